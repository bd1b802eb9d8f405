"""Inverse kinematics: joints that bring the tool of an arm to a pose.

Damped least squares from where the arm is; if that ends beside the pose, from random states at
once.  PURE: the same arguments give the same joints.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from actors.geometry.arms.kinematics import jacobians, tool_poses

if TYPE_CHECKING:
    import numpy.typing as npt

    from actors.geometry.arms.joint_paths import Arm

    F64 = npt.NDArray[np.float64]

NEAR_M: Final = 5e-4
NEAR_RAD: Final = 2e-3
STEPS: Final = 60
STEP_RAD: Final = 0.3
"""A joint turns no further in one step."""
DAMPING: Final = 1e-4
OTHERS: Final = 15
"""Random states that are tried together."""
KEPT_RAD: Final = 0.03
"""Free before the ends of the joints' ranges."""


@dataclass(frozen=True, slots=True, eq=False)
class Reached:
    """How near the tool comes to a pose.

    Attributes:
        q_rad: (n,), joints within their ranges.
        off_m: Distance of the tool from the pose.
        off_rad: Turn between the tool and the pose.
        nearby: It was found from where the arm is; otherwise the arm may have to go far for it.
    """

    q_rad: F64
    off_m: float
    off_rad: float
    nearby: bool

    @property
    def there(self) -> bool:
        """Whether the pose is reached."""
        return self.off_m <= NEAR_M and self.off_rad <= NEAR_RAD


def reach(arm: Arm, pose: F64, near_rad: F64) -> Reached:
    """Return joints with which the tool comes to a pose, or as near as was found.

    Args:
        arm: Kinematics and ranges.
        pose: (4, 4), cell_from_tool, metres.
        near_rad: (n,), where the arm is; the search begins there.
    """
    most = np.asarray(arm.q_max, np.float64) - KEPT_RAD
    start = np.clip(np.asarray(near_rad, np.float64), -most, most)[None]
    found = _descended(arm, pose, start, most, nearby=True)
    if found.there:
        return found
    random = np.random.default_rng(0).uniform(-0.9, 0.9, (OTHERS, len(most))) * most
    other = _descended(arm, pose, random, most, nearby=False)
    return other if _cost(other.off_m, other.off_rad) < _cost(found.off_m, found.off_rad) else found


def _descended(arm: Arm, pose: F64, starts: F64, most: F64, *, nearby: bool) -> Reached:
    """Return the best of what all starts lead to; of those that arrive the nearest to theirs."""
    q = starts.copy()
    for _ in range(STEPS):
        error = _errors(tool_poses(arm, q), pose)
        jacobian = jacobians(arm, q)
        square = jacobian @ jacobian.transpose(0, 2, 1) + DAMPING * np.eye(6)
        step = jacobian.transpose(0, 2, 1) @ np.linalg.solve(square, error[..., None])
        q = np.clip(q + np.clip(step[..., 0], -STEP_RAD, STEP_RAD), -most, most)
        if len(q) == 1 and np.abs(error[:, :3]).max() < 1e-5 and np.abs(error[:, 3:]).max() < 1e-5:
            break
    error = _errors(tool_poses(arm, q), pose)
    off_m, off_rad = np.linalg.norm(error[:, :3], axis=1), np.linalg.norm(error[:, 3:], axis=1)
    there = (off_m <= NEAR_M) & (off_rad <= NEAR_RAD)
    cost = np.where(there, np.abs(q - starts).max(axis=1) * 1e-6, _cost(off_m, off_rad))
    best = int(np.argmin(cost))
    return Reached(q[best], float(off_m[best]), float(off_rad[best]), nearby)


def _cost(off_m: float | F64, off_rad: float | F64) -> Any:
    return off_m + 0.2 * off_rad


def _errors(tools: F64, pose: F64) -> F64:
    """Return what lacks to the pose, (m, 6): way (m), rotation vector (rad), in the cell."""
    from scipy.spatial.transform import Rotation

    turns = Rotation.from_matrix(pose[:3, :3] @ tools[:, :3, :3].transpose(0, 2, 1))
    return np.concatenate((pose[:3, 3] - tools[:, :3, 3], turns.as_rotvec()), axis=1)
