"""Rounds of one kind: a commit over two shards, and daemons killed at one step of it.

The client, a prober that wants the same data right after, and the judge are threads of the test;
the shards are daemons that `dying_shard.py` stops at the step.  Each round ends with both shards
up, what is visible compared with what the client was told, and the time after which the prober had
its lock.
"""

import contextlib
import os
import random
import signal
import sys
import threading
import time
from collections import Counter
from dataclasses import dataclass, field

from accounts import COUNT, LEFT, RIGHT, open_accounts, start_trapped

from enact_dist import Lock, View, Write, connect
from enact_dist.errors import CommitUnknownError, LeaseLostError, ShardUnreachableError
from enact_dist.link.client import locks as link_client

PRIMARY, PARTICIPANT = "s0", "s1"
STEP_AT = {
    "all-prepared": PRIMARY,
    "decided": PRIMARY,
    "answered": PRIMARY,
    "prepared": PARTICIPANT,
    "finishing": PARTICIPANT,
}
VICTIMS = ((PRIMARY,), (PARTICIPANT,), (PRIMARY, PARTICIPANT))
AWAY_FOR_LONG = 8
"""Every so many rounds the victims stay away until the client has given up."""
FINISH_S_SHORT = 1.0
"""How long the client asks in such a round."""
FINISH_S_LONG = 60.0
"""And otherwise: longer than a busy machine takes to start two daemons; 10 s in the product."""
ROUNDS = int(os.environ.get("ENACT_DECISION_KILLS", "4"))
BUSY_S = 25.0
"""What a machine that does other things may add; locks that no shard frees stay for ever."""
TOLD_S = 90.0
WAIT_S = 60.0


def must_stand(step, victims):
    """Return whether a commit must stand after its victims died at a step; None: either way."""
    if step == "prepared":
        return False if PRIMARY in victims else None  # the client may prepare once more
    return step != "all-prepared" or PRIMARY not in victims


@dataclass
class Tally:
    """What happened in the rounds of one kind; times in seconds after `_back`."""

    rounds: int = 0
    told: Counter = field(default_factory=Counter)
    stands: Counter = field(default_factory=Counter)
    victims: Counter = field(default_factory=Counter)
    free_s: list[float] = field(default_factory=list)

    def free_ttls(self, ttl_s, share):
        """Return the time to free locks in TTLs that a share of the rounds kept below."""
        ordered = sorted(self.free_s)
        return ordered[min(len(ordered) - 1, int(len(ordered) * share))] / ttl_s

    def line(self, step, ttl_s):
        """Return the figures of a report."""
        p50, p99, top = (self.free_ttls(ttl_s, share) for share in (0.5, 0.99, 1.0))
        return (
            f"{step}: {self.rounds} rounds, TTL {ttl_s:g} s, victims {dict(self.victims)}, told"
            f" {dict(self.told)}, then visible {dict(self.stands)}, locks free after p50 {p50:.2f}"
            f" p99 {p99:.2f} max {top:.2f} TTL"
        )


@dataclass
class Told:
    """What the client was told about its commit; `outcome` is "" until then."""

    outcome: str = ""
    waited_s: float = 0.0
    error: Exception | None = None


