"""Tells who calls a shard when it comes (back) into reach: nobody has to ask again and again.

Zenoh notes on its own when a queryable for a key appears: 7 to 12 ms after the daemon's `ready`,
measured on a loopback, against up to a quarter of a TTL until the next keep-alive.
"""

from __future__ import annotations

import logging
import threading
from typing import TYPE_CHECKING, Final

import zenoh

from enact_dist.link.zenoh_config import keep_after_fork

if TYPE_CHECKING:
    from collections.abc import Callable

EVENTS_MAX: Final = 64
"""Comings and goings of one shard that wait to be looked at."""

_log = logging.getLogger("enact.link")


class ShardPresence:
    """Watches one shard on one session, from a thread of its own, until the session is closed.

    Args:
        session: Not closed with this.
        key: A key on which the shard takes requests.
        returned: Called from the thread each time the shard has come into reach.
    """

    def __init__(self, session: zenoh.Session, key: str, returned: Callable[[], None]) -> None:
        self._returned = returned
        self._querier = session.declare_querier(key)
        self._listener = self._querier.declare_matching_listener(
            zenoh.handlers.FifoChannel(EVENTS_MAX)
        )
        keep_after_fork(self)
        self._thread = threading.Thread(
            target=self._run, args=(self._listener.handler,), name="enact-presence", daemon=True
        )
        self._thread.start()

    def _run(self, events: zenoh.Handler[zenoh.MatchingStatus]) -> None:
        while True:
            try:
                event = events.recv()
            except zenoh.ZError:  # the session is closed
                return
            if event.matching:
                try:
                    self._returned()
                except Exception as error:  # noqa: BLE001 - the next return is told all the same
                    _log.error("a shard came into reach, which could not be told: %s", error)

    def join(self, wait_s: float) -> None:
        """Wait for the end of the thread, which follows that of the session."""
        if threading.current_thread() is not self._thread:
            self._thread.join(wait_s)
