"""Which capture stamp the data bear that an actor writes."""

import threading

import numpy as np
import pytest
from slots import put

from enact_dist import ActorThread, testing
from enact_dist.access.lock import Lock
from enact_dist.access.together import Together
from enact_dist.actor.actor import Actor
from enact_dist.errors import MisuseError
from enact_dist.terms import (
    Aspect,
    Entities,
    Entity,
    Read,
    View,
    ViewEach,
    World,
    Write,
    WriteEach,
)

IMAGE, POSE = Aspect("image", np.ndarray), Aspect("pose", int)
LEFT, RIGHT = Entity("camera/left"), Entity("camera/right")
TABLE = Entity("table")
ONLINE = World("online")


def stamp(world, entity, aspect):
    view = View(world, entity, aspect)
    with Lock(view) as lock:
        return lock.stamp_ns(view)


class Detector(Actor):
    """Sets, fills in place or sets by a pattern what it finds in an image."""

    image = View(ONLINE, Entities("camera/*"), IMAGE)
    pose = Write(ONLINE, Entities("camera/*"), POSE)
    mask = Write(ONLINE, Entities("camera/*"), Aspect("mask", np.ndarray))
    parts = WriteEach(ONLINE, Entities("part/*"), POSE)
    triggers = (image,)
    told = None

    def update(self, lock):
        lock.put(self.pose, 1, stamp_ns=self.told)
        lock.new(self.mask, (2,), np.uint8)[:] = 1
        lock[self.parts][Entity("part/1")] = 1


@pytest.fixture
def cell():
    with testing.worlds("online") as opened:
        yield opened


@pytest.fixture
def online(cell):
    return cell.world("online")


def test_what_an_image_triggers_bears_its_stamp(cell, online):
    """By `put`, in place and by a pattern; the detector hands on what it was not told of."""
    put(online, LEFT, IMAGE, np.zeros(2), 4_711)

    testing.run_once(Detector(), cell)

    assert stamp(online, LEFT, POSE) == 4_711
    assert stamp(online, LEFT, Aspect("mask", np.ndarray)) == 4_711
    assert stamp(online, Entity("part/1"), POSE) == 4_711


@pytest.mark.parametrize("told", [0, 99])
def test_update_may_say_another_stamp(cell, online, told):
    """0 is none; what is written beside it bears the trigger's."""
    put(online, LEFT, IMAGE, np.zeros(2), 4_711)
    detector = Detector()
    detector.told = told

    testing.run_once(detector, cell)

    assert stamp(online, LEFT, POSE) == told
    assert stamp(online, LEFT, Aspect("mask", np.ndarray)) == 4_711


def test_data_without_a_stamp_trigger_data_without_one(cell, online):
    """No stamp is made up."""
    put(online, LEFT, IMAGE, np.zeros(2), 0)

    testing.run_once(Detector(), cell)

    assert stamp(online, LEFT, POSE) == 0


def test_newest_stamp_among_the_triggers_counts(cell, online):
    """A task that was given long ago does not make the plan old."""

    class Planner(Actor):
        scene = View(ONLINE, TABLE, POSE)
        task = Read(ONLINE, TABLE, Aspect("task", int))
        beside = View(ONLINE, RIGHT, POSE)
        plan = Write(ONLINE, TABLE, Aspect("plan", int))
        triggers = (scene, task)

        def update(self, lock):
            lock[self.plan] = 1

    put(online, TABLE, POSE, 1, 500)
    put(online, TABLE, Aspect("task", int), 1, 20)
    put(online, RIGHT, POSE, 1, 900)

    testing.run_once(Planner(), cell)

    assert stamp(online, TABLE, Aspect("plan", int)) == 500


def test_of_a_pattern_the_entity_that_triggered_counts(cell, online):
    """`ViewEach` shows them all; the run is for the one that changed last."""

    class Fusion(Actor):
        poses = ViewEach(ONLINE, Entities("camera/*"), POSE)
        fused = Write(ONLINE, TABLE, Aspect("fused", int))
        triggers = (poses,)

        def update(self, lock):
            lock[self.fused] = len(lock[self.poses])

    fusion = Fusion()
    put(online, LEFT, POSE, 1, 700)
    testing.run_once(fusion, cell)
    put(online, RIGHT, POSE, 1, 300)
    testing.run_once(fusion, cell)

    assert stamp(online, TABLE, Aspect("fused", int)) == 300


def test_what_a_set_triggers_bears_the_stamp_of_the_set(cell, online):
    """The sets behind it are found without a word of its author."""
    set_ = Together([View(ONLINE, LEFT, POSE), View(ONLINE, RIGHT, POSE)], by="stamp")

    class Fusion(Actor):
        poses = set_
        fused = Write(ONLINE, TABLE, Aspect("fused", int))
        triggers = (poses,)

        def update(self, lock):
            lock[self.fused] = sum(lock[self.poses])

    put(online, LEFT, POSE, 1, 300)
    put(online, RIGHT, POSE, 1, 300)
    put(online, LEFT, POSE, 1, 400)

    testing.run_once(Fusion(), cell)

    assert stamp(online, TABLE, Aspect("fused", int)) == 300


class Camera(Actor):
    """A source; keeps its ticks."""

    image = Write(ONLINE, LEFT, POSE)
    every_s = 0.1

    def __init__(self):
        self.ticks = []

    def update(self, lock):
        self.ticks.append(lock.tick_ns)
        lock[self.image] = 1


def test_source_stamps_with_its_tick_on_a_manual_clock():
    """Ticks are multiples of the period by the clock of the test."""
    clock = testing.ManualClock()
    camera = Camera()
    with testing.worlds("online", clock=clock) as cell:
        clock.advance(0.25)
        testing.run_once(camera, cell)

        assert camera.ticks == [1_000_200_000_000]
        assert stamp(cell.world("online"), LEFT, POSE) == 1_000_200_000_000


def test_two_running_sources_have_the_same_ticks():
    """Whenever each was ready: their data of one tick make a set."""
    from enact_dist import local

    three = threading.Semaphore(0)

    class Counted(Camera):
        def update(self, lock):
            super().update(lock)
            three.release()

    class Other(Counted):
        image = Write(ONLINE, RIGHT, POSE)

    left, right = Counted(), Other()
    with (
        local(worlds=["online"]) as cell,
        ActorThread(left, cell),
        ActorThread(right, cell),
    ):
        while len(set(left.ticks) & set(right.ticks)) < 3:
            assert three.acquire(timeout=60.0)
        assert stamp(cell.world("online"), LEFT, POSE) in left.ticks

    assert all(tick % 100_000_000 == 0 for tick in left.ticks + right.ticks)


def test_only_a_source_has_ticks(cell, online):
    """The error says what is missing."""
    put(online, LEFT, IMAGE, np.zeros(2), 0)

    class Curious(Detector):
        def update(self, lock):
            lock.tick_ns  # noqa: B018

    with pytest.raises(MisuseError, match="not made for a tick of every_s"):
        testing.run_once(Curious(), cell)
