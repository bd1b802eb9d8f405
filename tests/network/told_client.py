"""A client that does what it is told, step by step, and journals it like those of a chaos run.

`python -m told_client CELL JOURNAL NAME TTL_S AHEAD_NS`; it says `started`, then takes lines:

- `hold SHARDS N`: take a write lock on one thing of each shard (`s0`, `s0,s1`), for data of N bytes
  or more; says `holding`.
- `commit`: go on with it; says `believes True` or `believes False` of the lock, and what it was
  told in the end, `told committed`.
- `pause`, before: stop when all is prepared and nothing decided; says `prepared` and the shard that
  decides, goes on at `decide`.
- `work N`: take write locks over both shards until N were committed, but at most `TRIES` times as
  many.  Says `worked` and how many were committed.
- `reached SHARD NS`: says `reached` and how many ms after that time a view of the shard succeeded.
"""

import queue
import sys
import threading
import time
from pathlib import Path

from enact_dist import Entity, View, Write, connect
from enact_dist.core.protocol.messages import Commit
from enact_dist.errors import LinkError, LockTimeoutError
from enact_dist.link.client import locks as link_client
from enact_dist.link.clock import boottime_ns
from enact_dist.verify.chaos.journal import Journal
from enact_dist.verify.chaos.workload import ASPECTS, LockWorkload, PlannedLock, datum_text
from enact_dist.verify.checker import LockOutcome

SUSPENDED_NS = 10**9
PROBE_S = 0.01
TRIES = 4
FINISH_S = 60.0
"""How long the outcome of a commit is asked for, longer than any cut; 10 s in the product."""


class SuspendedClock:
    """Stands still while its process does, as that of a virtual machine which is suspended."""

    def __init__(self):
        self._mutex = threading.Lock()
        self._last_ns, self._missed_ns = boottime_ns(), 0

    def __call__(self):
        with self._mutex:
            now_ns = boottime_ns()
            if now_ns > self._last_ns + SUSPENDED_NS:
                self._missed_ns += now_ns - self._last_ns
            self._last_ns = now_ns
            return now_ns - self._missed_ns


class HeldWorkload(LockWorkload):
    """Waits for a word between the grant and the commit."""

    def __init__(self, *arguments, **options):
        super().__init__(*arguments, **options)
        self.words = queue.SimpleQueue()
        self.waits = True
        self.padding = 0

    def _look(self, lock, plan):
        seen = super()._look(lock, plan)
        if self.waits:
            say("holding")
            self.words.get()
            say("believes", lock.valid())
        return seen

    def _write(self, lock, lock_id, write, plan, epochs):
        written = super()._write(lock, lock_id, write, plan, epochs)
        if self.padding:
            shard = self._shard_of(str(write.entity))
            lock[write] = datum_text(lock_id, written[1], epochs[shard]) + "." * self.padding
        return written


class PausingCarrier:
    """Stops before the call that decides, where it is told to."""

    def __init__(self, inner):
        self._inner = inner
        self.words = queue.SimpleQueue()
        self.pauses = False

    def __getattr__(self, name):
        return getattr(self._inner, name)

    def request(self, shard, message, *, timeout_s, **more):
        if self.pauses and isinstance(message, Commit):
            self.pauses = False
            say("prepared", shard)
            self.words.get()
        return self._inner.request(shard, message, timeout_s=timeout_s, **more)


class Probe(threading.Thread):
    """Views a thing of one shard again and again; knows when it last succeeded."""

    def __init__(self, cell, shard, journal):
        super().__init__(daemon=True)
        self._world = cell.world("online")
        self._view = View(self._world, Entity(f"thing/{shard}/0"), ASPECTS["kept"])
        self._journal = journal
        self._news = threading.Condition()
        self._reached_ns = 0

    def run(self):
        while True:
            try:
                self._world.view(self._view)
            except (LinkError, LockTimeoutError):
                continue  # its shard stayed away for as long as a view may take
            with self._news:
                self._reached_ns = self._journal.now_ns()
                self._news.notify_all()
            time.sleep(PROBE_S)  # how exactly the moment of a success is known

    def first_ns(self, since_ns):
        """Wait for a success after `since_ns` and return its time."""
        with self._news:
            self._news.wait_for(lambda: self._reached_ns > since_ns)
            return self._reached_ns


def say(*words):
    print(*words, flush=True)


class Client:
    """See the module."""

    def __init__(self, cell, journal, name, ttl_s):
        self._cell = cell
        self._carrier = cell._client.carrier = PausingCarrier(cell._client.carrier)
        self._work = HeldWorkload(cell, journal, name, seed=0, ttl_s=ttl_s)
        self._probes = {shard.name: Probe(cell, shard.name, journal) for shard in cell.shards()}
        for probe in self._probes.values():
            probe.start()

    def obey(self, word, *rest):
        if word == "hold":
            threading.Thread(target=self._hold, args=rest, daemon=True).start()
        elif word == "commit":
            self._work.words.put(word)
        elif word == "pause":
            self._carrier.pauses = True
        elif word == "decide":
            self._carrier.words.put(word)
        elif word == "work":
            self._work.waits = False
            say("worked", self._commit(int(rest[0])))
            self._work.waits = True
        elif word == "reached":
            shard, since_ns = rest
            first_ns = self._probes[shard].first_ns(int(since_ns))
            say("reached", (first_ns - int(since_ns)) / 1e6)

    def _commit(self, count):
        """Commit so many times, again where a slow machine or network cost the lock."""
        committed = 0
        for _ in range(TRIES * count):
            committed += self._work.take(self._plan("s0,s1")) is LockOutcome.COMMITTED
            if committed == count:
                break
        return committed

    def _hold(self, shards, size="0"):
        self._work.padding = int(size)
        told = self._work.take(self._plan(shards))
        self._work.padding = 0
        say("told", told.value)

    def _plan(self, shards):
        world, aspect = self._cell.world("online"), ASPECTS["kept"]
        writes = [Write(world, Entity(f"thing/{s}/1"), aspect) for s in shards.split(",")]
        return PlannedLock("write over shards", list(writes), writes, wait_s=60.0, hold_s=120.0)


def main():
    file, journal, name, ttl_s, ahead_ns = sys.argv[1:]
    link_client.FINISH_S = FINISH_S
    with connect(file, actor=name, timeout_s=30.0) as cell:
        cell._client._now_ns = SuspendedClock()
        client = Client(cell, Journal(Path(journal), ahead_ns=int(ahead_ns)), name, float(ttl_s))
        say("started")
        for line in sys.stdin:
            client.obey(*line.split())


if __name__ == "__main__":
    main()
