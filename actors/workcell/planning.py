"""Path planning (ENACT 4.1): a path to the next goal around the people in the cell."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace
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
    from collections.abc import Callable, Iterable

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
PAUSE: Final = 2
"""Sets after which a search that found no way is repeated, where the arm rests without a path."""
FORESEEN: Final = "someone will be in the way"
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


@dataclass(frozen=True, slots=True, eq=False)
class Followed:
    """Along what the arm moves.

    Attributes:
        path: Identity of the last path.
        speeds: Along it, with what it was left for.
        left: Along what the arm goes on if it refuses the last path; None: it has none.
    """

    path: object
    speeds: PathSpeeds
    left: PathSpeeds | None = None

    @classmethod
    def from_rest(cls, path: Path, model: ArmModel) -> Followed:
        """Return what an arm follows that has come to rest before a path."""
        speeds = PathSpeeds(model, JointPath(path.waypoints), nominal_m_s=NOMINAL_M_S)
        return cls(path.identity, speeds)

    def along(self, *, is_refused: bool) -> PathSpeeds:
        """Return along what the arm moves, which may have refused the last path."""
        return self.left if is_refused and self.left is not None else self.speeds


@dataclass(frozen=True, slots=True)
class Waits:
    """What planning waits for, from set to set.

    Attributes:
        blocked: Sets in a row that showed the path blocked.
        pause: Sets in which no way is searched, after a search found none.
        there_since_ns: Since when the arm dwells at its goal, ns since 1970; 0: it does not.
    """

    blocked: int = 0
    pause: int = 0
    there_since_ns: int = 0

    def after(self, found: Plan) -> Waits:
        """Return what is waited for after a search."""
        return Waits(pause=self.pause if len(found.waypoints) else PAUSE)


@dataclass(frozen=True, slots=True, eq=False)
class Search:
    """A path that is to be found.

    Attributes:
        start: Where it begins, (7,) rad, if it has no `branch`.
        goal: Number of the goal where it leads.
        around: What people take, the most careful first; the last is what counts.  Empty if
            someone is in the way to the `branch`.
        why: Why it replaces the last one.
        from_goal: Number of the goal that it comes from; None: as the last path.
        branch: Where a moving arm leaves its path.
    """

    start: F64
    goal: int
    around: tuple[CellGrid, ...]
    why: str = ""
    from_goal: int | None = None
    branch: Branch | None = None

    def found(self, scene: Scene, *, seed: int, limit_s: float) -> Plan:
        """Return the path, or why there is none; it takes as long as the limit at most."""
        ends_s, found = time.monotonic() + limit_s, Plan(np.empty((0, len(self.start))), CUT_OFF, 0)
        for cells in self.around:
            found = plan(
                self.start if self.branch is None else self.branch.q_rad,
                scene.task.goals[self.goal],
                scene.obstacles.free(cells).free,
                scene.obstacles.passable(cells).free,
                q_max_rad=scene.model.q_max,
                seed=seed,
                limit_s=max(ends_s - time.monotonic(), 0.02),
                heading=None if self.branch is None else self.branch.heading,
            )
            if len(found.waypoints):
                break
        return found

    def path(self, found: Plan, scene: Scene, planned_ns: int, took_ms: float) -> Path:
        """Return what was found at a time, ns since 1970, as a path."""
        last = scene.last
        came_from = last.from_goal if last is not None else -1
        return Path(
            waypoints=found.waypoints,
            number=scene.number,
            from_goal=came_from if self.from_goal is None else self.from_goal,
            to_goal=self.goal,
            planned_ns=planned_ns,
            length_rad=float(np.linalg.norm(np.diff(found.waypoints, axis=0), axis=1).sum()),
            reason=found.reason or self.why,
            took_ms=took_ms,
            captured_ns=scene.captured_ns,
        )

    def is_news(self, found: Plan, last: Path | None) -> bool:
        """Return whether what was found replaces the last path.

        The planner publishes once that there is no way.  That replaces no path that is still free.
        """
        if len(found.waypoints) or last is None:
            return True
        return self.why != FORESEEN and last.reason != found.reason


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """What path planning knows at a set.

    Attributes:
        model: The arm.
        joints: Its newest samples.
        task: Its goals.
        last: The path before; None: there is none.
        refusal: Why the robot refused it; empty if it did not.
        followed: Along what the arm moves; None if `last` has no waypoints.
        obstacles: What is static.
        now: The cells that people take.
        soon: With those that they take within `SOON_S`; `now` itself if no prediction is there.
        later: With all those that they take as far as is predicted.
        captured_ns: Stamp of the set, nanoseconds since 1970.
        ahead_s: How much of the path is looked at.
        branch_s: How long a path takes to the robot.
    """

    model: ArmModel
    joints: Joints
    task: Task
    last: Path | None
    refusal: str
    followed: Followed | None
    obstacles: Obstacles
    now: CellGrid
    soon: CellGrid
    later: CellGrid
    captured_ns: int
    ahead_s: float
    branch_s: float

    @property
    def number(self) -> int:
        """Number of the next path."""
        return 1 if self.last is None else self.last.number + 1

    def due(self, before: Waits, now_ns: Callable[[], int]) -> tuple[Search | None, Waits]:
        """Return which path is to be found, None if no other one, and what is waited for.

        If the path is blocked in two sets in a row, or the robot has refused it, another one is
        due.  A moving arm goes over to it at a place that it reaches only when that path is there.

        Args:
            before: What was waited for at the last set.
            now_ns: The time; asked once the path was looked at, which takes milliseconds.
        """
        last, q = self.last, self.joints.q[-1]
        is_at_rest = bool(np.abs(self.joints.dq).max() < 1e-6)
        goal = last.to_goal if last is not None and last.to_goal < len(self.task.goals) else 0
        search = Search(q, goal, (self.later, self.now))
        if last is None or self.followed is None:
            waits = replace(before, pause=before.pause - 1)
            return (search if waits.pause < 0 and is_at_rest else None), waits
        if is_at_rest and np.linalg.norm(q - self.task.goals[goal]) < HERE_RAD:
            return self._dwelt(goal, before)
        waits = replace(before, there_since_ns=0)
        speeds = self.followed.along(is_refused=bool(self.refusal))
        s_rad = speeds.path.nearest_rad(q)
        off_rad = float(np.linalg.norm(speeds.path.at(s_rad)[0][0] - q))
        has_moved = np.linalg.norm(last.waypoints[-1] - self.task.goals[goal]) > HERE_RAD
        if is_at_rest and (off_rad > OFF_RAD or has_moved or self.refusal):
            why = "the task has changed" if has_moved else self.refusal or "the arm is off its path"
            return replace(search, why=why), waits
        there = speeds.within(s_rad, self.ahead_s)
        ahead = speeds.path.states(s_rad, float(speeds.places_rad[there][-1]), LOOKED_RAD)
        passable = self.obstacles.passable(self.now)
        is_blocked = not passable.free(ahead).all()
        is_foreseen = (
            self.soon is not self.now and not self.obstacles.passable(self.soon).free(ahead).all()
        )
        waits = replace(waits, blocked=waits.blocked + 1 if is_blocked or is_foreseen else 0)
        if waits.blocked < 2 and not self.refusal:
            return None, waits
        branch = None if is_at_rest else self._branch(speeds, s_rad, now_ns())
        search = replace(search, branch=branch)
        if self.refusal or is_blocked:
            is_reached = branch is None or passable.free(branch.before_rad).all()
            around = search.around if is_reached else ()
            why = self.refusal or "someone is in the way"
            return replace(search, around=around, why=why), waits
        if waits.blocked % 3 == 2:
            return replace(search, around=(self.later,), why=FORESEEN), waits
        return None, waits

    def _dwelt(self, goal: int, before: Waits) -> tuple[Search | None, Waits]:
        """Stay at a goal as long as the task says, then go on to the next one."""
        task, following = self.task, goal + 1
        waits = replace(before, there_since_ns=before.there_since_ns or self.captured_ns)
        stays = self.captured_ns - waits.there_since_ns < task.dwell_s[goal] * 1e9
        is_last = following >= len(task.goals) and (not task.cyclic or len(task.goals) == 1)
        if stays or is_last:
            return None, waits
        to = following % len(task.goals)
        return Search(task.goals[goal], to, (self.later, self.now), from_goal=goal), waits

    def _branch(self, speeds: PathSpeeds, s_rad: float, now_ns: int) -> Branch:
        """Return where a moving arm will be able to leave its path when another one arrives."""
        along = max(float(np.linalg.norm(speeds.path.at(s_rad)[1][0])), 0.1)
        speed_rad_s = float(np.linalg.norm(self.joints.dq[-1])) / along
        age_s = max(0.0, (now_ns - int(self.joints.stamp_ns[-1])) / 1e9)
        reached_rad = speeds.reached_rad(s_rad, speed_rad_s, age_s + self.branch_s)
        return Branch(speeds, s_rad, speeds.path.straight_rad(reached_rad + BEYOND_RAD))


class PathPlanning(Actor):
    """Keep a path to the next goal of the task, at each hull.

    The next second of the path is looked at; `Scene.due` says when another one is planned.  A
    moving arm goes over to it without a stop; an arm that is past the place where it should leave
    its path refuses the new one and brakes, and the next set plans again.  Without a way, or if
    someone is in the way to that place, the path has no waypoints and says why.  Predicted
    positions of people are avoided if another way exists.

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

    def __init__(self) -> None:
        super().__init__()
        self._obstacles: tuple[bytes, Obstacles] | None = None
        self._followed: tuple[Followed, ...] = ()
        self._waits = self._before = Waits()
        self._done = 0, 0
        """Set of the last step, and version of the path if that step stands."""

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
        scene, version = self._scene(lock), lock.version(self.path)
        captured_ns, planned = self._done
        if scene.captured_ns != captured_ns and version == planned:
            self._before = self._waits
        search, self._waits = scene.due(self._before, self.now_ns)
        path = self._sought(search, scene) if search is not None else None
        if path is not None:
            lock[self.path] = path
        self._done = scene.captured_ns, version + (path is not None)

    def _sought(self, search: Search, scene: Scene) -> Path | None:
        """Return the path that a search gives; None if the last one stays."""
        began_s = time.monotonic()
        found = search.found(scene, seed=self.seed + scene.number, limit_s=self.limit_s)
        self._waits = self._waits.after(found)
        if not search.is_news(found, scene.last):
            return None
        took_ms = 1e3 * (time.monotonic() - began_s)
        path, branch = search.path(found, scene, self.now_ns(), took_ms), search.branch
        if branch is not None and len(path.waypoints):
            onto = branch.onto(path, scene.model)
            self._followed += (Followed(path.identity, onto, branch.speeds),)
        return path

    def _scene(self, lock: Lock) -> Scene:
        """Return what is known; what is the same as before is worked out once."""
        model, grid, hull = lock[self.model], lock[self.grid], lock[self.hull]
        boxes = [np.reshape(one, (-1, 15)) for _, one in sorted(lock[self.boxes].items())]
        rows = np.concatenate([np.empty((0, 15)), *boxes])
        size = np.array([grid.voxel_m, *grid.shape])
        parts = (rows, model.dh, model.base, model.capsules, grid.origin_m, size)
        made_of = b"".join(part.tobytes() for part in parts)
        if self._obstacles is None or self._obstacles[0] != made_of:
            self._obstacles = made_of, Obstacles(model, grid, rows)
        obstacles, last, done = self._obstacles[1], lock.get(self.path), lock.get(self.execution)
        followed, refusal = None, ""
        if last is not None and len(last.waypoints):
            known = (one for one in self._followed if one.path == last.identity)
            followed = next(known, None) or Followed.from_rest(last, model)
            self._followed = (followed,)
            if done is not None and done.refused_path == last.identity:
                refusal = done.path_refusal
        predictions = list(lock[self.predictions].values()) if self.predict else []
        now = obstacles.around(hull, [], 0.0)
        return Scene(
            model=model,
            joints=lock[self.joints],
            task=lock[self.task],
            last=last,
            refusal=refusal,
            followed=followed,
            obstacles=obstacles,
            now=now,
            soon=obstacles.around(hull, predictions, SOON_S) if predictions else now,
            later=obstacles.around(hull, predictions, np.inf) if predictions else now,
            captured_ns=lock.stamp_ns(self.hull),
            ahead_s=self.ahead_s,
            branch_s=self.branch_s,
        )


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
