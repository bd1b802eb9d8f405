"""How much stays of a slot's past, what is left of it, and what follows once it is forgotten.

The retention in the catalogue entry of an aspect: 0 means not stated.  If all three figures are 0,
the default holds; otherwise a figure of 0 means no limit.  Of several entries that state a
retention, the largest figure counts, and *no limit* is larger than any.

A context that was dropped and an aspect that was forgotten are gone with all their slots.  What is
made under the name again starts above all earlier versions; so does a slot of a context and an
aspect of which both were, above the higher one.  No version is ever used twice.

The replaced states of one slot, what was when, and what was captured when::

    kept   kept   | loose  loose | held  held  held | newest (in the slot itself)
                  └────────── states ───────────────┘
                    within 2 s     its retention

`states` has no holes, so any stamp from its first one on can be answered.  What is kept under a
label stays beyond that, alone: it was current at its own stamp, and longer where that is known.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right, insort
from collections import deque
from itertools import islice, pairwise
from operator import attrgetter
from typing import TYPE_CHECKING, Final, NamedTuple

from enact_dist.core.protocol.parts import NO_LIMIT, AspectEntry
from enact_dist.retention import DEFAULT_RETENTION, Retention

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Iterator

    from enact_dist.core.protocol.datum import Datum, Slot
    from enact_dist.core.protocol.records import AspectForgotten, Content, WorldDropped

_stamp_ns = attrgetter("stamp_ns")


class KeptVersion:
    """A version that labels keep; `until_ns` as in `VersionEntry`, 0 while it is in `states`."""

    __slots__ = ("content", "labels", "until_ns")

    def __init__(self, content: Content, until_ns: int = 0) -> None:
        self.content = content
        self.until_ns = until_ns
        self.labels: set[str] = set()


class SlotHistory:
    """What is known of the replaced states of one slot.  `History` changes it.

    Attributes:
        number: Unique number of the slot, for sorting.
        states: The replaced states up to the newest one, oldest first, without holes.
        held: How many of them, the latest, are within the slot's retention.
        size: Bytes of their data.
        young: How many states have been replaced so lately that cuts may ask for them.
        until_ns: The stamp of the newest state, which replaced the last of `states`.
        stored: Whether the versions are stored on the disk, too.
        queued: Whether the slot is in the queue of its aspect.
        kept: Versions that labels keep, by number; in `states` or not.
    """

    __slots__ = (
        "_captures",
        "held",
        "kept",
        "number",
        "queued",
        "size",
        "slot",
        "states",
        "stored",
        "until_ns",
        "young",
    )

    def __init__(self, slot: Slot, number: int, *, stored: bool) -> None:
        self.slot = slot
        self.number = number
        self.stored = stored
        self.states: deque[Content] = deque()
        self.kept: dict[int, KeptVersion] = {}
        self.held = self.size = self.young = self.until_ns = 0
        self.queued = False
        self._captures: list[tuple[int, int]] = []

    # ---------------------------------------------------------------- as of a stamp

    def at(self, at_ns: int) -> Content | None:
        """Return the replaced state that was current at a stamp before that of the newest one."""
        index = bisect_right(self.states, at_ns, key=_stamp_ns)
        return self.states[index - 1] if index else self.kept_at(at_ns)

    def kept_at(self, at_ns: int) -> Content | None:
        """Return a kept version that is known to have been current at a stamp."""
        for kept in self.kept.values():
            if kept.content.stamp_ns <= at_ns < max(kept.until_ns, kept.content.stamp_ns + 1):
                return kept.content
        return None

    # ---------------------------------------------------------------- versions

    def known(self) -> Iterator[tuple[Content, int]]:
        """Yield what is retained or kept, oldest first, with the stamp until which it was current.

        The stamp is the version's own one where no later one is known of.
        """
        first = self.states[-self.held].version if self.held else None
        for version in sorted(self.kept):
            until_ns = self.until_ns_of(version)
            if until_ns and (first is None or version < first):
                yield self.kept[version].content, until_ns
        held = self.retained()
        for content, after in pairwise(held):
            yield content, after.stamp_ns
        if held:
            yield held[-1], self.until_ns

    def retained(self) -> list[Content]:
        """Return the versions within the slot's retention, oldest first."""
        return list(islice(self.states, len(self.states) - self.held, None))

    def until_ns_of(self, version: int) -> int:
        """Return until when a kept version was current, 0 where it is the newest one."""
        if not self.states or version < self.states[0].version:
            return self.kept[version].until_ns
        index = version - self.states[0].version
        if index >= len(self.states):
            return 0
        return self.states[index + 1].stamp_ns if index + 1 < len(self.states) else self.until_ns

    def find(self, version: int) -> Content | None:
        """Return a replaced version that is retained or kept."""
        if self.is_held(version):
            return self.states[version - self.states[0].version]
        kept = self.kept.get(version)
        return kept.content if kept is not None else None

    def find_known(self, version: int) -> Iterator[tuple[Content, int]]:
        """Yield what `known` tells of one version, without a look at the others."""
        content = self.find(version)
        until_ns = self.until_ns_of(version) if content is not None else 0
        if content is not None and until_ns:
            yield content, until_ns

    def is_held(self, version: int) -> bool:
        """Whether a version is within the slot's retention."""
        return bool(self.held) and self.states[-self.held].version <= version <= (
            self.states[-1].version
        )

    def held_until_ns(self) -> int:
        """Return when the oldest version within retention was replaced."""
        return self.states[1 - self.held].stamp_ns if self.held > 1 else self.until_ns

    # ---------------------------------------------------------------- by capture stamp

    def index(self, content: Content) -> None:
        """Let a version within retention be found by its capture stamp, which it has."""
        assert content.datum is not None
        insort(self._captures, (content.datum.stamp_ns, content.version))

    def unindex(self, content: Content) -> None:
        """Let a version not be found by its capture stamp any more."""
        assert content.datum is not None
        del self._captures[bisect_left(self._captures, (content.datum.stamp_ns, content.version))]

    def captured(self, captured_ns: int, *, version_max: int) -> Content | None:
        """Return the latest version up to `version_max` that was captured then."""
        index = bisect_right(self._captures, (captured_ns, version_max)) - 1
        if index < 0 or self._captures[index][0] != captured_ns:
            return None
        return self.find(self._captures[index][1])

    def nearest(self, captured_ns: int, *, version_max: int) -> tuple[Content, ...]:
        """Return the versions up to `version_max` that were captured next to a stamp.

        At most one at or before it and one after it.
        """
        captures = self._captures
        middle = bisect_right(captures, (captured_ns, version_max))
        found = []
        for indices in (range(middle - 1, -1, -1), range(middle, len(captures))):
            near = next((i for i in indices if captures[i][1] <= version_max), None)
            if near is not None:
                stamp_ns = captures[near][0]
                found.append(self.captured(stamp_ns, version_max=version_max))
        return tuple([content for content in found if content is not None])

    def assert_invariants(self) -> None:
        """Assert the bookkeeping.  For tests and simulation."""
        versions = [state.version for state in self.states]
        first = versions[0] if versions else 0
        assert versions == list(range(first, first + len(versions))), versions
        stamps = [state.stamp_ns for state in self.states]
        assert stamps == sorted(set(stamps)), stamps
        held = [state for state in self.states if self.is_held(state.version)]
        assert len(held) == self.held, (len(held), self.held)
        assert self.size == sum(state.datum.size for state in held if state.datum is not None)
        right = [
            (state.datum.stamp_ns, state.version)
            for state in held
            if state.datum is not None and state.datum.stamp_ns
        ]
        assert self._captures == sorted(right), (self._captures, right)


