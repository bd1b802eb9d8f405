"""Serves one `ShardHost` over Zenoh: requests in, answers and notices out, tokens watched.

One queryable receives everything, so the messages of one client keep their order.  The thread that
takes a query from Zenoh's channel decodes it, lets the host decide and sends the answer itself;
`Senders` moves it to a thread of the client's own only where sending might block.

A query is answered once and then dropped; one that is dropped without an answer tells the client
*unknown*.  A frame that cannot be read is refused and counted, never followed by anything else.
"""

from __future__ import annotations

import logging
import queue
import threading
from typing import TYPE_CHECKING, Final

import zenoh

from enact_dist.core.messages import (
    Answer,
    Fetch,
    Ping,
    Refused,
    Request,
    Stage,
)
from enact_dist.core.owners import named_session
from enact_dist.core.records import SessionSeen
from enact_dist.errors import ProtocolError
from enact_dist.link.recycling import recycle_blocks
from enact_dist.link.senders import Senders, encoded, size_of
from enact_dist.link.zenoh_config import QUEUED_MAX, keep_after_fork
from enact_dist.wire.frames import decode_request, encode_frame
from enact_dist.wire.keys import (
    ANY,
    notice_key,
    parse_request_key,
    queryable_key,
    request_key,
    token_key,
    token_of,
    verb_of,
)

if TYPE_CHECKING:
    from enact_dist.core.messages import Notice
    from enact_dist.link.host import ShardHost

_log = logging.getLogger("enact.link")
DATA_SUFFIX: Final = "/data"
"""Slices of a client count, and wait, apart from its other answers."""
_NOTICES: Final = "@notices"
"""Stands for all watchers together among the clients of `Senders`."""
STAGED_BYTES_MAX: Final = 256 << 20
"""Bytes of slices that wait for their place: 32 transfers; a client asks again for a lost one."""
JOIN_S: Final = 0.5
"""How long a closing service waits for each of its threads."""


class ZenohService:
    """One shard's face on one Zenoh session.  The session is not closed with the service.

    Attributes:
        senders: Who sends the answers.
        count: Adds to a counter of the shard.
    """

    def __init__(self, host: ShardHost, session: zenoh.Session, cell: str) -> None:
        self._host = host
        self._cell = cell
        self.count = host.count
        self.senders = Senders(host.count)
        self._closed = False
        keep_after_fork(self)
        recycle_blocks()
        self._publisher = session.declare_publisher(
            notice_key(cell, host.name), congestion_control=zenoh.CongestionControl.DROP
        )
        self._unwatch = host.watch(self._publish)
        self._tokens = session.liveliness().declare_subscriber(
            token_key(cell, ANY, ANY), zenoh.handlers.FifoChannel(QUEUED_MAX), history=True
        )
        self._sights: zenoh.Handler[zenoh.Sample] = self._tokens.handler
        self._queryable = session.declare_queryable(
            queryable_key(cell, host.name), zenoh.handlers.FifoChannel(QUEUED_MAX), complete=True
        )
        # The handlers, not their owners: these cannot be undeclared while a thread waits on them,
        # and have no handler any more for a thread that begins when they are.
        self._inbox: zenoh.Handler[zenoh.Query] = self._queryable.handler
        host.add_inbox(self.drain_inbox)
        self._staged: queue.SimpleQueue[tuple[Stage, _Call, str] | None] = queue.SimpleQueue()
        self._staged_mutex = threading.Lock()
        self._staged_bytes = 0
        self._threads = [
            threading.Thread(target=run, name=name, daemon=True)
            for name, run in (
                ("enact-dispatch", self._dispatch),
                ("enact-stage", self._stage),
                ("enact-tokens", self._see),
            )
        ]
        for thread in self._threads:
            thread.start()

    # ---------------------------------------------------------------- requests

    def _dispatch(self) -> None:
        """Take queries until the queryable ends."""
        inbox, senders = self._inbox, self.senders
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
        header, payload = query.attachment, query.payload
        try:
            message = decode_request(
                bytes(header) if header is not None else b"",
                bytes(payload) if payload is not None else b"",
            )
            cell, shard, verb, identity = parse_request_key(str(query.key_expr))
            if verb != verb_of(message):
                raise ProtocolError(f"a {verb_of(message)} came on the key of a {verb}")
            if (ANY in cell or ANY in shard) and type(message) is not Ping:
                raise ProtocolError(f"a {verb} came to several shards at once; only a ping may")
        except Exception as error:  # noqa: BLE001 - every query is answered
            if not isinstance(error, ProtocolError):
                # A fault of the decoder: whoever found it must not make the shard deaf.
                _log.exception("a frame of %d bytes broke the decoder", len(header or b""))
            self._host.count("frames_refused")
            call = _Call(self, query, str(query.key_expr))
            if _answerable(str(query.key_expr)):
                call(Refused("protocol", str(error)))
            else:
                call.drop()
            return
        client = named_session(message) or str(query.key_expr)
        if type(message) in _SLICES:
            client += DATA_SUFFIX
        self.senders.heard(client)
        call = _Call(self, query, client)
        if type(message) is Stage:
            self._stage_later(message, call, identity)
        else:
            self._submit(message, call, identity)

    def _stage_later(self, message: Stage, call: _Call, identity: str) -> None:
        size = message.body.size
        with self._staged_mutex:
            full = self._staged_bytes and self._staged_bytes + size > STAGED_BYTES_MAX
            if not full:
                self._staged_bytes += size
        if full:
            self._host.count("slices_dropped")
            call.drop()
        else:
            self._staged.put((message, call, identity))

    def _stage(self) -> None:
        """Take the slices of large data to where they belong: making room for them takes time."""
        while (staged := self._staged.get()) is not None:
            self._submit(*staged)
            with self._staged_mutex:
                self._staged_bytes -= staged[0].body.size

    def _submit(self, message: Request, call: _Call, identity: str) -> None:
        try:
            self._host.submit(message, call, identity)
        except Exception:  # noqa: BLE001 - these threads serve all clients
            _log.exception("a %s was not taken", type(message).__name__)
            call.drop()

    def reply_key(self, query: zenoh.Query) -> zenoh.KeyExpr | str:
        """Return the key to answer under: the query's own, unless that asked every shard."""
        key = query.key_expr
        if ANY not in str(key):
            return key
        return request_key(self._cell, self._host.name, *str(key).split("/")[-2:])

    # ---------------------------------------------------------------- notices and tokens

    def _publish(self, notice: Notice) -> None:
        """Send a notice if anybody watches; Zenoh drops it for whoever does not read.

        Zenoh may wait 1 ms before it drops one message, but 2 s for one in several fragments: such
        a long notice, and whatever comes after it, is left to a thread.
        """
        if not self._publisher.matching_status.matching:  # type: ignore[attr-defined]  # see its stub
            return
        self.senders.heard(_NOTICES)
        self.senders.send(_NOTICES, _Publication(self._publisher, *encode_frame(notice)))

    def _see(self) -> None:
        """Tell the host which sessions' tokens are there, until the subscription ends."""
        try:
            while True:
                sample = self._sights.recv()
                identity, session = token_of(str(sample.key_expr))
                if session:
                    present = sample.kind == zenoh.SampleKind.PUT
                    self._host.event(SessionSeen(session, present, identity))
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
        self.senders.close()
        self._staged.put(None)
        for thread in self._threads:
            thread.join(JOIN_S)


