"""The robot's inner loop: along the newest path, no faster than the newest speed allows.

It runs in a thread of its own at 100 Hz and takes no lock: commands come in and states go out as
immutable values.  Time is an argument, so that tests and simulations run it as fast as they like.

Rules a change must keep:

1. Silence means stop.  The arm brakes fully once its newest command is older than the command's
   validity, counted from the exposure that the command is based on, whatever the reason.
2. A command is refused on arrival if its stamps are too old or in the future, or if it is based on
   an earlier exposure than the last one.  Ages are by the host's clock: when it is set, the newest
   command is forgotten.
3. The arm leaves a path at rest, or where it leads straight into the next one: there the arm goes
   over within all limits of both.  A path that the arm cannot come to any more is refused, and the
   arm brakes on the old one.
4. An arm that is not where it was commanded to be gets no more commands.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Protocol

import numpy as np

from actors.geometry.arms.joint_paths import (
    BRAKING_RAMP_S,
    STARTING_SHARE,
    JoinedPath,
    JointPath,
    PathFollower,
    PathSpeeds,
)
from actors.workcell.vocabulary import JOINTS_KEPT, NO_PATH, Execution, Joints

if TYPE_CHECKING:
    import numpy.typing as npt

    from actors.workcell.vocabulary import ArmModel, Path, Speed

    F64 = npt.NDArray[np.float64]

CYCLE_S: Final = 0.01
"""Period of the loop."""
ROBOT_S: Final = CYCLE_S + (1.0 + STARTING_SHARE) * BRAKING_RAMP_S
"""From the arrival of a command to full deceleration: one cycle, and the ramp from full
acceleration.  It is the robot's part of the reaction time T_r."""
NOMINAL_M_S: Final = 1.5
"""Greatest speed of the quickest point of the arm while no person is near."""
BRAKING_M_S2: Final = 6.0
"""Deceleration of that point on which the protective distance counts."""
BESIDE_RAD: Final = 0.02
"""So far from where the arm is may a path begin."""
FUTURE_NS: Final = 20_000_000
"""So far ahead of this host's clock may a stamp be."""
FOLLOWING_RAD: Final = 0.15
"""A joint that is farther than this from where it was commanded does not follow: at its greatest
speed a joint moves half of it in 30 ms."""
SET_NS: Final = 5_000_000
"""No clock drifts this much from one cycle to the next: it has been set."""
AT_ONCE_NS: Final = 1_000_000
"""Two clocks are compared if reading them took no longer."""


class HostClock:
    """Notices that the host's clock was set: ages by it are wrong then."""

    def __init__(self) -> None:
        self._ahead_ns: int | None = None

    def was_set(self, now_ns: int, before_ns: int, after_ns: int) -> bool:
        """Return whether the clock was set since the last call.

        Args:
            now_ns: The host's clock.
            before_ns: An earlier reading of a clock that cannot be set.
            after_ns: The same, read after.
        """
        if after_ns - before_ns > AT_ONCE_NS:
            return False
        ahead_ns = now_ns - before_ns
        last_ns, self._ahead_ns = self._ahead_ns, ahead_ns
        return last_ns is not None and abs(ahead_ns - last_ns) > SET_NS


class RobotDriver(Protocol):
    """What the loop needs of an arm.

    For a real arm, implement these over its interface for cyclic commands of joint positions
    (KUKA FRI, UR servoj, Franka joint position control): `command` is called every 10 ms with
    positions that keep the limits of the model.  The arm's own controller has to brake by itself
    when commands stay away, since a process can freeze.
    """

    def open(self, last_rad: F64 | None) -> F64:
        """Connect; return where the arm is, (7,) rad.

        Args:
            last_rad: Where it was when it was last published; a real arm ignores it.
        """
        ...

    def command(self, q_rad: F64, dq_rad_s: F64) -> tuple[F64, F64]:
        """Send the next position; return the measured position and speed, each (7,)."""
        ...

    def close(self) -> None:
        """Disconnect; the arm is at rest or brakes."""
        ...


