"""Serves one `ShardHost` to the processes of its own host, over a Unix socket.

Each connection has a thread that reads a request, lets the host decide, and sends the answer when
the host has let go of it: a client that does not read blocks its own connection and nothing else.
An answer that comes later (a grant after a wait) is sent by whoever brings it, as far as that goes
without waiting; what does not fit is left to the connection's thread.

Watchers get notices in the same way; what they do not read is kept up to `NOTICES_MAX`, and then
notices are dropped and counted: a watcher sees the gap in their numbers.

The kernel tells who connects, and when that process has ended: then its session is ended at once.
"""

from __future__ import annotations

import logging
import os
import select
import socket
import threading
from collections import deque
from pathlib import Path
from typing import TYPE_CHECKING, Final, cast, get_args

from enact_dist.core.messages import Answer, Refused, Request
from enact_dist.core.records import SessionDied
from enact_dist.errors import LinkError, ProtocolError
from enact_dist.link.senders import size_of
from enact_dist.link.socket_frames import (
    BUFFER_BYTES,
    Kind,
    Stream,
    prefixed,
    send_frame,
    wait_at_most,
)
from enact_dist.link.socket_peers import Deaths, check_peer
from enact_dist.wire.frames import decode_frame, encode_frame, encode_parts
from enact_dist.wire.limits import NAME_CHARACTERS_MAX

if TYPE_CHECKING:
    from enact_dist.core.messages import Notice
    from enact_dist.link.host import ShardHost
    from enact_dist.link.shared_folder import SharedFolder

SOCKET_NAME: Final = "socket"
CONNECTIONS_MAX: Final = 1024
"""Connections of one shard: each costs a thread and 0.1 MB."""
SESSION_CONNECTIONS_MAX: Final = 128
"""Connections of one session: one per thread that calls at the same time, and one per feed."""
BACKLOG: Final = 256
OPEN_S: Final = 1.0
"""How long a new connection has to say for whom it speaks."""
SEND_S: Final = 5.0
"""How long a client may read nothing of an answer before its connection is given up."""
DRAIN_ROUNDS: Final = 20
DRAIN_STEP_S: Final = 0.001
"""How often and how long a tick waits for requests that have arrived to be read."""
NOTICES_MAX: Final = 65_536
"""Notices kept for a watcher that does not read."""
JOIN_S: Final = 0.5
"""How long a closing service waits for each of its threads."""

_REQUESTS: Final = frozenset(get_args(Request))
_log = logging.getLogger("enact.link")


