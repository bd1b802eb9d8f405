"""An actor that moves something acts on each version at most once, whatever ends when."""

import json
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from enact_dist import testing
from enact_dist.access.lock import Lock
from enact_dist.actor.actor import Actor
from enact_dist.actor.outcome import Outcome
from enact_dist.actor.running.process import ActorThread
from enact_dist.actor.running.runner import run_actor
from enact_dist.errors import LeaseLostError, LockTimeoutError, MisuseError
from enact_dist.terms import (
    Aspect,
    Durability,
    Entities,
    Entity,
    View,
    ViewEach,
    World,
    Write,
    WriteEach,
)

ROBOT = Entity("robot")
PLAN, OUTCOME = Aspect("plan", list), Aspect("plan_outcome", Outcome)
JOINTS, LIMIT = Aspect("joints", list), Aspect("limit", float)
ONLINE = World("online")
PATIENCE_S = 60.0


class Robot(Actor):
    """Moves along a plan until it is over or somebody wants something else."""

    plan = View(ONLINE, ROBOT, PLAN)
    limits = ViewEach(ONLINE, Entities("limit/*"), LIMIT)
    outcome = Write(ONLINE, ROBOT, OUTCOME)
    joints = Write(ONLINE, ROBOT, JOINTS)
    triggers = (plan,)
    once = True
    hold_s = 0.2

    def __init__(self, moves=None):
        self.moved = []
        self.moves = moves or (lambda _lock: None)

    def update(self, lock):
        self.moved.append(lock[self.plan])
        self.moves(lock)
        lock[self.joints] = lock[self.plan]


def write(world, aspect, datum):
    request = Write(world, ROBOT, aspect)
    with Lock(request) as lock:
        if datum is None:
            del lock[request]
        else:
            lock[request] = datum


def read(world, aspect):
    view = View(world, ROBOT, aspect)
    return world.view(view).get(view)


class Gate:
    """Lets a test follow a motion: `begun` when it moves, `seen` what `newer` says in the end."""

    def __init__(self):
        self.begun, self.reasons = threading.Semaphore(0), []

    def __call__(self, lock):
        self.begun.release()
        assert lock.newer.wait(PATIENCE_S)
        self.reasons.append(lock.newer.reason)


def outcomes(world, count):
    """Follow the outcomes of the robot until so many have come, or time is up."""
    found = []
    with world.watch(ROBOT, OUTCOME) as watch:
        while len(found) < count:
            change = watch.next(timeout_s=PATIENCE_S)
            assert change is not None, found
            if not change.null:
                found.append(read(world, OUTCOME))
    return found


def until(world, state):
    """Wait until the newest outcome is in a state; return it."""
    with world.watch(ROBOT, OUTCOME) as watch:
        while True:
            change = watch.next(timeout_s=PATIENCE_S)
            assert change is not None, read(world, OUTCOME)
            found = read(world, OUTCOME)
            if found is not None and found.state == state:
                return found


@pytest.mark.carrier("local", "socket", "zenoh")
def test_version_is_taken_before_the_motion_and_closed_after_it(cell, online):
    """A motion that outlasts `hold_s` moves once; no lock is held meanwhile."""
    held, at_work = [], []

    def moves(lock):
        held.append([info for info in cell.locks() if info.granted])
        at_work.append(read(online, OUTCOME).state)
        threading.Event().wait(0.5)  # longer than hold_s, which a lock would not survive

    robot = Robot(moves)
    write(online, PLAN, [1])
    with ActorThread(robot, cell) as thread:
        done = until(online, "done")
        write(online, PLAN, [2])
        until(online, "taken")
        until(online, "done")
    with ActorThread(Robot(moves), cell):  # a new start acts on nothing again
        write(online, PLAN, [3])
        last = until(online, "taken")
        until(online, "done")

    assert robot.moved == [[1], [2]]
    assert held == [[], [], []]
    assert at_work == ["taken"] * 3
    assert (done.version, last.version) == (1, 3)
    assert read(online, JOINTS) == [3]
    assert thread.statistics().failures == thread.statistics().refused == 0


def test_newer_plan_preempts_the_motion(cell, online):
    """The event is set while the update runs; what it saw is its outcome; the newer plan runs."""
    gate = Gate()
    robot = Robot(gate)
    with ActorThread(robot, cell):
        write(online, PLAN, [1])
        assert gate.begun.acquire(timeout=PATIENCE_S)
        write(online, PLAN, [2])
        assert gate.begun.acquire(timeout=PATIENCE_S)
        write(online, PLAN, None)
        until(online, "cancelled")
        write(online, PLAN, [3])
        assert gate.begun.acquire(timeout=PATIENCE_S)
    states = [version.datum().state for version in online.history(ROBOT, OUTCOME)]

    assert robot.moved == [[1], [2], [3]]
    assert gate.reasons == ["preempted", "cancelled", "stopped"]
    assert states == ["taken", "preempted", "taken", "cancelled", "taken", "stopped"]


