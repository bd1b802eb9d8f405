"""Data that this process has seen, by version, so that a shard does not send them again.

The key of a datum is (shard, epoch, slot, version): versions of volatile slots start again with
each epoch, so a version alone would be ambiguous.  The cache has a byte limit and evicts the least
recently used data first.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from typing import TYPE_CHECKING, Final, NamedTuple

if TYPE_CHECKING:
    from enact_dist.core.datum import Datum, Slot

CACHE_BYTES_MAX: Final = 256 << 20
CACHED_BYTES_MIN: Final = 1024
"""Smaller data cost less to send again than to look up, bytes."""


class _Known(NamedTuple):
    shard: str
    epoch: int
    version: int
    datum: Datum


class DatumCache:
    """The newest datum of each slot that this process has seen, up to a byte limit."""

    def __init__(self, bytes_max: int = CACHE_BYTES_MAX) -> None:
        self._bytes_max = bytes_max
        self._known: OrderedDict[Slot, _Known] = OrderedDict()
        self._bytes = 0
        self._mutex = threading.Lock()

    def __contains__(self, slot: Slot) -> bool:
        return slot in self._known

    def version(self, slot: Slot, shard: str, epoch: int) -> int:
        """Return the known version of a slot in this epoch (0: none)."""
        with self._mutex:
            known = self._known.get(slot)
        return known.version if known and (known.shard, known.epoch) == (shard, epoch) else 0

    def get(self, slot: Slot, shard: str, epoch: int, version: int) -> Datum | None:
        """Return the datum of exactly this version, if it is cached."""
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
        """Store a datum; evict older ones beyond the limit.

        A datum of the past never replaces a newer one.
        """
        if not CACHED_BYTES_MIN <= datum.size <= self._bytes_max:
            return
        with self._mutex:
            old = self._known.get(slot)
            if old is not None:
                if (old.shard, old.epoch) == (shard, epoch) and version < old.version:
                    return
                del self._known[slot]
                self._bytes -= old.datum.size
            self._known[slot] = _Known(shard, epoch, version, datum)
            self._bytes += datum.size
            while self._bytes > self._bytes_max:
                _, dropped = self._known.popitem(last=False)
                self._bytes -= dropped.datum.size
