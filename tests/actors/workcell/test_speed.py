"""Speed control says run, slow, stop or fault with the reason, and on what it rests."""

import math
import time
from types import SimpleNamespace

import numpy as np
import pytest
from lost_commits import lose_commit
from slots import datum_of, put

from actors.geometry.arms.kinematics import capsules_at
from actors.geometry.capsules import bounds
from actors.geometry.separation import Separation
from actors.workcell.motion import NOMINAL_M_S, ROBOT_S
from actors.workcell.simulation.arm import ARM, HOME_RAD
from actors.workcell.speed import SpeedControl, Verdict, distance_to_sides_m, judged, troubles_of
from actors.workcell.vocabulary import (
    CAMERA_STATES,
    GRID,
    HULL,
    JOINTS,
    MODEL,
    PATH,
    ROBOT,
    SAFETY,
    SPEED,
    SYSTEM,
    WORKSPACE,
    CameraState,
    Grid,
    Hull,
    Joints,
    Path,
)
from enact_dist import Lock, Write, testing

MS = 1_000_000
SEPARATION = Separation()
SOUND = {
    "nearest_m": math.inf,
    "age_s": 0.06,
    "joints_age_s": 0.0,
    "states_age_s": 0.05,
    "nominal_m_s": 1.0,
    "separation": SEPARATION,
    "latest_s": 0.25,
}


@pytest.mark.parametrize(
    ("changes", "state", "text"),
    [
        ({}, "run", "no person is there"),
        ({"nearest_m": 2.0}, "run", "2.00 m to the robot"),
        ({"nearest_m": 0.8}, "slow", "0.80 m to the robot allow 0.45 m/s"),
        ({"nearest_m": 0.5}, "stop", "0.50 m to the robot, 0.55 m are the least"),
        ({"nearest_m": -0.1}, "stop", "-0.10 m"),
        ({"without_path": "no path was found"}, "stop", "no path was found"),
        ({"age_s": 0.26}, "stop", "260 ms old"),
        ({"age_s": -0.03}, "fault", "30 ms ahead of this host's clock"),
        ({"age_s": -0.01}, "run", ""),
        ({"joints_age_s": 0.3}, "fault", "300 ms before the exposure"),
        ({"states_age_s": 0.5}, "run", ""),
        ({"states_age_s": 0.6}, "fault", "in the 600 ms before the exposure"),
        ({"states_age_s": math.inf}, "fault", "CameraWatch has not written"),
        ({"misfits": 2}, "run", ""),
        ({"misfits": 3}, "fault", "the background no longer fits in 3 cameras"),
    ],
)
def test_verdict_follows_from_what_is_known(changes, state, text):
    """Each cause has its state and names the figures that it rests on."""
    verdict = judged(**{**SOUND, **changes})

    assert verdict.state == state
    assert text in verdict.reason
    assert (verdict.limit_m_s == 0.0) == (
        state in {"stop", "fault"} and "without_path" not in changes
    )


def test_worse_causes_come_first():
    """A fault is not hidden by someone who is near."""
    assert judged(**{**SOUND, "misfits": 8, "nearest_m": 0.0, "age_s": 9.0}).state == "fault"


@pytest.mark.parametrize(
    ("limit_m_s", "share"), [(0.0, 0.0), (0.5, 0.25), (2.0, 1.0), (math.inf, 1.0)]
)
def test_share_of_the_nominal_speed_is_never_more_than_all_of_it(limit_m_s, share):
    """Without a limit the robot goes as fast as its path lets it; at rest the share is exactly 0."""
    assert Verdict("slow", limit_m_s, "", "").share_of(2.0) == share


def test_troubles_are_counted_and_named():
    """A camera that misfits sees all the same; one that is stuck does not."""
    states = {
        "camera/2": CameraState(False, 0, 0, "stuck"),
        "camera/1": CameraState(True, 0, 0, "background no longer fits"),
        "camera/0": CameraState(False, 0, 0, "silent"),
        "camera/3": CameraState(True, 0, 0, ""),
    }
    assert troubles_of(states) == (1, "without camera/0, camera/2")
    assert troubles_of({}) == (0, "")


@pytest.mark.parametrize(("side", "sign"), [(0, -1.0), (0, 1.0), (1, -1.0), (1, 1.0)])
def test_distance_to_the_sides_is_to_the_nearest_one(side, sign):
    """Each side of the volume counts when the arm is nearest to it; what is not known counts as 0."""
    boxes = bounds(capsules_at(ARM, HOME_RAD)[0])[..., :2]
    end_m = boxes[:, 0].min(0) if sign < 0.0 else boxes[:, 1].max(0)
    low_m = np.array([-5.0, -5.0, 0.0])
    low_m[side] = end_m[side] - (0.3 if sign < 0.0 else 9.7)
    joints = Joints(np.tile(HOME_RAD, (2, 1)), np.zeros((2, 7)), np.arange(2))
    grid = Grid(low_m, 0.1, (100, 100, 20))
    assert distance_to_sides_m(grid, ARM, joints) == pytest.approx(0.3)
    assert distance_to_sides_m(None, ARM, joints) == distance_to_sides_m(grid, ARM, None) == 0.0


