"""Rare events of Zenoh, heard by a thread that sleeps until there is one.

Whoever waits in a channel of Zenoh's binding wakes ten times a second to look for signals: three
such threads cost an idle client 0.1 % of a core.  The thread of a callback sleeps.  What has to be
known of it (Zenoh 1.10):

- It takes events from a channel of 256, and Zenoh's receiving thread waits while that is full.
  Notices and answers, of which there can be many, keep to larger channels.
- It is a daemon if the thread that declares the listener is one.  Otherwise the interpreter waits
  for it before it calls `atexit`, where sessions that were left open are closed: for ever.
- It ends with the session or the listener, and says so by calling `drop`.
"""

from __future__ import annotations

import logging
import threading
from typing import TYPE_CHECKING, Generic, TypeVar

import zenoh

if TYPE_CHECKING:
    from collections.abc import Callable

E = TypeVar("E")

_log = logging.getLogger("enact.link")


class Events(Generic[E]):
    """A listener, until its session is closed.  Who keeps it never frees it in a forked child.

    Args:
        name: Of the thread, as debuggers show it once there was an event.
        declare: Declares the listener with the callback that it is given.
        heard: Called with each event, one at a time, from a thread of the listener's own.

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
            _log.error("an event of a connection could not be dealt with: %s", error)

    def _end(self) -> None:
        self._thread = threading.current_thread()
        self._over.set()

    def join(self, wait_s: float) -> None:
        """Wait for the end of the thread, which follows that of the session."""
        ended = self._over.wait(wait_s)
        if ended and self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join(wait_s)
