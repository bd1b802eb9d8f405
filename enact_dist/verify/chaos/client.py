"""One client process under test: locks at random until it is stopped or killed.

``python -m enact_dist.verify.chaos.client CELL JOURNAL NAME SEED TTL_S AHEAD_NS THREADS``; it says
`started` and, after a line on its standard input, `done`.
"""

from __future__ import annotations

import sys
import threading
from collections.abc import Sequence
from pathlib import Path

from enact_dist import Cell, connect
from enact_dist.errors import LinkError
from enact_dist.verify.chaos.journal import Journal
from enact_dist.verify.chaos.workload import LockWorkload


class ClientProcess:
    """The threads of one client; see the module."""

    def __init__(self, words: Sequence[str]) -> None:
        cell, journal, self._name, seed, ttl_s, ahead_ns, threads = words
        self._file, self._seed, self._ttl_s = cell, int(seed), float(ttl_s)
        self._journal = Journal(Path(journal), ahead_ns=int(ahead_ns))
        self._threads = int(threads)
        self._stop = threading.Event()
        self._connections = 0

    def run(self) -> None:
        """Work until a line comes, or the end of input because the parent process is gone."""
        threading.Thread(target=self._listen, daemon=True).start()
        while not self._stop.is_set():
            try:
                cell = connect(self._file, actor=self._name, timeout_s=2.0)
            except LinkError:
                continue  # cut off, or its shards are down
            if not self._connections:
                print("started", flush=True)
            self._connections += 1
            with cell:
                self._work(cell)
        self._journal.close()
        print("done", flush=True)

    def _listen(self) -> None:
        sys.stdin.readline()
        self._stop.set()

    def _work(self, cell: Cell) -> None:
        """Work with one connection until stopped, or until it takes a new one."""
        anew = threading.Event()
        failures: list[BaseException] = []

        def loop(lane: int) -> None:
            name = f"{self._name}.{self._connections}.{lane}"
            seed = hash((self._seed, self._connections, lane))
            try:
                work = LockWorkload(cell, self._journal, name, seed=seed, ttl_s=self._ttl_s)
                while not self._stop.is_set() and not anew.is_set():
                    work.run_one()
                    if work.skewed:
                        anew.set()
            except LinkError:
                anew.set()  # a shard was away before the first lock: connect anew
            except BaseException as failure:
                failures.append(failure)
                self._stop.set()
                raise

        threads = [threading.Thread(target=loop, args=(lane,)) for lane in range(self._threads)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        if failures:
            raise failures[0]


if __name__ == "__main__":
    ClientProcess(sys.argv[1:]).run()
