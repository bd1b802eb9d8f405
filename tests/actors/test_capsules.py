"""Capsules: signed distances against a search, outlines against rays, boxes that contain them."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from actors.geometry.cameras.projection import in_camera, on_image
from actors.geometry.capsules import (
    bounds,
    capsule_distances,
    distance_between,
    distance_to_points,
    distances_to_points,
    fill,
    image_boxes,
    outlines,
    segment_distances,
    volume_m3,
)
from actors.geometry.poses import inverse, looking_at

SEEDS = st.integers(0, 2**32 - 1)
MATRIX = np.array([[440.0, 0, 319.5], [0, 440.0, 239.5], [0, 0, 1]])
STRAIGHT = np.zeros(5)
LYING = np.array([[0.0, 0, 0, 1, 0, 0, 0.1]])


def some_capsules(random, number):
    """Return capsules within two metres of the origin."""
    return np.concatenate(
        [random.uniform(-1, 1, (number, 6)), random.uniform(0.03, 0.3, (number, 1))], 1
    )


def searched(one, other):
    """Return the least distance of two segments among 201 x 201 pairs of their points."""
    share = np.linspace(0.0, 1.0, 201)[:, None]
    first = one[:3] + share * (one[3:6] - one[:3])
    second = other[:3] + share * (other[3:6] - other[:3])
    return np.linalg.norm(first[:, None] - second[None], axis=2).min()


@pytest.mark.parametrize(
    ("point", "metres"),
    [
        ((0.5, 0.3, 0), 0.2),
        ((0.5, 0, 0), -0.1),
        ((-0.5, 0, 0), 0.4),
        ((1.3, 0.4, 0), 0.4),
        ((0.2, 0.1, 0), 0.0),
    ],
)
def test_a_point_beside_before_behind_and_inside(point, metres):
    """The distance to a lying capsule is that to its axis minus the radius, negative inside."""
    assert distance_to_points(LYING, np.array([point]))[0] == pytest.approx(metres, abs=1e-6)


def test_far_from_the_origin_distances_stay_exact():
    """A cell with coordinates of a kilometre loses no millimetre to float32."""
    shift = np.array([1000.0, -2000.0, 50.0])
    capsule = LYING + np.r_[shift, shift, 0.0]
    found = distance_to_points(capsule, np.array([[0.5, 0.3, 0.0]]) + shift)
    assert found[0] == pytest.approx(0.2, abs=1e-5)


@given(SEEDS)
@settings(max_examples=40, deadline=None)
def test_points_and_degenerate_segments_agree(seed):
    """A point is as far from a capsule as the segment from that point to itself is."""
    random = np.random.default_rng(seed)
    capsules, points = some_capsules(random, 4), random.uniform(-2, 2, (30, 3))
    by_segments = segment_distances(capsules[:, :6], np.hstack([points, points]))
    by_points = distances_to_points(capsules, points)
    assert np.abs(by_points - (by_segments - capsules[:, 6:])).max() < 1e-4


@given(SEEDS)
@settings(max_examples=40, deadline=None)
def test_segments_against_a_search(seed):
    """The closed form is never above a fine search and at most a step of the search below it."""
    random = np.random.default_rng(seed)
    one, other = random.uniform(-1, 1, (2, 3, 6))
    exact = segment_distances(one, other)
    search = np.array([[searched(a, b) for b in other] for a in one])
    assert (exact <= search + 1e-9).all()
    assert (exact >= search - 0.02).all()


@pytest.mark.parametrize(
    ("one", "other", "metres"),
    [
        ((0, 0, 0, 1, 0, 0), (0, 1, 0, 1, 1, 0), 1.0),
        ((0, 0, 0, 1, 0, 0), (2, 0, 0, 3, 0, 0), 1.0),
        ((-1, 0, 0, 1, 0, 0), (0, -1, 0.5, 0, 1, 0.5), 0.5),
        ((-1, 0, 0, 1, 0, 0), (0, -1, 0, 0, 1, 0), 0.0),
        ((0, 0, 0, 0, 0, 0), (3, 4, 0, 3, 4, 0), 5.0),
    ],
)
def test_parallel_collinear_crossing_and_point_segments(one, other, metres):
    """The cases in which the determinant vanishes, or nearly, are exact."""
    found = segment_distances(np.array([one], float), np.array([other], float))
    assert found[0, 0] == pytest.approx(metres, abs=1e-9)


def test_overlapping_capsules_are_negative_and_none_are_infinitely_far():
    """Two capsules that cross are minus the sum of their radii apart; nothing is far from all."""
    crossing = np.array([[0.5, -1, 0, 0.5, 1, 0, 0.2]])
    assert capsule_distances(LYING, crossing)[0, 0] == pytest.approx(-0.3)
    assert distance_between(LYING, np.empty((0, 7))) == np.inf
    assert distance_to_points(np.empty((0, 7)), np.zeros((2, 3))).tolist() == [np.inf, np.inf]
    assert distances_to_points(LYING, np.empty((0, 3))).shape == (1, 0)


def test_box_and_volume():
    """The box holds the caps, the volume is a cylinder and a ball."""
    assert bounds(LYING)[0].ravel() == pytest.approx([-0.1, -0.1, -0.1, 1.1, 0.1, 0.1])
    assert volume_m3(LYING)[0] == pytest.approx(np.pi * 0.01 + 4 / 3 * np.pi * 0.001)


def hit_by_rays(capsules, matrix, camera_from_cell, shape):
    """Return which pixels' rays come within the radius of a capsule's axis."""
    v, u = np.mgrid[0 : shape[0], 0 : shape[1]]
    rays = np.stack([(u - matrix[0, 2]) / 440.0, (v - matrix[1, 2]) / 440.0, np.ones(u.shape)], -1)
    cell_from_camera = inverse(camera_from_cell)
    eye = cell_from_camera[:3, 3]
    ends = eye + 10.0 * rays.reshape(-1, 3) @ cell_from_camera[:3, :3].T
    lines = np.hstack([np.broadcast_to(eye, ends.shape), ends])
    near = segment_distances(lines, capsules[:, :6]) <= capsules[:, 6]
    return near.any(1).reshape(shape)


@pytest.mark.parametrize("seed", range(3))
def test_masks_are_those_of_rays(seed):
    """An outline holds every pixel whose ray meets the capsule, and is at most a pixel wider."""
    import cv2

    random = np.random.default_rng(seed)
    capsules = some_capsules(random, 3)
    pose = inverse(looking_at(np.array([2.6, -2.6, 2.7]), np.array([0, 0, 0.0])))
    matrix = MATRIX.copy()
    matrix[:2, 2] -= 160.0, 120.0
    found = fill(outlines(capsules, [(matrix, STRAIGHT, pose)]), 240, 320)[0] > 0
    truth = hit_by_rays(capsules, matrix, pose, (240, 320))
    assert truth.sum() > 1000
    assert not (truth & ~found).any()
    wider = cv2.dilate(truth.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    assert not (found & ~wider).any()


def test_boxes_in_the_image_hold_the_masks():
    """The box of an outline is as large as what it fills, and empty outside the image."""
    pose = inverse(looking_at(np.array([0.0, -3, 1]), np.array([0, 0, 1.0])))
    capsules = np.array([[-0.4, 0, 1, 0.4, 0, 1.5, 0.1], [50.0, 0, 1, 50, 0, 1.2, 0.1]])
    lines = outlines(capsules, [(MATRIX, STRAIGHT, pose)])
    boxes = image_boxes(lines, 480, 640)[0]
    rows, columns = np.nonzero(fill(lines, 480, 640)[0])
    assert boxes[0][0] <= columns.min() < columns.max() < boxes[0][2]
    assert boxes[0][1] <= rows.min() < rows.max() < boxes[0][3]
    assert boxes[1].tolist() == [0, 0, 0, 0]


def test_what_is_behind_a_camera_has_no_outline_and_what_reaches_behind_is_cut_off():
    """A capsule behind the camera fills nothing; one that passes it fills what lies ahead."""
    pose = inverse(looking_at(np.array([0.0, 0, 1]), np.array([0, 5.0, 1])))
    behind = np.array([[0, -3, 1, 0.2, -2, 1, 0.1]])
    through = np.array([[0.5, -3, 1, 0.5, 3, 1, 0.1]])
    lines = outlines(np.vstack([behind, through]), [(MATRIX, STRAIGHT, pose)])
    assert np.isnan(lines[0, 0]).all()
    truth = hit_by_rays(through, MATRIX, pose, (480, 640))
    assert truth.any()
    assert not (truth & (fill(lines, 480, 640)[0] == 0)).any()


def test_projection_is_that_of_opencv():
    """Pixels with distortion are those of cv2.projectPoints."""
    import cv2

    random = np.random.default_rng(0)
    distortion = np.array([-0.28, 0.09, 0.001, -0.0007, -0.012])
    pose = inverse(looking_at(np.array([2.0, 1, 2]), np.array([0, 0, 0.5])))
    points = random.uniform(-0.8, 0.8, (50, 3))
    vector = cv2.Rodrigues(pose[:3, :3])[0]
    asked, _ = cv2.projectPoints(points, vector, pose[:3, 3], MATRIX, distortion)
    found = on_image(in_camera(points, pose), MATRIX, distortion)
    assert np.abs(found - asked[:, 0]).max() < 1e-6


def test_no_pixel_behind_a_camera_or_past_the_fold_of_its_distortion():
    """Strong barrel distortion would fold what is far aside back into the image."""
    fold = np.array([-0.3, 0.0, 0, 0, 0])
    points = np.array([[0.1, 0, 1.0], [0, 0, -1.0], [1.5, 0, 1.0]])
    seen = np.isfinite(on_image(points, MATRIX, fold)).all(1)
    assert seen.tolist() == [True, False, False]
