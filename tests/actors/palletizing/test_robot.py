"""Robot and gripper as actors: a loop in a thread, nets of a world context, and what fails."""

import itertools
import threading
import time
from contextlib import ExitStack, contextmanager
from types import SimpleNamespace

import numpy as np
import pytest
from lost_commits import lose_commit
from polling import until
from slots import put

from actors.palletizing import gripper as gripper_module
from actors.palletizing import robot
from actors.palletizing.control.controller import ArmMeasured, ControllerError, GripperMeasured
from actors.palletizing.control.execution import Grip
from actors.palletizing.gripper import Gripper
from actors.palletizing.handling.nets import Execution
from actors.palletizing.robot import Robot, RobotJoints, unexecuted
from actors.palletizing.vocabulary import (
    COMMAND,
    CONTROL,
    EXECUTION,
    GRIPPER,
    NET,
    NET_OUTCOME,
    ROBOT,
    STATE,
    SYSTEM,
    Attached,
    GripCommand,
)
from actors.workcell.vocabulary import JOINTS
from enact_dist import ActorThread, Lock, Outcome, View, Write, local, testing

from .sound_nets import axes, net, primitive, way
from .spring_arm import ARM, HOME_RAD, SpringArm

FAILED = way("failed", "force > 90")
BOUND_S = 30.0
numbers = itertools.count()


class SpringController:
    """Controllers of a kinematic arm and gripper, faster than real ones, that can fail."""

    cycle_s, model, posture_rad = 0.001, ARM, HOME_RAD

    def __init__(self):
        self.arm, self.q, self.grip = SpringArm(lag_s=0.02), HOME_RAD, None
        self.fails, self.starts, self.grips, self.cycles = "", 0, [], 0
        self.error, self.brakes = ControllerError, 0
        self.changed = threading.Condition()

    def start(self):
        self.starts += 1

    def measured(self):
        with self.changed:
            if self.fails:
                raise self.error(self.fails)
            self.cycles += 1
            self.arm.obey(SimpleNamespace(q=self.q, grip=self.grip))
            self.grip = None
            self.changed.notify_all()
            now = self.arm.measured()
            return ArmMeasured(now.stamp_ns, now.q, now.dq, now.tcp, now.wrench)

    def command(self, q):
        self.q = q

    def brake(self):
        self.brakes += 1

    def close(self):
        self.starts = -1

    def gripped(self):
        now = self.arm
        return GripperMeasured(time.time_ns(), now.width_m, now.width_rate_m_s, 0.0)

    def grip_width(self, width_m, force_limit_n):
        self.grip = Grip("width", width_m)
        self.grips.append(("width", width_m, force_limit_n))

    def grip_force(self, force_n):
        self.grip = Grip("force", force_n)
        self.grips.append(("force", force_n))

    def until(self, condition):
        """Wait until a condition holds after a cycle."""
        with self.changed:
            assert self.changed.wait_for(condition, BOUND_S)


class Trial:
    """Robot, RobotJoints and Gripper on a spring in a cell in this process."""

    def __init__(self, cell, **options):
        self.cell, self.online, self.device = cell, cell.world("online"), SpringController()
        self.address, self.options = f"test:arm?number={next(numbers)}", options
        self.attached = 0

    @contextmanager
    def running(self, *, gripper=True):
        with ExitStack() as threads:
            for actor in self.actors()[: 3 if gripper else 2]:
                threads.enter_context(ActorThread(actor, self.cell))
            yield self

    def actors(self):
        return (
            RobotJoints(self.address, every_s=0.01, **self.options),
            Robot(self.address),
            Gripper("test:gripper", every_s=0.01),
        )

    def attach(self, going, frames=None):
        self.attached += 1
        net_of = Attached(self.attached, 1, "grasp", going, frames or {})
        put(self.online, SYSTEM, NET, net_of)

    def get(self, entity, aspect):
        request = View(self.online, entity, aspect)
        return self.online.view(request).get(request)

    def until(self, entity, aspect, condition):
        """Wait until a datum satisfies a condition, and return it."""

        def asked():
            datum = self.get(entity, aspect)
            return datum if datum is not None and condition(datum) else None

        return until(asked, limit_s=BOUND_S, missed=lambda: f"{aspect} {self.get(entity, aspect)}")

    def ended(self, number=None):
        """Wait until a net is over; return its execution."""
        number = number or self.attached
        return self.until(
            ROBOT, EXECUTION, lambda done: done.net_version == number and bool(done.result)
        )


@pytest.fixture
def trial(monkeypatch):
    with local(worlds=["online"]) as cell:
        made = Trial(cell)
        for module in (robot, gripper_module):
            monkeypatch.setattr(module, "open_controller", lambda _: made.device)
        yield made