class CommandedArm:
    """An arm that is where it is commanded to be: the robot of a simulated cell.

    Args:
        home_rad: Where it stands at the first start, 7 numbers; also as text with blanks.
    """

    def __init__(self, home_rad: str | tuple[float, ...] = "0 0.6 0 -1.3 0 0.9 0") -> None:
        values = home_rad.split() if isinstance(home_rad, str) else home_rad
        self._home = np.array([float(value) for value in values])
        if self._home.shape != (7,):
            raise ValueError(f"home_rad is {home_rad!r}; it must be 7 numbers")

    def open(self, last_rad: F64 | None) -> F64:
        """Return where it was last, or home."""
        return self._home if last_rad is None else np.asarray(last_rad, np.float64)

    def command(self, q_rad: F64, dq_rad_s: F64) -> tuple[F64, F64]:
        """Be there."""
        return q_rad, dq_rad_s

    def close(self) -> None:
        """Do nothing."""


@dataclass(frozen=True, slots=True, eq=False)
class Doing:
    """What the loop does now.

    Attributes:
        state: "moving", "dwelling", "waiting" (for a path), "stopped" (nothing may move).
        reason: Why it does not move.
        scale: Share of the nominal speed, 0 to 1.
        speed_m_s: Of the quickest capsule end.
        path_number: Path that it follows, -1 of none.
        goals_reached: Paths that it has followed to their ends.
    """

    state: str = "waiting"
    reason: str = "no path yet"
    scale: float = 0.0
    speed_m_s: float = 0.0
    path_number: int = -1
    goals_reached: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class _Seam:
    """Where an arm goes over from its path to another one, without a stop.

    Attributes:
        leaves: Follower of the path that the arm is on.
        from_rad: Where on that path `speeds` begins.
        at_rad: Where on it the other one begins.
        speeds: Along both.
    """

    leaves: PathFollower
    from_rad: float
    at_rad: float
    speeds: PathSpeeds

    def lies_ahead(self, follower: PathFollower | None) -> bool:
        """Say whether the arm still comes to it."""
        return follower is self.leaves and follower.s_rad <= self.at_rad

    def crossed(self, limit_m_s: float) -> PathFollower | None:
        """Return a follower of both paths; None while the arm is too fast for them."""
        here_rad = self.leaves.s_rad - self.from_rad
        return self.leaves.over_to(self.speeds, here_rad, limit_m_s)


@dataclass(frozen=True, slots=True, eq=False)
class _Asked:
    """A path that the arm shall follow.

    Attributes:
        path: The path.
        speeds: Along it, from its beginning.
        seam: Where the arm goes over to it without a stop; None: nowhere.
    """

    path: Path
    speeds: PathSpeeds
    seam: _Seam | None


