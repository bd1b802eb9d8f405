"""Collision-free paths between two states of an arm: RRT-Connect, then shortcuts.

Every question *is this free?* is asked for many states at once, since one state costs half as much
as sixty: OMPL's planner asks for whole edges, and shortcuts are tried several at a time.

Kuffner and LaValle, *RRT-Connect: an efficient approach to single-query path planning*, 2000, as
implemented by OMPL.
"""

from __future__ import annotations

import itertools
import time
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from actors.geometry.arms.joint_paths import JointPath

if TYPE_CHECKING:
    from collections.abc import Callable

    import numpy.typing as npt

    F64 = npt.NDArray[np.float64]
    Free = Callable[[F64], npt.NDArray[np.bool_]]

STEP_RAD: Final = 0.02
"""Distance of the states that are looked at; between two of them no point of an arm with a reach of
1.3 m moves by more than 3.5 cm, so what is nearer than half of that must not count as free."""
RANGE_RAD: Final = 0.8
"""Longest edge of the trees."""
QUESTIONS_MAX: Final = 4000
"""Edges and states after which the search ends, however much time is left."""
CANDIDATES: Final = 8
"""Shortcuts that are tried together."""
TURNS_RAD: Final = (0.4, 0.2, 0.1, 0.05)
"""How far a path that has to begin straight on may do so before it turns."""


@dataclass(frozen=True, slots=True, eq=False)
class Plan:
    """The result of a search.

    Attributes:
        waypoints: (k, n) rad; (0, n) if there is no path.
        reason: Why there is no path; empty if there is one.
        questions: Number of collision checks of the search.
    """

    waypoints: F64
    reason: str
    questions: int


def plan(
    start_rad: F64,
    goal_rad: F64,
    free: Free,
    passable: Free,
    *,
    q_max_rad: F64,
    seed: int,
    limit_s: float,
    heading: F64 | None = None,
) -> Plan:
    """Return a path from one state to another.

    The same seed gives the same path, unless `limit_s` ends the search or the shortcuts.

    Args:
        start_rad: (n,).
        goal_rad: (n,).
        free: (m, n) states → (m,) bool, which of them are free.
        passable: The same with less margin, by which the rounded path is judged.  With the same
            margin a path along the edge of what is free would fail between the states that were
            looked at.
        q_max_rad: (n,), limits of the joints, symmetric.
        seed: Of the search, >= 1.
        limit_s: Longest time that search and shortcuts take, each half of it.
        heading: (n,), the direction of length 1 in which the path begins, so that an arm that moves
            can go over to it; None: any.

    Raises:
        ValueError: `seed` is less than 1.
    """
    if seed < 1:
        raise ValueError(f"the seed is {seed}; OMPL takes seeds from 1 on")
    none = np.empty((0, len(start_rad)))
    ends = free(np.stack([start_rad, goal_rad]))
    if not ends.all():
        return Plan(none, f"the {'goal' if ends[0] else 'arm'} is where something is in the way", 1)
    began_s = time.monotonic()
    before, questions = none, 2
    if heading is not None:
        turn_rad, asked = _turn(start_rad, goal_rad, heading, free)
        if turn_rad is None:
            return Plan(none, "the arm cannot turn before what is in the way", questions + asked)
        before, start_rad, questions = start_rad[None], turn_rad, questions + asked
    found = np.stack([start_rad, goal_rad])
    if not free(_states(found)).all():
        solved, asked = _rrt_connect(start_rad, goal_rad, free, q_max_rad, seed, limit_s / 2.0)
        questions += asked
        if solved is None:
            return Plan(none, "no path was found", questions)
        left_s = limit_s - (time.monotonic() - began_s)
        found = shortened(solved, free, seed=seed, limit_s=left_s)
    rounded = _with_free_corners(np.concatenate([before, found]), passable)
    if rounded is None:
        return Plan(none, "no path was found whose corners are free", questions)
    return Plan(rounded, "", questions)


def _turn(start_rad: F64, goal_rad: F64, heading: F64, free: Free) -> tuple[F64 | None, int]:
    """Return where a path that begins straight on can turn, if anywhere, and what was asked.

    The farther it is, the rounder is the corner; one from which the goal lies straight ahead is
    best.
    """
    most_rad = float(np.linalg.norm(goal_rad - start_rad)) / 2.0
    best, asked = None, 0
    for lead_rad in TURNS_RAD:
        if lead_rad > most_rad:
            continue
        turn_rad = start_rad + lead_rad * heading
        straight = free(_states(np.stack([start_rad, turn_rad]))).all()
        asked += 1
        if not straight:
            continue
        best = turn_rad if best is None else best
        asked += 1
        if free(_states(np.stack([turn_rad, goal_rad]))).all():
            return turn_rad, asked
    return best, asked


