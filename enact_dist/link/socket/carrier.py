"""The carrier of a client whose shards may run on its own host: a socket there, Zenoh elsewhere.

It works in front of a `ZenohCarrier`, whose sessions and tokens exist in any case.  A shard's
WELCOME names a shared folder; if this process sees that folder, calls to the shard use the socket
in it.  If the socket is unavailable, a call silently uses Zenoh instead.  A call whose socket
breaks after sending is *unknown*; this carrier does not send it again.

With the socket forced, a WELCOME whose socket cannot be used is an error, provided its shard still
runs.  Before the first WELCOME, and after a shard went away, calls still use Zenoh: the WELCOME
itself has to arrive somehow.
"""

from __future__ import annotations

import logging
import os
import threading
import weakref
from functools import partial
from typing import TYPE_CHECKING, Final

from enact_dist.core.protocol.messages import Alive, Ping, Pong, Welcome
from enact_dist.core.state.clock import is_older
from enact_dist.errors import LinkError
from enact_dist.link.carrier import check_usable
from enact_dist.link.notices import NoticeQueue
from enact_dist.link.socket.feed import SocketFeed
from enact_dist.link.socket.frames import greeting_of
from enact_dist.link.socket.line import IDLE_MAX, Connection, SocketLine

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from enact_dist.core.protocol.messages import Answer, Request, ShardEntry, Survey
    from enact_dist.link.carrier import Begun
    from enact_dist.link.zenoh.carrier import ZenohCarrier

FETCH_BYTES: Final = 4 << 20
"""A slice over a socket delays no other client; a shard sends no larger slice at once."""
LATE_S: Final = 1.0
"""How late the numbers of skipped notices may be: four times a shard's own limit."""
FORCED_TRIES: Final = 20
"""Attempts for a forced socket: a busy shard may not answer one within half a second."""
THERE_S: Final = 1.0
"""How long a shard with an unusable forced socket may take to show that it still runs."""

_log = logging.getLogger("enact.link")
_open: weakref.WeakSet[SocketCarrier] = weakref.WeakSet()


