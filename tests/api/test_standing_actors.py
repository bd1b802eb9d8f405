"""Actors whose locks wait for news at their shard: they see every change, and ask for nothing else."""

import itertools
import queue
import threading
import time

import pytest
from polling import until

from enact_dist import (
    Actor,
    ActorThread,
    Aspect,
    Durability,
    Entities,
    Entity,
    Lock,
    View,
    World,
    Write,
)
from enact_dist.actor.binding import BoundActor
from enact_dist.errors import LockTimeoutError, UnknownWorldError

PATIENCE_S = 20.0
ONLINE = World("online")
CAMERA, ROBOT = Entity("camera"), Entity("robot")
IMAGE = Aspect("image", int, Durability.VOLATILE)
POSE = Aspect("pose", int, Durability.VOLATILE)
MASK = Aspect("mask", int, Durability.VOLATILE)

pytestmark = pytest.mark.carrier("local", "drawn")


@pytest.fixture(autouse=True)
def stands(monkeypatch):
    monkeypatch.setenv("ENACT_STANDING", "1")


class Segmenter(Actor):
    """Makes a mask of each image, and tells the test which image it saw."""

    image = View(ONLINE, CAMERA, IMAGE)
    mask = Write(ONLINE, CAMERA, MASK)
    triggers = (image,)

    def __init__(self):
        self.saw = queue.Queue()
        self.go_on = threading.Event()
        self.go_on.set()
        self.fails = 0

    def update(self, lock):
        found = lock[self.image]
        self.saw.put(found)
        assert self.go_on.wait(PATIENCE_S)
        if self.fails:
            self.fails -= 1
            raise RuntimeError("as the test wants")
        lock[self.mask] = found


def put(online, value, aspect=IMAGE):
    """Commit a datum of the camera, or null."""
    request = Write(online, CAMERA, aspect)
    with Lock(request) as lock:
        if value is None:
            del lock[request]
        else:
            lock[request] = value


def counted(cell, name):
    """Return a counter of the one shard."""
    (shard,) = cell.shards()
    return shard.counters.get(name, 0)


def test_each_change_is_seen_once_in_order(cell, online):
    """Also what was there before the actor started."""
    actor = Segmenter()
    put(online, 0)
    with ActorThread(actor, cell) as running:
        for number in range(20):
            assert actor.saw.get(timeout=PATIENCE_S) == number
            put(online, number + 1)
        assert actor.saw.get(timeout=PATIENCE_S) == 20
    assert actor.saw.empty()
    found = running.statistics()
    assert (found.updates, found.skipped, found.failures, found.refused) == (21, 0, 0, 0)


def test_changes_during_an_update_are_one_run_of_the_newest(cell, online):
    """Those passed over are counted."""
    actor = Segmenter()
    put(online, 0)
    actor.go_on.clear()
    with ActorThread(actor, cell) as running:
        assert actor.saw.get(timeout=PATIENCE_S) == 0
        for number in (1, 2, 3, 4):
            put(online, number)
        actor.go_on.set()
        assert actor.saw.get(timeout=PATIENCE_S) == 4
    assert running.statistics().skipped == 3


def test_failed_update_is_not_repeated_before_the_next_change(cell, online):
    """An exception is no refusal: the datum that caused it would cause it again."""
    actor = Segmenter()
    actor.fails = 1
    put(online, 1)
    with ActorThread(actor, cell) as running:
        assert actor.saw.get(timeout=PATIENCE_S) == 1
        put(online, 2)
        assert actor.saw.get(timeout=PATIENCE_S) == 2
    found = running.statistics()
    assert (found.updates, found.failures) == (1, 1)


def test_deleted_datum_runs_nothing(cell, online):
    """There is nothing to work on, until there is a datum again."""
    actor = Segmenter()
    put(online, 1)
    with ActorThread(actor, cell):
        assert actor.saw.get(timeout=PATIENCE_S) == 1
        put(online, None)
        put(online, 3)
        assert actor.saw.get(timeout=PATIENCE_S) == 3


def test_waiting_for_news_is_no_waiting_for_the_lock(cell, online):
    """`waited` is the time in the queue; while the actor is idle it delays no other lock."""
    actor = Segmenter()
    put(online, 0)
    with ActorThread(actor, cell) as running:
        assert actor.saw.get(timeout=PATIENCE_S) == 0
        time.sleep(1.5)  # the actor is idle: this is the case under test
        put(online, 5, MASK)
        put(online, 1)
        assert actor.saw.get(timeout=PATIENCE_S) == 1
    assert running.statistics().lock_wait_p99_ms < 1000.0


def test_holder_in_the_way_is_a_refusal_after_the_patience_of_the_actor(cell, online):
    """From the news on the lock waits as any other; the news is not lost meanwhile."""
    actor, errors = Segmenter(), queue.Queue()
    put(online, 0)
    report = lambda entity, error: errors.put((entity, error))  # noqa: E731
    with ActorThread(actor, cell, wait_s=0.3, on_error=report):
        assert actor.saw.get(timeout=PATIENCE_S) == 0
        put(online, 0, MASK)
        with Lock(Write(online, CAMERA, MASK)):
            threading.Thread(target=put, args=(online, 1)).start()
            entity, error = errors.get(timeout=PATIENCE_S)
        assert entity == CAMERA
        assert isinstance(error, LockTimeoutError)
        assert actor.saw.get(timeout=PATIENCE_S) == 1


