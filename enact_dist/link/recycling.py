"""Makes the C library recycle memory blocks as large as a slice.

By default it requests each block over 128 KiB from the system and returns it at once, so the next
block touches all its pages for the first time: half the work of a shard that sends 10 MB.  glibc
adapts after the first long block is freed; with other C libraries this has no effect.
"""

from __future__ import annotations

from functools import cache
from typing import Final

RECYCLED_BYTES_MAX: Final = 16 << 20
"""Blocks up to this length are recycled; an idle process keeps up to twice as much."""


@cache
def recycle_blocks() -> None:
    """Enable recycling for the rest of this process; touches no page of the block."""
    bytes(RECYCLED_BYTES_MAX)
