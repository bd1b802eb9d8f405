"""A type gains a field with a default while the cell runs: who reads, who writes, what is refused."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import pytest
from slots import datum_of as seen
from slots import put

from enact_dist import (
    Aspect,
    Entities,
    Entity,
    Lock,
    Read,
    ReadEach,
    View,
    ViewEach,
    Write,
    WriteEach,
)
from enact_dist.errors import DatumTypeError

LEFT, RIGHT, THIRD = Entity("left/arm"), Entity("right/arm"), Entity("left/leg")


def older():
    """Return the types as the older program has them."""

    @dataclass(frozen=True)
    class Joint:
        angle_rad: float

    @dataclass(frozen=True)
    class Pose:
        x_mm: float
        joints: list[Joint]

    Pose.__annotations__["joints"] = list[Joint]
    return Pose, Joint


def newer():
    """Return them with two fields more: one nested, one before a field that both have."""

    @dataclass(frozen=True)
    class Joint:
        angle_rad: float
        torque_nm: float = 0.5

    @dataclass(frozen=True, kw_only=True)
    class Pose:
        frame: str = "base"
        x_mm: float
        joints: list[Joint]
        cloud: np.ndarray = field(default_factory=lambda: np.zeros(3))

    Pose.__annotations__["joints"] = list[Joint]
    return Pose, Joint


OLD, OLD_JOINT = older()
NEW, NEW_JOINT = newer()
OLD_POSE, NEW_POSE = Aspect("pose", OLD), Aspect("pose", NEW)


def old(x_mm):
    return OLD(x_mm, [OLD_JOINT(x_mm / 10)])


def new(x_mm):
    joints = [NEW_JOINT(x_mm / 10, 2.0)]
    return NEW(frame="tool", x_mm=x_mm, joints=joints, cloud=np.ones(2))


@pytest.fixture
def programs(two_shards):
    """The world context "online" as the older and as the newer program have it."""
    with two_shards.connect() as one, two_shards.connect() as other:
        yield one.world("online"), other.world("online")


@pytest.mark.carrier("socket", "zenoh")
def test_older_data_are_read_with_the_defaults(programs):
    """By a view, a lock, a pattern and a watch; what is missing in a nested one, too."""
    was, now = programs
    for entity in (LEFT, RIGHT):
        put(was, entity, OLD_POSE, old(10.0))

    found = seen(now, LEFT, NEW_POSE)
    assert (found.frame, found.x_mm, found.joints) == ("base", 10.0, [NEW_JOINT(1.0, 0.5)])
    assert found.cloud.tolist() == [0.0, 0.0, 0.0]
    assert not found.cloud.flags.writeable
    each, every = ViewEach(now, Entities("**"), NEW_POSE), ReadEach(now, Entities("**"), NEW_POSE)
    assert {e: pose.frame for e, pose in now.view(each)[each].items()} == dict.fromkeys(
        (LEFT, RIGHT), "base"
    )
    with Lock(every) as lock:
        assert [pose.joints[0].torque_nm for pose in lock[every].values()] == [0.5, 0.5]
    with now.watch("**", NEW_POSE) as watch:
        assert {watch.next(30.0).entity, watch.next(30.0).entity} == {LEFT, RIGHT}


@pytest.mark.carrier("socket", "zenoh")
def test_reading_with_the_newer_type_stops_no_older_writer(programs):
    """Readers are the first to be brought up to date: a type counts once it is written."""
    was, now = programs
    put(was, LEFT, OLD_POSE, old(10.0))
    seen(now, LEFT, NEW_POSE)
    with Lock(Read(now, LEFT, NEW_POSE)) as lock:
        assert lock[Read(now, LEFT, NEW_POSE)].frame == "base"
    each = ViewEach(now, Entities("**"), NEW_POSE)
    assert len(now.view(each)[each]) == 1

    for entity in (LEFT, THIRD, RIGHT):  # on a shard that only the reader has asked, too
        put(was, entity, OLD_POSE, old(20.0))
    assert [pose.x_mm for pose in now.view(each)[each].values()] == [20.0] * 3


@pytest.mark.carrier("socket", "zenoh")
def test_older_program_reads_newer_data_without_the_new_field_and_writes_no_more(programs):
    """Its write would drop the field: refused by name with both types, and nothing is written."""
    was, now = programs
    for entity in (LEFT, RIGHT):
        put(was, entity, OLD_POSE, old(10.0))
    put(now, LEFT, NEW_POSE, new(30.0))

    assert seen(was, LEFT, OLD_POSE) == old(30.0)
    with Lock(Read(was, LEFT, OLD_POSE)) as lock:
        assert lock[Read(was, LEFT, OLD_POSE)] == old(30.0)
    for request in (Write(was, LEFT, OLD_POSE), WriteEach(was, Entities("**"), OLD_POSE)):
        with pytest.raises(DatumTypeError) as refused:
            Lock(request).__enter__()
        assert "Pose{x_mm:float,joints:list[Joint{angle_rad:float}]}" in str(refused.value)
        assert "Pose{frame:str=,x_mm:float," in str(refused.value)
        assert "read" in str(refused.value)
    assert seen(now, LEFT, NEW_POSE).frame == "tool"
    put(was, RIGHT, OLD_POSE, old(11.0))  # a shard where nobody has written the newer type
    put(now, RIGHT, NEW_POSE, new(31.0))
    with pytest.raises(DatumTypeError, match=r"Pose\{frame:str=,x_mm:float"):
        put(was, RIGHT, OLD_POSE, old(12.0))


@pytest.mark.carrier("socket", "zenoh")
def test_lock_of_the_older_type_that_is_held_may_be_finished(programs):
    """What it looked at was of its own type: nothing is lost, and the newer write comes after."""
    was, now = programs
    put(was, LEFT, OLD_POSE, old(10.0))
    put(was, THIRD, OLD_POSE, old(10.0))
    write = Write(was, LEFT, OLD_POSE)
    with Lock(write) as lock:
        other = Write(now, THIRD, NEW_POSE)
        lock[write] = old(lock[write].x_mm + 1.0)
        now.session.client.register(aspects=[now.session._entry(other.aspect)])

    assert seen(now, LEFT, NEW_POSE).x_mm == 11.0
    with pytest.raises(DatumTypeError):
        put(was, LEFT, OLD_POSE, old(12.0))


@pytest.mark.carrier("socket", "zenoh")
@pytest.mark.parametrize("other", ["frames", "default", "type", "name", "order"])
def test_type_that_differs_otherwise_is_refused_by_name_as_ever(programs, other):
    """A field taken away, added without a default, of another type, under another name."""
    was, now = programs
    put(was, LEFT, OLD_POSE, old(10.0))
    hints = {
        "frames": {"joints": list[OLD_JOINT]},
        "default": {"x_mm": float, "joints": list[OLD_JOINT], "frame": str},
        "type": {"x_mm": int, "joints": list[OLD_JOINT]},
        "name": {"y_mm": float, "joints": list[OLD_JOINT]},
        "order": {"joints": list[OLD_JOINT], "x_mm": float},
    }[other]
    kind = dataclass(frozen=True)(type("Pose", (), {"__annotations__": hints}))
    wrong = Aspect("pose", kind)

    for request in (View(now, LEFT, wrong), Read(now, LEFT, wrong)):
        with pytest.raises(DatumTypeError, match="'pose' is registered with datum type Pose"):
            now.view(request) if request.access.locks is False else Lock(request).__enter__()
    with pytest.raises(DatumTypeError, match="'pose' is registered with datum type Pose"):
        put(now, LEFT, wrong, None)
    put(was, LEFT, OLD_POSE, old(20.0))


def test_two_types_that_each_add_another_field_do_not_mix(programs):
    """The one that is written first counts; the other one cannot even be read."""
    was, now = programs
    hints = {"x_mm": float, "joints": list[OLD_JOINT], "weight_kg": float}
    body = {"__annotations__": hints, "weight_kg": 1.0}
    sibling = Aspect("pose", dataclass(frozen=True)(type("Pose", (), body)))
    put(was, LEFT, OLD_POSE, old(10.0))
    assert seen(was, LEFT, sibling).weight_kg == 1.0
    put(now, LEFT, NEW_POSE, new(20.0))

    was.session.greet()
    with pytest.raises(DatumTypeError, match=r"weight_kg.*enact shard forget pose"):
        put(was, LEFT, sibling, None)
    with pytest.raises(DatumTypeError, match="weight_kg"):
        seen(was, LEFT, sibling)


@pytest.mark.carrier("socket", "zenoh")
def test_past_forks_and_history_show_both_types(programs):
    """Older versions with the defaults, newer ones without the new field; by either program."""
    was, now = programs
    first = put(was, LEFT, OLD_POSE, old(10.0))
    put(now, LEFT, NEW_POSE, new(20.0))

    for world, aspect in ((was, OLD_POSE), (now, NEW_POSE)):
        assert [v.datum().x_mm for v in world.history(LEFT, aspect)] == [10.0, 20.0]
        assert seen(world.at(first), LEFT, aspect).x_mm == 10.0
    assert seen(now.at(first), LEFT, NEW_POSE).frame == "base"
    fork = now.fork("what_if", at=first)
    assert seen(fork, LEFT, NEW_POSE).joints == [NEW_JOINT(1.0, 0.5)]
    put(fork, LEFT, NEW_POSE, new(5.0))
    was.session.greet()
    with pytest.raises(DatumTypeError, match=r"Pose\{frame:str="):
        put(type(was)("what_if", was.session), LEFT, OLD_POSE, old(1.0))


def test_type_outlasts_a_restart_of_its_shards(two_stored):
    """The catalogue keeps the newest type and those before it, on the disk."""
    with two_stored.connect() as one, two_stored.connect() as other:
        was, now = one.world("online"), other.world("online")
        put(was, LEFT, OLD_POSE, old(10.0))
        put(now, LEFT, NEW_POSE, new(20.0))
        two_stored.stop("left")
        two_stored.start("left")
        with pytest.raises(DatumTypeError, match=r"Pose\{frame:str="):
            put(was, LEFT, OLD_POSE, old(30.0))
        assert seen(was, LEFT, OLD_POSE).x_mm == 20.0
        put(now, LEFT, NEW_POSE, new(40.0))
    with two_stored.connect() as third:
        third.world("online").session.greet()
        (entry,) = third.world("online").session.client.aspect_entries().values()
        assert entry.older == ("Pose{x_mm:float,joints:list[Joint{angle_rad:float}]}",)
        assert seen(third.world("online"), LEFT, OLD_POSE).x_mm == 40.0


def test_program_of_the_older_type_that_comes_later_reads(two_shards):
    """It has never been seen by the shard: the newest type alone says that it came before."""
    with two_shards.connect() as one:
        put(one.world("online"), LEFT, NEW_POSE, new(20.0))
    with two_shards.connect() as late:
        world = late.world("online")
        assert seen(world, LEFT, OLD_POSE) == old(20.0)
        with pytest.raises(DatumTypeError, match="older"):
            put(world, LEFT, OLD_POSE, old(30.0))


def test_default_that_cannot_be_made_is_an_error_of_the_type(programs):
    """A default of the newer class that raises is named; nothing else goes wrong."""

    def none_today():
        raise ValueError("no camera is open")

    was, now = programs
    put(was, LEFT, OLD_POSE, old(10.0))
    hints = {"x_mm": float, "joints": list[OLD_JOINT], "seen_by": str}
    body = {"__annotations__": hints, "seen_by": field(default_factory=none_today)}
    kind = dataclass(frozen=True)(type("Pose", (), body))

    with pytest.raises(DatumTypeError, match=r"Pose\.seen_by.*no camera is open"):
        seen(now, LEFT, Aspect("pose", kind))


def test_embedded_cell_has_one_type_at_a_time_too(tmp_path):
    """A program that was stopped and comes back with a longer type goes on with its folder."""
    from enact_dist import local

    with local(tmp_path / "cell", worlds=["online"]) as cell:
        put(cell.world("online"), LEFT, OLD_POSE, old(10.0))
    with local(tmp_path / "cell", worlds=["online"]) as cell:
        world = cell.world("online")
        write = Write(world, LEFT, NEW_POSE)
        with Lock(write) as lock:
            assert lock[write].frame == "base"
            lock[write] = new(20.0)
        assert seen(world, LEFT, NEW_POSE).frame == "tool"
