"""Paths of the joints, and how fast an arm may be along them.

A path is a polyline through waypoints in joint space whose corners are rounded.  Its parameter `s`
is the length along the polyline, radians; the joints' velocity is q'(s) ds/dt, and |q'| <= 1.

Each corner is a Bézier curve of degree 4 with equally spaced control points
``P - r u, P - r u / 2, P, P + r v / 2, P + r v`` (u, v: directions before and behind): it leaves
and joins the lines with their direction, at unit speed and without curvature, so q, q' and q'' are
continuous, and |q''| <= 0.75 |v - u| / r.

Rules a change must keep: whatever the limit does, the arm stays on the path; it never goes back; a
lower limit is obeyed with full deceleration.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Final, Protocol

import numpy as np

from actors.geometry.arms.kinematics import Chain, end_velocities

if TYPE_CHECKING:
    import numpy.typing as npt

    F64 = npt.NDArray[np.float64]

CORNER_RAD: Final = 0.5
"""Greatest distance from a corner at which its rounding begins."""
GRID_RAD: Final = 0.01
"""Distance of the places along a path at which limits are worked out."""
BRAKING_SHARE: Final = 0.8
"""Of a joint's greatest acceleration; the rest is for the curvature of the path."""
BRAKING_RAMP_S: Final = 0.01
"""How long full deceleration takes to come: its limit of jerk."""
STARTING_RAMP_S: Final = 0.1
"""The same of acceleration."""
STARTING_SHARE: Final = 0.5
"""Acceleration along the path as a share of the deceleration."""
RELEASE_SHARE: Final = 0.05
"""Of the acceleration along the path: more does not follow at once on a deceleration."""
LAG_S: Final = 0.03
"""How much earlier the follower brakes than full deceleration needs."""
KEPT: Final = 0.97
"""Aim below a limit of speed: while the reach grows, the follower is a cycle behind."""
ARRIVED_RAD: Final = 2e-4
"""So near to its end a path is over."""
NEAR_RAD: Final = 0.02
"""Distance of the places among which the nearest one is sought first."""
GAP_RAD: Final = 1e-6
"""A path leads into another one if they lie no farther apart."""
BEND_LEAST: Final = 1e-3
"""Less curvature is none, rad/rad²."""
FAST_SHARE: Final = 1.02
"""How far a follower may be above a limit that lies ahead: while it brakes it is a cycle behind."""


class Arm(Chain, Protocol):
    """An arm with limits."""

    @property
    def q_max(self) -> F64:
        """(n,), rad; the limits are symmetric."""
        ...

    @property
    def dq_max(self) -> F64:
        """(n,), rad/s."""
        ...

    @property
    def ddq_max(self) -> F64:
        """(n,), rad/s²."""
        ...

    @property
    def payload_kg(self) -> float:
        """What its flange may carry: the hand and what it holds."""
        ...


class Line(ABC):
    """A curve of the joints by its parameter, 0 to `length_rad`.

    Attributes:
        length_rad: The greatest `s`.
    """

    length_rad: float

    @abstractmethod
    def at(self, s_rad: F64 | float) -> tuple[F64, F64, F64]:
        """Return q, q' and q'' at places along the path.

        Args:
            s_rad: (m,), or one; beyond the ends, the ends.

        Returns:
            Three (m, n): rad, rad/rad, rad/rad².
        """

    @abstractmethod
    def straight_rad(self, s_rad: float) -> float:
        """Return the first place from `s` on where the path is straight."""

    @property
    @abstractmethod
    def pieces(self) -> tuple[tuple[JointPath, float, float], ...]:
        """The paths that it is made of: each with where it begins on that path, and its length."""

    def nearest_rad(self, q_rad: F64, from_rad: float = 0.0) -> float:
        """Return the place that is nearest to a state of the joints, (n,), from a place on."""
        from_rad = float(np.clip(from_rad, 0.0, self.length_rad))
        count = int(np.ceil((self.length_rad - from_rad) / NEAR_RAD)) + 1
        places = np.linspace(from_rad, self.length_rad, count + 1)
        off = np.linalg.norm(self.at(places)[0] - q_rad, axis=1)
        place, least = float(places[np.argmin(off)]), float(off.min())
        for _ in range(6):
            q, dq, _ = self.at(place)
            along = float((q_rad - q[0]) @ dq[0] / max(float(dq[0] @ dq[0]), 1e-9))
            there = place + float(np.clip(along, -NEAR_RAD, NEAR_RAD))
            there = float(np.clip(there, from_rad, self.length_rad))
            now = float(np.linalg.norm(self.at(there)[0][0] - q_rad))
            if now >= least:
                break
            place, least = there, now
        return place

    def states(self, from_rad: float, to_rad: float, step_rad: float) -> F64:
        """Return states along a stretch of the path, both of its ends included, (m, n)."""
        count = max(2, int(np.ceil((to_rad - from_rad) / step_rad)) + 1)
        return self.at(np.linspace(from_rad, to_rad, count))[0]

    def leads_into(self, at_rad: float, other: Line) -> bool:
        """Say whether another path begins at a place of this one, straight on."""
        q, dq, ddq = self.at(at_rad)
        begins, heading, _ = other.at(0.0)
        gap = max(float(np.abs(q - begins).max()), float(np.abs(dq - heading).max()))
        return gap <= GAP_RAD and float(np.abs(ddq).max()) <= BEND_LEAST


