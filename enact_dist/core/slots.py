"""The world contexts of one shard: slots, their newest committed states, and the catalogue.

The map itself (ENACT 3.2) is `SlotMap`: (context, entity, aspect) to a version and a datum or
null.  Every committed write adds one to the version; a deleted slot keeps its version and never
reuses one.  Versions of volatile slots start again after a restart, so a version is only
comparable within one epoch of the shard.
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final, NamedTuple

from enact_dist.core.datum import Column, Datum, Slot
from enact_dist.core.messages import AspectEntry, Cause, SlotState, WorldEntry
from enact_dist.core.past import Past
from enact_dist.core.retained import Retained
from enact_dist.core.retaining import covers, with_larger
from enact_dist.terms import ACCESSES, Durability, NullReason, pattern_matches

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

    from enact_dist.core.messages import Item
    from enact_dist.core.records import SlotRecord

INLINE_BYTES_MAX: Final = 64 * 1024
"""Data up to this size travel with the grant; larger ones are fetched when they are read."""
ANSWER_BYTES_MAX: Final = 8 << 20
"""So many bytes of small data travel with one grant; a pattern's further ones count as large."""


@dataclass(frozen=True, slots=True)
class Content:
    """The committed state of one slot; replaced, never changed."""

    version: int
    stamp_ns: int
    datum: Datum | None
    null_reason: NullReason
    cause: Cause | None = None


NOTHING: Final = Content(0, 0, None, NullReason.NEVER_SET)
_OUTSIDE: Final = Content(0, 0, None, NullReason.OUTSIDE_RETENTION)


class Shown(NamedTuple):
    """What a grant or view shows.

    Attributes:
        states: The slots.
        pins: The data that `states` name without carrying, to keep them fetchable.
        from_ns: The largest stamp of it, nulls of a pattern included: current from there on.
    """

    states: list[SlotState]
    pins: dict[tuple[Slot, int], Datum]
    from_ns: int