class _Publication:
    """A notice on its way to all who watch."""

    __slots__ = ("_header", "_payload", "_publisher", "size")

    def __init__(self, publisher: zenoh.Publisher, header: bytes, payload: bytes | None) -> None:
        self._publisher = publisher
        self._header = header
        self._payload = payload or b""
        self.size = len(self._header) + len(self._payload)

    def send(self) -> None:
        """Publish it; a session that is closed meanwhile takes it with it."""
        try:
            self._publisher.put(self._payload, attachment=self._header)
        except zenoh.ZError as error:
            _log.warning("notice not sent: %s", error)

    def drop(self) -> None:
        """Do nothing: a watcher sees the gap in the numbers."""


class _Call:
    """One query on its way to its answer: the host's reply callback, and what is sent then."""

    __slots__ = ("_answer", "_client", "_query", "_service", "size")

    def __init__(self, service: ZenohService, query: zenoh.Query, client: str) -> None:
        self._service = service
        self._query = query
        self._client = client

    def __call__(self, answer: Answer) -> None:
        self._answer = answer
        self.size = size_of(answer)
        self._service.senders.send(self._client, self)

    def send(self) -> None:
        """Encode and send; a connection that has gone takes the answer with it."""
        query, answer = self._query, self._answer
        try:
            header, bodies = encoded(answer, self._service.count)
            payload = bytes(bodies[0]) if len(bodies) == 1 else b"".join(bodies)
            query.reply(self._service.reply_key(query), payload, attachment=header)
        except zenoh.ZError as error:
            _log.warning("answer %s not sent: %s", type(answer).__name__, error)
        finally:
            self.drop()

    def drop(self) -> None:
        """Leave the client without an answer, which tells it to ask again."""
        self._query.drop()  # type: ignore[no-untyped-call]  # as Zenoh's stub has it


def _answerable(key: str) -> bool:
    """Whether an answer to what came on this key can say who gives it."""
    try:
        return bool(parse_request_key(key))
    except ProtocolError:
        return ANY not in key


_SLICES: Final = frozenset((Fetch, Stage))
