"""Keeps the clients of a shard from delaying each other, both with requests and with answers.

`Turns`: a request waits for earlier requests of its own client and for at most one of each other
client, however many those have sent.

`Senders`: sending to a client that does not read can block until its connection is closed.  The
dispatcher therefore sends an answer itself only while the client has less than
`OUTSTANDING_BYTES_MAX` outstanding: that fits into the connection's buffers, so the call returns at
once and no other thread has to be woken (30 us of a 200 us round trip).  Everything beyond goes, in
order, to a thread of that client.

A shard cannot see whether an answer was read.  But a request that arrives *after* the answer was
sent proves that its client lives and reads.  Requests that waited in the inbox prove nothing.  So a
new burst starts only when the inbox was found empty (`new_burst`), and a client's outstanding bytes
are reset by its first request in a new burst (`heard`).

Every queue is bounded; excess requests and answers are dropped and counted.  A dropped one is
*unknown* to the client, which repeats its request.
"""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Callable
from typing import Final, Generic, Protocol, TypeVar

T = TypeVar("T")

OF_ONE_MAX: Final = 4_096
"""Requests of one client that may wait: four times as many as a session has threads."""
OF_ONE_BYTES_MAX: Final = 128 << 20
"""Bytes of one client's requests that may wait: 16 transfers of large data."""
OF_ALL_MAX: Final = 65_536
"""Requests of all clients together that may wait."""
OF_ALL_BYTES_MAX: Final = 512 << 20
"""Bytes of all requests together that may wait."""
OUTSTANDING_BYTES_MAX: Final = 64 << 10
"""What a client may have outstanding before its own sender takes over: one transport batch."""
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


class _Queue(Generic[T]):
    """The waiting requests of one client."""

    __slots__ = ("bytes", "waiting")

    def __init__(self) -> None:
        self.waiting: deque[tuple[int, int, T]] = deque()
        self.bytes = 0


class Turns(Generic[T]):
    """The waiting requests, by client.  For one thread.

    Attributes:
        put_count: Number of requests added so far; each is numbered by the count before it.
    """

    __slots__ = ("_bytes", "_queues", "_rotation", "_size", "put_count")

    def __init__(self) -> None:
        self._queues: dict[str, _Queue[T]] = {}
        self._rotation: deque[str] = deque()
        self._size = self._bytes = 0
        self.put_count = 0

    def __len__(self) -> int:
        return self._size

    def put(self, client: str, size: int, request: T) -> bool:
        """Add a request of `size` bytes; return False if it does not fit.

        A client without waiting requests may add one of any size.
        """
        if self._size >= OF_ALL_MAX or self._bytes + size > OF_ALL_BYTES_MAX:
            return False
        queue = self._queues.get(client)
        if queue is None:
            queue = self._queues[client] = _Queue()
            self._rotation.append(client)
        elif len(queue.waiting) >= OF_ONE_MAX or queue.bytes + size > OF_ONE_BYTES_MAX:
            return False
        queue.waiting.append((self.put_count, size, request))
        queue.bytes += size
        self._size += 1
        self._bytes += size
        self.put_count += 1
        return True

    def take(self) -> tuple[int, T]:
        """Remove the next request; return it with its number, and pass the turn to the next client.

        Raises:
            IndexError: No request waits.
        """
        client = self._rotation.popleft()
        queue = self._queues[client]
        number, size, request = queue.waiting.popleft()
        self._size -= 1
        self._bytes -= size
        if queue.waiting:
            queue.bytes -= size
            self._rotation.append(client)
        else:
            del self._queues[client]
        return number, request


class Parcel(Protocol):
    """An answer to one client."""

    @property
    def size(self) -> int:
        """Estimated length in bytes."""

    def send(self) -> None:
        """Send it; may block while the client does not read.  Never raises."""

    def drop(self) -> None:
        """Drop it: the client gets no answer.  Never raises."""


