"""A client's feed of notices, over sockets for shards on its host.

It has a connection to each shard with a socket and uses Zenoh for the others.  Both may bring the
same notice for a while: the queue takes each number once, and the watcher notices missing numbers.
A waiting thread reads the first connection itself; each further one has a thread.

A connection that ends is reopened at once.  If that fails, its shard's notices come over Zenoh.
The socket is tried again when a keep-alive of this session was answered over one, which happens
several times per TTL.  Zenoh stays until the first notice has come over the socket and all earlier
ones over Zenoh, so that none is missed.
"""

from __future__ import annotations

import logging
import socket
import threading
from typing import TYPE_CHECKING, Final, Protocol

from enact_dist.errors import LinkError, ProtocolError
from enact_dist.link.socket.frames import FrameKind, wait_at_most
from enact_dist.wire.frames import encode_frame

if TYPE_CHECKING:
    from collections.abc import Callable

    from enact_dist.core.protocol.messages import Notice, Survey
    from enact_dist.link.notices import NoticeQueue, Skipped
    from enact_dist.link.socket.line import Connection, SocketLine
    from enact_dist.link.zenoh.carrier import ZenohCarrier

JOIN_S: Final = 1.0
EARLIER_S: Final = 1.0
"""How long notices from before a socket's first one may still be in transit over Zenoh."""

_log = logging.getLogger("enact.link")


class Reach(Protocol):
    """What a feed needs of its client's carrier: the ways to the shards."""

    @property
    def behind(self) -> ZenohCarrier:
        """The carrier that reaches every shard."""

    def lines(self) -> tuple[set[str], dict[str, SocketLine]]:
        """Return the known shards, and the lines of those that have one."""

    def tried(
        self, line: SocketLine, open_one: Callable[[], Connection | None]
    ) -> Connection | None:
        """Return what `open_one` opens on a line; retried if the socket is forced."""


class SocketFeed:
    """Connects to each shard with a socket; uses Zenoh for the others."""

    def __init__(self, carrier: Reach, queue: NoticeQueue, interest: Survey | None) -> None:
        self._carrier = carrier
        self._queue = queue
        self._watch = encode_frame(interest)[0] if interest is not None else b""
        self._mutex = threading.Lock()
        self._pumps: dict[str, tuple[SocketLine, Connection, threading.Thread | None]] = {}
        self._coming: dict[str, tuple[Connection | None, threading.Thread]] = {}
        self._over_zenoh = False
        self._closed = False

    def settle(self) -> None:
        """Open and close connections as needed after a change."""
        with self._mutex:
            if self._closed:
                return
            shards, lines = self._carrier.lines()
            for shard, line in lines.items():
                if shard not in self._pumps:
                    self._open_pump(shard, line)
            need_zenoh = not shards or bool(shards - set(self._pumps))
            if need_zenoh and not self._over_zenoh:
                self._carrier.behind.feed_into(self._queue)
            elif self._over_zenoh and not need_zenoh:
                self._carrier.behind.stop_feeding(self._queue)
            self._over_zenoh = need_zenoh

    def _open_pump(self, shard: str, line: SocketLine) -> None:
        connection = self._carrier.tried(line, lambda: self._watching(line))
        if connection is not None:
            self._read_from(shard, line, connection)

    def _read_from(self, shard: str, line: SocketLine, connection: Connection) -> None:
        """Assign a connection to the waiting thread or to a new one; the mutex is held."""
        if self._queue.read_from(
            connection, lambda error: self._ended(shard, line, connection, error)
        ):
            self._pumps[shard] = line, connection, None
            return
        thread = threading.Thread(
            target=self._pump, args=(shard, line, connection), name="enact-notices", daemon=True
        )
        thread.start()  # its end waits for the mutex
        self._pumps[shard] = line, connection, thread

    def come_back(self, shard: str, line: SocketLine) -> None:
        """Try the socket to a shard again if its notices come over Zenoh; does not block."""
        if shard in self._pumps or shard in self._coming:
            return
        thread = threading.Thread(
            target=self._come_back, args=(shard, line), name="enact-notices", daemon=True
        )
        with self._mutex:
            if self._closed or shard in self._pumps or shard in self._coming:
                return
            self._coming[shard] = None, thread
            try:
                thread.start()
            except RuntimeError:  # no thread available: try next time
                del self._coming[shard]

    def _come_back(self, shard: str, line: SocketLine) -> None:
        """Watch over the socket in parallel, until Zenoh is no longer needed for this shard."""
        connection = self._watching(line)
        came = False
        try:
            with self._mutex:
                if connection is None or self._closed:
                    return
                self._coming[shard] = connection, threading.current_thread()
            found: list[Notice | Skipped] = []
            while not found:
                found = connection.take_notices(wait=True)
            self._queue.wait_for_earlier(found[0], EARLIER_S)
            self._queue.take(found)
            with self._mutex:
                if not self._closed and shard not in self._pumps:
                    self._read_from(shard, line, connection)
                    came = True
        except Exception as error:  # noqa: BLE001 - Zenoh goes on, and the socket is tried again
            _log.debug("notices of shard %s stay on Zenoh: %s", shard, error)
        finally:
            with self._mutex:
                self._coming.pop(shard, None)
            if connection is not None and not came:
                line.drop(connection)
        if came:
            self.settle()

    def _watching(self, line: SocketLine) -> Connection | None:
        """Return a new connection for notices, or None if that fails."""
        connection = line.connect()
        if connection is None:
            return None
        try:
            connection.exchange(FrameKind.WATCH, self._watch)
        except (LinkError, ProtocolError, EOFError, OSError) as error:
            _log.debug("no notices over the socket to shard %s: %s", line.shard, error)
            line.drop(connection)
            return None
        wait_at_most(connection.socket, socket.SO_RCVTIMEO, 0.0)
        return connection

    def _pump(self, shard: str, line: SocketLine, connection: Connection) -> None:
        """Move notices from a connection into the queue until it ends."""
        try:
            while True:
                self._queue.take(connection.take_notices(wait=True))
        except Exception as error:  # noqa: BLE001 - whatever it is, another way is opened
            self._ended(shard, line, connection, error)

    def _ended(
        self, shard: str, line: SocketLine, connection: Connection, error: Exception
    ) -> None:
        if not self._closed:
            _log.debug("notices of shard %s end: %s", shard, error)
        line.drop(connection)
        with self._mutex:
            self._pumps.pop(shard, None)
        if not self._closed:
            self.settle()

    def close(self) -> None:
        """End the feed; waits for its threads."""
        with self._mutex:
            self._closed = True
            pumps = list(self._pumps.values())
            coming = list(self._coming.values())
            if self._over_zenoh:
                self._carrier.behind.stop_feeding(self._queue)
        for _, connection, _ in pumps:
            connection.wake()
        for woken, _ in coming:
            if woken is not None:
                woken.wake()
        for _, joined in coming:
            if joined is not threading.current_thread():
                joined.join(JOIN_S)
        for line, connection, thread in pumps:
            if thread is None:
                line.drop(connection)
            elif thread is not threading.current_thread():
                thread.join(JOIN_S)