class JointPath(Line):
    """A polyline with rounded corners, see the module.

    Args:
        waypoints: (k, n), rad, k >= 1; equal ones in a row count as one.

    Attributes:
        waypoints: (k, n), without repetitions.
        length_rad: The greatest `s`.

    Raises:
        ValueError: There is no waypoint, or one is not finite.
    """

    def __init__(self, waypoints: F64) -> None:
        points = np.array(waypoints, np.float64)
        if points.ndim != 2 or not len(points) or not np.isfinite(points).all():
            raise ValueError(f"waypoints of shape {points.shape}; (k >= 1, n) finite numbers, rad")
        moves = np.linalg.norm(np.diff(points, axis=0), axis=1) > 1e-6
        self.waypoints = points = points[np.r_[True, moves]]
        lengths = np.linalg.norm(np.diff(points, axis=0), axis=1)
        self._directions = np.diff(points, axis=0) / lengths[:, None]
        self._at_rad = np.r_[0.0, np.cumsum(lengths)]
        self.length_rad = float(self._at_rad[-1])
        corner = np.zeros(len(points))
        room = 0.5 * lengths
        room[:1], room[-1:] = lengths[:1], lengths[-1:]  # only one corner shares these
        corner[1:-1] = np.minimum(CORNER_RAD, np.minimum(room[:-1], room[1:]))
        self.corner_rad = corner

    def at(self, s_rad: F64 | float) -> tuple[F64, F64, F64]:
        """Return q, q' and q'' at places along the path.

        Args:
            s_rad: (m,), or one; beyond the ends, the ends.

        Returns:
            Three (m, n): rad, rad/rad, rad/rad².
        """
        s = np.clip(np.atleast_1d(np.asarray(s_rad, np.float64)), 0.0, self.length_rad)
        if len(self.waypoints) == 1:
            zero = np.zeros((len(s), self.waypoints.shape[1]))
            return self.waypoints + zero, zero, zero.copy()
        piece = np.searchsorted(self._at_rad, s, side="right") - 1
        piece = np.clip(piece, 0, len(self._directions) - 1)
        first = self._directions[piece]
        q = self.waypoints[piece] + (s - self._at_rad[piece])[:, None] * first
        dq, ddq = first.copy(), np.zeros_like(first)
        for corner in (piece, piece + 1):
            reach = self.corner_rad[corner]
            inside = np.abs(s - self._at_rad[corner]) < reach
            if inside.any():
                q[inside], dq[inside], ddq[inside] = self._rounded(corner[inside], s[inside])
        return q, dq, ddq

    def _rounded(self, corner: npt.NDArray[np.intp], s: F64) -> tuple[F64, F64, F64]:
        """Return q, q', q'' within the roundings of corners."""
        reach = self.corner_rad[corner]
        t = ((s - self._at_rad[corner]) / reach + 1.0)[:, None] / 2.0
        before, behind = self._directions[corner - 1], self._directions[corner]
        turned = t**3 * (2.0 - t)  # the integral of how far the direction has turned
        q = self.waypoints[corner] + reach[:, None] * ((2.0 * t - 1.0) * before)
        q += reach[:, None] * turned * (behind - before)
        share = t**2 * (3.0 - 2.0 * t)
        ddq = (3.0 * t * (1.0 - t) / reach[:, None]) * (behind - before)
        return q, before + share * (behind - before), ddq

    @property
    def pieces(self) -> tuple[tuple[JointPath, float, float], ...]:
        """The path itself, all of it."""
        return ((self, 0.0, self.length_rad),)

    def straight_rad(self, s_rad: float) -> float:
        """Return the first place from `s` on where the path is straight: `s`, or a corner's end."""
        inside = np.abs(s_rad - self._at_rad) < self.corner_rad
        return float((self._at_rad + self.corner_rad)[inside].max(initial=s_rad))