class SocketCarrier:
    """Reaches shards over sockets where possible.  See `Carrier` for the methods; thread-safe.

    Args:
        behind: Reaches every shard; closed together with this carrier.
        session: The session that the connections speak for.
        identity: Owner of the session.
        secret: Proves to a shard that the session is this process's own.
        forced: Whether an unusable socket is an error.

    Attributes:
        inside: False: no shard runs in this process.
        calls: How many calls went over sockets, and how many over Zenoh.
    """

    def __init__(
        self,
        behind: ZenohCarrier,
        session: str,
        identity: str,
        secret: str = "",
        *,
        forced: bool = False,
    ) -> None:
        self.inside = False
        self.calls = {"socket": 0, "zenoh": 0}
        self._behind = behind
        self._greeting = greeting_of(session, identity, secret)
        self._forced = forced
        self._pid = os.getpid()
        self._closed = False
        self._mutex = threading.Lock()
        self._lines: dict[str, SocketLine] = {}
        self._epochs: dict[str, int] = {}
        self._shards: set[str] = set()
        self._feeds: dict[NoticeQueue, SocketFeed] = {}
        _open.add(self)

    @property
    def fetch_bytes(self) -> int:
        """The largest slice of a datum that one call requests, in bytes."""
        lines = list(self._lines.values())
        all_here = len(lines) == len(self._shards) and not any(line.problem for line in lines)
        return FETCH_BYTES if lines and all_here else self._behind.fetch_bytes

    # ---------------------------------------------------------------- requests

    def request(
        self,
        shard: str,
        message: Request,
        *,
        timeout_s: float,
        interrupt: threading.Event | None = None,
    ) -> Answer | None:
        """Send one request and return its answer, or None if none came in time.

        Raises:
            ProtocolError: An answer cannot be read, or two daemons answer for one shard.
            MisuseError: The carrier is closed or was opened before a fork.
            LinkError: The socket is forced and cannot be used.
        """
        if self._closed or self._pid != os.getpid():
            self._check_usable()
        line = self._lines.get(shard)
        connection = self._sent(line, message, timeout_s) if line is not None else None
        if line is None or connection is None:
            self.calls["zenoh"] += 1
            answer = self._behind.request(shard, message, timeout_s=timeout_s)
        else:
            self.calls["socket"] += 1
            answer = _received(line, connection, interrupt=interrupt)
        if type(answer) is Welcome:
            self.learn(answer)
        return answer

    def request_all(
        self, requests: Sequence[tuple[str, Request]], *, timeout_s: float
    ) -> list[Answer | None]:
        """Send all requests before waiting for the first answer; answers in the same order.

        Raises:
            ProtocolError: As `request`.
            MisuseError: As `request`.
            LinkError: As `request`.
        """
        self._check_usable()
        sent: dict[int, tuple[SocketLine, Connection]] = {}
        answers: list[Answer | None] = [None] * len(requests)
        try:
            for index, (shard, message) in enumerate(requests):
                line = self._lines.get(shard)
                connection = self._sent(line, message, timeout_s) if line is not None else None
                if line is not None and connection is not None:
                    sent[index] = line, connection
            others = [index for index in range(len(requests)) if index not in sent]
            self.calls["socket"] += len(sent)
            if others:
                self.calls["zenoh"] += len(others)
                asked = [requests[index] for index in others]
                came = self._behind.request_all(asked, timeout_s=timeout_s)
                for index, answer in zip(others, came, strict=True):
                    answers[index] = answer
            for index in list(sent):
                answers[index] = _received(*sent.pop(index))
                if type(answers[index]) is Alive:
                    self._is_near(requests[index][0])
        finally:
            for line, connection in sent.values():  # an exception came before its turn
                line.drop(connection)
        for answer in answers:
            if type(answer) is Welcome:
                self.learn(answer)
        return answers

    def _is_near(self, shard: str) -> None:
        """Let feeds that lost the socket to a shard try it again: its session lives there."""
        line = self._lines.get(shard)
        for feed in list(self._feeds.values()):
            if line is not None:
                feed.come_back(shard, line)

    def begin(self, shard: str, message: Request, *, timeout_s: float) -> Begun:
        """Send one request whose answer the caller awaits later; each uses its own connection.

        Raises:
            ProtocolError: As `request`.
            MisuseError: As `request`.
        """
        self._check_usable()
        line = self._lines.get(shard)
        connection = self._sent(line, message, timeout_s) if line is not None else None
        if line is None or connection is None:
            self.calls["zenoh"] += 1
            return self._behind.begin(shard, message, timeout_s=timeout_s)
        self.calls["socket"] += 1
        return _Begun(line, connection)

    @staticmethod
    def _sent(line: SocketLine, message: Request, timeout_s: float) -> Connection | None:
        """Send a request over a socket; None if none of it can have arrived."""
        try:
            connection: Connection | None = line.idle.pop()
        except IndexError:
            connection = line.connect()
        if connection is None:
            return None
        try:
            connection.send(message, timeout_s)
        except BlockingIOError:
            line.drop(connection)  # it does not read, and has only a part of the frame
            return None
        except OSError:
            line.lost(connection)  # either end was closed before, so the frame is incomplete
            return None
        except BaseException:
            line.drop(connection)
            raise
        return connection

    def _check_usable(self) -> None:
        check_usable(self._pid, closed=self._closed)

    # ---------------------------------------------------------------- lines

    def learn(self, welcome: Welcome) -> None:
        """Find out from a shard's WELCOME whether it shares memory with this process.

        Raises:
            LinkError: The socket is forced and this one cannot be used.
        """
        shard, old, connection = welcome.shard, None, None
        with self._mutex:
            if self._closed or is_older(welcome.epoch, self._epochs.get(shard, 0)):
                return
            self._epochs[shard] = welcome.epoch
            self._shards.add(shard)
            line = self._lines.get(shard)
            if line is None or line.name != welcome.shared:
                old = self._lines.pop(shard, None)
                line = None
                if welcome.shared:
                    line = self._lines[shard] = SocketLine(
                        shard,
                        welcome.shared,
                        welcome.shared_nonce,
                        self._greeting,
                        partial(self._behind.away, shard),
                    )
        if old is not None:
            old.close()
        if line is not None:
            # The connection is open before the first call, so the kernel can report the end of our
            # process.
            connection = self.tried(line, line.take)
            if connection is not None:
                line.give_back(connection)
        if self._forced and (line is None or connection is None):
            self._refuse_if_there(welcome, line)
        for feed in list(self._feeds.values()):
            feed.settle()

    def tried(
        self, line: SocketLine, open_one: Callable[[], Connection | None]
    ) -> Connection | None:
        """Return what `open_one` opens on a line; retried if the socket is forced."""
        for _ in range(FORCED_TRIES if self._forced else 1):
            line.try_again()
            connection = open_one()
            if connection is not None:
                return connection
        return None

    def _refuse_if_there(self, welcome: Welcome, line: SocketLine | None) -> None:
        """Raise if the shard that sent a WELCOME still runs; otherwise its socket ended with it."""
        shard, problem = welcome.shard, line.problem if line is not None else "it offers none"
        if not problem:
            return
        answer = self._behind.request(shard, Ping(), timeout_s=THERE_S)
        if isinstance(answer, Pong) and answer.epoch == welcome.epoch:
            raise LinkError(
                f"a socket is required (ENACT_CARRIER=socket), but that of shard {shard} cannot"
                f" be used: {problem}"
            )

    def transport_of(self, shard: str) -> str:
        """Return how calls to a shard travel now, for people: "socket" or "zenoh (why)"."""
        line = self._lines.get(shard)
        if line is None:
            known = shard in self._epochs
            return f"zenoh (the shard {'offers no socket' if known else 'has not welcomed us yet'})"
        return f"zenoh ({line.problem})" if line.problem else "socket"

    def add_endpoints(self, entries: Sequence[ShardEntry]) -> None:
        """Connect to all further shards that can be reached; existing connections stay.

        Raises:
            ConfigError: An endpoint cannot be read.
            LinkError: Some cannot be connected; the message gives the reasons.
            MisuseError: The carrier is closed or was opened before a fork.
        """
        self._check_usable()
        try:
            self._behind.add_endpoints(entries)
        finally:
            self._shards.update(entry.name for entry in entries)
            for feed in list(self._feeds.values()):
                feed.settle()

    def away(self, shard: str) -> bool:
        """Whether a shard is out of reach over Zenoh and over any socket tried so far."""
        line = self._lines.get(shard)
        return (line is None or bool(line.problem)) and self._behind.away(shard)

    def on_reconnect(self, returned: Callable[[str], None]) -> None:
        """Call `returned` with the name of each shard that comes (back) within reach."""
        lines = self._lines

        def told(shard: str) -> None:
            line = lines.get(shard)
            if line is not None:
                line.try_again()
            returned(shard)

        self._behind.on_reconnect(told)

    def endpoint_of(self, shard: str) -> str:
        """Return the shard's expected endpoint, for messages to people."""
        return self._behind.endpoint_of(shard)

    def reason_away(self, shard: str) -> str:
        """Return why a shard's certificate or ours is refused; empty if that is not the reason."""
        return self._behind.reason_away(shard)

    # ---------------------------------------------------------------- notices

    def subscribe(self, interest: Survey | None = None) -> NoticeQueue:
        """Open a feed of the notices of all shards, including shards added later."""
        self._check_usable()
        queue = NoticeQueue(interest)
        if interest is not None:
            queue.late_s = LATE_S
        feed = SocketFeed(self, queue, interest)
        queue.on_close = lambda: self._unsubscribe(queue)
        self._feeds[queue] = feed
        feed.settle()
        return queue

    def _unsubscribe(self, queue: NoticeQueue) -> None:
        feed = self._feeds.pop(queue, None)
        if feed is not None and self._pid == os.getpid():
            feed.close()

    def lines(self) -> tuple[set[str], dict[str, SocketLine]]:
        """Return the known shards, and the lines of those that have one."""
        return set(self._shards), dict(self._lines)

    @property
    def behind(self) -> ZenohCarrier:
        """The carrier that reaches every shard."""
        return self._behind

    # ---------------------------------------------------------------- end

    def close(self) -> None:
        """End all connections and pending calls (they return None); idempotent."""
        if self._closed or self._pid != os.getpid():
            return
        with self._mutex:
            self._closed = True
        for queue in list(self._feeds):
            queue.close()
        for line in self._lines.values():
            line.close()
        self._behind.close()

    def abandon(self) -> None:
        """Make a forked child forget the parent's connections."""
        for line in self._lines.values():
            line.abandon()


