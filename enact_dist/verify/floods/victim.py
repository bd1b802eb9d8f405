"""The honest client of a flood: `victim CELL UPDATES CARRIER`.

It counts a number up under a lock, each time from what it counted to itself, while another thread
holds a second lock; both are in plain sight of the attacker.  What it reads, and what it prints:

========  ======================================================================================
(start)   ``held SESSION`` once its second lock is granted
go        ``updated {json}`` after so many updates, with two newcomers in between
end       ``kept yes`` if the second lock, held all the time, commits; then it ends
========  ======================================================================================
"""

from __future__ import annotations

import json
import os
import sys
import threading
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Final

from enact_dist.access.lock import Lock
from enact_dist.errors import EnactError
from enact_dist.terms import Aspect, Durability, Entity, Write
from enact_dist.world.cell import Cell
from enact_dist.world.connecting import connect

ACTOR: Final = "victim"
COUNT: Final = Aspect("count", int, Durability.VOLATILE)
KEPT: Final = Aspect("kept", int)
COUNTED: Final = Entity("counted")
HELD: Final = Entity("held")
WORLD: Final = "online"
WAIT_S: Final = 10.0
"""How long one update may wait for its lock."""
FAILURES_MAX: Final = 3
"""After so many updates that failed, no further one is tried."""
HOLD_S: Final = 3600.0


@dataclass(slots=True)
class Updates:
    """What the honest client has seen.

    Attributes:
        done: Updates that were committed.
        found: What the number is at the end.
        p50_ms: Median of an update's time, lock to commit.
        p99_ms: What 99 of 100 updates took at most.
        longest_ms: The slowest one.
        newcomers_s: How long each further client took from `connect` to its first update.
        failures: Errors by class; empty if all is well.
    """

    done: int = 0
    found: int = 0
    p50_ms: float = 0.0
    p99_ms: float = 0.0
    longest_ms: float = 0.0
    newcomers_s: list[float] = field(default_factory=list)
    failures: dict[str, int] = field(default_factory=dict)

    def failed(self, how: str) -> None:
        """Count a failure."""
        self.failures[how] = self.failures.get(how, 0) + 1


def _say(*words: object) -> None:
    print(*words, flush=True)


def _share(sorted_ms: Sequence[float], share: float) -> float:
    return sorted_ms[min(len(sorted_ms) - 1, int(len(sorted_ms) * share))] if sorted_ms else 0.0


def _add_one(cell: Cell) -> None:
    write = Write(cell.world(WORLD), COUNTED, COUNT)
    with Lock(write, wait_s=WAIT_S) as lock:
        lock[write] = lock.get(write, 0) + 1


class Victim:
    """One honest client and the numbers that it counts."""

    def __init__(self, file: str, updates: int) -> None:
        self._file = file
        self._wanted = updates
        self._release = threading.Event()

    def run(self) -> None:
        """Do as the lines on standard input say, until they end."""
        with connect(self._file, actor=ACTOR, timeout_s=60.0) as cell:
            _add_one(cell)
            holder = threading.Thread(target=self._hold, args=(cell,), daemon=True)
            holder.start()
            for line in sys.stdin:
                if line.strip() == "go":
                    _say("updated", json.dumps(asdict(self._update(cell))))
                else:
                    break
            self._release.set()
            holder.join()

    def _hold(self, cell: Cell) -> None:
        """Hold one lock from the begin to the end, and write under it then."""
        try:
            write = Write(cell.world(WORLD), HELD, KEPT)
            with Lock(write, wait_s=WAIT_S, hold_s=HOLD_S) as lock:
                _say("held", cell._client.core.session)  # noqa: SLF001 - the attacker may know it
                self._release.wait()
                lock[write] = lock.get(write, 0) + 1
        except EnactError as error:
            _say("kept", f"{type(error).__name__}: {error}")
        else:
            _say("kept", "yes")

    def _update(self, cell: Cell) -> Updates:
        seen, times_ms = Updates(), []
        write = Write(cell.world(WORLD), COUNTED, COUNT)
        with Lock(write, wait_s=WAIT_S) as lock:
            start = lock.get(write, 0)
        newcomers = {self._wanted // 3, 2 * self._wanted // 3}
        expected = start
        for number in range(self._wanted):
            if number in newcomers:
                expected += self._join_anew(seen)
            begun_s = time.perf_counter()
            try:
                with Lock(write, wait_s=WAIT_S) as lock:
                    if lock.get(write, 0) != expected:
                        seen.failed("the number was changed")
                        expected = lock.get(write, 0)
                    lock[write] = expected + 1
            except EnactError as error:
                seen.failed(type(error).__name__)
                if sum(seen.failures.values()) >= FAILURES_MAX:
                    break
                continue
            expected += 1
            seen.done += 1
            times_ms.append(1e3 * (time.perf_counter() - begun_s))
        times_ms.sort()
        seen.p50_ms, seen.p99_ms = _share(times_ms, 0.5), _share(times_ms, 0.99)
        seen.longest_ms = times_ms[-1] if times_ms else 0.0
        try:
            with Lock(write, wait_s=WAIT_S) as lock:
                seen.found = lock.get(write, 0) - start - len(seen.newcomers_s)
        except EnactError as error:
            seen.failed(type(error).__name__)
        return seen

    def _join_anew(self, seen: Updates) -> int:
        """Connect as a newcomer would, and make one update."""
        begun_s = time.perf_counter()
        try:
            with connect(self._file, actor="newcomer", timeout_s=WAIT_S) as cell:
                _add_one(cell)
        except EnactError as error:
            seen.failed(f"newcomer: {type(error).__name__}")
            return 0
        seen.newcomers_s.append(time.perf_counter() - begun_s)
        return 1


if __name__ == "__main__":
    os.environ["ENACT_CARRIER"] = sys.argv[3]
    Victim(sys.argv[1], int(sys.argv[2])).run()
