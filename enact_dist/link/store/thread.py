"""The thread that writes a shard's records, so that no lock waits while the disk is forced.

Group commit: everything submitted while one batch is written forms the next one, forced to the disk
once.  An idle store writes at once; a busy one gets larger batches instead of a longer queue.
"""

from __future__ import annotations

import threading
import time
from typing import TYPE_CHECKING, Final

from enact_dist.core.state.clock import Latencies

if TYPE_CHECKING:
    from collections.abc import Callable

    from enact_dist.core.protocol.records import Persist
    from enact_dist.link.store.store import Store

REPORTED_MAX: Final = 8
"""Tickets reported at once: about 1 ms, during which the host holds its mutex."""
HAND_ON_S: Final = 0.00005
"""Pause in between: a mutex stays with a thread that reacquires it at once."""


class StoreThread:
    """Writes submitted records in order, and reports them.  Thread-safe.

    Args:
        store: Used only by this thread until `close` has returned.
        done: Called from the thread with the nonzero tickets of each stored batch, in order;
            several times for a large batch, so that others get turns in between.
        failed: Called from the thread, once, when the store has failed; nothing is written or
            reported afterwards.

    Attributes:
        writing_since_s: Start of the batch being written, on the monotonic clock; None: no batch.
        latencies: How long batches took, forcing included.
    """

    def __init__(
        self,
        store: Store,
        done: Callable[[list[int]], None],
        failed: Callable[[Exception], None],
    ) -> None:
        self._store = store
        self._done = done
        self._failed = failed
        self._wake = threading.Condition(threading.Lock())
        self._queue: list[Persist] = []
        self._ending = False
        self.writing_since_s: float | None = None
        self.latencies = Latencies()
        self._thread = threading.Thread(target=self._run, name="enact-store", daemon=True)
        self._thread.start()

    def submit(self, persist: Persist) -> None:
        """Queue a `Persist`; never blocks.  After a failure or `close` nothing is reported."""
        with self._wake:
            if not self._ending:
                self._queue.append(persist)
                self._wake.notify()

    def close(self) -> None:
        """Write and report everything submitted so far, then end; idempotent.

        Do not call it while holding a lock that `done` or `failed` takes.
        """
        with self._wake:
            self._ending = True
            self._wake.notify()
        if threading.current_thread() is not self._thread:
            self._thread.join()

    def _run(self) -> None:
        try:
            while self._write_batch():
                self._store.rest()
        except Exception as failure:  # noqa: BLE001 - whatever it was, nothing may be acknowledged
            with self._wake:
                self._ending = True
                self._queue.clear()
            self._failed(failure)

    def _write_batch(self) -> bool:
        """Write and report the queued records; return False at the end."""
        batch = self._next_batch()
        if batch:
            self.writing_since_s = started_s = time.monotonic()
            self._store.write(batch)
            self.writing_since_s = None
            self.latencies.add(time.monotonic() - started_s)
            tickets = [persist.ticket for persist in batch if persist.ticket]
            for first in range(0, len(tickets), REPORTED_MAX):
                if first:
                    time.sleep(HAND_ON_S)
                self._done(tickets[first : first + REPORTED_MAX])
        return bool(batch)

    def _next_batch(self) -> list[Persist]:
        """Wait for records; return all of them, or nothing at the end."""
        with self._wake:
            while not self._queue and not self._ending:
                self._wake.wait()
            batch, self._queue = self._queue, []
            return batch
