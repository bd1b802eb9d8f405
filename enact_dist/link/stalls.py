"""Logs when a shard or its disk stalls: its clients only see silence."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Callable

STALL_S: Final = 1.0
"""A batch that takes longer on disk, or a timer without a turn for longer, is logged."""

_log = logging.getLogger("enact.shard")


class Stalls:
    """Watches the clock and the disk of one shard.  For its timer's thread alone.

    Args:
        shard: The shard's name.
        count: Called with the name of a counter to add one to.
    """

    def __init__(self, shard: str, count: Callable[[str], None]) -> None:
        self._shard = shard
        self._count = count
        self._looked_s: float | None = None
        self._writing_since_s: float | None = None

    def look(self, writing_since_s: float | None, now_s: float) -> None:
        """Log each stall once when it is noticed and once when it is over.

        Args:
            writing_since_s: Start of the batch being written; None if there is none.
            now_s: The time now, on the same clock; to be called at least ten times a second.
        """
        looked_s, self._looked_s = self._looked_s, now_s
        if looked_s is not None and now_s - looked_s >= STALL_S:
            _log.warning(
                "shard %s had no turn for %.1f s: its process was stopped, or others used the"
                " processors",
                self._shard,
                now_s - looked_s,
            )
        told_s = self._writing_since_s
        if told_s is not None and writing_since_s != told_s:
            self._writing_since_s = None
            _log.warning("the disk of shard %s is back after %.1f s", self._shard, now_s - told_s)
        elif told_s is None and writing_since_s is not None and now_s - writing_since_s >= STALL_S:
            self._writing_since_s = writing_since_s
            self._count("disk_stalls")
            _log.warning(
                "the disk of shard %s has written nothing for %.1f s; commits and new clients wait",
                self._shard,
                now_s - writing_since_s,
            )
