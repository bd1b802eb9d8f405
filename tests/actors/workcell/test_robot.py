"""The robot's two actors with a loop in a thread: obeys, publishes, refuses, stops in silence."""

import itertools
import math
import threading
import time

import numpy as np
import pytest
from lost_commits import lose_commit

from actors.workcell import robot
from actors.workcell.motion import CommandedArm
from actors.workcell.robot import Robot, RobotJoints
from actors.workcell.simulation.arm import ARM, HOME_RAD
from actors.workcell.vocabulary import EXECUTION, JOINTS, MODEL, PATH, ROBOT, SPEED, Path, Speed
from enact_dist import ActorThread, Lock, View, Write, local, testing

MS = 1_000_000
AWAY = np.array(HOME_RAD) + np.array([2.5, 0, 0, 0, 0, 0, 0])
numbers = itertools.count()


class WatchedArm(CommandedArm):
    """Tells of each command; fails when asked to."""

    def __init__(self):
        super().__init__()
        self.heard, self.sent, self.fails, self.closed = threading.Condition(), [], False, False

    def command(self, q_rad, dq_rad_s):
        if self.fails:
            raise ConnectionError("the controller does not answer")
        with self.heard:
            self.sent.append((q_rad, dq_rad_s))
            self.heard.notify_all()
        return q_rad, dq_rad_s

    def close(self):
        self.closed = True

    def until(self, condition):
        """Wait until a condition holds after a command."""
        with self.heard:
            assert self.heard.wait_for(condition, 60.0)

    @property
    def moves(self):
        return bool(np.abs(self.sent[-1][1]).max() > 0.0)


class Cell:
    """Robot and RobotJoints with an arm of their own in a cell in this process."""

    def __init__(self, cell):
        self.cell, self.online, self.arm = cell, cell.world("online"), WatchedArm()
        driver = f"test:arm?number={next(numbers)}"
        self.joints, self.robot = RobotJoints(driver), Robot(driver)
        self.online.init(ROBOT, MODEL, ARM)

    def put(self, aspect, value):
        request = Write(self.online, ROBOT, aspect)
        with Lock(request) as lock:
            lock[request] = value

    def get(self, aspect):
        request = View(self.online, ROBOT, aspect)
        return self.online.view(request)[request]

    def command(self, age_ms=0, valid_ms=60_000.0, limit_m_s=math.inf, scale=1.0):
        """Commit a speed."""
        captured_ns = time.time_ns() - age_ms * MS
        self.put(
            SPEED, Speed(scale, limit_m_s, math.inf, "free", valid_ms, captured_ns, captured_ns)
        )

    def path(self, *waypoints, number=1):
        rows = np.array(waypoints, float).reshape(-1, 7)
        self.put(PATH, Path(rows, number, 0, 1, 0, 0.0))

    def obeyed(self):
        """Let Robot take what is new; return what it says."""
        testing.run_once(self.robot, self.cell)
        return self.get(EXECUTION)


@pytest.fixture
def cell(monkeypatch):
    with local(worlds=["online"]) as opened:
        made = Cell(opened)
        monkeypatch.setattr(robot, "open_sensor", lambda _: made.arm)
        yield made


@pytest.fixture
def running(cell):
    """The cell while RobotJoints runs."""
    with ActorThread(cell.joints, cell.cell):
        cell.arm.until(lambda: cell.arm.sent)
        yield cell


def test_arm_moves_while_it_is_commanded_and_rests_when_commands_end(running):
    """A valid command moves it along its path; when the command has ended, it brakes by itself."""
    running.path(HOME_RAD, AWAY)
    running.command(valid_ms=400.0)

    said = running.obeyed()
    running.arm.until(lambda: running.arm.moves)
    running.arm.until(lambda: not running.arm.moves)

    assert said.refused == 0
    assert said.captured_ns == running.get(SPEED).captured_ns
    assert 0.0 < running.arm.sent[-1][0][0] < AWAY[0]


