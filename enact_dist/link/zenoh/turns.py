"""Serves the clients of a shard in turn, each one's requests in their order.

A request waits for earlier requests of its own client and for at most one of each other client,
however many those have sent.  Everything is bounded, per client and in total: requests beyond a
limit are rejected, and the caller counts them.
"""

from __future__ import annotations

from collections import deque
from typing import Final, Generic, TypeVar

T = TypeVar("T")

OF_ONE_MAX: Final = 4_096
"""Requests of one client that may wait: four times as many as a session has threads."""
OF_ONE_BYTES_MAX: Final = 128 << 20
"""Bytes of one client's requests that may wait: 16 transfers of large data."""
OF_ALL_MAX: Final = 65_536
"""Requests of all clients together that may wait."""
OF_ALL_BYTES_MAX: Final = 512 << 20
"""Bytes of all requests together that may wait."""


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