def hull(nearest_m):
    none = np.empty(0)
    return Hull(
        np.empty((0, 3), np.int16), none.astype(np.float32), none.astype(bool),
        none.astype(np.int16), {}, (), nearest_m, -1,
    )  # fmt: skip


class Cell:
    """A cell in this process in which SpeedControl runs."""

    def __init__(self, cell):
        self.cell, self.online, self.actor = cell, cell.world("online"), SpeedControl()
        self.online.init(ROBOT, MODEL, ARM)
        put(self.online, SYSTEM, CAMERA_STATES, {}, time.time_ns())

    def joints(self, stamp_ns):
        q = np.tile(HOME_RAD, (30, 1))
        stamps = stamp_ns - 10 * MS * np.arange(29, -1, -1)
        put(self.online, ROBOT, JOINTS, Joints(q, np.zeros((30, 7)), stamps.astype(np.int64)))

    def path(self, *waypoints, number=1, reason=""):
        rows = np.array(waypoints, float).reshape(-1, 7)
        put(self.online, ROBOT, PATH, Path(rows, number, 0, 1, 0, 0.0, reason))

    def judge(self, nearest_m, age_ms=50):
        """Put a hull and run the actor; return the speed."""
        captured_ns = time.time_ns() - age_ms * MS
        put(self.online, WORKSPACE, HULL, hull(nearest_m), captured_ns)
        assert testing.run_once(self.actor, self.cell) == 1
        speed = datum_of(self.online, ROBOT, SPEED)
        assert speed.captured_ns == captured_ns
        return speed


@pytest.fixture
def cell(monkeypatch):
    """A cell whose clock stands, here and in the actor, so that nothing grows older by the load."""
    now_ns = time.time_ns()
    stopped = SimpleNamespace(time_ns=lambda: now_ns)
    monkeypatch.setattr("actors.workcell.speed.time", stopped)
    monkeypatch.setitem(globals(), "time", stopped)
    with testing.worlds("online") as worlds:
        yield Cell(worlds)


AWAY = np.array(HOME_RAD) + np.array([1.5, 0, 0, 0, 0, 0, 0])


def test_speed_carries_what_it_rests_on(cell):
    """Stamp of the exposure, stamp of the joints, the distance, and how long it is valid."""
    stamp_ns = time.time_ns()
    cell.joints(stamp_ns)
    cell.path(HOME_RAD, AWAY)

    speed = cell.judge(0.8)

    assert (speed.joints_ns, speed.nearest_m, speed.valid_ms) == (stamp_ns, 0.8, 250.0)
    expected = Separation(reaction_s=0.25 + ROBOT_S).speed_max_m_s(0.8)
    assert speed.limit_m_s == pytest.approx(expected)
    assert 0.0 < speed.scale < 1.0
    assert datum_of(cell.online, SYSTEM, SAFETY).state == "slow"


def test_share_is_that_of_the_speed_on_the_path(cell):
    """On a slow path the same limit is a larger share."""
    cell.joints(time.time_ns())
    cell.path(HOME_RAD, AWAY)
    quick = cell.judge(0.8)
    cell.path(HOME_RAD, np.array(HOME_RAD) + np.array([0, 0, 0, 0, 0, 0, 2.0]), number=2)

    slow = cell.judge(0.8)

    assert quick.limit_m_s == slow.limit_m_s
    assert quick.scale < 1.0
    assert slow.scale == 1.0
    assert quick.scale >= quick.limit_m_s / NOMINAL_M_S


def test_reaction_time_is_measured(cell):
    """Quick images shorten it; a hull that comes too late stops the robot."""
    cell.joints(time.time_ns())
    cell.path(HOME_RAD, AWAY)
    first = cell.judge(1.0, age_ms=20)
    for age_ms in range(20):
        quick = cell.judge(1.0, age_ms=age_ms)

    late = cell.judge(1.0, age_ms=400)

    assert quick.valid_ms < first.valid_ms
    assert quick.limit_m_s > first.limit_m_s
    assert late.valid_ms == 250.0
    assert late.limit_m_s == 0.0
    assert datum_of(cell.online, SYSTEM, SAFETY).reason == "the images come late"


def test_an_image_counts_once_though_its_commit_fails(cell):
    """It has the age of the speed that was written at last; twenty make the time a measured one."""
    for age_ms in range(20, 38):
        cell.judge(1.0, age_ms=age_ms)
    put(cell.online, WORKSPACE, HULL, hull(1.0), time.time_ns() - 38 * MS)
    lose_commit(cell.actor, cell.cell)
    testing.run_once(cell.actor, cell.cell)
    assert datum_of(cell.online, ROBOT, SPEED).valid_ms == 250.0
    assert cell.judge(1.0, age_ms=39).valid_ms < 250.0