def test_motion_that_ends_by_itself_is_done_though_a_newer_plan_has_come(cell, online):
    """It did not look, so it was not preempted."""
    gone_on, begun = threading.Event(), threading.Event()

    def moves(_lock):
        begun.set()
        assert gone_on.wait(PATIENCE_S)

    with ActorThread(Robot(moves), cell):
        write(online, PLAN, [1])
        assert begun.wait(PATIENCE_S)
        write(online, PLAN, [2])
        gone_on.set()
        states = {until(online, "done").version, until(online, "done").version}
    history = [version.datum() for version in online.history(ROBOT, OUTCOME)]

    assert states <= {1, 2}
    assert ("done", 1) in {(one.state, one.version) for one in history}


def test_newer_may_be_awaited_by_any_thread(cell, online):
    """A controller's own loop looks at it, not the update's thread alone."""
    robot = Robot()
    seen = []

    def moves(lock):
        loop = threading.Thread(target=lambda: seen.append(lock.newer.wait(PATIENCE_S)))
        loop.start()
        write(online, PLAN, [2])
        loop.join(PATIENCE_S)
        robot.moves = lambda _lock: None

    robot.moves = moves
    with ActorThread(robot, cell):
        write(online, PLAN, [1])
        while until(online, "done").version != 2:
            pass

    assert seen == [True]


def test_update_that_fails_is_not_repeated(cell, online):
    """Its outcome says why and where; nothing that it wrote is published."""

    def moves(lock):
        lock[Robot.joints] = [9]
        raise OSError("controller is away")

    robot = Robot(moves)
    write(online, PLAN, [1])
    with ActorThread(robot, cell) as thread:
        failed = until(online, "failed")
    with ActorThread(Robot(moves), cell):
        pass

    assert robot.moved == [[1]]
    assert failed.text.startswith("OSError at ")
    assert "test_once.py:" in failed.text
    assert failed.text.endswith("controller is away")
    assert read(online, JOINTS) is None
    assert thread.statistics().failures == 1


def test_motion_whose_writes_are_refused_for_good_has_failed_and_the_actor_goes_on(
    cell, online, monkeypatch
):
    """What is more than one lock may write does not end the actor, nor leave the version taken."""
    robot = Robot(lambda _: monkeypatch.setattr("enact_dist.access.writes.BODY_BYTES_MAX", 10_000))
    with ActorThread(robot, cell) as thread:
        write(online, PLAN, ["x" * 20_000])
        failed = until(online, "failed")
        write(online, PLAN, [2])
        until(online, "done")

    assert "MisuseError of what it wrote: the writes of one lock have" in failed.text
    assert [plan[-1:] for plan in robot.moved[1:]] == [[2]]
    assert thread.statistics().failures == 1


def test_update_sees_what_it_declared_and_writes_at_the_end(cell, online):
    """All as of the taking, though no lock is held; the token is that of the taking's grant."""
    cases = {}

    def moves(lock):
        write(online, PLAN, [2, 2])
        cases["plan"] = lock[Robot.plan], lock.version(Robot.plan), lock.is_null(Robot.joints)
        cases["each"] = {one.name: limit for one, limit in lock[Robot.limits].items()}
        cases["token"] = lock.token
        cases["entity"] = lock.entity
        lock.put(Robot.joints, [1.0], stamp_ns=77)
        cases["own"] = lock[Robot.joints], read(online, JOINTS)
        cases["valid"] = lock.valid()
        lock.check()
        for name, act in (
            ("new", lambda: lock.new(Robot.joints, (3,))),
            ("expect", lambda: lock.expect(Robot.plan)),
            ("outcome", lambda: lock.put(Robot.outcome, Outcome("done", 1, 1))),
        ):
            with pytest.raises(MisuseError) as raised:
                act()
            cases[name] = str(raised.value)

    online.init(Entity("limit/1"), LIMIT, 0.5)
    write(online, PLAN, [1])

    assert testing.run_once(Robot(moves), cell) == 1
    assert cases["plan"] == ([1], 1, True)
    assert cases["each"] == {"limit/1": 0.5}
    ((_, epoch, number),) = cases["token"]
    assert epoch > 0
    assert number > 0
    assert cases["entity"] == ROBOT
    assert cases["own"] == ([1.0], None)
    assert cases["valid"] is True
    assert "holds no lock" in cases["new"]
    assert "cannot expect" in cases["expect"]
    assert "the framework writes" in cases["outcome"]
    assert read(online, JOINTS) == [1]
    assert read(online, OUTCOME).state == "done"