class _Client:
    """What one client has outstanding, what waits for it, and its thread while it has one."""

    __slots__ = ("burst", "outstanding", "parcels", "queued", "sending", "served", "wake")

    def __init__(self, burst: int, mutex: threading.Lock) -> None:
        self.burst = burst
        self.outstanding = self.queued = 0
        self.parcels: deque[Parcel] = deque()
        self.served = self.sending = False
        self.wake = threading.Condition(mutex)


class Senders:
    """Sends the answers of one shard.  Thread-safe.

    Args:
        count: Called with the name and amount of what was dropped.

    Attributes:
        burst: How often the inbox was seen empty.
    """

    def __init__(self, count: Callable[[str, int], None]) -> None:
        self._count = count
        self._clients: dict[str, _Client] = {}
        self._mutex = threading.Lock()
        self.burst = 0
        self._senders = 0
        self._closed = False

    def new_burst(self) -> None:
        """Note that the inbox was empty: later requests were sent after all earlier answers."""
        self.burst += 1

    def heard(self, name: str, burst: int | None = None) -> None:
        """Note a request of a client: it has read what was sent to it in earlier bursts.

        `burst` is the burst in which the request arrived; None: the present one.
        """
        client = self._clients.get(name)
        if client is not None and client.burst < (self.burst if burst is None else burst):
            client.burst = self.burst
            client.outstanding = 0

    def send(self, name: str, parcel: Parcel) -> None:
        """Send `parcel` to a client in this thread, or queue it for the client's own sender."""
        with self._mutex:
            client = self._client(name)
            client.outstanding += parcel.size + ANSWER_OVERHEAD_BYTES
            idle = not client.parcels and not client.sending
            direct = idle and client.outstanding < OUTSTANDING_BYTES_MAX
            queued = direct or self._queue(client, parcel)
        if direct:
            parcel.send()
        elif not queued:
            parcel.drop()
            self._count("answers_dropped", 1)

    def _client(self, name: str) -> _Client:
        client = self._clients.get(name)
        if client is None:
            if len(self._clients) >= CLIENTS_MAX:
                unserved = next((n for n, c in self._clients.items() if not c.served), None)
                if unserved is not None:
                    del self._clients[unserved]
            client = self._clients[name] = _Client(self.burst, self._mutex)
        return client

    def _queue(self, client: _Client, parcel: Parcel) -> bool:
        """Leave a parcel to the client's sender; return whether there is room and a thread."""
        full = len(client.parcels) >= QUEUED_ANSWERS_MAX or client.queued >= QUEUED_BYTES_MAX
        if self._closed or full or not (client.served or self._start(client)):
            return False
        client.parcels.append(parcel)
        client.queued += parcel.size
        client.wake.notify()
        return True

    def _start(self, client: _Client) -> bool:
        """Start the client's sender; return whether a thread was free."""
        if self._senders >= SENDERS_MAX:
            return False
        run = threading.Thread(target=self._serve, args=(client,), name="enact-sender", daemon=True)
        try:
            run.start()
        except RuntimeError as error:  # the system has no more threads
            _log.warning("no thread sends a large answer, which is dropped: %s", error)
            return False
        client.served = True
        self._senders += 1
        return True

    def _serve(self, client: _Client) -> None:
        """Send what waits for one client, until nothing does for a while."""
        while True:
            with self._mutex:
                client.sending = False
                client.wake.wait_for(lambda: client.parcels or self._closed, IDLE_S)
                if self._closed or not client.parcels:
                    client.served = False
                    self._senders -= 1
                    return
                client.sending = True
                parcel = client.parcels.popleft()
                client.queued -= parcel.size
            try:
                parcel.send()
            except Exception:  # noqa: BLE001 - all that waits for this client would wait for ever
                _log.exception("an answer of %d bytes was not sent", parcel.size)

    def close(self) -> None:
        """Stop all sender threads; queued answers are dropped, a blocked call ends by itself."""
        with self._mutex:
            self._closed = True
            dropped = [parcel for client in self._clients.values() for parcel in client.parcels]
            for client in self._clients.values():
                client.parcels.clear()
                client.wake.notify()
        for parcel in dropped:
            parcel.drop()
