"""Rare events of Zenoh, received by a thread that sleeps until one comes.

A thread that waits in a channel of Zenoh's binding wakes ten times a second to check for signals:
three such threads cost an idle client 0.1 % of a core.  A callback's thread sleeps.  Its properties
(Zenoh 1.10):

- It takes events from a channel of 256, and Zenoh's receiving thread waits while that is full.
  Notices and answers, which may be many, use larger channels.
- It is a daemon if the thread that declares the listener is one.  Otherwise the interpreter waits
  forever for it before it calls `atexit`, which closes sessions left open.
- It ends with the session or the listener, and then calls `drop`.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from typing import Generic, TypeVar

import zenoh

E = TypeVar("E")

_log = logging.getLogger("enact.link")


class Events(Generic[E]):
    """A listener, until its session is closed.  Its owner must never free it in a forked child.

    Args:
        name: Name of the thread in debuggers, once there was an event.
        declare: Declares the listener with the given callback.
        heard: Called with each event, one at a time, from the listener's thread.

    Raises:
        ZError: The session is closed.
        RuntimeError: The system has no more threads.
    """

    def __init__(
        self,
        name: str,
        declare: Callable[[zenoh.handlers.Callback[E]], object],
        heard: Callable[[E], None],
    ) -> None:
        self._name = name
        self._heard = heard
        self._thread: threading.Thread | None = None
        self._over = threading.Event()
        self._listener: object = None
        failed: list[BaseException] = []

        def declare_here() -> None:
            try:
                self._listener = declare(zenoh.handlers.Callback(self._hear, self._end))
            except BaseException as error:  # noqa: BLE001 - raised again below
                failed.append(error)

        declaring = threading.Thread(target=declare_here, name="enact-declare", daemon=True)
        declaring.start()
        declaring.join()
        if failed:
            raise failed[0]

    def _hear(self, event: E) -> None:
        threading.current_thread().name = self._name
        try:
            self._heard(event)
        except Exception as error:  # noqa: BLE001 - the next event is heard all the same
            _log.error("cannot handle an event of a connection: %s", error)

    def _end(self) -> None:
        self._thread = threading.current_thread()
        self._over.set()

    def join(self, wait_s: float) -> None:
        """Wait for the thread, which ends after the session."""
        ended = self._over.wait(wait_s)
        if ended and self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join(wait_s)