class JoinedPath(Line):
    """A path from a place on, which goes over to another one at a later place.

    Args:
        first: The path.
        from_rad: Where on it this one begins.
        to_rad: Where on it the other one begins; at `from_rad` or behind it.
        second: The other one; `first` leads straight into it there.

    Raises:
        ValueError: There would be a gap or a kink.
    """

    def __init__(self, first: Line, from_rad: float, to_rad: float, second: Line) -> None:
        if not first.leads_into(to_rad, second):
            raise ValueError(f"the path does not lead straight into the other one at {to_rad} rad")
        before, at_rad = [], 0.0
        for path, begins_rad, length_rad in first.pieces:
            low, high = max(from_rad, at_rad), min(to_rad, at_rad + length_rad)
            if high > low:
                before.append((path, begins_rad + low - at_rad, high - low))
            at_rad += length_rad
        self._pieces = (*before, *second.pieces)
        ends = np.cumsum([length_rad for _, _, length_rad in self._pieces])
        self._at_rad = np.r_[0.0, ends[:-1]]
        self.length_rad = float(ends[-1])

    @property
    def pieces(self) -> tuple[tuple[JointPath, float, float], ...]:
        """The paths that it is made of: each with where it begins on that path, and its length."""
        return self._pieces

    def at(self, s_rad: F64 | float) -> tuple[F64, F64, F64]:
        """Return q, q' and q'', as `Line.at`."""
        s = np.clip(np.atleast_1d(np.asarray(s_rad, np.float64)), 0.0, self.length_rad)
        which = np.searchsorted(self._at_rad, s, side="right") - 1
        found = np.empty((3, len(s), self._pieces[0][0].waypoints.shape[1]))
        for number, (path, begins_rad, _) in enumerate(self._pieces):
            here = which == number
            if here.any():
                found[:, here] = path.at(s[here] - self._at_rad[number] + begins_rad)
        return found[0], found[1], found[2]

    def straight_rad(self, s_rad: float) -> float:
        """Return the first place from `s` on where the path is straight."""
        number = max(0, int(np.searchsorted(self._at_rad, s_rad, side="right")) - 1)
        path, begins_rad, length_rad = self._pieces[number]
        there = path.straight_rad(s_rad - self._at_rad[number] + begins_rad) - begins_rad
        return float(self._at_rad[number] + min(there, length_rad))


