"""Forward kinematics against poses worked out by hand, and velocities against differences."""

from dataclasses import dataclass

import numpy as np
import pytest

from actors.geometry.arms.kinematics import (
    capsules_at,
    end_velocities,
    jacobians,
    link_poses,
    tool_poses,
)

QUARTER = np.pi / 2


@dataclass(frozen=True)
class Arm:
    dh: np.ndarray
    base: np.ndarray
    capsules: np.ndarray


def planar():
    """Two links of 1 m and 0.5 m that turn about the cell's z, on a base 2 m up."""
    base = np.eye(4)
    base[2, 3] = 2.0
    dh = np.array([[0.0, 1.0, 0.0, 0.0], [0.0, 0.5, 0.0, 0.0]])
    return Arm(dh, base, np.array([[0, 0.0, 1, 0.0, 0.1], [1, 0.0, 2, 0.3, 0.05]]))


def twisted(joints=7, seed=3):
    draw = np.random.default_rng(seed)
    base = np.eye(4)
    base[:3, 3] = 0.1, -0.2, 0.75
    frames = np.arange(joints, dtype=float)
    capsules = np.stack(
        [frames, draw.uniform(-0.1, 0.1, joints), frames + 1, draw.uniform(0, 0.2, joints)], 1
    )
    return Arm(
        draw.uniform(-1.5, 1.5, (joints, 4)),
        base,
        np.column_stack([capsules, np.full(joints, 0.1)]),
    )


def test_planar_arm_stands_where_trigonometry_puts_it():
    """At (90°, -90°) the first link points along y, the second along x; z ends lie above."""
    capsules = capsules_at(planar(), np.array([QUARTER, -QUARTER]))
    assert capsules.shape == (1, 2, 7)
    expected = [[0, 0, 2, 0, 1, 2, 0.1], [0, 1, 2, 0.5, 1, 2.3, 0.05]]
    np.testing.assert_allclose(capsules[0], expected, atol=1e-12)


def test_elbow_out_of_the_plane():
    """A joint twisted by -90° lifts what follows: d along its z is the old y."""
    arm = Arm(
        np.array([[0.36, 0.0, -QUARTER, 0.0], [0.42, 0.0, 0.0, 0.0]]), np.eye(4), planar().capsules
    )
    poses = link_poses(arm, np.zeros(2))[0]
    np.testing.assert_allclose(poses[0, :3, 3], [0, 0, 0.36], atol=1e-12)
    np.testing.assert_allclose(poses[1, :3, 3], [0, 0.42, 0.36], atol=1e-12)


def test_zero_of_a_joint_is_added_to_its_angle():
    """An arm with offset zeros, driven by so much less, has the same poses."""
    arm = planar()
    offset = Arm(arm.dh + np.array([0, 0, 0, 0.4]), arm.base, arm.capsules)
    q = np.array([[0.2, -0.7]])
    np.testing.assert_allclose(link_poses(offset, q - 0.4), link_poses(arm, q), atol=1e-12)


def test_a_batch_is_its_states_one_by_one():
    """Five states at once give the capsules of each alone."""
    arm, q = twisted(), np.random.default_rng(1).uniform(-2, 2, (5, 7))
    batch = capsules_at(arm, q)
    assert batch.shape == (5, 7, 7)
    for row, state in zip(batch, q, strict=True):
        np.testing.assert_allclose(row, capsules_at(arm, state)[0], atol=1e-12)


def test_poses_stay_rigid():
    """Rotations are orthogonal with determinant one, over random states."""
    turns = link_poses(twisted(), np.random.default_rng(2).uniform(-3, 3, (20, 7)))[..., :3, :3]
    gram = turns @ turns.swapaxes(-1, -2)
    np.testing.assert_allclose(gram, np.broadcast_to(np.eye(3), gram.shape), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(turns), 1.0, atol=1e-12)


def test_velocities_of_ends_are_what_differences_say():
    """The velocities of the ends agree with central differences."""
    arm, draw = twisted(), np.random.default_rng(4)
    q, dq, step = draw.uniform(-2, 2, (6, 7)), draw.uniform(-1, 1, (6, 7)), 1e-6
    moved = capsules_at(arm, q + step * dq) - capsules_at(arm, q - step * dq)
    numeric = (moved[..., :6] / (2 * step)).reshape(6, 7, 2, 3)
    np.testing.assert_allclose(end_velocities(arm, q, dq), numeric, atol=1e-7)


def test_jacobian_maps_joint_speeds_to_the_tool():
    """Its linear part is the tip's velocity, its angular part a difference of turns."""
    arm, draw = twisted(), np.random.default_rng(5)
    q, dq, step = draw.uniform(-2, 2, (4, 7)), draw.uniform(-1, 1, (4, 7)), 1e-6
    twist = (jacobians(arm, q) @ dq[..., None])[..., 0]
    np.testing.assert_allclose(twist[:, :3], end_velocities(arm, q, dq)[:, -1, 1], atol=1e-12)
    after, before = tool_poses(arm, q + step * dq), tool_poses(arm, q - step * dq)
    rate = (after - before)[:, :3, :3] / (2 * step) @ tool_poses(arm, q)[:, :3, :3].swapaxes(1, 2)
    turning = np.stack([rate[:, 2, 1], rate[:, 0, 2], rate[:, 1, 0]], 1)
    np.testing.assert_allclose(twist[:, 3:], turning, atol=1e-6)


def test_tool_is_the_last_end():
    """The tool's position is the far end of the last capsule."""
    arm, q = twisted(), np.full(7, 0.3)
    tool = tool_poses(arm, q)[0, :3, 3]
    assert tool == pytest.approx(capsules_at(arm, q)[0, -1, 3:6], abs=1e-12)
