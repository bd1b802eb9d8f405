"""Tells who calls a shard when it comes (back) into reach: nobody has to ask again and again.

Zenoh notes on its own when a queryable for a key appears: 7 to 12 ms after the daemon's `ready`,
measured on a loopback, against up to a quarter of a TTL until the next keep-alive.
"""

from __future__ import annotations

import contextlib
import threading
from typing import TYPE_CHECKING, cast

import zenoh

from enact_dist.link.zenoh_config import keep_after_fork
from enact_dist.link.zenoh_events import Events

if TYPE_CHECKING:
    from collections.abc import Callable


class ShardPresence:
    """Watches one shard on one session, until it or the session is closed.

    One that is not closed before its session leaves 15 kB behind (Zenoh 1.10).

    Args:
        session: Not closed with this.
        key: A key on which the shard takes requests.
        returned: Called from another thread each time the shard has come into reach.
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
        """Whether the shard is in reach, as far as Zenoh has noted."""
        with self._mutex:  # Zenoh's binding raises where one thread asks and another ends it
            if self._closed:
                return False
            try:
                # As it is; Zenoh's stub says otherwise.
                return cast("zenoh.MatchingStatus", self._querier.matching_status).matching
            except zenoh.ZError:  # the session is closed
                return False

    def _heard(self, _: zenoh.MatchingStatus) -> None:
        # Of a shard that goes and comes at once the later event may be the one of its going.
        if self.here:
            self._returned()

    def close(self, wait_s: float = 0.0) -> None:
        """End it; wait so long for the end of what calls `returned`.  Twice is harmless."""
        with self._mutex:  # nor may two threads end it at once
            if not self._closed:
                self._closed = True
                with contextlib.suppress(zenoh.ZError):  # the session is closed
                    self._querier.undeclare()  # type: ignore[no-untyped-call]  # as in its stub
        self._events.join(wait_s)
