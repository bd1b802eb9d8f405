"""Hybrid logical time of one shard: the stamps of its commits (Kulkarni et al. 2014).

A stamp is the shard's wall clock in nanoseconds where that moves on, else one more than the last
stamp; and it exceeds every stamp that the committing client had seen, so that cause comes before
effect over all shards without synchronised clocks.
"""

from __future__ import annotations

from typing import Final

AHEAD_NS_MAX: Final = 1_000_000_000
"""A client's stamp may lie this far ahead of our wall clock; more is a wrong clock somewhere."""


class Stamps:
    """The clock of one shard.  Strictly increasing."""

    __slots__ = ("last_ns",)

    def __init__(self, last_ns: int) -> None:
        self.last_ns = last_ns

    def too_far_ahead(self, seen_ns: int, *, wall_ns: int) -> bool:
        """Whether a stamp from elsewhere would drag this clock away from the wall clock."""
        return seen_ns > max(wall_ns, self.last_ns) + AHEAD_NS_MAX

    def next(self, *, seen_ns: int, wall_ns: int) -> int:
        """Return the stamp of a new commit by a client that has seen stamps up to `seen_ns`."""
        self.last_ns = max(self.last_ns + 1, seen_ns + 1, wall_ns)
        return self.last_ns

    def saw(self, stamp_ns: int) -> None:
        """Come after a stamp that was decided elsewhere."""
        self.last_ns = max(self.last_ns, stamp_ns)

    def now(self, *, wall_ns: int) -> int:
        """Return the present; every later commit gets a larger stamp."""
        self.last_ns = max(self.last_ns, wall_ns)
        return self.last_ns
