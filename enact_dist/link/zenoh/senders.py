"""Decides which thread sends an answer: the one that made it, or the client's own sender.

Sending to a client that does not read can block until its connection is closed.  To delay no other
client, the dispatcher sends an answer itself only while the client has less than
`OUTSTANDING_BYTES_MAX` outstanding: that fits into the connection's buffers, so the call returns at
once and no other thread has to be woken (30 us of a 200 us round trip).  Everything beyond goes, in
order, to a thread of that client.

A shard cannot see whether an answer was read.  But a request that arrives *after* the answer was
sent proves that its client lives and reads.  Requests that waited in the inbox prove nothing.  So a
new burst starts only when the inbox was found empty (`new_burst`), and a client's outstanding bytes
are reset by its first request in a new burst (`heard`).

Every queue is bounded; excess answers are dropped and counted.  A dropped answer is *unknown* to
the client, which repeats its request.
"""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Protocol

from enact_dist.core.protocol.messages import (
    Audited,
    Granted,
    Locks,
    Registered,
    Sessions,
    Slice,
    Surveyed,
    Versions,
    Viewed,
    Welcome,
)
from enact_dist.core.protocol.pages import bytes_in_frame
from enact_dist.errors import ProtocolError
from enact_dist.wire.frames import encode_parts, refusal_of

if TYPE_CHECKING:
    from enact_dist.core.protocol.messages import Answer

OUTSTANDING_BYTES_MAX: Final = 64 << 10
"""What a client may have outstanding before its own sender takes over: one transport batch."""
SURVEYED_BYTES: Final = 160
"""Estimated length of one slot in the answer to a `Survey`."""
VERSION_BYTES: Final = 1024
"""Estimated length of one version, its cause included, in a listing."""
CATALOGUE_BYTES: Final = 64
"""Estimated length of one world context or aspect in a catalogue."""
QUEUED_ANSWERS_MAX: Final = 1024
"""Answers that wait for one client; a client has some calls per thread in flight."""
QUEUED_BYTES_MAX: Final = 256 << 20
"""Bytes of data that wait for one client."""
CLIENTS_MAX: Final = 16_384
"""Clients whose outstanding bytes are remembered; more than a shard has sessions."""
SENDERS_MAX: Final = 256
"""Sender threads of one shard; each client that is fetching large data needs one."""
IDLE_S: Final = 2.0
"""A sender without work ends after this time; the next large answer starts a new one."""
ANSWER_OVERHEAD_BYTES: Final = 256
"""Overhead that each answer adds to the size of its data."""

_log = logging.getLogger("enact.link")


class Parcel(Protocol):
    """An answer to one client."""

    @property
    def size(self) -> int:
        """Estimated length in bytes."""

    def send(self) -> None:
        """Send it; may block while the client does not read.  Never raises."""

    def drop(self) -> None:
        """Drop it: the client gets no answer.  Never raises."""


@dataclass(slots=True)
class _Account:
    """A client's outstanding bytes, and its sender while it has one."""

    burst: int
    bytes: int = 0
    sender: _Sender | None = None


class Senders:
    """Sends the answers of one shard.  Thread-safe.

    Args:
        count: Called with the name and amount of what was dropped.

    Attributes:
        burst: How often the inbox was seen empty.
    """

    def __init__(self, count: Callable[[str, int], None]) -> None:
        self._count = count
        self._accounts: dict[str, _Account] = {}
        self._mutex = threading.Lock()
        self.burst = 0
        self._senders = 0
        self._closed = False

    def new_burst(self) -> None:
        """Note that the inbox was empty: later requests were sent after all earlier answers."""
        self.burst += 1

    def heard(self, client: str, burst: int | None = None) -> None:
        """Note a request of `client`: it has read what was sent to it in earlier bursts.

        `burst` is the burst in which the request arrived; None: the present one.
        """
        account = self._accounts.get(client)
        if account is not None and account.burst < (self.burst if burst is None else burst):
            account.burst = self.burst
            account.bytes = 0

    def send(self, client: str, parcel: Parcel) -> None:
        """Send `parcel` in this thread, or queue it for the client's own sender."""
        with self._mutex:
            account = self._account_of(client)
            account.bytes += parcel.size + ANSWER_OVERHEAD_BYTES
            idle = account.sender is None or account.sender.idle
            direct = idle and account.bytes < OUTSTANDING_BYTES_MAX
            queued = direct or self._queue(account, parcel)
        if direct:
            parcel.send()
        elif not queued:
            parcel.drop()
            self._count("answers_dropped", 1)

    def _account_of(self, client: str) -> _Account:
        account = self._accounts.get(client)
        if account is None:
            if len(self._accounts) >= CLIENTS_MAX:
                idle = next((c for c, a in self._accounts.items() if a.sender is None), None)
                if idle is not None:
                    del self._accounts[idle]
            account = self._accounts[client] = _Account(self.burst)
        return account

    def _queue(self, account: _Account, parcel: Parcel) -> bool:
        if self._closed:
            return False
        if account.sender is None:
            if self._senders >= SENDERS_MAX:
                return False
            try:
                account.sender = _Sender(lambda sender: self._idle(account, sender))
            except RuntimeError as error:  # the system has no more threads
                _log.warning("an answer is lost: %s", error)
                return False
            self._senders += 1
        return account.sender.put(parcel)

    def _idle(self, account: _Account, sender: _Sender) -> bool:
        """Remove an idle sender; return False if it got a parcel meanwhile."""
        with self._mutex:
            if not sender.idle:
                return False
            account.sender = None
            self._senders -= 1
            return True

    def close(self) -> None:
        """Stop all sender threads; queued answers are dropped, a blocked call ends by itself."""
        with self._mutex:
            self._closed = True
            senders = [account.sender for account in self._accounts.values() if account.sender]
        for sender in senders:
            sender.close()


