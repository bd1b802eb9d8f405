"""A cell inside the test's own process, or with one shard beside it, with two world contexts."""

import sys
import time
from pathlib import Path

import pytest
from ports import free_endpoint

from enact_dist import connect, local

sys.path.append(str(Path(__file__).parent))  # not first: other folders have a conftest, too

WORLDS = ("online", "training")


@pytest.fixture
def cell(carrier, tmp_path, monkeypatch):
    """The paper's mode where the test's carrier is "local"; else a shard behind that carrier."""
    if carrier == "local":
        with local(worlds=list(WORLDS)) as opened:
            yield opened
        return
    from enact_dist.core.protocol.messages import PlacementMap, ShardEntry
    from enact_dist.core.shard.state import ShardSettings
    from enact_dist.link.daemon.daemon import start_shard
    from enact_dist.link.daemon.settings import DaemonSettings

    monkeypatch.setenv("ENACT_SHARED_FOLDER", str(tmp_path))
    endpoint = free_endpoint()
    placement = PlacementMap(1, (ShardEntry("local", (endpoint,)),), ())
    settings = ShardSettings("local", placement, worlds=WORLDS)
    shard = start_shard(DaemonSettings("cell", settings, (endpoint,), carrier=carrier))
    try:
        with connect(endpoint) as opened:
            yield opened
    finally:
        shard.stop(drain_s=0.0)


class TwoShards:
    """Shards "left" and "right" in this process; entities go by the first part of their name."""

    def __init__(self, folder=None):
        from enact_dist.core.protocol.messages import Pin, PlacementMap, ShardEntry

        self._folder = folder
        self._endpoints = {name: free_endpoint() for name in ("left", "right")}
        self._placement = PlacementMap(
            1,
            tuple(ShardEntry(name, (end,)) for name, end in self._endpoints.items()),
            (Pin("left/**", "left"), Pin("right/**", "right")),
        )
        self._running = {}
        for name in self._endpoints:
            self.start(name)
        self.cell = self.connect()

    def start(self, name):
        from enact_dist.core.shard.state import ShardSettings
        from enact_dist.link.daemon.daemon import start_shard
        from enact_dist.link.daemon.settings import DaemonSettings

        settings = ShardSettings(name, self._placement, worlds=WORLDS)
        folder = self._folder / name if self._folder is not None else None
        self._running[name] = start_shard(
            DaemonSettings("cell", settings, (self._endpoints[name],), folder=folder)
        )

    def stop(self, name):
        self._running.pop(name).stop(drain_s=0.0)

    def connect(self, **options):
        return connect(self._endpoints["left"], **options)

    def close(self):
        self.cell.close()
        for name in list(self._running):
            self.stop(name)


@pytest.fixture
def two_shards(tmp_path, monkeypatch):
    """A cell of two shards in memory."""
    monkeypatch.setenv("ENACT_SHARED_FOLDER", str(tmp_path))
    running = TwoShards()
    try:
        yield running
    finally:
        running.close()


@pytest.fixture
def two_stored(tmp_path, monkeypatch):
    """The same with a folder for each shard, so that they may be stopped and started again."""
    monkeypatch.setenv("ENACT_SHARED_FOLDER", str(tmp_path))
    running = TwoShards(tmp_path)
    try:
        yield running
    finally:
        running.close()


class Loose:
    """Stands for `LOOSE_NS`: how long what was replaced stays for cuts, until the test ends it."""

    def __init__(self):
        self._ended_ns = 0

    def __rsub__(self, _now_ns):
        return self._ended_ns

    def end(self):
        """Let what was replaced until now have stayed for long enough."""
        self._ended_ns = time.time_ns()


@pytest.fixture
def loose(monkeypatch):
    """What is replaced in shards of this process stays for cuts until `loose.end()`."""
    from enact_dist.core.state import history

    monkeypatch.setattr(history, "LOOSE_NS", Loose())
    return history.LOOSE_NS


@pytest.fixture
def online(cell):
    return cell.world("online")
