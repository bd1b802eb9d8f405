"""A shard whose disk stands still is alive: it says so, and nobody takes it for dead."""

import threading

import pytest
from quiet_moments import ATTEMPTS, met_once

from enact_dist import Aspect, Entity, Lock, Write, connect
from enact_dist.errors import CommitUnknownError, ShardUnreachableError
from enact_dist.link import host_figures as stalls
from enact_dist.link.client import locks as client
from enact_dist.link.client import session as session_client
from enact_dist.link.store.store import Store

COUNT = Aspect("count", int)
CUP = Entity("cup")


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
    """The shard answers all the time, only not with the end; its word for it is passed on."""
    daemon(endpoint, folder=tmp_path, durability="durable")
    monkeypatch.setattr(client, "FINISH_S", 2.5)
    with connect(endpoint) as cell:
        add_one(cell)

        def attempt():
            disk.clear()
            try:
                with pytest.raises(CommitUnknownError, match="s0 still works on it") as caught:
                    add_one(cell)
                assert "no answer" not in str(caught.value)
            finally:
                disk.set()
            assert cell.outcome(caught.value.lock_id) is not None

        met_once(attempt)


def test_shard_whose_disk_stands_still_is_not_taken_for_dead(
    daemon, endpoint, tmp_path, disk, monkeypatch
):
    """Neither who connects nor who registers an aspect is asked whether the shard runs."""
    shard = daemon(endpoint, folder=tmp_path, durability="durable")
    monkeypatch.setattr(session_client, "FINISH_S", 0.5)
    with connect(endpoint) as cell:
        add_one(cell)
        disk.clear()

        def connects():
            with pytest.raises(ShardUnreachableError, match=r"s0 is running.*its disk"):
                connect(endpoint, timeout_s=next(longer_s))

        def registers():
            request_timeout_s = next(longer_s)
            with pytest.raises(ShardUnreachableError, match=r"it runs.*its disk") as caught:
                cell._client.greet(timeout_s=request_timeout_s)
                cell._client.register(worlds=("another",), timeout_s=request_timeout_s)
            assert caught.value.shard == "s0"

        # On a machine that stands still for as long, nobody has said anything in time.
        for act in (connects, registers):
            longer_s = (0.5 * 2**attempt for attempt in range(ATTEMPTS))
            met_once(act)
        disk.set()
    assert shard.host._shard.counters["disk_stalls"] >= 1


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
