"""PathPlanning leads from goal to goal, around whoever is there, or waits and says why."""

import time
from dataclasses import replace

import numpy as np
import pytest
from lost_commits import lose_commit
from slots import get, put

from actors.geometry.arms.clearance import CellGrid
from actors.geometry.arms.joint_paths import JointPath
from actors.geometry.arms.kinematics import capsules_at
from actors.geometry.capsules import distance_to_points
from actors.workcell.motion import CYCLE_S, Motion
from actors.workcell.planning import Obstacles, PathPlanning, PlanningWithSpeed
from actors.workcell.setup import GOALS_RAD, grid_of
from actors.workcell.simulation.arm import ARM
from actors.workcell.simulation.room import BOXES as ROOM_BOXES
from actors.workcell.vocabulary import (
    BOXES,
    CAMERA_STATES,
    EXECUTION,
    GRID,
    HULL,
    JOINTS,
    MODEL,
    NO_PATH,
    PATH,
    PREDICTION,
    ROBOT,
    SAFETY,
    SPEED,
    SYSTEM,
    TASK,
    WORKSPACE,
    Execution,
    Grid,
    Hull,
    Joints,
    Prediction,
    Speed,
    Task,
    human_entity,
    obstacle_entity,
)
from enact_dist import Lock, View, Write, testing

LEFT = np.array([-1.0, 0.9, 0.0, -1.1, 0.0, 1.1, 0.0])
RIGHT = np.array([0.9, 0.9, 0.0, -1.1, 0.0, 1.1, 0.0])
START = LEFT - np.array([0.1, 0.1, 0.0, 0.0, 0.0, 0.0, 0.0])
FURTHER = RIGHT + np.array([0.2, -0.2, 0.0, 0.0, 0.0, 0.0, 0.0])
ORIGIN_M, VOXEL_M, SHAPE = np.array([-2.0, -2.0, 0.0]), 0.025, (160, 160, 88)
TABLE = np.r_[[0.95, 0.0, 0.375], [0.35, 0.6, 0.375], np.eye(3).ravel()]
PERIOD_NS = 100_000_000


def person(hand=(0.62, -0.15, 1.1), foot=(1.2, -0.75)):
    """Return the voxels of a body with an arm that reaches to `hand`."""
    shares = np.linspace(0.0, 1.0, 120)[:, None]
    body = np.r_[foot, 0.0] + shares * [0.0, 0.0, 1.7]
    arm = np.r_[foot, 1.4] + shares * (np.array(hand) - np.r_[foot, 1.4])
    return np.unique(np.floor((np.concatenate([body, arm]) - ORIGIN_M) / VOXEL_M), axis=0)


NOBODY = np.empty((0, 3))
REACHING = person(hand=(0.62, 0.2, 1.1), foot=(1.2, 0.75))
"""Someone in the second half of the way from left to right."""


@pytest.mark.parametrize("voxel_m", [0.02, 0.04, 0.05, 0.1])
def test_the_goals_of_the_task_are_free_on_any_grid(voxel_m):
    """A table does not grow with the voxels of the hull; a robot in an empty cell would stand."""
    grid, boxes = grid_of(voxel_m), np.stack([box.row() for box in ROOM_BOXES])
    obstacles = Obstacles(ARM, grid, boxes)

    free = obstacles.free(CellGrid(grid.origin_m, grid.voxel_m, grid.shape)).free

    assert free(np.array(GOALS_RAD)).all()


