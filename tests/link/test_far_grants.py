"""Grants that stay with sessions that share no memory with the shard, between real processes.

Client and shard meet in different shared folders, as if they ran on two hosts.
"""

import os
import signal
import threading
import time

import pytest
from kept_processes import RETAINER, Waiting, heard, keep, kept_of, slot, stopped, used_again
from socket_parts import add_one

from enact_dist import Entity, Lock, Read, Write, connect
from enact_dist.core.protocol.messages import KeepAlive

pytestmark = [pytest.mark.carrier("zenoh"), pytest.mark.kept_grants]

KEEPS = """
keep()
tell("kept")
hear()
"""
KEEPS_GOING = """
from enact_dist.errors import CommitUnknownError, LeaseLostError

keep()
tell("kept")
while True:
    try:
        add_one()
    except (CommitUnknownError, LeaseLostError):
        pass  # it was stopped in the block
"""
USES = """
keep()
with Lock(write) as lock:
    tell("in")
    hear()
    lock[write] = lock.get(write, 0) + 1
tell("out")
hear()
"""
FORKS = """
keep()
child = os.fork()
if not child:
    try:
        add_one()
    except EnactError:
        os._exit(7)
    os._exit(0)
_, status = os.waitpid(child, 0)
tell(os.waitstatus_to_exitcode(status))
add_one()
tell(len(kept))
hear()
"""


@pytest.fixture
def shard(daemon, endpoint, monkeypatch, tmp_path):
    """A shard in this process, whose shared folder no client sees."""
    started = daemon(endpoint)
    monkeypatch.setenv("ENACT_SHARED_FOLDER", str(tmp_path / "another host"))
    return started


@pytest.fixture
def cell(shard, endpoint):
    """A client that shares no memory with the shard."""
    with connect(endpoint, actor="next") as opened:
        add_one(opened, Entity("warm"))
        assert opened.statistics()["payload_folders_elsewhere"] >= 1
        yield opened


class Calls:
    """What a client sends from now on, keep-alives left out."""

    def __init__(self, cell, monkeypatch):
        self.kinds = []
        carrier = cell._client.carrier
        ask = carrier.request_all

        def request_all(requests, *, timeout_s):
            requests = tuple(requests)
            self.kinds += [type(r).__name__ for _, r in requests if not isinstance(r, KeepAlive)]
            return ask(requests, timeout_s=timeout_s)

        monkeypatch.setattr(carrier, "request_all", request_all)


def listeners():
    return [thread for thread in threading.enumerate() if thread.name == "enact-recalls"]


def state_of(cell, actor):
    return [info.state for info in cell.locks() if info.actor == actor]


def test_update_is_one_call_and_a_read_none(cell, monkeypatch):
    """Once the grant stays; what each block shows is what the one before has written."""
    count = slot(cell)
    keep(cell, count)
    calls, before = Calls(cell, monkeypatch), used_again(cell)
    for number in range(10):
        with Lock(count) as lock:
            assert lock[count] == number
            lock[count] = number + 1
        with Lock(count) as lock:
            assert lock[count] == number + 1

    assert calls.kinds == ["Commit"] * 10
    assert used_again(cell) == before + 20


def test_reads_are_kept_side_by_side(cell, endpoint, monkeypatch):
    """Two sessions keep the same datum for reading; a writer recalls both."""
    add_one(cell)
    read = Read(cell.world("online"), slot(cell).entity, slot(cell).aspect)
    with connect(endpoint, actor="other") as other:
        keep(cell, read)
        keep(other, Read(other.world("online"), read.entity, read.aspect))
        assert kept_of(cell)
        assert kept_of(other)
        with connect(endpoint, actor="third") as third:
            add_one(third)
        with Lock(read) as lock:
            assert lock[read] == 2


def test_idle_grant_goes_to_whoever_asks(cell, endpoint, program, record_property):
    """Word, release, grant: no lease has to end."""
    process = program(RETAINER, endpoint, KEEPS)
    heard(process, "kept")
    assert state_of(cell, "retainer") in ([], ["kept"])
    before_s = time.perf_counter()
    add_one(cell)
    record_property("granted_ms", (time.perf_counter() - before_s) * 1e3)

    assert time.perf_counter() - before_s < cell._client.core.ttl_ns / 2e9
    assert state_of(cell, "retainer") == []


def test_used_grant_goes_with_its_block(cell, endpoint, program):
    """The waiter is next; the block's commit stands."""
    process = program(RETAINER, endpoint, USES)
    heard(process, "in")
    waiting = Waiting(slot(cell))
    while state_of(cell, "retainer") != ["recalled"]:
        assert not waiting.granted.is_set()
    process.stdin.write("\n")
    process.stdin.flush()
    heard(process, "out")
    waiting.end()
    with Lock(slot(cell)) as lock:
        assert lock[slot(cell)] == 1


