"""SIGTERM and SIGINT as an ordinary event: no lock is ever taken inside a signal handler.

A Python handler runs in the main thread, between any two of its instructions.

  * If that thread is inside `Event.wait`, an `Event.set` (or a log line) in the handler waits
    forever for a lock that its own thread holds.  A daemon that was stopped the moment it was ready
    hung this way in about one start of a hundred.
  * The kernel may deliver the signal to any other thread, and does so after a SIGCONT; nothing then
    wakes the main thread, so a daemon that waits there misses the signal.

So the handler does nothing.  The interpreter's C code writes the number of each signal to a socket,
in whatever thread it arrives; a thread of ours reads it and does the rest.

`Uninterrupted` keeps Ctrl-C out of a few statements that must not be half executed.
"""

from __future__ import annotations

import importlib
import logging
import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable
from threading import get_ident
from types import FrameType
from typing import Any, Final, Self

SAME_S: Final = 1.0
"""A signal this soon after the first is the same request: `timeout` signals its command and its
group, systemd each process of a unit, and `enact up` sends one more.
"""
STOPPING: Final = (signal.SIGTERM, signal.SIGINT)
_END: Final = 0
# `signal` converts to enumerations and back, which takes 5 us a call instead of 0.5.
_plain: Final[Any] = importlib.import_module(
    "_signal" if sys.implementation.name == "cpython" else "signal"
)
_SIGINT: Final = int(signal.SIGINT)

_log = logging.getLogger("enact.link")
_running: list[StopSignals] = []


def _leave_to_parent() -> None:
    """Restore default handlers in a forked child, which must not use its parent's socket."""
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
        count: Number of requests to end; signals within `SAME_S` of the first count as one.
        before: The handlers outside the block.
    """

    def __init__(self) -> None:
        self.event = threading.Event()
        self.count = 0
        self.before: dict[signal.Signals, Callable[[int, FrameType | None], object] | int | None]
        self._acts: list[Callable[[str], None]] = []
        self._acts_again: list[Callable[[str], None]] = []
        self._others: dict[int, Callable[[], object]] = {}
        self._mutex = threading.Lock()
        self._name = ""
        self._thread = threading.Thread(target=self._serve, name="enact-signals", daemon=True)

    def __enter__(self) -> Self:
        self._numbers, self._arrivals = socket.socketpair()
        self._arrivals.setblocking(False)  # required by the interpreter
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
        """Call `act` with the signal's name at the first signal, or at once after it."""
        with self._mutex:
            self._acts.append(act)
            name = self._name
        if name:
            act(name)

    def call_again(self, act: Callable[[str], None]) -> None:
        """Call `act` with the first signal's name at each request to end after the first."""
        with self._mutex:
            self._acts_again.append(act)

    def call_at(self, number: signal.Signals, act: Callable[[], object]) -> None:
        """Call `act` at each signal of another number, until the block ends.  Main thread only."""
        self._others[number] = act
        self.before[number] = signal.signal(number, _do_nothing)

    def _serve(self) -> None:
        first_s = 0.0
        while (number := self._numbers.recv(1)[0]) != _END:
            if (other := self._others.get(number)) is not None:
                try:
                    other()
                except Exception:  # noqa: BLE001 - the next signal may be to end
                    _log.exception("an action on signal %d has failed", number)
                continue
            if number not in STOPPING:
                continue  # for another handler
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
                    _log.exception("an action on %s has failed", self._name)
            self.event.set()


def _do_nothing(_: int, __: FrameType | None) -> None:
    """Do nothing; as a handler it keeps the signal from ending the process or being ignored."""


class Uninterrupted:
    """Delays Ctrl-C to the end of a block of the main thread; costs 2 us.

    Python raises `KeyboardInterrupt` between any two bytecodes of the main thread.  That thread
    also calls a shard in this process, and a half-made decision must not be used.  Masking the
    signal would not help: another thread receives it, and Python still raises in this one.

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
