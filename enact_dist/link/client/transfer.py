"""Moves large data in slices, with a window of them always in flight.

Each slice is one idempotent request, so a transfer is resumable by itself: only slices whose answer
was lost (or whose link was down) are requested again.  The oldest slice is awaited first; slices of
one client arrive in the order of their requests.

The window bounds what either end holds at one time.  It grows with each answer and halves after a
loss.  Time limits follow the speed seen so far, so that a slow network is not asked again for
slices that it still carries.

Large data of a commit are staged at their shards ahead of it, through one window for all shards;
the commit then only names them.  So it is always a short message, and urgent commits of this
process and others never wait behind data.  Each slice carries its position: it may arrive twice,
late or out of order.

Staged data end with their session at the shard, or when the shard is asked to drop them.  A shard
that has lost them nevertheless answers `no_payload`, and they are sent again.
"""

from __future__ import annotations

import logging
import time
from collections import deque
from dataclasses import replace
from functools import partial
from itertools import chain, zip_longest
from typing import TYPE_CHECKING, Final, NamedTuple, Protocol

from enact_dist.core.protocol.datum import Datum
from enact_dist.core.protocol.messages import EpochChanged, Stage, Staged, WriteItem
from enact_dist.errors import (
    SHARD_RESTARTED,
    EnactError,
    LeaseLostError,
    ShardUnreachableError,
)
from enact_dist.link.client.calls import BYTES_PER_S_MIN, CALL_S
from enact_dist.link.memory.names import FIRST_STAGED
from enact_dist.link.refusals import error_for, unreachable
from enact_dist.wire.limits import PAYLOAD_BYTES_MIN

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

    from enact_dist.core.client.client import Client
    from enact_dist.core.protocol.messages import Answer, Request
    from enact_dist.link.carrier import Begun, Carrier

UNSTAGED_BYTES_MAX: Final = 1 << 20
"""Data up to this total size go with their commit, since one slice costs as much.  Beyond it, data
are staged, the largest first.
"""
_NOTHING: Final = Datum(b"", b"", 0)

_log = logging.getLogger("enact.link")


class Sender(Protocol):
    """What a transfer needs of the session that makes it."""

    request_timeout_s: float

    @property
    def staged_numbers(self) -> Iterator[int]:
        """The numbers of what it stages."""

    @property
    def carrier(self) -> Carrier:
        """Reaches the shards."""

    @property
    def core(self) -> Client:
        """The session itself."""

    def begin(self, shard: str, request: Request, *, timeout_s: float) -> Begun:
        """Send one request; the caller awaits its answer later."""

    def rest(self, pause_s: float) -> None:
        """Wait a little before a retry."""

    def count(self, name: str, amount: int = 1) -> None:
        """Add to one of the session's counters."""


def stage(
    client: Sender,
    writes: Mapping[str, Sequence[WriteItem]],
    alive: Callable[[], None],
) -> Mapping[str, Sequence[WriteItem]]:
    """Stage the large data of these writes at their shards; return writes that name them.

    Args:
        client: The session that will commit them.
        writes: By shard; data that already name a payload stay unchanged.
        alive: Raises once the lock for these writes is lost.

    Raises:
        LeaseLostError: A shard has restarted, which ends the lock.
        NoRoomError: A shard has no room for them; the message states its limit and what to do.
        ShardUnreachableError: A shard does not answer.
        EnactError: Whatever `alive` raises.
    """
    named = {shard: _named(client, each) for shard, each in writes.items()}
    by_shard = {
        shard: [_pieces(client, shard, w.datum) for w in each if w.datum and _is_staged(w.datum)]
        for shard, each in named.items()
        if each is not writes[shard]
    }
    if by_shard:
        try:
            Transfer(client, alive).run(in_turn(by_shard))
        except ShardUnreachableError:
            raise  # no shard to notify
        except BaseException:
            drop_staged(client, named)
            raise
    return named


def _named(client: Sender, writes: Sequence[WriteItem]) -> Sequence[WriteItem]:
    """Name each large datum of one shard's writes; return `writes` if nothing is staged."""
    inline = [(n, w.datum) for n, w in enumerate(writes) if w.datum and not w.datum.file]
    left = sum(datum.size for _, datum in inline)
    if left <= UNSTAGED_BYTES_MAX or client.carrier.inside:
        return writes
    named = list(writes)
    inline.sort(key=lambda one: one[1].size, reverse=True)
    for number, datum in inline:
        if datum.size <= PAYLOAD_BYTES_MIN and left <= UNSTAGED_BYTES_MAX:
            break
        left -= datum.size
        file = f"{client.core.session}-{next(client.staged_numbers):x}"
        named[number] = WriteItem(writes[number].slot, replace(datum, file=file))
    return named


def drop_staged(client: Sender, writes: Mapping[str, Sequence[WriteItem]]) -> None:
    """Tell the shards that the data staged for these writes will not be committed."""
    drops = [
        (shard, Stage(client.core.session, write.datum.file, 0, 0, _NOTHING))
        for shard, each in writes.items()
        for write in each
        if write.datum is not None and _is_staged(write.datum)
    ]
    if drops:
        try:
            client.carrier.request_all(drops, timeout_s=CALL_S)
        except EnactError as error:  # the shard notices by itself
            _log.info("could not tell a shard to drop staged data: %s", error)


def _is_staged(datum: Datum) -> bool:
    number = datum.file.rpartition("-")[2]
    return bool(number) and int(number, 16) >= FIRST_STAGED


def _pieces(client: Sender, shard: str, datum: Datum) -> Iterator[Piece]:
    """Yield the slices of one datum."""
    session, slice_bytes = client.core.session, client.carrier.fetch_bytes
    body = memoryview(datum.body)
    for offset in range(0, datum.size, slice_bytes):
        part = body[offset : offset + slice_bytes]
        request = Stage(session, datum.file, offset, datum.size, Datum(b"", part, len(part)))
        yield Piece(shard, request, len(part), partial(_check_staged, shard, datum.file))


def _check_staged(shard: str, file: str, answer: Answer) -> None:
    """Return if the answer confirms a slice, else raise its error."""
    if isinstance(answer, Staged) and answer.file == file:
        return
    if isinstance(answer, EpochChanged):
        raise LeaseLostError(
            f"shard {shard} has restarted, or ended this session, while data were on their way to"
            " it: the lock is lost and nothing was written; take it again and redo the work",
            cause=SHARD_RESTARTED,
        )
    raise error_for(answer, f"a slice of {file}")


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
        client: Sender,
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
            timeout_s = self._answer_timeout_s()
            begun = self._client.begin(piece.shard, piece.request, timeout_s=timeout_s)
            self._under_way.append((piece, begun))

    def _answer_timeout_s(self) -> float:
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
        if silent_s >= self._client.request_timeout_s:
            raise unreachable(shard, silent_s, self._client.carrier)
        self._alive()
        self._client.rest(self._pause_s)
        self._pause_s = min(2 * self._pause_s, PAUSE_S_MAX)
