"""Calls between shards: the outcome of a prepared lock, and the decision to commit.

Each other shard gets its own Zenoh session and thread at the first call, so that an absent shard
delays no other.  A call is made once; the core decides on repeating it, and learns when a shard
comes back.  Callers of `submit` never wait.
"""

from __future__ import annotations

import logging
import threading
import time
from typing import TYPE_CHECKING, Final

import zenoh

from enact_dist.core.shard.owners import shard_identity
from enact_dist.errors import ProtocolError
from enact_dist.link.zenoh.config import close_session, keep_after_fork, open_session
from enact_dist.link.zenoh.queries import (
    ServerNames,
    ShardPresence,
    answer_in,
    next_reply,
    send_query,
)
from enact_dist.link.zenoh.tls import why_refused
from enact_dist.wire.keys import request_key, verb_of

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from enact_dist.core.protocol.messages import Answer, Request, ShardEntry
    from enact_dist.link.zenoh.queries import Replies
    from enact_dist.link.zenoh.tls import KeyFiles

CALL_S: Final = 1.0
"""How long a call may stay without an answer; the core repeats it anyway."""
QUEUED_MAX: Final = 10_000
"""Calls that wait for one shard; further ones are dropped, and repeated later."""
JOIN_S: Final = 0.5
"""How long closing waits for all threads."""
SILENT_S: Final = 5.0
"""A shard that is silent for this time is logged, once."""

_log = logging.getLogger("enact.link")


class ShardCalls:
    """Carries the calls of one shard to the others.  Thread-safe.

    Args:
        cell: The cell's name.
        name: The calling shard; its identity is part of the keys.
        shards: All shards of the cell with their endpoints.
        lease_s: A connection counts as lost after this time without a sign of life.
        answered: Called with shard, request and answer, from the thread of that shard.
        returned: Called from any thread with the name of each previously called shard that comes
            (back) within reach.
        keys: The files by which this shard proves its name, in a cell with keys.
    """

    def __init__(
        self,
        cell: str,
        name: str,
        shards: Sequence[ShardEntry],
        *,
        lease_s: float,
        answered: Callable[[str, Request, Answer], None],
        returned: Callable[[str], None],
        keys: KeyFiles | None = None,
    ) -> None:
        self.keys = keys
        self._cell, self._identity, self._lease_s = cell, shard_identity(name), lease_s
        self._endpoints = {shard.name: shard.endpoints for shard in shards if shard.name != name}
        self.pass_answer, self.pass_return = answered, returned
        self._mutex = threading.Lock()
        self._lines: dict[str, _Line] = {}
        self._unknown: dict[str, None] = {}
        self._closed = False

    @property
    def others(self) -> tuple[str, ...]:
        """The shards that can be called."""
        return tuple(self._endpoints)

    def submit(self, shard: str, request: Request) -> None:
        """Queue a call; a call that is already queued is not queued twice."""
        with self._mutex:
            if self._closed:
                return
            if shard not in self._endpoints:
                self._log_unknown(shard)
                return
            line = self._lines.get(shard) or self._opened(shard)
        if line is not None:
            line.submit(request)

    def _opened(self, shard: str) -> _Line | None:
        """Return a new line to a shard; None if the system has no more threads."""
        try:
            line = self._lines[shard] = _Line(self, shard, self._endpoints[shard], self._lease_s)
        except RuntimeError as error:
            _log.warning("cannot call shard %s now: %s", shard, error)
            return None
        return line

    def key_of(self, shard: str, request: Request) -> str:
        """Return the key of a request of this shard to another one."""
        return request_key(self._cell, shard, verb_of(request), self._identity)

    def _log_unknown(self, shard: str) -> None:
        """Log once that a lock was prepared with a shard that the cell no longer has."""
        if shard not in self._unknown:
            self._unknown[shard] = None
            _log.error(
                "a lock waits for shard %s, which is not among the shards of this cell (%s): start"
                " it again, or abort the lock (enact lock resolve --force-abort)",
                shard,
                ", ".join(self._endpoints) or "none",
            )

    def close(self) -> None:
        """Drop what is queued and end; idempotent."""
        with self._mutex:
            self._closed = True
            lines = list(self._lines.values())
        for line in lines:
            line.end()
        deadline_s = time.monotonic() + JOIN_S
        for line in lines:
            line.join(deadline_s - time.monotonic())


