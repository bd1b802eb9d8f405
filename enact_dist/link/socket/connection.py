"""One connection of a client to a shard of its host: a request, its answer, the next request.

Its thread reads a request, lets the host decide, and sends the answer once the host has released
its mutex.  A later answer (a grant after a wait) is sent by the thread that produces it, as far as
that works without blocking; the connection's thread sends the rest.
"""

from __future__ import annotations

import logging
import socket
import threading
from typing import Final, Protocol

from enact_dist.core.protocol.datum import Slot
from enact_dist.core.protocol.messages import (
    PERMISSION,
    PROTOCOL,
    Answer,
    Hello,
    Outcome,
    Refused,
    Release,
    Request,
    Survey,
)
from enact_dist.core.rights.rules import UNPROVEN, path_of
from enact_dist.core.shard.owners import SESSION_OF, not_yours
from enact_dist.errors import LinkError, PermissionDeniedError, ProtocolError
from enact_dist.link.answers import encoded, size_of
from enact_dist.link.notices import Interest
from enact_dist.link.socket.frames import (
    BUFFER_BYTES,
    FrameKind,
    Stream,
    end_socket,
    prefixed,
    read_greeting,
    send_frame,
    wait_at_most,
)
from enact_dist.link.socket.peers import PeerCredentials
from enact_dist.link.socket.watcher import Publisher, SocketWatcher
from enact_dist.link.zenoh.access import refuse_other_name
from enact_dist.patterns import checked_patterns
from enact_dist.wire.frames import decode_frame, decode_request

OPEN_S: Final = 1.0
"""How long a new connection may take to name its session."""
SEND_S: Final = 5.0
"""How long a client may leave an answer unread before its connection is closed."""

_log = logging.getLogger("enact.link")


class Admission(Publisher, Protocol):
    """What a connection needs of the service that accepted it."""

    def admit(self, connection: SocketConnection, session: str, secret: str) -> None:
        """Admit a connection for a session; see `SocketService.admit`."""

    def left(self, connection: SocketConnection, session: str) -> None:
        """Record the end of an admitted connection."""

    def may_release(self, session: str, peer: PeerCredentials) -> bool:
        """Whether a session has connections from this process, or has ended."""


