"""One actor class for several entities: each instance works on one of them."""

import threading

import pytest
from polling import until

from enact_dist import (
    Actor,
    ActorThread,
    Aspect,
    Entities,
    Entity,
    View,
    ViewEach,
    World,
    Write,
    local,
    testing,
)
from enact_dist.actor.binding import BoundActor
from enact_dist.actor.check import check_actors
from enact_dist.actor.uses import ActorDeclaration
from enact_dist.errors import MisuseError

CAMERAS = Entities("camera/*")
IMAGE, MASK = Aspect("image", int), Aspect("mask", int)
online = World("online")


class Camera(Actor):
    """A source: one class for all cameras."""

    image = Write(online, CAMERAS, IMAGE)
    every_s = 0.01

    def __init__(self, both: threading.Barrier | None = None) -> None:
        self.both = both
        self.entities: list[Entity | None] = []

    def update(self, lock) -> None:
        self.entities.append(lock.entity)
        lock[self.image] = lock.get(self.image, 0) + 1
        if self.both is not None:
            self.both.wait(60.0)  # passes only where two hold their locks at once


class Worker(Actor):
    """Triggered by the image of its entity; writes beside it."""

    image = View(online, CAMERAS, IMAGE)
    mask = Write(online, CAMERAS, MASK)
    triggers = (image,)

    def update(self, lock) -> None:
        lock[self.mask] = -lock[self.image]


class Counter(Actor):
    """Triggered by any camera, writes for its own one."""

    images = ViewEach(online, CAMERAS, IMAGE)
    mask = Write(online, CAMERAS, MASK)
    triggers = (images,)

    def update(self, lock) -> None:
        lock[self.mask] = len(lock[self.images])


def only(actor: Actor, name: str) -> Actor:
    """Return an actor that works on one entity."""
    actor.only_entity = Entity(name)
    return actor


def shown(cell, aspect: Aspect[int]) -> dict[str, int]:
    """Return the data of an aspect by the name of their camera."""
    each = ViewEach(cell.world("online"), CAMERAS, aspect)
    return {entity.name: datum for entity, datum in cell.world("online").view(each)[each].items()}


def test_sources_of_one_class_write_each_its_own_entity():
    """What a camera writes bears the name of its entity, and `lock.entity` says it."""
    with testing.worlds("online") as cell:
        cameras = [only(Camera(), f"camera/{number}") for number in range(8)]
        for camera in (*cameras, cameras[3]):
            testing.run_once(camera, cell)

        wanted = {f"camera/{number}": 1 for number in range(8)}
        assert shown(cell, IMAGE) == {**wanted, "camera/3": 2}
    assert cameras[3].entities == [Entity("camera/3")] * 2


def test_sources_of_one_class_run_at_once():
    """Their locks are of different data, so none waits for another."""
    both = threading.Barrier(2)
    with local(worlds=["online"]) as cell:
        one, two = (only(Camera(both), f"camera/{number}") for number in range(2))
        with ActorThread(one, cell, name="camera-0"), ActorThread(two, cell, name="camera-1"):
            until(lambda: len(shown(cell, IMAGE)) == 2)
            both.abort()  # one of them may wait for the other, which has ended


def test_triggered_actor_sees_its_own_entity_alone():
    """Changes of the other cameras run it not once."""
    with testing.worlds("online") as cell:
        for number in range(3):
            cell.world("online").init(Entity(f"camera/{number}"), IMAGE, number)
        worker = only(Worker(), "camera/2")

        assert testing.run_once(worker, cell) == 1
        testing.run_once(only(Camera(), "camera/1"), cell)
        assert testing.run_once(worker, cell) == 0
        testing.run_once(only(Camera(), "camera/2"), cell)
        assert testing.run_once(worker, cell) == 1
        assert shown(cell, MASK) == {"camera/2": -3}


