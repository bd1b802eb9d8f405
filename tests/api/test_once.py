"""An actor that moves something acts on each version at most once, whatever ends when."""

import threading

import pytest
from once_robot import (
    JOINTS,
    LIMIT,
    ONLINE,
    OUTCOME,
    PATIENCE_S,
    PLAN,
    ROBOT,
    Gate,
    Robot,
    read,
    until,
    write,
)

from enact_dist import ActorThread, Outcome, testing
from enact_dist.access.lock import Lock
from enact_dist.actor import once
from enact_dist.actor.actor import Actor
from enact_dist.actor.triggers import BackOff
from enact_dist.errors import MisuseError
from enact_dist.terms import (
    Aspect,
    Durability,
    Entities,
    Entity,
    View,
    Write,
    WriteEach,
)


@pytest.mark.carrier("local", "socket", "zenoh")
def test_version_is_taken_before_the_motion_and_closed_after_it(cell, online):
    """A motion that outlasts `hold_s` moves once; no lock is held meanwhile."""
    held, at_work = [], []

    def moves(lock):
        held.append([info for info in cell.locks() if info.state not in ("kept", "waits")])
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


def test_outcome_that_waits_to_be_written_is_tried_at_once_when_the_actor_stops(
    cell, online, caplog, monkeypatch
):
    """A stop request cuts the pause after a refusal short: what moved is told before the end."""
    monkeypatch.setattr(once, "BackOff", lambda spread: BackOff(PATIENCE_S, PATIENCE_S, spread))
    begun, ends = threading.Event(), threading.Event()

    def moves(_):
        begun.set()
        assert ends.wait(PATIENCE_S)

    robot = Robot(moves)
    robot.wait_s = 0.2
    write(online, PLAN, [1])
    with ActorThread(robot, cell) as thread:
        assert begun.wait(PATIENCE_S)
        with Lock(Write(online, ROBOT, OUTCOME)):
            ends.set()
            while not any("outcome done not written yet" in line for line in caplog.messages):
                pass
        thread.stop()
        thread.join(PATIENCE_S / 2)

    assert read(online, OUTCOME).state == "done"


def test_actor_that_is_stopped_waits_for_its_outcome_no_longer_than_it_has_left(
    cell, online, monkeypatch
):
    """Another program may hold the outcome for as long as the actor would wait otherwise."""
    asked, begun, ends = [], threading.Event(), threading.Event()

    class Asked(Lock):
        def __init__(self, *requests, wait_s):
            asked.append(wait_s)
            super().__init__(*requests, wait_s=wait_s)

    def moves(_):
        begun.set()
        assert ends.wait(PATIENCE_S)

    monkeypatch.setattr(once, "Lock", Asked)
    robot = Robot(moves)
    robot.wait_s = 60.0
    write(online, PLAN, [1])
    with ActorThread(robot, cell) as thread:
        assert begun.wait(PATIENCE_S)
        thread.stop()
        ends.set()
        thread.join(PATIENCE_S)

    assert read(online, OUTCOME).state == "done"
    assert asked[-1] <= once.OUTCOME_S