def taken_by(online, session, version=1):
    """Leave a version as taken, as an actor does that is killed before its outcome."""
    (found,) = (slot for slot in online.list_slots(ROBOT.name) if slot.aspect == "plan")
    left = Outcome("taken", version, found.position.stamp_ns, actor="Robot, process 7 on cell-1",
                   session=session, run="before")  # fmt: skip
    write(online, OUTCOME, left)
    return left


def test_version_whose_taker_is_gone_is_interrupted_and_never_repeated(cell, online, caplog):
    """Shown by its outcome, in the log and in the report; a newer plan runs."""
    write(online, PLAN, [1])
    taken_by(online, "0123456789abcdef")
    robot = Robot()

    with ActorThread(robot, cell) as thread:
        found = until(online, "interrupted")
        write(online, PLAN, [2])
        until(online, "done")

    assert robot.moved == [[2]]
    assert found.version == 1
    assert "process 7 on cell-1" in found.text
    assert thread.statistics().interrupted == 1
    assert "version 1 for " in thread.statistics().last_interrupted
    assert "how far it came is unknown" in caplog.text


def test_version_of_a_run_before_in_this_process_is_closed(cell, online, caplog):
    """Its session lives on with the next run, which would wait for an outcome for ever."""

    class Killed(BaseException):
        pass

    def moves(_):
        raise Killed

    write(online, PLAN, [1])
    with pytest.raises(Killed):
        run_actor(Robot(moves), cell, stop=threading.Event())
    assert read(online, OUTCOME).state == "taken"
    robot = Robot()
    with ActorThread(robot, cell):
        until(online, "interrupted")
        write(online, PLAN, [2])
        until(online, "done")

    assert robot.moved == [[2]]
    assert "interrupted: version 1" in caplog.text


def test_version_that_was_deleted_meanwhile_is_closed_too(cell, online):
    """No plan is there to trigger; the start of the actor looks for what was left."""
    write(online, PLAN, [1])
    taken_by(online, "0123456789abcdef")
    write(online, PLAN, None)

    with ActorThread(Robot(), cell):
        assert until(online, "interrupted").version == 1


@pytest.mark.slow
def test_version_of_a_session_that_still_seems_to_live_is_closed_when_it_is_over(two_shards):
    """No trigger is needed for it: the actor looks again until the other's lease has ended."""
    online = two_shards.cell.world("online")
    other = two_shards.connect(actor="before")
    write(online, PLAN, [1])
    left = taken_by(online, other._client.core.session)
    write(online, PLAN, None)

    with ActorThread(Robot(), two_shards.cell) as thread:
        while thread.statistics().state != "running":
            pass
        assert read(online, OUTCOME) == left
        other.close()
        assert until(online, "interrupted").version == 1


def test_two_processes_of_one_actor_do_not_act_both(cell, online, caplog):
    """While the taker's session lives, the other one waits; it does not call it interrupted."""
    write(online, PLAN, [1])
    left = taken_by(online, cell._client.core.session)
    robot = Robot()

    with pytest.raises(LockTimeoutError, match="version 1 is taken by Robot, process 7 on cell-1"):
        testing.run_once(robot, cell)
    assert robot.moved == []
    assert read(online, OUTCOME) == left

    write(online, OUTCOME, Outcome("done", 1, left.committed_ns))
    assert testing.run_once(robot, cell) == 0
    assert "waits: version 1" in caplog.text


def test_taker_that_was_taken_for_gone_learns_it_and_writes_no_outcome(cell, online, caplog):
    """One that was cut off and comes back: what others have written stays."""
    other = Outcome("interrupted", 1, 1)

    def moves(lock):
        write(online, OUTCOME, other)
        with pytest.raises(LeaseLostError):
            lock.check()
        assert not lock.valid()

    write(online, PLAN, [1])
    testing.run_once(Robot(moves), cell)

    assert read(online, OUTCOME) == other
    assert read(online, JOINTS) is None
    assert "the outcome done of version 1 is not written" in caplog.text


PROGRAM = """
import os, sys, threading
from pathlib import Path
sys.path.insert(0, sys.argv[3])
from enact_dist import Actor, Aspect, Entity, View, World, Write, connect, run_actor
from enact_dist.actor.outcome import Outcome

class Robot(Actor):
    plan = View(World("online"), Entity("robot"), Aspect("plan", list))
    outcome = Write(World("online"), Entity("robot"), Aspect("plan_outcome", Outcome))
    triggers = (plan,)
    once = True
    def update(self, lock):
        with Path(sys.argv[2]).open("a") as moved:
            moved.write(f"{lock[self.plan]}\\n")
        print("moves", flush=True)
        if lock[self.plan] == [1]:
            threading.Event().wait()

with connect(sys.argv[1]) as cell:
    run_actor(Robot(), cell, stop=threading.Event())
"""


