"""Rigid transforms, (4, 4) float64, metres; `b_from_a` carries points of frame a into frame b.

Rules a change must keep: names say both frames; a product on the tray has three freedoms only
(x, y, yaw about z), because height and tilt are given by the tray it stands on.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import numpy.typing as npt

    Pose = npt.NDArray[np.float64]
    Points = npt.NDArray[np.floating]


def on_tray(x_m: float, y_m: float, yaw_rad: float) -> Pose:
    """Return tray_from_product of a product that stands on the tray at (x, y), turned by yaw."""
    cosine, sine = np.cos(yaw_rad), np.sin(yaw_rad)
    pose = np.eye(4)
    pose[:2, :2] = [[cosine, -sine], [sine, cosine]]
    pose[:2, 3] = x_m, y_m
    return pose


def turned(roll_rad: float, pitch_rad: float, yaw_rad: float) -> npt.NDArray[np.float64]:
    """Return the rotation Rz(yaw) Ry(pitch) Rx(roll), (3, 3): the turns follow each other so."""
    (cr, cp, cy), (sr, sp, sy) = (f([roll_rad, pitch_rad, yaw_rad]) for f in (np.cos, np.sin))
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def roll_pitch_yaw(turn: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return the angles, (3,) rad, from which `turned` makes a rotation; pitch is -π/2 … π/2."""
    roll = np.arctan2(turn[2, 1], turn[2, 2])
    pitch = np.arctan2(-turn[2, 0], np.hypot(turn[0, 0], turn[1, 0]))
    return np.array([roll, pitch, np.arctan2(turn[1, 0], turn[0, 0])])


def yaw_of(pose: Pose) -> float:
    """Return the turn about z that best explains a pose, radians, -pi … pi."""
    return float(np.arctan2(pose[1, 0] - pose[0, 1], pose[0, 0] + pose[1, 1]))


def yaw_between(one_rad: float, other_rad: float) -> float:
    """Return the shortest way from one angle to the other, radians, -pi … pi."""
    return float((other_rad - one_rad + np.pi) % (2.0 * np.pi) - np.pi)


def moved(points_m: Points, b_from_a: Pose) -> npt.NDArray[np.float64]:
    """Return points of frame a in frame b.

    Args:
        points_m: (N, 3), metres, frame a.
        b_from_a: (4, 4).

    Returns:
        (N, 3) float64, metres, frame b.
    """
    return np.asarray(points_m @ b_from_a[:3, :3].T + b_from_a[:3, 3], np.float64)


def inverse(b_from_a: Pose) -> Pose:
    """Return a_from_b."""
    pose = np.eye(4)
    pose[:3, :3] = b_from_a[:3, :3].T
    pose[:3, 3] = -b_from_a[:3, :3].T @ b_from_a[:3, 3]
    return pose


def coordinates(world_from_frame: Pose, world_from_body: Pose) -> npt.NDArray[np.float64]:
    """Return a body in a frame, (6,): x, y, z (m), roll, pitch, yaw (rad)."""
    pose = inverse(world_from_frame) @ world_from_body
    return np.concatenate((pose[:3, 3], roll_pitch_yaw(pose[:3, :3])))


def looking_at(eye_m: Points, target_m: Points) -> Pose:
    """Return world_from_camera of a camera at `eye_m` whose optical axis hits `target_m`.

    The image's columns run horizontally; looking straight down they run along world x.

    Args:
        eye_m: (3,), metres, world.
        target_m: (3,), metres, world; not equal to `eye_m`.
    """
    forward = np.asarray(target_m, float) - np.asarray(eye_m, float)
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    if np.linalg.norm(right) < 1e-6:
        right = np.array([1.0, 0.0, 0.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, 0], pose[:3, 1], pose[:3, 2] = right, np.cross(forward, right), forward
    pose[:3, 3] = eye_m
    return pose


def along_z(z: Points) -> npt.NDArray[np.float64]:
    """Return a right-handed turn, (3, 3), whose z axis is a unit vector, (3,)."""
    x = np.cross(np.eye(3)[np.argmin(np.abs(z))], z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)


def small_motion(twist: npt.NDArray[np.float64]) -> Pose:
    """Return the rigid transform of a rotation vector (rad) and a translation (m), (6,)."""
    from scipy.spatial.transform import Rotation

    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec(twist[:3]).as_matrix()
    pose[:3, 3] = twist[3:]
    return pose