class SocketConnection:
    """One connection and its thread: a request, its answer, the next request.

    Attributes:
        session: The session it speaks for; empty until the service has admitted it.
        identity: Owner of that session.
        subject: Whose rights it uses; None: the shard has no rights.
        peer: The process at the other end, according to the kernel.
        step: 3n while it waits for its n-th request, 3n + 1 once it has read it, 3n + 2 once the
            host has it.
        ended: Set when the thread has ended.
    """

    __slots__ = (
        "_answer", "_answered", "_late", "_rest", "_service", "_stream", "_thread", "connected",
        "ended", "identity", "peer", "session", "step", "subject",
    )  # fmt: skip

    def __init__(self, service: Admission, connected: socket.socket) -> None:
        self._service = service
        self._stream = Stream(connected)
        self._thread = 0
        self._answer: Answer | None = None
        self._answered = threading.Lock()
        self._late: Answer | None = None
        self._rest: memoryview | None = None
        self.connected = connected
        self.session = self.identity = ""
        self.subject: str | None = None
        self.peer = PeerCredentials(0, 0, 0)
        self.step = 2
        self.ended = threading.Event()

    def run(self) -> None:
        """Serve until either side ends the connection."""
        self._thread = threading.get_ident()
        self._answered.acquire()
        try:
            wait_at_most(self.connected, socket.SO_RCVTIMEO, OPEN_S)
            wait_at_most(self.connected, socket.SO_SNDTIMEO, SEND_S)
            if self._open():
                self._serve()
        except BlockingIOError:
            self._service.host.count("answers_dropped")
            _log.warning("session %s does not read; its connection is closed", self.session[:8])
        except (EOFError, OSError) as error:
            _log.debug("a connection of session %s ends: %s", self.session[:8], error)
        except ProtocolError as error:
            self._refuse(error)
        finally:
            if self.session:
                self._service.left(self, self.session)
            self.connected.close()
            self.ended.set()

    def _open(self) -> bool:
        """Read which session the connection speaks for; return whether it may."""
        try:
            kind, header, payload = self._stream.receive()
        except BlockingIOError:
            return False
        if kind != FrameKind.OPEN or payload:
            raise ProtocolError(f"a frame of kind {kind} came instead of a greeting")
        session, self.identity, secret = read_greeting(header)
        try:
            self._service.admit(self, session, secret)
            self.session = session
        except LinkError as error:
            self._refuse(error)
            return False
        wait_at_most(self.connected, socket.SO_RCVTIMEO, 0.0)
        send_frame(self.connected, self._service.host.name.encode(), kind=FrameKind.OPENED)
        return True

    def _refuse(self, error: Exception) -> None:
        self._service.host.count("connections_refused")
        _log.warning("a connection is refused: %s", error)
        try:
            send_frame(
                self.connected, str(error).encode()[: BUFFER_BYTES // 2], kind=FrameKind.REFUSED
            )
        except OSError:
            return

    def _serve(self) -> None:
        receive, host = self._stream.receive, self._service.host
        step = -1
        while True:
            self.step = step = step + 1
            kind, header, payload = receive()
            self.step = step = step + 1
            if kind != FrameKind.MESSAGE:
                if kind == FrameKind.WATCH:
                    self.step = step + 1
                    may_read = self._may_read if host.rights is not None else None
                    interest = _interest(header)
                    SocketWatcher(self._service, self.connected, interest, may_read).run()
                    return
                raise ProtocolError(f"a frame of kind {kind} came instead of a request")
            try:
                message = decode_request(header, payload)
            except ProtocolError as error:
                host.count("frames_refused")
                self.step = step = step + 1
                self._send(Refused(PROTOCOL, str(error)))
                continue
            name = SESSION_OF[type(message)]
            session = name(message) if name is not None else ""
            if session and session != self.session and not self._may_name(session, message):
                self.step = step = step + 1
                self._send(not_yours(session, "another connection", self.identity))
                continue
            if type(message) is Hello and self.subject is not None:
                try:
                    refuse_other_name(message.actor, self.identity)
                except PermissionDeniedError as error:
                    self.step = step = step + 1
                    self._send(Refused(PERMISSION, str(error)))
                    continue
            left = host.submit(message, self._take, self.identity, self.subject, True)
            self.step = step = step + 1
            if left:
                host.write_here()
            answer, self._answer = self._answer, None
            if answer is not None:
                self._send(answer)
            else:
                self._send_late()
            if host.payloads.wants_ahead:
                host.payloads.make_ahead()

    def _may_read(self, slot: Slot) -> bool:
        rights = self._service.host.rights
        return rights is None or rights.may(self.subject or UNPROVEN, "read", path_of(slot))

    def _may_name(self, session: str, message: Request) -> bool:
        """Whether a message may name another session, as a question for a commit's outcome does.

        Of two sessions of one process, each may release the other's locks.  The core refuses
        everything else by identity.
        """
        if type(message) is Release:
            return self._service.may_release(session, self.peer)
        return type(message) is Outcome

    def _take(self, answer: Answer) -> None:
        """Take the answer from the host, whose mutex is held: this must not block.

        This connection's thread may look at `_answer` at any moment, and exactly one of the two
        threads must send, so no third thread may touch it.
        """
        if threading.get_ident() == self._thread:
            self._answer = answer
            return
        if size_of(answer) < BUFFER_BYTES:
            self._rest = self._send_what_fits(answer)
        else:
            self._late = answer
        self._wake()

    def _send_late(self) -> None:
        """Wait for the thread that produces the answer, and send what it has not sent."""
        self._answered.acquire()
        answer, self._late = self._late, None
        rest, self._rest = self._rest, None
        if rest is not None:
            self.connected.sendall(rest)
        if answer is not None:
            self._send(answer)

    def _send(self, answer: Answer) -> None:
        send_frame(self.connected, *encoded(answer, self._service.host.count))

    def _send_what_fits(self, answer: Answer) -> memoryview | None:
        """Send without blocking; return the rest, which the connection's thread sends."""
        header, bodies = encoded(answer, self._service.host.count)
        payload = b"".join(bodies)
        frame = prefixed(header, len(payload)) + payload
        try:
            sent = self.connected.send(frame, socket.MSG_DONTWAIT)
        except BlockingIOError:
            sent = 0
        except OSError as error:
            _log.info("answer %s not sent: %s", type(answer).__name__, error)
            end_socket(self.connected)
            return None
        return memoryview(frame)[sent:] if sent < len(frame) else None

    def end(self) -> None:
        """Make the thread end soon, wherever it waits."""
        end_socket(self.connected)
        self._wake()

    def _wake(self) -> None:
        try:
            self._answered.release()
        except RuntimeError:  # an answer and the end came at the same moment
            return


def _interest(header: bytes) -> Interest | None:
    """Return what a watcher watches; None: everything.

    Raises:
        ProtocolError: The header is something else, or its patterns are invalid.
    """
    if not header:
        return None
    wanted = decode_frame(header, b"")
    if not isinstance(wanted, Survey):
        raise ProtocolError(f"{type(wanted).__name__} came instead of what to watch")
    try:
        checked_patterns(wanted.patterns)
    except ValueError as error:
        raise ProtocolError(str(error)) from None
    return Interest(wanted)
