"""Readers that must not stop writers, and data that must not be stale."""

import json
import time

import numpy as np
import pytest

from enact_dist import Aspect, Durability, Entity, Lock, Read, View, Write, connect
from enact_dist.errors import NullDatumError

COUNT = Aspect("count", int)
FRAME = Aspect("frame", np.ndarray, Durability.VOLATILE)
counter = Entity("counter")


@pytest.mark.slow
def test_slow_viewer_leaves_writer_alone(make_cell):
    """While a reader works on its View, a writer of 100 Hz goes on; a lock would stop it."""
    cell = make_cell().start_all()
    ticking = cell.worker("ticker", 100)
    ticking.expect("started")
    with connect(cell.file) as joined:
        world = joined.world("online")
        watch = world.watch(Entity("ticker"), COUNT)
        assert watch.next(60.0)
        viewer = cell.worker("view_slowly")
        first = viewer.expect("viewing")
        while watch.next(60.0).version < int(first) + 100:
            pass
        viewer.tell("look again")
        assert viewer.expect("still", 30) == first, "a view is of one moment"
        watch.close()
    ticking.tell("stop")
    assert int(ticking.expect("committed")) >= int(first) + 100


@pytest.mark.slow
def test_no_stale_value_is_served_after_shard_restarted(make_cell):
    """A warm client cache never answers for a volatile slot that its shard has lost."""
    cell = make_cell().start_all()
    with connect(cell.file) as joined:
        online = joined.world("online")
        read, write = Read(online, counter, FRAME), Write(online, counter, FRAME)
        for value in (1, 2):
            with Lock(write) as lock:
                lock[write] = np.full(100_000, value)
        with Lock(read) as lock:
            assert lock[read][0] == 2

        cell.kill()
        cell.start()

        with Lock(read, wait_s=20.0) as lock, pytest.raises(NullDatumError, match="lost"):
            lock[read]
        for value in (3, 4):  # versions 1 and 2 again, with other data
            with Lock(write) as lock:
                lock[write] = np.full(100_000, value)
        with Lock(read) as lock:
            assert lock.version(read) == 2
            assert lock[read][0] == 4


@pytest.mark.slow
@pytest.mark.carrier("socket", "zenoh")
def test_watcher_that_was_stopped_resynchronises_and_says_what_it_missed(make_cell, carrier):
    """A reader stopped for 3 s gets the newest state and the number of skipped versions.

    Over a socket none are skipped: the shard keeps them for it.
    """
    import signal

    cell = make_cell().start_all()
    watcher = cell.worker("watch_ticker")
    ticking = cell.worker("ticker", 100)
    ticking.expect("started")
    watcher.expect("version")  # it follows
    watcher.signal(signal.SIGSTOP)
    stopped_s = time.monotonic()
    with connect(cell.file) as joined:
        view = View(joined.world("online"), Entity("ticker"), COUNT)
        start = joined.world("online").view(view)[view]
        watch = joined.world("online").watch(Entity("ticker"), COUNT)
        # 3 s at 100 Hz; who was behind its time commits them faster
        while watch.next(60.0).version < start + 300 or time.monotonic() < stopped_s + 3.0:
            pass
        watch.close()
    watcher.signal(signal.SIGCONT)
    ticking.tell("stop")
    last = int(ticking.expect("committed"))
    watcher.tell(str(last))
    said = json.loads(watcher.expect("summary"))

    assert said["last"] == last
    assert said["first"] - 1 + said["seen"] + said["gap"] == last
    assert said["gap"] > 0 if carrier == "zenoh" else said["gap"] == 0
    assert said["in_order"]


def test_missing_shard_is_an_error_that_names_shard_and_endpoint(make_cell):
    """Nothing that lies on a dead shard looks like an empty answer."""
    from enact_dist.errors import ShardUnreachableError

    cell = make_cell(shards=("s0", "s1")).start_all()
    with connect(cell.file, request_timeout_s=1.0) as joined:
        online = joined.world("online")
        cell.kill("s1")
        with pytest.raises(ShardUnreachableError, match=rf"s1 at tcp/127.0.0.1:{cell.ports['s1']}"):
            online.list_slots()
        joined._client.request_timeout_s = 10.0
        states = {shard.name: shard.reachable for shard in joined.shards()}
        assert states == {"s0": True, "s1": False}