def test_silent_robot_and_missing_path_are_said(cell):
    """Without joints there is a fault; without a path a stop with the planner's reason."""
    fault = cell.judge(math.inf)
    state_before = datum_of(cell.online, SYSTEM, SAFETY)
    cell.joints(time.time_ns())
    cell.path(number=3, reason="the goal is where something is in the way")

    cell.judge(math.inf)

    assert (fault.limit_m_s, state_before.state) == (0.0, "fault")
    state = datum_of(cell.online, SYSTEM, SAFETY)
    assert (state.state, state.reason) == (
        "stop",
        "no path: the goal is where something is in the way",
    )


@pytest.mark.parametrize("age_ms", [700, None])
def test_a_silent_camera_watch_is_a_fault(cell, age_ms):
    """Without the watch no camera would ever be known to misfit again."""
    cell.joints(time.time_ns())
    cell.path(HOME_RAD, AWAY)
    sound = cell.judge(2.0)
    if age_ms is None:
        with Lock(request := Write(cell.online, SYSTEM, CAMERA_STATES)) as lock:
            del lock[request]
    else:
        put(cell.online, SYSTEM, CAMERA_STATES, {}, time.time_ns() - age_ms * MS)

    fault = cell.judge(2.0)

    assert sound.limit_m_s > 0.0 == fault.limit_m_s
    state = datum_of(cell.online, SYSTEM, SAFETY)
    assert (state.state, state.reason) == ("fault", "the camera watch is silent")


def test_cameras_are_named(cell):
    """A camera for which another stands in is named; three that do not fit are a fault."""
    cell.joints(time.time_ns())
    cell.path(HOME_RAD, AWAY)
    states = {
        f"camera/{n}": CameraState(n != 3, 0, 0, "silent" if n == 3 else "") for n in range(8)
    }
    put(cell.online, SYSTEM, CAMERA_STATES, states, time.time_ns())
    without = cell.judge(2.0)
    misfit = CameraState(alive=True, last_ns=0, sets_missed=0, trouble="background no longer fits")
    misfits = {**states, **{f"camera/{n}": misfit for n in range(3)}}
    put(cell.online, SYSTEM, CAMERA_STATES, misfits, time.time_ns())

    fault = cell.judge(2.0)

    assert without.reason == "2.00 m to the robot; without camera/3"
    assert fault.limit_m_s == 0.0
    assert datum_of(cell.online, SYSTEM, SAFETY).state == "fault"


def test_no_distance_counts_on_more_braking_than_there_is(cell):
    """A deceleration that the arm's loop does not have is refused, and no speed is written."""
    cell.actor.braking_m_s2 = 6.5

    with pytest.raises(ValueError, match=r"braking_m_s2 is 6\.5; the arm's loop brakes with 6"):
        cell.judge(1.0)


def test_speeds_along_a_path_are_those_of_its_own_life_of_the_shard(cell):
    """Another path may have the number of one that went with the shard."""
    cell.joints(time.time_ns())
    put(cell.online, ROBOT, PATH, Path(np.array([HOME_RAD, AWAY]), 1, 0, 1, 1000, 0.0))
    quick = cell.judge(0.8)
    wrist = np.array(HOME_RAD) + np.array([0, 0, 0, 0, 0, 0, 2.0])
    put(cell.online, ROBOT, PATH, Path(np.array([HOME_RAD, wrist]), 1, 0, 1, 2000, 0.0))

    slow = cell.judge(0.8)

    assert quick.scale < slow.scale == 1.0


def test_open_sides_keep_the_robot_from_who_stands_beside_the_volume(cell):
    """Nobody is seen outside the grid: with open sides the distance to these counts."""
    cell.joints(time.time_ns())
    cell.path(HOME_RAD, AWAY)
    fenced = cell.judge(math.inf)
    cell.actor.open_sides = True
    unknown = cell.judge(math.inf)
    put(cell.online, WORKSPACE, GRID, Grid(np.array([-1.3, -1.2, 0.0]), 0.1, (28, 24, 20)))

    beside = cell.judge(math.inf)

    tool_m = bounds(capsules_at(ARM, HOME_RAD)[0])[:, 1, 0].max()
    separation = Separation(reaction_s=0.25 + ROBOT_S)
    assert fenced.limit_m_s == math.inf
    assert unknown.limit_m_s == 0.0
    assert 0.6 < 1.5 - tool_m < 1.2
    assert beside.limit_m_s == pytest.approx(separation.speed_max_m_s(1.5 - tool_m))
    assert beside.nearest_m == math.inf


def test_safety_is_written_when_it_changes(cell):
    """The state keeps the exposure since which it holds, however the figures change."""
    cell.joints(time.time_ns())
    cell.path(HOME_RAD, AWAY)
    first = cell.judge(0.8)
    cell.judge(0.75)
    since = datum_of(cell.online, SYSTEM, SAFETY)
    last = cell.judge(0.2)

    assert (since.state, since.since_ns) == ("slow", first.captured_ns)
    assert datum_of(cell.online, SYSTEM, SAFETY).since_ns == last.captured_ns
    assert len(cell.online.history(SYSTEM, SAFETY)) == 2
