"""The stop of an actor as its pulse: each time it looks whether to stop, it shows that it lives.

An actor that is idle, waits for a lock or was refused looks every 0.1 s.  One inside
`update` does not look: an update that hangs, or takes longer than the watchdog allows, is silent.
"""

from __future__ import annotations

import threading
import time
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Callable

LOOK_S: Final = 0.1
"""How often a wait looks."""


class StopWithPulse(threading.Event):
    """An event whose every look calls `alive`, in the thread that looks.

    Args:
        alive: Called with each sign of life; must not block.
    """

    def __init__(self, alive: Callable[[], None]) -> None:
        super().__init__()
        self._alive = alive

    def is_set(self) -> bool:
        """Return whether to stop."""
        self._alive()
        return super().is_set()

    def wait(self, timeout: float | None = None) -> bool:
        """Wait until it is set, or for `timeout` seconds; return whether to stop."""
        end_s = float("inf") if timeout is None else time.monotonic() + timeout
        while True:
            self._alive()
            left_s = end_s - time.monotonic()
            if super().wait(max(0.0, min(left_s, LOOK_S))) or left_s <= LOOK_S:
                return super().is_set()