class _Sender:
    """One client's own thread, alive while it has something to send."""

    def __init__(self, may_end: Callable[[_Sender], bool]) -> None:
        self._may_end = may_end
        self._parcels: deque[Parcel] = deque()
        self._bytes = 0
        self._in_hand = 0
        self._changed = threading.Condition(threading.Lock())
        self._closed = False
        threading.Thread(target=self._run, name="enact-sender", daemon=True).start()

    @property
    def idle(self) -> bool:
        """Whether nothing waits and nothing is being sent."""
        return not self._parcels and not self._in_hand

    def put(self, parcel: Parcel) -> bool:
        """Queue a parcel; False if the queue is full."""
        with self._changed:
            full = len(self._parcels) >= QUEUED_ANSWERS_MAX or self._bytes >= QUEUED_BYTES_MAX
            if full or self._closed:
                return False
            self._parcels.append(parcel)
            self._bytes += parcel.size
            self._changed.notify()
        return True

    def close(self) -> None:
        """Drop the queue, and end once the present parcel is sent or dropped."""
        with self._changed:
            self._closed = True
            parcels = list(self._parcels)
            self._parcels.clear()
            self._changed.notify()
        for parcel in parcels:
            parcel.drop()

    def _run(self) -> None:
        while True:
            with self._changed:
                if not self._changed.wait_for(lambda: self._parcels or self._closed, IDLE_S):
                    parcel = None
                elif self._closed:
                    return
                else:
                    self._in_hand = 1
                    parcel = self._parcels.popleft()
                    self._bytes -= parcel.size
            if parcel is not None:
                try:
                    parcel.send()
                except Exception:  # noqa: BLE001 - all that waits for this client would wait for ever
                    _log.exception("an answer of %d bytes is lost", parcel.size)
                self._in_hand = 0
            elif self._may_end(self):
                return


def encoded(
    answer: Answer, count: Callable[[str, int], None]
) -> tuple[bytes, list[bytes | memoryview]]:
    """Return header and bodies of an answer, or of a refusal if it cannot be encoded."""
    try:
        return encode_parts(answer)
    except ProtocolError as error:
        count("answers_refused", 1)
        _log.warning("answer %s became a refusal: %s", type(answer).__name__, error)
        return encode_parts(refusal_of(error))


def size_of(answer: Answer) -> int:
    """Estimate the length of an answer's data in bytes, without encoding it."""
    estimate = _SIZE_OF.get(type(answer))
    return estimate(answer) if estimate is not None else 0


def _size_of_states(answer: Granted | Viewed) -> int:
    size = SURVEYED_BYTES * len(answer.states)
    for state in answer.states:
        if state.datum is not None and not state.large:
            size += state.size
    return size


def _size_of_catalogue(answer: Welcome | Registered) -> int:
    return CATALOGUE_BYTES * (len(answer.worlds) + len(answer.aspects))


_SIZE_OF: Final[dict[type, Callable[[Any], int]]] = {
    Granted: _size_of_states,
    Viewed: _size_of_states,
    Welcome: _size_of_catalogue,
    Registered: _size_of_catalogue,
    Slice: lambda answer: answer.body.size,
    Surveyed: lambda answer: SURVEYED_BYTES * len(answer.states),
    Versions: lambda answer: VERSION_BYTES * len(answer.entries),
    Locks: lambda answer: bytes_in_frame(answer.holders),
    Sessions: lambda answer: bytes_in_frame(answer.sessions + answer.aspects),
    Audited: lambda answer: bytes_in_frame(answer.entries),
}
