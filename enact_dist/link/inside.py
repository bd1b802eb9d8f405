"""Counts threads inside Zenoh: shutdown must wait for them, or the interpreter aborts."""

from __future__ import annotations

import threading


class Inside:
    """Counts the threads inside Zenoh, so that shutdown can wait for them."""

    __slots__ = ("_changed", "_count")

    def __init__(self) -> None:
        self._changed = threading.Condition(threading.Lock())
        self._count = 0

    def __enter__(self) -> None:
        with self._changed:
            self._count += 1

    def __exit__(self, *_: object) -> None:
        with self._changed:
            self._count -= 1
            if not self._count:
                self._changed.notify_all()

    def wait_empty(self, timeout_s: float) -> bool:
        """Wait until no thread is inside; return whether that happened in time."""
        with self._changed:
            return self._changed.wait_for(lambda: not self._count, timeout_s)
