"""Serves one `ShardHost` over Zenoh: receives requests, sends answers and notices, watches tokens.

One queryable receives everything, and one thread takes it all from Zenoh's channel, so the messages
of one client keep their order.  That thread first empties the channel and then serves the clients
in turn (`Turns`), so that a client with a thousand requests delays the others by only one.  It
decodes a query, lets the host decide and sends the answer itself; `Senders` passes it to a thread
of the client only if sending might block.

Here a client is the identity in the keys of its requests.  All clients without a session share one
turn, so that a crowd of newcomers delays the others by one request.  A hostile program gets as many
turns as it opens sessions under different identities.

In a cell with keys, Zenoh's access rules bind the name in an identity to the sender's certificate
(`link.zenoh.access`).  So a request uses the rights of that name, and a hello must say it.

A query is answered once and then dropped; a query dropped without an answer means *unknown* to the
client.  An unreadable frame is refused and counted, and has no other effect.
"""

from __future__ import annotations

import logging
import queue
import threading
import time
from functools import partial
from typing import TYPE_CHECKING, Final, NamedTuple

import zenoh

from enact_dist.core.protocol.messages import (
    PERMISSION,
    PROTOCOL,
    Answer,
    Fetch,
    Hello,
    Ping,
    Refused,
    Request,
    Stage,
)
from enact_dist.core.protocol.records import SessionSeen
from enact_dist.core.shard.owners import named_session
from enact_dist.errors import EnactError, PermissionDeniedError, ProtocolError
from enact_dist.link.answers import encoded, size_of
from enact_dist.link.memory.maps import recycle_blocks
from enact_dist.link.zenoh.access import refuse_other_name
from enact_dist.link.zenoh.config import QUEUED_MAX, keep_after_fork
from enact_dist.link.zenoh.fairness import Senders, Turns
from enact_dist.link.zenoh.queries import bytes_of
from enact_dist.wire.frames import decode_request, encode_frame
from enact_dist.wire.keys import (
    ANY,
    name_in,
    notice_key,
    parse_request_key,
    queryable_key,
    request_key,
    token_key,
    token_of,
    verb_of,
)

if TYPE_CHECKING:
    from enact_dist.core.protocol.messages import Notice
    from enact_dist.link.host import ShardHost

_log = logging.getLogger("enact.link")
DATA_SUFFIX: Final = "/data"
"""Slices to a client are counted and queued apart from its other answers."""
_NOTICES: Final = "@notices"
"""Represents all watchers together among the clients of `Senders`."""
NEWCOMERS: Final = "@newcomers"
"""Represents all identities without a session together among the clients of `Turns`."""
STAGED_BYTES_MAX: Final = 256 << 20
"""Bytes of slices that wait to be stored: 32 transfers; a client asks again for a lost one."""
PULLED_MAX: Final = 256
"""Queries that are taken from Zenoh's channel between two turns: 1 ms."""
DRAIN_S_MAX: Final = 0.5
"""Longest wait of a tick for requests that arrived before it; too short to stall the timer."""
DRAIN_STEP_S: Final = 0.001
"""How long a tick waits for a query that was just taken from the channel."""
OVERHEAD_BYTES: Final = 1024
"""Overhead that each waiting query adds to the size of its data."""
LOGGED_MAX: Final = 1_000
"""Number of clients with dropped requests that the log names, each once."""
SHOWN_CHARACTERS: Final = 200
"""Logged length of a client's name."""
JOIN_S: Final = 0.5
"""How long a closing service waits for each of its threads."""