class SocketService:
    """One shard's face on one Unix socket in its shared folder.

    Args:
        host: The shard.
        folder: Where the socket is made; closed by whoever made it.

    Raises:
        LinkError: The socket cannot be made.
    """

    def __init__(self, host: ShardHost, folder: SharedFolder) -> None:
        self.host = host
        self._access = folder.access
        self._users = frozenset((os.geteuid(), 0))
        self._closing = threading.Event()
        self._mutex = threading.Lock()
        self._connections: dict[str, set[_Connection]] = {}
        self._count = 0
        self._watchers: tuple[_Watcher, ...] = ()
        self._listener = _listen(folder)
        self._deaths = Deaths(self._died)
        self._unwatch = host.watch(self._publish)
        host.add_inbox(self.drain_inbox)
        self._thread = threading.Thread(target=self._accept, name="enact-accept", daemon=True)
        self._thread.start()

    # ---------------------------------------------------------------- connections

    def _accept(self) -> None:
        while True:
            try:
                connected, _ = self._listener.accept()
            except OSError as error:
                if self._closing.is_set():
                    return
                self.host.count("connections_refused")
                _log.warning("a connection could not be taken: %s", error)
                self._closing.wait(0.05)
                continue
            connection = _Connection(self, connected)
            try:
                threading.Thread(target=connection.run, name="enact-socket", daemon=True).start()
            except RuntimeError:  # no more threads
                self.host.count("connections_refused")
                connected.close()

    def admit(self, connection: _Connection, session: str) -> None:
        """Let a connection speak for a session.

        Raises:
            LinkError: It comes from a stranger, or there are too many.
        """
        check_peer(connection.connected, users=self._users, group=self._access.group)
        with self._mutex:
            mine = self._connections.setdefault(session, set())
            if self._closing.is_set() or self._count >= CONNECTIONS_MAX:
                problem = f"{CONNECTIONS_MAX} connections to shard {self.host.name} are open"
            elif len(mine) >= SESSION_CONNECTIONS_MAX:
                problem = f"session {session[:8]} has {SESSION_CONNECTIONS_MAX} connections open"
            else:
                mine.add(connection)
                self._count += 1
                problem = ""
            if not mine:
                del self._connections[session]
        if problem:
            raise LinkError(problem)
        self._deaths.connected(session, connection.connected)

    def left(self, connection: _Connection, session: str) -> None:
        """Take note that an admitted connection has ended."""
        with self._mutex:
            mine = self._connections.get(session, set())
            mine.discard(connection)
            self._count -= 1
            if not mine:
                self._connections.pop(session, None)
        self._deaths.disconnected(session)

    def _died(self, session: str) -> None:
        self.host.event(SessionDied(session))
        with self._mutex:
            left = list(self._connections.get(session, ()))
        for connection in left:  # a forked child may hold them open
            connection.end()

    def drain_inbox(self) -> None:
        """Wait a moment for requests that have arrived but were not read; before a tick."""
        with self._mutex:
            reading = [c for mine in self._connections.values() for c in mine if c.reading]
        if not reading:
            return
        poll = select.poll()
        of = {connection.connected.fileno(): connection for connection in reading}
        of.pop(-1, None)
        for descriptor in of:
            poll.register(descriptor, select.POLLIN)
        unread = set(of)
        for _ in range(DRAIN_ROUNDS):
            ready = {d for d, event in poll.poll(0) if event & select.POLLIN and of[d].reading}
            unread &= ready
            if not unread or self._closing.wait(DRAIN_STEP_S):
                return

    # ---------------------------------------------------------------- notices

    def watch(self, watcher: _Watcher) -> None:
        """Send all further notices to `watcher`."""
        with self._mutex:
            self._watchers = (*self._watchers, watcher)

    def unwatch(self, watcher: _Watcher) -> None:
        """Send it no more."""
        with self._mutex:
            self._watchers = tuple(other for other in self._watchers if other is not watcher)

    def _publish(self, notice: Notice) -> None:
        """Send a notice to all watchers without waiting for any.  The host's mutex is held."""
        watchers = self._watchers
        if watchers:
            header, payload = encode_frame(notice)
            frame = prefixed(header, len(payload or b"")) + (payload or b"")
            for watcher in watchers:
                watcher.put(frame)

    # ---------------------------------------------------------------- end

    def close(self) -> None:
        """Take and send nothing more; twice is harmless."""
        if self._closing.is_set():
            return
        self._closing.set()
        self._unwatch()
        _end(self._listener)
        self._thread.join(JOIN_S)
        self._listener.close()
        with self._mutex:
            left = [connection for mine in self._connections.values() for connection in mine]
        for connection in left:
            connection.end()
        for connection in left:
            connection.ended.wait(JOIN_S)
        self._deaths.close()


def _listen(folder: SharedFolder) -> socket.socket:
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        listener.bind(folder.address(SOCKET_NAME))
        # Nobody gets to it before its mode is right: the folder lets no stranger in either.
        Path(folder.address(SOCKET_NAME)).chmod(folder.access.socket_mode)
        listener.listen(BACKLOG)
    except OSError as error:
        listener.close()
        raise LinkError(
            f"no socket can be made in {folder.path}: {error.strerror or error}"
        ) from None
    return listener


def _end(connected: socket.socket) -> None:
    """Wake whoever waits on a socket; its own thread closes it."""
    try:
        connected.shutdown(socket.SHUT_RDWR)
    except OSError:  # ended already
        return