class Motion:
    """The loop, one cycle at a time, see the module.

    Args:
        model: The arm.
        q_rad: Where it is, (7,); it is at rest.
        now_ns: The time.

    Attributes:
        doing: What it does now.
        refused: Commands that it has refused.
        refused_path: Identity of the last path that it has refused.
        path_refusal: Why; empty if it has refused none.
    """

    def __init__(self, model: ArmModel, q_rad: F64, now_ns: int) -> None:
        self._model = model
        self.q_rad, self.dq_rad_s = np.array(q_rad, np.float64), np.zeros(len(q_rad))
        self._recent: tuple[tuple[int, F64, F64], ...] = ((now_ns, self.q_rad, self.dq_rad_s),)
        self._speed: Speed | None = None
        self._asked: _Asked | None = None
        self._path_captured_ns = 0
        self._followed: Path | None = None
        self._follower: PathFollower | None = None
        self._cut_for: Path | None = None
        self._reached = False
        self._silence = "no speed has been commanded"
        self.doing, self.refused = Doing(), 0
        self.refused_path, self.path_refusal = NO_PATH, ""

    def obey(self, speed: Speed, now_ns: int) -> str:
        """Take a command.

        Returns:
            Why it is refused; empty if it is taken.
        """
        age_ms = (now_ns - speed.captured_ns) / 1e6
        if not (age_ms <= speed.valid_ms and math.isfinite(speed.valid_ms)):
            why = f"the command is {age_ms:.0f} ms old, {speed.valid_ms:.0f} are allowed"
        elif age_ms * 1e6 < -FUTURE_NS:
            why = f"the command is {-age_ms:.0f} ms ahead of this host's clock"
        elif self._speed is not None and speed.captured_ns < self._speed.captured_ns:
            why = "the command rests on an earlier exposure than the last"
        else:
            self._speed = speed
            return ""
        self.refused += 1
        return why

    def follow(self, path: Path, now_ns: int) -> None:
        """Take a path; one without waypoints ends the motion where it can stop.

        A path on an earlier exposure than the last one, or on one that is still to come, is
        refused, see `path_refusal`.
        """
        asked = self._asked
        if path.identity in (self.refused_path, asked.path.identity if asked else None):
            return
        ahead_ns = path.captured_ns - now_ns
        if ahead_ns > FUTURE_NS:
            why = f"it rests on images {ahead_ns / 1e6:.0f} ms ahead of this host's clock"
            self._refuse(path, why)
            return
        if path.captured_ns < self._path_captured_ns:
            self._refuse(path, "it rests on an earlier exposure than the last path")
            return
        waypoints = path.waypoints if len(path.waypoints) else self.q_rad[None]
        line = JointPath(waypoints)
        speeds = PathSpeeds(self._model, line, nominal_m_s=NOMINAL_M_S)
        self._path_captured_ns = path.captured_ns
        self._asked = _Asked(path, speeds, self._seam(speeds))

    def _seam(self, speeds: PathSpeeds) -> _Seam | None:
        """Return where the path of the arm leads straight into another one, if it does."""
        follower = self._follower
        if follower is None or speeds.path.length_rad == 0.0:
            return None
        from_rad, line = follower.s_rad, follower.speeds.path
        at_rad = line.nearest_rad(speeds.path.at(0.0)[0][0], from_rad)
        if not line.leads_into(at_rad, speeds.path):
            return None
        both = JoinedPath(line, from_rad, at_rad, speeds.path)
        joined = PathSpeeds(self._model, both, nominal_m_s=NOMINAL_M_S)
        return _Seam(follower, from_rad, at_rad, joined)

    def silence(self, reason: str) -> None:
        """Forget the newest command and stamp: the arm brakes and rests until another one comes."""
        self._speed, self._silence, self._path_captured_ns = None, reason, 0

    def cycle(self, now_ns: int) -> None:
        """Do what is to be done in one period of the loop."""
        limit_m_s, why = self._limit(now_ns)
        limit_m_s = self._change_path(limit_m_s)
        follower = self._follower
        if follower is not None:
            follower.step(limit_m_s)
            q, dq, _ = follower.speeds.path.at(follower.s_rad)
            self.q_rad, self.dq_rad_s = q[0], dq[0] * follower.speed_rad_s
        self._tell(why)

    def measured(self, q_rad: F64, dq_rad_s: F64, now_ns: int) -> None:
        """Keep what the arm has measured.

        Raises:
            RuntimeError: The arm is not where it was commanded, or does not say where it is.
        """
        off_rad = np.abs(q_rad - self.q_rad)
        if not (off_rad <= FOLLOWING_RAD).all():
            joint = int(np.argmax(np.where(np.isfinite(off_rad), off_rad, np.inf)))
            raise RuntimeError(
                f"joint {joint + 1} is {off_rad[joint]:.2f} rad from where it was commanded; at"
                f" most {FOLLOWING_RAD} is allowed; check the arm, then restart it"
            )
        self._recent = (*self._recent[1 - JOINTS_KEPT :], (now_ns, q_rad, dq_rad_s))

    def joints(self) -> Joints:
        """Return the last 0.3 s; until they have passed, the first sample fills the gap."""
        recent = self._recent
        missing = JOINTS_KEPT - len(recent)
        first_ns = recent[0][0]
        step_ns = round(CYCLE_S * 1e9)
        stamps = [first_ns - step_ns * k for k in range(missing, 0, -1)]
        return Joints(
            q=np.stack([recent[0][1]] * missing + [q for _, q, _ in recent]),
            dq=np.stack([np.zeros_like(recent[0][2])] * missing + [dq for _, _, dq in recent]),
            stamp_ns=np.array(stamps + [stamp for stamp, _, _ in recent], np.int64),
        )

    def execution(self, captured_ns: int, received_ns: int, refusal: str) -> Execution:
        """Return what came of the newest command.

        Args:
            captured_ns: Exposure on which it rests.
            received_ns: When it came.
            refusal: Why it was refused; empty if it was taken.
        """
        doing = self.doing
        return Execution(
            state="refused" if refusal else doing.state,
            scale=doing.scale,
            speed_m_s=doing.speed_m_s,
            captured_ns=captured_ns,
            received_ns=received_ns,
            path_number=doing.path_number,
            goals_reached=doing.goals_reached,
            refused=self.refused,
            reason=refusal or doing.reason,
            refused_path=self.refused_path,
            path_refusal=self.path_refusal,
        )

    def _limit(self, now_ns: int) -> tuple[float, str]:
        """Return the speed allowed now, and the reason if it is zero."""
        speed = self._speed
        if speed is None:
            return 0.0, self._silence
        age_ms = (now_ns - speed.captured_ns) / 1e6
        if age_ms > speed.valid_ms or age_ms * 1e6 < -FUTURE_NS:
            return 0.0, f"the newest command is {age_ms:.0f} ms old"
        if speed.scale <= 0.0 or not speed.limit_m_s > 0.0:
            return 0.0, speed.reason
        return speed.limit_m_s, ""

    def _change_path(self, limit_m_s: float) -> float:
        """Go over to the newest path where that can be; return the limit until then."""
        asked, follower = self._asked, self._follower
        if asked is None or asked.path is self._followed:
            return limit_m_s
        path, speeds = asked.path, asked.speeds
        at_rest = follower is None or follower.speed_rad_s == 0.0
        if not len(path.waypoints) or path.identity == self.refused_path:
            if at_rest:
                self._follow(path, None)
            return 0.0
        if asked.seam is not None and asked.seam.lies_ahead(follower):
            crossed = asked.seam.crossed(limit_m_s)
            if crossed is not None:
                self._follow(path, crossed)
            return limit_m_s if crossed is not None else 0.0
        beside_rad = float(np.linalg.norm(path.waypoints[0] - self.q_rad))
        if at_rest and beside_rad <= 1.5 * BESIDE_RAD:
            if beside_rad > 1e-9:
                line = JointPath(np.vstack([self.q_rad, path.waypoints]))
                speeds = PathSpeeds(self._model, line, nominal_m_s=NOMINAL_M_S)
            begun = PathFollower(speeds, cycle_s=CYCLE_S, braking_m_s2=BRAKING_M_S2)
            self._follow(path, begun)
            return limit_m_s
        if follower is not None and self._ends_there(follower, path):
            return limit_m_s
        self._refuse(path, self._astray(path))
        if at_rest:
            self._follow(path, None)
        return 0.0

    def _astray(self, path: Path) -> str:
        """Say why the arm cannot come to a path from where it is."""
        follower, followed = self._follower, self._followed
        if follower is not None and followed is not None:
            line, start = follower.speeds.path, path.waypoints[0]
            place_rad = line.nearest_rad(start)
            if np.linalg.norm(line.at(place_rad)[0][0] - start) <= BESIDE_RAD:
                cannot = "cannot stop at" if place_rad > follower.s_rad else "has passed"
                return f"the arm {cannot} the place where it leaves path {followed.number}"
        return "it starts elsewhere"

    def _refuse(self, path: Path, why: str) -> None:
        """Keep which path is refused, and why."""
        self.refused_path = path.identity
        self.path_refusal = f"path {path.number} is refused: {why}"

    def _ends_there(self, follower: PathFollower, path: Path) -> bool:
        """Let the present path end where the next one begins; False if it does not lead there."""
        if self._cut_for is not path:
            line, start = follower.speeds.path, path.waypoints[0]
            place_rad = line.nearest_rad(start)
            beside_rad = np.linalg.norm(line.at(place_rad)[0][0] - start)
            if beside_rad > BESIDE_RAD or not follower.end_at(place_rad):
                return False
            self._cut_for = path
        return True

    def _follow(self, path: Path, follower: PathFollower | None) -> None:
        """Follow a path, or none."""
        self._followed, self._cut_for, self._reached = path, None, False
        self._follower = follower

    def _number(self) -> int:
        followed = self._followed
        return followed.number if followed is not None and self._follower is not None else -1

    def _tell(self, why: str) -> None:
        follower, reached = self._follower, self.doing.goals_reached
        if follower is None:
            path = self._followed
            reason = "no path yet" if path is None else path.reason
            if path is not None and path.identity == self.refused_path:
                reason = self.path_refusal
            self.doing = Doing("waiting", reason, 0.0, 0.0, -1, reached)
        elif follower.arrived:
            if not self._reached and self._cut_for is None:
                self._reached, reached = True, reached + 1
            self.doing = Doing("dwelling", "", 0.0, 0.0, self._number(), reached)
        elif why and follower.speed_rad_s == 0.0:
            self.doing = Doing("stopped", why, 0.0, 0.0, self._number(), reached)
        else:
            speed = follower.share, follower.speed_m_s
            self.doing = Doing("moving", why, *speed, self._number(), reached)
