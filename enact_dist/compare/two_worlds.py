"""Slots of one or two world contexts as of one cut: their versions first, their data on demand.

The data stay fetchable until the program releases them, even if newer ones are committed.  Small
data arrive with the versions (up to 8 MiB per shard); large ones are fetched on demand.
"""

from __future__ import annotations

from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING, Any, ClassVar, Final, Protocol

import numpy as np

from enact_dist.access.closing import Closing
from enact_dist.access.reads import is_null
from enact_dist.access.session import unknown_aspect
from enact_dist.core.protocol.datum import Slot
from enact_dist.core.protocol.messages import Explain, Item, SlotVersion, Versions
from enact_dist.core.protocol.parts import CAUSE_FORK, DatumRead
from enact_dist.errors import MisuseError
from enact_dist.link.client.fetch import fetch_all
from enact_dist.terms import Access, Aspect
from enact_dist.wire.limits import ITEMS_MAX

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from enact_dist.access.session import Session
    from enact_dist.core.client.lock import MultiLock
    from enact_dist.core.client.plan import Reading
    from enact_dist.core.protocol.datum import Datum
    from enact_dist.link.client.locks import CellClient

SIGHT_S: Final = 10.0
"""How long a cut over its shards may take."""
GENERATIONS_MAX: Final = 64
"""How many forks of forks a version is followed through to where it was written."""
BLOCK_BYTES: Final = 1 << 20
"""Bytes that are compared in one step."""

Place = tuple[str, str]
"""Names of an entity and of an aspect."""


class Viewable(Protocol):
    """A `WorldContext`, or a `PastContext`."""

    past: ClassVar[bool]

    @property
    def name(self) -> str:
        """Its name."""

    @property
    def session(self) -> Session:
        """The request that shows it."""


class Sight(Closing):
    """What a cut showed, and the way to its data.  Used by one thread.

    Attributes:
        session: By which it was taken.
        forked: Whether a context in it is a fork.
    """

    def __init__(self, session: Session, lock: MultiLock, *, forked: bool) -> None:
        self.session = session
        self.forked = forked
        self._lock = lock
        self._readings: dict[str, dict[Place, Reading]] = {}
        for reading in lock.states:
            if not is_null(reading.state):
                context, entity, aspect = reading.state.slot
                self._readings.setdefault(context, {})[entity, aspect] = reading

    def of(self, context: str) -> dict[Place, Reading]:
        """Return the slots of one context that are not null."""
        return self._readings.get(context, {})

    def fetch(self, readings: Iterable[Reading]) -> dict[Slot, Datum]:
        """Return the data of some of its slots.

        Raises:
            LeaseLostError: A shard restarted, or the session rested too long: look again.
            ShardUnreachableError: A shard does not answer.
        """
        client, lock = self.session.client, self._lock.lock
        return fetch_all(client, self.session.cache, lock, readings, client.check_usable)

    def close(self) -> None:
        """Release its data; idempotent."""
        self.session.client.release(self._lock)


def look(worlds: Sequence[Viewable], places: Iterable[Place], *, each: bool) -> Sight:
    """Take one cut over world contexts of one cell and one time.

    Args:
        worlds: One or two.
        places: Entities (patterns with `each`) and aspects; of an aspect that a shard does not
            know it shows nothing.
        each: Whether these are patterns.

    Raises:
        ForgottenError: The past data are no longer known.
        LockTimeoutError: No consistent view came within `patience_s`.
        MisuseError: The requests exceed what one view can hold.
        UnknownWorldError: The cell no longer has one of them; checked if patterns show nothing.
        ShardUnreachableError: A shard does not answer.
    """
    client = worlds[0].session.client
    asked = list(places)
    names = dict.fromkeys(world.name for world in worlds)
    access = int(Access.VIEW_EACH if each else Access.VIEW)
    items = [Item(access, name, *place) for name in names for place in asked]
    if len(items) > ITEMS_MAX:
        raise MisuseError(
            f"asked {len(asked)} data of each of {len(names)} world contexts at once, found room"
            f" for {ITEMS_MAX} in all; name fewer aspects"
        )
    past_ns = past_ns_of(worlds[0])
    lock = client.acquire(items, wait_s=client.patience_s, hold_s=SIGHT_S, past_ns=past_ns)
    if lock.parts:
        # Commits came too fast for a consistent snapshot, so read locks replaced it.  No writer
        # should wait for a comparison: release the locks and look at that moment as the past.
        client.release(lock)
        past_ns = client.core.seen_stamp_ns
        lock = client.acquire(items, wait_s=client.patience_s, hold_s=SIGHT_S, past_ns=past_ns)
    sight = Sight(worlds[0].session, lock, forked=any(map(_is_fork, worlds)))
    try:
        for world in worlds:
            if each and not sight.of(world.name):
                world.session.check_world(world.name)
    except BaseException:
        sight.close()
        raise
    return sight