def going(y_m=0.0, *, seconds=3.0, **changes):
    """Return a net that lifts the tool beside its start and succeeds there."""
    x, _, z = SpringArm().tcp[:3, 3]
    target = axes(**{name: ("position", at) for name, at in zip("xyz", (x, y_m, z), strict=True)})
    arrived = way("done", "error < 0.003")
    return net(
        {
            "trial": primitive(
                arrived, FAILED, axes=target, speed_m_s=0.4, limit_s=seconds, **changes
            )
        }
    )


def endless(**changes):
    """Return a net that moves slowly for a minute."""
    drift = axes(y=("velocity", 0.002))
    return net(
        {
            "drift": primitive(
                way("done", "elapsed_s > 60"), FAILED, axes=drift, limit_s=99, **changes
            )
        }
    )


def test_net_is_executed_and_published(trial):
    """Exits, result, joints, figures and the gripper's commands become data; the arm got there."""
    close = primitive(
        way("away", "elapsed_s > 0.3", "width < 0.07"), FAILED, tool="force", tool_value=45.0
    )
    x, _, z = SpringArm().tcp[:3, 3]
    target = {name: ("position", at) for name, at in zip("xyz", (x, 0.1, z), strict=True)}
    away = primitive(
        way("done", "error < 0.003"), FAILED, axes=axes(**target), tool="width", tool_value=0.1
    )
    with trial.running():
        trial.attach(net({"close": close, "away": away}))
        done = trial.ended()
        trial.until(GRIPPER, STATE, lambda state: abs(state.width_m - 0.1) < 1e-3)
        joints = trial.until(ROBOT, JOINTS, lambda _: True)
        control = trial.until(ROBOT, CONTROL, lambda found: found.cycles > 0)
        outcome = trial.until(ROBOT, NET_OUTCOME, lambda found: found.state != "taken")

    assert (done.result, done.net_version) == ("done", 1)
    assert [(step.primitive, step.to) for step in done.trace] == [
        ("close", "away"),
        ("away", "done"),
    ]
    assert trial.device.grips == [("force", 45.0), ("width", 0.1, 40.0)]
    assert trial.get(GRIPPER, COMMAND).number == trial.get(GRIPPER, STATE).number == 2
    assert trial.device.arm.tcp[1, 3] == pytest.approx(0.1, abs=4e-3)
    assert joints.q.shape == (30, 7)
    assert (np.diff(joints.stamp_ns) > 0).all()
    assert 0.0 < control.median_ms <= control.p99_ms
    assert outcome.state == "done"
    assert trial.device.starts == -1, "it is closed"


def test_exits_wait_for_the_gripper(trial):
    """The time of a primitive with a grip begins when the gripper has taken its command."""
    close = net(
        {"close": primitive(way("done", "elapsed_s > 0.05"), FAILED, tool="force", tool_value=45.0)}
    )
    with trial.running(gripper=False), ActorThread(SilentGripper(), trial.cell) as silent:
        trial.attach(close)
        trial.until(GRIPPER, COMMAND, lambda command: command.number == 1)
        many = trial.device.cycles + 100
        trial.device.until(lambda: trial.device.cycles > many)
        waits = trial.get(ROBOT, EXECUTION).result
        silent.stop()
        silent.join()
        with ActorThread(Gripper("test:gripper", every_s=0.01), trial.cell):
            done = trial.ended()

    assert waits == ""
    assert done.result == "done"


class SilentGripper(Gripper):
    """Publishes its state and takes no command."""

    def __init__(self):
        super().__init__("test:gripper", every_s=0.01)
        self._number = 0

    def _obey(self, gripper, command):
        pass


@pytest.mark.parametrize(
    ("other", "result"),
    [(None, "braked:gripper_silent"), (SilentGripper, "braked:gripper_refuses")],
)
def test_net_ends_without_its_gripper(trial, other, result):
    """A silent one, and one that does not take its command, end the net by name."""
    trial.options = {"lease_s": 0.2}
    with trial.running(gripper=False), ExitStack() as stack:
        if other is not None:
            stack.enter_context(ActorThread(other(), trial.cell))
        trial.attach(endless(tool="width", tool_value=0.1))
        done = trial.ended()

    assert done.result == result
    assert done.trace[-1].because


def test_loop_goes_on_while_a_lock_is_held(trial):
    """A held lock does not stop the loop: a net that runs shorter than the lease goes to its end."""
    trial.options = {"lease_s": 60.0}
    blocked = Write(trial.online, ROBOT, EXECUTION)
    with trial.running():
        trial.attach(going(0.1))
        trial.until(ROBOT, EXECUTION, lambda now: now.net_version == 1)
        with Lock(blocked):
            trial.device.until(lambda: abs(trial.device.arm.tcp[1, 3] - 0.1) < 3e-3)
        done = trial.ended()

    assert done.result == "done"