@pytest.mark.slow
@pytest.mark.carrier("socket", "zenoh")
def test_actor_that_is_killed_in_its_motion_never_repeats_it(two_shards, tmp_path):
    """`kill -9` between taking and outcome; started again, it closes the version and goes on."""
    online = two_shards.cell.world("online")
    moved = tmp_path / "moved"
    command = [sys.executable, "-c", PROGRAM, two_shards._endpoints["left"], str(moved),
               str(Path(__file__).parents[2])]  # fmt: skip
    write(online, PLAN, [1])
    actors = []
    try:
        for _ in range(2):
            actors.append(subprocess.Popen(command, stdout=subprocess.PIPE, text=True))
            if len(actors) == 1:
                assert actors[0].stdout.readline() == "moves\n"
                os.kill(actors[0].pid, signal.SIGKILL)
                actors[0].wait(PATIENCE_S)
        interrupted = until(online, "interrupted")
        write(online, PLAN, [2])
        assert actors[1].stdout.readline() == "moves\n"
        until(online, "done")
    finally:
        for actor in actors:
            actor.kill()
            actor.wait(PATIENCE_S)
            actor.stdout.close()

    assert interrupted.version == 1
    assert [json.loads(line) for line in moved.read_text().splitlines()] == [[1], [2]]


def declared(**attributes):
    return lambda: type("Wrong", (Robot,), attributes)


@pytest.mark.parametrize(
    ("wrong", "reason"),
    [
        (declared(once=1), "must be True or False"),
        (declared(triggers=()), "declare one View as its only trigger"),
        (declared(outcome=None), 'declare one: outcome = Write(online, Entity(name=\'robot\'), Aspect("plan_outcome", Outcome))'),
        (declared(outcome=Write(ONLINE, Entities("robot*"), OUTCOME)), "each entity has its own outcome"),
        (declared(outcome=Write(ONLINE, ROBOT, Aspect("plan_outcome", Outcome, Durability.VOLATILE))), "volatile"),
        (declared(parts=WriteEach(ONLINE, Entities("part/*"), JOINTS)), "holds no lock"),
    ],
)  # fmt: skip
def test_declaration_that_cannot_act_once_is_refused(wrong, reason):
    """By the class, with what to write."""
    with pytest.raises(MisuseError) as raised:
        wrong()

    assert reason in str(raised.value)


def test_newer_is_of_an_update_that_acts_once(online):
    """The error says what to declare."""
    with Lock(View(online, ROBOT, PLAN)) as lock, pytest.raises(MisuseError, match="once = True"):
        lock.newer  # noqa: B018


class Mover(Actor):
    """Moves in an update that may be repeated: what `once` is there for."""

    plan = View(ONLINE, ROBOT, PLAN)
    joints = Write(ONLINE, ROBOT, JOINTS)
    triggers = (plan,)

    def __init__(self, cell):
        self._cell, self.moved = cell, 0

    def update(self, lock):
        self.moved += 1
        if self.moved < 3:
            for info in self._cell.locks():
                self._cell.break_lock(info.number, shard=info.shard, reason="test")
        lock[self.joints] = lock[self.plan]


def test_update_that_lost_its_lock_and_runs_again_is_told_of_once(cell, online, caplog):
    """By name, with the remedy; the next repetition is not told again."""
    mover = Mover(cell)
    write(online, PLAN, [1])
    done = threading.Event()
    with online.watch(ROBOT, JOINTS) as watch, ActorThread(mover, cell, name="arm"):
        assert watch.next(timeout_s=PATIENCE_S) is not None
        done.set()

    assert mover.moved == 3
    told = [line for line in caplog.messages if "update runs again" in line]
    assert len(told) == 1
    assert told[0].startswith("arm for robot: Mover.update runs again, because it lost its lock")
    assert "once = True (enact_dist/docs/actuators.md)" in told[0]


def test_actor_that_is_stopped_while_it_waits_for_its_lock_just_ends(cell, online):
    """Nothing was taken, so nothing is left to free."""
    write(online, PLAN, [1])
    outcome = Write(online, ROBOT, OUTCOME)
    with Lock(outcome):
        with ActorThread(Robot(Gate()), cell):
            while all(lock.granted for lock in cell.locks()):
                pass
        assert all(lock.granted for lock in cell.locks())

    assert read(online, OUTCOME) is None
