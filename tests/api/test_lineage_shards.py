"""Lineage over two shards on disk: over world contexts, over a restart, over a fork."""

import socket

import pytest

from enact_dist import Aspect, Durability, Entity, Lock, Read, View, Write, connect
from enact_dist.core.protocol.messages import Pin, PlacementMap, ShardEntry
from enact_dist.core.shard.state import ShardSettings
from enact_dist.link.daemon.daemon import start_shard
from enact_dist.link.daemon.settings import DaemonSettings

COUNT = Aspect("count", int)
SUM = Aspect("sum", int)
QUICK = Aspect("quick", int, Durability.VOLATILE)
here, there, total = Entity("a/1"), Entity("b/1"), Entity("a/total")


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


def put(request, value):
    with Lock(request) as lock:
        lock[request] = value


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


def test_durable_chain_survives_a_restart(two):
    """Causes are kept as their versions are: after a restart both trees are the same."""
    with two.connect() as cell:
        chained(cell)
        before = names(cell.why("online", "a/verdict", SUM).walk())
    two.stop()
    two.start()

    with two.connect() as cell:
        tree = cell.why("online", "a/verdict", SUM)
        effects = cell.impact("training", here, COUNT)

    assert names(tree.walk()) == before == CAUSES
    assert names(effects.walk()) == EFFECTS
    assert {(one.kind, one.actor) for one in tree.walk()} == {("commit", "tester")}


def test_volatile_cause_is_forgotten_with_its_shard(two):
    """A durable datum names what it was made of, though that is gone; a new one is no cause."""
    with two.connect() as cell:
        online = cell.world("online")
        put(Write(online, there, QUICK), 3)
        view, target = View(online, there, QUICK), Write(online, total, SUM)
        with Lock(view, target) as lock:
            lock[target] = lock[view]
    two.stop()
    two.start()

    with two.connect() as cell:
        put(Write(cell.world("online"), there, QUICK), 4)  # version 1 again
        (cause,) = cell.why("online", total, SUM).children
        effects = cell.impact("online", there, QUICK)

    assert (cause.version, cause.kind) == (1, "forgotten")
    assert effects.children == ()


def test_fork_stands_between_a_datum_and_its_causes(two):
    """What was done in a fork comes from the datum that was forked, and that from its own causes."""
    with two.connect() as cell:
        chained(cell)
        what_if = cell.world("training").fork("what_if")
        model, guess = Read(what_if, Entity("b/model"), SUM), Write(what_if, total, SUM)
        with Lock(model, guess) as lock:
            lock[guess] = lock[model] + 1

        tree = cell.why(what_if, total, SUM)
        effects = cell.impact("training", "b/model", SUM)

    assert [one.kind for one in tree.walk()] == ["commit", "fork", "commit", "commit"]
    assert [(one.world, one.entity.name) for one in tree.walk()] == [
        ("what_if", "a/total"),
        ("what_if", "b/model"),
        ("training", "b/model"),
        ("training", "a/1"),
    ]
    assert {one.world for one in effects.walk()} == {"training", "online", "what_if"}
