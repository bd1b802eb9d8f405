"""Static obstacles from a scan of the empty cell: boxes within a centimetre, surfaces that fit."""

import numpy as np
import pytest

from actors.geometry.shapes import Camera
from actors.geometry.surfaces.static_shapes import static_shapes
from actors.workcell.shapes import ShapeReconstruction, frames_of
from actors.workcell.simulation.room import BOXES
from actors.workcell.simulation.scan import scan_of_room
from actors.workcell.vocabulary import BOXES as BOXES_ASPECT
from actors.workcell.vocabulary import GRID, OBSTACLES, SURFACE, WORKSPACE, Grid, obstacle_entity
from enact_dist import ViewEach, local
from enact_dist.actor.running.runner import run_actor

LOW, HIGH = np.array((-3.4, -3.4, 0.0)), np.array((3.4, 3.4, 2.6))
SMALL = Camera(width_px=192, height_px=144, fx_px=173.0, fy_px=173.0, cx_px=95.5, cy_px=71.5)
THINGS = (BOXES[1], BOXES[3])


@pytest.fixture(scope="module")
def scan():
    return scan_of_room(3, boxes=THINGS, views=24, camera=SMALL)


@pytest.fixture(scope="module")
def shapes(scan):
    return static_shapes(scan, LOW, HIGH, voxel_m=0.03)


def outside(points_m, box):
    """Return how far points are from the surface of a box along the axes of the cell."""
    away = np.abs(points_m - np.array(box.centre_m)) - np.array(box.half_m)
    far = np.linalg.norm(np.maximum(away, 0.0), axis=1) + np.minimum(away.max(1), 0.0)
    return np.abs(far)


def test_boxes_are_where_the_things_stand(shapes):
    """Within 1 cm, upright, on the floor; the larger thing first."""
    assert len(shapes) == len(THINGS)
    for shape, thing in zip(shapes, THINGS, strict=True):
        (row,) = shape.boxes
        assert np.allclose(row[:3], thing.centre_m, atol=0.01)
        assert np.allclose(row[3:6], thing.half_m, atol=0.01)
        assert np.array_equal(row[6:], np.eye(3).ravel())


def test_surfaces_lie_on_the_things_and_cover_them(shapes):
    """Accuracy and completeness against the true boxes; the grid has 3 cm."""
    for shape, thing in zip(shapes, THINGS, strict=True):
        vertices = shape.surface.vertices_m[np.unique(shape.surface.triangles)].astype(float)
        assert np.median(outside(vertices, thing)) < 0.01
        low, high = (np.array(thing.centre_m) + side * np.array(thing.half_m) for side in (-1, 1))
        samples = np.random.default_rng(1).uniform(low, high, (600, 3))
        samples[:, 2] = samples[:, 2].clip(0.1)
        samples[:300, 2] = high[2]
        samples[300:, 0] = high[0]
        nearest = np.min(np.linalg.norm(samples[:, None] - vertices, axis=2), axis=1)
        assert np.mean(nearest < 0.05) > 0.9


def test_scan_of_nothing_is_refused(scan):
    """No image, or none that shows anything above the floor."""
    with pytest.raises(ValueError, match="found none"):
        static_shapes([], LOW, HIGH)
    with pytest.raises(ValueError, match="above the floor, found 0 points"):
        static_shapes(scan, HIGH, HIGH + 1.0)


def test_actor_writes_obstacles_and_deletes_those_of_before(scan, monkeypatch):
    """Once, under one lock; surface and boxes of each."""
    import threading

    monkeypatch.setattr("actors.workcell.shapes.frames_of", lambda _: scan)
    with local(worlds=("online",)) as cell:
        online = cell.world("online")
        online.init(WORKSPACE, GRID, Grid(LOW, 0.05, (136, 136, 52)))
        online.init(obstacle_entity(7), BOXES_ASPECT, np.zeros((1, 15)))
        done = run_actor(ShapeReconstruction(fusion_m=0.04), cell, stop=threading.Event())
        assert (done.state, done.last_error) == ("done", "")
        for aspect in (SURFACE, BOXES_ASPECT):
            each = ViewEach(online, OBSTACLES, aspect)
            found = dict(online.view(each)[each].items())
            assert set(found) == {obstacle_entity(0), obstacle_entity(1)}


def test_scan_is_a_recording_or_simulated(tmp_path):
    """What is neither is refused."""
    with pytest.raises(ValueError, match="write simulated:SEED or the name of a folder"):
        frames_of("simulated:x")
    with pytest.raises(ValueError, match="asked for"):
        frames_of(str(tmp_path))
    with pytest.raises(ValueError, match="fusion_m is 0"):
        ShapeReconstruction(fusion_m=0.0)
