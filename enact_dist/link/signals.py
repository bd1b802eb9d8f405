"""SIGTERM and SIGINT as an ordinary event: no lock is ever taken inside a signal handler.

A Python handler runs in the main thread between any two of its instructions, and nowhere else.

  * If that thread is just inside `Event.wait`, an `Event.set` (or a log line) in the handler waits
    for a lock that its own thread holds, for ever: a daemon that was told to stop the moment it was
    ready hung so, once in some hundred starts.
  * The kernel may give the signal to any other thread, and does after a SIGCONT; then nothing wakes
    the main thread, and a daemon that waits there never hears of it.

So nothing is done in the handler.  The interpreter's own C code writes the number of each signal to
a socket, in whichever thread it arrives, and a thread of ours reads it there and does the rest.
"""

from __future__ import annotations

import logging
import os
import signal
import socket
import threading
import time
from typing import TYPE_CHECKING, Final, Self

if TYPE_CHECKING:
    from collections.abc import Callable
    from types import FrameType

SAME_S: Final = 1.0
"""A signal this soon after the first belongs to the same request: `timeout` sends one to its
command and one to the group, systemd one to each process of a unit and `enact up` one more."""
STOPPING: Final = (signal.SIGTERM, signal.SIGINT)
_END: Final = 0

_log = logging.getLogger("enact.link")
_running: list[StopSignals] = []


def _leave_to_parent() -> None:
    """Let a forked child die of its signals; its parent's socket is none of its business."""
    if _running:
        signal.set_wakeup_fd(-1)
        for number, handler in _running[0].before.items():
            signal.signal(number, handler)
        _running.clear()


os.register_at_fork(after_in_child=_leave_to_parent)


class StopSignals:
    """Turns SIGTERM and SIGINT into an event while its block runs.  Main thread only.

    Attributes:
        event: Set by the first signal.
        count: How many requests to end came; signals within `SAME_S` of the first are one.
        before: The handlers outside of the block.
    """

    def __init__(self) -> None:
        self.event = threading.Event()
        self.count = 0
        self.before: dict[signal.Signals, Callable[[int, FrameType | None], object] | int | None]
        self._acts: list[Callable[[str], None]] = []
        self._acts_again: list[Callable[[str], None]] = []
        self._mutex = threading.Lock()
        self._name = ""
        self._thread = threading.Thread(target=self._serve, name="enact-signals", daemon=True)

    def __enter__(self) -> Self:
        self._numbers, self._arrivals = socket.socketpair()
        self._arrivals.setblocking(False)  # as the interpreter demands
        self._thread.start()
        self._fd_before = signal.set_wakeup_fd(self._arrivals.fileno(), warn_on_full_buffer=False)
        self.before = {number: signal.signal(number, _do_nothing) for number in STOPPING}
        _running.append(self)
        return self

    def __exit__(self, *_: object) -> None:
        _running.remove(self)
        for number, handler in self.before.items():
            signal.signal(number, handler)
        signal.set_wakeup_fd(self._fd_before)
        self._arrivals.setblocking(True)
        self._arrivals.sendall(bytes((_END,)))
        self._thread.join()
        self._arrivals.close()
        self._numbers.close()

    def call(self, act: Callable[[str], None]) -> None:
        """Call `act` with the signal's name at the first signal, at once if there was one."""
        with self._mutex:
            self._acts.append(act)
            name = self._name
        if name:
            act(name)

    def call_again(self, act: Callable[[str], None]) -> None:
        """Call `act` with the first signal's name at each request to end after the first."""
        with self._mutex:
            self._acts_again.append(act)

    def _serve(self) -> None:
        first_s = 0.0
        while (number := self._numbers.recv(1)[0]) != _END:
            if number not in STOPPING:
                continue  # of a handler that somebody else has set
            now_s = time.monotonic()
            if self.count and now_s - first_s < SAME_S:
                continue
            first_s = first_s if self.count else now_s
            self.count += 1
            with self._mutex:
                first, self._name = not self._name, signal.Signals(number).name
                acts = list(self._acts if first else self._acts_again)
            for act in acts:
                try:
                    act(self._name)
                except Exception:  # noqa: BLE001 - the process has to end all the same
                    _log.exception("what %s was to bring about has failed", self._name)
            self.event.set()


def _do_nothing(_: int, __: FrameType | None) -> None:
    """Be a handler, so that the signal neither ends the process nor is ignored."""
