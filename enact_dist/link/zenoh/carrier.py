"""The carrier between processes and hosts: one Zenoh query per request.

A client has one Zenoh session per destination: the given endpoints, and each shard that it learns
of later, because a running session accepts no new endpoints.  Each session carries the client's
liveliness token, so each shard sees the token over its own link, as long as that link lives.
Sessions share their threads; one more costs 0.3 MB.

Rules that a change must keep:

- Channels only, no Python callbacks: a library that holds the interpreter lock for half a minute
  would stall Zenoh's receiving thread, and with it the token (measured).
- Control calls have a high priority, data a lower one, and slices a separate connection
  (`_Link.bulk`), so that a keep-alive never queues behind a mesh.  Until that is connected, slices
  are requested with DROP, which their answers inherit: a slow reader then loses an answer instead
  of the connection with its token.
- Two replies to one query mean two daemons with one name: that is an error.
"""

from __future__ import annotations

import logging
import os
import threading
import time
from collections import deque
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Final

import zenoh

from enact_dist.core.protocol.messages import ListPlaces, Notice
from enact_dist.errors import ProtocolError, ShardUnreachableError
from enact_dist.link.carrier import check_usable, failure_of
from enact_dist.link.memory.maps import recycle_blocks
from enact_dist.link.notices import NoticeQueue
from enact_dist.link.zenoh.access import barred
from enact_dist.link.zenoh.config import (
    OPEN_S,
    QUEUED_MAX,
    close_session,
    keep_after_fork,
    open_session,
)
from enact_dist.link.zenoh.queries import (
    QUESTION,
    ServerNames,
    ShardPresence,
    answer_in,
    bytes_of,
    next_reply,
    send_query,
    wait_connected,
)
from enact_dist.link.zenoh.tls import why_refused
from enact_dist.wire.frames import decode_frame
from enact_dist.wire.keys import ANY, NAMELESS, notice_key, request_key, token_key, verb_of

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from enact_dist.core.protocol.messages import Answer, Request, ShardEntry, Survey
    from enact_dist.link.carrier import Begun
    from enact_dist.link.zenoh.queries import Replies
    from enact_dist.link.zenoh.tls import KeyFiles

_log = logging.getLogger("enact.link")
FETCH_BYTES: Final = 1 << 20
"""Slices of this size delay the answers to other clients by only a few ms."""
CONNECT_S: Final = 5.0
"""How long opening a carrier waits for a first connection."""
REACH_S: Final = 0.3
"""How long a shard may take to show that it is already within reach."""
JOIN_S: Final = 1.0
"""How long an ending carrier or feed waits for each of its threads."""
UNCHECKED_MAX: Final = 256
"""Answered queries that are still watched for a second reply."""


class _Link:
    """One Zenoh session with the client's token, and a second connection for slices of data.

    Zenoh sends urgent messages first, but cannot take back data that it has passed to the kernel:
    on a slow network a keep-alive would wait behind everything in the socket.  With a separate
    connection for slices it waits for nothing.  The slice connection may block, which slows the
    sender to the speed of the network and loses no slice; it may even be closed when its reader
    stalls, since token and calls use the other one.  It opens with the first transfer, takes 3 ms,
    and reconnects by itself.

    Attributes:
        session: Carries calls and the token.
        names: Checks the names of the shards that answer, in a cell with keys.
    """

    def __init__(
        self,
        endpoints: tuple[str, ...],
        token: str,
        lease_s: float,
        open_s: float,
        keys: KeyFiles | None,
    ) -> None:
        self.endpoints = endpoints
        self._open = partial(
            open_session, connect=endpoints, lease_s=lease_s, open_s=open_s, keys=keys
        )
        self._mutex = threading.Lock()
        self._closed = False
        self._bulk: zenoh.Session | None = None
        self.session = self._open()
        self.names = ServerNames(self.session) if keys is not None else None
        self._token = self.session.liveliness().declare_token(token)
        keep_after_fork(self)

    def bulk(self) -> zenoh.Session | None:
        """Return the session for slices; None while it is not connected."""
        session = self._bulk
        if session is None:
            with self._mutex:
                if self._bulk is None and not self._closed:
                    recycle_blocks()
                    self._bulk = self._open()
                session = self._bulk
        return session if session is not None and session.info.peers_zid() else None

    def end(self) -> None:
        """Close both sessions and end all calls on them."""
        with self._mutex:
            self._closed = True
        if self._bulk is not None:
            close_session(self._bulk)
        self._token.undeclare()  # type: ignore[no-untyped-call]  # as in Zenoh's stub
        close_session(self.session)