class DecisionRounds:
    """One cell of two shards, a client and a prober, for many rounds at one step."""

    def __init__(self, cell, step, *, ttl_s, seed):
        self.cell, self.step, self.ttl_s = cell, step, ttl_s
        self.tally = Tally()
        self._draw = random.Random(seed)
        self._reached = threading.Event()
        self._value = 0
        self._start(cell.ports)
        with contextlib.ExitStack() as stack:
            self._client = stack.enter_context(connect(cell.file, actor="client"))
            self._prober = stack.enter_context(connect(cell.file, actor="prober"))
            open_accounts(self._client)
            assert self._probe(self._prober)[0] == 0
            self._stack = stack.pop_all()

    def play(self):
        """Run all rounds; return the longest time until locks were free, and print the figures."""
        try:
            for number in range(ROUNDS):
                self.run(number)
        finally:
            self._stack.close()
            if self.tally.rounds:
                print(f"\n{self.tally.line(self.step, self.ttl_s)}", file=sys.stderr)
        return max(self.tally.free_s)

    def run(self, number):
        """Run one round and judge it."""
        armed = STEP_AT[self.step]
        victims = VICTIMS[number % len(VICTIMS)]
        long_away = number % AWAY_FOR_LONG == 3
        link_client.FINISH_S = FINISH_S_SHORT if long_away else FINISH_S_LONG
        self._arm(armed)
        self._reached.clear()
        told = Told()
        client = threading.Thread(target=self._commit, args=(self._value + 1, told))
        client.start()
        self._reach(armed)
        self._kill(victims, armed)
        if long_away:
            client.join(TOLD_S)
        elif number % 2:
            client.join(self._draw.uniform(1.0, 2.0) * self.ttl_s)  # away for more than a TTL
        back_s = self._back(victims)
        value, free_s = self._probe(self._prober)
        self.tally.free_s.append(free_s - back_s)
        client.join(TOLD_S)
        assert not client.is_alive(), f"the client was told nothing; {self._stories()}"
        self._judge(told, value, victims, long_away=long_away)

    def _start(self, names):
        for name in names:
            start_trapped(self.cell, name)

    def _back(self, victims):
        """Let the victims serve again; return the time from which waiting for locks counts."""
        self._start(victims)
        return time.monotonic()

    def _arm(self, name):
        daemon = self.cell.daemons[name]
        daemon.tell(f"arm {self.step}")
        daemon.expect("armed")

    def _commit(self, value, told):
        world = self._client.world("online")
        left, right = Write(world, LEFT, COUNT), Write(world, RIGHT, COUNT)
        for _ in range(60):
            told.error, finish_s = None, time.monotonic()
            try:
                with Lock(left, right, wait_s=WAIT_S) as lock:
                    lock[left] = lock[right] = value
                    finish_s = time.monotonic()
            except (LeaseLostError, ShardUnreachableError, CommitUnknownError) as error:
                told.error = error
            told.waited_s = time.monotonic() - finish_s
            # Lost before it came to the step, by a machine that let it wait: nothing was tried.
            soon = told.waited_s < FINISH_S_SHORT / 2 and not self._reached.is_set()
            if not (soon and isinstance(told.error, LeaseLostError)):
                break
        told.outcome = type(told.error).__name__ if told.error else "committed"

    def _reach(self, name):
        """Wait until the daemon stands still at the step."""
        daemon = self.cell.daemons[name]
        daemon.expect(f"reached {self.step}")
        self._reached.set()
        stopped = os.waitid(os.P_PID, daemon.pid, os.WSTOPPED)
        assert stopped.si_status == signal.SIGSTOP

    def _kill(self, victims, armed):
        for name in victims:
            self.cell.kill(name)
        if armed not in victims:
            self.cell.daemons[armed].signal(signal.SIGCONT)
            self.cell.daemons[armed].tell("go on")

    def _probe(self, cell):
        """Lock both accounts; return their one value, and when they could be had."""
        world = cell.world("online")
        left, right = Write(world, LEFT, COUNT), Write(world, RIGHT, COUNT)
        while True:
            with contextlib.suppress(LeaseLostError), Lock(left, right, wait_s=WAIT_S) as lock:
                free_s = time.monotonic()
                assert lock[left] == lock[right], f"half a commit stands; {self._stories()}"
                return lock[left], free_s

    def _judge(self, told, value, victims, *, long_away):
        """Compare what the client was told with what everybody sees."""
        tally, before = self.tally, self._value
        committed = value == before + 1
        assert value in {before, before + 1}
        stands = must_stand(self.step, victims)
        assert stands in {None, committed}, f"{self.step}, {victims} killed: {value} after {before}"
        if told.outcome == "committed":
            assert committed, f"told committed, not visible; {self._stories()}"
        elif told.outcome == "CommitUnknownError":
            assert long_away, f"told unknown after {told.waited_s} s; {self._stories()}"
            assert told.waited_s >= FINISH_S_SHORT
            found = self._client.outcome(told.error.lock_id, timeout_s=TOLD_S)
            assert (found is not None) == committed, f"the outcome is {found}; {self._stories()}"
        else:
            assert not committed, f"told {told.error!r}, but visible; {self._stories()}"
        view = View(self._prober.world("online"), LEFT, COUNT)
        assert self._prober.world("online").view(view)[view] == value
        self._value = value
        tally.rounds += 1
        tally.told[told.outcome] += 1
        tally.stands["all" if committed else "nothing"] += 1
        tally.victims["+".join(victims)] += 1

    def _stories(self):
        return "\n".join(self.cell.daemons[name].story() for name in self.cell.ports)
