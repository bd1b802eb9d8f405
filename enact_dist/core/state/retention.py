"""The retention in the catalogue entry of an aspect, and how several entries combine.

In an entry 0 means not stated.  If all three figures are 0, the default holds; otherwise a figure
of 0 means no limit.  Of several entries that state a retention, the largest figure counts, and *no
limit* is larger than any.

Above which versions slots start, and since when they are known, after something was forgotten.

A context that was dropped and an aspect that was forgotten are gone with all their slots.  What is
made under the name again starts above all earlier versions; so does a slot of a context and an
aspect
of which both were, above the higher one.  No version is ever used twice.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

from enact_dist.core.protocol.parts import NO_LIMIT
from enact_dist.retention import DEFAULT_RETENTION

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable

    from enact_dist.core.protocol.datum import Datum
    from enact_dist.core.protocol.parts import AspectEntry
    from enact_dist.core.protocol.records import AspectForgotten, WorldDropped
    from enact_dist.retention import Retention


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
        """Count that more (or fewer) states name a datum's payload.

        Args:
            datum: The datum; nothing to be done where it is no payload.
            stays: So many more are newest states or kept ones.
            may_go: So many more are replaced states.
        """
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


def said(retention: Retention | None) -> Limits:
    """Return a retention as an entry bears it: 0 for what is unsaid."""
    if retention is None:
        return UNSAID
    age_ns = 0 if retention.age_s is None else max(1, round(retention.age_s * 1e9))
    return Limits(retention.versions or 0, age_ns, retention.size_bytes or 0)


UNSAID: Final = Limits(0, 0, 0)
DEFAULT: Final = said(DEFAULT_RETENTION)


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