class _Line:
    """The connection to one other shard.  After any failure the next calls try again."""

    def __init__(
        self, calls: ShardCalls, shard: str, endpoints: tuple[str, ...], lease_s: float
    ) -> None:
        self._calls, self._shard = calls, shard
        self._endpoints, self._lease_s = endpoints, lease_s
        self._queued: dict[Request, None] = {}
        self._wake = threading.Condition(threading.Lock())
        self._ending = False
        self._session: zenoh.Session | None = None
        self._names: ServerNames | None = None
        self._presence: ShardPresence | None = None
        self._silent_since_s: float | None = None
        self._silence_logged = False
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
            while (calls := self._next_calls()) is not None:
                try:
                    answers = self._answers(calls)
                except Exception as error:  # noqa: BLE001 - a lock may wait for the next call
                    answers = []
                    _log.error("cannot call shard %s: %s", self._shard, error)
                self._note_silence(answered=bool(answers))
                for request, answer in answers:
                    if not self._ending:
                        self._calls.pass_answer(self._shard, request, answer)
        finally:
            self._close_session()

    def _answers(self, calls: list[Request]) -> list[tuple[Request, Answer]]:
        """Make calls at once; return those that were answered.

        Raises:
            EnactError: No call can be made.
        """
        session = self._session
        if session is None:
            files = self._calls.keys
            session = self._session = open_session(
                connect=self._endpoints, lease_s=self._lease_s, keys=files
            )
            self._names = ServerNames(session) if files is not None else None
        keys = [self._calls.key_of(self._shard, call) for call in calls]
        if self._presence is None:
            self._watch(session, keys[0])
        sent = [
            (call, send_query(session, key, call, timeout_s=CALL_S))
            for call, key in zip(calls, keys, strict=True)
        ]
        end_s = time.monotonic() + CALL_S
        received = [(call, self._receive(replies, end_s)) for call, replies in sent]
        return [(request, answer) for request, answer in received if answer is not None]

    def _receive(self, replies: Replies | None, end_s: float) -> Answer | None:
        """Return the answer that came, or None; Zenoh itself ends the wait after `CALL_S`."""
        if time.monotonic() > end_s + CALL_S:
            return None
        try:
            sample = next_reply(replies, self._names, self._shard)
            return answer_in(sample, self._shard) if sample is not None else None
        except ProtocolError as error:
            _log.warning("cannot read another shard's answer: %s", error)
            return None

    def _watch(self, session: zenoh.Session, key: str) -> None:
        """Watch the shard; on failure the next calls try again, and these are made anyway."""
        try:
            self._presence = ShardPresence(session, key, self._report_return)
        except (zenoh.ZError, RuntimeError) as error:  # closed meanwhile, or no thread available
            if not self._ending:
                _log.warning("shard %s is not watched at the moment: %s", self._shard, error)

    def _report_return(self) -> None:
        if not self._ending:
            self._calls.pass_return(self._shard)

    def _note_silence(self, *, answered: bool) -> None:
        """Log once that the shard is away, and once that it is back."""
        now_s = time.monotonic()
        if answered:
            if self._silence_logged:
                _log.info("shard %s answers again", self._shard)
            self._silent_since_s, self._silence_logged = None, False
            return
        if self._silent_since_s is None:
            self._silent_since_s = now_s
        if (
            not self._silence_logged
            and now_s - self._silent_since_s >= SILENT_S
            and not self._ending
        ):
            self._silence_logged = True
            refused = why_refused(self._endpoints, self._calls.keys, self._shard)
            _log.warning(
                "shard %s at %s does not answer; commits over it and this shard wait for it, and"
                " keep their locks here (enact lock ls)%s",
                self._shard,
                " or ".join(self._endpoints),
                f"; {refused}" if refused else "",
            )

    def _next_calls(self) -> list[Request] | None:
        """Wait for calls; return all that are queued, None at the end."""
        with self._wake:
            while not self._queued and not self._ending:
                self._wake.wait()
            calls, self._queued = list(self._queued), {}
            return None if self._ending else calls

    def end(self) -> None:
        """Take no more calls and let pending ones end without an answer."""
        with self._wake:
            self._ending = True
            self._wake.notify()
        self._close_session()

    def join(self, timeout_s: float) -> None:
        deadline_s = time.monotonic() + timeout_s
        self._thread.join(max(0.0, timeout_s))
        if self._presence is not None:
            self._presence.close(max(0.0, deadline_s - time.monotonic()))

    def _close_session(self) -> None:
        if self._presence is not None:
            self._presence.close(0.0)
        session = self._session
        if session is not None:
            close_session(session)