def test_idle_actor_stops_at_once_and_reports_meanwhile(cell, online):
    """Neither its stop nor its report waits for news."""
    actor = Segmenter()
    with ActorThread(actor, cell, name="idle") as running:

        def runs():
            rows = (row for info in cell.actors() for row in info.report.get("actors", ()))
            return any(row["name"] == "idle" and row["state"] == "running" for row in rows)

        until(runs)
        begun_s = time.monotonic()
    assert time.monotonic() - begun_s < 5.0
    assert running.statistics().state == "stopped"


def test_lock_that_is_refused_is_asked_for_ever_more_rarely(cell, online):
    """A context that is gone is no reason to ask as fast as possible, and the actor does not end."""
    extra = cell.create_world("extra")
    actor, errors = Segmenter(), queue.Queue()
    put(extra, 1)
    report = lambda _entity, error: errors.put((time.monotonic(), error))  # noqa: E731
    with (
        extra.watch(CAMERA, MASK) as masks,
        ActorThread(actor, cell, {"online": "extra"}, on_error=report),
    ):
        assert actor.saw.get(timeout=PATIENCE_S) == 1
        assert masks.next(PATIENCE_S).version == 1  # its lock has ended with that commit
        cell.drop_world("extra")
        (first_s, error), (last_s, _) = [errors.get(timeout=PATIENCE_S) for _ in range(4)][::3]
    assert isinstance(error, UnknownWorldError)
    assert last_s - first_s > 0.1


class Fuser(Segmenter):
    """Is triggered by two data of the camera."""

    pose = View(ONLINE, CAMERA, POSE)
    triggers = (Segmenter.image, pose)

    def update(self, lock):
        self.saw.put((lock.get(self.image), lock.get(self.pose)))
        lock[self.mask] = 1


def test_either_of_two_triggers_runs_the_update(cell, online):
    """As with a watch: what changed first runs it, with the other one as it is."""
    actor = Fuser()
    with ActorThread(actor, cell):
        put(online, 1)
        assert actor.saw.get(timeout=PATIENCE_S) == (1, None)
        put(online, 2, POSE)
        assert actor.saw.get(timeout=PATIENCE_S) == (1, 2)


class OfEach(Actor):
    """Serves several entities."""

    image = View(ONLINE, Entities("*"), IMAGE)
    mask = Write(ONLINE, Entities("*"), MASK)
    triggers = (image,)

    def update(self, lock):
        lock[self.mask] = lock[self.image]


class Onlooker(Actor):
    """Locks nothing: it only views."""

    image = View(ONLINE, CAMERA, IMAGE)
    triggers = (image,)

    def update(self, lock):
        lock[self.image]


class OfTwo(Actor):
    """Is triggered by data of two entities."""

    image, pose = View(ONLINE, CAMERA, IMAGE), View(ONLINE, ROBOT, POSE)
    mask = Write(ONLINE, CAMERA, MASK)
    triggers = (image, pose)

    def update(self, lock):
        lock[self.mask] = 1


@pytest.mark.parametrize("kind", [OfEach, Onlooker, OfTwo])
def test_actors_whose_lock_cannot_wait_watch_their_triggers(cell, kind):
    """A pattern, views alone, and triggers of two entities."""
    assert BoundActor(kind(), cell).trigger_slots() == ()


def test_pattern_with_one_entity_can_wait(cell):
    """With `only_entity` it is known which slot it is."""
    actor = OfEach()
    actor.only_entity = CAMERA

    (slot,) = BoundActor(actor, cell).trigger_slots()

    assert (slot.entity, slot.aspect) == ("camera", "image")


@pytest.mark.carrier("drawn")
def test_data_on_two_shards_are_watched(two_shards):
    """A shard that granted its part first would break the order of the shards."""

    class Across(Actor):
        image = View(ONLINE, Entity("left/camera"), IMAGE)
        mask = Write(ONLINE, Entity("right/camera"), MASK)
        triggers = (image,)

        def update(self, lock):
            lock[self.mask] = lock[self.image]

    assert BoundActor(Across(), two_shards.cell).trigger_slots() == ()


@pytest.mark.parametrize("standing", ["0", "1"])
def test_switch_lets_an_actor_watch_instead(cell, online, monkeypatch, standing):
    """Both ways end in the same data; the shard counts which one it was."""
    monkeypatch.setenv("ENACT_STANDING", standing)
    actor, numbers = Segmenter(), itertools.count()

    def begun():
        number = next(numbers)
        put(online, number)
        assert actor.saw.get(timeout=PATIENCE_S) == number
        return counted(cell, "standing_locks_begun")

    with ActorThread(actor, cell):
        if standing == "1":
            until(begun)  # a change that comes before the request is parked begins none
        else:
            assert [begun() for _ in range(10)] == [0] * 10
