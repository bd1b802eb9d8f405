"""Epochs of shards: what a number says of the shard that began it, and how far it is in it."""

from __future__ import annotations

from typing import Final

UNKEPT_FROM: Final = 10**11
"""Epochs from here on are milliseconds since 1970, of shards that keep nothing; lower ones are
seconds, or one more than the epoch before, of shards that do."""


def unkept_epoch(wall_ns: int) -> int:
    """Return the epoch of a shard that keeps nothing, so knows none before.

    It grows by the millisecond: two starts may come within a second.
    """
    return wall_ns // 1_000_000


def is_kept(epoch: int) -> bool:
    """Whether a shard has begun this epoch with what it had kept of the one before."""
    return epoch < UNKEPT_FROM


def state_of(*, grants: bool, draining: bool) -> str:
    """Say in words whether a shard grants locks, and if not, why."""
    if grants:
        return "open"
    return "drains" if draining else "waits for older leases"
