"""Wrong versions that become null, with what was made of them."""

import threading
from dataclasses import dataclass

import pytest

from enact_dist import Aspect, Entity, Lock, Read, View, Write
from enact_dist.errors import LockHeldError, LockTimeoutError, MisuseError, NullDatumError
from enact_dist.world import invalidation


@dataclass(frozen=True)
class Pose:
    """What a shard knows by its fingerprint only."""

    x_m: float


CAMERA, CUP = Entity("camera"), Entity("cup")
SCALE, POSE, GRASP, OTHER = (
    Aspect("scale", float),
    Aspect("pose", Pose),
    Aspect("grasp", Pose),
    Aspect("other", int),
)


@pytest.fixture
def world(cell):
    return cell.world("online")


def put(world, entity, aspect, value, *reads):
    """Commit one datum; return its version."""
    write, reads = Write(world, entity, aspect), [Read(world, *read) for read in reads]
    with Lock(write, *reads) as lock:
        for read in reads:
            lock[read]
        lock[write] = value
    return world.history(entity, aspect)[-1]


@pytest.fixture
def chain(world):
    """A scale, a pose that was made of it, a grasp that was made of the pose, and another datum."""
    scale = put(world, CAMERA, SCALE, 2.0)
    put(world, CUP, POSE, Pose(1.0), (CAMERA, SCALE))
    put(world, CUP, GRASP, Pose(3.0), (CUP, POSE))
    put(world, CUP, OTHER, 5)
    return scale


@pytest.mark.carrier("local", "drawn")
def test_what_was_made_of_a_wrong_version_is_null_until_it_is_made_anew(cell, world, chain):
    """Of the slots that show something else nothing changes; a new commit ends it."""
    replaced = cell.invalidate("bad-scale", chain)

    assert sorted(str(one.slot) for one in replaced) == [
        "online:camera/scale",
        "online:cup/grasp",
        "online:cup/pose",
    ]
    other = Read(world, CUP, OTHER)
    pose, grasp = Read(world, CUP, POSE), Read(world, CUP, GRASP)
    with Lock(other, pose, grasp) as lock:
        assert lock[other] == 5
        with pytest.raises(NullDatumError, match="enact why online cup/pose says by whom"):
            lock[pose]
    put(world, CUP, POSE, Pose(2.0))
    with Lock(pose, grasp) as lock:
        assert lock[pose] == Pose(2.0)
        assert lock.is_null(grasp)
    assert cell.invalidate("bad-scale", chain) == ()


@pytest.mark.carrier("local", "drawn")
def test_all_of_it_stays_readable_under_the_label(cell, world, chain):
    """An incident is looked into afterwards."""
    cell.invalidate("incident/7", chain)

    kept = {version.slot: version for version in cell.pinned()["incident/7"]}
    pose = next(one for slot, one in kept.items() if slot.aspect == "pose")
    assert len(kept) == 3
    assert world.history(CUP, POSE)[0].datum() == Pose(1.0)
    assert pose.version == 1


@pytest.mark.carrier("local", "drawn")
def test_one_commit_replaces_all(cell, world, chain):
    """No reader sees a grasp whose pose is gone."""
    cell.invalidate("bad", chain)

    stamps = {
        world.history(entity, aspect)[-1].position.stamp_ns
        for entity, aspect in ((CAMERA, SCALE), (CUP, POSE), (CUP, GRASP))
    }
    assert len(stamps) == 1


@pytest.mark.carrier("local", "drawn")
def test_what_was_replaced_before_stays_replaced(cell, world, chain):
    """A newer pose, of a good scale, is not touched; the grasp made of the old one is."""
    put(world, CAMERA, SCALE, 1.0)
    put(world, CUP, POSE, Pose(0.5), (CAMERA, SCALE))

    replaced = cell.invalidate("bad", chain)

    assert [one.slot.aspect for one in replaced] == ["grasp"]
    snapshot = world.view(pose := View(world, CUP, POSE))
    assert snapshot[pose] == Pose(0.5)


@pytest.mark.carrier("local", "drawn")
def test_what_was_made_of_the_null_is_not_touched(cell, world, chain):
    """An actor that finds nothing and says so has said nothing wrong."""
    cell.invalidate("bad", chain)
    read, write = Read(world, CUP, POSE), Write(world, CUP, OTHER)
    with Lock(read, write) as lock:
        lock[write] = -1 if lock.is_null(read) else 1

    assert cell.invalidate("bad", chain) == ()
    with Lock(write) as lock:
        assert lock[write] == -1


def test_an_effect_that_comes_meanwhile_is_found(cell, world, chain, monkeypatch):
    """Who had viewed the pose before commits what it made of it while the pose becomes null."""
    late, look = Write(world, CUP, OTHER), invalidation._replace
    pose = View(world, CUP, POSE)

    def replace(session, made, *, wait_s):
        if not rounds:
            with Lock(late, pose) as lock:
                lock[late] = int(lock[pose].x_m)
        rounds.append(len(made))
        return look(session, made, wait_s=wait_s)

    rounds = []
    monkeypatch.setattr(invalidation, "_replace", replace)
    replaced = cell.invalidate("bad", chain)

    assert [one.slot.aspect for one in replaced][-1] == "other"
    assert rounds == [3, 4, 4]


def test_slots_that_stay_locked_are_named(cell, world, chain):
    """Nothing is replaced then."""
    with Lock(Write(world, CUP, GRASP)), pytest.raises(LockHeldError):
        cell.invalidate("bad", chain)


def test_a_holder_is_waited_for(cell, world, chain):
    """And named, if it takes too long."""
    held, done = threading.Event(), threading.Event()

    def hold():
        with Lock(Write(world, CUP, GRASP)):
            held.set()
            done.wait()

    thread = threading.Thread(target=hold)
    thread.start()
    held.wait()
    try:
        with pytest.raises(LockTimeoutError, match="grasp"):
            cell.invalidate("bad", chain, wait_s=0.1)
    finally:
        done.set()
        thread.join()
    assert world.history(CUP, POSE)[-1].version == 1


def test_what_is_no_version_is_refused(cell, world):
    """With what to name in its place."""
    with pytest.raises(MisuseError, match="one that `history` or `impact` returns"):
        cell.invalidate("bad", CUP)
