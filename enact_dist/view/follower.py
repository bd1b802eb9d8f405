"""A thread that follows the cell for all pages, from `start` to `stop`."""

from __future__ import annotations

import contextlib
import os
import threading
from abc import ABC, abstractmethod
from pathlib import Path
from typing import Final

NICER: Final = 5
"""How much lower than that of the cell the priority of the view's threads is: who looks waits."""


def stand_back(name: str) -> None:
    """Lower the priority of the calling thread, and name it for `top -H`: its first 15 letters.

    Idempotent: it counts from the main thread, since a thread begins with what its maker has.
    """
    with contextlib.suppress(OSError):  # Linux alone has both
        Path("/proc/thread-self/comm").write_text(name)
        own = os.getpriority(os.PRIO_PROCESS, os.getpid())
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), own + NICER)


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
        stand_back(self._thread.name)
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
