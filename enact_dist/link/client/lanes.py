"""Lanes: small numbers for the threads of a session that hold or await a lock at the same time.

A shard keeps a few facts per lane (the exactly-once table), so their number is bounded.  Any thread
may reuse a lane after its lock has ended.
"""

from __future__ import annotations

import re
import threading
from collections import deque
from typing import TYPE_CHECKING, Final

from enact_dist.core.protocol.datum import LockId
from enact_dist.core.state.sessions import LANES_MAX
from enact_dist.errors import MisuseError

if TYPE_CHECKING:
    from enact_dist.core.client.lock import MultiLock

_NAME: Final = re.compile(
    r"(?P<session>[^.@]+)\.(?P<lane>\d+)\.(?P<seq>\d+)@(?P<shard>[^~]+)(~(?P<epoch>\d{1,19}))?\Z"
)


def name_of(multilock: MultiLock) -> str:
    """Return the name of a lock and of the shard that decides whether it commits.

    An epoch stands behind them if a restart takes the shard's record of the commit.
    """
    lock, finishing = multilock.lock, multilock.finishing
    if finishing is None or not finishing.primary:
        return str(lock)
    name = f"{lock.session}.{lock.lane}.{lock.seq}@{finishing.primary}"
    return f"{name}~{finishing.known_in}" if finishing.known_in else name


def read_name(name: str) -> tuple[LockId, str, int]:
    """Return the lock of a name, its deciding shard, and the epoch that alone knows (0: any).

    Raises:
        MisuseError: The name is invalid.
    """
    found = _NAME.match(name)
    if found is None:
        raise MisuseError(f"{name!r} names no lock; use the lock_id of a CommitUnknownError")
    lock = LockId(found["session"], int(found["lane"]), int(found["seq"]))
    return lock, found["shard"], int(found["epoch"] or 0)


KEPT_MAX: Final = 64
"""Lanes kept unused after an unanswered commit, since a new lock would erase its outcome."""


class Lanes:
    """The lanes of one session.  Thread-safe.

    Attributes:
        free: The lanes that no live lock uses; any thread may pop one, or append its own.
    """

    def __init__(self) -> None:
        self._mutex = threading.Lock()
        self.free: list[int] = []
        self._kept: deque[int] = deque()
        self._made = 0

    def take(self) -> int:
        """Return a lane that no live lock uses; append it to `free` once, when its lock is over.

        Raises:
            MisuseError: The session already holds or awaits its maximum of locks.
        """
        try:
            return self.free.pop()
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

    def keep(self, lane: int) -> None:
        """Keep the outcome of a lane for a while; frees the oldest such lane."""
        with self._mutex:
            self._kept.append(lane)
            if len(self._kept) > KEPT_MAX:
                self.free.append(self._kept.popleft())
