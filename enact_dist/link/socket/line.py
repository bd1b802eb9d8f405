"""Connections of one client to one shard of the same host; each carries one call at a time.

The calling thread sends and receives, so no other thread has to be woken: a round trip costs two
system calls on either side.  A connection whose answer was late is closed, so a late answer never
meets the next call.
"""

from __future__ import annotations

import contextlib
import errno
import logging
import os
import select
import socket
import threading
import time
import weakref
from collections.abc import Callable
from typing import Final

from enact_dist.core.protocol.messages import Answer, Notice, Request
from enact_dist.errors import EnactError, LinkError, ProtocolError
from enact_dist.link.carrier import LOOK_S
from enact_dist.link.memory.shared_folder import open_shared
from enact_dist.link.notices import Skipped
from enact_dist.link.socket.frames import (
    Buffer,
    FrameKind,
    Stream,
    read_skipped,
    rounded_s,
    send_frame,
    wait_at_most,
)
from enact_dist.link.socket.peers import check_peer
from enact_dist.wire.frames import decode_answer, decode_frame, encode_parts

SOCKET_NAME: Final = "socket"
CONNECTIONS_MAX: Final = 100
"""Connections of one client to one shard; further calls take the other carrier."""
IDLE_MAX: Final = 16
"""Idle connections kept open for the next call."""
CONNECT_S: Final = 0.5
"""How long a shard may take to accept a connection: it is on this host."""
SEND_S: Final = 3.0
"""How long a shard may leave a request unread before its connection is closed."""
SLACK_S: Final = 1.0
"""Extra time, at most doubling it, that a call may take: the two calls of a lock, whose times
differ
by this much, then share one timeout in the kernel.
"""
RETRY_S_MIN: Final = 0.1
RETRY_S_MAX: Final = 5.0
"""Pause before a lost socket is tried again; doubles up to the second figure."""
AWAY_S: Final = 10.0
"""That pause while Zenoh cannot reach the shard either; ends when the shard returns."""

_log = logging.getLogger("enact.link")


class Connection:
    """One connection to a shard; for one call at a time.  Closes with its last reference."""

    __slots__ = ("__weakref__", "_main", "_poll", "_stream", "_wait_s", "shard", "socket")

    def __init__(self, shard: str, connected: socket.socket) -> None:
        self.shard = shard
        self.socket = connected
        self._stream = Stream(connected)
        self._wait_s = CONNECT_S
        self._main = threading.main_thread().ident
        self._poll = select.poll()
        self._poll.register(connected, select.POLLIN)

    def __del__(self) -> None:
        self.close()

    def close(self) -> None:
        """Close the socket, even one whose descriptor the program has closed; idempotent."""
        with contextlib.suppress(OSError):
            self.socket.close()

    def send(self, request: Request, timeout_s: float) -> None:
        """Send a request, for whose answer `receive` waits up to `timeout_s`.

        Raises:
            OSError: The connection is gone.
            ProtocolError: The request cannot be sent.
        """
        header, bodies = encode_parts(request)
        if not timeout_s <= self._wait_s <= timeout_s + min(timeout_s, SLACK_S):
            self._wait_s = rounded_s(timeout_s)
            wait_at_most(self.socket, socket.SO_RCVTIMEO, self._wait_s)
        send_frame(self.socket, header, bodies)

    def wait(self, interrupt: threading.Event) -> None:
        """Wait until an answer begins to arrive, and look at an interrupt meanwhile.

        Raises:
            BlockingIOError: Time is up, or the interrupt is set.
        """
        end_s = time.monotonic() + self._wait_s
        while not self._poll.poll(LOOK_S * 1e3):
            if interrupt.is_set() or time.monotonic() >= end_s:
                raise BlockingIOError(errno.EAGAIN, "no answer in time, or interrupted")

    def receive(self, into: memoryview | None = None) -> Answer:
        """Return the answer to the sent request, with its data in `into` if they fit.

        Raises:
            EOFError: The shard has closed the connection.
            OSError: The connection is broken, or time is up.
            ProtocolError: The data are no answer.
        """
        # Each signal that Python handles in its main thread restarts the kernel's timeout of a
        # blocked call; a poll, which costs 0.5 us, continues with the remaining time.
        if threading.get_ident() == self._main and not self._poll.poll(self._wait_s * 1e3):
            raise BlockingIOError(errno.EAGAIN, "no answer in time")
        kind, header, payload = self._stream.receive(into)
        if kind != FrameKind.MESSAGE:
            raise ProtocolError(
                f"shard {self.shard} sent a frame of kind {kind} instead of an answer"
                f" ({header.decode('utf-8', 'replace')})"
            )
        return decode_answer(self.shard, header, payload)

    def exchange(self, kind: FrameKind, header: bytes) -> None:
        """Send a frame and wait for the shard's acceptance.

        Raises:
            LinkError: The shard refuses, with its reason.
            EOFError: As `receive`.
            OSError: As `receive`.
            ProtocolError: As `receive`.
        """
        send_frame(self.socket, header, kind=kind)
        kind_of_answer, text, _ = self._stream.receive()
        if kind_of_answer == FrameKind.REFUSED:
            raise LinkError(text.decode("utf-8", "replace"))
        if kind_of_answer != FrameKind.OPENED:
            raise ProtocolError(f"a frame of kind {kind_of_answer} came instead of a greeting")
        if kind == FrameKind.OPEN and text != self.shard.encode():
            raise LinkError(f"shard {text!r} answers at the socket of {self.shard}")

    def fileno(self) -> int:
        """Return the descriptor that becomes readable when data have arrived."""
        return self.socket.fileno()

    def take_notices(self, *, wait: bool = False) -> list[Notice | Skipped]:
        """Return the complete notices sent since `WATCH`; empty if there are none yet.

        Args:
            wait: Whether to wait for some data, which may be only a part of a notice.

        Raises:
            EOFError: As `receive`.
            OSError: As `receive`.
            ProtocolError: The data are no notice.
        """
        found: list[Notice | Skipped] = []
        frame = self._stream.receive_here(wait=wait)
        while frame is not None:
            found.append(self._notice(*frame))
            frame = self._stream.receive_here() if self._stream.begun else None
        return found

    def _notice(self, kind: int, header: bytes, payload: Buffer) -> Notice | Skipped:
        if kind == FrameKind.SKIPPED:
            return Skipped(self.shard, *read_skipped(header))
        notice = decode_frame(header, payload) if kind == FrameKind.MESSAGE else None
        if not isinstance(notice, Notice):
            raise ProtocolError(f"{type(notice).__name__} came instead of a notice")
        return notice

    def wake(self) -> None:
        """End the call that waits on it, from another thread."""
        try:
            self.socket.shutdown(socket.SHUT_RDWR)
        except OSError:  # ended already
            return


