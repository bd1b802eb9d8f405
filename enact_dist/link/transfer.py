"""Moves a large amount of data in slices: a window of them is always under way.

Each slice is one idempotent request, so a transfer is resumable by itself: what came stays, a
slice whose answer was lost (or whose link was down) is asked again, nothing else.  The oldest
slice is waited for; slices of one client come in the order in which they were asked.

The window bounds what either end holds at one time.  It opens as answers come and halves where
one is lost, and how long an answer may take follows the speed seen so far, so that a slow network
is not asked twice for what it still carries.
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
"""Bytes under way at most: hides the round trip, bounds what a stopped client leaves behind."""
FIRST_WINDOW_BYTES: Final = 2 << 20
"""Bytes under way before the first answer has shown how fast the way is."""
PAUSE_S: Final = 0.02
PAUSE_S_MAX: Final = 0.3
"""Pause after lost answers; doubles up to the second figure."""
SLOWEST_BYTES_PER_S: Final = 1e5
"""No way is taken to be slower than this."""


class Piece(NamedTuple):
    """One slice: its request, what takes the answer, and where its bytes may be put directly.

    `take` raises whatever ends the transfer.  `size` is what travels, in bytes.
    """

    shard: str
    request: Request
    size: int
    take: Callable[[Answer], None]
    into: memoryview | None = None


def in_turn(by_shard: Mapping[str, Iterable[Iterator[Piece]]]) -> Iterator[Piece]:
    """Yield all slices so that no shard waits until another has had all of its own."""
    rows = zip_longest(*(chain.from_iterable(each) for each in by_shard.values()))
    return (piece for row in rows for piece in row if piece is not None)


class Transfer:
    """One transfer of the calling thread.

    Args:
        client: The session that asks.
        alive: Raises where nobody wants the data any more; called after each loss.
        window_bytes: How much may be under way.
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
        """Move all pieces; returns once each answer was taken.  Counts slices asked again.

        Raises:
            ShardUnreachableError: None was answered for 10 s.
            EnactError: What `alive`, or the `take` of a piece, has raised.
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
        """Return how long the answer to a slice may take behind all that is under way."""
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
        """Wait a little before slices are asked again, unless all is over."""
        silent_s = time.monotonic() - self._heard_s
        if silent_s >= self._client.patience_s:
            raise unreachable(shard, silent_s, self._client.carrier.endpoint_of)
        self._alive()
        self._client.rest(self._pause_s)
        self._pause_s = min(2 * self._pause_s, PAUSE_S_MAX)
