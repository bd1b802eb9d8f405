"""Simulated people: bodies of 17 capsules, their gait, and what they do over a scenario.

Rules a change must keep: the lower foot stands on the floor; a body moves without jumps (who
measures speed on truth would see them); the same walk gives the same body at the same time.

Segment lengths are shares of the height, as anthropometric tables give them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

if TYPE_CHECKING:
    import numpy.typing as npt

    from actors.workcell.scenarios import Pause, Walk

    F64 = npt.NDArray[np.float64]
    Point = tuple[float, float, float]

CAPSULES: Final = 17
"""Two legs of three, pelvis, belly, chest, neck, head, two arms of three; in this order."""
RIGHT_HAND: Final = 13
"""Row of the right hand; its second end is the tip that reaches."""
HEAD: Final = 10
"""Row of the head."""

_THIGH, _SHANK, _TRUNK = 0.245, 0.246, 0.30
_UPPER_ARM, _FOREARM, _HAND = 0.186, 0.146, 0.097
_HIP, _SHOULDER = 0.05, 0.137
_RADIUS_THIGH, _RADIUS_SHANK, _RADIUS_FOOT = 0.085, 0.06, 0.045
_STRIDE: Final = 0.76
"""Length of two steps as a share of the height, at any speed."""
_SPEED_FULL_M_S: Final = 1.6
"""At this speed legs and arms swing fully."""

RATE_HZ: Final = 50.0
"""Samples per second that a walk is worked out in."""
_SMOOTH_S: Final = 0.6
"""Corners, starts and stops of a way are rounded over this time."""
_TURN_RAD_S: Final = 2.5
"""How fast a person turns."""
_REACH_S: Final = 0.7
"""How long a hand needs to its target, and back, before the rounding."""
_STEP_S: Final = 0.05
"""A velocity is that from so much earlier to so much later."""


@dataclass(frozen=True, slots=True)
class Posture:
    """Where a body is and what it does at one moment.

    Attributes:
        x_m: Middle of the body, cell frame.
        y_m: Likewise.
        yaw_rad: Where it looks, from x towards y.
        phase_rad: Of the gait; two steps are 2 pi.
        swing: Share of the full swing of legs and arms, 0 (stands) to 1.
        lean_rad: How far the trunk leans forward.
        target_m: Where the right hand goes, cell frame; None: nowhere.
        reach: How far it is on its way there, 0 to 1.
    """

    x_m: float
    y_m: float
    yaw_rad: float
    phase_rad: float = 0.0
    swing: float = 0.0
    lean_rad: float = 0.0
    target_m: Point | None = None
    reach: float = 0.0


def body(posture: Posture, height_m: float = 1.75) -> F64:
    """Return a body.

    Returns:
        (17, 7) capsules, cell frame: end, end, radius; metres.
    """
    legs, pelvis_z = _legs(posture, height_m)
    lean = posture.lean_rad
    up_x, up_z = math.sin(lean), math.cos(lean)

    def trunk(x: float, y: float, z: float) -> Point:
        return (x * up_z + z * up_x, y, pelvis_z + z * up_z - x * up_x)

    length = _TRUNK * height_m
    rows = [(*one, *other, radius) for one, other, radius in legs]
    rows += [(0.0, -0.07, pelvis_z + 0.02, 0.0, 0.07, pelvis_z + 0.02, 0.12)]
    rows += [(*trunk(0.0, -0.06, 0.18), *trunk(0.0, 0.06, 0.18), 0.12)]
    rows += [(*trunk(0.0, -0.12, length - 0.12), *trunk(0.0, 0.12, length - 0.12), 0.13)]
    rows += [(*trunk(0.01, 0.0, length + 0.06), *trunk(0.01, 0.0, length + 0.12), 0.06)]
    skull = height_m - (_leg_m(height_m) + length) - 0.10
    rows += [(*trunk(0.03, 0.0, skull + length - 0.06), *trunk(0.03, 0.0, skull + length), 0.10)]
    for side, phase in ((-1.0, posture.phase_rad), (1.0, posture.phase_rad + math.pi)):
        shoulder = trunk(0.0, side * _SHOULDER * height_m, length - 0.05)
        swing = 0.3 * posture.swing * math.sin(phase)
        elbow, wrist, tip = _hanging(shoulder, swing, height_m)
        if side < 0.0 and posture.target_m is not None and posture.reach > 0.0:
            elbow, wrist, tip = _reaching(posture, shoulder, tip, height_m)
        rows += [(*shoulder, *elbow, 0.05), (*elbow, *wrist, 0.042), (*wrist, *tip, 0.04)]
    capsules = np.array(rows)
    cosine, sine = math.cos(posture.yaw_rad), math.sin(posture.yaw_rad)
    for column in (0, 3):
        x, y = capsules[:, column].copy(), capsules[:, column + 1].copy()
        capsules[:, column] = cosine * x - sine * y + posture.x_m
        capsules[:, column + 1] = sine * x + cosine * y + posture.y_m
    return capsules


def _leg_m(height_m: float) -> float:
    """Return the height of the hips of who stands upright."""
    return (_THIGH + _SHANK) * height_m + 0.03 + _RADIUS_FOOT


def _legs(posture: Posture, height_m: float) -> tuple[list[tuple[Point, Point, float]], float]:
    """Return six capsules of the legs, and the height of the hips that puts a foot on the floor."""
    chains: list[list[Point]] = []
    for side, phase in ((-1.0, posture.phase_rad + math.pi), (1.0, posture.phase_rad)):
        hip_angle = posture.swing * 0.45 * math.sin(phase) + 0.02
        knee_angle = posture.swing * max(0.0, 0.9 * math.sin(phase + 1.2)) + 0.02
        y = side * _HIP * height_m
        knee = _below((0.0, y, 0.0), hip_angle, _THIGH * height_m)
        ankle = _below(knee, hip_angle - knee_angle, _SHANK * height_m)
        pitch = 0.3 * (hip_angle - knee_angle)
        x, z = math.cos(pitch) * 0.18 + math.sin(pitch) * 0.03, math.sin(pitch) * 0.18
        toe = (ankle[0] + x, y, ankle[2] + z - math.cos(pitch) * 0.03)
        chains.append([(0.0, y, 0.0), knee, ankle, toe])
    lowest = min(
        min(ankle[2] - _RADIUS_SHANK, toe[2] - _RADIUS_FOOT) for _, _, ankle, toe in chains
    )
    legs: list[tuple[Point, Point, float]] = []
    radii = (_RADIUS_THIGH, _RADIUS_SHANK, _RADIUS_FOOT)
    for chain in chains:
        joints = [(x, y, z - lowest) for x, y, z in chain]
        legs += [(joints[k], joints[k + 1], radii[k]) for k in range(3)]
    return legs, -lowest


def _below(joint: Point, angle_rad: float, length_m: float) -> Point:
    """Return the lower end of a limb that hangs at a joint, swung forward by an angle."""
    x, y, z = joint
    return (x + math.sin(angle_rad) * length_m, y, z - math.cos(angle_rad) * length_m)


def _hanging(shoulder: Point, swing_rad: float, height_m: float) -> tuple[Point, Point, Point]:
    """Return elbow, wrist and tip of the hand of an arm that swings."""
    elbow = _below(shoulder, swing_rad, _UPPER_ARM * height_m)
    wrist = _below(elbow, swing_rad + 0.35, _FOREARM * height_m)
    return elbow, wrist, _below(wrist, swing_rad + 0.35, _HAND * height_m)


def _reaching(
    posture: Posture, shoulder: Point, hanging: Point, height_m: float
) -> tuple[Point, Point, Point]:
    """Return elbow, wrist and tip of the right hand on its way from where it hangs to its target.

    Two links in the plane of shoulder, tip and a point behind and below the shoulder, so that the
    elbow bends as an elbow does.  What is out of reach is reached for with a straight arm.
    """
    assert posture.target_m is not None
    cosine, sine = math.cos(posture.yaw_rad), math.sin(posture.yaw_rad)
    dx, dy = posture.target_m[0] - posture.x_m, posture.target_m[1] - posture.y_m
    target = np.array([cosine * dx + sine * dy, cosine * dy - sine * dx, posture.target_m[2]])
    start = np.array(shoulder)
    way = (1.0 - posture.reach) * np.array(hanging) + posture.reach * target - start
    upper, lower = _UPPER_ARM * height_m, (_FOREARM + _HAND) * height_m
    far = float(np.linalg.norm(way))
    direction = way / max(far, 1e-9)
    far = min(max(far, upper - lower + 1e-3, lower - upper + 1e-3), upper + lower - 1e-3)
    pole = np.array([-1.0, 0.0, -0.5])
    pole -= (pole @ direction) * direction
    pole /= max(float(np.linalg.norm(pole)), 1e-9)
    cosine = (upper * upper + far * far - lower * lower) / (2.0 * upper * far)
    sine = math.sqrt(max(0.0, 1.0 - cosine * cosine))
    elbow = start + upper * (cosine * direction + sine * pole)
    tip = start + far * direction
    wrist = elbow + (tip - elbow) * (_FOREARM / (_FOREARM + _HAND))
    return _point(elbow), _point(wrist), _point(tip)


def _point(values: F64) -> Point:
    return (float(values[0]), float(values[1]), float(values[2]))


class Person:
    """One person of a scenario, from a walk: where they are and what they do at any time.

    Attributes:
        height_m: Height of the person.
        begin_s: From when on the person is there.
        end_s: Until when; infinite if the person stays or comes again.
    """

    def __init__(self, walk: Walk) -> None:
        self.height_m, self.begin_s = walk.height_m, walk.begin_s
        self._targets = [pause.reach_m for pause in walk.pauses if pause.reach_m is not None]
        columns = _samples(walk)
        self._every_s = len(columns["x"]) / RATE_HZ
        self.end_s = math.inf if walk.repeats else walk.begin_s + self._every_s
        step_m = np.hypot(np.gradient(columns["x"]), np.gradient(columns["y"]))
        self._table = np.stack(
            [
                columns["x"],
                columns["y"],
                columns["yaw"],
                np.cumsum(step_m) * 2.0 * np.pi / (_STRIDE * walk.height_m),
                np.minimum(step_m * RATE_HZ / _SPEED_FULL_M_S, 1.0),
                columns["lean"],
                columns["reach"],
            ]
        )
        self._which = columns["which"].astype(int)

    def posture_at(self, at_s: float) -> Posture | None:
        """Return what the person does at a time of the scenario; None while absent."""
        if not self.begin_s <= at_s < self.end_s:
            return None
        place = ((at_s - self.begin_s) % self._every_s) * RATE_HZ
        row = min(int(place), self._table.shape[1] - 2)
        share = min(place - row, 1.0)
        now = (1.0 - share) * self._table[:, row] + share * self._table[:, row + 1]
        x, y, yaw, phase, swing, lean, reach = now.tolist()
        which = self._which[row]
        sway = 0.012 * (1.0 - swing)
        return Posture(
            x_m=x + sway * math.sin(1.3 * at_s),
            y_m=y + sway * math.sin(1.7 * at_s + 1.0),
            yaw_rad=yaw,
            phase_rad=phase,
            swing=swing,
            lean_rad=lean,
            target_m=self._targets[which] if which >= 0 else None,
            reach=reach,
        )

    def capsules_at(self, at_s: float) -> F64 | None:
        """Return the body at a time of the scenario, (17, 7); None while the person is absent."""
        posture = self.posture_at(at_s)
        return None if posture is None else body(posture, self.height_m)

    def centre_at(self, at_s: float) -> F64 | None:
        """Return x and y of the middle of the body by volume, (2,); None while absent."""
        capsules = self.capsules_at(at_s)
        if capsules is None:
            return None
        middle, length = capsules[:, :2] + capsules[:, 3:5], capsules[:, 3:6] - capsules[:, :3]
        radius = capsules[:, 6]
        weight = radius**2 * (np.linalg.norm(length, axis=1) + radius * 4.0 / 3.0)
        return np.asarray(weight @ middle / (2.0 * weight.sum()))

    def velocity_at(self, at_s: float) -> F64 | None:
        """Return the velocity of that middle, (2,), m/s; None while absent.

        Only places of one round count: at its end a person who repeats the way starts it again.
        """
        if not self.begin_s <= at_s < self.end_s:
            return None
        begin_s = at_s - (at_s - self.begin_s) % self._every_s
        first_s = max(at_s - _STEP_S, begin_s)
        last_s = min(at_s + _STEP_S, begin_s + self._every_s - 1e-6)
        before, after = self.centre_at(first_s), self.centre_at(last_s)
        assert before is not None
        assert after is not None
        return np.asarray((after - before) / max(last_s - first_s, 1e-6))


def _samples(walk: Walk) -> dict[str, F64]:
    """Return x, y, yaw, lean, reach and which target, at `RATE_HZ` from the first point on."""
    way = np.array(walk.way_m, np.float64)
    pauses = {pause.waypoint: pause for pause in walk.pauses}
    pieces: list[dict[str, F64]] = []
    targets = 0
    heading = float(np.arctan2(*(way[1] - way[0])[::-1]))
    for number, point in enumerate(way):
        if number:
            leg = point - way[number - 1]
            far = float(np.linalg.norm(leg))
            count = max(1, round(far / walk.speed_m_s * RATE_HZ))
            heading = float(np.arctan2(leg[1], leg[0])) if far > 1e-6 else heading
            share = np.arange(count)[:, None] / count
            pieces.append(_piece(way[number - 1] + share * leg, heading))
        if number in pauses:
            which = targets if pauses[number].reach_m is not None else -1
            targets += which >= 0
            pieces.append(_pause(point, heading, pauses[number], which))
    columns = {name: np.concatenate([piece[name] for piece in pieces]) for name in pieces[0]}
    columns["yaw"] = _turned(np.unwrap(columns["yaw"]))
    smooth = {name: _rounded(columns[name]) for name in ("x", "y", "yaw", "lean", "reach")}
    return {**smooth, "which": _kept(columns["which"])}


def _piece(points: F64, yaw_rad: float) -> dict[str, F64]:
    count = len(points)
    zeros = np.zeros(count)
    return {
        "x": points[:, 0],
        "y": points[:, 1],
        "yaw": np.full(count, yaw_rad),
        "lean": zeros,
        "reach": zeros,
        "which": np.full(count, -1.0),
    }


def _pause(point: F64, heading_rad: float, pause: Pause, which: int) -> dict[str, F64]:
    """Return the samples of a pause: turn, reach, hold, take the hand back."""
    count = max(2, round(pause.seconds * RATE_HZ))
    yaw = heading_rad if pause.facing_rad is None else pause.facing_rad
    piece = _piece(np.repeat(point[None], count, axis=0), yaw)
    at_s = np.arange(count) / RATE_HZ
    turn_s = min(abs((yaw - heading_rad + np.pi) % (2.0 * np.pi) - np.pi) / _TURN_RAD_S + 0.5, 2.5)
    out = np.clip((at_s - turn_s) / _REACH_S, 0.0, 1.0)
    back = np.clip((pause.seconds - 0.5 - at_s) / _REACH_S, 0.0, 1.0)
    share = np.minimum(out, back)
    piece["lean"] = share * pause.lean_rad
    piece["reach"] = share * (which >= 0)
    piece["which"] = np.full(count, float(which))
    return piece


def _turned(yaw_rad: F64) -> F64:
    """Return headings that follow others no faster than a person turns."""
    out, now, step = np.empty_like(yaw_rad), float(yaw_rad[0]), _TURN_RAD_S / RATE_HZ
    for place, wanted in enumerate(yaw_rad.tolist()):
        now += min(max(wanted - now, -step), step)
        out[place] = now
    return out


def _rounded(values: F64) -> F64:
    """Return values after a Hann window over `_SMOOTH_S`; the ends stay as they are."""
    half = round(_SMOOTH_S * RATE_HZ / 2.0)
    window = np.hanning(2 * half + 3)[1:-1]
    padded = np.pad(values, half, mode="edge")
    return np.convolve(padded, window / window.sum(), mode="valid")


def _kept(which: F64) -> F64:
    """Return the target of each sample, also where the rounding lets the hand begin early."""
    half = round(_SMOOTH_S * RATE_HZ / 2.0) + 1
    out = which.copy()
    for place in np.flatnonzero(which >= 0.0):
        out[max(place - half, 0) : place + half + 1] = which[place]
    return out
