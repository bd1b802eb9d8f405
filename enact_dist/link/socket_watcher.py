"""A connection that gets notices: sent at once while it reads, kept for it while not.

What it does not read is kept up to `NOTICES_MAX`, and then notices are dropped and counted: a
watcher sees the gap in their numbers.
"""

from __future__ import annotations

import os
import select
import socket
import threading
from collections import deque
from typing import TYPE_CHECKING, Final

from enact_dist.link.socket_frames import Kind, prefixed

if TYPE_CHECKING:
    from enact_dist.link.socket_service import SocketService

NOTICES_MAX: Final = 65_536
"""Notices kept for a watcher that does not read."""


class SocketWatcher:
    """One watching connection; its own thread is in `run`, whoever publishes is in `put`."""

    __slots__ = ("_bell", "_connected", "_mutex", "_service", "_waiting")

    def __init__(self, service: SocketService, connected: socket.socket) -> None:
        self._service = service
        self._connected = connected
        self._mutex = threading.Lock()
        # The first that it is sent, whatever is committed at this moment.
        self._waiting = deque([memoryview(prefixed(b"", 0, Kind.OPENED))])
        self._bell = os.eventfd(0, os.EFD_CLOEXEC | os.EFD_NONBLOCK)

    def put(self, frame: bytes) -> None:
        """Send a frame, or as much as goes without waiting, or keep it, or drop it."""
        with self._mutex:
            if self._bell < 0:
                return
            rest = memoryview(frame)
            if not self._waiting:
                try:
                    sent = self._connected.send(frame, socket.MSG_DONTWAIT)
                except BlockingIOError:
                    sent = 0
                except OSError:  # its thread notices, too
                    return
                if sent == len(frame):
                    return
                rest = rest[sent:]
                os.eventfd_write(self._bell, 1)
            elif len(self._waiting) >= NOTICES_MAX:
                self._service.host.count("notices_dropped")
                return
            self._waiting.append(rest)

    def run(self) -> None:
        """Send what was kept, until the connection ends."""
        poll = select.poll()
        poll.register(self._bell, select.POLLIN)
        poll.register(self._connected, select.POLLIN)
        self._service.watch(self)
        try:
            while True:
                poll.modify(
                    self._connected, select.POLLIN | (select.POLLOUT if self._waiting else 0)
                )
                for descriptor, event in poll.poll():
                    if descriptor == self._bell:
                        os.eventfd_read(self._bell)
                    elif event & ~select.POLLOUT:
                        return  # it has nothing to say: it has ended
                    else:
                        self._flush()
        finally:
            self._service.unwatch(self)
            with self._mutex:
                os.close(self._bell)
                self._bell = -1

    def _flush(self) -> None:
        while self._waiting:
            first = self._waiting[0]
            try:
                sent = self._connected.send(first, socket.MSG_DONTWAIT)
            except BlockingIOError:
                return
            with self._mutex:
                if sent < len(first):
                    self._waiting[0] = first[sent:]
                else:
                    self._waiting.popleft()
