"""SIGTERM and SIGINT as an ordinary event: no lock is ever taken inside a signal handler.

A handler runs in the main thread between any two of its instructions.  If that thread is just
inside `Event.wait`, an `Event.set` (or a log line) in the handler waits for a lock that its own
thread holds, for ever: a daemon that was told to stop the moment it was ready hung so, once in some
hundred starts.  So the handler only puts the number into a `SimpleQueue`, whose `put` may interrupt
itself, and a thread does the rest.
"""

from __future__ import annotations

import queue
import signal
import threading
from typing import TYPE_CHECKING, Final, Self

if TYPE_CHECKING:
    from collections.abc import Callable
    from types import FrameType

STOPPING: Final = (signal.SIGTERM, signal.SIGINT)
_END: Final = 0


class StopSignals:
    """Turns SIGTERM and SIGINT into an event while its block runs.  Main thread only.

    Attributes:
        event: Set by the first signal.
        count: How many signals came.
    """

    def __init__(self) -> None:
        self.event = threading.Event()
        self.count = 0
        self._numbers: queue.SimpleQueue[int] = queue.SimpleQueue()
        self._acts: list[Callable[[str], None]] = []
        self._mutex = threading.Lock()
        self._name = ""
        self._thread = threading.Thread(target=self._serve, name="enact-signals", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        self._before = {number: signal.signal(number, self._take) for number in STOPPING}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)
        self._numbers.put(_END)
        self._thread.join()

    def call(self, act: Callable[[str], None]) -> None:
        """Call `act` with the signal's name at the first signal, at once if there was one."""
        with self._mutex:
            self._acts.append(act)
            name = self._name
        if name:
            act(name)

    def _take(self, number: int, _: FrameType | None) -> None:
        self.count += 1
        self._numbers.put(number)

    def _serve(self) -> None:
        while (number := self._numbers.get()) != _END:
            with self._mutex:
                first, self._name = not self._name, signal.Signals(number).name
                acts = list(self._acts) if first else []
            for act in acts:
                act(self._name)
            self.event.set()