class Cell:
    """A robot that is put anywhere, and hulls one period apart."""

    def __init__(self, cell, actor=None, goals=(LEFT, RIGHT), dwell_s=0.0, cyclic=True):
        self.cell, self.online = cell, cell.world("online")
        self.actor = actor or PathPlanning()
        self.actor.limit_s = 60.0
        self.now_ns = time.time_ns()
        self.online.init(ROBOT, MODEL, ARM)
        self.online.init(WORKSPACE, GRID, Grid(ORIGIN_M, VOXEL_M, SHAPE))
        self.online.init(obstacle_entity(0), BOXES, TABLE[None])
        self.online.init(ROBOT, TASK, Task(np.array(goals), np.full(len(goals), dwell_s), cyclic))

    def see(self, q, voxels=NOBODY, dq=None):
        """Let one set come while the arm is at `q`; return the path."""
        self.come(q, voxels, dq)
        testing.run_once(self.actor, self.cell)
        return get(self.online, ROBOT, PATH)

    def come(self, q, voxels=NOBODY, dq=None):
        self.now_ns += PERIOD_NS
        dq = np.zeros(7) if dq is None else dq
        stamps = self.now_ns - 10_000_000 * np.arange(29, -1, -1)
        put(self.online, ROBOT, JOINTS, Joints(np.tile(q, (30, 1)), np.tile(dq, (30, 1)), stamps))
        count = len(voxels)
        hull = Hull(
            np.asarray(voxels, np.int16), np.zeros(count, np.float32), np.ones(count, bool),
            np.zeros(count, np.int16), {}, (), np.inf, -1,
        )  # fmt: skip
        put(self.online, WORKSPACE, HULL, hull, self.now_ns)


@pytest.fixture
def worlds():
    with testing.worlds("online") as cell:
        yield cell


def touches(path, voxels):
    """Say whether the arm touches the middle of a voxel anywhere on a path, every 2 mrad."""
    line = JointPath(path.waypoints)
    points = ORIGIN_M + (np.asarray(voxels) + 0.5) * VOXEL_M
    states = line.states(0.0, line.length_rad, 0.002)[::3]
    return any(
        distance_to_points(capsules[1:], points).min() <= 0.0
        for capsules in capsules_at(ARM, states)
    )


def test_path_leads_from_goal_to_goal(worlds):
    """To the first goal, then to the second one, and back to the first of a cyclic task."""
    cell = Cell(worlds)

    first = cell.see(START)
    second = cell.see(LEFT)
    third = cell.see(RIGHT)

    np.testing.assert_allclose(first.waypoints, [START, LEFT])
    np.testing.assert_allclose(second.waypoints[[0, -1]], [LEFT, RIGHT])
    np.testing.assert_allclose(third.waypoints[[0, -1]], [RIGHT, LEFT])
    ends = [(path.from_goal, path.to_goal, path.number) for path in (first, second, third)]
    assert ends == [(-1, 0, 1), (0, 1, 2), (1, 0, 3)]


def test_path_carries_the_stamp_of_its_hull(worlds):
    """So that `why` leads from the path to the images."""
    cell = Cell(worlds)
    cell.see(START)
    request = View(cell.online, ROBOT, PATH)

    with Lock(request) as lock:
        assert lock.stamp_ns(request) == cell.now_ns


def test_robot_dwells_at_a_goal(worlds):
    """It stays there for as long as the task says."""
    cell = Cell(worlds, dwell_s=0.35)
    cell.see(START)

    numbers = [cell.see(LEFT).number for _ in range(6)]

    assert numbers == [1, 1, 1, 1, 2, 2]


def test_task_that_is_not_cyclic_ends(worlds):
    """After the last goal there is no further path."""
    cell = Cell(worlds, goals=(LEFT, RIGHT), cyclic=False)
    for q in (START, LEFT, RIGHT, RIGHT, RIGHT):
        last = cell.see(q)

    assert (last.number, last.to_goal) == (2, 1)


def test_path_leads_around_a_person(worlds):
    """Planned beside someone who reaches over the table, it touches neither of them."""
    cell = Cell(worlds)
    cell.see(START, person())

    path = cell.see(LEFT, person())

    assert path.reason == ""
    assert len(path.waypoints) > 2
    assert not touches(path, person())


def test_blocked_path_is_replaced_after_two_sets(worlds):
    """One set could be noise; the new path begins where the arm can stop, on the old one."""
    cell = Cell(worlds)
    cell.see(START)
    old = cell.see(LEFT)
    on_way = LEFT + (RIGHT - LEFT) * 0.02
    dq = (RIGHT - LEFT) / np.linalg.norm(RIGHT - LEFT) * 0.1
    once = cell.see(on_way, person(), dq)

    cell.actor.limit_s = 0.08
    cell.see(on_way, NOBODY, dq)
    cell.see(on_way, person(), dq)
    cell.actor.limit_s = 0.5
    new = cell.see(on_way, person(), dq)

    assert (once.number, new.number) == (old.number, old.number + 1)
    assert new.reason == "someone is in the way"
    assert new.to_goal == old.to_goal
    start = new.waypoints[0]
    along = (start - on_way) @ (RIGHT - LEFT) / np.linalg.norm(RIGHT - LEFT)
    np.testing.assert_allclose(start, on_way + along * dq / 0.1, atol=1e-9)
    assert 0.0 < along < 0.4
    assert not touches(new, person())