class SocketLine:
    """The connections of one session to one start of one shard.  Thread-safe.

    Args:
        shard: The shard's name.
        name: Name of its shared folder, from its WELCOME.
        nonce: Required content of its nonce file.
        greeting: Identifies the connections' session, from `socket_frames.greeting_of`.
        away: Whether the shard is known to be out of reach.

    Attributes:
        problem: Why the last attempt to connect failed; empty without a failure.
        idle: The connections that wait for a call; any thread may take one from the end.
    """

    def __init__(
        self,
        shard: str,
        name: str,
        nonce: bytes,
        greeting: bytes,
        away: Callable[[], bool] = lambda: False,
    ) -> None:
        self.shard = shard
        self.name = name
        self.problem = ""
        self._nonce = nonce
        self._greeting = greeting
        self._away = away
        self.idle: list[Connection] = []
        # Weak: Ctrl-C may hit the holder between any two steps, which abandons the connection.
        self._open: weakref.WeakSet[Connection] = weakref.WeakSet()
        self._mutex = threading.Lock()
        self._retry_at_s = 0.0
        self._retry_s = RETRY_S_MIN
        self.closed = False

    def take(self) -> Connection | None:
        """Return a connection for one call; None if none is available."""
        try:
            return self.idle.pop()
        except IndexError:
            return self.connect()

    def give_back(self, connection: Connection) -> None:
        """Keep the connection of an answered call for the next one."""
        self.idle.append(connection)
        if self.closed or len(self.idle) > IDLE_MAX:
            self.settle(connection)

    def settle(self, given: Connection) -> None:
        """Close what is not kept, after `given` has become idle."""
        if self.closed:  # perhaps just closed by another thread, which has not seen this one
            self.lost(given)
            return
        try:
            surplus = self.idle.pop()
        except IndexError:  # other calls have taken them
            return
        self.drop(surplus)

    def drop(self, connection: Connection) -> None:
        """Close a connection whose answer was late or invalid."""
        with self._mutex:
            self._open.discard(connection)
        connection.close()

    def lost(self, connection: Connection) -> None:
        """Note that a connection has broken: the others are suspect, too."""
        self.drop(connection)
        with self._mutex:
            idle, self.idle = self.idle, []
        for other in idle:
            self.drop(other)

    def connect(self) -> Connection | None:
        """Open one more connection; None if that fails, or if it is too early for a retry."""
        if not self._may_connect():
            return None
        try:
            connection = self._connected()
        except (EnactError, EOFError, OSError) as error:
            none = isinstance(error, FileNotFoundError)
            before = self.problem
            self.problem = "it offers none" if none else str(error) or type(error).__name__
            away = self._away()
            with self._mutex:
                self._retry_at_s = time.monotonic() + (AWAY_S if away else self._retry_s)
                self._retry_s = min(2 * self._retry_s, RETRY_S_MAX)
            if self.problem != before:  # not at every further attempt
                _log.debug("no socket to shard %s: %s", self.shard, self.problem)
            return None
        self.problem, self._retry_s = "", RETRY_S_MIN
        with self._mutex:
            self._open.add(connection)
        if self.closed:  # closed meanwhile by another thread
            self.drop(connection)
            return None
        return connection

    def _may_connect(self) -> bool:
        rests = time.monotonic() < self._retry_at_s
        return not self.closed and not rests and len(self._open) < CONNECTIONS_MAX

    def _connected(self) -> Connection:
        folder = open_shared(self.name, self._nonce)
        connected = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            wait_at_most(connected, socket.SO_SNDTIMEO, CONNECT_S)
            wait_at_most(connected, socket.SO_RCVTIMEO, CONNECT_S)
            connected.connect(folder.address(SOCKET_NAME))
            check_peer(connected, users=frozenset((folder.owner, os.geteuid())), group=None)
            connection = Connection(self.shard, connected)
            connection.exchange(FrameKind.OPEN, self._greeting)
            wait_at_most(connected, socket.SO_SNDTIMEO, SEND_S)
        except BaseException:
            connected.close()
            raise
        finally:
            folder.close()
        return connection

    def try_again(self) -> None:
        """End the pause after a failure: the shard or Zenoh has just shown that it is there."""
        self._retry_at_s = 0.0

    def abandon(self) -> None:
        """Close the connections that a forked child has inherited; sends the shard nothing."""
        self.closed = True
        for connection in (*self._open,):
            connection.close()

    def close(self) -> None:
        """End all connections; pending calls return without an answer."""
        with self._mutex:
            self.closed = True
            idle, self.idle = self.idle, []
            left = [connection for connection in self._open if connection not in idle]
            self._open.difference_update(idle)
        for connection in idle:
            connection.close()
        for connection in left:
            connection.wake()
