"""The world contexts of one shard: slots, their newest committed states and their history.

The map itself (ENACT 3.2) is `SlotMap`: (context, entity, aspect) to a version and a datum or
null.  Every committed write adds one to the version; a deleted slot keeps its version and never
reuses one.  Versions of volatile slots start again after a restart, so a version is only
comparable within one epoch of the shard.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from heapq import nlargest
from itertools import islice
from operator import itemgetter
from typing import Final, NamedTuple

from enact_dist.core.protocol.datum import Column, Datum, Slot
from enact_dist.core.protocol.messages import (
    INLINE_BYTES_MAX,
    Forgotten,
    Item,
    SlotState,
    SlotVersion,
    WriteItem,
)
from enact_dist.core.protocol.records import (
    LOST,
    NOTHING,
    AspectForgotten,
    Content,
    KeptRecord,
    SlotRecord,
    WorldDropped,
    content_of,
)
from enact_dist.core.state.history import History, Policy
from enact_dist.core.state.retention import AspectBases, Bases, PayloadNames
from enact_dist.patterns import pattern_matches
from enact_dist.terms import ACCESSES, NullReason

ANSWER_BYTES_MAX: Final = 8 << 20
"""So many bytes of small data travel with one grant; a pattern's further ones count as large."""
LARGE_BYTES: Final = INLINE_BYTES_MAX
"""Smaller data are not counted: they never lie in shared memory."""
LOOKED_MAX: Final = 1000
"""Slots of a group that one question looks at."""


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


class LargeSlots:
    """The slots whose newest data are large: the largest are found at once, of however many.

    Slots stand in groups by the power of two of their size.  A question looks at the topmost
    groups, and there at some of each: what it names is as large as the largest ones, or half of it
    at least.
    """

    __slots__ = ("_groups",)

    def __init__(self) -> None:
        self._groups: dict[int, dict[Slot, int]] = {}

    def change(self, slot: Slot, *, before: int, after: int) -> None:
        """Note that the datum of a slot has so many bytes now (0: it is null, or gone)."""
        if before >= LARGE_BYTES:
            group = self._groups[before.bit_length()]
            del group[slot]
            if not group:
                del self._groups[before.bit_length()]
        if after >= LARGE_BYTES:
            self._groups.setdefault(after.bit_length(), {})[slot] = after

    def largest(self, count: int) -> list[tuple[str, int]]:
        """Return slots with the largest data, with their bytes; fewer where few are large."""
        found: list[tuple[Slot, int]] = []
        for exponent in sorted(self._groups, reverse=True):
            found += islice(self._groups[exponent].items(), LOOKED_MAX)
            if len(found) >= count:
                break
        return [(str(slot), size) for slot, size in nlargest(count, found, key=itemgetter(1))]