def test_a_set_counts_once_though_its_commit_fails(worlds):
    """Someone in the way of one set could be noise, though its step is done again."""
    cell = Cell(worlds)
    cell.see(START)
    old = cell.see(LEFT)
    on_way = LEFT + 0.02 * (RIGHT - LEFT)
    cell.come(on_way, person(), 0.1 * heading_to(LEFT, RIGHT))
    lose_commit(cell.actor, worlds)
    testing.run_once(cell.actor, worlds)
    assert get(cell.online, ROBOT, PATH).number == old.number


def test_a_goal_is_left_though_the_commit_of_the_path_fails(worlds):
    """The arm has dwelt there: it does not begin to dwell anew."""
    cell = Cell(worlds, dwell_s=0.35)
    cell.see(START)
    for _ in range(4):
        before = cell.see(LEFT)
    cell.come(LEFT)
    lose_commit(cell.actor, worlds)
    assert cell.see(LEFT).number == before.number + 1


def test_an_arm_is_on_its_way_to_its_path_though_the_one_after_it_was_not_written(worlds):
    """It rests before the place where it goes over: that is known still, and no other path comes."""
    cell = Cell(worlds)
    cell.actor.now_ns = lambda: cell.now_ns
    cell.see(START)
    cell.see(LEFT)
    ahead = heading_to(LEFT, RIGHT)
    cell.see(LEFT + 0.3 * ahead, REACHING, ahead)
    over = cell.see(LEFT + 0.4 * ahead, REACHING, ahead)
    refused = Execution("moving", 1.0, 1.0, 0, 0, 2, 0, 0, "", over.identity, "it is refused")
    put(cell.online, ROBOT, EXECUTION, refused)
    cell.come(LEFT + 0.42 * ahead, REACHING, 0.4 * ahead)
    lose_commit(cell.actor, worlds)
    put(cell.online, ROBOT, EXECUTION, replace(refused, refused_path=NO_PATH, path_refusal=""))
    assert cell.see(LEFT + 0.45 * ahead).number == over.number


def heading_to(one, other):
    return (other - one) / np.linalg.norm(other - one)


def test_moving_arm_leaves_its_path_straight_on_where_it_will_be(worlds):
    """Not where it is now: behind the way of the time that planning and hand-over take."""
    cell = Cell(worlds)
    cell.see(START)
    cell.see(LEFT)
    ahead = heading_to(LEFT, RIGHT)
    on_way = LEFT + 0.3 * ahead
    cell.see(on_way, REACHING, ahead)

    new = cell.see(on_way + 0.1 * ahead, REACHING, ahead)

    along = (new.waypoints[0] - on_way) @ ahead - 0.1
    assert 0.13 < along < 0.4
    np.testing.assert_allclose(heading_to(*new.waypoints[:2]), ahead, atol=1e-9)
    assert new.captured_ns == cell.now_ns
    assert not touches(new, REACHING)


def test_refused_path_is_planned_again_from_the_path_that_is_followed(worlds):
    """The robot was past the place where it should have left its path: there is another one."""
    cell = Cell(worlds)
    cell.actor.now_ns = lambda: cell.now_ns  # planning takes no time, however busy the machine is
    cell.see(START)
    old = cell.see(LEFT)
    ahead = heading_to(LEFT, RIGHT)
    cell.see(LEFT + 0.3 * ahead, REACHING, ahead)
    late = cell.see(LEFT + 0.4 * ahead, REACHING, ahead)
    beyond = late.waypoints[0] + 0.05 * ahead
    why = f"path {late.number} is refused: the arm has passed the place"
    done = Execution("moving", 1.0, 1.0, 0, 0, old.number, 0, 0, "", late.identity, why)
    put(cell.online, ROBOT, EXECUTION, done)

    new = cell.see(beyond, REACHING, 0.4 * ahead)

    assert (new.number, new.reason) == (late.number + 1, why)
    assert (new.waypoints[0] - beyond) @ ahead > 0.05
    np.testing.assert_allclose(heading_to(*new.waypoints[:2]), ahead, atol=1e-9)


