"""What a cell's handles share: the client, the datum cache, names turned into protocol items."""

from __future__ import annotations

import time
import weakref
from typing import TYPE_CHECKING, Any, Final, NoReturn

from enact_dist.access.asking import await_stamp
from enact_dist.access.reads import slot_of
from enact_dist.config.table import suggestion
from enact_dist.core.protocol.datum_types import type_conflict
from enact_dist.core.protocol.messages import AspectEntry, Item
from enact_dist.core.protocol.placement import shard_of
from enact_dist.core.state.retention import stated_limits
from enact_dist.errors import (
    DatumTypeError,
    MisuseError,
    ShardUnreachableError,
    UnknownWorldError,
)
from enact_dist.link.client.calls import CALL_S
from enact_dist.link.client.fetch import DatumCache
from enact_dist.retention import checked_retention
from enact_dist.terms import Access, Aspect, Entity, LockRequest, refuse_duplicates
from enact_dist.wire.fingerprint import fingerprint
from enact_dist.wire.limits import ITEMS_MAX

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from enact_dist.core.client.plan import Reading
    from enact_dist.core.protocol.datum import Slot
    from enact_dist.link.client.locks import CellClient


SETTLE_S: Final = 10.0
"""How long our own commit may take to be shown by all its shards."""
SETTLE_SLICE_S: Final = 0.5
ENTRIES_MAX: Final = 1024
"""Aspect objects whose catalogue entries are remembered."""
BOUND_ITEMS_MAX: Final = 32
BOUND_MAX: Final = 256
"""Sets of so few requests, at most so many, are remembered as they were bound."""
LOOKED_UP_S: Final = 1.0
"""So long the shards are not asked again about an aspect that is only read and not in use yet."""


class BoundRequests:
    """What the requests of a lock mean to a session, worked out once for each set of them.

    It refers to no request and no session: a session that is dropped ends at once.

    Args:
        requests: The requests, checked.

    Attributes:
        single: For each request of one entity, by its `id`: its slot, aspect, and whether it allows
            writing.  Valid while the caller keeps the requests.
        reads: The slots of those that show one datum and do not write it.
        items: The lines of the protocol, as asked for while no datum is cached.
        known_at: The state of the catalogues in which all aspects were found settled.
    """

    __slots__ = ("_alive", "items", "known_at", "reads", "single", "slots")

    def __init__(self, requests: tuple[LockRequest[Any], ...]) -> None:
        self.single: dict[int, tuple[Slot, Aspect[Any], bool]] = {}
        self._alive: list[weakref.ref[LockRequest[Any]]] = []
        items = []
        for request in dict.fromkeys(requests):
            items.append(Item(int(request.access), *request.address))
            if not request.access.each:
                slot = slot_of(request)
                self.single[id(request)] = slot, request.aspect, request.access is Access.WRITE
        self.items = tuple(items)
        self.slots = [slot for slot, _, _ in self.single.values()]
        self.reads = [slot for slot, _, writable in self.single.values() if not writable]
        self.known_at: object = None

    def remember(
        self, requests: tuple[LockRequest[Any], ...], bound: dict[tuple[int, ...], BoundRequests]
    ) -> None:
        """Enter this into the sets that a session remembers, until one of the requests is freed.

        Another object may then have its id.
        """
        key = tuple(map(id, requests))

        def drop(_: object) -> None:
            bound.pop(key, None)

        if len(bound) >= BOUND_MAX:
            bound.clear()
        self._alive = [weakref.ref(request, drop) for request in requests]
        bound[key] = self


