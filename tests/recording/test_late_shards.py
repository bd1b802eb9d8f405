"""A commit over shards is recorded whole, however late one of them shows its part."""

import threading

import pytest
from polling import until
from ports import free_endpoint

from enact_dist import Aspect, Entity, Lock, Write, connect
from enact_dist.core.protocol.messages import Finish
from enact_dist.core.protocol.parts import Pin, PlacementMap, ShardEntry
from enact_dist.core.shard.state import ShardSettings
from enact_dist.link.daemon.daemon import start_shard
from enact_dist.link.daemon.settings import DaemonSettings
from enact_dist.recording import Recorder, recorder, settling
from enact_dist.recording.reading import Recording

NAMES = ("left", "right")
COUNT = Aspect("count", int)


@pytest.fixture
def late_cell():
    """Two shards that lose what a deciding one says: the other asks it by itself after a second."""
    entries = tuple(ShardEntry(name, (free_endpoint(),)) for name in NAMES)
    placement = PlacementMap(1, entries, tuple(Pin(f"{name}/**", name) for name in NAMES))
    shards = []
    try:
        for name, endpoints in entries:
            settings = ShardSettings(name, placement, worlds=("online",))
            shards.append(start_shard(DaemonSettings("late", settings, endpoints)))
        for shard in shards:
            shard.host.call_with(lambda name, request, calls=shard._calls: (
                None if isinstance(request, Finish) else calls.submit(name, request)
            ))  # fmt: skip
        with connect(entries[0].endpoints[0]) as cell:
            yield cell
    finally:
        for shard in shards:
            shard.stop()


@pytest.mark.parametrize("at_the_end", [False, True], ids=["meanwhile", "at the end"])
def test_commit_that_one_shard_shows_late_is_recorded_whole(
    late_cell, tmp_path, monkeypatch, at_the_end
):
    """It was reported before the recorder was told to stop; its halves are one commit."""
    monkeypatch.setattr(settling, "SHOWN_S", 60.0)  # on a busy machine, too
    monkeypatch.setattr(recorder, "END_S", 60.0)
    online, path = late_cell.world("online"), tmp_path / "run.mcap"
    requests = [Write(online, Entity(f"{name}/piece"), COUNT) for name in NAMES]
    stop, begun, both = threading.Event(), threading.Event(), threading.Event()

    def tell(summary):
        begun.set()
        if summary.versions == 2:
            both.set()

    following = Recorder(late_cell, path)
    thread = threading.Thread(target=lambda: following.run(stop, tell=tell))
    thread.start()
    assert begun.wait(60)
    with Lock(*requests) as lock:
        for request in requests:
            lock[request] = 1
    if not at_the_end:
        assert both.wait(60)
    stop.set()
    thread.join(120)

    (commit,) = Recording(path).commits()
    assert sorted(version.shard for version in commit.versions) == list(NAMES)
    assert (following.summary.missing, following.summary.out_of_order) == (0, 0)


def test_shard_that_shows_nothing_any_more_is_not_waited_for_long(late_cell, monkeypatch):
    """What is in doubt for good ends no recording, and what else is committed is recorded."""
    monkeypatch.setattr(settling, "SHOWN_S", 0.2)
    resting = settling.Settling(late_cell._client)
    monkeypatch.setattr(resting, "_all_show", lambda _, **__: False)

    resting.told(7)
    until(lambda: resting.settled_ns(0.1) >= 7)
    resting.wait_shown(7, wait_s=0.2)
