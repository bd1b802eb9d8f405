"""Speed control: how fast the robot may be, by speed and separation monitoring (ENACT 4.1)."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from actors.geometry.arms.joint_paths import JointPath, PathSpeeds
from actors.geometry.arms.kinematics import capsules_at
from actors.geometry.capsules import bounds
from actors.geometry.separation import Reaction, Separation
from actors.workcell.motion import BRAKING_M_S2, FUTURE_NS, NOMINAL_M_S, ROBOT_S
from actors.workcell.vocabulary import (
    CAMERA_STATES,
    GRID,
    HULL,
    JOINTS,
    MODEL,
    PATH,
    PERIOD_S,
    ROBOT,
    SAFETY,
    SPEED,
    SYSTEM,
    WORKSPACE,
    Safety,
    Speed,
)
from actors.workcell.watch import MISFIT
from enact_dist import Actor, View, World, Write

if TYPE_CHECKING:
    from collections.abc import Mapping

    from actors.workcell.vocabulary import ArmModel, CameraState, Grid, Joints, Path
    from enact_dist import Lock

MISFITS_MAX = 2
"""More cameras than this whose background no longer fits are a fault."""
STATES_S = 0.5
"""Older states of the cameras tell nothing: their misfits would stay what they were."""
AHEAD_S = 0.15
"""How far along the path the share of the nominal speed is worked out."""


@dataclass(frozen=True, slots=True)
class Verdict:
    """What the cell may do.

    Attributes:
        state: "run", "slow", "stop" or "fault".
        limit_m_s: Greatest speed of the quickest point of the arm.
        cause: Why, without figures: what changes only when the cause does.
        reason: Why, with figures.
    """

    state: str
    limit_m_s: float
    cause: str
    reason: str

    def share_of(self, nominal_m_s: float) -> float:
        """Return the share of a speed that is allowed, 0 to 1."""
        return min(1.0, self.limit_m_s / nominal_m_s) if self.limit_m_s else 0.0


def judged(
    *,
    nearest_m: float,
    age_s: float,
    joints_age_s: float,
    nominal_m_s: float,
    separation: Separation,
    latest_s: float,
    states_age_s: float,
    misfits: int = 0,
    without_path: str = "",
) -> Verdict:
    """Return what follows from a set of images.

    Args:
        nearest_m: Distance from occupied space to the robot at the exposure.
        age_s: Present age of the exposure.
        joints_age_s: Age of the newest joint sample at the exposure.
        nominal_m_s: Speed of the fastest point on the path without a limit.
        separation: The quantities of the protective distance.
        latest_s: Oldest exposure, and oldest sample of the joints, on which the robot may move.
        states_age_s: Age of the cameras' states at the exposure; infinite if there are none.
        misfits: Cameras whose background no longer fits.
        without_path: Why there is no path; empty if there is one.

    Raises:
        ValueError: The distance counts on more braking than the arm has.
    """
    if separation.braking_m_s2 > BRAKING_M_S2:
        raise ValueError(
            f"braking_m_s2 is {separation.braking_m_s2:g}; the arm's loop brakes with"
            f" {BRAKING_M_S2:g} m/s², and no distance may count on more"
        )
    if misfits > MISFITS_MAX:
        cause = f"the {MISFIT}"
        return Verdict("fault", 0.0, cause, f"{cause} in {misfits} cameras")
    if age_s < -FUTURE_NS / 1e9:
        cause = "the cameras' clock is ahead"
        text = f"the newest set is {-1e3 * age_s:.0f} ms ahead of this host's clock"
        return Verdict("fault", 0.0, cause, text)
    if states_age_s > STATES_S:
        cause = "the camera watch is silent"
        text = "CameraWatch has not written the state of the cameras"
        if states_age_s < math.inf:
            text += f" in the {1e3 * states_age_s:.0f} ms before the exposure"
        return Verdict("fault", 0.0, cause, text)
    if joints_age_s > latest_s:
        cause = "the robot does not tell where it is"
        text = f"no sample of its joints in the {1e3 * joints_age_s:.0f} ms before the exposure"
        return Verdict("fault", 0.0, cause, text)
    if age_s > latest_s:
        cause = "the images come late"
        return Verdict("stop", 0.0, cause, f"the newest set is {1e3 * age_s:.0f} ms old")
    limit_m_s = separation.speed_max_m_s(nearest_m)
    if limit_m_s <= 0.0:
        cause = "someone is too near"
        least_m = separation.protective_m(0.0)
        text = f"{nearest_m:.2f} m to the robot, {least_m:.2f} m are the least at rest"
        return Verdict("stop", 0.0, cause, text)
    if without_path:
        return Verdict("stop", limit_m_s, f"no path: {without_path}", without_path)
    if limit_m_s < nominal_m_s:
        text = f"{nearest_m:.2f} m to the robot allow {limit_m_s:.2f} m/s"
        return Verdict("slow", limit_m_s, "someone is near", text)
    near = "no person is there" if math.isinf(nearest_m) else f"{nearest_m:.2f} m to the robot"
    return Verdict("run", limit_m_s, "", near)


class SpeedControl(Actor):
    """Attach to the robot how fast it may be, at each hull.

    The protective distance is that of ISO/TS 15066 5.5.4.  Its reaction time is measured: the
    greatest age of the images of the last minute, one period, and the robot's own time.  The
    command is valid for just that time, so the robot brakes before it would be exceeded.

    The speed rests on the hull, the robot's joints, and the state of the cameras; it carries the
    stamp of the exposure.
    """

    online = World("online")
    hull = View(online, WORKSPACE, HULL)
    joints = View(online, ROBOT, JOINTS)
    path = View(online, ROBOT, PATH)
    model = View(online, ROBOT, MODEL)
    grid = View(online, WORKSPACE, GRID)
    cameras = View(online, SYSTEM, CAMERA_STATES)
    speed = Write(online, ROBOT, SPEED)
    safety = Write(online, SYSTEM, SAFETY)
    triggers = (hull,)

    human_m_s: float = 1.6
    braking_m_s2: float = BRAKING_M_S2
    intrusion_m: float = 0.10
    uncertainty_m: float = 0.05
    latest_s: float = 0.25
    """Oldest exposure on which the robot may move, whatever was measured."""
    open_sides: bool = False
    """People can stand right beside the watched volume, where no voxel is: the robot then keeps the
    protective distance from the volume's sides, too."""

    def __init__(self) -> None:
        self._reaction = Reaction(period_s=PERIOD_S, robot_s=ROBOT_S)
        self._speeds: tuple[object, PathSpeeds] | None = None

    def now_ns(self) -> int:
        """Return the time, ns since 1970; a simulation has its own."""
        return time.time_ns()

    def update(self, lock: Lock) -> None:
        """Judge the newest hull."""
        hull, captured_ns = lock[self.hull], lock.stamp_ns(self.hull)
        joints, path, model = lock.get(self.joints), lock.get(self.path), lock.get(self.model)
        age_s, reaction = (self.now_ns() - captured_ns) / 1e9, self._reaction
        reaction.latest_s = self.latest_s
        reaction.seen(captured_ns, age_s)
        joints_ns = int(joints.stamp_ns[-1]) if joints is not None else 0
        states_ns = -math.inf if lock.is_null(self.cameras) else lock.stamp_ns(self.cameras)
        misfits, without = troubles_of(lock.get(self.cameras, {}))
        nearest_m = hull.nearest_m
        if self.open_sides:
            nearest_m = min(nearest_m, distance_to_sides_m(lock.get(self.grid), model, joints))
        nominal_m_s = self._nominal_m_s(model, path, joints)
        human_m_s, by_whom = self.people_m_s(lock)
        verdict = judged(
            nearest_m=nearest_m,
            age_s=age_s,
            joints_age_s=max(0.0, (captured_ns - joints_ns) / 1e9),
            nominal_m_s=nominal_m_s,
            separation=Separation(
                reaction_s=reaction.reaction_s,
                human_m_s=human_m_s,
                braking_m_s2=self.braking_m_s2,
                intrusion_m=self.intrusion_m,
                uncertainty_m=self.uncertainty_m,
            ),
            latest_s=self.latest_s,
            states_age_s=max(0.0, (captured_ns - states_ns) / 1e9),
            misfits=misfits,
            without_path=_missing(path),
        )
        lock[self.speed] = Speed(
            scale=verdict.share_of(nominal_m_s),
            limit_m_s=verdict.limit_m_s,
            nearest_m=hull.nearest_m,
            reason="; ".join(filter(None, (verdict.reason, by_whom, without))),
            valid_ms=1e3 * reaction.valid_s,
            captured_ns=captured_ns,
            joints_ns=joints_ns,
            human_m_s=human_m_s,
        )
        last = lock.get(self.safety)
        said = verdict.state, verdict.cause + (without and f"; {without}")
        if last is None or (last.state, last.reason) != said:
            lock[self.safety] = Safety(*said, since_ns=captured_ns)

    def people_m_s(self, lock: Lock) -> tuple[float, str]:
        """Return how fast people count, and why; nothing where it is assumed."""
        return self.human_m_s, ""

    def _nominal_m_s(
        self, model: ArmModel | None, path: Path | None, joints: Joints | None
    ) -> float:
        """Return how fast the robot would be where it is on its path, nothing limiting."""
        if model is None or joints is None or path is None or not len(path.waypoints):
            return NOMINAL_M_S
        if self._speeds is None or self._speeds[0] != path.identity:
            line = JointPath(path.waypoints)
            self._speeds = path.identity, PathSpeeds(model, line, nominal_m_s=NOMINAL_M_S)
        speeds = self._speeds[1]
        return speeds.nominal_m_s(speeds.path.nearest_rad(joints.q[-1]), AHEAD_S)


def troubles_of(states: Mapping[str, CameraState]) -> tuple[int, str]:
    """Return how many cameras no longer fit their background, and which do not see, in words."""
    misfits = sum(state.trouble == MISFIT for state in states.values())
    blind = [name for name, state in sorted(states.items()) if not state.alive]
    return misfits, f"without {', '.join(blind)}" if blind else ""


def distance_to_sides_m(grid: Grid | None, model: ArmModel | None, joints: Joints | None) -> float:
    """Return how far the arm is from the sides of the watched volume; 0 while that is not known."""
    if grid is None or model is None or joints is None:
        return 0.0
    boxes = bounds(capsules_at(model, joints.q[-1])[0])[..., :2]
    high_m = grid.origin_m[:2] + grid.voxel_m * np.array(grid.shape[:2])
    low = (boxes[:, 0] - grid.origin_m[:2]).min()
    return float(min(low, (high_m - boxes[:, 1]).min()))


def _missing(path: Path | None) -> str:
    """Return the reason for a missing path; empty if there is a path."""
    if path is None:
        return "none is planned yet"
    return "" if len(path.waypoints) else path.reason
