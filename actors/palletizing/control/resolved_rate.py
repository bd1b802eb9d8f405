"""From the speed of the tool to positions of the joints: resolved-rate control with all limits.

One object per executed net; it holds the *commanded* joints.  Time and measurements are arguments.

Rules a change must keep: no joint leaves its range, speed, acceleration or jerk, also while it
brakes; a tool that is blocked is not pushed ahead any further than the lead allows, since behind
the commanded position stands a spring, the arm's own controller.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from actors.geometry.arms.kinematics import tool_and_jacobian

if TYPE_CHECKING:
    import numpy.typing as npt

    from actors.geometry.arms.joint_paths import Arm

    F64 = npt.NDArray[np.float64]

DAMPING: Final = 1e-4
"""λ² of the damped least squares: near a singularity the tool is slower, no joint faster."""
ACCELERATION_RAD_S2: Final = 6.0
"""A carton of 0.5 kg that is held with 45 N slips in the hand above it."""
SPEED_SHARE: Final = 0.95
"""Of the joints' greatest speeds: an arm that limits them itself needs some to catch up with."""
SMOOTHED: Final = 5
"""Cycles over which the joints' speeds are averaged.  Averaging keeps all limits of speed and
acceleration and bounds the jerk to 600 rad/s³ at 250 Hz; an arm that limits jerk itself could not
follow steps of the acceleration, and would fall behind in midst of a move."""
POSTURE_PER_S: Final = 0.5
"""How fast the elbow goes back to where it shall be; it moves nothing of the tool."""
RANGE_RAD: Final = 0.02
"""Kept free before the end of a joint's range."""
LEAD_M: Final = 0.015
"""The commanded tool is so far ahead of a blocked one at most."""
LEAD_S: Final = 0.1
"""And by so much at the allowed speed: an arm follows its command after 50 to 80 ms."""
LEAD_RAD: Final = 0.15
"""The same of the tool's turn."""


class ResolvedRate:
    """The commanded joints of an arm, moved by speeds of its tool.

    Args:
        arm: Kinematics and limits; its base is the frame of all poses here.
        q_rad: Where it is, (n,), at rest.
        posture_rad: (n,), where the joints go as far as the tool leaves it open.

    Attributes:
        q_rad: (n,), commanded.
        dq_rad_s: (n,), commanded.
    """

    def __init__(self, arm: Arm, q_rad: F64, posture_rad: F64) -> None:
        self._arm, self._posture_rad = arm, np.array(posture_rad, np.float64)
        self.q_rad, self.dq_rad_s = np.array(q_rad, np.float64), np.zeros(len(q_rad))
        self._speeds = np.zeros((SMOOTHED, len(q_rad)))
        self._q_max = np.asarray(arm.q_max, np.float64) - RANGE_RAD
        self._dq_max = SPEED_SHARE * np.asarray(arm.dq_max, np.float64)
        self._ddq_max = np.minimum(np.asarray(arm.ddq_max, np.float64), ACCELERATION_RAD_S2)

    @property
    def at_rest(self) -> bool:
        """Whether no joint is commanded to move."""
        return not self.dq_rad_s.any()

    def move(self, twist: F64, base_from_tool: F64, speed_m_s: float, dt_s: float) -> None:
        """Go on for one cycle.

        Args:
            twist: (6,), speed (m/s) and turning (rad/s) of the tool, base frame.
            base_from_tool: (4, 4), where the tool was measured.
            speed_m_s: Greatest speed that the tool may have.
            dt_s: Since the last cycle.
        """
        commanded, jacobian = tool_and_jacobian(self._arm, self.q_rad)
        twist = _held_back(twist, commanded, base_from_tool, LEAD_M + LEAD_S * speed_m_s)
        home = POSTURE_PER_S * (self._posture_rad - self.q_rad)
        square = jacobian @ jacobian.T
        square.flat[::7] += DAMPING
        dq = home + jacobian.T @ np.linalg.solve(square, twist - jacobian @ home)
        dq *= min(1.0, float((self._dq_max / np.maximum(np.abs(dq), 1e-9)).min()))
        self._advance(dq, dt_s)

    def brake(self, dt_s: float) -> None:
        """Come to rest with full deceleration, on the line it was on."""
        self._advance(np.zeros_like(self.dq_rad_s), dt_s)

    def _advance(self, dq: F64, dt_s: float) -> None:
        """Take joint speeds, within range, acceleration and jerk."""
        change = dq - self._speeds[-1]
        greatest = float((np.abs(change) / np.maximum(self._ddq_max * dt_s, 1e-12)).max())
        dq = self._speeds[-1] + change * min(1.0, 1.0 / max(greatest, 1e-12))
        up = np.sqrt(2.0 * self._ddq_max * np.maximum(self._q_max - self.q_rad, 0.0))
        down = np.sqrt(2.0 * self._ddq_max * np.maximum(self._q_max + self.q_rad, 0.0))
        self._speeds[:-1] = self._speeds[1:]
        self._speeds[-1] = np.clip(dq, -down, up)
        self.dq_rad_s = self._speeds.mean(axis=0)
        self.q_rad = np.clip(self.q_rad + self.dq_rad_s * dt_s, -self._q_max, self._q_max)


def rotation_vector(turn: F64) -> F64:
    """Return the rotation vector of a rotation, (3, 3) → (3,), rad; the sense of π is free."""
    sine = 0.5 * np.array(
        [turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]
    )
    cosine = 0.5 * (float(np.trace(turn)) - 1.0)
    length = float(np.sqrt(sine @ sine))
    angle = float(np.arctan2(length, cosine))
    if length > 1e-6:
        return np.asarray(sine * (angle / length))
    if cosine > 0.0:
        return sine
    column = int(np.argmax(np.diag(turn)))
    axis = turn[:, column] + np.eye(3)[column]
    return np.asarray(axis * (angle / np.linalg.norm(axis)))


def _held_back(twist: F64, commanded: F64, measured: F64, lead_m: float) -> F64:
    """Return the twist without what would take the commanded tool too far from the measured."""
    twist = twist.copy()
    ahead = commanded[:3, 3] - measured[:3, 3]
    turned = rotation_vector(commanded[:3, :3] @ measured[:3, :3].T)
    for part, lead, most in ((twist[:3], ahead, lead_m), (twist[3:], turned, LEAD_RAD)):
        length = float(np.sqrt(lead @ lead))
        outwards = float(part @ lead)
        if length > most and outwards > 0.0:
            part[:] = part - lead * (outwards / length**2)
    return twist
