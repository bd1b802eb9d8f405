"""Wrong versions that become null, with what was made of them."""

import dataclasses
import itertools
import threading
from dataclasses import dataclass

import pytest

from enact_dist import Aspect, Entity, Lock, Outcome, Read, View, Write, connect
from enact_dist.errors import ForgottenError, LockTimeoutError, MisuseError, NullDatumError
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


def meanwhile(monkeypatch, act):
    """Let something happen once between the search for effects and the lock; count the rounds."""
    rounds, replaced = [], invalidation._replaced

    def acting(client, shown, *, wait_s):
        if not rounds:
            act()
        rounds.append(len(shown))
        return replaced(client, shown, wait_s=wait_s)

    monkeypatch.setattr(invalidation, "_replaced", acting)
    return rounds


def test_an_effect_that_comes_meanwhile_is_found(cell, world, chain, monkeypatch):
    """Who had viewed the pose before commits what it made of it while the pose becomes null."""

    def commit_late():
        late, pose = Write(world, CUP, OTHER), View(world, CUP, POSE)
        with Lock(late, pose) as lock:
            lock[late] = int(lock[pose].x_m)

    rounds = meanwhile(monkeypatch, commit_late)
    replaced = cell.invalidate("bad", chain)

    assert [one.slot.aspect for one in replaced][-1] == "other"
    assert rounds == [3, 1]


def test_a_newer_datum_that_comes_meanwhile_stays(cell, world, chain, monkeypatch):
    """The lock is granted after it."""
    meanwhile(monkeypatch, lambda: put(world, CUP, POSE, Pose(9.0)))

    replaced = cell.invalidate("bad", chain)

    assert sorted(one.slot.aspect for one in replaced) == ["grasp", "scale"]
    with Lock(pose := Read(world, CUP, POSE)) as lock:
        assert lock[pose] == Pose(9.0)


def test_an_outcome_stays_and_what_was_made_of_it_does_not(cell, world, chain):
    """Without it an actor with `once` would act a second time."""
    outcome = Aspect("pose_outcome", Outcome)
    put(world, CUP, outcome, Outcome("done", 1, 1), (CUP, POSE))
    put(world, CUP, OTHER, 1, (CUP, outcome))

    replaced = cell.invalidate("bad", chain)

    assert sorted(one.slot.aspect for one in replaced) == ["grasp", "other", "pose", "scale"]
    with Lock(read := Read(world, CUP, outcome)) as lock:
        assert lock[read].state == "done"


def test_a_datum_whose_type_begins_as_an_outcome_does_becomes_null(cell, world, chain):
    """A user's own class of that name is data like any other."""
    fields = ("state", str), ("version", int), ("committed_ns", int), ("score", float)
    own = dataclasses.make_dataclass("Outcome", fields, frozen=True)
    put(world, CUP, Aspect("own_outcome", own), own("done", 1, 1, 0.5), (CUP, POSE))

    replaced = cell.invalidate("bad", chain)

    assert "own_outcome" in {one.slot.aspect for one in replaced}


def test_an_outcome_of_a_later_release_stays(cell, world, chain):
    """It has further fields, each with a default; this release has to leave it alone."""
    later = dataclasses.make_dataclass(
        "Outcome", [("place", str, "")], bases=(Outcome,), frozen=True
    )
    put(world, CUP, Aspect("pose_outcome", later), later("done", 1, 1), (CUP, POSE))

    assert "pose_outcome" not in {one.slot.aspect for one in cell.invalidate("bad", chain)}


def test_a_long_chain_is_followed_to_its_end(cell, world):
    """Trees for people end after 200 steps."""
    long = [Aspect(f"step_{number}", int) for number in range(230)]
    wrong = put(world, CUP, long[0], 0)
    for before, after in itertools.pairwise(long):
        put(world, CUP, after, 1, (CUP, before))

    assert len(cell.invalidate("bad", wrong)) == len(long)


def test_more_slots_than_one_lock_takes_become_null_in_parts(cell, world, chain, monkeypatch):
    """Each part in one commit."""
    monkeypatch.setattr(invalidation, "ITEMS_MAX", 2)

    assert len(cell.invalidate("bad", chain)) == 3
    assert world.history(CUP, GRASP)[-1].null_reason == "deleted"


@pytest.mark.carrier("socket")
def test_an_observer_pins_nothing(cell, chain):
    """It is refused before anything is done."""
    with connect(cell.shards()[0].endpoint, observer=True) as other:
        with pytest.raises(MisuseError, match="only observes"):
            other.invalidate("bad", chain)
        assert other.pinned() == {}


def test_a_number_that_another_datum_has_now_is_refused(cell, chain):
    """Versions of a volatile slot start again with its shard; the stamp tells them apart."""
    earlier = dataclasses.replace(chain, position=chain.position._replace(stamp_ns=1))

    with pytest.raises(ForgottenError, match="another datum now"):
        cell.invalidate("bad", earlier)


def test_a_null_is_refused_with_what_to_name(cell, world, chain):
    """The second run of a command without a version finds the null that the first has written."""
    cell.invalidate("bad", chain)

    with pytest.raises(NullDatumError, match="that was wrong, as in camera/scale@1"):
        cell.invalidate("bad", world.history(CAMERA, SCALE)[-1])


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
