"""Arms as chains of Denavit-Hartenberg rows with capsules on them; all of it in batches.

Rules a change must keep: the classical convention (turn about z by the joint, along z by d, along
x by a, about x by alpha); frame 0 is the base, frame i moves with joint i; metres and radians.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

import numpy as np

if TYPE_CHECKING:
    import numpy.typing as npt

    F64 = npt.NDArray[np.float64]


class Chain(Protocol):
    """What this module needs of an arm with n revolute joints."""

    @property
    def dh(self) -> F64:
        """(n, 4) per joint: d (m), a (m), alpha (rad), what is added to the joint's angle (rad)."""
        ...

    @property
    def base(self) -> F64:
        """(4, 4), cell_from_base."""
        ...

    @property
    def capsules(self) -> F64:
        """(k, 5): frame of one end, its z there (m), the same of the other end, radius (m).

        Ends lie on the z axes of their frames; the second end of the last capsule is the tool.
        """
        ...


def link_poses(chain: Chain, q_rad: F64) -> F64:
    """Return cell_from_frame of all frames that move.

    Args:
        chain: The arm.
        q_rad: (m, n), or (n,) for one state.

    Returns:
        (m, n, 4, 4); [:, i] is the frame of joint i + 1.
    """
    q = np.atleast_2d(np.asarray(q_rad, np.float64))
    d, a, alpha, zero = np.asarray(chain.dh, np.float64).T
    cosine, sine = np.cos(q + zero), np.sin(q + zero)
    poses = np.zeros((*q.shape, 4, 4))
    poses[..., 0, 0], poses[..., 1, 0] = cosine, sine
    poses[..., 0, 1], poses[..., 1, 1] = -sine * np.cos(alpha), cosine * np.cos(alpha)
    poses[..., 0, 2], poses[..., 1, 2] = sine * np.sin(alpha), -cosine * np.sin(alpha)
    poses[..., 0, 3], poses[..., 1, 3] = a * cosine, a * sine
    poses[..., 2, 1], poses[..., 2, 2], poses[..., 2, 3] = np.sin(alpha), np.cos(alpha), d
    poses[..., 3, 3] = 1.0
    before = np.asarray(chain.base, np.float64)
    for joint in range(q.shape[1]):
        before = poses[:, joint] = before @ poses[:, joint]
    return poses


def capsules_at(chain: Chain, q_rad: F64) -> F64:
    """Return the arm's capsules in the cell.

    Args:
        chain: The arm with k capsules.
        q_rad: (m, n), or (n,) for one state.

    Returns:
        (m, k, 7): one end, the other end, radius; metres, frame of the cell.
    """
    frames, z_m, radius_m = _ends(chain)
    ends = _points(_with_base(chain, link_poses(chain, q_rad)), frames, z_m)
    out = np.empty((len(ends), len(radius_m), 7))
    out[..., :6] = ends.reshape(len(ends), -1, 6)
    out[..., 6] = radius_m
    return out


def end_velocities(chain: Chain, q_rad: F64, dq_rad_s: F64) -> F64:
    """Return how fast both ends of each capsule move; no other point of a capsule is faster.

    Args:
        chain: The arm with k capsules.
        q_rad: (m, n), or (n,) for one state.
        dq_rad_s: Like `q_rad`.

    Returns:
        (m, k, 2, 3), m/s, frame of the cell.
    """
    poses = _with_base(chain, link_poses(chain, q_rad))
    dq = np.atleast_2d(np.asarray(dq_rad_s, np.float64))
    origins = poses[:, :, :3, 3]
    turning = np.zeros_like(origins)
    moving = np.zeros_like(origins)
    turning[:, 1:] = np.cumsum(dq[..., None] * poses[:, :-1, :3, 2], axis=1)
    steps = np.cross(turning[:, 1:], np.diff(origins, axis=1))
    moving[:, 1:] = np.cumsum(steps, axis=1)
    frames, z_m, radius_m = _ends(chain)
    arms = _points(poses, frames, z_m) - origins[:, frames]
    velocities = moving[:, frames] + np.cross(turning[:, frames], arms)
    return np.asarray(velocities.reshape(len(poses), len(radius_m), 2, 3))


def tool_poses(chain: Chain, q_rad: F64) -> F64:
    """Return cell_from_tool, (m, 4, 4): the last frame, moved along z to the last capsule's end."""
    poses = link_poses(chain, q_rad)[:, -1].copy()
    poses[:, :3, 3] += np.asarray(chain.capsules)[-1, 3] * poses[:, :3, 2]
    return poses


def jacobians(chain: Chain, q_rad: F64) -> F64:
    """Return how the tool moves with each joint.

    Returns:
        (m, 6, n): rows are the tool's velocity (m/rad), then its turning (rad/rad), in the cell.
    """
    return _jacobians(chain, link_poses(chain, q_rad))


def tool_and_jacobian(chain: Chain, q_rad: F64) -> tuple[F64, F64]:
    """Return cell_from_tool, (4, 4), and its Jacobian, (6, n), of one state; see `jacobians`."""
    links = link_poses(chain, q_rad)
    pose = links[0, -1].copy()
    pose[:3, 3] += np.asarray(chain.capsules)[-1, 3] * pose[:3, 2]
    return pose, _jacobians(chain, links)[0]


def _jacobians(chain: Chain, links: F64) -> F64:
    before = _with_base(chain, links)[:, :-1]
    tool = links[:, -1, :3, 3] + np.asarray(chain.capsules)[-1, 3] * links[:, -1, :3, 2]
    axes = before[:, :, :3, 2]
    arms = tool[:, None] - before[:, :, :3, 3]
    (ax, ay, az), (x, y, z) = np.moveaxis(axes, -1, 0), np.moveaxis(arms, -1, 0)
    # The cross product written out: that of NumPy takes most of a control cycle.
    rows = (ay * z - az * y, az * x - ax * z, ax * y - ay * x, ax, ay, az)
    return np.stack(rows, axis=1)


def _with_base(chain: Chain, links: F64) -> F64:
    """Return (m, n + 1, 4, 4), the frames from the base on."""
    base = np.broadcast_to(np.asarray(chain.base, np.float64), (len(links), 1, 4, 4))
    return np.concatenate((base, links), axis=1)


def _ends(chain: Chain) -> tuple[npt.NDArray[np.intp], F64, F64]:
    """Return frames (2 k,), z (2 k,) and radii (k,) of the capsules' ends, both of each in turn."""
    capsules = np.asarray(chain.capsules, np.float64)
    return capsules[:, [0, 2]].astype(np.intp).ravel(), capsules[:, [1, 3]].ravel(), capsules[:, 4]


def _points(poses: F64, frames: npt.NDArray[np.intp], z_m: F64) -> F64:
    """Return (m, e, 3), points on the z axes of frames."""
    there = poses[:, frames]
    return np.asarray(there[..., :3, 3] + z_m[:, None] * there[..., :3, 2])
