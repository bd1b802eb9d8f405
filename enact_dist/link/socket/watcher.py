"""A connection that receives notices; they are queued while the watcher does not read.

The queue holds up to `NOTICES_MAX` notices; further ones are dropped and counted, and the watcher
sees the gap in their numbers.

Notices that it does not watch are not sent, since each would wake a process for nothing.  It gets
only their numbers, before the next notice or once they are `SKIP_S` old.  The same holds for
changes of slots that its client may not read.
"""

from __future__ import annotations

import os
import select
import socket
import threading
import time
from collections import deque
from dataclasses import replace
from typing import TYPE_CHECKING, Final, Protocol

from enact_dist.link.notices import Interest, Skipped
from enact_dist.link.socket.frames import FrameKind, prefixed, skipped_frame
from enact_dist.wire.frames import encode_frame

if TYPE_CHECKING:
    from collections.abc import Callable

    from enact_dist.core.protocol.datum import Slot
    from enact_dist.core.protocol.messages import Notice
    from enact_dist.link.host import ShardHost

NOTICES_MAX: Final = 65_536
"""Notices queued for a watcher that does not read."""
SKIP_S: Final = 0.25
"""After this time the numbers of skipped notices are sent on their own."""


class OutgoingNotice:
    """A notice and its frame, encoded once for all watchers, and only if one of them wants it."""

    __slots__ = ("_frame", "notice")

    def __init__(self, notice: Notice) -> None:
        self.notice, self._frame = notice, b""

    @property
    def frame(self) -> bytes:
        """The whole frame."""
        if not self._frame:
            header, payload = encode_frame(self.notice)
            self._frame = prefixed(header, len(payload or b"")) + (payload or b"")
        return self._frame


class Publisher(Protocol):
    """What a watcher needs of the service that sends it notices."""

    @property
    def host(self) -> ShardHost:
        """The shard, which counts what is dropped."""

    def watch(self, watcher: SocketWatcher) -> None:
        """Send all further notices to `watcher`."""

    def unwatch(self, watcher: SocketWatcher) -> None:
        """Stop sending notices to `watcher`."""


class SocketWatcher:
    """One watching connection; its own thread calls `run`, publishing threads call `put`."""

    __slots__ = (
        "_bell", "_connected", "_interest", "_may_read", "_mutex", "_service", "_skipped",
        "_skipped_s", "_waiting",
    )  # fmt: skip

    def __init__(
        self,
        service: Publisher,
        connected: socket.socket,
        interest: Interest | None,
        may_read: Callable[[Slot], bool] | None = None,
    ) -> None:
        self._may_read = may_read
        self._service = service
        self._interest = interest
        self._skipped: Skipped | None = None
        self._skipped_s = 0.0
        self._connected = connected
        self._mutex = threading.Lock()
        # The first frame sent, even if a commit is published at this moment.
        self._waiting = deque([memoryview(prefixed(b"", 0, FrameKind.OPENED))])
        self._bell = os.eventfd(0, os.EFD_CLOEXEC | os.EFD_NONBLOCK)

    def takes_data(self, notice: Notice) -> bool:
        """Whether a notice may carry data: not while others wait for it, so they take no memory."""
        interest = self._interest
        wants = interest is not None and interest.wanted.data and not self._waiting
        return wants and interest.covers(notice)  # type: ignore[union-attr]  # it wants data

    def put(self, outgoing: OutgoingNotice) -> None:
        """Send a notice, if it is watched; by one thread at a time."""
        kept, hidden, notice = True, False, outgoing.notice
        if self._may_read is not None:
            notice = self._readable(outgoing.notice, self._may_read)
            if notice is not outgoing.notice:
                hidden, outgoing = not notice.changes, OutgoingNotice(notice)
        with self._mutex:
            if not hidden and (self._interest is None or self._interest.covers(notice)):
                kept = self._send(self._taken_skipped() + outgoing.frame)
            elif self._skipped is None:
                number = notice.number
                self._skipped = Skipped(notice.shard, notice.epoch, number - 1, number)
                self._skipped_s = time.monotonic()
            else:
                shard, epoch, after, _ = self._skipped
                self._skipped = Skipped(shard, epoch, after, notice.number)
        self._count(kept=kept)

    @staticmethod
    def _readable(notice: Notice, may_read: Callable[[Slot], bool]) -> Notice:
        """Return a notice without the changes that the client may not see."""
        changes = tuple([change for change in notice.changes if may_read(change.slot)])
        return notice if len(changes) == len(notice.changes) else replace(notice, changes=changes)

    def tell_skipped(self) -> None:
        """Send the numbers of notices skipped a while ago."""
        if self._skipped is None or time.monotonic() - self._skipped_s < SKIP_S:
            return
        with self._mutex:
            kept = self._send(self._taken_skipped())
        self._count(kept=kept)

    def _count(self, *, kept: bool) -> None:
        """Count dropped notices; without the mutex, which others take inside the host's."""
        if not kept:
            self._service.host.count("notices_dropped")

    def _taken_skipped(self) -> bytes:
        skipped, self._skipped = self._skipped, None
        return skipped_frame(*skipped[1:]) if skipped is not None else b""

    def _send(self, frame: bytes) -> bool:
        """Send a frame, as far as possible without blocking, or queue it; False: dropped."""
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
        except OSError:  # its own thread notices this, too
            return True
        if sent < len(frame):
            # Before the bell, which makes the thread look for frames to send and then wait.
            self._waiting.append(memoryview(frame)[sent:])
            os.eventfd_write(self._bell, 1)
        return True

    def run(self) -> None:
        """Send the queued frames, until the connection ends."""
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
                        return  # a watcher sends nothing: it has ended
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
