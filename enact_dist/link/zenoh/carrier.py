"""The carrier between processes and hosts: one Zenoh query per request.

A client has one Zenoh session per destination: the given endpoints, and each shard that it learns
of later, because a running session accepts no new endpoints.  Each session carries the client's
liveliness token, so each shard sees the token over its own link, as long as that link lives.
Sessions share their threads; one more costs 0.3 MB.

Rules that a change must keep:

- Channels only, no Python callbacks: a library that holds the interpreter lock for half a minute
  would stall Zenoh's receiving thread, and with it the token (measured).
- Control calls have a high priority, data a lower one, and slices a separate connection
  (`link.zenoh.bulk`), so that a keep-alive never queues behind a mesh.  Until that is connected,
  slices are requested with DROP, which their answers inherit: a slow reader then loses an answer
  instead of the connection with its token.
- A query without a reply, or with the error "Timeout", is *unknown*.  Two replies to one query mean
  two daemons with one name: that is an error.
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

from enact_dist.core.protocol.messages import Answer, Commit, Notice, Ping, Prepare
from enact_dist.errors import ProtocolError, ShardUnreachableError
from enact_dist.link.carrier import check_usable, failure_of
from enact_dist.link.notices import NoticeQueue
from enact_dist.link.zenoh.bulk import BulkWay
from enact_dist.link.zenoh.config import (
    OPEN_S,
    QUEUED_MAX,
    close_session,
    keep_after_fork,
    open_session,
)
from enact_dist.link.zenoh.presence import Inside, ShardPresence
from enact_dist.wire.frames import decode_answer, decode_frame, encode_frame
from enact_dist.wire.keys import notice_key, request_key, token_key, verb_of

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from enact_dist.core.protocol.messages import Request, ShardEntry, Survey
    from enact_dist.link.carrier import Begun

_log = logging.getLogger("enact.link")
CONTROL_BYTES_MAX: Final = 16 << 10
"""Requests with more data than this leave the control priority to the others."""
FETCH_BYTES: Final = 1 << 20
"""Slices of this size delay the answers to other clients by only a few ms."""
CONNECT_S: Final = 5.0
"""How long opening a carrier waits for a first connection."""
POLL_S: Final = 0.005
"""How often a carrier being opened looks for a connection.  A session opens connected if its
shard is running, so the first look usually suffices; and no channel of Zenoh's Python binding,
which
would tell of a later connection, can be waited on for a limited time."""
REACH_S: Final = 0.3
"""How long a shard may take to show that it is already within reach."""
JOIN_S: Final = 1.0
"""How long an ending carrier or feed waits for each of its threads."""
UNCHECKED_MAX: Final = 256
"""Answered queries that are still watched for a second reply."""

QUESTION: Final = Ping()
"""The cheapest request: answered at once, changes nothing."""
_NONE = zenoh.ConsolidationMode.NONE
_BLOCK, _DROP = zenoh.CongestionControl.BLOCK, zenoh.CongestionControl.DROP
_CONTROL, _DATA, _BULK = (
    zenoh.Priority.INTERACTIVE_HIGH,
    zenoh.Priority.DATA,
    zenoh.Priority.DATA_LOW,
)


@dataclass(frozen=True, slots=True)
class _Link:
    """One Zenoh session of the carrier, with its token, which lives as long as this object."""

    session: zenoh.Session
    endpoints: tuple[str, ...]
    token: zenoh.LivelinessToken
    bulk: BulkWay


@dataclass(frozen=True, slots=True)
class _Pump:
    """One subscription and the thread that moves its notices into a feed."""

    subscriber: zenoh.Subscriber[zenoh.Handler[zenoh.Sample]]
    thread: threading.Thread


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

    Raises:
        ShardUnreachableError: No endpoint could be connected.
        ConfigError: An endpoint cannot be read.
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
    ) -> None:
        self.inside = False
        self.fetch_bytes = FETCH_BYTES
        self._cell = cell
        self._session = session
        self._identity = identity
        self._lease_s = ttl_s / 2
        self._open_s = open_s
        self._pid = os.getpid()
        self._closed = False
        self._mutex = threading.Lock()
        self._inside = Inside()
        self._links: list[_Link] = []
        self._link_of: dict[str, _Link] = {}
        self._endpoints_of: dict[str, tuple[str, ...]] = {}
        self._feeds: dict[NoticeQueue, list[_Pump]] = {}
        self._keys: dict[tuple[str, type], str] = {}
        self._presences: dict[str, ShardPresence] = {}
        self._returned: Callable[[str], None] = lambda _: None
        self._unchecked: deque[zenoh.Handler[zenoh.Reply]] = deque(maxlen=UNCHECKED_MAX)
        keep_after_fork(self)
        first = self._open_link(tuple(endpoints))
        if not wait_connected(first.session, connect_s):
            self.close()
            raise ShardUnreachableError(
                f"no shard answers at {', '.join(endpoints)} (waited {connect_s:g} s); is the shard"
                " running there? (enact shard run, enact doctor)",
                endpoint=", ".join(endpoints),
            )

    # ---------------------------------------------------------------- requests

    def request(self, shard: str, message: Request, *, timeout_s: float) -> Answer | None:
        """Send one request and return its answer, or None if none came in time.

        Raises:
            ProtocolError: An answer cannot be read, or two daemons answer for one shard.
            MisuseError: The carrier is closed or was opened before a fork.
        """
        with self._inside:
            self._check_usable()
            replies = self._send(shard, message, timeout_s)
            self._check_answered_once()
            return self._receive(shard, replies)

    def request_all(
        self, requests: Sequence[tuple[str, Request]], *, timeout_s: float
    ) -> list[Answer | None]:
        """Send all requests before waiting for the first answer; answers in the same order.

        Raises:
            ProtocolError: As `request`.
            MisuseError: As `request`.
        """
        with self._inside:
            self._check_usable()
            sent = [(shard, self._send(shard, message, timeout_s)) for shard, message in requests]
            for _ in sent:
                self._check_answered_once()
            return [self._receive(shard, replies) for shard, replies in sent]

    def _send(
        self, shard: str, message: Request, timeout_s: float
    ) -> zenoh.Handler[zenoh.Reply] | None:
        link = self._link_of.get(shard) or self._links[0]
        header, payload = encode_frame(message)
        priority = _CONTROL
        if isinstance(message, Commit | Prepare) and payload and len(payload) > CONTROL_BYTES_MAX:
            priority = _DATA
        return _asked(
            link.session,
            self._key(shard, message),
            header,
            payload,
            timeout_s=timeout_s,
            priority=priority,
            congestion=_BLOCK,
        )

    def begin(self, shard: str, message: Request, *, timeout_s: float) -> Begun:
        """Send the request for one slice; the caller awaits its answer later.

        Raises:
            ProtocolError: The request cannot be sent.
            MisuseError: As `request`.
        """
        with self._inside:
            self._check_usable()
            link = self._link_of.get(shard) or self._links[0]
            header, payload = encode_frame(message)
            session = link.bulk.session()
            replies = _asked(
                session or link.session,
                self._key(shard, message),
                header,
                payload,
                timeout_s=timeout_s,
                priority=_BULK,
                congestion=_DROP if session is None else _BLOCK,
            )
            return _Begun(partial(self._wait, shard, replies))

    def _wait(self, shard: str, replies: zenoh.Handler[zenoh.Reply] | None) -> Answer | None:
        with self._inside:
            self._check_answered_once()
            return self._receive(shard, replies)

    def _key(self, shard: str, message: Request) -> str:
        known = (shard, type(message))
        key = self._keys.get(known)
        if key is None:
            key = request_key(self._cell, shard, verb_of(message), self._identity)
            self._keys[known] = key
        return key

    def _receive(self, shard: str, replies: zenoh.Handler[zenoh.Reply] | None) -> Answer | None:
        if replies is None:
            return None
        try:
            sample = replies.recv().ok
        except zenoh.ZError:  # ended without a reply
            return None
        if sample is None:  # the error that stands for a timeout
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
        """Connect to all further shards that can be reached; existing connections stay.

        Raises:
            ConfigError: An endpoint cannot be read.
            LinkError: Some cannot be connected; the message gives the reasons.
            MisuseError: The carrier is closed or was opened before a fork.
        """
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
            told = partial(self._tell_returned, name)
            self._presences[name] = ShardPresence(session, key, told)

    def _link_reaching(self, shard: str, endpoints: Sequence[str]) -> _Link | None:
        """Return the link that already reaches `shard`, perhaps at another of its addresses."""
        for link in self._links:
            if set(link.endpoints) & set(endpoints):
                return link
        if len(self._links) == 1 and self.request(shard, QUESTION, timeout_s=REACH_S) is not None:
            return self._links[0]
        return None

    def _open_link(self, endpoints: tuple[str, ...]) -> _Link:
        session = open_session(connect=endpoints, lease_s=self._lease_s, open_s=self._open_s)
        token = session.liveliness().declare_token(
            token_key(self._cell, self._identity, self._session)
        )
        link = _Link(session, endpoints, token, BulkWay(endpoints, self._lease_s, self._open_s))
        with self._mutex:
            late = self._closed  # closed by another thread while this link was opened
            if not late:
                self._links.append(link)
                for feed, pumps in self._feeds.items():
                    pumps.append(self._pump_into(feed, link))
        if late:
            close_session(session)
            self._check_usable()
        return link

    def way_to(self, shard: str) -> str:
        """Return the transport, for people."""
        return "zenoh"

    def away(self, shard: str) -> bool:
        """Whether Zenoh reports a shard as out of reach."""
        presence = self._presences.get(shard)
        return presence is not None and not presence.here

    def tell_returns(self, returned: Callable[[str], None]) -> None:
        """Call `returned` with the name of each shard that comes (back) within reach."""
        self._returned = returned

    def _tell_returned(self, shard: str) -> None:
        if not self._closed:
            self._returned(shard)

    def endpoint_of(self, shard: str) -> str:
        """Return the shard's expected endpoint, for messages to people."""
        endpoints = self._endpoints_of.get(shard) or self._links[0].endpoints
        return ", ".join(endpoints)

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
            notice_key(self._cell, "*"), zenoh.handlers.RingChannel(QUEUED_MAX)
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
            link.bulk.close()
            link.token.undeclare()  # type: ignore[no-untyped-call]  # as in Zenoh's stub
            close_session(link.session)
        for pump in pumps:
            pump.thread.join(JOIN_S)
        # A thread that returns from Zenoh while the interpreter exits would abort the process.
        self._inside.wait_empty(JOIN_S)