def test_world_that_is_away_longer_than_the_lease_ends_the_net(trial):
    """The arm rests by itself without a connection; the reason is published later."""
    trial.options = {"lease_s": 0.3}
    blocked = Write(trial.online, ROBOT, EXECUTION)
    with trial.running():
        trial.attach(endless())
        trial.until(ROBOT, EXECUTION, lambda now: now.net_version == 1)
        with Lock(blocked):
            loop = robot._loops[trial.address]
            assert loop.wait(BOUND_S)
            assert not np.any(trial.device.q - loop._from_rad)
        done = trial.ended()

    assert done.result == "braked:world_unreachable"
    assert "no shard has answered" in done.trace[-1].because


def test_newer_net_ends_the_one_that_runs(trial):
    """The first is braked, and then the second is executed from where the arm is."""
    with trial.running():
        trial.attach(endless())
        trial.until(ROBOT, EXECUTION, lambda now: now.net_version == 1)
        trial.attach(going(0.05))
        done = trial.ended()
        every = [one.datum() for one in trial.online.history(ROBOT, EXECUTION)]

    assert done.result == "done"
    assert "braked:preempted" in [one.result for one in every if one.net_version == 1]


def test_stopped_robot_brakes(trial):
    """A process that ends brakes its net, and says so before it is gone."""
    joints, executes, gripper = trial.actors()
    with ActorThread(joints, trial.cell), ActorThread(gripper, trial.cell):
        with ActorThread(executes, trial.cell):
            trial.attach(endless())
            trial.until(ROBOT, EXECUTION, lambda now: now.net_version == 1)
        assert trial.ended().result == "braked:stopped"


@pytest.mark.parametrize(
    ("error", "result", "because"),
    [
        (ControllerError, "braked:controller", "the controller does not answer"),
        (ValueError, "braked:loop", "ValueError: the controller does not answer"),
    ],
)
def test_controller_that_fails_ends_the_net_and_is_tried_again(trial, error, result, because):
    """The result names it, the reason is its own; the next net runs when it is back."""
    trial.device.error = error
    with trial.running():
        trial.attach(endless())
        trial.until(ROBOT, EXECUTION, lambda now: now.net_version == 1)
        trial.device.fails = "the controller does not answer"
        done = trial.ended()
        trial.attach(going(0.05))
        trial.device.fails = ""
        again = trial.ended()

    assert done.result == result
    assert done.trace[-1].because == because
    assert again.result == "done"
    assert trial.device.brakes >= 1  # at once: not only when it notices that nothing comes any more


def test_measurements_that_stand_still_end_the_net(trial):
    """A frozen sensor is found by the host's clock."""
    with trial.running():
        trial.attach(endless())
        trial.until(ROBOT, EXECUTION, lambda now: now.net_version == 1)
        trial.device.arm.frozen = True
        done = trial.ended()

    assert done.result == "sensor:frozen"


def test_net_with_an_unknown_frame_is_refused(trial):
    """It ends before anything moves, in one line."""
    lost = net({"trial": primitive(way("done", "elapsed_s > 0.1"), FAILED, frame="package/9")})
    with trial.running():
        trial.attach(lost)
        done = trial.ended()

    assert done.result.startswith("refused:")
    assert "package/9" in done.result
    np.testing.assert_array_equal(trial.device.q, HOME_RAD)


def test_net_that_an_earlier_process_had_begun_does_not_go_on(trial):
    """After a restart its execution ends as interrupted, where it was, and the arm stays."""
    with trial.running():
        trial.attach(endless())
        begun = trial.until(ROBOT, EXECUTION, lambda now: now.net_version == 1)
    put(trial.online, ROBOT, EXECUTION, begun)  # as a killed process leaves it

    testing.run_once(trial.actors()[0], trial.cell)
    done = trial.get(ROBOT, EXECUTION)
    assert (done.result, done.net_version) == ("interrupted:drift", 1)
    assert done.trace[-1].because == "the robot was started again"


def test_execution_is_published_until_it_stands(trial, monkeypatch):
    """The commit fails: the loop has no newer state, and this one is written all the same."""
    joints = trial.actors()[0]
    joints.start()
    for method in ("start", "stop"):
        monkeypatch.setattr(joints, method, lambda: None)
    robot._loops[trial.address].execution = execution(1, "")
    lose_commit(joints, trial.cell)
    testing.run_once(joints, trial.cell)
    assert trial.get(ROBOT, EXECUTION).net_version == 1