class _Begun:
    """A request that was sent over a connection."""

    __slots__ = ("_connection", "_line")

    def __init__(self, line: SocketLine, connection: Connection) -> None:
        self._line = line
        self._connection = connection

    def wait(self, into: memoryview | None = None) -> Answer | None:
        """Return the answer, or None if none will come."""
        return _received(self._line, self._connection, into)

    def abandon(self) -> None:
        """Discard the connection and the answer with it."""
        self._line.drop(self._connection)


def _received(
    line: SocketLine,
    connection: Connection,
    into: memoryview | None = None,
    *,
    interrupt: threading.Event | None = None,
) -> Answer | None:
    """Return the answer on a connection, or None if none will come."""
    try:
        if interrupt is not None:
            connection.wait(interrupt)
        answer = connection.receive(into)
    except BlockingIOError:  # the time is over
        line.drop(connection)
        return None
    except (EOFError, OSError):
        line.lost(connection)
        return None
    except BaseException:  # an interrupt, too
        line.drop(connection)
        raise
    line.idle.append(connection)
    if line.closed or len(line.idle) > IDLE_MAX:
        line.settle(connection)
    return answer


def _after_fork() -> None:
    for carrier in list(_open):
        carrier.abandon()


os.register_at_fork(after_in_child=_after_fork)