class Session:
    """One connection of this process to a cell, behind `Cell`, `WorldContext` and `Lock`.

    Attributes:
        bound: The sets of requests that were bound here, by the ids of their requests.
        unknown: Aspects that are only read and that no shard knew when they were looked up.
    """

    def __init__(self, client: CellClient) -> None:
        self.client = client
        self.bound: dict[tuple[int, ...], BoundRequests] = {}
        self.cache = DatumCache()
        self._entries: dict[int, tuple[Aspect[Any], AspectEntry, AspectEntry]] = {}
        self._looked_up: dict[AspectEntry, float] = {}
        self._lapses = 0
        self.unknown: set[AspectEntry] = set()

    def __reduce__(self) -> NoReturn:
        raise MisuseError(
            "a cell cannot be pickled, and neither can contexts and requests made from it: let the"
            " other process connect by itself, and send it names, entities and aspects"
        )

    def prepare_bound(
        self, bound: BoundRequests, requests: Iterable[LockRequest[Any]], *, wait_s: float
    ) -> int:
        """`prepare` for the requests of a lock; at once where the catalogues have not changed."""
        client, catalogue = self.client, self.client.catalogue
        lapses = catalogue.lapses  # first: a lapse after this is seen by `check_shown`'s caller
        state = catalogue.state
        if bound.known_at is state and state[0] is client.core.placement:
            return lapses
        prepared = self._see_lapses()
        if not client.knows(self._entries_of(requests)[0]):
            return self.prepare(requests, wait_s=wait_s)
        bound.known_at = state  # as it was before: a change meanwhile is looked at next time
        return prepared

    def prepare(self, requests: Iterable[LockRequest[Any]], *, wait_s: float | None = None) -> int:
        """Make sure that the aspects of a lock or view can be used: register what it may write.

        Args:
            requests: The requests; only their shards are asked.
            wait_s: How long the caller would wait at most; each shard gets at least the time of
                one call.

        Returns:
            The value to pass to `check_shown` once a grant or view has arrived.

        Raises:
            DatumTypeError: A shard knows one of the aspects with another type.
            ShardUnreachableError: A shard that is asked does not answer.
        """
        prepared = self._see_lapses()
        entries, written = self._entries_of(requests)
        if self.client.knows(entries):
            return prepared
        timeout_s = self.client.request_timeout_s
        if wait_s is not None:
            timeout_s = min(timeout_s, max(wait_s, CALL_S))
        if written:
            writing = [request for request in requests if request.access.writes]
            self.client.register(
                aspects=[entry for entry in entries if entry.name in written],
                needed=lambda: self.shards_of(writing),
                timeout_s=timeout_s,
            )
        reading = [request for request in requests if request.aspect.name not in written]
        if reading:
            read = [entry for entry in entries if entry.name not in written]
            self._look_up(read, lambda: self.shards_of(reading), timeout_s)
        return prepared

    def _entries_of(
        self, requests: Iterable[LockRequest[Any]]
    ) -> tuple[list[AspectEntry], set[str]]:
        """Return the catalogue's entries of all aspects, and the names of those to be written."""
        aspects = {request.aspect.name: request.aspect for request in requests}
        written = {request.aspect.name for request in requests if request.access.writes}
        entries = [self._entry(one, reads=name not in written) for name, one in aspects.items()]
        return entries, written

    def _see_lapses(self) -> int:
        """Return how often a shard has forgotten an aspect; what was looked up before is void."""
        lapses = self.client.catalogue.lapses
        if lapses != self._lapses:
            self._lapses = lapses
            self._looked_up.clear()
        return lapses

    def greet(self, *, enough: str = "") -> None:
        """Refresh the aspects and world contexts that the shards know.

        With the name of an aspect that is `enough` it ends where those that answer at once know it.

        Raises:
            ShardUnreachableError: A shard does not answer.
        """
        client = self.client
        if enough:
            client.call_once([(shard, client.core.hello(shard)) for shard in client.shards()])
            found = client.aspect_entries().get(enough)
            if found is not None and found.fingerprint:
                return
        client.greet()

    def registered(self, *, enough: str = "") -> dict[str, AspectEntry]:
        """Return the registered aspects by name, as the shards know them now.

        Once a shard that answers knows an aspect that is `enough`, no other shard is awaited.

        Raises:
            ShardUnreachableError: A shard does not answer.
        """
        self.greet(enough=enough)
        return self.client.aspect_entries()

    def typed_aspects(self, *, enough: str = "") -> list[str]:
        """Return the names of the registered aspects that have a type, sorted; see `registered`."""
        entries = self.registered(enough=enough)
        return sorted(name for name, entry in entries.items() if entry.fingerprint)

    def look_up(self, aspects: Iterable[Aspect[Any]], *, timeout_s: float | None = None) -> None:
        """Make sure that no shard knows one of these aspects, which are only read, otherwise.

        Args:
            aspects: The aspects.
            timeout_s: How long shards have to answer; None: `request_timeout_s`.

        Raises:
            DatumTypeError: A shard knows one with another type.
            ShardUnreachableError: A shard that is asked does not answer.
        """
        self._see_lapses()
        entries = [self._entry(aspect, reads=True) for aspect in aspects]
        if not self.client.knows(entries):
            self._look_up(entries, self.client.shards, timeout_s)

    def _look_up(
        self,
        entries: Sequence[AspectEntry],
        needed: Callable[[], Iterable[str]],
        timeout_s: float | None,
    ) -> None:
        """Check aspects that are only read; nothing comes to be by being asked for.

        A reader of a known aspect may want more retention, and the aspect may be new to some
        shard: these are registered too, except by an observer.
        """
        client, now_s = self.client, time.monotonic()
        due = [e for e in entries if now_s >= self._looked_up.get(e, -LOOKED_UP_S) + LOOKED_UP_S]
        lacking = client.lacking(due, needed)
        if not lacking:
            self.unknown.difference_update(due)
            return
        client.greet(lacking, timeout_s=timeout_s)
        known = client.aspect_entries()
        for entry in due:
            wrong = type_conflict(known[entry.name], entry) if entry.name in known else ""
            if wrong:
                raise DatumTypeError(wrong)
        used = [entry for entry in due if entry.name in known]
        if used and not client.core.observer:
            # A shard to which an aspect is new gets the type that the others have.
            as_known = [one._replace(fingerprint=known[one.name].fingerprint) for one in used]
            client.register(aspects=as_known, needed=needed, timeout_s=timeout_s)
        if len(self._looked_up) >= ENTRIES_MAX:
            self._looked_up.clear()
            self.unknown.clear()
        self._looked_up.update(dict.fromkeys(due, now_s))
        self.unknown -= set(used)
        self.unknown |= set(due) - set(used)

    def check_shown(
        self, readings: Iterable[Reading], requests: Iterable[LockRequest[Any]], prepared: int
    ) -> None:
        """Check aspects that came into use after they were looked up, by what is shown of them.

        Checks only the aspects of these requests, at the shards that show them.  If a shard has
        forgotten an aspect or changed its type in between, all are checked again.

        Args:
            readings: What is shown.
            requests: What was asked for.
            prepared: What `prepare` has returned.

        Raises:
            DatumTypeError: One has another type.
            ShardUnreachableError: A shard does not answer.
        """
        if self.client.catalogue.lapses != prepared:
            self.prepare(requests, wait_s=CALL_S)
        if not self.unknown:
            return  # the usual case
        shown = [one.state.slot for one in readings if not one.state.null_reason]
        names = {slot.aspect for slot in shown}
        wanted = {
            self._entry(one.aspect, reads=True) for one in requests if one.aspect.name in names
        }
        entries = [entry for entry in wanted if entry in self.unknown]
        for entry in entries:
            self._looked_up.pop(entry, None)
            self.unknown.discard(entry)  # whatever comes out, it is not unknown any more
        if entries:
            new = {entry.name for entry in entries}
            placement = self.client.core.placement
            shards = {shard_of(slot.entity, placement) for slot in shown if slot.aspect in new}
            self._look_up(entries, lambda: shards, CALL_S)

    def shards_of(self, requests: Iterable[LockRequest[Any]]) -> set[str]:
        """Return the shards on which the requests lie; a pattern lies on all."""
        shards: set[str] = set()
        for request in requests:
            if request.access.each:
                return set(self.client.shards())
            shards.add(shard_of(str(request.entity), self.client.core.placement))
        return shards

    def _entry(self, aspect: Aspect[Any], *, reads: bool = False) -> AspectEntry:
        """Return the entry with which a client registers; computed once per aspect object."""
        known = self._entries.get(id(aspect))
        if known is None or known[0] is not aspect:
            if len(self._entries) >= ENTRIES_MAX:
                self._entries.clear()  # for programs that make a new aspect for each lock
                self.bound.clear()  # so that the aspects of every set are entered again
            durability = aspect.durability.value if aspect.durability is not None else ""
            try:
                datum_type = fingerprint(aspect.datum_type)
            except DatumTypeError as error:
                raise DatumTypeError(f"aspect {aspect.name!r}: {error}") from None
            entry = AspectEntry(
                aspect.name,
                datum_type,
                durability,
                *stated_limits(checked_retention(aspect.retention)),
            )
            known = (aspect, entry, entry._replace(reads=True))
            self._entries[id(aspect)] = known
        _, writing, reading = known
        return reading if reads else writing

    def aspect_used(self, name: str) -> Aspect[Any] | None:
        """Return the aspect of that name that this process used last here, if it used one."""
        entries = list(self._entries.values())  # other threads add to them
        return next((aspect for aspect, *_ in reversed(entries) if aspect.name == name), None)

    def shard_of(self, slot: Slot) -> str:
        """Return the name of the shard that owns the slot."""
        return shard_of(slot.entity, self.client.core.placement)

    def item_of(
        self, request: LockRequest[Any], captured_ns: int = 0, *, nearest: bool = False
    ) -> Item:
        """Return the protocol's line for a request, with the version that the cache holds.

        With `captured_ns` it asks for the version with that capture stamp, or the `nearest`.
        """
        context, entity, aspect = request.address
        if request.access.each:
            return Item(int(request.access), context, entity, aspect)
        slot, known = slot_of(request), 0
        if slot in self.cache:
            shard = self.shard_of(slot)
            known = self.cache.version(slot, shard, self.client.core.epoch(shard))
        return Item(int(request.access), context, entity, aspect, known, captured_ns, nearest)

    def settle(self, shard: str) -> None:
        """Wait until a shard shows our own commits over shards, which may be on their way to it.

        Raises:
            ShardUnreachableError: It does not in time.
        """
        stamp_ns = self.client.unsettled_ns(shard)
        deadline_s = time.monotonic() + SETTLE_S
        while stamp_ns:
            if await_stamp(self.client, shard, stamp_ns, wait_s=SETTLE_SLICE_S):
                self.client.reached(shard, stamp_ns)
                return
            if time.monotonic() >= deadline_s:
                raise ShardUnreachableError(
                    f"shard {shard} does not show a commit of this process after {SETTLE_S:g} s:"
                    " the shard that decided it is away; see `enact lock ls`",
                    shard=shard,
                )

    def check_world(self, name: str) -> None:
        """Make sure that the cell has a world context: where a listing came back empty.

        Raises:
            UnknownWorldError: Not every shard has it (any more).
            ShardUnreachableError: A shard does not answer.
        """
        self.client.greet()
        if name not in self.client.worlds():
            raise self.unknown_world(name)

    def unknown_world(self, name: str) -> UnknownWorldError:
        """Return the error for a world context that the cell does not have."""
        known = tuple(self.client.worlds())
        part = self.client.worlds_at(name)
        remedy = f"enact world create {name}, or cell.create_world({name!r}), makes it"
        if part:
            remedy = (
                f"a part of it is on {', '.join(part)} alone: complete the fork, or drop it with"
                f" enact world drop {name}, or cell.drop_world({name!r})"
            )
        return UnknownWorldError(
            f"the cell has no world context {name!r}{suggestion(name, known)} (it has"
            f" {', '.join(known) or 'none'}); {remedy}",
            known=known,
        )


