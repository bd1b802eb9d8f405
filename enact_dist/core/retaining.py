"""The retention in the catalogue entry of an aspect, and how several entries combine.

In an entry 0 means not stated.  If all three figures are 0, the default holds; otherwise a figure
of 0 means no limit.  Of several entries that state a retention, the largest figure counts, and *no
limit* is larger than any.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

from enact_dist.retention import DEFAULT_RETENTION

if TYPE_CHECKING:
    from enact_dist.core.message_parts import AspectEntry
    from enact_dist.retention import Retention

NO_LIMIT: Final = 1 << 62
"""Represents "no limit"; below the wire's largest integer, since messages may carry it."""


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
