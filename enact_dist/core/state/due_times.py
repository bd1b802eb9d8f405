"""What is to be looked at, by the time before which nothing can have become of it.

A lease that is renewed moves its end with each message, so the ends are corrected lazily: each
name is kept under a time that its real one is never before, looked at then, and put back where it
has moved on.  A look therefore costs what is due, however many names there are.
"""

from __future__ import annotations

import heapq
from typing import Final

STALE_MAX: Final = 1024
"""Entries of dropped names that the heap may hold, beside as many as names, before it is swept."""


class DueTimes:
    """Names, each under the earliest time at which it may be due."""

    __slots__ = ("_heap", "due")

    def __init__(self) -> None:
        self.due: dict[str, int] = {}
        self._heap: list[tuple[int, str]] = []

    def __len__(self) -> int:
        return len(self.due)

    def __contains__(self, name: str) -> bool:
        return name in self.due

    def put(self, name: str, due_ns: int) -> None:
        """Keep a name, under another time than before if it is here."""
        self.due[name] = due_ns
        heapq.heappush(self._heap, (due_ns, name))
        if len(self._heap) > 2 * len(self.due) + STALE_MAX:
            self._heap = [(due_ns, name) for name, due_ns in self.due.items()]
            heapq.heapify(self._heap)

    def drop(self, name: str) -> None:
        """Forget a name, if it is here."""
        self.due.pop(name, None)

    def take(self, until_ns: int) -> list[str]:
        """Take out the names that may be due by `until_ns`, the earliest first."""
        taken = []
        while self._heap and self._heap[0][0] <= until_ns:
            due_ns, name = heapq.heappop(self._heap)
            if self.due.get(name) == due_ns:
                del self.due[name]
                taken.append(name)
        return taken

    def next_ns(self) -> int | None:
        """Return the earliest time at which a name may be due; None without names."""
        while self._heap and self.due.get(self._heap[0][1]) != self._heap[0][0]:
            heapq.heappop(self._heap)
        return self._heap[0][0] if self._heap else None
