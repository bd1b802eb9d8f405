"""A watch that is open while the cell gets another shard, and entities move there."""

import threading
import time

import pytest
from ports import free_endpoint

from enact_dist import Actor, ActorThread, Lock, World, connect
from enact_dist.core.protocol.messages import Pin, PlacementMap, ShardEntry
from enact_dist.core.shard.state import ShardSettings
from enact_dist.link.daemon.daemon import start_shard
from enact_dist.link.daemon.settings import DaemonSettings
from enact_dist.link.offline.rebalance import rebalance
from enact_dist.recording import Recorder
from enact_dist.recording.reading import Recording
from enact_dist.terms import Aspect, Durability, Entities, Entity, View, Write

pytestmark = pytest.mark.carrier("socket", "zenoh")

COUNT = Aspect("count", int, Durability.OS)
STAYS, MOVES, NEW = Entity("part/left"), Entity("part/right"), Entity("part/right/new")
WAIT_S = 30.0


class GrowingCell:
    """A cell of shard "left" that gets a shard "right", to which `part/right` moves."""

    def __init__(self, folder, carrier):
        self.folder, self.carrier, self.running = folder, carrier, []
        self.endpoints = {name: free_endpoint() for name in ("left", "right")}
        self.start(self.placement("left"))

    def placement(self, *names):
        """Return the placement of a cell that has these shards."""
        entries = tuple(ShardEntry(name, (self.endpoints[name],)) for name in names)
        pins = (Pin("part/right/**", "right"), Pin("part/right", "right"), Pin("part/**", "left"))
        return PlacementMap(len(names), entries, tuple(pin for pin in pins if pin.shard in names))

    def start(self, placement):
        """Start its shards."""
        for name, endpoints in placement.shards:
            settings = ShardSettings(name, placement, worlds=("online", "planned"))
            daemon = DaemonSettings(
                "cell", settings, endpoints, self.folder / name, carrier=self.carrier
            )
            self.running.append(start_shard(daemon))

    def stop(self):
        """Stop all shards."""
        while self.running:
            self.running.pop().stop(drain_s=0.0)

    def grow(self):
        """Give the cell its second shard, as an operator does."""
        self.stop()
        placement = self.placement("left", "right")
        folders = {name: self.folder / name for name in self.endpoints}
        moved = rebalance(folders, placement, unix_s=int(time.time()))
        assert [move.entity for move in moved.moves] == [MOVES.name]
        self.start(placement)


@pytest.fixture
def growing(tmp_path, monkeypatch, carrier):
    """A cell of one stored shard that can get a second one; leases are short."""
    monkeypatch.setenv("ENACT_SHARED_FOLDER", str(tmp_path))
    monkeypatch.setattr("enact_dist.world.connecting.TTL_S", 0.4)
    cell = GrowingCell(tmp_path, carrier)
    yield cell
    cell.stop()


def put(world, entity, number):
    """Commit a number."""
    with Lock(write := Write(world, entity, COUNT), wait_s=WAIT_S) as lock:
        lock[write] = number


def told(change):
    """Return what of a change does not differ between runs."""
    return change.entity.name, change.version, change.gap, change.null, change.position.shard


def test_open_watch_sees_what_is_on_a_shard_that_was_added(growing):
    """What moved there is no change until it is written, and its versions go on without a gap."""
    with connect(growing.endpoints["left"]) as cell:
        online = cell.world("online")
        put(online, STAYS, 1)
        put(online, MOVES, 1)
        with online.watch(Entities("part/**"), COUNT) as watch:
            seen = {told(watch.next(WAIT_S)) for _ in range(2)}
            assert seen == {("part/left", 1, 0, False, "left"), ("part/right", 1, 0, False, "left")}

            growing.grow()
            with connect(growing.endpoints["right"]) as other:
                for number, entity in enumerate((MOVES, NEW, STAYS)):
                    put(other.world("online"), entity, number)
            seen = [told(watch.next(WAIT_S)) for _ in range(3)]

            assert sorted(seen) == [
                ("part/left", 2, 0, False, "left"),
                ("part/right", 2, 0, False, "right"),
                ("part/right/new", 1, 0, False, "right"),
            ]
            assert watch.next(1.0) is None


def test_open_diff_sees_what_is_on_a_shard_that_was_added(growing):
    """What moved there differs when it is written, what is new there at once."""
    with connect(growing.endpoints["left"]) as cell:
        online, planned = cell.world("online"), cell.world("planned")
        for world in (online, planned):
            put(world, STAYS, 1)
            put(world, MOVES, 1)
        with online.watch_diff(planned, Entities("part/**"), COUNT) as watch:
            assert watch.next(0.0) is None

            growing.grow()
            with connect(growing.endpoints["right"]) as other:
                for number, entity in enumerate((MOVES, NEW, STAYS), 2):
                    put(other.world("online"), entity, number)
            rows = [watch.next(WAIT_S) for _ in range(3)]

        assert sorted((row.entity.name, row.kind.value) for row in rows) == [
            ("part/left", "changed"),
            ("part/right", "changed"),
            ("part/right/new", "only left"),
        ]


def test_recorder_follows_a_shard_that_was_added(growing, tmp_path):
    """Its recording has what was written there, and misses nothing."""
    path, stop, begun = tmp_path / "run.mcap", threading.Event(), threading.Event()
    with connect(growing.endpoints["left"]) as cell:
        for entity in (STAYS, MOVES):
            put(cell.world("online"), entity, 1)
        recorder = Recorder(cell, path)
        whole = threading.Event()

        def tell(summary):
            begun.set()
            if summary.versions == 5:
                whole.set()

        thread = threading.Thread(target=lambda: recorder.run(stop, tell=tell))
        thread.start()
        try:
            assert begun.wait(WAIT_S)
            growing.grow()
            with connect(growing.endpoints["right"]) as other:
                for number, entity in enumerate((MOVES, NEW, STAYS), 1):
                    put(other.world("online"), entity, number)
            assert whole.wait(WAIT_S)
        finally:
            stop.set()
            thread.join(WAIT_S)

        versions = [version for commit in Recording(path).commits() for version in commit.versions]
        assert recorder.summary.missing == 0
        shards = {version.slot.entity: version.shard for version in versions}
        assert shards["part/right/new"] == shards["part/right"] == "right"


class Doubling(Actor):
    """Write twice of each count."""

    online = World("online")
    count = View(online, Entities("part/**"), COUNT)
    double = Write(online, Entities("part/**"), Aspect("double", int))
    triggers = (count,)

    def update(self, lock):
        """Write twice the count."""
        lock[self.double] = 2 * lock[self.count]


def test_actor_is_triggered_by_entities_of_a_shard_that_was_added(growing):
    """It runs on as it was started: nobody restarts the actors of a cell that grows."""
    with connect(growing.endpoints["left"]) as cell:
        put(cell.world("online"), STAYS, 1)
        put(cell.world("online"), MOVES, 1)
        with ActorThread(Doubling(), cell):
            growing.grow()
            with connect(growing.endpoints["right"]) as other:
                online = other.world("online")
                double = View(online, NEW, Doubling.double.aspect)
                with online.watch(NEW, double.aspect) as watch:
                    put(online, NEW, 21)
                    change = watch.next(WAIT_S)
                assert change is not None
                assert online.view(double)[double] == 42
