"""Lineage over two shards on disk: over world contexts."""

import socket

import pytest

from enact_dist import Aspect, Entity, Lock, Read, View, Write, connect
from enact_dist.core.messages import Pin, PlacementMap, ShardEntry
from enact_dist.core.shard_state import ShardSettings
from enact_dist.link.shard_daemon import DaemonSettings, start_shard

COUNT = Aspect("count", int)
SUM = Aspect("sum", int)
here = Entity("a/1")


def names(trees):
    return [f"{one.world}:{one.entity}/{one.aspect} v{one.version}" for one in trees]


class TwoShards:
    """Shards `a` and `b` on disk, with the entities a/** and b/**."""

    def __init__(self, folder):
        self.folder = folder
        sockets = [socket.create_server(("127.0.0.1", 0)) for _ in "ab"]
        self.endpoints = [f"tcp/127.0.0.1:{each.getsockname()[1]}" for each in sockets]
        for each in sockets:
            each.close()
        self.running = {}

    def start(self):
        at = dict(zip("ab", self.endpoints, strict=True))
        entries = tuple(ShardEntry(name, (endpoint,)) for name, endpoint in at.items())
        placement = PlacementMap(1, entries, (Pin("a/**", "a"), Pin("b/**", "b")))
        for name, endpoint in at.items():
            settings = ShardSettings(name, placement, worlds=("online", "training"))
            daemon = DaemonSettings("cell", settings, (endpoint,), self.folder / name)
            self.running[name] = start_shard(daemon)

    def stop(self):
        while self.running:
            self.running.popitem()[1].stop(drain_s=0.0)

    def connect(self):
        return connect(self.endpoints[0], actor="tester")


@pytest.fixture
def two(tmp_path, monkeypatch):
    monkeypatch.setenv("ENACT_SHARED_FOLDER", str(tmp_path / "shared"))
    (tmp_path / "shared").mkdir()
    shards = TwoShards(tmp_path)
    shards.start()
    yield shards
    shards.stop()


def chained(cell):
    """Commit view → model on both shards → verdict, in two world contexts."""
    training, online = cell.world("training"), cell.world("online")
    training.init(here, COUNT, 1)
    view = Read(training, here, COUNT)
    models = [Write(training, Entity(name), SUM) for name in ("a/model", "b/model")]
    with Lock(view, *models) as lock:
        for model in models:
            lock[model] = lock[view]
    verdict, model = Write(online, Entity("a/verdict"), SUM), View(training, Entity("b/model"), SUM)
    with Lock(model, verdict) as lock:
        lock[verdict] = lock[model]


CAUSES = ["online:a/verdict/sum v1", "training:b/model/sum v1", "training:a/1/count v1"]
EFFECTS = [
    "training:a/1/count v1",
    "training:a/model/sum v1",
    "training:b/model/sum v1",
    "online:a/verdict/sum v1",
]


def test_trees_go_over_shards_and_world_contexts(two):
    """A verdict on one shard comes from a model on another, and from a view on the first."""
    with two.connect() as cell:
        chained(cell)

        tree = cell.why("online", "a/verdict", SUM)
        effects = cell.impact("training", here, COUNT)

    assert names(tree.walk()) == CAUSES
    assert names(effects.walk()) == EFFECTS
    assert {one.position.shard for one in tree.walk()} == {"a", "b"}
    assert {one.actor for one in tree.walk()} == {"tester"}
