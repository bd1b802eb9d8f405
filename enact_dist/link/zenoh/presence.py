"""Reports when a shard comes (back) within reach, so that callers need not poll.

Zenoh reports when a queryable for a key appears: 7 to 12 ms after the daemon's `ready`,
measured on a loopback, against up to a quarter of a TTL until the next keep-alive.
"""

from __future__ import annotations

import contextlib
import threading
from typing import TYPE_CHECKING, cast

import zenoh

from enact_dist.link.zenoh.config import keep_after_fork
from enact_dist.link.zenoh.events import Events

if TYPE_CHECKING:
    from collections.abc import Callable


class Inside:
    """Counts the threads inside Zenoh, so that shutdown can wait for them."""

    __slots__ = ("_changed", "_count")

    def __init__(self) -> None:
        self._changed = threading.Condition(threading.Lock())
        self._count = 0

    def __enter__(self) -> None:
        with self._changed:
            self._count += 1

    def __exit__(self, *_: object) -> None:
        with self._changed:
            self._count -= 1
            if not self._count:
                self._changed.notify_all()

    def wait_empty(self, timeout_s: float) -> bool:
        """Wait until no thread is inside; return whether that happened in time."""
        with self._changed:
            return self._changed.wait_for(lambda: not self._count, timeout_s)


class ShardPresence:
    """Watches one shard on one session, until it or the session is closed.

    If it is not closed before its session, it leaks 15 kB (Zenoh 1.10).

    Args:
        session: Stays open when this ends.
        key: A key on which the shard takes requests.
        returned: Called from another thread each time the shard comes within reach.
    """

    def __init__(self, session: zenoh.Session, key: str, returned: Callable[[], None]) -> None:
        self._returned = returned
        self._mutex = threading.Lock()
        self._closed = False
        self._querier = session.declare_querier(key)
        self._events: Events[zenoh.MatchingStatus] = Events(
            "enact-presence", self._querier.declare_matching_listener, self._heard
        )
        keep_after_fork(self)

    @property
    def here(self) -> bool:
        """Whether the shard is within reach, as far as Zenoh knows."""
        with self._mutex:  # Zenoh's binding raises if one thread asks while another closes it
            if self._closed:
                return False
            try:
                # The actual type; Zenoh's stub differs.
                return cast("zenoh.MatchingStatus", self._querier.matching_status).matching
            except zenoh.ZError:  # the session is closed
                return False

    def _heard(self, _: zenoh.MatchingStatus) -> None:
        # If a shard leaves and returns at once, the event of its leaving may come last.
        if self.here:
            self._returned()

    def close(self, wait_s: float = 0.0) -> None:
        """Stop watching; wait up to `wait_s` for the thread that calls `returned`.  Idempotent."""
        with self._mutex:  # nor may two threads close it at once
            if not self._closed:
                self._closed = True
                with contextlib.suppress(zenoh.ZError):  # the session is closed
                    self._querier.undeclare()  # type: ignore[no-untyped-call]  # as in its stub
        self._events.join(wait_s)
