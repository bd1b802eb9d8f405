"""The thread that writes a shard's records, so that no lock waits while the disk is forced.

Group commit: whatever was submitted while one batch was written makes the next one, and shares its
one forcing of the disk.  An idle store writes at once; a busy one gets larger batches, not a
longer queue.
"""

from __future__ import annotations

import threading
import time
from typing import TYPE_CHECKING, Final, Protocol

from enact_dist.core.latencies import Latencies

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from enact_dist.core.records import Persist

REPORTED_MAX: Final = 8
"""Tickets reported at once: about 1 ms, for which a host keeps its mutex."""
HAND_ON_S: Final = 0.00005
"""How long the thread rests in between: a mutex stays with its releaser if that asks at once."""


class BatchStore(Protocol):
    """What the thread writes to: a `Store`."""

    def write(self, batch: Sequence[Persist]) -> None:
        """Apply a batch whole; raise when it cannot be kept."""

    def rest(self) -> None:
        """Do what can wait until the batch is acknowledged."""


class StoreThread:
    """Writes what is submitted, in order, and reports it.  Thread-safe.

    Args:
        store: Used by this thread only, until `close` has returned.
        done: Called from the thread with the tickets of each batch kept, in order, without those
            that are 0; several times for a large batch, so that others have their turns in between.
        failed: Called from the thread, once, when the store has failed; nothing is written or
            reported after that.

    Attributes:
        writing_since_s: When the batch was begun that is being written, on the monotonic clock;
            None while nothing is.
        latencies: How long the batches took, the forcing of the disk included.
    """

    def __init__(
        self,
        store: BatchStore,
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
        """Write and report everything submitted so far, then end; twice is harmless.

        Must not be called while holding a lock that `done` or `failed` takes.
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
        """Write what is queued and report it; return False at the end."""
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
        """Wait for work; return all of it, or nothing at the end."""
        with self._wake:
            while not self._queue and not self._ending:
                self._wake.wait()
            batch, self._queue = self._queue, []
            return batch