class ZenohService:
    """Serves one shard on a Zenoh session, which it does not close.

    Args:
        host: The shard.
        session: Where it listens.
        cell: Name of the cell.
        proven: Whether certificates prove the names of clients.

    Attributes:
        count: Adds to a counter of the shard.
        present: The tokens that are there: a session, and the identity that says it is there.
    """

    def __init__(
        self, host: ShardHost, session: zenoh.Session, cell: str, *, proven: bool = False
    ) -> None:
        self._host = host
        self._cell = cell
        self._proven = proven
        self.count = host.count
        self.senders = Senders(host.count)
        self._closed = False
        self.present: set[tuple[str, str]] = set()
        keep_after_fork(self)
        recycle_blocks()
        self._publisher = session.declare_publisher(
            notice_key(cell, host.name), congestion_control=zenoh.CongestionControl.DROP
        )
        self._unwatch = host.watch(self._publish)
        self._tokens = session.liveliness().declare_subscriber(
            token_key(cell, ANY, ANY), zenoh.handlers.FifoChannel(QUEUED_MAX), history=True
        )
        self._token_events: zenoh.Handler[zenoh.Sample] = self._tokens.handler
        self._declare = partial(
            session.declare_queryable,
            queryable_key(cell, host.name),
            zenoh.handlers.FifoChannel(QUEUED_MAX),
            complete=True,
        )
        self._queryable: zenoh.Queryable[zenoh.Handler[zenoh.Query]] | None = None
        self._serving = threading.Lock()
        self._turns = Turns[_Arrived]()
        self._logged: set[str] = set()
        self._resting = True
        self._drained: threading.Event | None = None
        self._marked: threading.Event | None = None
        self._mark = self._left = 0
        self._remove_inbox = host.add_inbox(self.drain_inbox)
        self._staged: queue.SimpleQueue[tuple[Stage, _Call, str] | tuple[()] | None] = (
            queue.SimpleQueue()
        )
        self._staged_mutex = threading.Lock()
        self._staged_bytes = 0
        self._threads = [
            threading.Thread(target=run, name=name, daemon=True)
            for name, run in (("enact-stage", self._stage), ("enact-tokens", self._watch_tokens))
        ]
        for thread in self._threads:
            thread.start()
        self._dispatcher: threading.Thread | None = None
        self.serve()

    # ---------------------------------------------------------------- requests

    def serve(self) -> None:
        """Take requests, after `withdraw` again; idempotent."""
        with self._serving:
            if self._closed or self._queryable is not None:
                return
            if self._dispatcher is not None:
                self._dispatcher.join()
            self._queryable = self._declare()
            # The handlers, not their owners: owners cannot be undeclared while a thread waits on
            # them, and afterwards have no handler for a thread that starts late.
            self._inbox: zenoh.Handler[zenoh.Query] = self._queryable.handler
            self._dispatcher = threading.Thread(
                target=self._dispatch, name="enact-dispatch", daemon=True
            )
            self._dispatcher.start()

    def withdraw(self) -> bool:
        """Take no requests, so that clients ask another daemon; whether it took some before.

        Clients stay connected, and so do their tokens: sessions and locks stay.
        """
        with self._serving:
            queryable, self._queryable = self._queryable, None
            if queryable is not None:
                queryable.undeclare()  # type: ignore[no-untyped-call]  # untyped in its stub
            return queryable is not None

    def _dispatch(self) -> None:
        """Serve the clients in turn until the queryable ends."""
        turns = self._turns
        try:
            while True:
                if self._pull():
                    self._mark_drain()
                if not turns:
                    self._rest()
                number, arrived = turns.take()
                self._take(arrived)
                if number < self._mark and self._left:
                    self._left -= 1
                    if not self._left:
                        self._end_drain(self._marked)
        except zenoh.ZError:
            if self._queryable is not None:
                _log.critical("shard %s: its queryable ended unexpectedly", self._host.name)
        finally:
            self._resting = True
            while turns:
                turns.take()[1].query.drop()  # type: ignore[no-untyped-call]  # untyped in its stub

    def _rest(self) -> None:
        """Wait for the next query: the channel was empty, so no tick waits."""
        self._resting = True
        self._end_drain(self._drained)
        query = self._inbox.recv()
        self._resting = False
        self._arrived(query)

    def _pull(self) -> bool:
        """Queue the arrived queries for their turns; return whether these were all."""
        try_recv = self._inbox.try_recv
        for _ in range(PULLED_MAX):
            query = try_recv()
            if query is None:
                self.senders.new_burst()
                return True
            self._arrived(query)
        return False

    def _mark_drain(self) -> None:
        """Record which queries a waiting tick waits for: all that are here now."""
        drained = self._drained
        if drained is not None and drained is not self._marked:
            self._marked, self._mark, self._left = drained, self._turns.put_count, len(self._turns)

    def _arrived(self, query: zenoh.Query) -> None:
        header, payload, key = query.attachment, query.payload, str(query.key_expr)
        size = OVERHEAD_BYTES
        if header is not None:
            size += len(header)
        if payload is not None:
            size += len(payload)
        arrived = _Arrived(query, key, header, payload, self.senders.burst)
        client = key.rpartition("/")[2]
        if not self._host.knows(client):
            client = NEWCOMERS
        if not self._turns.put(client, size, arrived):
            query.drop()  # type: ignore[no-untyped-call]  # untyped in its stub
            self._dropped(client)

    def _dropped(self, client: str) -> None:
        """Count a request that did not fit; log each client once."""
        self._host.count("requests_dropped")
        client = client[:SHOWN_CHARACTERS]
        if client not in self._logged and len(self._logged) < LOGGED_MAX:
            self._logged.add(client)
            _log.warning(
                "shard %s: too many requests from %s, or from all clients, are waiting; some were"
                " dropped, and further ones are only counted",
                self._host.name,
                client,
            )

    def drain_inbox(self) -> None:
        """Wait until all arrived requests are submitted; called by the timer before a tick.

        The dispatcher submits them, so that each client's requests keep their order.
        """
        drained = self._drained = threading.Event()
        end_s = time.monotonic() + DRAIN_S_MAX
        while not drained.wait(DRAIN_STEP_S):
            # A dispatcher that still rests found the channel empty, and nothing came since.
            if self._resting or self._closed or time.monotonic() > end_s:
                return

    def _end_drain(self, drained: threading.Event | None) -> None:
        if drained is not None:
            drained.set()
            if self._drained is drained:
                self._drained = None

    def _take(self, arrived: _Arrived) -> None:
        query, key, header, payload, burst = arrived
        try:
            message = decode_request(bytes_of(header), bytes_of(payload))
            cell, shard, verb, identity = parse_request_key(key)
            if verb != verb_of(message):
                raise ProtocolError(f"a {verb_of(message)} arrived on the key of a {verb}")
            if self._proven and type(message) is Hello:
                refuse_other_name(message.actor, identity, message.session)
            if (ANY in cell or ANY in shard) and type(message) is not Ping:
                raise ProtocolError(
                    f"a {verb} was sent to several shards at once; only a ping may be"
                )
        except Exception as error:  # noqa: BLE001 - every query is answered
            if not isinstance(error, EnactError):
                # A bug in the decoder: a client that triggers it must not stop the dispatcher.
                _log.exception("a frame of %d bytes broke the decoder", len(header or b""))
            self._host.count("frames_refused")
            call = _Call(self, query, key)
            if _answerable(key):
                denied = isinstance(error, PermissionDeniedError)
                call(Refused(PERMISSION if denied else PROTOCOL, str(error)))
            else:
                call.drop()
            return
        client = named_session(message) or key
        if type(message) in _SLICES:
            client += DATA_SUFFIX
        self.senders.heard(client, burst)
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
        """Store slices of large data, in a thread: making room, and files ahead, takes time."""
        while (staged := self._staged.get()) is not None:
            if staged:
                self._submit(*staged)
                with self._staged_mutex:
                    self._staged_bytes -= staged[0].body.size
            self._host.payloads.make_ahead()

    def _submit(self, message: Request, call: _Call, identity: str) -> None:
        try:
            subject = name_in(identity) if self._proven else None
            self._host.submit(message, call, identity, subject)
        except Exception:  # noqa: BLE001 - these threads serve all clients
            _log.exception("a %s could not be handled", type(message).__name__)
            call.drop()
        if self._host.payloads.wants_ahead:
            self._staged.put(())

    def reply_key(self, query: zenoh.Query) -> zenoh.KeyExpr | str:
        """Return the answer's key: the query's own, unless that addressed every shard."""
        key = query.key_expr
        if ANY not in str(key):
            return key
        return request_key(self._cell, self._host.name, *str(key).split("/")[-2:])

    # ---------------------------------------------------------------- notices and tokens

    def _publish(self, notice: Notice) -> None:
        """Send a notice if there are watchers; Zenoh drops it for slow readers.

        Zenoh may wait 1 ms before it drops one message, but 2 s for a fragmented one.  A thread
        therefore sends such a long notice and whatever comes after it.
        """
        if not self._publisher.matching_status.matching:  # type: ignore[attr-defined]  # see its stub
            return
        self.senders.heard(_NOTICES)
        self.senders.send(_NOTICES, _Publication(self._publisher, *encode_frame(notice)))

    def _watch_tokens(self) -> None:
        """Report sessions' tokens to the host, until the subscription ends."""
        try:
            while True:
                sample = self._token_events.recv()
                identity, session = token_of(str(sample.key_expr))
                if session:
                    present = sample.kind == zenoh.SampleKind.PUT
                    (self.present.add if present else self.present.discard)((session, identity))
                    self._host.event(SessionSeen(session, present, identity))
        except zenoh.ZError:
            return

    def close(self) -> None:
        """Stop serving; idempotent."""
        if self._closed:
            return
        self._closed = True
        self._unwatch()
        self._remove_inbox()
        self.withdraw()
        self._tokens.undeclare()  # type: ignore[no-untyped-call]  # untyped in its stub
        self.senders.close()
        self._staged.put(None)
        for thread in (self._dispatcher, *self._threads):
            if thread is not None:
                thread.join(JOIN_S)