def test_scale_nought_stops(running):
    """A newer command that allows nothing brakes, though the old one is still valid."""
    running.path(HOME_RAD, AWAY)
    running.command()
    running.obeyed()
    running.arm.until(lambda: running.arm.moves)

    running.command(scale=0.0, limit_m_s=0.0)
    running.obeyed()

    running.arm.until(lambda: not running.arm.moves)


def test_command_with_old_stamps_is_refused(running):
    """The arm stays where it is; `execution` says refused, counts, and names the exposure."""
    running.path(HOME_RAD, AWAY)
    running.command(age_ms=300, valid_ms=250.0)

    said = running.obeyed()
    many = len(running.arm.sent) + 10
    running.arm.until(lambda: len(running.arm.sent) >= many)

    assert (said.state, said.refused) == ("refused", 1)
    assert said.reason.endswith("ms old, 250 are allowed")
    assert not running.arm.moves
    np.testing.assert_array_equal(running.arm.sent[-1][0], HOME_RAD)


def test_refusal_is_said_though_the_first_commit_fails(running):
    """The arm has refused the command once; a path that comes later is no refusal."""
    assert robot._is_open(running.joints.driver).wait(60.0)
    running.command(age_ms=300, valid_ms=250.0)
    lose_commit(running.robot, running.cell)

    said = running.obeyed()
    running.path(HOME_RAD, AWAY)
    later = running.obeyed()

    assert (said.state, said.refused, later.refused) == ("refused", 1, 1)
    assert later.state != "refused"


def test_joints_are_published_at_their_rate(running):
    """Thirty samples of the loop, their own stamps, over and over."""
    with running.online.watch(ROBOT, JOINTS) as watch:
        changes = iter(watch)
        versions = [next(changes).version for _ in range(3)]
    joints = running.get(JOINTS)

    assert versions == sorted(set(versions))
    assert joints.q.shape == (30, 7)
    assert (np.diff(joints.stamp_ns) > 0).all()
    np.testing.assert_array_equal(joints.q[-1], HOME_RAD)


def test_restarted_robot_goes_on_where_it_was(cell):
    """The arm is braked and closed with its process; the next one begins at the last joints."""
    with ActorThread(cell.joints, cell.cell):
        cell.arm.until(lambda: cell.arm.sent)
        cell.path(HOME_RAD, AWAY)
        cell.command()
        cell.obeyed()
        cell.arm.until(lambda: cell.arm.moves)
    closed, rested = cell.arm.closed, not cell.arm.moves
    last = cell.get(JOINTS).q[-1]

    with ActorThread(RobotJoints(cell.joints.driver), cell.cell):
        before = len(cell.arm.sent)
        cell.arm.until(lambda: len(cell.arm.sent) > before)

    assert (closed, rested) == (True, True)
    np.testing.assert_array_equal(cell.arm.sent[before][0], last)


def test_clock_that_is_set_forgets_the_command(running, monkeypatch):
    """Set back by less than a command is valid it would let the arm move on images of before."""
    running.path(HOME_RAD, AWAY)
    running.command()
    running.obeyed()
    running.arm.until(lambda: running.arm.moves)

    monkeypatch.setattr(robot.time, "time_ns", lambda true_ns=time.time_ns: true_ns() - 100 * MS)
    running.arm.until(lambda: not running.arm.moves)

    arm = robot._arms[running.joints.driver]
    assert arm.motion.doing.reason == "the clock of the robot's host was set"


def test_robot_without_its_arm_says_what_is_missing(cell, monkeypatch):
    """In a process of its own it finds no arm; the error says how to configure it."""
    monkeypatch.setattr(robot, "OPENING_S", 0.01)
    cell.command()

    with pytest.raises(RuntimeError, match='process = "robot"'):
        testing.run_once(cell.robot, cell.cell)


def test_arm_that_fails_is_reported(running):
    """What the driver raises ends the loop, and both actors say so."""
    assert robot._is_open(running.joints.driver).wait(60.0)
    running.arm.fails = True
    robot._arms[running.joints.driver]._thread.join(60.0)
    running.command()

    with pytest.raises(RuntimeError, match="the controller does not answer"):
        testing.run_once(running.robot, running.cell)
