"""A second connection to the same shards, for data that travel in slices.

Zenoh sends urgent messages before others, but what it has handed to the kernel it cannot take
back: on a slow network a keep-alive would wait behind all that the socket holds.  Beside a
connection of its own it waits for nothing, and this one may block (no slice is lost, the sender is
slowed to the speed of the network) or even be given up when its reader stands still: the client's
token and its calls live on the other one.

It is opened with the first transfer, takes 3 ms, and connects again by itself.
"""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING

from enact_dist.link.recycling import recycle_blocks
from enact_dist.link.zenoh_config import close_session, keep_after_fork, open_session

if TYPE_CHECKING:
    from collections.abc import Sequence

    import zenoh


class BulkWay:
    """The way of large data beside one Zenoh session.  Thread-safe.

    Args:
        endpoints: Where that session connects to.
        lease_s: Its link lease.
        open_s: How long a shard has to answer a connection.
    """

    def __init__(self, endpoints: Sequence[str], lease_s: float, open_s: float) -> None:
        self._endpoints = endpoints
        self._lease_s, self._open_s = lease_s, open_s
        self._mutex = threading.Lock()
        self._closed = False
        self._session: zenoh.Session | None = None
        keep_after_fork(self)

    def session(self) -> zenoh.Session | None:
        """Return the session; None while it has no connection."""
        session = self._session
        if session is None:
            with self._mutex:
                if self._session is None and not self._closed:
                    recycle_blocks()
                    self._session = open_session(
                        connect=self._endpoints, lease_s=self._lease_s, open_s=self._open_s
                    )
                session = self._session
        return session if session is not None and session.info.peers_zid() else None

    def close(self) -> None:
        """End it and all calls on it; twice is harmless."""
        with self._mutex:
            self._closed = True
        if self._session is not None:
            close_session(self._session)