def _asked(
    session: zenoh.Session,
    key: str,
    header: bytes,
    payload: bytes | None,
    *,
    timeout_s: float,
    priority: zenoh.Priority,
    congestion: zenoh.CongestionControl,
) -> zenoh.Handler[zenoh.Reply] | None:
    try:
        return session.get(
            key,
            payload=payload,
            attachment=header,
            timeout=max(timeout_s, 0.001),
            consolidation=_NONE,
            priority=priority,
            congestion_control=congestion,
        )
    except zenoh.ZError:  # closed meanwhile by another thread
        return None


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
            message = decode_frame(_bytes(sample.attachment), _bytes(sample.payload))
        except Exception as error:  # noqa: BLE001 - the next one can be read
            _log.warning("cannot read a notice: %s", error)
            continue
        if isinstance(message, Notice):
            feed.put(message)


def _bytes(payload: zenoh.ZBytes | None) -> bytes:
    """Copy out of Zenoh's buffer: keeping a small piece of it would pin 64 KiB."""
    return bytes(payload) if payload is not None else b""


def answer_in(sample: zenoh.Sample, shard: str) -> Answer:
    """Return the answer that a reply carries.

    Raises:
        ProtocolError: It cannot be read or is no answer.
    """
    return decode_answer(shard, _bytes(sample.attachment), _bytes(sample.payload))


def wait_connected(session: zenoh.Session, wait_s: float) -> bool:
    """Wait until the session has a peer; False if it has none after `wait_s`."""
    deadline_s = time.monotonic() + wait_s
    while not session.info.peers_zid():
        if time.monotonic() > deadline_s:
            return False
        time.sleep(POLL_S)
    return True
