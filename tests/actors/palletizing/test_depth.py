"""Claims about depth images."""

import numpy as np
import pytest

from actors.geometry.shapes import VGA
from actors.geometry.surfaces.depth import (
    depth_of_points,
    grid_normals,
    mean_known,
    median_known,
    metres,
    millimetres,
    points_grid,
    spread_m,
)


def wavy_depth_m() -> np.ndarray:
    rows, columns = np.indices(VGA.shape)
    return (0.6 + 0.05 * np.sin(rows / 40.0) + 0.03 * np.cos(columns / 30.0)).astype(np.float32)


def test_points_go_back_to_the_pixels_they_came_from():
    """Projecting the points of an image gives the image, unknown pixels included."""
    depth = wavy_depth_m()
    depth[100:120, 200:260] = np.nan
    grid = points_grid(depth, VGA)

    again = depth_of_points(grid[np.isfinite(depth)], VGA)

    np.testing.assert_array_equal(np.isnan(again), np.isnan(depth))
    np.testing.assert_allclose(again, depth, atol=1e-6)


def test_part_of_an_image_keeps_its_place():
    """The points of a part are those of the whole image there."""
    depth = wavy_depth_m()

    part = points_grid(depth[50:60, 70:90], VGA, corner_px=(50, 70))

    np.testing.assert_allclose(part, points_grid(depth, VGA)[50:60, 70:90], atol=1e-6)


def test_millimetres_keep_what_is_unknown():
    """NaN, infinity, zero and what does not fit become 0, and 0 becomes NaN again."""
    depth = np.array([[np.nan, np.inf, 0.0, -1.0, 70.0, 0.9504]])

    image = millimetres(depth)

    assert image.tolist() == [[0, 0, 0, 0, 0, 950]]
    assert np.isnan(metres(image)[0, :5]).all()


def test_median_ignores_dropouts():
    """One dropout in ten does not shift the median of a plane."""
    random = np.random.default_rng(2)
    image = np.full((80, 80), 0.9, np.float32)
    image[random.random(image.shape) < 0.1] = np.nan

    smooth = median_known(image, 5)

    np.testing.assert_allclose(smooth, 0.9, atol=1e-6)


def test_mean_stays_unknown_inside_a_hole():
    """Far from every known pixel nothing is made up."""
    image = np.full((60, 60), 0.9, np.float32)
    image[15:45, 15:45] = np.nan

    smooth = mean_known(image, 7)

    assert np.isnan(smooth[25:35, 25:35]).all()
    assert np.isfinite(smooth[:10]).all()


def test_normals_of_a_plane_face_the_camera():
    """A wall square to the optical axis has the normal (0, 0, -1) everywhere."""
    normals = grid_normals(points_grid(np.full(VGA.shape, 0.8, np.float32), VGA))

    np.testing.assert_allclose(
        normals[10:-10, 10:-10], np.broadcast_to([0.0, 0.0, -1.0], (460, 620, 3)), atol=1e-4
    )


def test_spread_is_that_of_the_sensor():
    """1.2 mm at 0.4 m and 1.8 mm above the tray."""
    assert spread_m(0.4) == pytest.approx(0.0012)
    assert spread_m(0.95) == pytest.approx(0.00177, abs=1e-5)
