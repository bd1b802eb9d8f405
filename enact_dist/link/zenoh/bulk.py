"""A second connection to the same shards, for data sent in slices.

Zenoh sends urgent messages first, but cannot take back data that it has passed to the kernel: on a
slow network a keep-alive would wait behind everything in the socket.  With a separate connection
for slices it waits for nothing.  The slice connection may block, which slows the sender to the
speed of the network and loses no slice; it may even be closed when its reader stalls, since the
client's token and calls use the other one.

It opens with the first transfer, takes 3 ms, and reconnects by itself.
"""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING

from enact_dist.link.memory.maps import recycle_blocks
from enact_dist.link.zenoh.config import close_session, keep_after_fork, open_session

if TYPE_CHECKING:
    from collections.abc import Sequence

    import zenoh


class BulkWay:
    """The connection for large data beside one Zenoh session.  Thread-safe.

    Args:
        endpoints: Endpoints of that session.
        lease_s: Link lease of that session.
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
        """Return the session; None while it is not connected."""
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
        """Close the session and end all calls on it; idempotent."""
        with self._mutex:
            self._closed = True
        if self._session is not None:
            close_session(self._session)