def test_running_actor_is_woken_by_its_own_entity_alone():
    """Its watch asks for that entity only."""
    with local(worlds=["online"]) as cell:
        worker = only(Worker(), "camera/1")
        (watched,) = BoundActor(worker, cell).watched()
        assert str(watched.entities) == "camera/1"
        with ActorThread(worker, cell) as thread:
            for number in range(3):
                testing.run_once(only(Camera(), f"camera/{number}"), cell)
            until(lambda: thread.statistics().updates == 1)
            assert shown(cell, MASK) == {"camera/1": -1}


def test_each_that_triggers_runs_for_the_own_entity():
    """The others are seen, and change nothing of their own."""
    with testing.worlds("online") as cell:
        for number in range(3):
            cell.world("online").init(Entity(f"camera/{number}"), IMAGE, number)

        assert testing.run_once(only(Counter(), "camera/1"), cell) == 1
        assert shown(cell, MASK) == {"camera/1": 3}


class Plain(Actor):
    """Names one entity itself."""

    image = Write(online, Entity("camera/0"), IMAGE)

    def update(self, lock) -> None:
        lock[self.image] = 1


@pytest.mark.parametrize(
    ("actor", "entity", "message"),
    [
        (Camera(), None, r"Camera\.image .*no triggers and no only_entity.*--entity.*WriteEach"),
        (Camera(), Entity("tray/0"), r"Camera\.image .*which tray/0 does not match"),
        (Worker(), Entity("tray/0"), r"Worker\.image .*which tray/0 does not match"),
        (Plain(), Entity("camera/0"), r"Plain has no request whose pattern could stand for"),
        (Camera(), "camera/0", r"only_entity is 'camera/0'; it must be an Entity"),
    ],
)
def test_entity_that_does_not_fit_is_refused_before_it_runs(actor, entity, message):
    """The text names the request, and where the entity is said."""
    actor.only_entity = entity
    with testing.worlds("online") as cell, pytest.raises(MisuseError, match=message):
        testing.run_once(actor, cell)


def test_check_tells_cameras_apart_by_their_entity():
    """Two of one entity write one slot; what nobody says may be said by an `__init__`."""
    zero, one = Entity("camera/0"), Entity("camera/1")

    def found(*entities):
        actors = [
            ActorDeclaration(f"camera-{number}", Camera, None, entity)
            for number, entity in enumerate(entities)
        ]
        return [(finding.kind, finding.actors) for finding in check_actors(actors)]

    assert found(zero, one) == []
    assert found(zero, one, zero) == [("two writers", ("camera-0", "camera-2"))]
    assert found(zero, Entity("tray/1")) == [("no such entity", ("camera-1",))]
    assert found(zero, None) == [("entity unsaid", ("camera-1",))]
    assert found(zero, "camera/1") == [("no such entity", ("camera-1",)), TWO_WRITERS]


TWO_WRITERS = ("two writers", ("camera-0", "camera-1"))


class Flagging(Camera):
    """Writes a slot of its own entity, and one that is the same for all."""

    flag = Write(online, Entity("system"), MASK)


def test_check_finds_two_writers_of_one_slot_though_an_entity_is_unsaid():
    """What stands for the entity is open; what does not is known."""
    actors = [
        ActorDeclaration("camera-0", Flagging),
        ActorDeclaration("camera-1", Flagging, None, Entity("camera/1")),
    ]

    found = [(finding.kind, finding.actors) for finding in check_actors(actors)]

    assert found == [TWO_WRITERS, ("entity unsaid", ("camera-0",))]


def test_actors_of_one_class_are_told_apart_by_their_names():
    """Where nobody names them."""
    with testing.worlds("online") as cell:
        names = [
            ActorThread(actor, cell).statistics().name
            for actor in (Worker(), only(Worker(), "camera/1"), only(Camera(), "camera/1"))
        ]
    assert names == ["Worker", "Worker-camera-1", "Camera-camera-1"]
