"""The threads that write a shard's records, so that no lock waits while the disk is forced.

Group commit: everything submitted while one batch is written forms the next one, forced to the disk
once.  An idle store writes at once; a busy one gets larger batches instead of a longer queue.

A thread that would only wait for the answer lends itself and writes the batch (`write_here`): to
wake another thread, and be woken by it, takes longer than to write.  Who cannot be kept waiting by
a slow disk leaves it to the store's own thread, as does one that finds another thread writing.
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
        store: Used by one thread at a time, and no more once `close` has returned.
        done: Called by the thread that writes, with the nonzero tickets of each stored batch, in
            order; several times for a large batch, so that others get turns in between.
        failed: Called once, when the store has failed; nothing is written or reported afterwards.

    Attributes:
        queue: What the next batch will hold.
        writing_since_s: Start of the batch being written, on the monotonic clock; None: no batch.
        latencies: How long batches took, forcing included.
    """

    def __init__(
        self,
        store: Store,
        done: Callable[[list[int]], None],
        failed: Callable[[BaseException], None],
    ) -> None:
        self._store = store
        self._takes_loans = store.holding is None  # a database may take its time
        self._done = done
        self._failed = failed
        self._pen = threading.Lock()  # of who writes, and then looks for what was queued meanwhile
        self._wake = threading.Condition(threading.Lock())
        self.queue: list[Persist] = []
        self._ending = self._broken = False
        self.writing_since_s: float | None = None
        self.latencies = Latencies()
        self._thread = threading.Thread(target=self._run, name="enact-store", daemon=True)
        self._thread.start()

    def submit(self, persist: Persist, *, wake: bool = True) -> None:
        """Queue a `Persist`; never blocks.  After a failure or `close` nothing is reported.

        Args:
            persist: The records.
            wake: Whether to wake the store's thread; otherwise `wake` or `write_here` follows.
        """
        with self._wake:
            if not self._ending:
                self.queue.append(persist)
                if wake:
                    self._wake.notify()

    def wake(self) -> None:
        """Let the store's thread write what is queued; never blocks."""
        with self._wake:
            self._wake.notify()

    def write_here(self) -> None:
        """Write and report what is queued, in the calling thread unless another one writes.

        It takes as long as the disk does, and a Ctrl-C in between fails the store: not for the main
        thread.  Do not call it while holding a lock that `done` or `failed` takes.
        """
        if not self._takes_loans:
            self.wake()
        elif self.queue and self._pen.acquire(blocking=False):
            self._write()
            if self.queue or self._store.tired:
                self.wake()

    def close(self) -> None:
        """Write and report everything submitted so far, then end; idempotent.

        Do not call it while holding a lock that `done` or `failed` takes.
        """
        with self._wake:
            self._ending = True
            self._wake.notify()
        if threading.current_thread() is not self._thread:
            self._thread.join()
            with self._pen:  # a thread that lent itself has written
                return

    def _run(self) -> None:
        while self._has_work():
            self._pen.acquire()
            self._write(rests=True)

    def _has_work(self) -> bool:
        """Wait for something to do; return False at the end."""
        with self._wake:
            while not (self.queue or self._ending or self._store.tired):
                self._wake.wait()
            return bool(self.queue) or not self._ending

    def _write(self, *, rests: bool = False) -> None:
        """Write and report what is queued, with the pen, and give it back."""
        try:
            with self._wake:
                batch, self.queue = self.queue, []
            if batch:
                self.writing_since_s = started_s = time.monotonic()
                self._store.write(batch)
                self.writing_since_s = None
                self.latencies.add(time.monotonic() - started_s)
                self._report([persist.ticket for persist in batch if persist.ticket])
            if rests and not self._broken:
                self._store.rest()
        except BaseException as failure:  # whatever it was, nothing may be acknowledged
            with self._wake:
                self._ending = self._broken = True
                self.queue.clear()
                self._wake.notify()
            self._pen.release()
            self._failed(failure)
            if not isinstance(failure, Exception):
                raise
        else:
            self._pen.release()

    def _report(self, tickets: list[int]) -> None:
        for first in range(0, len(tickets), REPORTED_MAX):
            if first:
                time.sleep(HAND_ON_S)
            self._done(tickets[first : first + REPORTED_MAX])
