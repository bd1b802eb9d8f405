"""Commits over shards with real processes: all or nothing, whatever is killed when."""

import json
import os
import random
import time

import pytest
from accounts import COUNT, LEFT, RIGHT, open_accounts, two_shards

from enact_dist import Lock, Write, connect

pytestmark = pytest.mark.slow
TOTAL = 10_000


@pytest.fixture
def cell(make_cell):
    """Two shards with one account on each."""
    cell = two_shards(make_cell, ttl_s=1.0).start_all()
    with connect(cell.file) as joined:
        open_accounts(joined, TOTAL)
    return cell


def total(cell):
    """Return the sum of both accounts under one lock."""
    with connect(cell.file) as joined:
        world = joined.world("online")
        one, two = Write(world, LEFT, COUNT), Write(world, RIGHT, COUNT)
        with Lock(one, two, wait_s=60.0) as lock:
            return lock[one] + lock[two]


@pytest.mark.carrier("socket", "zenoh")
def test_transfers_between_shards_keep_the_sum_when_shards_are_killed(cell):
    """4 processes move numbers between two shards that are killed: no view sees another sum."""
    kills = int(os.environ.get("ENACT_KILLS", "8"))
    draw = random.Random(3)
    auditor = cell.worker("audit")
    workers = [cell.worker("transfer", seed, 150) for seed in range(4)]
    for process in (auditor, *workers):
        process.expect("started")
    for number in range(kills):
        workers[number % 4].expect("progress", 60)
        time.sleep(draw.uniform(0.0, 0.1))  # the moment of the kill is what varies
        name = draw.choice(("s0", "s1"))
        cell.kill(name)
        cell.start(name)
    for worker in workers:
        assert worker.expect("done", 120).startswith("150 ")
    auditor.tell("")
    seen = json.loads(auditor.expect("summary", 30))

    assert total(cell) == TOTAL
    assert seen["sums"] == [TOTAL], seen
    assert seen["views"] > 50
    with connect(cell.file) as joined:
        assert not joined.locks()
        counters = [shard.counters for shard in joined.shards()]
    assert sum(counter.get("commits_finished", 0) for counter in counters) > 0


def test_lock_in_doubt_is_told_and_given_up_by_hand(cell):
    """`enact lock resolve` refuses what is not in doubt, and says what to do."""
    holder = cell.worker("hold")
    holder.expect("holding")
    with connect(cell.file) as joined:
        (held,) = [lock for lock in joined.locks() if lock.granted]

    done = cell.enact(
        "lock", "resolve", "--force-abort", str(held.number), "--shard", held.shard, "--reason", "x"
    )

    assert done.returncode == 1
    assert "not in doubt" in done.stderr
