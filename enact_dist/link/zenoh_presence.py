"""Tells who calls a shard when it comes (back) into reach: nobody has to ask again and again.

Zenoh notes on its own when a queryable for a key appears: 7 to 12 ms after the daemon's `ready`,
measured on a loopback, against up to a quarter of a TTL until the next keep-alive.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, cast

from enact_dist.link.zenoh_config import keep_after_fork
from enact_dist.link.zenoh_events import Events

if TYPE_CHECKING:
    from collections.abc import Callable

    import zenoh


class ShardPresence:
    """Watches one shard on one session until the session is closed.

    Attributes:
        here: Whether the shard is in reach, as far as Zenoh has noted.

    Args:
        session: Not closed with this.
        key: A key on which the shard takes requests.
        returned: Called from another thread each time the shard has come into reach.
    """

    def __init__(self, session: zenoh.Session, key: str, returned: Callable[[], None]) -> None:
        self._returned = returned
        self._querier = session.declare_querier(key)
        # As it is; Zenoh's stub says otherwise.
        self.here = cast("zenoh.MatchingStatus", self._querier.matching_status).matching
        self._events: Events[zenoh.MatchingStatus] = Events(
            "enact-presence", self._querier.declare_matching_listener, self._heard
        )
        keep_after_fork(self)

    def _heard(self, event: zenoh.MatchingStatus) -> None:
        self.here = event.matching
        if event.matching:
            self._returned()

    def join(self, wait_s: float) -> None:
        """Wait for the end of what calls `returned`, which follows that of the session."""
        self._events.join(wait_s)