class PayloadNames:
    """How often each payload is named, by what stays and by what may go.

    Several states may name one payload: a fork shares the data of its source.

    Attributes:
        spare: Bytes of the payloads that only history names.
    """

    __slots__ = ("_named", "spare")

    def __init__(self) -> None:
        self._named: dict[str, tuple[int, int]] = {}
        self.spare = 0

    def count(self, datum: Datum | None, *, stays: int = 0, may_go: int = 0) -> None:
        """Count that more (or fewer) states, kept ones and replaced ones, name a payload."""
        if datum is None or not datum.file:
            return
        before, going = self._named.get(datum.file, (0, 0))
        if going and not before:
            self.spare -= datum.size
        before, going = before + stays, going + may_go
        if going and not before:
            self.spare += datum.size
        if before or going:
            self._named[datum.file] = before, going
        else:
            del self._named[datum.file]

    def assert_counts(self, stay: Iterable[Datum | None], may_go: Iterable[Datum | None]) -> None:
        """Assert that exactly the data of these states are counted.  For tests and simulation."""
        right = PayloadNames()
        for datum in stay:
            right.count(datum, stays=1)
        for datum in may_go:
            right.count(datum, may_go=1)
        assert (right._named, right.spare) == (self._named, self.spare)


class Bases:
    """The versions above which the slots of contexts, or of aspects, start by their names."""

    __slots__ = ("_by_entity", "_by_name")

    def __init__(self, records: Iterable[WorldDropped] | Iterable[AspectForgotten]) -> None:
        self._by_name: dict[str, int] = {}
        self._by_entity: dict[str, dict[str, int]] = {}
        for record in records:
            by_entity = {entity: base for entity, base, *_ in record.entity_bases}
            self.set(record.name, record.version_base, by_entity)

    def set(self, name: str, base: int, by_entity: dict[str, int] | None = None) -> None:
        """Let slots of a name start above `base`, those of entities from elsewhere by theirs."""
        self._by_name[name] = base
        self._by_entity[name] = by_entity or {}

    def of_name(self, name: str) -> int:
        """Return the base of a name."""
        return self._by_name.get(name, 0)

    def of(self, name: str, entity: str) -> int:
        """Return the base of the slots that an entity has under a name."""
        base = self._by_name.get(name, 0)
        return self._by_entity[name].get(entity, base) if base else 0


