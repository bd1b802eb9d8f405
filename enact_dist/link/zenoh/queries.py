"""Requests to shards as Zenoh queries, their answers, and whether a shard is there to answer.

A query without a reply, or with the error "Timeout", is *unknown*, never *not executed*.
"""

from __future__ import annotations

import contextlib
import threading
import time
from typing import TYPE_CHECKING, Final, cast

import zenoh

from enact_dist.core.protocol.messages import Commit, Ping, Prepare
from enact_dist.core.shard.owners import shard_identity
from enact_dist.errors import ShardUnreachableError
from enact_dist.link.zenoh.config import keep_after_fork
from enact_dist.link.zenoh.events import Events
from enact_dist.wire.frames import decode_answer, encode_frame

if TYPE_CHECKING:
    from collections.abc import Callable
    from typing import TypeAlias

    from enact_dist.core.protocol.messages import Answer, Request

    Replies: TypeAlias = zenoh.Handler[zenoh.Reply]

QUESTION: Final = Ping()
"""The cheapest request: answered at once, changes nothing."""
CONTROL: Final = zenoh.Priority.INTERACTIVE_HIGH
CONTROL_BYTES_MAX: Final = 16 << 10
"""Commits with more data than this leave the control priority to the others."""
POLL_S: Final = 0.005
"""Pause between two looks for a connection.  A session opens connected if its shard is running, so
the first look usually suffices; and no channel of Zenoh's Python binding, which would report a
later connection, can be waited on for a limited time.
"""
TIMEOUT_S_MIN: Final = 0.001


def send_query(
    session: zenoh.Session,
    key: str,
    message: Request,
    *,
    timeout_s: float,
    priority: zenoh.Priority = CONTROL,
    drop: bool = False,
) -> Replies | None:
    """Send a request; return its replies, or None if another thread has closed the session.

    Args:
        session: Where to send it.
        key: The key of the request.
        message: The request.
        timeout_s: How long to wait for an answer.
        priority: Its priority; large commits have that of data.
        drop: Whether Zenoh may drop the query, or its answer, for a slow reader.

    Raises:
        ProtocolError: The request cannot be sent.
    """
    header, payload = encode_frame(message)
    if isinstance(message, Commit | Prepare) and payload and len(payload) > CONTROL_BYTES_MAX:
        priority = zenoh.Priority.DATA
    congestion = zenoh.CongestionControl
    try:
        return session.get(
            key,
            payload=payload,
            attachment=header,
            timeout=max(timeout_s, TIMEOUT_S_MIN),
            consolidation=zenoh.ConsolidationMode.NONE,
            priority=priority,
            congestion_control=congestion.DROP if drop else congestion.BLOCK,
        )
    except zenoh.ZError:
        return None


def next_reply(
    replies: Replies | None, names: ServerNames | None = None, shard: str = ""
) -> zenoh.Sample | None:
    """Wait for a reply; return None if the query ended without one, or timed out.

    Raises:
        ShardUnreachableError: The reply comes from a server with another name.
    """
    if replies is None:
        return None
    try:
        reply = replies.recv()
    except zenoh.ZError:
        return None
    if names is not None:
        names.check(reply, shard)
    return reply.ok


class ServerNames:
    """Checks by certificates that answers on a session come from the shards that were asked.

    Every key of a cell may connect, so a shard's certificate must prove that shard's name, too.
    Each server is looked up once: the check of a further answer takes 1 us.
    """

    def __init__(self, session: zenoh.Session) -> None:
        self._session = session
        self._known: set[tuple[zenoh.ZenohId, str]] = set()

    def check(self, reply: zenoh.Reply, shard: str) -> None:
        """Check who has answered.

        Raises:
            ShardUnreachableError: The certificate of that server proves another name.
        """
        replier = reply.replier_id
        if replier is None or (replier.zid, shard) in self._known:
            return
        for link in self._session.info.links():
            if link.zid != replier.zid:
                continue
            expected, found = shard_identity(shard), link.auth_identifier
            if found != expected:
                raise ShardUnreachableError(
                    f"shard {shard} is out of reach: what answers in its name at {link.dst} has the"
                    f" certificate of {found}, not of {expected}; stop it, or correct the endpoints"
                    " in cell.toml",
                    shard=shard,
                    endpoint=str(link.dst),
                )
            self._known.add((replier.zid, shard))


def answer_in(sample: zenoh.Sample, shard: str) -> Answer:
    """Return the answer that a reply carries.

    Raises:
        ProtocolError: It cannot be read or is no answer.
    """
    return decode_answer(shard, bytes_of(sample.attachment), bytes_of(sample.payload))


def bytes_of(payload: zenoh.ZBytes | None) -> bytes:
    """Copy out of Zenoh's buffer: keeping a small piece of it would pin 64 KiB."""
    return bytes(payload) if payload is not None else b""


def wait_connected(session: zenoh.Session, wait_s: float) -> bool:
    """Wait until the session has a peer; False if it has none after `wait_s`."""
    deadline_s = time.monotonic() + wait_s
    while not session.info.peers_zid():
        if time.monotonic() > deadline_s:
            return False
        time.sleep(POLL_S)
    return True


class ShardPresence:
    """Reports when a shard comes (back) within reach of a session, so that callers need not poll.

    Zenoh reports when a queryable for a key appears: 7 to 12 ms after the daemon's `ready`,
    measured on a loopback, against up to a quarter of a TTL until the next keep-alive.  If it is
    not closed before its session, it leaks 15 kB (Zenoh 1.10).
    """

    def __init__(self, session: zenoh.Session, key: str, returned: Callable[[], None]) -> None:
        self._returned = returned
        self._mutex = threading.Lock()
        self._closed = False
        self._querier = session.declare_querier(key)
        self._events: Events[zenoh.MatchingStatus] = Events(
            "enact-presence", self._querier.declare_matching_listener, self._heard
        )
        keep_after_fork(self)

    @property
    def here(self) -> bool:
        """Whether the shard is within reach, as far as Zenoh knows."""
        with self._mutex:  # Zenoh's binding raises if one thread asks while another closes it
            if self._closed:
                return False
            try:
                # The actual type; Zenoh's stub differs.
                return cast("zenoh.MatchingStatus", self._querier.matching_status).matching
            except zenoh.ZError:  # the session is closed
                return False

    def _heard(self, _: zenoh.MatchingStatus) -> None:
        # If a shard leaves and returns at once, the event of its leaving may come last.
        if self.here:
            self._returned()

    def close(self, wait_s: float = 0.0) -> None:
        """Stop watching; wait up to `wait_s` for the thread that calls `returned`.  Idempotent."""
        with self._mutex:  # nor may two threads close it at once
            if not self._closed:
                self._closed = True
                with contextlib.suppress(zenoh.ZError):  # the session is closed
                    self._querier.undeclare()  # type: ignore[no-untyped-call]  # as in its stub
        self._events.join(wait_s)
