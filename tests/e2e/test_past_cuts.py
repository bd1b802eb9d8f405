"""The past is one cut over shards, and stays what it was: under load, and over restarts."""

import os
import random
import threading
import time

import pytest
from accounts import COUNT, LEFT, PINS, RIGHT, open_accounts

from enact_dist import Position, View, connect
from enact_dist.errors import ForgottenError, LockTimeoutError, ShardUnreachableError

READS = int(os.environ.get("ENACT_PAST_READS", "5000"))
READS_OVER_KILLS = min(READS, 3000)
SAMPLES = 200
BOTH = 1000


@pytest.fixture
def cell(make_cell):
    aspects = "[aspects.count]\nretention = 50_000"
    made = make_cell(shards=("s0", "s1"), pins=PINS, aspects=aspects, ttl_s=1.0)
    return made.start_all()


class Traveller:
    """Sees both accounts as of moments since they were opened."""

    def __init__(self, joined, seed):
        open_accounts(joined, left=BOTH // 2, right=BOTH // 2)
        self.world = joined.world("online")
        self.seen = {}
        self._draw = random.Random(seed)
        self._first_ns = max(self._newest_ns(LEFT), self._newest_ns(RIGHT))

    def _newest_ns(self, entity):
        return self.world.history(entity, COUNT, count=1)[-1].position.stamp_ns

    def moment(self):
        """Draw a moment: any, or of the last tenth of a second, where commits are under way."""
        now_ns = time.time_ns()
        first_ns = self._draw.choice((self._first_ns, now_ns - 100_000_000))
        return Position(self._draw.randrange(max(first_ns, self._first_ns), now_ns), "s0")

    def read(self, moment):
        past = self.world.at(moment)
        left, right = View(past, LEFT, COUNT), View(past, RIGHT, COUNT)
        seen = past.view(left, right)
        balances = seen[left], seen[right]
        assert sum(balances) == BOTH, (moment, balances)
        assert self.seen.setdefault(moment, balances) == balances, moment
        if len(self.seen) > SAMPLES:  # those that stay are of all the time, not of its begin
            del self.seen[self._draw.choice(list(self.seen))]


@pytest.mark.slow
def test_sum_over_two_shards_holds_in_every_read_of_the_past(cell):
    """Thousands of reads as of drawn moments, while two processes move amounts between the shards."""
    with connect(cell.file) as joined:
        traveller = Traveller(joined, seed=1)
        workers = [cell.worker("transfer", seed, 1_000_000) for seed in (1, 2)]
        for worker in workers:
            worker.expect("progress")

        for _ in range(READS):
            traveller.read(traveller.moment())
        for moment in list(traveller.seen):
            traveller.read(moment)

        assert len(set(traveller.seen.values())) > SAMPLES // 20


@pytest.mark.slow
def test_past_is_the_same_after_shards_were_killed(cell):
    """What was read of a moment is read again, whoever has restarted since."""
    with connect(cell.file) as joined:
        traveller = Traveller(joined, seed=2)
        worker = cell.worker("transfer", 1, 1_000_000)
        for name in ("s1", "s0", "s1"):
            worker.expect("progress")
            for _ in range(300):
                traveller.read(traveller.moment())

            cell.kill(name)
            cell.start(name)

            for moment in list(traveller.seen):
                traveller.read(moment)


@pytest.mark.slow
def test_sum_holds_while_shards_are_killed_and_little_is_retained(make_cell):
    """A read of the past is whole or forgotten: then it lies before what the error says is known."""
    aspects = "[aspects.count]\nretention = 20"
    cell = make_cell(shards=("s0", "s1"), pins=PINS, aspects=aspects, ttl_s=1.0).start_all()
    reads, forgotten = 0, []
    with connect(cell.file) as joined:
        traveller = Traveller(joined, seed=3)
        worker = cell.worker("transfer", 1, 1_000_000)
        worker.expect("progress")
        done = threading.Event()

        def kill_each():
            try:
                for name in ("s1", "s0"):
                    worker.expect("progress")
                    cell.kill(name)
                    cell.start(name)
                worker.expect("progress")
            finally:
                done.set()

        killer = threading.Thread(target=kill_each)
        killer.start()
        while reads < READS_OVER_KILLS or not done.is_set():
            moment = traveller.moment()
            try:
                traveller.read(moment)
            except ForgottenError as error:
                forgotten.append((moment.stamp_ns, error.oldest_ns))
                traveller.seen.pop(moment, None)
            except (LockTimeoutError, ShardUnreachableError):
                continue  # a slow machine starts it, or lets it decide, later than a read waits
            reads += 1
        killer.join()

        assert 0 < len(forgotten) < reads
        assert all(asked_ns < oldest_ns for asked_ns, oldest_ns in forgotten)
        assert len(set(traveller.seen.values())) > 1
        assert cell.daemons["s0"].popen.poll() is None
