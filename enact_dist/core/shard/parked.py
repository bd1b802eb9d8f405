"""Requests that wait at a shard for a decision, or for the end of their wait.

The cost of a message does not grow with the number of parked requests: the one that waits longest
is found at once, and so is the one with the smallest stamp.
"""

from __future__ import annotations

import heapq
from typing import TYPE_CHECKING, Final, Generic, NamedTuple, TypeVar

if TYPE_CHECKING:
    from collections.abc import Iterator

T = TypeVar("T")

OF_A_SESSION_MAX: Final = 64
"""Questions of one kind that a session may have parked; the oldest one is answered for the next."""
STALE_MAX: Final = 1024
"""Entries of questions that were answered early may stay in a heap up to as many as are parked
and these, then they are swept out."""


class Waiting(NamedTuple, Generic[T]):
    """One parked question: whose it is, and when its wait is over."""

    question: T
    session: str
    end_ns: int


class Order:
    """Parked questions by a number, the smallest first; those that are gone are passed over."""

    __slots__ = ("_heap", "_parked")

    def __init__(self, parked: dict[int, Waiting[T]]) -> None:
        self._parked = parked
        self._heap: list[tuple[int, int]] = []

    def add(self, number: int, reply_to: int) -> None:
        """Put a parked question in its place."""
        if len(self._heap) > 2 * len(self._parked) + STALE_MAX:
            self._heap = [entry for entry in self._heap if entry[1] in self._parked]
            heapq.heapify(self._heap)
        heapq.heappush(self._heap, (number, reply_to))

    def first(self) -> tuple[int, int] | None:
        """Return the smallest number, and the question that has it; None if nothing is parked."""
        heap = self._heap
        while heap and heap[0][1] not in self._parked:
            heapq.heappop(heap)
        return heap[0] if heap else None


class Parked(Generic[T]):
    """All parked questions of one kind, by where their answers go."""

    __slots__ = ("_by_end", "_of_session", "by_reply")

    def __init__(self) -> None:
        self.by_reply: dict[int, Waiting[T]] = {}
        self._by_end = Order(self.by_reply)
        self._of_session: dict[str, dict[int, None]] = {}

    def __bool__(self) -> bool:
        return bool(self.by_reply)

    def __len__(self) -> int:
        return len(self.by_reply)

    def add(self, reply_to: int, question: T, *, session: str, end_ns: int) -> int | None:
        """Park a request; return the oldest one of its session if that has too many."""
        self.by_reply[reply_to] = Waiting(question, session, end_ns)
        self._by_end.add(end_ns, reply_to)
        of_session = self._of_session.setdefault(session, {})
        of_session[reply_to] = None
        return next(iter(of_session)) if len(of_session) > OF_A_SESSION_MAX else None

    def take(self, reply_to: int) -> T:
        """Let a question go that is answered now."""
        question, session, _ = self.by_reply.pop(reply_to)
        of_session = self._of_session[session]
        del of_session[reply_to]
        if not of_session:
            del self._of_session[session]
        return question

    def ended(self, now_ns: int) -> Iterator[tuple[int, T]]:
        """Remove and yield the requests whose wait is over."""
        while (first := self._by_end.first()) is not None and first[0] <= now_ns:
            yield first[1], self.take(first[1])

    def all(self) -> Iterator[tuple[int, T]]:
        """Remove and yield all requests, in order."""
        for reply_to in list(self.by_reply):
            yield reply_to, self.take(reply_to)

    def next_end_ns(self) -> int | None:
        """Return when the next wait is over."""
        first = self._by_end.first()
        return None if first is None else first[0]
