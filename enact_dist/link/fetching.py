"""Data on the way to the client: the cache by version, and large data in slices.

A datum is known by (shard, epoch, slot, version): versions of volatile slots start again with a
new epoch of their shard, so a version alone could name two data.  What the cache holds is never
sent twice; its bytes are capped and the least recently used go first.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from typing import TYPE_CHECKING, Final, NamedTuple

from enact_dist.core.datum import Datum, Slot
from enact_dist.core.messages import EpochChanged, Fetch, Gone, Refused, Slice, SlotState
from enact_dist.errors import LeaseLostError, ProtocolError
from enact_dist.link.refusals import error_of
from enact_dist.link.session_client import FINISH_S
from enact_dist.wire.limits import BODY_BYTES_MAX

if TYPE_CHECKING:
    from enact_dist.core.datum import LockId
    from enact_dist.link.client import CellClient

CACHE_BYTES_MAX: Final = 256 << 20
CACHED_BYTES_MIN: Final = 1024
"""Smaller data cost less to send again than to look up."""
IN_FLIGHT: Final = 4
"""Slices asked for at once: hides the round trip, bounds what a stopped client leaves behind."""


class _Known(NamedTuple):
    shard: str
    epoch: int
    version: int
    datum: Datum


class DatumCache:
    """The newest datum of each slot that this process has seen, up to a number of bytes."""

    def __init__(self, bytes_max: int = CACHE_BYTES_MAX) -> None:
        self._bytes_max = bytes_max
        self._known: OrderedDict[Slot, _Known] = OrderedDict()
        self._bytes = 0
        self._mutex = threading.Lock()

    def version(self, slot: Slot, shard: str, epoch: int) -> int:
        """Return the version that is known of a slot in this epoch (0: none)."""
        with self._mutex:
            known = self._known.get(slot)
        return known.version if known and (known.shard, known.epoch) == (shard, epoch) else 0

    def get(self, slot: Slot, shard: str, epoch: int, version: int) -> Datum | None:
        """Return the datum of exactly this version, if it is known."""
        with self._mutex:
            known = self._known.get(slot)
            if known is None or (known.shard, known.epoch, known.version) != (
                shard,
                epoch,
                version,
            ):
                return None
            self._known.move_to_end(slot)
            return known.datum

    def put(self, slot: Slot, shard: str, epoch: int, version: int, datum: Datum) -> None:
        """Remember a datum; forget older ones beyond the cap."""
        if not CACHED_BYTES_MIN <= datum.size <= self._bytes_max:
            return
        with self._mutex:
            old = self._known.pop(slot, None)
            if old is not None:
                self._bytes -= old.datum.size
            self._known[slot] = _Known(shard, epoch, version, datum)
            self._bytes += datum.size
            while self._bytes > self._bytes_max:
                _, dropped = self._known.popitem(last=False)
                self._bytes -= dropped.datum.size


def fetch(
    client: CellClient, cache: DatumCache, lock: LockId, shard: str, epoch: int, state: SlotState
) -> Datum:
    """Return the datum that `state` of a grant or view names, from the cache or in slices.

    Args:
        client: The session that took the grant or view.
        cache: Where to look first and to remember it.
        lock: The lock that pins the datum.
        shard: The slot's shard.
        epoch: The shard's epoch when the grant or view was taken.
        state: A state with a datum (not null).

    Raises:
        LeaseLostError: The shard keeps this version for the lock no more.
        ShardUnreachableError: The shard does not answer.
        ProtocolError: The answers do not fit together.
    """
    if state.datum is not None and not state.large:
        cache.put(state.slot, shard, epoch, state.version, state.datum)
        return state.datum
    known = cache.get(state.slot, shard, epoch, state.version)
    if known is not None:
        return known
    datum = _fetch_slices(client, lock, shard, epoch, state)
    cache.put(state.slot, shard, epoch, state.version, datum)
    return datum


def _fetch_slices(
    client: CellClient, lock: LockId, shard: str, epoch: int, state: SlotState
) -> Datum:
    length = client.carrier.fetch_bytes
    if state.size > BODY_BYTES_MAX:
        raise ProtocolError(f"{state.slot} is said to have {state.size} bytes")
    offsets = range(0, max(1, state.size), length)
    body = memoryview(b"") if len(offsets) == 1 else memoryview(bytearray(state.size))
    encoding, stamp_ns = b"", 0
    for first in range(0, len(offsets), IN_FLIGHT):
        calls = [
            (shard, Fetch(lock, epoch, state.slot, state.version, offset, length))
            for offset in offsets[first : first + IN_FLIGHT]
        ]
        timeout_s = FINISH_S + length * len(calls) / 10e6 if length < 1 << 30 else FINISH_S
        for (_, call), answer in zip(
            calls, client.call_all(calls, timeout_s=timeout_s), strict=True
        ):
            part = _checked(answer, call, state, lock)
            encoding, stamp_ns = part.encoding, part.stamp_ns
            if len(offsets) == 1:
                body = memoryview(part.body.body)
            else:
                body[call.offset : call.offset + part.body.size] = part.body.body
    if len(body) != state.size:
        raise ProtocolError(f"{state.slot}: {len(body)} bytes came instead of {state.size}")
    return Datum(encoding, body.toreadonly(), state.size, stamp_ns)


def _checked(answer: object, call: Fetch, state: SlotState, lock: LockId) -> Slice:
    """Return the answer if it is the asked slice, else raise what it stands for."""
    if isinstance(answer, Slice):
        wanted = min(call.length, state.size - call.offset)
        fits = (answer.slot, answer.version, answer.offset) == (
            state.slot,
            state.version,
            call.offset,
        )
        if not fits or answer.total != state.size or answer.body.size != wanted:
            raise ProtocolError(
                f"{state.slot}: a slice of {answer.body.size} bytes at"
                f" {answer.offset} came, {wanted} at {call.offset} was asked"
            )
        return answer
    if isinstance(answer, Gone | EpochChanged):
        raise LeaseLostError(
            f"version {state.version} of {state.slot} is kept for lock {lock} no more: the lock was"
            " lost or its shard restarted; take it again",
            cause="the datum is gone",
        )
    if isinstance(answer, Refused):
        raise error_of(answer)
    raise ProtocolError(f"{type(answer).__name__} came as the answer to Fetch")
