"""The data of the workcell as data: written and read back through a lock, unchanged."""

import dataclasses
from typing import Any

import numpy as np
import pytest

from actors.geometry.shapes import Surface
from actors.workcell import vocabulary as words
from enact_dist import Aspect, Entity, Lock, Write, local


def _hull(count: int) -> words.Hull:
    return words.Hull(
        voxels=np.arange(3 * count, dtype=np.int16).reshape(-1, 3),
        clearance_m=np.full(count, 0.5, np.float32),
        tight=np.ones(count, np.bool_),
        component=np.zeros(count, np.int16),
        counts={"raw": count, "robot": 0},
        cameras=("camera/0", "camera/1"),
        nearest_m=0.5 if count else float("inf"),
        nearest_voxel=0 if count else -1,
    )


def _surface() -> Surface:
    return Surface.free_form(np.zeros((3, 3)), np.array([[0, 1, 2]]))


EXAMPLES: list[tuple[Aspect[Any], Any]] = [
    (words.CALIBRATION, words.Calibration(np.eye(3), np.zeros(5), np.eye(4), 640, 480)),
    (
        words.BACKGROUND,
        words.Background(np.zeros((4, 8, 3), np.uint8), np.ones((4, 8, 3), np.uint8), 20, 7),
    ),
    (words.SILHOUETTE, words.Silhouette(np.zeros((480, 80), np.uint8), 0)),
    (words.GRID, words.Grid(np.zeros(3), 0.025, (160, 160, 88))),
    (words.HULL, _hull(5)),
    (words.HULL, _hull(0)),
    (words.SURFACE, _surface()),
    (
        words.TRACK,
        words.Track(np.zeros(3), np.zeros(3), np.eye(6), 1.75, 0.07, 7, hidden=False),
    ),
    (words.PREDICTION, words.Prediction(np.zeros(10), np.zeros((10, 2)), np.zeros(10))),
    (
        words.MODEL,
        words.ArmModel(np.zeros((7, 4)), np.eye(4), np.zeros((5, 5)), *np.zeros((3, 7))),
    ),
    (
        words.JOINTS,
        words.Joints(np.zeros((30, 7)), np.zeros((30, 7)), np.arange(30, dtype=np.int64)),
    ),
    (words.TASK, words.Task(np.zeros((2, 7)), np.zeros(2), cyclic=True)),
    (words.PATH, words.Path(np.zeros((0, 7)), 1, -1, 0, 7, 0.0, "no path: the person is in it")),
    (words.SPEED, words.Speed(1.0, float("inf"), float("inf"), "nobody near", 250.0, 7, 6)),
    (words.EXECUTION, words.Execution("moving", 1.0, 1.2, 7, 9, 1, 0, 0)),
    (words.SAFETY, words.Safety("run", "nobody near", 7)),
    (words.CAMERA_STATES, {"camera/0": words.CameraState(alive=True, last_ns=7, sets_missed=0)}),
    (words.PLAYING, words.Playing("S1", 7, 9, 60.0, robot=True)),
    (words.BODY, words.Body(np.zeros((17, 7), np.float32), np.zeros(2), np.zeros(2))),
]


def _same(one: Any, other: Any) -> bool:
    if isinstance(one, np.ndarray):
        return one.dtype == other.dtype and bool(np.array_equal(one, other))
    if dataclasses.is_dataclass(one):
        return type(one) is type(other) and all(
            _same(getattr(one, field.name), getattr(other, field.name))
            for field in dataclasses.fields(one)
        )
    return bool(one == other)


@pytest.mark.parametrize(("aspect", "datum"), EXAMPLES)
def test_a_datum_comes_back_as_it_was_written(aspect: Aspect[Any], datum: object) -> None:
    """Written under one lock, read under the next, the example of each aspect is the same."""
    with local(worlds=["online"]) as cell:
        request = Write(cell.world("online"), Entity("thing"), aspect)
        with Lock(request) as lock:
            lock[request] = datum
        with Lock(request) as lock:
            assert _same(lock[request], datum)


def test_every_structured_aspect_has_an_example() -> None:
    """An aspect whose datum is a dataclass cannot be added without one."""
    structured = {
        aspect.name
        for aspect in vars(words).values()
        if isinstance(aspect, Aspect) and dataclasses.is_dataclass(aspect.datum_type)
    }
    assert structured <= {aspect.name for aspect, _ in EXAMPLES}
