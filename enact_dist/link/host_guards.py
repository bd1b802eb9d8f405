"""Logs when a shard or its disk stalls: its clients only see silence.

Keeps Ctrl-C out of a few statements that must not be half executed.

Python raises `KeyboardInterrupt` between any two bytecodes of the main thread.  That thread also
calls a shard in this process, and a half-made decision must not be used.  Masking the signal would
not help: another thread receives it, and Python still raises in this one.
"""

from __future__ import annotations

import importlib
import logging
import signal
import sys
import threading
from threading import get_ident
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from collections.abc import Callable
    from types import FrameType

# `signal` converts to enumerations and back, which takes 5 us a call instead of 0.5.
_plain: Final[Any] = importlib.import_module(
    "_signal" if sys.implementation.name == "cpython" else "signal"
)
_SIGINT: Final = int(signal.SIGINT)


class Uninterrupted:
    """Delays Ctrl-C to the end of a block of the main thread; costs 2 us.

    In other threads, and if SIGINT raises nothing, it does nothing.  Reusable, but not nested.

    Attributes:
        main: The identifier of the main thread.
    """

    __slots__ = ("_before", "_pending", "main")

    def __init__(self) -> None:
        self.main = threading.main_thread().ident
        self._before: Any = None
        self._pending: tuple[int, FrameType | None] | None = None

    def __enter__(self) -> None:
        if get_ident() == self.main and callable(_plain.getsignal(_SIGINT)):
            self._before = _plain.signal(_SIGINT, self._defer)

    def _defer(self, number: int, frame: FrameType | None) -> None:
        self._pending = (number, frame)

    def __exit__(self, *_: object) -> None:
        before = self._before
        if before is not None:
            self._before = None
            _plain.signal(_SIGINT, before)
            pending, self._pending = self._pending, None
            if pending is not None:
                before(*pending)


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