def test_arm_stops_if_it_would_pass_someone_before_it_can_leave_its_path(worlds):
    """A path that leaves the old one behind them would lead the arm through them."""
    cell = Cell(worlds)
    cell.actor.branch_s = 0.5
    cell.actor.now_ns = lambda: cell.now_ns
    cell.see(START)
    cell.see(LEFT)
    ahead = heading_to(LEFT, RIGHT)
    on_way = LEFT + 0.4 * ahead
    between = JointPath(np.array([LEFT, RIGHT])).at(0.7)[0]
    end_m = capsules_at(ARM, between)[0][-1, 3:5]
    pole = np.r_[end_m, 0.0] + np.linspace(0.0, 1.0, 120)[:, None] * [0.0, 0.0, 2.0]
    pole = np.unique(np.floor((pole - ORIGIN_M) / VOXEL_M), axis=0)
    cell.see(on_way, pole, 1.2 * ahead)

    new = cell.see(on_way, pole, 1.2 * ahead)

    assert not len(new.waypoints)
    assert new.reason == "someone is in the way before the arm can leave its path"
    for _ in range(4):
        rested = cell.see(on_way + 0.1 * ahead)
    np.testing.assert_allclose(rested.waypoints, [on_way + 0.1 * ahead, RIGHT])


def test_refused_path_is_planned_again_from_where_the_arm_rests(worlds):
    """Also if the arm rests so near to the refused path that it seems to be on it."""
    cell = Cell(worlds)
    cell.see(START)
    path = cell.see(LEFT)
    beside = LEFT + 0.3 * heading_to(LEFT, RIGHT) + 0.01
    done = Execution("waiting", 0.0, 0.0, 0, 0, -1, 0, 0, "", path.identity, "path 2 is refused")
    put(cell.online, ROBOT, EXECUTION, done)

    new = cell.see(beside)

    np.testing.assert_array_equal(new.waypoints[[0, -1]], [beside, RIGHT])
    assert new.reason == "path 2 is refused"


def run_past(cell, voxels, seconds=8.0):
    """Let an arm go from left to right while something appears in its way; return states and refusals."""
    motion = Motion(ARM, START, cell.now_ns)
    period, cycle = round(PERIOD_NS / 1e6), round(CYCLE_S * 1e3)
    states, refusals, coming = [], set(), []
    for at_ms in range(0, round(seconds * 1e3), cycle):
        if at_ms % period == 0:
            there = voxels if motion.q_rad[0] > -0.7 else NOBODY
            path = cell.see(motion.q_rad, there, motion.dq_rad_s)
            coming.append((at_ms + 120, path))
        while coming and at_ms >= coming[0][0]:
            motion.follow(coming.pop(0)[1], cell.now_ns + at_ms % period * 1_000_000)
        now_ns = cell.now_ns + at_ms % period * 1_000_000
        motion.obey(Speed(1.0, np.inf, np.inf, "", 250.0, now_ns, now_ns), now_ns)
        motion.cycle(now_ns)
        states.append((motion.q_rad, float(np.linalg.norm(motion.dq_rad_s))))
        refusals.add(motion.path_refusal)
        if at_ms % period == 0:
            put(cell.online, ROBOT, EXECUTION, motion.execution(now_ns, now_ns, ""))
        if motion.doing.goals_reached == 2:
            break
    return states, refusals - {""}


