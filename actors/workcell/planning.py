"""Path planning (ENACT 4.1): a path to the next goal around the people in the cell."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from actors.geometry.arms.clearance import ArmSpheres, CellGrid, Clearance, GrownGrid
from actors.geometry.arms.joint_paths import JoinedPath, JointPath, PathSpeeds
from actors.geometry.arms.joint_planning import Plan, load, plan
from actors.workcell.motion import NOMINAL_M_S
from actors.workcell.speed import SpeedControl
from actors.workcell.vocabulary import (
    BOXES,
    EXECUTION,
    GRID,
    HULL,
    HUMANS,
    JOINTS,
    MODEL,
    OBSTACLES,
    PATH,
    PREDICTION,
    ROBOT,
    TASK,
    WORKSPACE,
    ArmModel,
    Grid,
    Hull,
    Joints,
    Path,
    Prediction,
    Task,
)
from enact_dist import Actor, View, ViewEach, World, Write

if TYPE_CHECKING:
    from collections.abc import Iterable

    import numpy.typing as npt

    from enact_dist import Lock

    F64 = npt.NDArray[np.float64]

MARGIN_M: Final = 0.05
"""What a planned path keeps from everything."""
STATIC_MARGIN_M: Final = 0.02
"""The remaining clearance from static obstacles along a path that is still valid."""
STATIC_CELL_M: Final = 0.025
"""Edge of the cells that static obstacles take, however coarse the hull is."""
COARSER: Final = 2
"""Voxels of the hull along an edge of a cell in which is planned: 5 cm."""
HEIGHT_M: Final = 2.0
"""Height of a predicted person."""
SOON_S: Final = 0.5
"""So far ahead a prediction can block the path that the arm follows."""
OFF_RAD: Final = 0.05
"""So far from its path the arm is not on it."""
HERE_RAD: Final = 2e-3
"""So near to a goal the arm is there."""
BEYOND_RAD: Final = 0.01
"""So far beyond where the arm can be by then it leaves its path."""
LOOKED_RAD: Final = 0.03
"""Distance of the states that are looked at along a path."""
CUT_OFF: Final = "someone is in the way before the arm can leave its path"


class Obstacles:
    """What the arm must not touch, as questions about its states.

    Args:
        model: The arm.
        grid: Voxels of the hull.
        boxes: (n, 15), of the static obstacles.
    """

    def __init__(self, model: ArmModel, grid: Grid, boxes: F64) -> None:
        self._model, self._grid = model, grid
        self._spheres = ArmSpheres(model)
        x, y, z = (math.ceil(size * grid.voxel_m / STATIC_CELL_M - 1e-9) for size in grid.shape)
        static = CellGrid(grid.origin_m, STATIC_CELL_M, (x, y, z))
        static.mark_boxes(boxes)
        self._static = GrownGrid(self._spheres, static, MARGIN_M)
        self._static_left = GrownGrid(self._spheres, static, STATIC_MARGIN_M)

    def around(self, hull: Hull, predictions: Iterable[Prediction], ahead_s: float) -> CellGrid:
        """Return the cells that people take or will take within a time."""
        edge_m = self._grid.voxel_m * COARSER
        x, y, z = (-(-size // COARSER) for size in self._grid.shape)
        cells = CellGrid(self._grid.origin_m, edge_m, (x, y, z))
        cells.mark_indices(hull.voxels // COARSER)
        for one in predictions:
            there = one.at_s <= ahead_s
            cells.mark_cylinders(one.centre_m[there], one.radius_m[there], HEIGHT_M)
        return cells

    def free(self, cells: CellGrid) -> Clearance:
        """Return what a new path has to keep to."""
        grown = GrownGrid(self._spheres, cells, MARGIN_M)
        return Clearance(self._spheres, self._model, [self._static, grown])

    def passable(self, cells: CellGrid) -> Clearance:
        """Return what a path that is followed has to keep to."""
        grown = GrownGrid(self._spheres, cells, 0.0)
        grids = [self._static_left, grown]
        return Clearance(self._spheres, self._model, grids, slack_m=0.02)


@dataclass(frozen=True, slots=True, eq=False)
class Branch:
    """Where an arm leaves the path that it follows, without a stop.

    Attributes:
        speeds: Along that path.
        here_rad: Where the arm is on it.
        at_rad: Where it leaves it; the path is straight there.
    """

    speeds: PathSpeeds
    here_rad: float
    at_rad: float

    @property
    def q_rad(self) -> F64:
        """The state in which it leaves, (7,)."""
        state: F64 = self.speeds.path.at(self.at_rad)[0][0]
        return state

    @property
    def before_rad(self) -> F64:
        """The states of the arm from here to there, (m, 7)."""
        return self.speeds.path.states(self.here_rad, self.at_rad, LOOKED_RAD)

    @property
    def heading(self) -> F64:
        """The direction in which it leaves, (7,), of length 1."""
        heading: F64 = self.speeds.path.at(self.at_rad)[1][0]
        return heading

    def onto(self, path: Path, model: ArmModel) -> PathSpeeds:
        """Return what the arm follows from where it is: the rest of its path, and then another."""
        line = JointPath(path.waypoints)
        both = JoinedPath(self.speeds.path, self.here_rad, self.at_rad, line)
        return PathSpeeds(model, both, nominal_m_s=NOMINAL_M_S)


class PathPlanning(Actor):
    """Keep a path to the next goal of the task, at each hull.

    The next second of the path is looked at.  If it is blocked in two sets in a row, another path
    is planned.  A moving arm goes over to it without a stop, at a place that it reaches only when
    the path is there; an arm that is past that place refuses the path and brakes, and the next set
    plans again.  Without a way, or if someone is in the way to that place, the path has no
    waypoints and says why.  Predicted positions of people are avoided if another way exists.

    Attributes:
        predict: Whether predictions count.
        seed: Of the search; with the number of the path it decides what is found.
        limit_s: Longest time of a search.
        ahead_s: How much of the path is looked at.
        branch_s: How long a path takes to the robot, from the time that planning begins: `limit_s`,
            and the way.
    """

    online = World("online")
    hull = View(online, WORKSPACE, HULL)
    grid = View(online, WORKSPACE, GRID)
    predictions = ViewEach(online, HUMANS, PREDICTION)
    boxes = ViewEach(online, OBSTACLES, BOXES)
    joints = View(online, ROBOT, JOINTS)
    execution = View(online, ROBOT, EXECUTION)
    model = View(online, ROBOT, MODEL)
    task = View(online, ROBOT, TASK)
    path = Write(online, ROBOT, PATH)
    triggers = (hull,)

    predict: bool = True
    seed: int = 1
    limit_s: float = 0.08
    ahead_s: float = 1.0
    branch_s: float = 0.13

    def __init__(self, *, predict: bool = True, seed: int = 1) -> None:
        super().__init__()
        self.predict, self.seed = predict, seed
        self._obstacles: tuple[bytes, Obstacles] | None = None
        self._followed: tuple[object, PathSpeeds] | None = None
        self._left: PathSpeeds | None = None
        self._blocked = 0
        self._pause = 0
        self._there_since_ns = 0

    def start(self) -> None:
        """Load the planner before any lock is held."""
        load()

    def now_ns(self) -> int:
        """Return the time, ns since 1970; a simulation has its own."""
        return time.time_ns()

    def update(self, lock: Lock) -> None:
        """Look at the path; plan another one where that is due."""
        if any(map(lock.is_null, (self.model, self.task, self.joints, self.grid))):
            return
        joints, task, last = lock[self.joints], lock[self.task], lock.get(self.path)
        q = joints.q[-1]
        at_rest = bool(np.abs(joints.dq).max() < 1e-6)
        goal = last.to_goal if last is not None and last.to_goal < len(task.goals) else 0
        obstacles = self._known(lock)
        hull = lock[self.hull]
        predictions = list(lock[self.predictions].values()) if self.predict else []
        now = obstacles.around(hull, [], 0.0)
        soon = obstacles.around(hull, predictions, SOON_S) if predictions else now
        later = obstacles.around(hull, predictions, np.inf) if predictions else now
        if last is None or not len(last.waypoints):
            self._pause -= 1
            if self._pause < 0 and at_rest:
                self._plan(lock, obstacles, [later, now], q, goal, "")
            return
        if at_rest and np.linalg.norm(q - task.goals[goal]) < HERE_RAD:
            self._dwell(lock, obstacles, [later, now], task, goal)
            return
        self._there_since_ns = 0
        refusal = self._refusal(lock, last)
        speeds = self._speeds_along(lock[self.model], last, refused=bool(refusal))
        line = speeds.path
        s_rad = line.nearest_rad(q)
        off_rad = float(np.linalg.norm(line.at(s_rad)[0][0] - q))
        moved_on = np.linalg.norm(last.waypoints[-1] - task.goals[goal]) > HERE_RAD
        if at_rest and (off_rad > OFF_RAD or moved_on or refusal):
            why = "the task has changed" if moved_on else refusal or "the arm is off its path"
            self._plan(lock, obstacles, [later, now], q, goal, why)
            return
        there = speeds.within(s_rad, self.ahead_s)
        ahead = line.states(s_rad, float(speeds.places_rad[there][-1]), LOOKED_RAD)
        passable = obstacles.passable(now)
        blocked = not passable.free(ahead).all()
        avoid = bool(predictions) and not obstacles.passable(soon).free(ahead).all()
        self._blocked = self._blocked + 1 if blocked or avoid else 0
        if self._blocked < 2 and not refusal:
            return
        branch = None if at_rest else self._branch(speeds, s_rad, joints)
        if refusal or blocked:
            why = refusal or "someone is in the way"
            reached = branch is None or passable.free(branch.before_rad).all()
            cells = [later, now] if reached else []
            self._plan(lock, obstacles, cells, q, goal, why, branch=branch)
        elif self._blocked % 3 == 2:
            why = "someone will be in the way"
            self._plan(lock, obstacles, [later], q, goal, why, branch=branch)

    def _dwell(
        self, lock: Lock, obstacles: Obstacles, cells: list[CellGrid], task: Task, goal: int
    ) -> None:
        """Stay at a goal as long as the task says, then go on to the next one."""
        stamp_ns = lock.stamp_ns(self.hull)
        self._there_since_ns = self._there_since_ns or stamp_ns
        if stamp_ns - self._there_since_ns < task.dwell_s[goal] * 1e9:
            return
        following = goal + 1
        if following >= len(task.goals) and not task.cyclic:
            return
        if len(task.goals) > 1:
            start, to = task.goals[goal], following % len(task.goals)
            self._plan(lock, obstacles, cells, start, to, "", from_goal=goal)

    def _plan(
        self,
        lock: Lock,
        obstacles: Obstacles,
        cells: list[CellGrid],
        start: F64,
        goal: int,
        why: str,
        from_goal: int | None = None,
        branch: Branch | None = None,
    ) -> None:
        """Write a path from a state to a goal, or the absence of one.

        Args:
            lock: Of the update.
            obstacles: What to keep from.
            cells: What people take, the most careful first; the last is what counts.  Empty if
                someone is in the way to the `branch`.
            start: Where the path begins, (7,), if it has no `branch`.
            goal: Where it leads.
            why: Why it replaces the last one.
            from_goal: Goal that it comes from; None: as the last path.
            branch: Where a moving arm leaves its path.
        """
        last, began_s = lock.get(self.path), time.monotonic()
        number = last.number + 1 if last is not None else 1
        only_wish = last is not None and why == "someone will be in the way"
        found = Plan(np.empty((0, len(start))), CUT_OFF, 0)
        for one in cells:
            left_s = self.limit_s - (time.monotonic() - began_s)
            found = plan(
                start if branch is None else branch.q_rad,
                lock[self.task].goals[goal],
                obstacles.free(one).free,
                obstacles.passable(one).free,
                q_max_rad=lock[self.model].q_max,
                seed=self.seed + number,
                limit_s=max(left_s, 0.02),
                heading=None if branch is None else branch.heading,
            )
            if len(found.waypoints) or one is cells[-1]:
                break
        self._blocked, self._there_since_ns = 0, 0
        if not len(found.waypoints):
            self._pause = 2
            if only_wish or (last is not None and last.reason == found.reason):
                return
        if from_goal is None:
            from_goal = last.from_goal if last is not None else -1
        length_rad = float(np.linalg.norm(np.diff(found.waypoints, axis=0), axis=1).sum())
        path = Path(
            waypoints=found.waypoints,
            number=number,
            from_goal=from_goal,
            to_goal=goal,
            planned_ns=self.now_ns(),
            length_rad=length_rad,
            reason=found.reason or why,
            took_ms=1e3 * (time.monotonic() - began_s),
            captured_ns=lock.stamp_ns(self.hull),
        )
        lock[self.path] = path
        if branch is not None and len(path.waypoints):
            self._followed = path.identity, branch.onto(path, lock[self.model])
            self._left = branch.speeds

    def _refusal(self, lock: Lock, last: Path) -> str:
        """Say why the robot refused the last path; empty if it did not."""
        done = lock.get(self.execution)
        if done is None or done.refused_path != last.identity:
            return ""
        return done.path_refusal

    def _branch(self, speeds: PathSpeeds, s_rad: float, joints: Joints) -> Branch:
        """Return where a moving arm will be able to leave its path when another one arrives."""
        along = max(float(np.linalg.norm(speeds.path.at(s_rad)[1][0])), 0.1)
        speed_rad_s = float(np.linalg.norm(joints.dq[-1])) / along
        age_s = max(0.0, (self.now_ns() - int(joints.stamp_ns[-1])) / 1e9)
        reached_rad = speeds.reached_rad(s_rad, speed_rad_s, age_s + self.branch_s)
        return Branch(speeds, s_rad, speeds.path.straight_rad(reached_rad + BEYOND_RAD))

    def _known(self, lock: Lock) -> Obstacles:
        """Return what is static, worked out once as long as it stays the same."""
        boxes = [np.reshape(one, (-1, 15)) for _, one in sorted(lock[self.boxes].items())]
        rows = np.concatenate([np.empty((0, 15)), *boxes])
        model, grid = lock[self.model], lock[self.grid]
        size = np.array([grid.voxel_m, *grid.shape])
        parts = (rows, model.dh, model.base, model.capsules, grid.origin_m, size)
        key = b"".join(np.ascontiguousarray(part).tobytes() for part in parts)
        if self._obstacles is None or self._obstacles[0] != key:
            self._obstacles = key, Obstacles(model, grid, rows)
        return self._obstacles[1]

    def _speeds_along(self, model: ArmModel, path: Path, *, refused: bool) -> PathSpeeds:
        """Return along what the arm moves: the last path, with what it followed before."""
        if self._followed is None or self._followed[0] != path.identity:
            line = JointPath(path.waypoints)
            self._followed = path.identity, PathSpeeds(model, line, nominal_m_s=NOMINAL_M_S)
            self._left = None
        return self._left if refused and self._left is not None else self._followed[1]


class PlanningWithSpeed(PathPlanning, SpeedControl):  # type: ignore[misc]  # one writes the path
    """Path planning and speed control in one actor, as in the paper's Figure 4.

    The speed then waits for a search, up to `limit_s`: run the two apart in a real cell.
    """

    hull = PathPlanning.hull
    triggers = (hull,)

    def update(self, lock: Lock) -> None:
        """Plan, then say how fast the robot may be."""
        PathPlanning.update(self, lock)
        SpeedControl.update(self, lock)
