"""The truth of a run: bodies, distances and speeds at any stamp, of the scenario and the joints."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from actors.geometry.arms.kinematics import capsules_at, end_velocities
from actors.geometry.capsules import distance_between, distance_to_points
from actors.geometry.separation import Separation
from actors.workcell import vocabulary as words
from actors.workcell.scenarios import Thing, scenario_of
from actors.workcell.scores.trace import TRUTH
from actors.workcell.simulation.human import Person

if TYPE_CHECKING:
    import numpy.typing as npt

    from actors.workcell.scenarios import Scenario
    from actors.workcell.scores.trace import Trace

    F64 = npt.NDArray[np.float64]
    Moving = tuple[F64, F64, F64]

RESTING_M_S: Final = 0.02
"""Slower than this the arm is at rest: what the limit of jerk leaves at the end of a stop."""
AHEAD_S: Final = 0.5
"""How far ahead a prediction is scored."""
SILENT_NS: Final = 250_000_000
"""After so long without a command the robot brakes, whatever the last one was."""


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """What really was.

    Attributes:
        scenario: What was played.
        arm: The arm.
        people: Everybody who comes.
        things: Boxes that are left.
        start_ns: Stamp of second 0.
        seconds: How long it lasts.
        low_m: x and y from which on the workspace reaches.
        high_m: x and y up to which it does.
    """

    scenario: Scenario
    arm: words.ArmModel
    people: tuple[Person, ...]
    things: tuple[Thing, ...]
    start_ns: int
    seconds: float
    low_m: F64
    high_m: F64

    @property
    def ticks(self) -> int:
        """How many exposures the scenario has."""
        return math.ceil(self.seconds / words.PERIOD_S)

    def covers(self, stamp_ns: int) -> bool:
        """Say whether a stamp lies in the scenario."""
        return 0 <= stamp_ns - self.start_ns < self.ticks * words.PERIOD_NS

    def at_s(self, stamp_ns: int) -> float:
        """Return the second of the scenario."""
        return (stamp_ns - self.start_ns) / 1e9

    def bodies_at(self, stamp_ns: int) -> list[F64]:
        """Return the bodies of who is there, each (17, 7) capsules."""
        bodies = (person.capsules_at(self.at_s(stamp_ns)) for person in self.people)
        return [body for body in bodies if body is not None]

    def over(self, points_m: F64, beyond_m: F64 | float = 0.0) -> npt.NDArray[np.bool_]:
        """Say which points (..., 2) lie over the workspace, grown by `beyond_m` on each side."""
        low_m, high_m = self.low_m - beyond_m, self.high_m + beyond_m
        return np.asarray(((points_m > low_m) & (points_m < high_m)).all(-1))

    def inside(self, body: F64) -> bool:
        """Say whether all of a body lies over the workspace."""
        return bool(self._over(body).all())

    def _over(self, body: F64) -> npt.NDArray[np.bool_]:
        """Say of both ends of each capsule, (n, 2), whether all of it lies over the workspace."""
        ends = body[:, :6].reshape(-1, 2, 3)[..., :2]
        return self.over(ends, -body[:, None, 6:])

    def centres_at(self, stamp_ns: int) -> list[Moving]:
        """Return middle, velocity and middle half a second later of who is there."""
        now, found = self.at_s(stamp_ns), []
        for person in self.people:
            here, ahead, before, after = (
                person.centre_at(now + step) for step in (0.0, AHEAD_S, -0.05, 0.05)
            )
            if here is not None and ahead is not None and before is not None and after is not None:
                found.append((here, (after - before) / 0.1, ahead))
        return found

    def distance_to_things(self, points_m: F64, stamp_ns: int) -> F64:
        """Return the distance of points to the nearest box present at that time, metres."""
        nearest = np.full(len(points_m), np.inf)
        for thing in self.things:
            if self.at_s(stamp_ns) >= thing.from_s:
                beyond = np.abs(points_m - np.array(thing.centre_m)) - np.array(thing.half_m)
                nearest = np.minimum(nearest, np.linalg.norm(np.maximum(beyond, 0.0), axis=1))
        return nearest

    def distance_m(self, stamp_ns: int, q_rad: F64, *, over_workspace: bool = False) -> float:
        """Return the arm's distance to people and objects, metres; infinity if there are none.

        Args:
            stamp_ns: When.
            q_rad: (7,), the arm then.
            over_workspace: Only limbs over the workspace count, as no voxel lies elsewhere.
        """
        arm = capsules_at(self.arm, q_rad)[0]
        bodies = [
            distance_between(arm, body[self._over(body).all(1)] if over_workspace else body)
            for body in self.bodies_at(stamp_ns)
        ]
        things = [
            float(distance_to_points(arm, _surface(thing)).min())
            for thing in self.things
            if self.at_s(stamp_ns) >= thing.from_s
        ]
        return min([*bodies, *things], default=math.inf)


def truth_of(trace: Trace) -> Truth:
    """Return the truth of a run.

    Raises:
        ConfigError: The run has no word on what was played, no arm or no grid.
    """
    playing = trace.newest(words.SCENARIO.name, words.PLAYING, TRUTH)
    grid = trace.newest(words.WORKSPACE.name, words.GRID)
    scenario = scenario_of(playing.scenario, playing.seed, playing.seconds)
    return Truth(
        scenario=scenario,
        arm=trace.newest(words.ROBOT.name, words.MODEL),
        people=tuple(Person(walk) for walk in scenario.walks),
        things=scenario.things,
        start_ns=playing.start_ns,
        seconds=playing.seconds,
        low_m=grid.origin_m[:2],
        high_m=grid.origin_m[:2] + np.array(grid.shape[:2]) * grid.voxel_m,
    )


def _surface(thing: Thing, step_m: float = 0.03) -> F64:
    """Return points on and in a box, (n, 3), no farther apart than `step_m`."""
    axes = [
        np.linspace(middle - half, middle + half, max(2, math.ceil(2.0 * half / step_m) + 1))
        for middle, half in zip(thing.centre_m, thing.half_m, strict=True)
    ]
    return np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)


@dataclass(frozen=True, slots=True, eq=False)
class Course:
    """The arm at its samples in the scenario, and how far it truly was from people and objects.

    Attributes:
        stamp_ns: (n,) int64, increasing.
        dq: (n, 7) rad/s.
        fastest_m_s: (n,), speed of its quickest point.
        distance_m: (n,), infinity where nothing is there.
    """

    stamp_ns: npt.NDArray[np.int64]
    dq: F64
    fastest_m_s: F64
    distance_m: F64


def course_of(trace: Trace, truth: Truth, *, every: int = 1) -> Course:
    """Return the course of the arm over the scenario, at each so-many-th sample."""
    motion = trace.joints()
    covered = [truth.covers(int(stamp)) for stamp in motion.stamp_ns]
    chosen = np.flatnonzero(covered)[::every]
    stamps, q, dq = motion.stamp_ns[chosen], motion.q[chosen], motion.dq[chosen]
    fastest = np.empty(0)
    if len(q):
        fastest = np.linalg.norm(end_velocities(truth.arm, q, dq), axis=-1).max((1, 2))
    distances = [truth.distance_m(int(at), joints) for at, joints in zip(stamps, q, strict=True)]
    return Course(stamps, dq, fastest, np.array(distances))


def allowed_m_s(course: Course) -> F64:
    """Return the speed that ISO/TS 15066 allows at each true distance; T_r is used up."""
    spent = Separation(reaction_s=0.0)
    return np.array([spent.speed_max_m_s(float(distance)) for distance in course.distance_m])


def too_fast_of(trace: Trace, truth: Truth) -> F64:
    """Return 1 for each sample at which the arm was faster than `allowed_m_s`, 0 for others."""
    course = course_of(trace, truth)
    fast = course.fastest_m_s > np.maximum(allowed_m_s(course), RESTING_M_S)
    return fast.astype(np.float64)


def share_of(trace: Trace, truth: Truth) -> F64:
    """Return the share of the nominal speed at the end of each period, but those at a goal; (n,).

    It is 0 while no command reaches the robot.  Empty where the run has no robot.
    """
    done = sorted(
        (kept.datum for kept in trace.of(words.ROBOT.name, words.EXECUTION)),
        key=lambda one: one.received_ns,
    )
    if not done:
        return np.empty(0)
    received_ns = np.array([one.received_ns for one in done], np.int64)
    result: list[float] = []
    for at_ns in truth.start_ns + words.PERIOD_NS * np.arange(1, truth.ticks + 1):
        newest = int(np.searchsorted(received_ns, at_ns, side="right")) - 1
        if newest < 0 or at_ns - received_ns[newest] > SILENT_NS:
            result.append(0.0)
        elif done[newest].state != "dwelling":
            result.append(done[newest].scale)
    return np.array(result, np.float64)
