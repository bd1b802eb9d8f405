"""What a lock went through, in times and counts."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class LockStatistics:
    """What a lock went through.

    Attributes:
        granted: Whether it was granted.
        waited_s: From asking to the grant.
        held_s: From the grant to the end of the block, or until now.
        shards: The shards that it locked.
        fetched: How many data were decoded.
    """

    granted: bool
    waited_s: float
    held_s: float
    shards: tuple[str, ...]
    fetched: int
