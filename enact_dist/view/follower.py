"""A thread that follows the cell for all pages, from `start` to `stop`."""

from __future__ import annotations

import contextlib
import threading
from abc import ABC, abstractmethod
from pathlib import Path


def show_name(name: str) -> None:
    """Name the calling thread for `top -H` and for `enact bench view`: its first 15 letters."""
    with contextlib.suppress(OSError):  # Linux alone has it
        Path("/proc/thread-self/comm").write_text(name)


class Follower(ABC):
    """One thread, and the condition on which it waits.

    Args:
        name: Of the thread.
    """

    def __init__(self, name: str) -> None:
        self._news = threading.Condition()
        self._stopped = False
        self._thread = threading.Thread(target=self._begin, name=name, daemon=True)

    def _begin(self) -> None:
        show_name(self._thread.name)
        self._run()

    @abstractmethod
    def _run(self) -> None:
        """Work until `_stopped` is set."""

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def stop(self) -> None:
        """End; twice is harmless."""
        with self._news:
            self._stopped = True
            self._news.notify_all()
        if self._thread.ident is not None:
            self._thread.join()