class PathSpeeds:
    """How fast an arm may be at each place of a path.

    The greatest `ds/dt` keeps every joint within its speed and acceleration while the parameter
    accelerates or brakes in full, and the quickest end of a capsule below `nominal_m_s`.

    Args:
        arm: The arm.
        path: The path.
        nominal_m_s: Greatest speed of a capsule's end while no person is near.

    Attributes:
        path: The path.
        braking_rad_s2: Deceleration of the parameter that is always there.
        starting_rad_s2: Its greatest acceleration.
        places_rad: (m,), where the arrays below hold; each up to the next one.
        reach_m: (m,), speed of the quickest capsule end per `ds/dt`, m/rad.
        nominal_rad_s: (m,), greatest `ds/dt`.
    """

    def __init__(self, arm: Arm, path: Line, *, nominal_m_s: float) -> None:
        self.path = path
        count = int(np.ceil(path.length_rad / GRID_RAD)) + 2
        self.places_rad = np.linspace(0.0, path.length_rad, count)
        q, dq, ddq = path.at(self.places_rad)
        steepest = np.maximum(np.abs(dq).max(0), 1e-6)
        braking = BRAKING_SHARE * float((np.asarray(arm.ddq_max) / steepest).min())
        self.braking_rad_s2 = min(braking, 20.0)
        self.starting_rad_s2 = STARTING_SHARE * self.braking_rad_s2
        ends = np.linalg.norm(end_velocities(arm, q, dq), axis=-1).reshape(count, -1)
        reach = np.maximum(ends.max(1), 1e-3)
        left = np.asarray(arm.ddq_max) - np.abs(dq) * self.braking_rad_s2
        speed = (np.asarray(arm.dq_max) / np.maximum(np.abs(dq), 1e-9)).min(1)
        bent = np.sqrt((left / np.maximum(np.abs(ddq), 1e-9)).min(1))
        greatest = np.minimum(speed, bent)
        self.reach_m = np.maximum(reach, np.r_[reach[1:], reach[-1]])
        greatest = np.minimum(greatest, np.r_[greatest[1:], greatest[-1]])
        self.nominal_rad_s = np.minimum(0.95 * greatest, nominal_m_s / self.reach_m)

    def place(self, s_rad: float) -> int:
        """Return the index of the place that holds at `s`."""
        return int(np.clip(np.searchsorted(self.places_rad, s_rad, "right") - 1, 0, None))

    def within(self, s_rad: float, seconds: float) -> slice:
        """Return the places that the arm can come to within a time, from `s` on."""
        first = self.place(s_rad)
        step = self.places_rad[1] - self.places_rad[0] if len(self.places_rad) > 1 else 1.0
        came_s = np.cumsum(step / self.nominal_rad_s[first:])
        return slice(first, first + 1 + int(np.searchsorted(came_s, seconds)))

    def reached_rad(self, s_rad: float, speed_rad_s: float, seconds: float) -> float:
        """Return how far the arm can come within a time, from `s` on, at most."""
        left_s = seconds
        while left_s > 0.0 and s_rad < self.path.length_rad:
            step_s = min(0.01, left_s)
            quickest = speed_rad_s + self.starting_rad_s2 * step_s
            least = speed_rad_s - self.braking_rad_s2 * step_s
            speed_rad_s = max(least, min(quickest, float(self.nominal_rad_s[self.place(s_rad)])))
            s_rad, left_s = s_rad + speed_rad_s * step_s, left_s - step_s
        return min(s_rad, self.path.length_rad)

    def nominal_m_s(self, s_rad: float, ahead_s: float) -> float:
        """Return the quickest speed of a capsule's end from `s` on, nothing limiting, m/s."""
        there = self.within(s_rad, ahead_s)
        return float((self.reach_m * self.nominal_rad_s)[there].max())

    def allowed_rad_s(self, limit_m_s: float, braking_m_s2: float) -> F64:
        """Return the greatest `ds/dt` at each place under a limit of speed and separation, (m,).

        It keeps the quickest end of a capsule below the limit, and the arm at rest within the time
        and way that the quickest point takes at `braking_m_s2`.
        """
        stopping = limit_m_s * min(1e9, self.braking_rad_s2 / braking_m_s2)
        kept = np.minimum(KEPT * limit_m_s / self.reach_m, stopping)
        return np.asarray(np.minimum(self.nominal_rad_s, kept))