@dataclass(frozen=True, slots=True)
class _Pump:
    """One subscription and the thread that moves its notices into a feed."""

    subscriber: zenoh.Subscriber[zenoh.Handler[zenoh.Sample]]
    thread: threading.Thread


class Inside:
    """Counts the threads inside Zenoh, so that shutdown can wait for them."""

    __slots__ = ("_changed", "_count")

    def __init__(self) -> None:
        self._changed = threading.Condition(threading.Lock())
        self._count = 0

    def __enter__(self) -> None:
        with self._changed:
            self._count += 1

    def __exit__(self, *_: object) -> None:
        with self._changed:
            self._count -= 1
            if not self._count:
                self._changed.notify_all()

    def wait_empty(self, timeout_s: float) -> bool:
        """Wait until no thread is inside; return whether that happened in time."""
        with self._changed:
            return self._changed.wait_for(lambda: not self._count, timeout_s)


class ZenohCarrier:
    """Reaches the shards of a cell over Zenoh.  See `Carrier` for the methods; thread-safe.

    Attributes:
        inside: False: no shard runs in this process.
        fetch_bytes: The largest slice of a datum that one call requests, in bytes.

    Args:
        cell: The cell's name.
        session: Whose liveliness token is held for the life of the carrier.
        identity: The sender; part of the key of every request and of the token.
        endpoints: Endpoints to connect to first; one that answers is enough.
        ttl_s: The session's lease; a link counts as lost after half of it.
        connect_s: How long to wait for the first connection.
        open_s: How long a shard may take to answer a connection; closing waits for pending ones.
        keys: The files by which this process proves its name, in a cell with keys.

    Raises:
        ShardUnreachableError: No endpoint could be connected.
        ConfigError: An endpoint cannot be read, or the keys for one cannot be used.
        MisuseError: This process was forked from one that is connected.
    """

    def __init__(
        self,
        cell: str,
        session: str,
        identity: str,
        endpoints: Sequence[str],
        *,
        ttl_s: float,
        connect_s: float = CONNECT_S,
        open_s: float = OPEN_S,
        keys: KeyFiles | None = None,
    ) -> None:
        self.inside = False
        self.fetch_bytes = FETCH_BYTES
        self._cell = cell
        self._session = session
        self._identity = identity
        self._lease_s = ttl_s / 2
        self._open_s = open_s
        self._keys = keys
        self._pid = os.getpid()
        self._closed = False
        self._mutex = threading.Lock()
        self._inside = Inside()
        self._links: list[_Link] = []
        self._link_of: dict[str, _Link] = {}
        self._endpoints_of: dict[str, tuple[str, ...]] = {}
        self._feeds: dict[NoticeQueue, list[_Pump]] = {}
        self._presences: dict[str, ShardPresence] = {}
        self._returned: Callable[[str], None] = lambda _: None
        self._unchecked: deque[Replies] = deque(maxlen=UNCHECKED_MAX)
        keep_after_fork(self)
        first = self._open_link(tuple(endpoints))
        if not wait_connected(first.session, connect_s):
            self.close()
            refused = why_refused(endpoints, keys)
            raise ShardUnreachableError(
                f"no shard answers at {', '.join(endpoints)} (waited {connect_s:g} s); "
                + (refused or "is the shard running there? (enact shard run, enact doctor)"),
                endpoint=", ".join(endpoints),
            )

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

        A thread that waits inside Zenoh cannot look at `interrupt`.
        """
        del interrupt
        return self.request_all(((shard, message),), timeout_s=timeout_s)[0]

    def request_all(
        self, requests: Sequence[tuple[str, Request]], *, timeout_s: float
    ) -> list[Answer | None]:
        """Send all requests before waiting for the first answer; answers in the same order."""
        with self._inside:
            self._check_usable()
            sent = [(shard, self._send(shard, message, timeout_s)) for shard, message in requests]
            for _ in sent:
                self._check_answered_once()
            return [self._receive(shard, replies) for shard, replies in sent]

    def _send(self, shard: str, message: Request, timeout_s: float) -> Replies | None:
        session, key = self._link_to(shard).session, self._key(shard, message)
        return send_query(session, key, message, timeout_s=timeout_s)

    def begin(self, shard: str, message: Request, *, timeout_s: float) -> Begun:
        """Send the request for one slice; the caller awaits its answer later."""
        with self._inside:
            self._check_usable()
            link = self._link_to(shard)
            bulk = link.bulk()
            replies = send_query(
                bulk or link.session,
                self._key(shard, message),
                message,
                timeout_s=timeout_s,
                priority=zenoh.Priority.DATA_LOW,
                drop=bulk is None,
            )
            return _Begun(partial(self._wait, shard, replies))

    def _wait(self, shard: str, replies: Replies | None) -> Answer | None:
        with self._inside:
            self._check_answered_once()
            return self._receive(shard, replies)

    def _link_to(self, shard: str) -> _Link:
        return self._link_of.get(shard) or self._links[0]

    def _key(self, shard: str, message: Request) -> str:
        return request_key(self._cell, shard, verb_of(message), self._identity)

    def _receive(self, shard: str, replies: Replies | None) -> Answer | None:
        sample = next_reply(replies, self._link_to(shard).names, shard)
        if replies is None or sample is None:
            return None
        self._unchecked.append(replies)
        return answer_in(sample, shard)

    def _check_answered_once(self) -> None:
        """Check whether an earlier query got a second reply; called while a query is in flight."""
        try:
            earlier = self._unchecked.popleft()
        except IndexError:
            return
        try:
            second = earlier.try_recv()
        except zenoh.ZError:  # ended, as expected
            return
        if second is not None and second.ok is not None:
            key = str(second.ok.key_expr)
            _log.warning("two answers to one request: %s", key)
            raise ProtocolError(
                f"two daemons answer as one shard ({key}); stop one of them (enact shard ls)"
            )

    def _check_usable(self) -> None:
        check_usable(self._pid, closed=self._closed)

    # ---------------------------------------------------------------- links

    def add_endpoints(self, entries: Sequence[ShardEntry]) -> None:
        """Connect to all further shards that can be reached; existing connections stay."""
        self._check_usable()
        failures: dict[str, Exception] = {}
        for name, endpoints in entries:
            self._endpoints_of[name] = endpoints
            try:
                if endpoints:
                    self._connect(name, endpoints)
            except Exception as error:  # noqa: BLE001 - the next one can be connected
                self._check_usable()
                failures[name] = error
        if failures:
            raise failure_of(failures)

    def _connect(self, name: str, endpoints: tuple[str, ...]) -> None:
        if name not in self._link_of:
            reaching = self._link_reaching(name, endpoints)
            self._link_of[name] = reaching or self._open_link(endpoints)
        if name not in self._presences:
            session, key = self._link_of[name].session, self._key(name, QUESTION)
            returned = partial(self._report_return, name)
            self._presences[name] = ShardPresence(session, key, returned)

    def _link_reaching(self, shard: str, endpoints: Sequence[str]) -> _Link | None:
        """Return the link that already reaches `shard`, perhaps at another of its addresses."""
        for link in self._links:
            if set(link.endpoints) & set(endpoints):
                return link
        if len(self._links) == 1 and self.request(shard, QUESTION, timeout_s=REACH_S) is not None:
            return self._links[0]
        return None

    def _open_link(self, endpoints: tuple[str, ...]) -> _Link:
        token = token_key(self._cell, self._identity, self._session)
        link = _Link(endpoints, token, self._lease_s, self._open_s, self._keys)
        with self._mutex:
            late = self._closed  # closed by another thread while this link was opened
            if not late:
                self._links.append(link)
                for feed, pumps in self._feeds.items():
                    pumps.append(self._pump_into(feed, link))
        if late:
            link.end()
            self._check_usable()
        return link

    def transport_of(self, shard: str) -> str:
        """Return the transport, for people."""
        return "zenoh"

    def away(self, shard: str) -> bool:
        """Whether Zenoh reports a shard as out of reach."""
        presence = self._presences.get(shard)
        return presence is not None and not presence.here

    def on_reconnect(self, returned: Callable[[str], None]) -> None:
        """Call `returned` with the name of each shard that comes (back) within reach."""
        self._returned = returned

    def _report_return(self, shard: str) -> None:
        if not self._closed:
            self._returned(shard)

    def endpoint_of(self, shard: str) -> str:
        """Return the shard's expected endpoint, for messages to people."""
        endpoints = self._endpoints_of.get(shard) or self._links[0].endpoints
        return ", ".join(endpoints)

    def reason_away(self, shard: str) -> str:
        """Return why a shard's certificate or ours is refused; empty if that is not the reason."""
        if self._keys is None:
            return ""
        endpoints = self._endpoints_of.get(shard) or self._links[0].endpoints
        refused = why_refused(endpoints, self._keys, shard)
        return refused or (barred(self._keys.name, shard) if self._is_barred(shard) else "")

    def _is_barred(self, shard: str) -> bool:
        """Return whether a shard lets any key ping, but ends other queries of ours at once."""
        key = request_key(self._cell, shard, verb_of(QUESTION), NAMELESS)
        with self._inside:
            replies = send_query(self._link_to(shard).session, key, QUESTION, timeout_s=REACH_S)
            if next_reply(replies) is None:
                return False
        began_s = time.monotonic()
        answer = self.request(shard, ListPlaces(), timeout_s=REACH_S)
        return answer is None and time.monotonic() - began_s < REACH_S / 2

    # ---------------------------------------------------------------- notices

    def subscribe(self, interest: Survey | None = None) -> NoticeQueue:
        """Open a feed of the notices of all shards, including shards added later."""
        self._check_usable()
        feed = NoticeQueue(interest)
        feed.on_close = lambda: self.stop_feeding(feed)
        self.feed_into(feed)
        return feed

    def feed_into(self, feed: NoticeQueue) -> None:
        """Send the notices of all shards to `feed` too, which may have other sources."""
        with self._mutex:
            self._feeds[feed] = [self._pump_into(feed, link) for link in self._links]

    def _pump_into(self, feed: NoticeQueue, link: _Link) -> _Pump:
        subscriber = link.session.declare_subscriber(
            notice_key(self._cell, ANY), zenoh.handlers.RingChannel(QUEUED_MAX)
        )
        thread = threading.Thread(
            target=_pump, args=(subscriber.handler, feed), name="enact-notices", daemon=True
        )
        thread.start()
        return _Pump(subscriber, thread)

    def stop_feeding(self, feed: NoticeQueue) -> None:
        """Stop sending notices to `feed`."""
        with self._mutex:
            pumps = self._feeds.pop(feed, [])
        if self._pid != os.getpid():
            return
        for pump in pumps:
            if not self._closed:
                pump.subscriber.undeclare()  # type: ignore[no-untyped-call]  # as in Zenoh's stub
                pump.thread.join(JOIN_S)

    # ---------------------------------------------------------------- end

    def close(self) -> None:
        """End all connections and pending calls (they return None); idempotent."""
        if self._closed or self._pid != os.getpid():
            return
        with self._mutex:
            self._closed = True
        pumps = [pump for pumps in self._feeds.values() for pump in pumps]
        for feed in list(self._feeds):
            feed.close()
        for presence in list(self._presences.values()):
            presence.close(JOIN_S)
        for link in self._links:
            link.end()
        for pump in pumps:
            pump.thread.join(JOIN_S)
        # A thread that returns from Zenoh while the interpreter exits would abort the process.
        self._inside.wait_empty(JOIN_S)


class _Begun:
    """A query that was sent; `wait` brings its answer."""

    __slots__ = ("_wait",)

    def __init__(self, wait: Callable[[], Answer | None]) -> None:
        self._wait = wait

    def wait(self, into: memoryview | None = None) -> Answer | None:
        """Return the answer; Zenoh does not let callers provide the buffer."""
        return self._wait()

    def abandon(self) -> None:
        """Do nothing: an unread answer is freed with its handler."""


def _pump(notices: zenoh.Handler[zenoh.Sample], feed: NoticeQueue) -> None:
    """Move notices from Zenoh's channel into a feed until the subscription ends."""
    while True:
        try:
            sample = notices.recv()
        except zenoh.ZError:
            return
        try:
            message = decode_frame(bytes_of(sample.attachment), bytes_of(sample.payload))
        except Exception as error:  # noqa: BLE001 - the next one can be read
            _log.warning("cannot read a notice: %s", error)
            continue
        if isinstance(message, Notice):
            feed.put(message)
