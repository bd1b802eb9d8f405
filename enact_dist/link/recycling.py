"""Lets the C library keep blocks of memory as long as a slice for the next one.

By itself it asks the system for each block over 128 KiB and gives it back at once, and the next
one touches all its pages anew: half the work of a shard that sends 10 MB.  glibc learns from the
first long block that is given back; for another C library this does nothing.
"""

from __future__ import annotations

from functools import cache
from typing import Final

RECYCLED_BYTES_MAX: Final = 16 << 20
"""Blocks up to this length are recycled; up to twice as much stays with an idle process."""


@cache
def recycle_blocks() -> None:
    """Make it so for the rest of this process; no page of the block is touched."""
    bytes(RECYCLED_BYTES_MAX)