def shortened(waypoints: F64, free: Free, *, seed: int, limit_s: float) -> F64:
    """Return a path that goes straight where it can."""
    draw = np.random.default_rng(seed)
    end_s, idle = time.monotonic() + limit_s, 0
    while len(waypoints) > 2 and idle < 4 and time.monotonic() < end_s:
        path = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(waypoints, axis=0), axis=1))]
        cuts = np.sort(draw.uniform(0.0, path[-1], (CANDIDATES, 2)), axis=1)
        cuts[0] = 0.0, path[-1]
        ends = np.stack(
            [
                np.stack([np.interp(cuts[:, k], path, joint) for joint in waypoints.T], -1)
                for k in (0, 1)
            ],
            1,
        )
        edges = [_states(pair) for pair in ends]
        which = np.repeat(np.arange(CANDIDATES), [len(edge) for edge in edges])
        blocked = np.bincount(which[~free(np.concatenate(edges))], minlength=CANDIDATES) > 0
        saved = cuts[:, 1] - cuts[:, 0] - np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
        saved[blocked] = 0.0
        best = int(np.argmax(saved))
        if saved[best] < 1e-3:
            idle += 1
            continue
        idle = 0
        kept_before = waypoints[path < cuts[best, 0] - 1e-9]
        kept_behind = waypoints[path > cuts[best, 1] + 1e-9]
        waypoints = np.concatenate([kept_before, ends[best], kept_behind])
    return waypoints


def _states(waypoints: F64) -> F64:
    """Return states along a polyline, `STEP_RAD` apart or less."""
    parts = [waypoints[:1]]
    for one, other in itertools.pairwise(waypoints):
        count = max(1, int(np.ceil(np.linalg.norm(other - one) / STEP_RAD)))
        parts.append(one + (other - one) * (np.arange(1, count + 1) / count)[:, None])
    return np.concatenate(parts)


def _with_free_corners(waypoints: F64, passable: Free) -> F64 | None:
    """Return waypoints whose rounded path is free of collisions, or None.

    A point halfway into a rounding on each side of its corner makes it half as wide.
    """
    for _ in range(6):
        path = JointPath(waypoints)
        count = max(2, int(np.ceil(path.length_rad / STEP_RAD)) + 1)
        at_rad = np.linspace(0.0, path.length_rad, count)
        blocked_rad = at_rad[~passable(path.at(at_rad)[0])]
        if not len(blocked_rad):
            return path.waypoints
        corner_rad = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(path.waypoints, axis=0), axis=1))]
        points = []
        for corner, there, reach in zip(path.waypoints, corner_rad, path.corner_rad, strict=True):
            if (np.abs(blocked_rad - there) < reach).any():
                q = path.waypoints
                points += [_along(q, corner_rad, there - reach / 2.0), corner]
                points += [_along(q, corner_rad, there + reach / 2.0)]
            else:
                points.append(corner)
        if len(points) == len(waypoints):
            return None  # not because of a corner
        waypoints = np.stack(points)
    return None


def _along(waypoints: F64, at_rad: F64, place_rad: float) -> F64:
    """Return the state at a place of a polyline."""
    return np.array([np.interp(place_rad, at_rad, joint) for joint in waypoints.T])


def load() -> None:
    """Load OMPL, which takes half a second, before the first search."""
    _ompl()


@lru_cache(maxsize=1)
def _ompl() -> tuple[Any, Any, Any]:
    """Load OMPL once, without its log: a new seed is intended, and failures are returned."""
    from ompl import base, geometric, util

    util.setLogLevel(util.LogLevel.LOG_NONE)
    return base, geometric, util


def _rrt_connect(
    start_rad: F64, goal_rad: F64, free: Free, q_max_rad: F64, seed: int, limit_s: float
) -> tuple[F64 | None, int]:
    """Return waypoints of the first path that is found, or None, and the number of questions."""
    base, geometric, util = _ompl()
    util.RNG.setSeed(seed)
    joints, asked = len(start_rad), 0
    space, bounds = base.RealVectorStateSpace(joints), base.RealVectorBounds(joints)
    for joint, greatest in enumerate(q_max_rad):
        bounds.setLow(joint, -float(greatest))
        bounds.setHigh(joint, float(greatest))
    space.setBounds(bounds)
    about = base.SpaceInformation(space)

    def values(state: Any) -> F64:
        return np.array([state[joint] for joint in range(joints)])

    def is_free(state: Any) -> bool:
        nonlocal asked
        asked += 1
        return bool(free(values(state)[None])[0])

    class Edges(base.MotionValidator):  # type: ignore[misc, name-defined]  # OMPL has no types
        def checkMotion(self, one: Any, other: Any, *_: Any) -> bool:  # noqa: N802 (OMPL's name)
            nonlocal asked
            asked += 1
            return bool(free(_states(np.stack([values(one), values(other)]))).all())

    about.setStateValidityChecker(is_free)
    edges = Edges(about)
    about.setMotionValidator(edges)
    about.setup()
    problem = base.ProblemDefinition(about)
    ends = [space.allocState(), space.allocState()]
    for state, value in zip(ends, (start_rad, goal_rad), strict=True):
        for joint in range(joints):
            state[joint] = float(value[joint])
    problem.setStartAndGoalStates(*ends)
    planner = geometric.RRTConnect(about)
    planner.setProblemDefinition(problem)
    planner.setRange(RANGE_RAD)
    planner.setup()
    end_s = time.monotonic() + limit_s
    planner.solve(
        base.PlannerTerminationCondition(
            lambda: asked >= QUESTIONS_MAX or time.monotonic() >= end_s
        )
    )
    if not problem.hasExactSolution():
        return None, asked
    path = problem.getSolutionPath()
    return np.stack([values(path.getState(k)) for k in range(path.getStateCount())]), asked
