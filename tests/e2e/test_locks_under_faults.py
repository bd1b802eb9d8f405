"""Locks with real processes: killed, stopped and starved ones never break what a lock promises."""

import json
import os
import signal
import time

import pytest

from enact_dist import Aspect, Entity, View, connect
from enact_dist.errors import LeaseLostError

pytestmark = pytest.mark.slow
COUNT = Aspect("count", int)
counter = Entity("counter")
TTL_S = 2.0
LONG_S = 400.0
"""What a busy machine may take for thousands of locks; it is no claim."""
GIL_S = int(os.environ.get("ENACT_GIL_SECONDS", "13"))


def counted(cell, entity=counter):
    """Return the counter's value as a fresh client sees it."""
    with connect(cell.file) as joined:
        view = View(joined.world("online"), entity, COUNT)
        return joined.world("online").view(view).get(view, 0)


both = pytest.mark.carrier("socket", "zenoh")
"""What has to hold however messages travel."""


@both
def test_increments_of_four_processes_add_up(make_cell):
    """4 processes x 1,000 increments through locks are 4,000 exactly."""
    cell = make_cell().start_all()
    workers = [cell.worker("increment", 1000) for _ in range(4)]
    for worker in workers:
        assert worker.expect("done", LONG_S).startswith("1000 ")
    assert counted(cell) == 4000


@both
def test_increments_add_up_when_shard_is_killed_and_restarted(make_cell):
    """The same with `kill -9` of the shard in the middle, twice: nothing lost, nothing doubled."""
    cell = make_cell().start_all()
    workers = [cell.worker("increment", 1000) for _ in range(4)]
    for _ in range(2):
        workers[0].expect("progress")
        cell.kill()
        cell.start()
    for worker in workers:
        assert worker.expect("done", LONG_S).startswith("1000 ")
    assert counted(cell) == 4000


@both
def test_stopped_holder_is_fenced_when_it_wakes(make_cell):
    """A holder stopped for three TTLs while another commits: its commit is refused, the value stands."""
    cell = make_cell().start_all()
    holder = cell.worker("hold")
    holder.expect("holding")
    holder.signal(signal.SIGSTOP)
    stopped_s = time.monotonic()
    other = cell.worker("write_once", 5)
    other.expect("wrote")
    assert time.monotonic() - stopped_s >= TTL_S / 2 * 0.9
    while time.monotonic() - stopped_s < 3 * TTL_S:  # the claim is about three TTLs
        other_value = counted(cell)
        assert other_value == 5

    holder.signal(signal.SIGCONT)
    holder.tell("")

    assert "nothing was written" in holder.expect("lost")
    assert counted(cell) == 5


def test_holder_of_the_interpreter_lock_keeps_its_lease(make_cell):
    """A holder whose interpreter is busy for 6 TTLs under 100 notices/s keeps its lock and commits."""
    cell = make_cell().start_all()
    ticking = cell.worker("ticker", 100)
    ticking.expect("started")
    holder = cell.worker("hold_gil", GIL_S)
    holder.expect("holding")

    assert float(holder.expect("slept", GIL_S + LONG_S)) >= 6 * TTL_S
    holder.expect("committed")

    assert counted(cell) == 222
    ticking.tell("stop")
    assert int(ticking.expect("committed")) > GIL_S * 100 / 20


@both
def test_killed_holder_leaves_its_lock(make_cell):
    """After `kill -9` of a holder the next one gets the lock, though it was held for a minute."""
    cell = make_cell().start_all()
    holder = cell.worker("hold")
    holder.expect("holding")
    waiter = cell.worker("write_once", 7)
    waiter.expect("asking")

    holder.signal(signal.SIGKILL)
    waiter.expect("wrote", 45)  # it would be a minute without that

    assert counted(cell) == 7


@both
def test_opposite_order_locks_neither_deadlock_nor_starve(make_cell):
    """8 processes lock random pairs in any order: all go on, nobody is overtaken, sums agree."""
    seconds = float(os.environ.get("ENACT_OPPOSITE_SECONDS", "8"))
    cell = make_cell().start_all()
    workers = [cell.worker("opposite", seed, seconds, 4) for seed in range(8)]
    results = [json.loads(worker.expect("done", seconds + LONG_S)) for worker in workers]

    assert all(result["done"] > 0 and result["timeouts"] == 0 for result in results), results
    total = sum(counted(cell, Entity(f"pair/{i}")) for i in range(4))
    assert total == 2 * sum(result["done"] for result in results)
    with connect(cell.file) as joined:
        counters = joined.shards()[0].counters
    assert counters.get("locks_bypassed", 0) == 0
    assert counters["lock_waits"] > 0


def test_two_perceptions_of_one_package_create_one_entity(make_cell):
    """Look, then create, under WriteEach: of two processes one creates and one finds."""
    cell = make_cell(shards=("s0", "s1")).start_all()
    workers = [cell.worker("perceive", "milk") for _ in range(2)]
    for worker in workers:
        worker.expect("ready")
    for worker in workers:
        worker.tell("go")
    said = sorted(next_word(worker) for worker in workers)

    assert said == ["created", "found"]
    with connect(cell.file) as joined:
        assert len(joined.world("online").entities("package/*")) == 1


def next_word(worker):
    for start in ("created", "found"):
        if any(line.startswith(start) for line in worker.seen):
            return start
    line = worker.lines.get(timeout=LONG_S)
    assert line is not None, worker.story()
    worker.seen.append(line)
    return line.split()[0]


def test_long_reader_makes_writer_wait_visibly(make_cell):
    """`enact lock ls` shows who waits for whom, by name, while a reader holds its lock."""
    cell = make_cell().start_all()
    reader = cell.worker("read_long")
    reader.expect("reading")
    writer = cell.worker("write_once", 1)
    writer.expect("asking")

    with connect(cell.file) as joined:
        while len(found := joined.locks()) < 2:
            assert writer.popen.poll() is None, writer.story()
    listed = cell.enact("lock", "ls", "--json")

    held = next(lock for lock in found if lock.granted)
    waiting = next(lock for lock in found if not lock.granted)
    assert (held.actor, waiting.actor) == ("read_long", "write_once")
    assert waiting.waits_for == (held.number,)
    assert held.modes == "read"
    assert listed.returncode == 0, listed.stderr
    assert "write_once" in listed.stdout
    assert "read_long" in listed.stdout
    reader.tell("")
    writer.expect("wrote")


def test_lost_lock_names_its_cause():
    """LeaseLostError carries the shard's words."""
    assert LeaseLostError("x", cause="held too long").cause == "held too long"
