"""The two sides of a comparison: consistent snapshots, aspects, and what need not be fetched."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from typing import Any, ClassVar, Final, Protocol

import numpy as np

from enact_dist.access.asking import explained
from enact_dist.access.reads import is_null
from enact_dist.access.session import Session, unknown_aspect
from enact_dist.access.snapshot import HeldView
from enact_dist.core.client.plan import Reading
from enact_dist.core.protocol.datum import Datum, Slot
from enact_dist.core.protocol.messages import CAUSE_FORK, DatumRead, Item, SlotVersion
from enact_dist.errors import MisuseError
from enact_dist.terms import Access, Aspect
from enact_dist.wire.limits import ITEMS_MAX

GENERATIONS_MAX: Final = 64
"""How many forks of forks are followed back to the context where a version was written."""
BLOCK_BYTES: Final = 1 << 20
"""Bytes that are compared in one step."""

Place = tuple[str, str]
"""Names of an entity and of an aspect."""


class Viewable(Protocol):
    """A `WorldContext` or a `PastContext`."""

    past: ClassVar[bool]

    @property
    def name(self) -> str:
        """Its name."""

    @property
    def session(self) -> Session:
        """The connection that it belongs to."""


class SideView(HeldView):
    """A consistent snapshot of one side of a comparison, or of both.

    Args:
        worlds: One or two world contexts of one cell and one time.
        places: Entities (patterns with `each`) and aspects; an aspect that a shard does not know
            has no slots there.
        each: Whether the entities are patterns.

    Attributes:
        forked: Whether one of the contexts is a fork.

    Raises:
        ForgottenError: The past data are no longer known.
        LockTimeoutError: No consistent view came within `request_timeout_s`.
        MisuseError: The requests exceed what one view can hold.
        UnknownWorldError: The cell no longer has one of them; checked if patterns show nothing.
        ShardUnreachableError: A shard does not answer.
    """

    def __init__(self, worlds: Sequence[Viewable], places: Iterable[Place], *, each: bool) -> None:
        asked, session = list(places), worlds[0].session
        names = dict.fromkeys(world.name for world in worlds)
        access = int(Access.VIEW_EACH if each else Access.VIEW)
        items = [Item(access, name, *place) for name in names for place in asked]
        if len(items) > ITEMS_MAX:
            raise MisuseError(
                f"asked for {len(asked)} data of each of {len(names)} world contexts at once; at"
                f" most {ITEMS_MAX} fit in all; name fewer aspects"
            )
        super().__init__(session, items, past_ns=past_ns_of(worlds[0]))
        if self.locks:
            # Commits came too fast for a consistent snapshot, so read locks replaced it.  No writer
            # should wait for a comparison: release the locks and view that moment as the past.
            self.close()
            super().__init__(session, items, past_ns=session.client.core.seen_stamp_ns)
        self.forked = any(map(_is_fork, worlds))
        self._readings: dict[str, dict[Place, Reading]] = {}
        for reading in self.states:
            if not is_null(reading.state):
                context, entity, aspect = reading.state.slot
                self._readings.setdefault(context, {})[entity, aspect] = reading
        try:
            for world in worlds:
                if each and not self.of(world.name):
                    session.check_world(world.name)
        except BaseException:
            self.close()
            raise

    def of(self, context: str) -> dict[Place, Reading]:
        """Return the slots of one context that are not null."""
        return self._readings.get(context, {})


@contextmanager
def both_sides(
    left: Viewable, right: Viewable, places: Sequence[Place], *, each: bool
) -> Iterator[tuple[SideView, SideView]]:
    """View two world contexts, in one snapshot if they are of one cell and one time."""
    together = left.session is right.session and past_ns_of(left) == past_ns_of(right)
    with ExitStack() as stack:
        worlds = [left, right] if together else [left]
        first = second = stack.enter_context(SideView(worlds, places, each=each))
        if not together:
            second = stack.enter_context(SideView([right], places, each=each))
        yield first, second


def past_ns_of(world: Viewable) -> int:
    """Return the timestamp as of which a context is viewed (0: the present).

    Raises:
        MisuseError: It shows data by their capture stamps, which belong to no single moment.
    """
    if not world.past:
        return 0
    at_ns: int = getattr(world, "at_ns", 0)
    if not at_ns:
        raise MisuseError(
            f"{world!r} shows data by their capture stamps, which belong to no single moment of"
            " the world context; compare it as of a moment: at(position)"
        )
    return at_ns


def _is_fork(world: Viewable) -> bool:
    entry = world.session.client.worlds().get(world.name)
    return entry is not None and bool(entry.source)


def aspects_of(
    worlds: Sequence[Viewable],
    wanted: Iterable[Aspect[Any] | str] | None,
    *,
    later: bool = False,
) -> dict[str, Aspect[Any]]:
    """Return the aspects to compare by name, each with its type if this process knows it.

    Args:
        worlds: The world contexts to compare.
        wanted: Aspects, or names; None: all that these cells know.
        later: Whether an aspect without a type may be registered later; one with a type may always,
            and its slots are null until then.

    Raises:
        MisuseError: A name that no cell knows.
        DatumTypeError: An aspect is registered with another type.
    """
    sessions = dict.fromkeys(world.session for world in worlds)
    if wanted is None or not set(_names(wanted := tuple(wanted))) <= _known(sessions):
        for session in sessions:
            session.client.greet()
    given = {one.name: one for one in wanted or () if isinstance(one, Aspect)}
    typed = {name: one for name, one in given.items() if one.datum_type is not object}
    for session in sessions:
        session.look_up(typed.values())
    known = _known(sessions)
    expected = given if later else typed
    for name in _names(wanted or ()):
        if name not in known and name not in expected:
            raise unknown_aspect(name, known)
    names = known if wanted is None else _names(wanted)
    return {name: given.get(name) or _type_used(sessions, name) for name in sorted(names)}


def _names(aspects: Iterable[Aspect[Any] | str]) -> list[str]:
    return [str(aspect) for aspect in aspects]


def _known(sessions: Iterable[Session]) -> set[str]:
    """Return the names of all aspects that cells know a type of."""
    entries = [entry for one in sessions for entry in one.client.aspect_entries().values()]
    return {entry.name for entry in entries if entry.fingerprint}


def _type_used(sessions: Iterable[Session], name: str) -> Aspect[Any]:
    """Return an aspect as this process has used it, or without a type."""
    used = [session.aspect_used(name) for session in sessions]
    return next((aspect for aspect in used if aspect is not None), Aspect(name, object))


# ---------------------------------------------------------------- what need not be fetched


def origins(session: Session, readings: Iterable[Reading]) -> dict[Slot, DatumRead]:
    """Return by slot where its version was written: a fork's copy comes from the forked context.

    A copy has the timestamp of its fork, so only versions with that timestamp are asked about.  A
    copy whose source is not known any more counts as written where it is.

    Raises:
        ShardUnreachableError: A shard does not answer.
    """
    forked_ns = {
        name: entry.at_ns for name, entry in session.client.worlds().items() if entry.source
    }
    found = moved = {one.state.slot: DatumRead(*one.state[:3]) for one in readings}
    for _ in range(GENERATIONS_MAX):
        copies = {
            slot: at for slot, at in moved.items() if forked_ns.get(at.slot.context) == at.stamp_ns
        }
        if not copies:
            break
        asked = (SlotVersion(copy.slot, copy.version) for copy in copies.values())
        sources = {
            entry.state.slot: entry.cause.reads[0]
            for answer in explained(session.client, asked)
            for entry in answer.entries
            if entry.cause is not None and entry.cause.kind == CAUSE_FORK and entry.cause.reads
        }
        moved = {slot: sources[at.slot] for slot, at in copies.items() if at.slot in sources}
        found = found | moved
    return found


def same_datum(left: Datum, right: Datum) -> bool:
    """Whether two data are the same bytes; some equal ones are not (NaN, -0.0, order of keys)."""
    if left.encoding != right.encoding or left.size != right.size:
        return False
    one, other = (np.frombuffer(each.body, np.uint8) for each in (left, right))
    return all(
        np.array_equal(one[start : start + BLOCK_BYTES], other[start : start + BLOCK_BYTES])
        for start in range(0, left.size, BLOCK_BYTES)
    )