@contextmanager
def both_in_sight(
    left: Viewable, right: Viewable, places: Sequence[Place], *, each: bool
) -> Iterator[tuple[Sight, Sight]]:
    """Look at two world contexts: as one cut where they are of one cell and one time.

    Raises:
        ForgottenError: See `look`.
        LockTimeoutError: See `look`.
        ShardUnreachableError: See `look`.
    """
    one_cut = left.session is right.session and past_ns_of(left) == past_ns_of(right)
    with ExitStack() as stack:
        first = stack.enter_context(look([left, right] if one_cut else [left], places, each=each))
        second = first
        if not one_cut:
            second = stack.enter_context(look([right], places, each=each))
        yield first, second


def past_ns_of(world: Viewable) -> int:
    """Return the timestamp as of which a context is viewed (0: the present).

    Raises:
        MisuseError: It shows data by when they were captured, which are of no one moment.
    """
    if not world.past:
        return 0
    at_ns: int = getattr(world, "at_ns", 0)
    if not at_ns:
        raise MisuseError(
            f"{world!r} shows data by their capture stamps, which are of no one moment of the world"
            " context; compare it as of a moment: at(position)"
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
    """Return the aspects to look at by name, each with its type as far as that is known here.

    Args:
        worlds: The world contexts to look at.
        wanted: Aspects, or names; None: all that these cells know.
        later: Whether an aspect without a type that no cell knows may still come; one with a type
            is null until then, as it is for a view.

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
    """Return an aspect as this process has used it, else without a type."""
    used = [session.aspect_used(name) for session in sessions]
    return next((aspect for aspect in used if aspect is not None), Aspect(name, object))


# ---------------------------------------------------------------- what need not be fetched


def origins(session: Session, readings: Iterable[Reading]) -> dict[Slot, DatumRead]:
    """Return by slot where its version was written: a fork's copy was in what it was forked from.

    Copies bear the stamp of their fork, so nothing else is asked about.  One whose source is not
    known any more counts as written where it is.

    Raises:
        ShardUnreachableError: A shard does not answer.
    """
    client = session.client
    forked_ns = {name: entry.at_ns for name, entry in client.worlds().items() if entry.source}
    found = {
        one.state.slot: DatumRead(one.state.slot, one.state.version, one.state.stamp_ns)
        for one in readings
    }
    moved = dict(found)
    for _ in range(GENERATIONS_MAX):
        copies = {
            slot: at for slot, at in moved.items() if forked_ns.get(at.slot.context) == at.stamp_ns
        }
        if not copies:
            break
        sources = _sources(client, copies.values())
        moved = {slot: sources[at.slot] for slot, at in copies.items() if at.slot in sources}
        found |= moved
    return found


def _sources(client: CellClient, copies: Iterable[DatumRead]) -> dict[Slot, DatumRead]:
    """Return by slot what these copies were made of, as far as that is known."""
    asked: dict[str, list[SlotVersion]] = {}
    for copy in copies:
        shard = client.shard_of(copy.slot.entity)
        asked.setdefault(shard, []).append(SlotVersion(copy.slot, copy.version))
    answers = client.call_all([(shard, Explain(tuple(some))) for shard, some in asked.items()])
    return {
        entry.state.slot: entry.cause.reads[0]
        for answer in answers
        if isinstance(answer, Versions)
        for entry in answer.entries
        if entry.cause is not None and entry.cause.kind == CAUSE_FORK and entry.cause.reads
    }


def same_datum(left: Datum, right: Datum) -> bool:
    """Whether two data are the same bytes; some equal ones are not (NaN, -0.0, order of keys)."""
    if left.encoding != right.encoding or left.size != right.size:
        return False
    one, other = (np.frombuffer(each.body, np.uint8) for each in (left, right))
    return all(
        np.array_equal(one[start : start + BLOCK_BYTES], other[start : start + BLOCK_BYTES])
        for start in range(0, left.size, BLOCK_BYTES)
    )
