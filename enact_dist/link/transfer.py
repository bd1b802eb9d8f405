"""Moves large data in slices, with a window of them always in flight.

Each slice is one idempotent request, so a transfer is resumable by itself: only slices whose answer
was lost (or whose link was down) are requested again.  The oldest slice is awaited first; slices of
one client arrive in the order of their requests.

The window bounds what either end holds at one time.  It grows with each answer and halves after a
loss.  Time limits follow the speed seen so far, so that a slow network is not asked again for
slices that it still carries.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from itertools import chain, zip_longest
from typing import TYPE_CHECKING, Final, NamedTuple

from enact_dist.link.calls import BYTES_PER_S_MIN, CALL_S
from enact_dist.link.refusals import unreachable

if TYPE_CHECKING:
    from enact_dist.core.messages import Answer, Request
    from enact_dist.link.carrier import Begun
    from enact_dist.link.session_client import SessionClient

WINDOW_BYTES: Final = 8 << 20
"""Most bytes in flight: hides the round trip, bounds what a stopped client leaves behind."""
FIRST_WINDOW_BYTES: Final = 2 << 20
"""Bytes in flight before the first answer has shown the speed."""
PAUSE_S: Final = 0.02
PAUSE_S_MAX: Final = 0.3
"""Pause after lost answers; doubles up to the second figure."""
SLOWEST_BYTES_PER_S: Final = 1e5
"""The lowest speed assumed of any connection."""


class Piece(NamedTuple):
    """One slice: its request, a function that takes the answer, and perhaps a buffer for it.

    `take` raises an exception to end the transfer.  `size` is the number of bytes to send or
    receive.
    """

    shard: str
    request: Request
    size: int
    take: Callable[[Answer], None]
    into: memoryview | None = None


def in_turn(by_shard: Mapping[str, Iterable[Iterator[Piece]]]) -> Iterator[Piece]:
    """Yield all slices, alternating between shards so that none waits for another's transfer."""
    rows = zip_longest(*(chain.from_iterable(each) for each in by_shard.values()))
    return (piece for row in rows for piece in row if piece is not None)


class Transfer:
    """One transfer of the calling thread.

    Args:
        client: The session that transfers.
        alive: Raises if the data are no longer wanted; called after each loss.
        window_bytes: The window's limit.
    """

    def __init__(
        self,
        client: SessionClient,
        alive: Callable[[], None],
        *,
        window_bytes: int = WINDOW_BYTES,
    ) -> None:
        self._repeated = 0
        self._client = client
        self._alive = alive
        self._window_max = window_bytes
        self._window = min(FIRST_WINDOW_BYTES, window_bytes)
        self._under_way: deque[tuple[Piece, Begun]] = deque()
        self._bytes = 0
        self._received = 0
        self._pause_s = PAUSE_S
        self._began_s = self._heard_s = time.monotonic()

    def run(self, pieces: Iterable[Piece]) -> None:
        """Move all pieces; return once all answers are taken.  Counts repeated slices.

        Raises:
            ShardUnreachableError: None was answered for 10 s.
            EnactError: Whatever `alive` or the `take` of a piece raises.
        """
        left, again = iter(pieces), deque[Piece]()
        try:
            while True:
                if again and not self._under_way:
                    self._recover(again[0].shard)
                if not (again and self._under_way):  # after a loss, first see what else is lost
                    self._fill(again, left)
                if not self._under_way:
                    return
                missing = self._take_oldest()
                if missing is not None:
                    again.append(missing)
        finally:
            for _, begun in self._under_way:
                begun.abandon()
            if self._repeated:
                self._client.count("slices_repeated", self._repeated)

    def _fill(self, again: deque[Piece], left: Iterator[Piece]) -> None:
        while not self._under_way or self._bytes < self._window:
            piece = again.popleft() if again else next(left, None)
            if piece is None:
                return
            self._bytes += piece.size
            begun = self._client.begin(piece.shard, piece.request, timeout_s=self._patience_s())
            self._under_way.append((piece, begun))

    def _patience_s(self) -> float:
        """Return how long the answer to a slice may take behind all that is in flight."""
        rate = BYTES_PER_S_MIN
        if self._received:
            rate = self._received / max(1e-6, time.monotonic() - self._began_s)
        return CALL_S + 2 * self._bytes / max(rate, SLOWEST_BYTES_PER_S)

    def _take_oldest(self) -> Piece | None:
        """Wait for the oldest slice; return it if its answer is lost."""
        piece, begun = self._under_way.popleft()
        self._bytes -= piece.size
        answer = begun.wait(piece.into)
        if answer is None:
            self._repeated += 1
            self._window = max(1, self._window // 2)
            return piece
        self._heard_s = time.monotonic()
        self._received += piece.size
        self._window = min(self._window_max, self._window + piece.size)
        self._pause_s = PAUSE_S
        piece.take(answer)
        return None

    def _recover(self, shard: str) -> None:
        """Wait a little before repeating slices, unless the transfer has to end."""
        silent_s = time.monotonic() - self._heard_s
        if silent_s >= self._client.patience_s:
            raise unreachable(shard, silent_s, self._client.carrier.endpoint_of)
        self._alive()
        self._client.rest(self._pause_s)
        self._pause_s = min(2 * self._pause_s, PAUSE_S_MAX)