class SlotMap:
    """All slots of one shard by context and aspect, and their history.

    Args:
        recovered: The newest states that the store has kept.
        policies: How much of its history each aspect retains; may change.
        since_ns: Stamp of the start of this epoch: lost data count as lost from then on.
        answer_bytes_max: Limit of the bytes of small data in one answer.
        dropped: The contexts that were dropped, and above which versions theirs start now.
        forgotten: The aspects that were forgotten, likewise.

    Attributes:
        large: Which slots have the largest data.
    """

    __slots__ = (
        "_answer_bytes_max",
        "_aspect_bases",
        "_columns",
        "_context_bases",
        "_lost",
        "_payloads",
        "_since_ns",
        "bytes",
        "count",
        "history",
        "large",
    )

    def __init__(
        self,
        recovered: Iterable[SlotRecord],
        *,
        policies: Mapping[str, Policy] | None = None,
        since_ns: int = 0,
        answer_bytes_max: int = ANSWER_BYTES_MAX,
        dropped: Iterable[WorldDropped] = (),
        forgotten: Collection[AspectForgotten] = (),
    ) -> None:
        self._context_bases = Bases(dropped)
        self._aspect_bases = AspectBases(forgotten)
        self._answer_bytes_max = answer_bytes_max
        self._since_ns = since_ns
        self._columns: dict[Column, dict[str, Content]] = {}
        self._lost: set[Slot] = set()
        self.count = 0
        self.bytes = 0
        self.large = LargeSlots()
        self._payloads = PayloadNames()
        self.history = History({} if policies is None else policies, self._payloads)
        for record in recovered:
            self.set(record.slot, content_of(record))
            if record.volatile:
                self._lost.add(record.slot)

    def recover_history(self, replaced: Iterable[SlotRecord], kept: Iterable[KeptRecord]) -> None:
        """Take over what the store has kept of replaced states, oldest first within each slot."""
        labels: dict[SlotVersion, list[str]] = {}
        for record in kept:
            for version in record.versions:
                labels.setdefault(version, []).append(record.label)
        states: dict[Slot, list[Content]] = {slot: [] for slot, _ in labels}
        for row in replaced:
            states.setdefault(row.slot, []).append(content_of(row))
        for slot, contents in states.items():
            self.history.recover(slot, self[slot], contents, labels)

    def __getitem__(self, slot: Slot) -> Content:
        context, entity, aspect = slot
        column = self._columns.get((context, aspect))  # type: ignore[call-overload]
        return NOTHING if column is None else column.get(entity, NOTHING)

    def exists(self, slot: Slot) -> bool:
        """Whether the slot was ever written or is known to have been."""
        context, entity, aspect = slot
        return entity in self._columns.get((context, aspect), ())  # type: ignore[call-overload]

    def exist(self, writes: Iterable[WriteItem]) -> bool:
        """Whether all slots that are to be written are there, or are known to have been."""
        columns = self._columns
        for (context, entity, aspect), _ in writes:
            if entity not in columns.get((context, aspect), ()):  # type: ignore[call-overload]
                return False
        return True

    def next_version(self, slot: Slot) -> int:
        """Return the version that the next write of a slot makes.

        In a context that was dropped before, or of an aspect that was forgotten, the first one lies
        above all that there was then.
        """
        context, entity, aspect = slot
        column = self._columns.get((context, aspect))  # type: ignore[call-overload]
        if column is not None and entity in column:
            version: int = column[entity].version
            if version:
                return version + 1
        return self._first_version(slot)

    def version_base(self, context: str) -> int:
        """Return the largest version of a context, the nulls of a drop counted as versions."""
        before = self._context_bases.of_name(context)
        return max([before, *(content.version + 1 for _, content in self.of_context(context))])

    def drop(self, context: str) -> list[tuple[Slot, Content]]:
        """Forget all slots of a context with their past, and return them."""
        gone = list(self.of_context(context))
        self._context_bases.set(context, self.version_base(context))
        self.history.drop(slot for slot, _ in gone)
        for slot, content in gone:
            self._lost.discard(slot)
            self._payloads.count(content.datum, stays=-1)
            size = content.datum.size if content.datum is not None else 0
            self.bytes -= size
            self.large.change(slot, before=size, after=0)
        for column in [column for column in self._columns if column.context == context]:
            del self._columns[column]
        self.count -= len(gone)
        return gone

    def replace(self, slot: Slot, content: Content) -> None:
        """Put a newly committed state in place of the old one, which becomes history."""
        old = self.set(slot, content)
        self.history.replaced(slot, old, until_ns=content.stamp_ns)

    # ---------------------------------------------------------------- the past

    def at(self, slot: Slot, newest: Content, at_ns: int) -> Content:
        """Return the state of a slot as of a stamp (0: now), or `newest` where that is gone."""
        if not at_ns or newest.stamp_ns <= at_ns:
            return newest
        found = self.history.of(slot)
        old = found.at(at_ns) if found is not None else None
        if old is not None:
            return old
        if self._oldest(slot, newest).version != self._first_version(slot):
            return newest
        return LOST if slot in self._lost else NOTHING

    def as_of(self, slot: Slot, at_ns: int) -> Content | int:
        """Return the state of a slot as of a stamp, or since when it is known if that is later."""
        newest = self[slot]
        since_ns = self.known_since_ns(slot, newest)
        if since_ns <= at_ns:
            return self.at(slot, newest, at_ns)
        found = self.history.of(slot)
        kept = found.kept_at(at_ns) if found is not None else None
        return kept if kept is not None else since_ns

    def known_since_ns(self, slot: Slot, newest: Content) -> int:
        """Return the stamp from which on all states of a slot are known, 0: from ever."""
        oldest = self._oldest(slot, newest)
        if oldest.version > self._first_version(slot):
            return oldest.stamp_ns
        forgotten_ns = self._aspect_bases.forgotten_ns(slot.aspect, slot.entity)
        return max(forgotten_ns, self._since_ns) if slot in self._lost else forgotten_ns

    def _oldest(self, slot: Slot, newest: Content) -> Content:
        """Return the oldest state of a slot from which on all are known."""
        found = self.history.of(slot)
        return found.states[0] if found is not None and found.states else newest

    def _first_version(self, slot: Slot) -> int:
        context, entity, aspect = slot
        return 1 + max(
            self._context_bases.of(context, entity), self._aspect_bases.of(aspect, entity)
        )

    def forgotten(self, items: Iterable[Item], at_ns: int) -> Forgotten | None:
        """Return the requested data no longer known as of a timestamp; None if all are known."""
        latest, unknown = Forgotten(Slot("", "", ""), 0), False
        for item in items:
            each = ACCESSES[item.access].each
            forgotten_ns = self._aspect_bases.forgotten_ns(item.aspect) if each else 0
            if forgotten_ns > at_ns:  # whatever the slots were that a pattern asks for
                slot = Slot(item.context, item.entity, item.aspect)
                latest = max(latest, Forgotten(slot, forgotten_ns), key=lambda one: one.oldest_ns)
                unknown = True
            for slot, newest in self._asked(item):
                since_ns = self.known_since_ns(slot, newest)
                if since_ns > latest.oldest_ns:
                    latest = Forgotten(slot, since_ns)
                unknown |= since_ns > at_ns and isinstance(self.as_of(slot, at_ns), int)
        return latest if unknown else None

    def forgotten_aspect(self, context: str) -> Forgotten:
        """Return the aspect that was forgotten last, and up to when its slots are not known."""
        at_ns, aspect = self._aspect_bases.last()
        return Forgotten(Slot(context, "**", aspect), at_ns)

    def captured(
        self, slot: Slot, newest: Content, captured_ns: int, *, nearest: bool = False
    ) -> Content:
        """Return the latest version up to `newest` with a capture stamp, null if none is left.

        With `nearest`, the one whose capture stamp lies nearest; of two as near, the later one.
        """
        datum, history = newest.datum, self.history.of(slot)
        if datum is not None and datum.stamp_ns == captured_ns:
            return newest
        found: list[Content] = []
        if nearest:
            found = [newest] if datum is not None and datum.stamp_ns else []
            if history is not None:
                found += history.nearest(captured_ns, version_max=newest.version)
        elif history is not None:
            exact = history.captured(captured_ns, version_max=newest.version)
            found = [exact] if exact is not None else []
        if found:
            return min(found, key=lambda one: _distance(one, captured_ns))
        return newest if datum is None else _OUTSIDE

    def versions(self, slot: Slot, *, version: int | None = None) -> Iterator[tuple[Content, int]]:
        """Yield all versions of a slot that are known, oldest first, and until when each was.

        The stamp is 0 for the newest one, and the version's own where no later one is known of.
        What a restart has lost shows as version 0.  Of one `version`, the others are not looked at.
        """
        found, newest = self.history.of(slot), self[slot]
        if found is not None:
            yield from found.known() if version is None else found.find_known(version)
        if newest is not NOTHING and version in (None, newest.version):
            yield newest, 0

    def is_stored(self, slot: Slot, version: int) -> bool:
        """Whether the store has a version of a slot: the newest one, or one of its history."""
        found = self.history.of(slot)
        here = self[slot].version == version or (
            found is not None and found.find(version) is not None
        )
        return here and self.history.is_stored(slot)

    def make_room(self, size: int) -> tuple[int, int]:
        """Remove the oldest replaced states until so many payload bytes are no longer named."""
        return self.history.make_room(size)

    # ---------------------------------------------------------------- the present

    def assert_invariants(self) -> None:
        """Assert the bookkeeping of histories and payloads.  For tests and simulation."""
        self.history.assert_invariants()
        for found in self.history:
            newest = self[found.slot]
            if found.states:
                assert found.states[-1].version + 1 == newest.version, found.slot
                assert found.until_ns == newest.stamp_ns, found.slot
        stay = [content.datum for column in self._columns.values() for content in column.values()]
        stay += [kept.content.datum for found in self.history for kept in found.kept.values()]
        may_go = [state.datum for found in self.history for state in found.states]
        self._payloads.assert_counts(stay, may_go)

    def set(self, slot: Slot, content: Content) -> Content:
        """Put a new committed state in place of the old one, which is returned."""
        context, entity, aspect = slot
        column = self._columns.get((context, aspect))  # type: ignore[call-overload]
        if column is None:
            column = self._columns[Column(context, aspect)] = {}
        old: Content = column.get(entity, NOTHING)
        before = old.datum.size if old.datum is not None else 0
        after = content.datum.size if content.datum is not None else 0
        if before >= LARGE_BYTES or after >= LARGE_BYTES:
            self.large.change(slot, before=before, after=after)
        if old is NOTHING:
            self.count += 1
        elif old.datum is not None:
            self.bytes -= old.datum.size
            if old.datum.file:
                self._payloads.count(old.datum, stays=-1)
        if content.datum is not None:
            self.bytes += content.datum.size
            if content.datum.file:
                self._payloads.count(content.datum, stays=1)
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

    def of_column(self, column: Column) -> Mapping[str, Content]:
        """Return the slots of a column by entity, as they came, null ones too."""
        return self._columns.get(column, {})

    def _asked(self, item: Item) -> list[tuple[Slot, Content]]:
        """Return the slots that an item names, or that match its pattern."""
        if ACCESSES[item.access].each:
            return list(self.matching(Column(item.context, item.aspect), item.entity))
        slot = Slot(item.context, item.entity, item.aspect)
        return [(slot, self[slot])]

    def shown(self, items: Iterable[Item], at_ns: int = 0, *, named: Sequence[Slot] = ()) -> Shown:
        """Return what a grant or view shows of `items` as of a stamp (0: now).

        Slots are in order, with patterns expanded to slots that are not null.

        Args:
            items: What is asked for.
            at_ns: As of when.
            named: The slots of `items`, where the caller knows that none of these is a pattern.
        """
        states: list[SlotState] = []
        pins: dict[tuple[Slot, int], Datum] = {}
        from_ns, left = 0, self._answer_bytes_max
        for index, item in enumerate(items):
            each = not named and ACCESSES[item.access].each
            slot = named[index] if named else Slot(item.context, item.entity, item.aspect)
            found = self._asked(item) if each else ((slot, self[slot]),)
            for slot, newest in found:
                content = self.at(slot, newest, at_ns) if at_ns else newest
                # Of the newest one as of then, too, where an older version is asked: what was
                # captured when is certain only from its commit on.
                if content.stamp_ns > from_ns:  # noqa: PLR1730 - as in `Stamps.next`
                    from_ns = content.stamp_ns
                if item.captured_ns:
                    content = self.captured(slot, content, item.captured_ns, nearest=item.nearest)
                if content.datum is None and each:
                    continue
                state = state_of(slot, content, known=item.known, inline_max=left)
                left -= state.size if state.datum is not None and not state.large else 0
                states += (state,)
                if content.datum is not None and (state.large or state.same):
                    pins[slot, state.version] = content.datum
        return Shown(states, pins, from_ns)


def _distance(content: Content, captured_ns: int) -> tuple[int, int, int]:
    """Return a key that puts what was captured next to a stamp first, the later of two."""
    stamp_ns = content.datum.stamp_ns if content.datum is not None else 0
    return abs(stamp_ns - captured_ns), -stamp_ns, -content.version


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
    large = datum.size > INLINE_BYTES_MAX or 0 < datum.size > inline_max
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