class SlotMap:
    """All slots of one shard by context and aspect."""

    __slots__ = (
        "_answer_bytes_max",
        "_columns",
        "_version_bases",
        "bytes",
        "count",
        "past",
        "retained",
    )

    def __init__(
        self,
        recovered: Iterable[SlotRecord],
        *,
        answer_bytes_max: int = ANSWER_BYTES_MAX,
        version_bases: Mapping[str, int] | None = None,
    ) -> None:
        self._answer_bytes_max = answer_bytes_max
        self._version_bases = dict(version_bases or {})
        self._columns: dict[Column, dict[str, Content]] = {}
        self.count = 0
        self.bytes = 0
        self.past = Past()
        self.retained = Retained()
        for record in recovered:
            if record.volatile:
                self.set(record.slot, Content(0, 0, None, NullReason.LOST))
            else:
                reason = (
                    NullReason[record.null_reason] if record.null_reason else NullReason.DELETED
                )
                self.set(
                    record.slot,
                    Content(record.version, record.stamp_ns, record.datum, reason, record.cause),
                )

    def __getitem__(self, slot: Slot) -> Content:
        context, entity, aspect = slot
        column = self._columns.get((context, aspect))  # type: ignore[call-overload]
        return NOTHING if column is None else column.get(entity, NOTHING)

    def exists(self, slot: Slot) -> bool:
        """Whether the slot was ever written or is known to have been."""
        return self[slot] is not NOTHING

    def next_version(self, slot: Slot) -> int:
        """Return the version that the next write of a slot makes.

        In a context that was dropped before, the first one lies above all that it had then.
        """
        version = self[slot].version
        return (version or self._version_bases.get(slot.context, 0)) + 1

    def version_base(self, context: str) -> int:
        """Return the largest version of a context, the nulls of a drop counted as versions."""
        before = self._version_bases.get(context, 0)
        return max([before, *(content.version + 1 for _, content in self.of_context(context))])

    def drop(self, context: str) -> list[tuple[Slot, Content]]:
        """Forget all slots of a context with their past, and return them."""
        gone = list(self.of_context(context))
        self._version_bases[context] = self.version_base(context)
        for column in [column for column in self._columns if column.context == context]:
            del self._columns[column]
        self.past.drop(context)
        self.retained.drop(context)
        self.count -= len(gone)
        self.bytes -= sum(content.datum.size for _, content in gone if content.datum is not None)
        return gone

    def versions(self, slot: Slot) -> Iterator[Content]:
        """Yield all states of a slot that are known, oldest first."""
        yield from (old for old in self.past.of(slot) if old is not NOTHING)
        yield self[slot]

    def as_of(self, slot: Slot, at_ns: int) -> Content | int:
        """Return the state of a slot as of a stamp, or since when it is known if that is later."""
        versions = list(self.versions(slot))
        for content in reversed(versions):
            if content.stamp_ns <= at_ns:
                return content
        first = self._version_bases.get(slot.context, 0) + 1
        return NOTHING if versions[0].version == first else versions[0].stamp_ns

    def replace(self, slot: Slot, content: Content, *, retention: int = 1) -> None:
        """Put a newly committed state in place of the old one, which stays known for a while.

        Args:
            slot: The slot.
            content: Its new state.
            retention: How many versions stay readable, the new one included.
        """
        old = self.set(slot, content)
        self.past.keep(slot, old, until_ns=content.stamp_ns)
        if retention > 1:
            self.retained.keep(slot, old, count=retention - 1)

    def at(self, slot: Slot, content: Content, at_ns: int) -> Content:
        """Return the state of a slot as of a stamp (0: now), or `content` where that is gone."""
        if not at_ns or content.stamp_ns <= at_ns:
            return content
        return self.past.at(slot, at_ns) or content

    def captured(self, slot: Slot, newest: Content, captured_ns: int) -> Content:
        """Return the newest version up to `newest` with a capture stamp, null if none is left."""
        if newest.datum is not None and newest.datum.stamp_ns == captured_ns:
            return newest
        found = self.retained.captured(slot, captured_ns, version_max=newest.version)
        if found is not None:
            return found
        return newest if newest.datum is None else _OUTSIDE

    def make_room(self, size: int) -> tuple[int, int]:
        """Forget the oldest replaced states until so many bytes of payloads are named no more.

        What is kept to answer as of a recent stamp goes first: the present stands in for it.
        Where all of them would not do, they stay.

        Returns:
            How many versions went, and the bytes of payloads that only they named.
        """
        named = {
            old.datum.file: old.datum.size
            for old in (*self.past.states(), *self.retained.states())
            if old.datum is not None and old.datum.file
        }
        gone = freed = 0
        if sum(named.values()) < size:
            return 0, 0
        while self.past:
            slot, old = self.past.forget_oldest()
            freed_now = 0 if (slot, old.version) in self.retained else _payload_bytes(old)
            freed, gone = freed + freed_now, gone + bool(freed_now)
        while self.retained and freed < size:
            freed += _payload_bytes(self.retained.forget_oldest())
            gone += 1
        return gone, freed

    def biggest(self, count: int) -> list[tuple[str, int]]:
        """Return the slots whose newest data are the largest, with their bytes."""
        sizes = (
            (content.datum.size, str(Slot(column.context, entity, column.aspect)))
            for column, contents in self._columns.items()
            for entity, content in contents.items()
            if content.datum is not None
        )
        return [(name, size) for size, name in heapq.nlargest(count, sizes)]

    def set(self, slot: Slot, content: Content) -> Content:
        """Put a new committed state in place of the old one, which is returned."""
        context, entity, aspect = slot
        column = self._columns.get((context, aspect))  # type: ignore[call-overload]
        if column is None:
            column = self._columns[Column(context, aspect)] = {}
        old: Content = column.get(entity, NOTHING)
        if old is NOTHING:
            self.count += 1
        elif old.datum is not None:
            self.bytes -= old.datum.size
        if content.datum is not None:
            self.bytes += content.datum.size
        column[entity] = content
        return old

    def matching(self, column: Column, pattern: str) -> Iterator[tuple[Slot, Content]]:
        """Yield the slots of a column whose entity the pattern covers, null ones too."""
        for entity, content in self._columns.get(column, {}).items():
            if pattern_matches(pattern, entity):
                yield Slot(column.context, entity, column.aspect), content

    def of_context(self, context: str) -> Iterator[tuple[Slot, Content]]:
        """Yield the slots of a context, null ones too."""
        for column, contents in self._columns.items():
            if column.context == context:
                for entity, content in contents.items():
                    yield Slot(context, entity, column.aspect), content

    def all(self) -> Iterator[Slot]:
        """Yield every slot."""
        for context in dict.fromkeys(column.context for column in self._columns):
            yield from (slot for slot, _ in self.of_context(context))

    def columns(self) -> Iterator[Column]:
        """Yield every (context, aspect) that has slots."""
        yield from self._columns

    def shown(self, items: Iterable[Item], at_ns: int = 0) -> Shown:
        """Return what a grant or view shows of `items` as of a stamp (0: now).

        Slots stand in order, patterns expanded to those that are not null.
        """
        states: list[SlotState] = []
        pins: dict[tuple[Slot, int], Datum] = {}
        from_ns, left = 0, self._answer_bytes_max
        for item in items:
            each = ACCESSES[item.access].each
            if each:
                column = Column(item.context, item.aspect)
                found = list(self.matching(column, item.entity))
            else:
                slot = Slot(item.context, item.entity, item.aspect)
                found = [(slot, self[slot])]
            for slot, newest in found:
                content = self.at(slot, newest, at_ns) if at_ns else newest
                # Of the newest one as of then, too, where an older version is asked: what was
                # captured when is certain only from its commit on.
                from_ns = max(from_ns, content.stamp_ns)
                if item.captured_ns:
                    content = self.captured(slot, content, item.captured_ns)
                if content.datum is None and each:
                    continue
                state = state_of(slot, content, known=item.known, inline_max=left)
                left -= state.size if state.datum is not None and not state.large else 0
                states.append(state)
                if content.datum is not None and (state.large or state.same):
                    pins[slot, state.version] = content.datum
        return Shown(states, pins, from_ns)


