"""Keeps Ctrl-C out of a few statements that must not be half executed.

Python raises `KeyboardInterrupt` between any two bytecodes of the main thread.  That thread also
calls a shard in this process, and a half-made decision must not be used.  Masking the signal would
not help: another thread receives it, and Python still raises in this one.
"""

from __future__ import annotations

import importlib
import signal
import sys
import threading
from threading import get_ident
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from types import FrameType

# `signal` converts to enumerations and back, which takes 5 us a call instead of 0.5.
_plain: Final[Any] = importlib.import_module(
    "_signal" if sys.implementation.name == "cpython" else "signal"
)
_SIGINT: Final = int(signal.SIGINT)


class Uninterrupted:
    """Delays Ctrl-C to the end of a block of the main thread; costs 2 us.

    In other threads, and if SIGINT raises nothing, it does nothing.  Reusable, but not nested.
    """

    __slots__ = ("_before", "_main", "_pending")

    def __init__(self) -> None:
        self._main = threading.main_thread().ident
        self._before: Any = None
        self._pending: tuple[int, FrameType | None] | None = None

    def __enter__(self) -> None:
        if get_ident() == self._main and callable(_plain.getsignal(_SIGINT)):
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
