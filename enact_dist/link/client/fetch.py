"""Fetches data for a client: from its cache, or in slices directly into their final memory.

Data of all shards are fetched together through one window (`Transfer`): the slices of many matching
images follow each other like those of one large cloud.

The cache holds data that this process has seen, so that a shard does not send them again, by
(shard, epoch, slot, version): versions of volatile slots start again with each epoch, so a version
alone would be ambiguous.  It has a byte limit and evicts the least recently used data first.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from enact_dist.core.protocol.datum import Datum, LockId, Slot
from enact_dist.core.protocol.messages import Answer, EpochChanged, Fetch, Gone, Slice, SlotState
from enact_dist.errors import LeaseLostError, ProtocolError
from enact_dist.link.client.transfer import Piece, Transfer, in_turn
from enact_dist.link.memory.maps import RECYCLED_BYTES_MAX, body_of, plain_memory
from enact_dist.link.refusals import error_for
from enact_dist.wire.limits import BODY_BYTES_MAX

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from enact_dist.core.client.plan import Reading
    from enact_dist.link.client.locks import CellClient

CACHE_BYTES_MAX: Final = 256 << 20
CACHED_BYTES_MIN: Final = 1024
"""Smaller data cost less to send again than to look up, bytes."""


class _Known(NamedTuple):
    shard: str
    epoch: int
    version: int
    datum: Datum


class DatumCache:
    """The newest datum of each slot that this process has seen, up to a byte limit.

    Attributes:
        known: The data by slot; only this class changes them.
    """

    def __init__(self, bytes_max: int = CACHE_BYTES_MAX) -> None:
        self._bytes_max = bytes_max
        self.known: OrderedDict[Slot, _Known] = OrderedDict()
        self._bytes = 0
        self._mutex = threading.Lock()

    def __contains__(self, slot: Slot) -> bool:
        return slot in self.known

    def version(self, slot: Slot, shard: str, epoch: int) -> int:
        """Return the known version of a slot in this epoch (0: none)."""
        with self._mutex:
            known = self.known.get(slot)
        return known.version if known and (known.shard, known.epoch) == (shard, epoch) else 0

    def get(self, slot: Slot, shard: str, epoch: int, version: int) -> Datum | None:
        """Return the datum of exactly this version, if it is cached."""
        with self._mutex:
            known = self.known.get(slot)
            if known is None or (known.shard, known.epoch, known.version) != (
                shard,
                epoch,
                version,
            ):
                return None
            self.known.move_to_end(slot)
            return known.datum

    def put(self, slot: Slot, shard: str, epoch: int, version: int, datum: Datum) -> None:
        """Store a datum; evict older ones beyond the limit.

        A datum of the past never replaces a newer one.
        """
        if not CACHED_BYTES_MIN <= datum.size <= self._bytes_max:
            return
        with self._mutex:
            old = self.known.get(slot)
            if old is not None:
                if (old.shard, old.epoch) == (shard, epoch) and version < old.version:
                    return
                del self.known[slot]
                self._bytes -= old.datum.size
            self.known[slot] = _Known(shard, epoch, version, datum)
            self._bytes += datum.size
            while self._bytes > self._bytes_max:
                _, dropped = self.known.popitem(last=False)
                self._bytes -= dropped.datum.size


def fetch_all(
    client: CellClient,
    cache: DatumCache,
    lock: LockId,
    readings: Iterable[Reading],
    alive: Callable[[], None] = lambda: None,
) -> dict[Slot, Datum]:
    """Return the data of `readings`, from the grant, the cache, or in slices.

    Args:
        client: The session that took the grant or view.
        cache: Where to look first; receives the fetched data.
        lock: The lock that pins the data.
        readings: States with a datum (not null), each with its shard and epoch.
        alive: Raises if the data are no longer wanted; called after each lost answer.

    Raises:
        LeaseLostError: A shard no longer keeps one of these versions for the lock.
        ShardUnreachableError: A shard does not answer.
        ProtocolError: The answers do not fit together.
    """
    found: dict[Slot, Datum] = {}
    missing: list[_Incoming] = []
    for reading in readings:
        datum = at_hand(client, cache, reading)
        if datum is not None:
            found[reading.state.slot] = datum
        else:
            missing.append(_Incoming(lock, reading, client.carrier.fetch_bytes))
    if not missing:
        return found
    by_shard: dict[str, list[Iterator[Piece]]] = {}
    for incoming in missing:
        by_shard.setdefault(incoming.reading.shard, []).append(incoming.pieces())
    Transfer(client, alive).run(in_turn(by_shard))
    for incoming in missing:
        datum = found[incoming.state.slot] = incoming.datum()
        reading = incoming.reading
        cache.put(reading.state.slot, reading.shard, reading.epoch, reading.state.version, datum)
    return found


def at_hand(client: CellClient, cache: DatumCache, reading: Reading) -> Datum | None:
    """Return the datum of a reading that carries it, or names it in shared memory, or is cached."""
    shard, epoch, state = reading
    if state.datum is not None and not state.large:
        cache.put(state.slot, shard, epoch, state.version, state.datum)
        return state.datum
    named = state.datum
    if named is not None and named.file:
        body = client.payloads.mapped(shard, epoch, named.file, state.size)
        if body is not None:
            return replace(named, body=body)
    return cache.get(state.slot, shard, epoch, state.version)


class _Incoming:
    """One datum that arrives in slices, and their destinations."""

    def __init__(self, lock: LockId, reading: Reading, slice_bytes: int) -> None:
        self.reading = reading
        self.state = reading.state
        if self.state.size > BODY_BYTES_MAX:
            raise ProtocolError(f"a shard announced {self.state.size} bytes for {self.state.slot}")
        self._lock = lock
        self._slice_bytes = slice_bytes
        self._offsets = range(0, max(1, self.state.size), slice_bytes)
        self.count = len(self._offsets)
        self._body: memoryview | None = None
        self._encoding, self._stamp_ns = b"", 0

    def pieces(self) -> Iterator[Piece]:
        """Yield its slices; the first one allocates memory for all."""
        shard, epoch, state = self.reading
        if self.count > 1:
            self._body = _room(state.size)
        for offset in self._offsets:
            call = Fetch(self._lock, epoch, state.slot, state.version, offset, self._slice_bytes)
            size = min(self._slice_bytes, state.size - offset)
            into = None if self._body is None else self._body[offset : offset + size]
            yield Piece(shard, call, size, partial(self._take, call, into), into)

    def _take(self, call: Fetch, into: memoryview | None, answer: Answer) -> None:
        part = _checked(answer, call, self.state, self._lock)
        self._encoding, self._stamp_ns = part.encoding, part.stamp_ns
        came = part.body.body
        if into is None:
            self._body = memoryview(came)
        elif not (isinstance(came, memoryview) and came.obj is into.obj):
            into[:] = came

    def datum(self) -> Datum:
        """Return the complete datum."""
        body = self._body if self._body is not None else memoryview(b"")
        return Datum(self._encoding, body.toreadonly(), self.state.size, self._stamp_ns)


def _room(size: int) -> memoryview:
    """Return memory for a datum that comes in slices, not zeroed.

    Ordinary memory may be recycled, which avoids page faults.  A separate thread frees blocks too
    long for that.  Huge pages (2 MB) were slower than either.
    """
    if size > RECYCLED_BYTES_MAX:
        return body_of(plain_memory(size))
    return np.empty(size, np.uint8).data


def _checked(answer: Answer, call: Fetch, state: SlotState, lock: LockId) -> Slice:
    """Return the answer if it is the requested slice, else raise its error."""
    if isinstance(answer, Slice):
        wanted = min(call.length, state.size - call.offset)
        fits = (answer.slot, answer.version, answer.offset) == (
            state.slot,
            state.version,
            call.offset,
        )
        if not fits or answer.total != state.size or answer.body.size != wanted:
            raise ProtocolError(
                f"{state.slot}: got a slice of {answer.body.size} bytes at"
                f" {answer.offset} instead of {wanted} at {call.offset}"
            )
        return answer
    if isinstance(answer, Gone | EpochChanged):
        raise LeaseLostError(
            f"version {state.version} of {state.slot} is no longer kept for lock {lock}: the lock"
            " was lost or its shard restarted; take it again",
            cause="the datum was removed",
        )
    raise error_for(answer, "a Fetch")
