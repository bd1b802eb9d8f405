"""Commits over shards with real processes: all or nothing, whatever is killed when."""

import contextlib
import json
import os
import random
import time

import pytest
from accounts import COUNT, LEFT, RIGHT, open_accounts, two_shards
from polling import until

from enact_dist import Lock, Write, connect
from enact_dist.errors import LeaseLostError

pytestmark = pytest.mark.slow
TOTAL = 10_000
TRIES = 60


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
        for _ in range(TRIES):  # what is found lost at the end is asked for again
            with contextlib.suppress(LeaseLostError), Lock(one, two, wait_s=60.0) as lock:
                lock[one] = lock[one]  # a commit over both since the last start of either
                lock[two] = lock[two]
                found = lock[one] + lock[two]
            if lock.position is not None:
                return found
    raise AssertionError(f"a lock over both was lost {TRIES} times")


def finished(joined):
    """Return how many commits shards heard of that another one had decided, since their start."""
    return sum(shard.counters.get("commits_finished", 0) for shard in joined.shards())


@pytest.mark.carrier("socket", "zenoh")
def test_transfers_between_shards_keep_the_sum_when_shards_are_killed(cell):
    """4 processes move numbers between two shards that are killed: no view sees another sum."""
    kills = int(os.environ.get("ENACT_KILLS", "8"))
    draw = random.Random(3)
    auditor = cell.worker("audit")
    transfers = max(150, 10 * kills)  # a worker tells of every 20, and is asked for each 4th kill
    workers = [cell.worker("transfer", seed, transfers) for seed in range(4)]
    for process in (auditor, *workers):
        process.expect("started")
    for number in range(kills):
        workers[number % 4].expect("progress")
        time.sleep(draw.uniform(0.0, 0.1))  # the moment of the kill is what varies
        name = draw.choice(("s0", "s1"))
        cell.kill(name)
        cell.start(name)
    for worker in workers:
        assert worker.expect("done", 400).startswith(f"{transfers} ")
    auditor.expect("often")
    auditor.tell("")
    seen = json.loads(auditor.expect("summary"))

    assert total(cell) == TOTAL
    assert seen["sums"] == [TOTAL], seen
    with connect(cell.file) as joined:
        # Others hear of an end after the client that has ended.
        until(lambda: all(lock.state == "kept" for lock in joined.locks()), missed=joined.locks)
        until(lambda: finished(joined), missed=joined.shards)


def test_lock_in_doubt_is_told_and_given_up_by_hand(cell):
    """`enact lock resolve` refuses what is not in doubt, and says what to do."""
    holder = cell.worker("hold")
    holder.expect("holding")
    with connect(cell.file) as joined:
        (held,) = [lock for lock in joined.locks() if lock.state == "held"]

    done = cell.enact(
        "lock", "resolve", "--force-abort", str(held.number), "--shard", held.shard, "--reason", "x"
    )

    assert done.returncode == 1
    assert "not in doubt" in done.stderr
