"""When something is tried again: ever more rarely, and many clients not at the same moment."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Final

RETRY_NS_MIN: Final = 20_000_000
RETRY_NS_MAX: Final = 300_000_000
"""Pause after a call without an answer; doubles up to the second figure."""
CALLED_NS_MIN: Final = 5_000_000_000
CALLED_NS_MAX: Final = 20_000_000_000
"""Pauses of a client that waits for a shard out of reach, from the first to the longest.

The session's own signs of life find it sooner, once for all who wait, and wake them.
"""
AWAY_NS_MIN: Final = 4_000_000_000
AWAY_NS_MAX: Final = 10_000_000_000
"""Pause between two signs of life to a shard that is out of reach; doubles up to the second figure.

The carrier tells when it comes back, so these only repair what the carrier has missed.
"""
USED_PARTS: Final = 4
IDLE_PARTS: Final = 2
"""A session gives so many signs of life in a TTL while it is used, and while it holds nothing.

An idle one has nothing to lose: its shards forget it only after several TTLs without any.
"""


class Backoff:
    """Pauses that double up to a longest one, each shortened by up to a half at random."""

    __slots__ = ("_draw", "_longest_ns", "_next_ns")

    def __init__(self, first_ns: int, longest_ns: int, draw: Callable[[], float]) -> None:
        self._next_ns, self._longest_ns, self._draw = first_ns, longest_ns, draw

    def pause_ns(self) -> int:
        """Return the next pause."""
        pause_ns = self._next_ns
        self._next_ns = min(2 * pause_ns, self._longest_ns)
        return pause_ns - int(self._draw() * pause_ns / 2)


class SignsOfLife:
    """Whom a session sends its next signs of life: shards in reach each time, others rarely.

    Those that are away are asked together, the first time a pause after the last of them went: no
    sign of life reaches a shard that has just left.

    Args:
        draw: Returns numbers in [0, 1).

    Attributes:
        gone: The shards that were out of reach when it was last asked who is due.
    """

    __slots__ = ("_at_ns", "_backoff", "_draw", "_used_until_ns", "gone")

    def __init__(self, draw: Callable[[], float]) -> None:
        self._draw = draw
        self.gone: frozenset[str] = frozenset()
        self._backoff = Backoff(AWAY_NS_MIN, AWAY_NS_MAX, draw)
        self._at_ns = 0
        self._used_until_ns = 0

    def due(self, shards: Iterable[str], away: Callable[[str], bool], now_ns: int) -> list[str]:
        """Return the shards that are to be asked now, of all that know the session."""
        shards = list(shards)
        gone = frozenset(shard for shard in shards if away(shard))
        if gone - self.gone:
            self._backoff = Backoff(AWAY_NS_MIN, AWAY_NS_MAX, self._draw)
            self._at_ns = now_ns + self._backoff.pause_ns()
        self.gone = gone
        asks = now_ns >= self._at_ns
        if gone and asks:
            self._at_ns = now_ns + self._backoff.pause_ns()
        return [shard for shard in shards if asks or shard not in gone]

    def used(self, now_ns: int, ttl_ns: int) -> None:
        """Note that the session has a lock, or that a thread needs what its answers report."""
        self._used_until_ns = max(self._used_until_ns, now_ns + ttl_ns)

    def is_used(self, now_ns: int) -> bool:
        """Whether the session was used within the last TTL."""
        return now_ns < self._used_until_ns

    def pause_ns(
        self, shards: Iterable[str], away: Callable[[str], bool], ttl_ns: int, now_ns: int
    ) -> int:
        """Return the time to the next keep-alive: a part of the TTL while a shard is in reach."""
        usual_ns = ttl_ns // (USED_PARTS if self.is_used(now_ns) else IDLE_PARTS)
        in_reach = any(shard not in self.gone or not away(shard) for shard in shards)
        return usual_ns if in_reach else max(usual_ns, self._at_ns - now_ns)
