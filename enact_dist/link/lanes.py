"""Lanes: small numbers for the threads of a session that hold or await a lock at the same time.

A shard keeps a few facts per lane (the exactly-once table), so their number is bounded.  Any thread
may reuse a lane after its lock has ended.
"""

from __future__ import annotations

import threading
from collections import deque
from typing import Final

from enact_dist.core.sessions import LANES_MAX
from enact_dist.errors import MisuseError

KEPT_MAX: Final = 64
"""Lanes kept unused after an unanswered commit, since a new lock would erase its outcome."""


class Lanes:
    """The lanes of one session.  Thread-safe."""

    def __init__(self) -> None:
        self._mutex = threading.Lock()
        self._free: list[int] = []
        self._kept: deque[int] = deque()
        self._made = 0

    def take(self) -> int:
        """Return a lane that no live lock uses.

        Raises:
            MisuseError: The session already holds or awaits its maximum of locks.
        """
        try:
            return self._free.pop()
        except IndexError:
            return self._make()

    def _make(self) -> int:
        with self._mutex:
            if self._made >= LANES_MAX:
                raise MisuseError(
                    f"{LANES_MAX} threads of this process hold or await a lock or view of this"
                    " cell, the most that one session may; use fewer threads, or several processes"
                )
            self._made += 1
            return self._made - 1

    def give_back(self, lane: int) -> None:
        """Free the lane; call once per `take`, or two locks would share it."""
        self._free.append(lane)

    def keep(self, lane: int) -> None:
        """Keep the outcome of a lane for a while; frees the oldest such lane."""
        with self._mutex:
            self._kept.append(lane)
            if len(self._kept) > KEPT_MAX:
                self._free.append(self._kept.popleft())
