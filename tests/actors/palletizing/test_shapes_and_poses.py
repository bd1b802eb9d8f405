"""Claims about the data types and the rigid transforms."""

import numpy as np
import pytest

from actors.geometry.poses import (
    inverse,
    looking_at,
    moved,
    on_tray,
    small_motion,
    yaw_between,
    yaw_of,
)
from actors.geometry.shapes import VGA, Acquisition, Camera, DepthFrame, PointCloud, Surface


def test_cloud_refuses_double_precision():
    """A cloud of another dtype is refused by name, with what was asked and found."""
    with pytest.raises(ValueError, match="points_m: asked for float32 of shape Nx3, found float64"):
        PointCloud(np.zeros((4, 3)))


def test_cloud_refuses_normals_of_another_length():
    """Normals belong to all points or to none."""
    points = np.zeros((4, 3), np.float32)

    with pytest.raises(ValueError, match="asked for none or 4, found 2"):
        PointCloud(points, points[:2])


def test_frame_refuses_an_image_of_another_camera():
    """A depth image has the size of the camera that it names."""
    with pytest.raises(ValueError, match="depth_mm: asked for uint16 of shape 480x640"):
        DepthFrame(np.zeros((240, 320), np.uint16), Acquisition(VGA, np.eye(4)))


def test_frame_refuses_depth_in_metres():
    """Floats are millimetres of several images; metres, and double precision, are refused."""
    seen_by = Acquisition(VGA, np.eye(4))
    with pytest.raises(ValueError, match=r"asked for millimetres, found at most 0.950"):
        DepthFrame(np.full((480, 640), 0.95, np.float32), seen_by)
    with pytest.raises(ValueError, match="found float64"):
        DepthFrame(np.full((480, 640), 950.0), seen_by)
    assert DepthFrame(np.full((480, 640), 950.25, np.float32), seen_by).depth_mm[0, 0] == 950.25


def test_camera_refuses_a_focal_length_of_zero():
    """A camera without focal length cannot be made."""
    with pytest.raises(ValueError, match="focal lengths above zero"):
        Camera(640, 480, 0.0, 577.0, 319.5, 239.5)


def test_surface_refuses_patches_of_another_length():
    """Every vertex has exactly one patch number."""
    with pytest.raises(ValueError, match="patch_of_vertex"):
        Surface(
            np.zeros((3, 3), np.float32),
            np.array([[0, 1, 2]], np.int32),
            np.zeros(2, np.int32),
            np.empty((0, 4)),
        )


def test_inverse_undoes_a_pose():
    """A pose and its inverse carry points there and back."""
    pose = small_motion(np.array([0.3, -0.2, 1.1, 0.5, -0.7, 0.2]))
    points = np.random.default_rng(1).normal(size=(20, 3))

    back = moved(moved(points, pose), inverse(pose))

    np.testing.assert_allclose(back, points, atol=1e-12)


@pytest.mark.parametrize("eye", [(0.4, 0.3, 0.5), (0.0, 0.0, 0.95), (-0.2, 0.6, 0.1)])
def test_looking_at_puts_the_target_on_the_optical_axis(eye):
    """The target has camera coordinates (0, 0, distance); the pose is a proper rotation."""
    target = np.array([0.02, -0.01, 0.03])

    pose = looking_at(np.array(eye), target)

    seen = moved(target[None], inverse(pose))[0]
    np.testing.assert_allclose(seen, [0.0, 0.0, np.linalg.norm(target - eye)], atol=1e-9)
    assert np.linalg.det(pose[:3, :3]) == pytest.approx(1.0)


def test_yaw_between_takes_the_shorter_way():
    """From 170 to -170 degrees it is 20 degrees, not 340 back."""
    assert yaw_between(np.deg2rad(170), np.deg2rad(-170)) == pytest.approx(np.deg2rad(20))


def test_on_tray_keeps_the_yaw():
    """The yaw that makes a pose is the yaw that is read from it."""
    assert yaw_of(on_tray(0.1, 0.2, 2.5)) == pytest.approx(2.5)