def test_arm_goes_around_what_appears_while_it_moves(worlds):
    """Planner and robot together: no stop, no touch, and the goal is reached."""
    cell = Cell(worlds, goals=(LEFT, RIGHT), cyclic=False)
    cell.actor.now_ns = lambda: cell.now_ns + 50_000_000

    states, refusals = run_past(cell, REACHING)

    path = get(cell.online, ROBOT, PATH)
    under_way = [speed for q, speed in states if -0.9 < q[0] < 0.8]
    points = ORIGIN_M + (REACHING + 0.5) * VOXEL_M
    off_m = [
        distance_to_points(capsules[1:], points).min()
        for capsules in capsules_at(ARM, np.array([q for q, _ in states])[::2])
    ]
    assert path.reason == "someone is in the way"
    assert refusals == set()
    np.testing.assert_allclose(states[-1][0], RIGHT, atol=1e-9)
    assert min(under_way) > 0.05
    assert min(off_m) > 0.0


def test_without_a_path_it_waits_and_says_why(worlds):
    """A goal that someone stands in is named; when they leave, the path comes."""
    tool = capsules_at(ARM, RIGHT)[0, -1, 3:6]
    there = person(hand=tool, foot=(1.2, 0.9))
    cell = Cell(worlds)
    cell.see(START, there)

    blocked = cell.see(LEFT, there)
    waits = [cell.see(LEFT, there) for _ in range(6)]
    free = [cell.see(LEFT) for _ in range(4)][-1]

    assert len(blocked.waypoints) == 0
    assert blocked.reason == "the goal is where something is in the way"
    assert {path.number for path in waits} == {blocked.number}
    assert len(free.waypoints) == 2
    assert free.to_goal == 1


def test_arm_off_its_path_gets_another_one(worlds):
    """At rest beside the path, it is planned anew from there."""
    cell = Cell(worlds)
    cell.see(START)
    cell.see(LEFT)
    aside = LEFT + np.array([0.0, -0.4, 0, 0, 0, 0, 0])

    path = cell.see(aside)

    np.testing.assert_allclose(path.waypoints[[0, -1]], [aside, RIGHT])
    assert path.reason == "the arm is off its path"


def test_prediction_is_avoided_but_never_stops(worlds):
    """Where someone will be is gone around if there is a way; else the path stays."""
    cell = Cell(worlds)
    cell.see(START)
    straight = cell.see(LEFT)
    at_s = np.linspace(0.1, 1.0, 10)
    middle = capsules_at(ARM, (LEFT + RIGHT) / 2)[0, -1, 3:5]
    walls = Prediction(at_s, np.tile(middle, (10, 1)), np.full(10, 0.15))
    put(cell.online, human_entity(0), PREDICTION, walls)

    for _ in range(6):
        kept = cell.see(LEFT + (RIGHT - LEFT) * 0.25)

    assert len(straight.waypoints) == 2
    assert len(kept.waypoints) >= 2
    ignoring = PathPlanning()
    ignoring.predict = False
    ignoring.limit_s = 60.0
    cell.actor = ignoring
    assert cell.see(LEFT + (RIGHT - LEFT) * 0.25).number == kept.number


def test_changed_task_is_planned_for(worlds):
    """A goal that moved is gone to from where the arm rests."""
    cell = Cell(worlds)
    cell.see(START)
    cell.see(LEFT)
    put(cell.online, ROBOT, TASK, Task(np.array([LEFT, FURTHER]), np.zeros(2), cyclic=True))

    path = cell.see(LEFT + 0.01)

    np.testing.assert_allclose(path.waypoints[-1], FURTHER)


def test_nothing_is_planned_before_there_is_a_task(worlds):
    """A hull alone makes no path."""
    cell = Cell(worlds)
    request = Write(cell.online, ROBOT, TASK)
    with Lock(request) as lock:
        del lock[request]

    assert cell.see(LEFT) is None


def test_both_in_one_actor(worlds):
    """As in the paper's Figure 4: path and speed by one actor, from one set."""
    cell = Cell(worlds, PlanningWithSpeed())
    cell.now_ns -= 10 * PERIOD_NS
    put(cell.online, SYSTEM, CAMERA_STATES, {}, cell.now_ns + PERIOD_NS)
    cell.see(START)

    path = cell.see(START)

    assert len(path.waypoints) == 2
    assert get(cell.online, ROBOT, SPEED).captured_ns == cell.now_ns
    assert get(cell.online, SYSTEM, SAFETY).state in {"run", "stop"}
