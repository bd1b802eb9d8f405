"""Which slots have the largest data: found at once, however many there are.

Slots stand in groups by the power of two of their size.  A question looks at the topmost groups,
and there at some of each: what it names is as large as the largest ones, or half of it at least.
"""

from __future__ import annotations

from heapq import nlargest
from itertools import islice
from operator import itemgetter
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from enact_dist.core.protocol.datum import Slot

LARGE_BYTES: Final = 64 << 10
"""Smaller data are not counted: they never lie in shared memory."""
LOOKED_MAX: Final = 1000
"""Slots of a group that one question looks at."""


class LargeSlots:
    """The slots whose newest data are large."""

    __slots__ = ("_groups",)

    def __init__(self) -> None:
        self._groups: dict[int, dict[Slot, int]] = {}

    def change(self, slot: Slot, *, before: int, after: int) -> None:
        """Note that the datum of a slot has so many bytes now (0: it is null, or gone)."""
        if before >= LARGE_BYTES:
            group = self._groups[before.bit_length()]
            del group[slot]
            if not group:
                del self._groups[before.bit_length()]
        if after >= LARGE_BYTES:
            self._groups.setdefault(after.bit_length(), {})[slot] = after

    def largest(self, count: int) -> list[tuple[str, int]]:
        """Return slots with the largest data, with their bytes; fewer where few are large."""
        found: list[tuple[Slot, int]] = []
        for exponent in sorted(self._groups, reverse=True):
            found += islice(self._groups[exponent].items(), LOOKED_MAX)
            if len(found) >= count:
                break
        return [(str(slot), size) for slot, size in nlargest(count, found, key=itemgetter(1))]