class _Connection:
    """One connection and its thread: a request, its answer, the next request.

    Attributes:
        reading: Whether the thread waits for a request, or has not noticed one yet.
        ended: Set once the thread is through.
    """

    __slots__ = (
        "_answer", "_answered", "_late", "_rest", "_service", "_stream", "_thread", "connected",
        "ended", "reading", "session",
    )  # fmt: skip

    def __init__(self, service: SocketService, connected: socket.socket) -> None:
        self._service = service
        self._stream = Stream(connected)
        self._thread = 0
        self._answer: Answer | None = None
        self._answered = threading.Lock()
        self._late: Answer | None = None
        self._rest: memoryview | None = None
        self.connected = connected
        self.session = ""
        self.reading = False
        self.ended = threading.Event()

    def run(self) -> None:
        """Serve until either side ends the connection."""
        self._thread = threading.get_ident()
        self._answered.acquire()
        try:
            wait_at_most(self.connected, socket.SO_RCVTIMEO, OPEN_S)
            wait_at_most(self.connected, socket.SO_SNDTIMEO, SEND_S)
            if self._open():
                try:
                    self._serve()
                finally:
                    self._service.left(self, self.session)
        except BlockingIOError:
            self._service.host.count("answers_dropped")
            _log.warning("session %s does not read; its connection is closed", self.session[:8])
        except (EOFError, OSError):
            pass
        except ProtocolError as error:
            self._refuse(error)
        finally:
            self.connected.close()
            self.ended.set()

    def _open(self) -> bool:
        """Learn for whom the connection speaks; say whether it may."""
        try:
            kind, header, payload = self._stream.receive()
        except BlockingIOError:
            return False
        if kind != Kind.OPEN or payload or not 0 < len(header) <= NAME_CHARACTERS_MAX:
            raise ProtocolError("a connection did not say for whom it speaks")
        try:
            self.session = header.decode("ascii")
            self._service.admit(self, self.session)
        except (LinkError, UnicodeDecodeError) as error:
            self._refuse(error)
            return False
        wait_at_most(self.connected, socket.SO_RCVTIMEO, 0.0)
        send_frame(self.connected, self._service.host.name.encode(), kind=Kind.OPENED)
        return True

    def _refuse(self, error: Exception) -> None:
        self._service.host.count("connections_refused")
        _log.warning("a connection is refused: %s", error)
        try:
            send_frame(self.connected, str(error).encode()[: BUFFER_BYTES // 2], kind=Kind.REFUSED)
        except OSError:
            return

    def _serve(self) -> None:
        receive, host = self._stream.receive, self._service.host
        while True:
            self.reading = True
            kind, header, payload = receive()
            if kind != Kind.MESSAGE:
                if kind == Kind.WATCH:
                    self.reading = False
                    _Watcher(self._service, self.connected).run()
                    return
                raise ProtocolError(f"a frame of kind {kind} came in place of a request")
            try:
                message = decode_frame(header, payload)
                if type(message) not in _REQUESTS:
                    raise ProtocolError(f"{type(message).__name__} is no request")
            except ProtocolError as error:
                host.count("frames_refused")
                self._send(Refused("protocol", str(error)))
                continue
            host.submit(cast("Request", message), self._take)
            self.reading = False
            self._send_answer()

    def _take(self, answer: Answer) -> None:
        """Take the answer from the host, whose mutex is held: nothing here may wait.

        Another thread leaves `_answer` alone: this connection's own may look at it at any moment,
        and one of the two has to send.
        """
        if threading.get_ident() == self._thread:
            self._answer = answer
            return
        if size_of(answer) < BUFFER_BYTES:
            self._rest = self._send_what_fits(answer)
        else:
            self._late = answer
        self._wake()

    def _send_answer(self) -> None:
        """Send the answer, or wait for whoever brings it and send what is left of it."""
        answer, self._answer = self._answer, None
        if answer is None:
            self._answered.acquire()
            answer, self._late = self._late, None
            rest, self._rest = self._rest, None
            if rest is not None:
                self.connected.sendall(rest)
        if answer is not None:
            self._send(answer)

    def _send(self, answer: Answer) -> None:
        try:
            header, bodies = encode_parts(answer)
        except ProtocolError as error:
            _log.warning("answer %s not sent: %s", type(answer).__name__, error)
            raise EOFError from error  # closed, which tells the client *unknown*
        send_frame(self.connected, header, bodies)

    def _send_what_fits(self, answer: Answer) -> memoryview | None:
        """Send without waiting; return what is left for the connection's thread."""
        try:
            header, payload = encode_frame(answer)
            frame = prefixed(header, len(payload or b"")) + (payload or b"")
            sent = self.connected.send(frame, socket.MSG_DONTWAIT)
        except BlockingIOError:
            sent = 0
        except (OSError, ProtocolError) as error:
            _log.info("answer %s not sent: %s", type(answer).__name__, error)
            _end(self.connected)
            return None
        return memoryview(frame)[sent:] if sent < len(frame) else None

    def end(self) -> None:
        """Let the thread end soon, wherever it waits."""
        _end(self.connected)
        self._wake()

    def _wake(self) -> None:
        try:
            self._answered.release()
        except RuntimeError:  # an answer and the end came at the same moment
            return


class _Watcher:
    """A connection that gets notices: sent at once while it reads, kept for it while not."""

    __slots__ = ("_bell", "_connected", "_mutex", "_service", "_waiting")

    def __init__(self, service: SocketService, connected: socket.socket) -> None:
        self._service = service
        self._connected = connected
        self._mutex = threading.Lock()
        self._waiting: deque[memoryview] = deque()
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
            send_frame(self._connected, b"", kind=Kind.OPENED)
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