def unknown_aspect(name: str, known: Iterable[str]) -> MisuseError:
    """Return the error for an aspect that no program has registered."""
    names = sorted(known)
    return MisuseError(
        f"no aspect {name!r} is registered{suggestion(name, names)} (known:"
        f" {', '.join(names) or 'none'})"
    )


def bound_before(requests: tuple[LockRequest[Any], ...]) -> BoundRequests | None:
    """Return what the requests of a lock mean if exactly these were bound before."""
    world = getattr(requests[0], "world", None) if requests else None
    session: Session | None = getattr(world, "session", None)
    return session.bound.get(tuple(map(id, requests))) if session is not None else None


def bind(requests: tuple[LockRequest[Any], ...]) -> BoundRequests:
    """Return what the requests of a lock mean; remembered for sets of a few requests.

    Raises:
        MisuseError: There are none or too many, one datum is named twice with different accesses,
            or as `session_of`.
    """
    if not requests:
        raise MisuseError("a lock of nothing: name at least one request")
    if len(requests) > ITEMS_MAX:
        raise MisuseError(
            f"a lock with {len(requests)} requests; at most {ITEMS_MAX} are allowed. A pattern"
            " (ReadEach, WriteEach, ViewEach) counts as one request and shows all matching"
            f" data, but one lock writes at most {ITEMS_MAX}"
        )
    session = session_of(requests)
    try:
        refuse_duplicates(requests)
    except ValueError as error:
        raise MisuseError(str(error)) from None
    bound = BoundRequests(requests)
    if len(requests) <= BOUND_ITEMS_MAX:
        bound.remember(requests, session.bound)
    return bound