def test_net_that_was_taken_and_not_begun_ends_too(trial):
    """A process that was killed between taking a net and its first cycle leaves no riddle."""
    trial.attach(endless())
    trial.online.init(ROBOT, NET_OUTCOME, Outcome("interrupted", 1, 1))
    testing.run_once(trial.actors()[0], trial.cell)
    assert trial.get(ROBOT, EXECUTION).result == "interrupted:drift"


@pytest.mark.parametrize("earlier", [False, True])
@pytest.mark.parametrize("state", ["failed", "stopped", "cancelled", "preempted"])
def test_net_that_the_robot_did_not_execute_ends_by_name(trial, state, earlier):
    """`Robot` failed before the loop got its net, in this process or in one before."""
    joints, executes, gripper = trial.actors()
    with ActorThread(joints, trial.cell), ActorThread(gripper, trial.cell):
        if earlier:  # the loop has executed a net of its own before
            with ActorThread(executes, trial.cell):
                trial.attach(going(0.05))
                trial.ended()
        trial.attach(endless())
        outcome = Outcome(state, trial.attached, 1, text="no arm is open")
        put(trial.online, ROBOT, NET_OUTCOME, outcome)
        done = trial.ended()

    assert done.result == f"braked:{state}"
    assert done.trace[-1].because == "no arm is open"


def test_what_interrupted_one_net_does_not_end_the_next(trial):
    """The outcome of the net before still stands there when a new one is attached."""
    trial.attach(endless())
    trial.online.init(ROBOT, NET_OUTCOME, Outcome("interrupted", 1, 1))
    trial.attach(going(0.05))

    testing.run_once(trial.actors()[0], trial.cell)

    assert trial.get(ROBOT, EXECUTION) is None


def test_restarted_gripper_follows_the_newest_command(trial):
    """Its command is a level: it is followed again, and the state names it."""
    with trial.running():
        trial.attach(going(tool="width", tool_value=0.1))
        trial.ended()
    trial.device.grips.clear()
    testing.run_once(trial.actors()[2], trial.cell)
    assert trial.device.grips == [("width", 0.1, 40.0)]
    assert trial.get(GRIPPER, STATE).number == 1


def test_gripper_that_refuses_goes_on_and_one_that_was_lost_is_started_again(trial, capsys):
    """A refused command is reported once; one that did not get through is given again."""
    device, gripper = trial.device, trial.actors()[2]
    width, calls = device.grip_width, []

    def grip_width(width_m, force_limit_n):
        calls.append(width_m)
        raise ControllerError("asked for 300 mm between the fingers")

    device.grip_width = grip_width
    put(trial.online, GRIPPER, COMMAND, GripCommand(1, "width", 0.3))
    for _ in range(2):
        testing.run_once(gripper, trial.cell)
    assert calls == [0.3]
    assert trial.get(GRIPPER, STATE).number == 0
    assert capsys.readouterr().out == "command 1 is refused: asked for 300 mm between the fingers\n"

    put(trial.online, GRIPPER, COMMAND, GripCommand(2, "width", 0.1))
    gripped = device.gripped

    def away():
        raise ControllerError("no answer")

    device.gripped = away
    with pytest.raises(ControllerError, match="no answer"):
        testing.run_once(gripper, trial.cell)
    device.gripped, device.grip_width = gripped, width
    testing.run_once(gripper, trial.cell)
    assert device.grips == [("width", 0.1, 40.0)]
    assert trial.get(GRIPPER, STATE).number == 2


def test_robot_without_its_arm_says_what_is_missing(trial, monkeypatch):
    """In a process of its own it finds no arm; the error says how to configure it."""
    monkeypatch.setattr(robot, "OPENING_S", 0.01)
    trial.attach(endless())
    with pytest.raises(RuntimeError, match='process = "robot"'):
        testing.run_once(Robot(trial.address), trial.cell)


def execution(number, result):
    return Execution("trial", number, "drift", 7, (), result, np.zeros(6), 0.07, np.eye(4))


@pytest.mark.parametrize(
    ("before", "taken", "begun_here", "result"),
    [
        (None, Outcome("taken", 4, 1), False, None),
        (None, Outcome("failed", 4, 1), True, "braked:failed"),
        (execution(1, "done"), Outcome("done", 4, 1), True, "interrupted:drift"),
        (execution(2, "done"), Outcome("done", 4, 1), True, None),
        (execution(1, ""), None, False, "interrupted:drift"),
        (execution(1, ""), None, True, None),
    ],
)
def test_a_net_that_no_process_executes_is_over(before, taken, begun_here, result):
    """Only one that was taken ends without a step, by the name of what became of it."""
    net_of = Attached(2, 1, "push", endless(), {})
    over = unexecuted(net_of, taken, before, version=4, begun_here=begun_here)
    assert (over and over.result) == result
