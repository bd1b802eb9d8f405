"""A bounded queue of notices between whoever receives them and whoever watches.

The newest notices win: when nobody takes them, the oldest are dropped and counted.  A watcher
sees the gap in their numbers and asks for the present state, so nothing is missed unknowingly.
"""

from __future__ import annotations

import threading
from collections import deque
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Callable

    from enact_dist.core.messages import Notice

NOTICES_MAX: Final = 65_536
"""Notices kept for a watcher that does not take them: 11 minutes at 100 per second."""


class NoticeQueue:
    """A feed filled from another thread.  `put` never blocks, `get` wakes at once.

    Attributes:
        on_close: Called once by the first `close`; ends what fills the feed.
    """

    def __init__(self, *, notices_max: int = NOTICES_MAX) -> None:
        self._notices: deque[Notice] = deque()
        self._notices_max = notices_max
        self.on_close: Callable[[], None] | None = None
        self._newest: dict[str, tuple[int, int]] = {}
        self._changed = threading.Condition(threading.Lock())
        self._closed = False
        self._dropped = 0

    @property
    def dropped(self) -> int:
        """How many notices were thrown away because nobody took them in time."""
        return self._dropped

    def put(self, notice: Notice) -> None:
        """Add a notice; one that came already (over a second connection) is ignored."""
        with self._changed:
            number = (notice.epoch, notice.number)
            if self._closed or number <= self._newest.get(notice.shard, (0, 0)):
                return
            self._newest[notice.shard] = number
            if len(self._notices) >= self._notices_max:
                self._notices.popleft()
                self._dropped += 1
            self._notices.append(notice)
            self._changed.notify()

    def get(self, timeout_s: float | None) -> Notice | None:
        """Return the next notice; None after `timeout_s` without one, or once closed."""
        with self._changed:
            self._changed.wait_for(lambda: self._notices or self._closed, timeout_s)
            return self._notices.popleft() if self._notices and not self._closed else None

    def close(self) -> None:
        """End the feed and wake whoever waits in `get`; twice is harmless."""
        with self._changed:
            if self._closed:
                return
            self._closed = True
            self._changed.notify_all()
        if self.on_close is not None:
            self.on_close()
