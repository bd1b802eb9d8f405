"""`lock.newer`: tells a running motion that its version is no longer the newest."""

from __future__ import annotations

import threading
import time
from typing import Final

LOOK_S: Final = 0.1
"""How often a wait looks whether the actor is to stop."""


class Newer:
    """An event: the version was replaced or deleted, or the actor must stop.

    Any thread may check it at any rate: a check sends no message and holds no lock.  If an update
    has seen the event and returns, its outcome is the reason; otherwise its outcome is "done".

    Args:
        stop: Set when the actor is to stop.
    """

    def __init__(self, stop: threading.Event | None = None) -> None:
        self._stop = stop
        self._event = threading.Event()
        self._reason = ""
        self._owner = threading.get_ident()
        self._seen = False

    def set(self, reason: str) -> None:
        """Let it be seen; the first reason stays."""
        if not self._event.is_set():
            self._reason = reason
            self._event.set()

    def is_set(self) -> bool:
        """Return whether to end the motion now."""
        if not self._event.is_set() and self._is_to_stop():
            self.set("stopped")
        self._seen = self._seen or self._event.is_set()
        return self._event.is_set()

    def wait(self, timeout_s: float | None = None) -> bool:
        """Wait until it is set, or for `timeout_s`; return whether it is set."""
        end_s = float("inf") if timeout_s is None else time.monotonic() + timeout_s
        while not self.is_set():
            left_s = end_s - time.monotonic()
            if left_s <= 0:
                return False
            self._event.wait(min(left_s, LOOK_S))
        return True

    @property
    def reason(self) -> str:
        """Why it is set: "preempted" (a newer version), "cancelled" (deleted), "stopped"; or ""."""
        return self._reason if self.is_set() else ""

    def ended(self) -> str:
        """Return the outcome of an update that returned: "done", or the reason that it saw."""
        return self._reason if self._seen else "done"

    def _is_to_stop(self) -> bool:
        if self._stop is None:
            return False
        if threading.get_ident() == self._owner:
            return self._stop.is_set()  # the look of the actor's own thread is its sign of life
        return threading.Event.is_set(self._stop)
