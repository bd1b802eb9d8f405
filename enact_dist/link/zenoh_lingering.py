"""Closing a lost connection must not wait: Zenoh's TCP sockets are made to close at once.

Zenoh 1.10 gives each of its TCP sockets a linger time of 10 s (zenoh issue 2350).  The kernel then
holds the thread that closes a socket until the other side has acknowledged everything, and these
are the few threads that receive for all connections.  So when one host was cut off, its links were
given up after their lease, and the shard heard nobody for another 10 s: 12 s from a cut to the
next grant with a TTL of 2 s, against 2.0 s now.  Without a linger time the kernel goes on sending
what is left, behind the process's back.

No setting of Zenoh turns it off, so each new connection of a session is looked up among the open
descriptors of this process.  Only sockets with exactly Zenoh's linger time are touched.
"""

from __future__ import annotations

import contextlib
import logging
import os
import socket
import stat
import struct
import threading
from pathlib import Path
from typing import TYPE_CHECKING, Final

import zenoh

if TYPE_CHECKING:
    from collections.abc import Iterator

EVENTS_MAX: Final = 65_536
"""Comings and goings of connections that wait to be looked at."""
JOIN_S: Final = 1.0
_DESCRIPTORS: Final = Path("/proc/self/fd")
_LINGER: Final = struct.Struct("ii")
_ZENOHS: Final = _LINGER.pack(1, 10)
_NONE: Final = _LINGER.pack(0, 0)

_log = logging.getLogger("enact.link")


class LingerWatch:
    """Takes the linger time off the connections of a session, until that is closed.

    Args:
        session: Not closed with this.
    """

    def __init__(self, session: zenoh.Session) -> None:
        self._listener = session.info.declare_link_events_listener(
            zenoh.handlers.FifoChannel(EVENTS_MAX), history=True
        )
        self._thread = threading.Thread(
            target=self._run, args=(self._listener.handler,), name="enact-links", daemon=True
        )
        self._thread.start()

    def _run(self, events: zenoh.Handler[zenoh.LinkEvent]) -> None:
        while True:
            try:
                event = events.recv()
                while (more := events.try_recv()) is not None:
                    event = more if more.kind == zenoh.SampleKind.PUT else event
            except zenoh.ZError:  # the session is closed
                return
            if event.kind == zenoh.SampleKind.PUT:
                end_lingering()

    def join(self) -> None:
        """Wait for the end of the thread, which follows that of the session."""
        self._thread.join(JOIN_S)


def end_lingering() -> int:
    """Take Zenoh's linger time off every open TCP socket; return how many had it."""
    found = 0
    for connection in _connections():
        with connection:
            if connection.getsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _LINGER.size) == _ZENOHS:
                connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _NONE)
                found += 1
    return found


def _connections() -> Iterator[socket.socket]:
    """Yield this process's sockets, each by a descriptor of our own: others may close theirs."""
    try:
        entries = list(_DESCRIPTORS.iterdir())
    except OSError as error:  # no Linux
        _log.debug("connections that are lost may take 10 s to close: %s", error)
        return
    for entry in entries:
        with contextlib.suppress(OSError):  # closed meanwhile, or too many are open
            if not stat.S_ISSOCK(entry.stat().st_mode):
                continue
            mine = os.dup(int(entry.name))
            try:
                connection = socket.socket(fileno=mine)
            except OSError:
                os.close(mine)
                continue
            if connection.family in (socket.AF_INET, socket.AF_INET6):
                yield connection
            else:
                connection.close()