@pytest.mark.parametrize("sent", [signal.SIGSTOP, signal.SIGKILL])
def test_process_that_cannot_answer_holds_up_others_until_its_lease_ends(
    cell, endpoint, program, sent
):
    """As with any lock of it; then the others go on, and it believes nothing that is not so."""
    process = program(RETAINER, endpoint, KEEPS_GOING)
    heard(process, "kept")
    if sent == signal.SIGSTOP:
        stopped(process)
    else:
        process.kill()
        process.wait()
    before_s = time.perf_counter()
    with Lock(slot(cell), wait_s=30.0) as lock:
        counted = lock[slot(cell)]
    waited_s = time.perf_counter() - before_s
    assert waited_s < 2.5 * cell._client.core.ttl_ns / 1e9

    if sent == signal.SIGSTOP:
        os.kill(process.pid, signal.SIGCONT)
        while True:
            assert process.poll() is None
            with Lock(slot(cell)) as lock:
                if lock[slot(cell)] > counted:
                    break


def test_two_that_write_in_turn_lose_no_update(cell, endpoint):
    """Whatever stays, is recalled and given back meanwhile."""
    rounds, threads = 200, 2
    with connect(endpoint, actor="other") as other:

        def count(opened):
            for _ in range(rounds):
                add_one(opened)

        working = [
            threading.Thread(target=count, args=(opened,))
            for opened in (cell, other)
            for _ in range(threads)
        ]
        for thread in working:
            thread.start()
        for thread in working:
            thread.join()
        with Lock(slot(cell)) as lock:
            assert lock[slot(cell)] == 2 * threads * rounds


def test_own_lock_that_conflicts_is_granted(cell):
    """What its own session keeps stands in nobody's way: the listening thread gives it back."""
    count, more = slot(cell), Write(cell.world("online"), Entity("more"), slot(cell).aspect)
    keep(cell, count)
    before_s = time.perf_counter()
    with Lock(count, more) as lock:
        lock[more] = lock[count]

    assert time.perf_counter() - before_s < cell._client.core.ttl_ns / 2e9


def test_idle_session_gives_its_grants_back_and_listens_no_more(cell):
    """Nobody waits for a session that has gone on to something else."""
    keep(cell, slot(cell))
    assert len(listeners()) == 1
    for thread in listeners():
        thread.join(10.0)
        assert not thread.is_alive()

    assert kept_of(cell) == {}
    assert state_of(cell, "next") == []


def test_closed_session_leaves_neither_grant_nor_thread(shard, endpoint):
    """Its goodbye answers the question that its thread waits for."""
    with connect(endpoint, actor="gone") as opened:
        keep(opened, slot(opened))
        assert listeners()
        before_s = time.perf_counter()
    assert time.perf_counter() - before_s < 0.5
    assert not listeners()
    with connect(endpoint, actor="next") as opened:
        assert state_of(opened, "gone") == []


def test_restarted_shard_ends_it(shard, daemon, endpoint, cell):
    """The next lock asks, after the grace, and the grant may stay again."""
    count = slot(cell)
    keep(cell, count)
    shard.stop(drain_s=0.0)
    daemon(endpoint)
    with Lock(count, wait_s=20.0) as lock:
        lock[count] = 1
    keep(cell, count)


def test_drained_shard_stops_soon(shard, cell):
    """It recalls what is kept, and stops once that was given back."""
    keep(cell, slot(cell))
    before_s = time.perf_counter()
    shard.stop(drain_s=10.0)

    assert time.perf_counter() - before_s < 3.0


def test_broken_by_hand_refuses_the_commit_of_its_block(cell, endpoint, program):
    """As with any lock that was broken."""
    process = program(RETAINER, endpoint, USES)
    heard(process, "in")
    (info,) = [info for info in cell.locks() if info.actor == "retainer"]
    cell.break_lock(info.number, shard="s0", reason="a test")
    add_one(cell)
    process.stdin.write("\n")
    process.stdin.flush()
    _, said = process.communicate()
    assert "LeaseLostError" in said
    with Lock(slot(cell)) as lock:
        assert lock[slot(cell)] == 1


def test_forked_child_has_no_part_in_it(cell, endpoint, program):
    """It may not use the cell, and the parent goes on."""
    process = program(RETAINER, endpoint, FORKS)
    heard(process, "7")
    heard(process, "1")


@pytest.mark.parametrize("where", ["client", "shard"])
def test_switched_off_at_either_end(daemon, endpoint, monkeypatch, tmp_path, where):
    """Every lock is asked for."""
    monkeypatch.setenv("ENACT_RETAIN", "0" if where == "shard" else "1")
    daemon(endpoint)
    monkeypatch.setenv("ENACT_SHARED_FOLDER", str(tmp_path / "another host"))
    monkeypatch.setenv("ENACT_RETAIN", "0" if where == "client" else "1")
    with connect(endpoint) as opened:
        for _ in range(6):
            add_one(opened)
        assert used_again(opened) == 0
        assert not listeners()