def session_of(requests: tuple[LockRequest[Any], ...], *, view: bool = False) -> Session:
    """Return the one cell session that all requests belong to.

    Args:
        requests: Of a lock, or of a `view`, which may be one of the past.
        view: Whether they only look.

    Raises:
        MisuseError: A request names an unbound role, two cells are mixed, or one locks the past.
    """
    session: Session | None = None
    for request in requests:
        if not isinstance(request, LockRequest):
            raise MisuseError(
                f"{request!r} is no lock request;"
                f" {getattr(request, 'remedy', 'use Read, Write, View or …Each')}"
            )
        found: Session | None = getattr(request.world, "session", None)
        if found is None:
            raise MisuseError(
                f"{request!r} names {request.world!r}, which is a role and not a world context of"
                " a cell; use cell.world(name), or run the actor with its roles bound"
            )
        if not request.access.each and not isinstance(request.entity, Entity):
            raise MisuseError(
                f"{request!r} names a pattern; outside an actor use {type(request).__name__}Each"
            )
        if request.world.past and (request.access.locks or not view):
            raise MisuseError(
                f"{request!r} names {request.world!r}: what was cannot be locked; view it with"
                " past.view(View(past, …)), or name the world context as it is now"
            )
        if session is not None and found is not session:
            raise MisuseError("one lock names world contexts of two connections; connect once")
        session = found
    assert session is not None, "called with at least one request"
    return session
