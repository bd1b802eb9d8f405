"""Voxels and what cameras can say about them: numbering, tables, obstacles, bad calibrations."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from actors.geometry.cameras.projection import in_camera, on_image
from actors.geometry.hull.visibility import (
    GROWN_PX,
    camera_table,
    check_calibration,
    hidden_by,
    inside,
    seen_by,
    static_voxels,
)
from actors.geometry.hull.voxels import VoxelBlocks

from .hull_parts import FOCAL, HEIGHT, WIDTH, box_row, ring, small_grid

BARREL = (-0.25, 0.06, 0.001, -0.0005, 0.0)


def test_rows_and_indices_are_inverse_and_a_block_is_a_slice():
    """Every voxel has one row; 64 rows in a row are 4 x 4 x 4 neighbours."""
    grid = VoxelBlocks(np.array([1.0, 2, 3]), 0.1, (8, 4, 12))
    rows = np.arange(grid.voxels)
    assert np.array_equal(grid.rows_of(grid.indices(rows)), rows)
    assert np.ptp(grid.indices(rows[64:128]), axis=0).tolist() == [3, 3, 3]
    assert grid.rows_in(np.array([1])).tolist() == rows[64:128].tolist()
    assert grid.centres(np.array([0]))[0] == pytest.approx([1.05, 2.05, 3.05])
    dense = np.arange(grid.voxels).reshape(grid.shape)
    i, j, k = grid.indices(rows).T
    assert np.array_equal(grid.block_major(dense), dense[i, j, k])


@pytest.mark.parametrize(
    ("origin", "voxel_m", "shape", "words"),
    [
        ((0, 0, 0), 0.1, (8, 8, 6), "multiples of 4; found .*8, 8, 6"),
        ((0, 0, 0), -0.1, (8, 8, 8), "a voxel above 0 m"),
        ((0, 0, np.nan), 0.1, (8, 8, 8), "asked for an origin"),
        ((0, 0, 0), 0.001, (4000, 4000, 2200), "at most 50,000,000 voxels.*lengths are metres"),
    ],
)
def test_grids_that_are_none_are_refused(origin, voxel_m, shape, words):
    """What is wrong with a grid is said in one line."""
    with pytest.raises(ValueError, match=words):
        VoxelBlocks(np.array(origin, float), voxel_m, shape)


@pytest.mark.parametrize("distortion", [(0.0,) * 5, BARREL])
def test_a_table_says_where_each_voxel_is_seen(distortion):
    """Place and growth of every 97th voxel are those of its projected centre and corners."""
    grid, camera = small_grid(), ring(5, distortion)[1]
    table = camera_table(grid, camera, [])
    rows = np.arange(0, grid.voxels, 97)
    corners = np.array(list(np.ndindex(2, 2, 2))) - 0.5
    centre = grid.centres(rows).astype(float)
    points = centre[:, None] + corners * grid.voxel_m
    local = in_camera(np.concatenate([centre[:, None], points], 1), camera.camera_from_cell)
    pixels = on_image(local, camera.camera_matrix, camera.distortion)
    bound = np.array([WIDTH, HEIGHT]) - 0.5
    whole = ((pixels[:, 1:] > -0.5) & (pixels[:, 1:] < bound)).all((1, 2))
    say = table.pixel[rows] != table.sentinel
    assert 0.3 < say.mean() < 1.0
    assert np.array_equal(say, whole & (say | (_reach(pixels) <= GROWN_PX[-1])))
    place = table.pixel[rows[say]] % table.mask_px
    asked = np.rint(pixels[say, 0])
    assert np.abs(np.stack([place % WIDTH, place // WIDTH], 1) - asked).max() <= 1
    slot = table.pixel[rows[say]] // table.mask_px
    assert (np.array([0, *GROWN_PX])[slot] >= _reach(pixels)[say] - 0.01).all()


def _reach(pixels):
    """Return how far the corners of voxels lie from the pixel of the centre, in whole pixels."""
    return np.floor(np.abs(pixels[:, 1:] - np.rint(pixels[:, :1])).max((1, 2)) + 0.499)


def test_behind_a_box_a_camera_has_no_say_and_above_it_does():
    """The shadow of a box, seen from the camera, is silent; what rests on the box is not."""
    grid, camera = small_grid(), ring(4)[0]
    box = box_row((0.0, 0.0, 0.2), (0.2, 0.2, 0.2))
    free, table = camera_table(grid, camera, []), camera_table(grid, camera, [box[None]])
    silent = (free.pixel != free.sentinel) & (table.pixel == table.sentinel)
    eye = np.linalg.inv(camera.camera_from_cell)[:3, 3]
    away = grid.centres(np.flatnonzero(silent)) @ (eye / np.linalg.norm(eye))
    assert silent.sum() > 200
    assert away.max() < 0.6
    on_top = grid.rows_of(np.array([[15, 15, 8], [16, 16, 8], [14, 17, 9]]))
    assert (table.pixel[on_top] != table.sentinel).all()
    behind = grid.centres(np.flatnonzero(silent))
    assert (behind[:, 2] < 0.55).all()


def test_beside_its_image_a_camera_has_no_say_even_in_an_obstacle():
    """Corners within a box do not count; the centre of a voxel that is in it does."""
    grid, camera = small_grid(), dataclasses.replace(ring(4)[0], width=200, height=140)
    box = box_row((0.0, 0.0, 0.4), (0.9, 0.9, 0.5))
    table = camera_table(grid, camera, [box[None]])
    rows = np.flatnonzero(table.pixel != table.sentinel)
    local = in_camera(grid.centres(rows).astype(float), camera.camera_from_cell)
    pixels = on_image(local, camera.camera_matrix, camera.distortion)
    assert len(rows) > 200
    assert table.pixel.max() == table.sentinel
    assert (pixels > -0.51).all()
    assert (pixels < np.array([200, 140]) - 0.49).all()


@pytest.mark.parametrize("yaw_rad", [0.0, 0.4])
def test_lines_of_sight_against_points_along_them(yaw_rad):
    """A point is hidden exactly if one of 400 points of its line lies in the box."""
    random = np.random.default_rng(3)
    box, eye = box_row((0.1, -0.1, 0.3), (0.3, 0.15, 0.3), yaw_rad), np.array([2.0, 1.0, 1.5])
    points = random.uniform(-1.0, 1.0, (300, 3))
    axes = tuple(points[:, k].reshape(-1, 1, 1) for k in range(3))
    hidden = hidden_by(box, eye, axes).ravel()
    share = np.linspace(0.0, 1.0, 400)[:, None, None]
    lines = eye + share * (points - eye)
    deep, wide = (
        inside(box, tuple(lines[..., k, None] for k in range(3)), margin).any(0).ravel()
        for margin in (-0.02, 0.005)
    )
    assert hidden.sum() > 15
    assert not (deep & ~hidden).any()
    assert not (hidden & ~wide).any()


def test_voxels_of_an_obstacle_are_static_and_none_beside_it():
    """A box along the voxels is exactly its voxels; a turned one is those with the centre inside."""
    grid = small_grid()
    static = static_voxels(grid, [box_row((0.0, 0.0, 0.2), (0.2, 0.1, 0.2))[None]])
    assert static.sum() == 8 * 4 * 8
    turned = static_voxels(grid, [box_row((0.0, 0.0, 0.2), (0.2, 0.1, 0.2), 0.6)[None]])
    assert 200 < turned.sum() < 340


def test_the_count_of_cameras_with_a_say():
    """In the middle all see, in a corner of the floor some do."""
    grid = small_grid()
    tables = [camera_table(grid, camera, []) for camera in ring(6)]
    seen = seen_by(tables)
    assert seen[grid.rows_of(np.array([[16, 16, 12]]))] == 6
    assert seen.min() < 6


def _changed(**parts):
    """Return a camera with some parts of another kind."""
    return dataclasses.replace(ring(4)[0], **parts)


MATRIX = np.array([[FOCAL, 0, 160.0], [0, FOCAL, 120], [0, 0, 1]])
MIRRORED = np.diag([-1.0, 1, 1, 1])


@pytest.mark.parametrize(
    ("parts", "words"),
    [
        ({"camera_matrix": np.eye(4)}, r"found matrices \(4, 4\)"),
        ({"camera_matrix": MATRIX * [[np.nan], [1], [1]]}, "not finite"),
        ({"camera_matrix": MATRIX * [[-1], [1], [1]]}, "found a camera matrix"),
        ({"width": 140}, "found a centre at 160, 120 of an image of 140 x 240 pixels"),
        ({"height": 0}, "an image of 320 x 0 pixels"),
        ({"camera_from_cell": np.eye(4) * 1.01}, "a pose that is not rigid"),
        ({"camera_from_cell": MIRRORED}, "a pose that mirrors"),
    ],
)
def test_wrong_calibrations_are_named(parts, words):
    """A calibration that no camera has is refused in one line, with the name of the camera."""
    with pytest.raises(ValueError, match=words) as refused:
        check_calibration("camera/3", _changed(**parts))
    assert "camera/3" in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_good_calibration_passes():
    """Nothing is said about a camera of the ring."""
    check_calibration("camera/0", ring(4)[0])
