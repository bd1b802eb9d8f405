"""Looks at the shards of a cell under test ten times a second, and last of all at every slot.

``python -m enact_dist.verify.chaos.watcher CELL FOLDER TTL_S AHEAD_NS``; told `final` it reads
everything under one lock and says `final committed`, told `rest S` it waits until no lock is left
for at most S seconds and says `left N`, told anything else it says `done` and ends.  What it sees
on the way is in ``FOLDER/watcher.log``:

=========  =====================================================================================
word       then
=========  =====================================================================================
doubt      lock, shard, first and last time at which it was seen prepared and undecided
counters   shard, epoch, the shard's counters by name
=========  =====================================================================================
"""

from __future__ import annotations

import sys
import threading
import time
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Final

from enact_dist import Cell, connect
from enact_dist.core.protocol.messages import MERELY_KEPT, ListLocks, ListSessions, Locks, Sessions
from enact_dist.verify.chaos.journal import SUFFIX, Journal
from enact_dist.verify.chaos.workload import LockWorkload
from enact_dist.verify.checker import LockOutcome

LOG: Final = "watcher.log"
PERIOD_S: Final = 0.1
FINAL_S: Final = 30.0
"""How long a lock over everything is retried after one was lost or timed out."""
COUNTERS_EVERY: Final = 5
"""Counters are asked for with every so manieth look."""


class Watcher:
    """Looks at a cell; see the module."""

    def __init__(self, cell: Cell, folder: Path, *, ttl_s: float, ahead_ns: int) -> None:
        self._cell, self._client = cell, cell._client  # noqa: SLF001 - one call, unlike `cell.locks()`
        self._folder, self._ttl_s, self._ahead_ns = folder, ttl_s, ahead_ns
        self._log = Journal(folder / LOG, ahead_ns=ahead_ns)
        self._doubts: dict[tuple[str, str], tuple[int, int]] = {}
        self._final: LockWorkload | None = None
        self._looks = 0
        self.locks_left = 0

    def look(self) -> bool:
        """Look once at all shards; return whether all of them answered."""
        shards = self._client.shards()
        answers = self._client.call_once([(s, ListLocks()) for s in shards], timeout_s=0.3)
        now_ns = self._log.now_ns()
        self.locks_left = 0
        for shard, answer in zip(shards, answers, strict=True):
            if isinstance(answer, Locks):
                self.locks_left += sum(holder.kept not in MERELY_KEPT for holder in answer.holders)
                self._note_doubts(shard, answer, now_ns)
        self._looks += 1
        if self._looks % COUNTERS_EVERY == 0:
            self._ask_counters(shards)
        return all(isinstance(answer, Locks) for answer in answers)

    def _note_doubts(self, shard: str, answer: Locks, now_ns: int) -> None:
        doubted = {str(h.lock) for h in answer.holders if "in doubt" in h.modes}
        for lock in doubted:
            first_ns, _ = self._doubts.get((shard, lock), (now_ns, now_ns))
            self._doubts[shard, lock] = (first_ns, now_ns)
        for at, lock in [known for known in self._doubts if known[0] == shard]:
            if lock not in doubted:
                self._log.write("doubt", lock, at, *self._doubts.pop((at, lock)))

    def _ask_counters(self, shards: tuple[str, ...]) -> None:
        answers = self._client.call_once([(s, ListSessions()) for s in shards], timeout_s=0.3)
        for shard, answer in zip(shards, answers, strict=True):
            if isinstance(answer, Sessions):
                counters = {counter.name: counter.value for counter in answer.counters}
                self._log.write("counters", shard, answer.epoch, counters)

    def final(self) -> str:
        """Read everything under one lock; return its outcome.

        On a machine that lets it wait for longer than its lease it is done again.
        """
        if self._final is None:
            journal = Journal(self._folder / f"final{SUFFIX}", ahead_ns=self._ahead_ns)
            self._final = LockWorkload(self._cell, journal, "final", seed=0, ttl_s=self._ttl_s)
        again_s = time.monotonic() + FINAL_S
        while (told := self._final.take_all()) is not LockOutcome.COMMITTED:
            if time.monotonic() > again_s:
                break
            time.sleep(PERIOD_S)  # a failure that comes at once is not asked for again at once
        return told.value

    def rest(self, limit_s: float) -> int:
        """Wait until no lock is held, awaited or in doubt; return how many are left."""
        deadline_s = time.monotonic() + limit_s
        while True:
            answered = self.look()
            if (answered and not self.locks_left) or time.monotonic() > deadline_s:
                self._ask_counters(self._client.shards())
                return self.locks_left if answered else -1


def main() -> None:
    """Look until asked to end."""
    file, folder, ttl_s, ahead_ns = sys.argv[1:]
    lines: SimpleQueue[str] = SimpleQueue()

    def listen() -> None:
        for line in sys.stdin:
            lines.put(line.strip())
        lines.put("end")

    threading.Thread(target=listen, daemon=True).start()
    with connect(file, actor="watcher", timeout_s=60.0) as cell:
        watcher = Watcher(cell, Path(folder), ttl_s=float(ttl_s), ahead_ns=int(ahead_ns))
        print("started", flush=True)
        while True:
            try:
                word, _, rest = lines.get(timeout=PERIOD_S).partition(" ")
            except Empty:
                watcher.look()
                continue
            if word == "final":
                print("final", watcher.final(), flush=True)
            elif word == "rest":
                print("left", watcher.rest(float(rest)), flush=True)
            else:
                break
    print("done", flush=True)


if __name__ == "__main__":
    main()