class AspectBases(Bases):
    """The same of aspects, and up to which stamps the contents of their slots are unknown."""

    __slots__ = ("_at_ns", "_at_ns_by_entity")

    def __init__(self, records: Collection[AspectForgotten]) -> None:
        super().__init__(records)
        self._at_ns = {record.name: record.at_ns for record in records}
        self._at_ns_by_entity = {
            record.name: {entity: at_ns for entity, _, at_ns in record.entity_bases}
            for record in records
        }

    def forgotten_ns(self, aspect: str, entity: str = "") -> int:
        """Return up to which stamp nothing is known of an aspect, or of an entity's (0: all is).

        Without an entity, of all that there may have been: any other one knows as much or more.
        """
        at_ns = self._at_ns.get(aspect, 0)
        return self._at_ns_by_entity[aspect].get(entity, at_ns) if at_ns else 0

    def last(self) -> tuple[int, str]:
        """Return the latest stamp up to which nothing is known of an aspect (0: all is), and it."""
        return max(((at_ns, name) for name, at_ns in self._at_ns.items()), default=(0, ""))


class Limits(NamedTuple):
    """Up to where a slot's history goes: versions (the newest included), age, replaced bytes."""

    versions: int
    age_ns: int
    size: int


def stated_limits(retention: Retention | None) -> Limits:
    """Return a retention as an entry bears it: 0 for what is unsaid."""
    if retention is None:
        return UNSAID
    age_ns = 0 if retention.age_s is None else max(1, round(retention.age_s * 1e9))
    return Limits(retention.versions or 0, age_ns, retention.size_bytes or 0)


UNSAID: Final = Limits(0, 0, 0)
DEFAULT: Final = stated_limits(DEFAULT_RETENTION)


def limits_of(entry: AspectEntry) -> Limits:
    """Return what holds for an aspect with this entry."""
    found = Limits(entry.retention, entry.age_ns, entry.size)
    return DEFAULT if found == UNSAID else Limits(*(figure or NO_LIMIT for figure in found))


def with_larger(entry: AspectEntry, other: AspectEntry) -> AspectEntry:
    """Return `entry` with the larger retention of both."""
    if not says_something(other):
        return entry
    largest = limits_of(other)
    if says_something(entry):
        largest = Limits(*map(max, limits_of(entry), largest))
    versions, age_ns, size = (0 if figure == NO_LIMIT else figure for figure in largest)
    if not (versions or age_ns or size):
        versions = NO_LIMIT  # means that there is no limit
    return entry._replace(retention=versions, age_ns=age_ns, size=size)


def says_something(entry: AspectEntry) -> bool:
    """Whether the entry says anything about retention."""
    return bool(entry.retention or entry.age_ns or entry.size)


def covers(known: AspectEntry, wanted: AspectEntry) -> bool:
    """Whether the retention that is known leaves nothing of a wanted one to be asked for."""
    if not says_something(wanted):
        return True
    pairs = zip(limits_of(known), limits_of(wanted), strict=True)
    return says_something(known) and all(here >= asked for here, asked in pairs)