class PathFollower:
    """Moves the path's parameter within limits of speed, acceleration and jerk, cycle by cycle.

    Args:
        cycle_s: Time of a step.
        braking_m_s2: Deceleration of the quickest point that a limit counts on.

    Attributes:
        speeds: The path that it follows.
        s_rad: Where it is.
        speed_rad_s: `ds/dt`.
        acceleration_rad_s2: d²s/dt².
    """

    def __init__(self, speeds: PathSpeeds, *, cycle_s: float = 0.01, braking_m_s2: float) -> None:
        import ruckig

        self.speeds = speeds
        self._cycle_s, self._braking_m_s2 = cycle_s, braking_m_s2
        self._end_rad = speeds.path.length_rad
        self._allowed: tuple[float, F64] = (np.inf, speeds.nominal_rad_s)
        self._ruckig = ruckig.Ruckig(1, cycle_s)
        self._state, self._next = ruckig.InputParameter(1), ruckig.OutputParameter(1)
        self._state.control_interface = ruckig.ControlInterface.Velocity
        self._state.target_acceleration = [0.0]
        self._state.max_acceleration = [speeds.starting_rad_s2]
        self._state.min_acceleration = [-speeds.braking_rad_s2]
        self._place(0.0, 0.0, 0.0)

    def _place(self, s_rad: float, speed_rad_s: float, acceleration_rad_s2: float) -> None:
        self.s_rad, self.speed_rad_s = s_rad, speed_rad_s
        self.acceleration_rad_s2 = acceleration_rad_s2
        self._state.current_position = [s_rad]
        self._state.current_velocity = [speed_rad_s]
        self._state.current_acceleration = [acceleration_rad_s2]

    @property
    def arrived(self) -> bool:
        """Whether it is at the end, at rest."""
        return self.s_rad >= self._end_rad and self.speed_rad_s == 0.0

    @property
    def speed_m_s(self) -> float:
        """Speed of the quickest capsule end."""
        return float(self.speed_rad_s * self.speeds.reach_m[self.speeds.place(self.s_rad)])

    @property
    def share(self) -> float:
        """Speed as a share of the nominal one, 0 to 1."""
        nominal = self.speeds.nominal_rad_s[self.speeds.place(self.s_rad)]
        return float(min(1.0, self.speed_rad_s / nominal))

    def end_at(self, s_rad: float) -> bool:
        """Let the path end earlier; False if the arm could not stop there any more."""
        if s_rad < self.s_rad + self._stopping_rad():
            return False
        self._end_rad = min(self._end_rad, s_rad)
        return True

    def _stopping_rad(self) -> float:
        return (
            self.speed_rad_s**2 / (1.6 * self.speeds.braking_rad_s2)
            + self.speed_rad_s * 2.0 * LAG_S
        )

    def over_to(self, speeds: PathSpeeds, s_rad: float, limit_m_s: float) -> PathFollower | None:
        """Return a follower that goes on from here on another path, as fast as this one.

        Args:
            speeds: The other path, which goes through where the arm is, in the same direction.
            s_rad: Where on it the arm is.
            limit_m_s: As for `step`.

        Returns:
            None while the arm is too fast for what comes on the other path.
        """
        other = PathFollower(speeds, cycle_s=self._cycle_s, braking_m_s2=self._braking_m_s2)
        other._place(s_rad, self.speed_rad_s, self.acceleration_rad_s2)
        # A path on which the arm brakes as well as here has nothing to do with a lower limit.
        weaker = speeds.braking_rad_s2 < self.speeds.braking_rad_s2
        most_rad_s = other._target(limit_m_s if weaker else np.inf)
        return other if self.speed_rad_s <= FAST_SHARE * most_rad_s else None

    def step(self, limit_m_s: float) -> None:
        """Move on by one cycle.

        Args:
            limit_m_s: Greatest speed of the quickest capsule end from now on; 0 stops in full.
        """
        if self.arrived:
            return
        target = self._target(limit_m_s)
        braking = target < self.speed_rad_s or self.acceleration_rad_s2 < 0.0
        state, speeds = self._state, self.speeds
        state.target_velocity = [target]
        # The jerk that ends a deceleration would else begin an acceleration that ends too late.
        release = RELEASE_SHARE if self.acceleration_rad_s2 < 0.0 else 1.0
        state.max_acceleration = [release * speeds.starting_rad_s2]
        state.max_jerk = [
            speeds.braking_rad_s2 / BRAKING_RAMP_S
            if braking
            else speeds.starting_rad_s2 / STARTING_RAMP_S
        ]
        result = self._ruckig.update(state, self._next)
        assert int(result) >= 0, f"ruckig refuses {state} with {result}"
        s, v, a = (
            float(new[0])
            for new in (
                self._next.new_position, self._next.new_velocity, self._next.new_acceleration
            )
        )  # fmt: skip
        if s >= self._end_rad - ARRIVED_RAD and v < 10.0 * ARRIVED_RAD / LAG_S:
            self._place(self._end_rad, 0.0, 0.0)
        elif target == 0.0 and v < 1e-6:
            self._place(max(s, self.s_rad), 0.0, 0.0)
        else:
            self._place(max(s, self.s_rad), max(v, 0.0), a)

    def _target(self, limit_m_s: float) -> float:
        """Return the greatest `ds/dt` from which all that comes on the path can be kept."""
        if limit_m_s <= 0.0:
            return 0.0
        if self._allowed[0] != limit_m_s:
            allowed = self.speeds.allowed_rad_s(limit_m_s, self._braking_m_s2)
            self._allowed = limit_m_s, allowed
        allowed = self._allowed[1]
        places, first = self.speeds.places_rad, self.speeds.place(self.s_rad)
        braking = 0.8 * self.speeds.braking_rad_s2
        reach = self.s_rad + self.speed_rad_s**2 / braking + self.speed_rad_s * 0.2 + 0.05
        last = int(np.searchsorted(places, reach)) + 1
        lag = braking * LAG_S
        away = np.maximum(places[first:last] - self.s_rad, 0.0)
        there = np.sqrt((allowed[first:last] + lag) ** 2 + 2.0 * braking * away) - lag
        to_end = max(self._end_rad - self.s_rad, 0.0)
        return float(min(there.min(), np.sqrt(lag**2 + 2.0 * braking * to_end) - lag))
