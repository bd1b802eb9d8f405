"""Serves one `ShardHost` over Zenoh: requests in, answers and notices out, tokens watched.

One queryable receives everything, so the messages of one client keep their order.  The thread that
takes a query from Zenoh's channel decodes it, lets the host decide and sends the answer itself;
`Senders` moves it to a thread of the client's own only where sending might block.

A query is answered once and then dropped; one that is dropped without an answer tells the client
*unknown*.  A frame that cannot be read is refused and counted, never followed by anything else.
"""

from __future__ import annotations

import logging
import threading
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, get_args

import zenoh

from enact_dist.core.messages import (
    Answer,
    Granted,
    Refused,
    Request,
    Slice,
    Surveyed,
    Viewed,
)
from enact_dist.core.records import SessionSeen
from enact_dist.errors import ProtocolError
from enact_dist.link.senders import Senders
from enact_dist.link.zenoh_config import QUEUED_MAX, keep_after_fork
from enact_dist.wire.frames import decode_frame, encode_frame
from enact_dist.wire.keys import (
    notice_key,
    queryable_key,
    request_key,
    session_of,
    token_key,
)

if TYPE_CHECKING:
    from enact_dist.core.messages import Notice, SlotState
    from enact_dist.link.host import ShardHost

_log = logging.getLogger("enact.link")
_REQUESTS: Final = frozenset(get_args(Request))
SURVEYED_BYTES: Final = 160
"""Estimated length of one slot in the answer to a `Survey`."""
JOIN_S: Final = 0.5
"""How long a closing service waits for each of its threads."""


class ZenohService:
    """One shard's face on one Zenoh session.  The session is not closed with the service."""

    def __init__(self, host: ShardHost, session: zenoh.Session, cell: str) -> None:
        self._host = host
        self._cell = cell
        self._senders = Senders(host.count)
        self._closed = False
        keep_after_fork(self)
        self._publisher = session.declare_publisher(
            notice_key(cell, host.name), congestion_control=zenoh.CongestionControl.DROP
        )
        self._unwatch = host.watch(self._publish)
        self._tokens = session.liveliness().declare_subscriber(
            token_key(cell, "*"), zenoh.handlers.FifoChannel(QUEUED_MAX), history=True
        )
        self._queryable = session.declare_queryable(
            queryable_key(cell, host.name), zenoh.handlers.FifoChannel(QUEUED_MAX), complete=True
        )
        # The handlers, not their owners: these cannot be undeclared while a thread waits on them.
        self._inbox: zenoh.Handler[zenoh.Query] = self._queryable.handler
        host.add_inbox(self.drain_inbox)
        self._threads = [
            threading.Thread(target=run, name=name, daemon=True)
            for name, run in (("enact-dispatch", self._dispatch), ("enact-tokens", self._see))
        ]
        for thread in self._threads:
            thread.start()

    # ---------------------------------------------------------------- requests

    def _dispatch(self) -> None:
        """Take queries until the queryable ends."""
        inbox, senders = self._inbox, self._senders
        try:
            while True:
                query = inbox.try_recv()
                if query is None:
                    senders.new_burst()
                    query = inbox.recv()
                self._take(query)
        except zenoh.ZError:
            if not self._closed:
                _log.critical("shard %s: its queryable ended by itself", self._host.name)

    def drain_inbox(self) -> None:
        """Take the queries that have arrived already; called from the timer before a tick."""
        try:
            while (query := self._inbox.try_recv()) is not None:
                self._take(query)
        except zenoh.ZError:
            return

    def _take(self, query: zenoh.Query) -> None:
        key = str(query.key_expr)
        client = key
        try:
            header, payload = query.attachment, query.payload
            message = decode_frame(
                bytes(header) if header is not None else b"",
                bytes(payload) if payload is not None else b"",
            )
            if type(message) not in _REQUESTS:
                raise ProtocolError(f"{type(message).__name__} is no request")
        except ProtocolError as error:
            self._host.count("frames_refused")
            self._answer(query, key, client, Refused("protocol", str(error)))
            return
        client = client_of(message) or key
        self._senders.heard(client)
        self._host.submit(message, lambda answer: self._answer(query, key, client, answer))

    def _answer(self, query: zenoh.Query, key: str, client: str, answer: Answer) -> None:
        if "*" in key:
            # Asked of every shard in reach, by a client that does not know our name yet.
            key = request_key(self._cell, self._host.name, *key.split("/")[-2:])
        self._senders.send(client, _Parcel(query, key, answer, size_of(answer)))

    # ---------------------------------------------------------------- notices and tokens

    def _publish(self, notice: Notice) -> None:
        """Send a notice; Zenoh drops it for whoever does not read."""
        header, payload = encode_frame(notice)
        try:
            self._publisher.put(payload or b"", attachment=header)
        except zenoh.ZError:
            self._host.count("notices_dropped")

    def _see(self) -> None:
        """Tell the host which sessions' tokens are there, until the subscription ends."""
        tokens = self._tokens.handler
        try:
            while True:
                sample = tokens.recv()
                session = session_of(str(sample.key_expr))
                if session:
                    present = sample.kind == zenoh.SampleKind.PUT
                    self._host.event(SessionSeen(session, present))
        except zenoh.ZError:
            return

    def close(self) -> None:
        """Take and send nothing more; twice is harmless."""
        if self._closed:
            return
        self._closed = True
        self._unwatch()
        self._queryable.undeclare()  # type: ignore[no-untyped-call]  # as Zenoh's stub has it
        self._tokens.undeclare()  # type: ignore[no-untyped-call]  # as Zenoh's stub has it
        self._senders.close()
        for thread in self._threads:
            thread.join(JOIN_S)


@dataclass(frozen=True, slots=True)
class _Parcel:
    """An answer and the query that it belongs to."""

    query: zenoh.Query
    key: str
    answer: Answer
    size: int

    def send(self) -> None:
        """Encode and send; a connection that has gone takes the answer with it."""
        try:
            header, payload = encode_frame(self.answer)
            self.query.reply(self.key, payload or b"", attachment=header)
        except (zenoh.ZError, ProtocolError) as error:
            _log.warning("answer %s not sent: %s", type(self.answer).__name__, error)
        finally:
            self.query.drop()  # type: ignore[no-untyped-call]  # as Zenoh's stub has it

    def drop(self) -> None:
        """Leave the client without an answer, which tells it to ask again."""
        self.query.drop()  # type: ignore[no-untyped-call]  # as Zenoh's stub has it


def client_of(message: Request) -> str:
    """Return the session that sent a request, or nothing where it does not say."""
    lock = getattr(message, "lock", None)
    return lock.session if lock is not None else getattr(message, "session", "")


def size_of(answer: Answer) -> int:
    """Estimate the length of an answer's data in bytes, without encoding it."""
    if isinstance(answer, Granted | Viewed):
        return sum(map(_size_of_state, answer.states))
    if isinstance(answer, Slice):
        return answer.body.size
    if isinstance(answer, Surveyed):
        return SURVEYED_BYTES * len(answer.states)
    return 0


def _size_of_state(state: SlotState) -> int:
    return SURVEYED_BYTES + (state.datum.size if state.datum is not None else 0)
