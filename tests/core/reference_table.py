"""Who may hold what, from the definition alone: sets of holders and one queue, scanned in full.

A request is a set of lines.  Two lines conflict when they are about one aspect of one context, at
least one writes, and they name one entity or either names a pattern (a pattern stands for every
entity, those yet to come included).  A request is granted when it conflicts with no holder and
with no earlier request that waits still.  Nothing here is taken from `enact_dist.core.state.lock_table`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from enact_dist.patterns import pattern_matches
from enact_dist.terms import Access

if TYPE_CHECKING:
    from collections.abc import Iterable

    from enact_dist.core.protocol.datum import LockId, Slot
    from enact_dist.core.protocol.messages import Item


class Line(NamedTuple):
    """One line of a request that locks something."""

    context: str
    aspect: str
    entity: str
    each: bool
    writes: bool

    def conflicts(self, other: Line) -> bool:
        """Say whether the two lines exclude each other."""
        return (
            self.aspect == other.aspect
            and self.context == other.context
            and (self.writes or other.writes)
            and (self.each or other.each or self.entity == other.entity)
        )

    def allows(self, slot: Slot) -> bool:
        """Say whether a slot may be written under this line."""
        if not self.writes or (slot.context, slot.aspect) != (self.context, self.aspect):
            return False
        return (
            pattern_matches(self.entity, slot.entity) if self.each else slot.entity == self.entity
        )

    def guards(self, slot: Slot) -> bool:
        """Say whether this line keeps everybody else from a slot."""
        if not self.writes or (slot.context, slot.aspect) != (self.context, self.aspect):
            return False
        return self.each or slot.entity == self.entity


Lines = frozenset[Line]


def lines_of(items: Iterable[Item]) -> Lines:
    """Return what a lock of these items keeps others from."""
    writing = (Access.WRITE, Access.WRITE_EACH)
    each = (Access.READ_EACH, Access.WRITE_EACH)
    return frozenset(
        Line(item.context, item.aspect, item.entity, item.access in each, item.access in writing)
        for item in items
        if item.access not in (Access.VIEW, Access.VIEW_EACH)
    )


def conflict(some: Lines, others: Lines) -> bool:
    """Say whether two requests exclude each other."""
    return any(one.conflicts(other) for one in some for other in others)


class ReferenceTable:
    """Holders as sets of lines, waiters as one list in order of arrival."""

    def __init__(self) -> None:
        self.held: dict[LockId, Lines] = {}
        self.queue: list[tuple[LockId, Lines]] = []

    def enqueue(self, lock: LockId, lines: Lines) -> None:
        """Put a request at the end of the queue."""
        self.queue.append((lock, lines))

    def remove(self, lock: LockId) -> None:
        """Forget a request, granted or not."""
        self.held.pop(lock, None)
        self.queue = [waiting for waiting in self.queue if waiting[0] != lock]

    def may_go_on(self) -> list[LockId]:
        """Return the waiting requests that may be granted, in order of arrival."""
        return [lock for lock, _ in self.queue if not any(self.in_the_way(lock))]

    def grant(self) -> list[LockId]:
        """Grant whatever may be granted and return it in order of arrival."""
        granted = self.may_go_on()
        for lock, lines in self.queue:
            if lock in granted:
                self.held[lock] = lines
        self.queue = [waiting for waiting in self.queue if waiting[0] not in granted]
        return granted

    def in_the_way(self, lock: LockId) -> tuple[list[LockId], list[LockId]]:
        """Return whom a waiting request waits for: holders, and earlier requests."""
        lines = dict(self.queue)[lock]
        holders = [other for other, held in self.held.items() if conflict(lines, held)]
        earlier = []
        for other, wanted in self.queue:
            if other == lock:
                break
            if conflict(lines, wanted):
                earlier.append(other)
        return holders, earlier

    def guards_of(self, slot: Slot) -> set[LockId]:
        """Return the holders that keep everybody else from a slot."""
        return {
            lock for lock, lines in self.held.items() if any(line.guards(slot) for line in lines)
        }

    def conflicting_holders(self) -> list[tuple[LockId, LockId]]:
        """Return every pair of holders that exclude each other: none, by definition."""
        held = list(self.held.items())
        return [
            (one, other)
            for index, (one, lines) in enumerate(held)
            for other, others in held[:index]
            if conflict(lines, others)
        ]
