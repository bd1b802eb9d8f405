"""A connection that gets notices: sent at once while it reads, kept for it while not.

What it does not read is kept up to `NOTICES_MAX`, and then notices are dropped and counted: a
watcher sees the gap in their numbers.

Notices of what it does not watch are not sent: each would wake a process for nothing.  Of a run of
them it gets the numbers, before the next notice, or when the run is `SKIP_S` old.
"""

from __future__ import annotations

import os
import select
import socket
import threading
import time
from collections import deque
from typing import TYPE_CHECKING, Final

from enact_dist.link.notices import Skipped
from enact_dist.link.socket_frames import Kind, prefixed, skipped_frame

if TYPE_CHECKING:
    from enact_dist.core.messages import Notice
    from enact_dist.link.notices import Interest
    from enact_dist.link.socket_service import SocketService

NOTICES_MAX: Final = 65_536
"""Notices kept for a watcher that does not read."""
SKIP_S: Final = 0.25
"""After so long the numbers of skipped notices are sent by themselves."""


class SocketWatcher:
    """One watching connection; its own thread is in `run`, whoever publishes is in `put`."""

    __slots__ = (
        "_bell", "_connected", "_interest", "_mutex", "_service", "_skipped", "_skipped_s",
        "_waiting",
    )  # fmt: skip

    def __init__(
        self, service: SocketService, connected: socket.socket, interest: Interest | None
    ) -> None:
        self._service = service
        self._interest = interest
        self._skipped: Skipped | None = None
        self._skipped_s = 0.0
        self._connected = connected
        self._mutex = threading.Lock()
        # The first that it is sent, whatever is committed at this moment.
        self._waiting = deque([memoryview(prefixed(b"", 0, Kind.OPENED))])
        self._bell = os.eventfd(0, os.EFD_CLOEXEC | os.EFD_NONBLOCK)

    def put(self, notice: Notice, frame: bytes) -> None:
        """Send the frame of a notice, if it is watched; for one thread at a time."""
        kept = True
        with self._mutex:
            if self._interest is None or self._interest.covers(notice):
                kept = self._send(self._taken_skipped() + frame)
            elif self._skipped is None:
                number = notice.number
                self._skipped = Skipped(notice.shard, notice.epoch, number - 1, number)
                self._skipped_s = time.monotonic()
            else:
                shard, epoch, after, _ = self._skipped
                self._skipped = Skipped(shard, epoch, after, notice.number)
        self._count(kept=kept)

    def tell_skipped(self) -> None:
        """Send the numbers of what was skipped a while ago."""
        if self._skipped is None or time.monotonic() - self._skipped_s < SKIP_S:
            return
        with self._mutex:
            kept = self._send(self._taken_skipped())
        self._count(kept=kept)

    def _count(self, *, kept: bool) -> None:
        """Count what was dropped; without the mutex, which others take inside the host's."""
        if not kept:
            self._service.host.count("notices_dropped")

    def _taken_skipped(self) -> bytes:
        skipped, self._skipped = self._skipped, None
        return skipped_frame(*skipped[1:]) if skipped is not None else b""

    def _send(self, frame: bytes) -> bool:
        """Send a frame, or as much as goes without waiting, or keep it; False: it is dropped."""
        if self._bell < 0:
            return True
        if self._waiting:
            if len(self._waiting) >= NOTICES_MAX:
                return False
            self._waiting.append(memoryview(frame))
            return True
        try:
            sent = self._connected.send(frame, socket.MSG_DONTWAIT)
        except BlockingIOError:
            sent = 0
        except OSError:  # its thread notices, too
            return True
        if sent < len(frame):
            # Before the bell, at which its thread looks what there is to send, and then waits.
            self._waiting.append(memoryview(frame)[sent:])
            os.eventfd_write(self._bell, 1)
        return True

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
