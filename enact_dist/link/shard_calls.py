"""Calls from shard to shard: what became of a prepared lock, and that one has committed.

Each other shard has a Zenoh session and a thread of its own, both made at the first call, so that
one that is down delays nobody.  A call is made once; whether it is made again the core decides.
Whoever submits never waits.
"""

from __future__ import annotations

import logging
import threading
import time
from typing import TYPE_CHECKING, Final, cast, get_args

import zenoh

from enact_dist.core.messages import Answer, Request
from enact_dist.errors import EnactError, ProtocolError
from enact_dist.link.zenoh_config import close_session, keep_after_fork, open_session
from enact_dist.wire.frames import decode_frame, encode_frame
from enact_dist.wire.keys import request_key, verb_of

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from enact_dist.core.messages import ShardEntry

CALL_S: Final = 1.0
"""How long a call may stay without an answer; the core makes it again anyway."""
QUEUED_MAX: Final = 10_000
"""Calls that wait for one shard; what is beyond is dropped, and made again later."""
JOIN_S: Final = 0.5
"""How long closing waits for each thread."""

_ANSWERS: Final = frozenset(get_args(Answer))
_log = logging.getLogger("enact.link")


class ShardCalls:
    """Carries the calls of one shard to the others.  Thread-safe.

    Args:
        cell: The cell's name.
        name: The calling shard; stands in the keys where clients have their actor's name.
        shards: All shards of the cell with their endpoints.
        lease_s: A connection counts as lost after so long without a sign of life.
        answered: Called with shard, request and answer, from the thread of that shard.
    """

    def __init__(
        self,
        cell: str,
        name: str,
        shards: Sequence[ShardEntry],
        *,
        lease_s: float,
        answered: Callable[[str, Request, Answer], None],
    ) -> None:
        self._cell, self._name, self._lease_s = cell, name, lease_s
        self._endpoints = {shard.name: shard.endpoints for shard in shards if shard.name != name}
        self._answered = answered
        self._mutex = threading.Lock()
        self._lines: dict[str, _Line] = {}
        self._closed = False

    def submit(self, shard: str, request: Request) -> None:
        """Queue a call; the same call that is queued already is not queued twice."""
        with self._mutex:
            if self._closed or shard not in self._endpoints:
                return
            line = self._lines.get(shard)
            if line is None:
                line = self._lines[shard] = _Line(
                    lambda request: request_key(self._cell, shard, verb_of(request), self._name),
                    self._endpoints[shard],
                    self._lease_s,
                    lambda request, answer: self._answered(shard, request, answer),
                )
        line.submit(request)

    def close(self) -> None:
        """Drop what is queued and end; twice is harmless."""
        with self._mutex:
            self._closed = True
            lines = list(self._lines.values())
        for line in lines:
            line.close()


class _Line:
    """The way to one other shard."""

    def __init__(
        self,
        key_of: Callable[[Request], str],
        endpoints: tuple[str, ...],
        lease_s: float,
        answered: Callable[[Request, Answer], None],
    ) -> None:
        self._key_of, self._endpoints, self._lease_s = key_of, endpoints, lease_s
        self._answered = answered
        self._queued: dict[Request, None] = {}
        self._wake = threading.Condition(threading.Lock())
        self._ending = False
        self._session: zenoh.Session | None = None
        keep_after_fork(self)
        self._thread = threading.Thread(target=self._run, name="enact-calls", daemon=True)
        self._thread.start()

    def submit(self, request: Request) -> None:
        with self._wake:
            if not self._ending and len(self._queued) < QUEUED_MAX:
                self._queued[request] = None
                self._wake.notify()

    def _run(self) -> None:
        try:
            self._session = open_session(connect=self._endpoints, lease_s=self._lease_s)
        except EnactError as error:
            _log.error("no way to another shard at %s: %s", self._endpoints, error)
            return
        while (calls := self._next_calls()) is not None:
            sent = [(request, self._send(self._session, request)) for request in calls]
            end_s = time.monotonic() + CALL_S
            for request, replies in sent:
                answer = _receive(replies, end_s)
                if answer is not None and not self._ending:
                    self._answered(request, answer)

    def _next_calls(self) -> list[Request] | None:
        """Wait for calls; return all that are queued, None at the end."""
        with self._wake:
            while not self._queued and not self._ending:
                self._wake.wait()
            calls, self._queued = list(self._queued), {}
            return None if self._ending else calls

    def _send(self, session: zenoh.Session, request: Request) -> zenoh.Handler[zenoh.Reply] | None:
        header, payload = encode_frame(request)
        try:
            return session.get(
                self._key_of(request),
                payload=payload,
                attachment=header,
                timeout=CALL_S,
                consolidation=zenoh.ConsolidationMode.NONE,
                priority=zenoh.Priority.INTERACTIVE_HIGH,
                congestion_control=zenoh.CongestionControl.BLOCK,
            )
        except zenoh.ZError:
            return None

    def close(self) -> None:
        with self._wake:
            self._ending = True
            self._wake.notify()
        if self._session is not None:
            close_session(self._session)
        self._thread.join(JOIN_S)


def _receive(replies: zenoh.Handler[zenoh.Reply] | None, end_s: float) -> Answer | None:
    """Return the answer that came, or None; Zenoh itself ends the wait after `CALL_S`."""
    if replies is None or time.monotonic() > end_s + CALL_S:
        return None
    try:
        sample = replies.recv().ok
    except zenoh.ZError:  # ended without a reply
        return None
    if sample is None:
        return None
    header, payload = sample.attachment, sample.payload
    try:
        answer = decode_frame(
            bytes(header) if header is not None else b"",
            bytes(payload) if payload is not None else b"",
        )
    except ProtocolError as error:
        _log.warning("another shard's answer cannot be read: %s", error)
        return None
    return cast("Answer", answer) if type(answer) in _ANSWERS else None