class _Arrived(NamedTuple):
    """A query that waits for its turn, and the burst of its arrival; see `Senders`."""

    query: zenoh.Query
    key: str
    header: zenoh.ZBytes | None
    payload: zenoh.ZBytes | None
    burst: int


class _Publication:
    """A notice to all watchers."""

    __slots__ = ("_header", "_payload", "_publisher", "size")

    def __init__(self, publisher: zenoh.Publisher, header: bytes, payload: bytes | None) -> None:
        self._publisher = publisher
        self._header = header
        self._payload = payload or b""
        self.size = len(self._header) + len(self._payload)

    def send(self) -> None:
        """Publish it; it is lost if the session is closed meanwhile."""
        try:
            self._publisher.put(self._payload, attachment=self._header)
        except zenoh.ZError as error:
            _log.warning("cannot send a notice: %s", error)

    def drop(self) -> None:
        """Do nothing: a watcher sees the gap in the numbers."""


class _Call:
    """One query until it is answered: the host's reply callback, and then the answer."""

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
        """Encode and send; the answer is lost if the connection has gone."""
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
        """Leave the client without an answer, which makes it repeat the request."""
        self._query.drop()  # type: ignore[no-untyped-call]  # untyped in its stub


def _answerable(key: str) -> bool:
    """Whether the answer to a query on this key can name the answering shard."""
    try:
        return bool(parse_request_key(key))
    except ProtocolError:
        return ANY not in key


_SLICES: Final = frozenset((Fetch, Stage))