def _payload_bytes(content: Content) -> int:
    datum = content.datum
    return datum.size if datum is not None and datum.file else 0


def state_of(
    slot: Slot,
    content: Content,
    *,
    known: int = 0,
    with_datum: bool = True,
    inline_max: int = INLINE_BYTES_MAX,
) -> SlotState:
    """Return what travels of a slot: its datum where that is small and not known already."""
    datum = content.datum
    if datum is None:
        return SlotState(
            slot, content.version, content.stamp_ns, 0, None, False, False, content.null_reason.name
        )
    same = with_datum and known == content.version > 0
    large = datum.size > min(INLINE_BYTES_MAX, max(0, inline_max))
    if same or not with_datum:
        shown = None
    else:
        # A payload's name tells a client of this host where to look; the size belongs to it.
        size = datum.size if datum.file else 0
        shown = replace(datum, body=b"", size=size) if large else datum
    return SlotState(
        slot,
        content.version,
        content.stamp_ns,
        datum.size,
        shown,
        same,
        large and not same,
        "",
        datum.stamp_ns,
    )


class Catalogue:
    """World contexts and aspects that this shard knows."""

    __slots__ = ("_configured", "aspects", "worlds")

    def __init__(
        self,
        *,
        configured: Iterable[AspectEntry],
        recovered: Iterable[AspectEntry],
        worlds: Iterable[WorldEntry],
    ) -> None:
        self._configured = {entry.name: entry for entry in configured}
        self.aspects: dict[str, AspectEntry] = {}
        self.worlds: dict[str, WorldEntry] = {}
        for world in worlds:
            # That it is a fork is known of a context which is also named elsewhere.
            if world.source or world.name not in self.worlds:
                self.worlds[world.name] = world
        for entry in recovered:
            self.aspects[entry.name] = self._with_configured(entry)

    def _with_configured(self, entry: AspectEntry) -> AspectEntry:
        """Let the cell's configuration decide the durability, and the larger retention count."""
        configured = self._configured.get(entry.name)
        durability = configured.durability if configured else ""
        durability = durability or entry.durability or Durability.DURABLE.value
        entry = entry._replace(durability=durability)
        return with_larger(entry, configured) if configured else entry

    def register(self, entry: AspectEntry) -> tuple[AspectEntry, bool] | str:
        """Register an aspect; return its entry and whether it changed, or why it is refused."""
        wanted = self._with_configured(entry)
        known = self.aspects.get(entry.name)
        if known is None:
            self.aspects[entry.name] = wanted
            return wanted, True
        if known.fingerprint != wanted.fingerprint:
            return (
                f"aspect {entry.name!r} is registered with datum type {known.fingerprint}, and was"
                f" now asked with {wanted.fingerprint}; use the registered type or another name"
            )
        if entry.durability and known.durability != wanted.durability:
            return (
                f"aspect {entry.name!r} is registered as {known.durability}, and was now asked as"
                f" {wanted.durability}; state one durability in cell.toml or in Aspect(…)"
            )
        if not covers(known, wanted):
            known = self.aspects[entry.name] = with_larger(known, wanted)
            return known, True
        return known, False

    def forks(self) -> tuple[WorldEntry, ...]:
        """Return the world contexts that are forks."""
        return tuple(world for world in self.worlds.values() if world.source)

    def retention(self, aspect: str) -> int:
        """Return how many versions of a slot of this aspect stay readable."""
        entry = self.aspects.get(aspect)
        return max(1, entry.retention) if entry is not None else 1

    def durability(self, aspect: str) -> Durability:
        """Return what a commit of this (registered) aspect survives."""
        return _DURABILITIES[self.aspects[aspect].durability]


_DURABILITIES: Final = {durability.value: durability for durability in Durability}
