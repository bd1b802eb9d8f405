"""When something is tried again: ever more rarely, and many clients not at the same moment."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

CALLED_NS_MIN: Final = 1_000_000_000
CALLED_NS_MAX: Final = 2_000_000_000
"""Pauses of somebody who waits for a shard that is out of reach, from the first to the longest."""
AWAY_NS_MIN: Final = 2_000_000_000
AWAY_NS_MAX: Final = 5_000_000_000
"""Pause between two signs of life to a shard that is out of reach; doubles up to the second figure.

The carrier tells when it comes back, so these only repair what the carrier has missed.
"""


class Backoff:
    """Pauses that double up to a longest one, each shortened by up to a half at random.

    Args:
        first_ns: The first pause.
        longest_ns: The longest one.
        draw: Returns numbers in [0, 1).
    """

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

    Args:
        draw: Returns numbers in [0, 1).
    """

    __slots__ = ("_away", "_draw")

    def __init__(self, draw: Callable[[], float]) -> None:
        self._draw = draw
        self._away: dict[str, tuple[int, Backoff]] = {}

    def due(self, shards: Iterable[str], away: Callable[[str], bool], now_ns: int) -> list[str]:
        """Return the shards that are to be asked now.

        Args:
            shards: All that know the session.
            away: Whether a shard is known to be out of reach.
            now_ns: The session's clock.
        """
        asked = []
        for shard in shards:
            if not away(shard):
                self._away.pop(shard, None)
                asked.append(shard)
                continue
            at_ns, backoff = self._away.get(shard) or (
                now_ns,
                Backoff(AWAY_NS_MIN, AWAY_NS_MAX, self._draw),
            )
            if now_ns >= at_ns:
                asked.append(shard)
                at_ns = now_ns + backoff.pause_ns()
            self._away[shard] = at_ns, backoff
        return asked

    def pause_ns(
        self, shards: Iterable[str], away: Callable[[str], bool], usual_ns: int, now_ns: int
    ) -> int:
        """Return how long nobody is due: `usual_ns` while a shard is in reach."""
        due_ns = [
            self._away[shard][0] if away(shard) and shard in self._away else 0 for shard in shards
        ]
        return max(usual_ns, min(due_ns, default=0) - now_ns)
