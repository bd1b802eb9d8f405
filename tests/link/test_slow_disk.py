"""A shard whose disk stands still is alive: it says so, and nobody takes it for dead."""

import threading
import time

import pytest

from enact_dist import Aspect, Entity, Lock, Write, connect
from enact_dist.core.protocol.messages import OUTCOME_PENDING, Commit, Outcome, OutcomeIs
from enact_dist.errors import CommitUnknownError, ShardUnreachableError
from enact_dist.link import host_figures as stalls
from enact_dist.link.client import locks as client
from enact_dist.link.client import session as session_client
from enact_dist.link.store.store import Store
from enact_dist.link.zenoh import discovery
from enact_dist.world import connecting

COUNT = Aspect("count", int)
CUP = Entity("cup")
HOUR_S = 3600.0


class PassingTime:
    """This host's clocks, on which a test lets time pass at once."""

    passed_s = 0.0
    sleep = staticmethod(time.sleep)

    def monotonic(self):
        return time.monotonic() + self.passed_s

    def boottime_ns(self):
        return session_client.boottime_ns() + int(self.passed_s * 1e9)


@pytest.fixture(autouse=True)
def _long_leases(monkeypatch):
    """A session outlives what stands still beside the disk: what is tested is not its lease."""
    monkeypatch.setattr(connecting, "TTL_S", 60.0)


@pytest.fixture
def disk(monkeypatch):
    """Whether the disks of all shards of this process go on; they do, until it is cleared."""
    goes_on, write = threading.Event(), Store.write
    goes_on.set()
    goes_on.stalls_after = lambda seconds: monkeypatch.setattr(stalls, "STALL_S", seconds)

    def write_when_it_goes_on(store, batch):
        assert goes_on.wait(60)
        write(store, batch)

    monkeypatch.setattr(Store, "write", write_when_it_goes_on)
    goes_on.stalls_after(0.1)
    yield goes_on
    goes_on.set()


def add_one(cell, aspect=COUNT):
    write = Write(cell.world("online"), CUP, aspect)
    with Lock(write) as lock:
        lock[write] = lock.get(write, 0) + 1


def disk_lines(caplog):
    return [
        record.getMessage()
        for record in caplog.records
        if "the store of shard" in record.getMessage()
    ]


def test_commit_that_the_disk_still_works_on_says_so(daemon, endpoint, tmp_path, disk, monkeypatch):
    """A shard that has not kept a commit yet says so; once time is up its word is passed on."""
    daemon(endpoint, folder=tmp_path, durability="durable")
    monkeypatch.setattr(client, "FINISH_S", HOUR_S)
    with connect(endpoint) as cell:
        add_one(cell)
        clock, asked, request = PassingTime(), [], cell._client.carrier.request
        monkeypatch.setattr(cell._client, "_now_ns", clock.boottime_ns)

        def ask(shard, message, **options):
            answer = request(shard, message, **options)
            if isinstance(message, Commit | Outcome):
                asked.append((type(message), getattr(answer, "kind", answer)))
            if isinstance(answer, OutcomeIs):  # the time for the commit ends with this word
                clock.passed_s = HOUR_S
            return answer

        monkeypatch.setattr(cell._client.carrier, "request", ask)
        disk.clear()
        with pytest.raises(CommitUnknownError, match="s0 still works on it") as caught:
            add_one(cell)
        assert asked[0] == (Commit, None)
        assert asked[-1] == (Outcome, OUTCOME_PENDING)
        assert "no answer" not in str(caught.value)

        disk.set()
        assert cell.outcome(caught.value.lock_id) is not None


def test_who_connects_while_the_disk_stands_still_reads_that_the_shard_runs(
    daemon, endpoint, tmp_path, disk, monkeypatch
):
    """The shard is found, its welcome waits for the disk, and then time is up."""
    daemon(endpoint, folder=tmp_path, durability="durable")
    clock, greet = PassingTime(), discovery._Probe.greet

    def greet_at_last(probe, found, hello, deadline_s):
        answer = greet(probe, found, hello, clock.monotonic())  # asks for the shortest time
        clock.passed_s = HOUR_S
        return answer

    monkeypatch.setattr(discovery, "time", clock)
    monkeypatch.setattr(discovery._Probe, "greet", greet_at_last)
    disk.clear()
    with pytest.raises(ShardUnreachableError, match=r"s0 is running.*its disk"):
        connect(endpoint, timeout_s=HOUR_S)


def test_shard_whose_disk_stands_still_is_not_taken_for_dead(
    daemon, endpoint, tmp_path, disk, monkeypatch, until
):
    """It greets those it knows, and who registers a world is told that it runs."""
    shard = daemon(endpoint, folder=tmp_path, durability="durable")
    monkeypatch.setattr(
        session_client, "CALL_S", HOUR_S
    )  # the question whether it runs is answered
    with connect(endpoint) as cell:
        add_one(cell)
        disk.clear()
        cell._client.greet(timeout_s=HOUR_S)
        with pytest.raises(ShardUnreachableError, match=r"it runs.*its disk") as caught:
            cell._client.register(worlds=("another",), timeout_s=0.0)
        assert caught.value.shard == "s0"
        until(lambda: shard.host._shard.counters.get("disk_stalls"))
        disk.set()


def test_disk_that_stands_still_is_told_to_the_log(daemon, endpoint, tmp_path, disk, caplog, until):
    """Once when it is noticed, and once, with its length, when it is over."""
    shard = daemon(endpoint, folder=tmp_path, durability="durable")
    disk.stalls_after(60.0)  # but for the one that is meant
    with connect(endpoint) as cell:
        add_one(cell)
        disk.clear()
        disk.stalls_after(0.1)
        waiting = threading.Thread(target=add_one, args=(cell,))
        waiting.start()

        until(lambda: shard.host._shard.counters.get("disk_stalls"))
        disk.stalls_after(60.0)
        disk.set()
        waiting.join()
        told = until(lambda: len(lines := disk_lines(caplog)) > 1 and lines)

    assert len(told) == 2, told
    assert "has written nothing for" in told[0]
    assert "writes again after" in told[1]
    assert shard.host._shard.counters["disk_stalls"] == 1


def test_idle_disk_stands_not_still(daemon, endpoint, tmp_path, disk):
    """A shard without work counts nothing."""
    shard = daemon(endpoint, folder=tmp_path, durability="durable")
    with connect(endpoint) as cell:
        add_one(cell)
        before = shard.host._shard.counters.get("disk_stalls", 0)
        for _ in range(4):
            shard.host.tick()

        assert shard.host._shard.counters.get("disk_stalls", 0) == before


def test_shard_without_a_turn_is_told_to_the_log(caplog):
    """A stopped process, or a machine with too much to do, is named once; short rests are not."""
    counted = []
    watch = stalls.Stalls("s0", counted.append)
    for now_s in (100.0, 100.1, 100.9, 112.7, 112.8):
        watch.look(None, now_s)

    (told,) = (record.getMessage() for record in caplog.records)
    assert "shard s0 did not run for 11.8 s" in told
    assert counted == []
