"""Finding a model in clutter: the right cluster, its pose, and honest scores."""

from __future__ import annotations

import numpy as np
import pytest

from actors.geometry.poses import inverse, moved, small_motion
from actors.geometry.recognition.matching import NoMatchError, find_model, rigid_fit

pytest.importorskip("open3d", exc_type=ImportError)

MODEL_BOXES = [((0, 0, 0), (0.20, 0.06, 0.05)), ((0, 0, 0), (0.05, 0.06, 0.14))]
"""An L of two boxes: no turn carries it onto itself."""

CLUTTER_BOXES = [((0.25, 0.1, 0), (0.40, 0.24, 0.09)), ((-0.35, 0.2, 0), (-0.27, 0.28, 0.22))]
TRUE_POSE = small_motion(np.array([0.0, 0.0, 0.7, 0.02, -0.12, 0.0]))


def box_points(random, low, high, density=40_000):
    """Return points and outward normals on the faces of a box, `density` points per m2."""
    low, high = np.array(low, float), np.array(high, float)
    points, normals = [], []
    for axis in range(3):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        for side, place in ((-1.0, low[axis]), (1.0, high[axis])):
            count = int(density * (high - low)[u] * (high - low)[v])
            face = low + random.random((count, 3)) * (high - low)
            face[:, axis] = place
            points.append(face)
            normal = np.zeros(3)
            normal[axis] = side
            normals.append(np.tile(normal, (count, 1)))
    return np.concatenate(points), np.concatenate(normals)


def boxes(random, parts, eye=None, pose=None):
    """Return points on boxes, moved by `pose`; of those, with an eye, what it sees of each."""
    kept = []
    for low, high in parts:
        points, normals = box_points(random, low, high)
        if pose is not None:
            points, normals = moved(points, pose), normals @ pose[:3, :3].T
        if eye is not None:
            points = points[((eye - points) * normals).sum(1) > 0.0]
        kept.append(points)
    return np.concatenate(kept)


def scene_points(random, *, with_model=True, eye=None):
    """Return a table with clutter and, turned and moved, the model; 1 mm of noise."""
    table = np.column_stack([random.uniform(-0.5, 0.5, (40_000, 2)), np.zeros(40_000)])
    parts = [table, boxes(random, CLUTTER_BOXES, eye)]
    if with_model:
        parts.append(boxes(random, MODEL_BOXES, eye, TRUE_POSE))
    points = np.concatenate(parts)
    return points + random.normal(0.0, 0.001, points.shape)


def pose_error(pose, truth):
    """Return the error of a pose of the L in millimetres (worst corner of its box)."""
    corners = np.array([[x, y, z] for x in (0, 0.2) for y in (0, 0.06) for z in (0, 0.14)])
    return 1e3 * np.linalg.norm(moved(corners, pose) - moved(corners, truth), axis=1).max()


def test_model_is_found_with_its_pose_when_it_stands_in_clutter():
    """Every corner of the found L lies within 5 mm of where it is, and the next best is far off."""
    random = np.random.default_rng(1)
    model, scene = boxes(random, MODEL_BOXES), scene_points(random)

    match = find_model(model, scene)

    assert pose_error(match.best.scene_from_model, TRUE_POSE) < 5.0
    assert match.best.score > 0.85
    assert match.ranking[1].score < 0.7
    assert len(match.planes) == 1
    assert np.abs(match.planes[0][:3] - (0, 0, 1)).max() < 0.01


def test_model_is_found_when_it_lies_tilted_in_a_scene_of_another_frame():
    """Neither the model nor the scene needs to stand upright."""
    random = np.random.default_rng(2)
    turn = small_motion(np.array([0.9, -0.5, 2.0, 0.3, -0.2, 1.5]))
    start = small_motion(np.array([-2.0, 0.4, 1.0, 0.1, 0.1, 0.1]))
    model, scene = boxes(random, MODEL_BOXES), scene_points(random)

    match = find_model(moved(model, start), moved(scene, turn))

    truth = turn @ TRUE_POSE @ inverse(start)
    error_mm = pose_error(match.best.scene_from_model @ start, truth @ start)
    assert error_mm < 5.0


def test_complete_model_is_not_blamed_for_its_far_side_when_the_eye_is_known():
    """One camera sees half of it: fitness is near 1 with the eye, near a half without."""
    random = np.random.default_rng(3)
    eye = np.array([0.3, -1.0, 0.8])
    model, scene = boxes(random, MODEL_BOXES), scene_points(random, eye=eye)

    with_eye = find_model(model, scene, eye_m=eye)
    without = find_model(model, scene)

    assert pose_error(with_eye.best.scene_from_model, TRUE_POSE) < 8.0
    assert with_eye.best.fitness > 0.95
    assert without.best.fitness < 0.8


def test_match_is_the_same_when_the_seed_is():
    """Two runs with one seed give one pose to the last bit, whatever else the machine does."""
    random = np.random.default_rng(4)
    model, scene = boxes(random, MODEL_BOXES), scene_points(random)

    one, other = (find_model(model, scene, seed=7) for _ in range(2))

    assert np.array_equal(one.best.scene_from_model, other.best.scene_from_model)
    assert [c.cluster for c in one.ranking] == [c.cluster for c in other.ranking]


def test_score_is_low_when_the_model_is_absent():
    """Clutter without the L scores below what counts as found."""
    random = np.random.default_rng(5)

    match = find_model(boxes(random, MODEL_BOXES), scene_points(random, with_model=False))

    assert match.best.score < 0.75


def test_match_is_refused_when_there_is_only_a_table():
    """A scene without clusters is an error that counts what it had."""
    random = np.random.default_rng(6)
    table = np.column_stack([random.uniform(-0.5, 0.5, (40_000, 2)), np.zeros(40_000)])

    with pytest.raises(NoMatchError, match="no cluster"):
        find_model(boxes(random, MODEL_BOXES), table)


def test_match_is_refused_when_the_model_has_too_few_points():
    """Twenty points are no model."""
    random = np.random.default_rng(7)

    with pytest.raises(NoMatchError, match="denser"):
        find_model(random.random((20, 3)) * 0.1, scene_points(random))


def test_rigid_fit_recovers_each_motion_of_a_batch():
    """Three points and their images determine the motion exactly, without mirroring."""
    random = np.random.default_rng(8)
    truth = np.array([small_motion(random.normal(size=6)) for _ in range(20)])
    source = random.normal(size=(20, 3, 3))
    target = np.array([moved(s, t) for s, t in zip(source, truth, strict=True)])

    assert np.allclose(rigid_fit(source, target), truth, atol=1e-9)
