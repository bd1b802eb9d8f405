"""Calibrations in the formats of others: all are read into the same cameras, or refused by name."""

import json
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from actors.geometry.cameras.camera_sets import decomposed, read_cameras
from actors.geometry.files import InputFileError

from . import turntable

RING = turntable.ring(3)
BENT = turntable.ring(3, distortion=(0.1, -0.02, 1e-3, -2e-3, 0.0))
FORMATS = {
    "cameras.json": ("cameras.json", turntable.write_json, BENT),
    "cameras.json in millimetres": (
        "cameras.json", partial(turntable.write_json, unit="mm", scale=1000.0), BENT,
    ),
    "cameras.json with P": ("cameras.json", partial(turntable.write_json, projections=True), RING),
    "COLMAP text": ("COLMAP text", turntable.write_colmap, BENT),
    "parameter file": ("parameter file", turntable.write_parameters, RING),
    "projections": ("projections", turntable.write_projections, RING),
    "OpenCV YAML": ("OpenCV", turntable.write_opencv, BENT),
    "OpenCV XML with rvec": (
        "OpenCV", partial(turntable.write_opencv, ending=".xml", rvec=True), BENT,
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", FORMATS)
def test_each_format_is_read_into_the_same_cameras(tmp_path, name):
    """Poses in metres, pixels counted from the centre of the first one."""
    reader, write, cameras = FORMATS[name]
    write(tmp_path, cameras)

    found = read_cameras(tmp_path)

    assert found.reader == reader
    for one, other in zip(found.cameras, cameras, strict=True):
        assert one.name.removesuffix(".png") == other.name
        assert np.allclose(one.camera_matrix, other.camera_matrix, atol=1e-4)
        assert np.allclose(one.camera_from_cell, other.camera_from_cell, atol=1e-6)
        assert np.allclose(one.distortion, other.distortion)
        assert (one.width, one.height) in {turntable.SIZE, (0, 0)}


@given(
    st.tuples(*[st.floats(-3.0, 3.0)] * 3),
    st.tuples(*[st.floats(-2.0, 2.0)] * 3),
    st.floats(-8.0, 3.0).map(lambda power: 10.0**power),
    st.booleans(),
)
@settings(max_examples=50)
def test_projection_is_decomposed_whatever_its_scale_and_sign(turn, t, scale, negative):
    """K has a positive diagonal and ends in 1, det R is 1; both make the projection again."""
    import cv2

    k = np.array([[300.0, 2.0, 150.0], [0.0, 310.0, 120.0], [0.0, 0.0, 1.0]])
    rotation = cv2.Rodrigues(np.array(turn))[0]
    matrix = k @ np.column_stack((rotation, t)) * (-scale if negative else scale)

    found_k, found_r, found_t = decomposed(matrix)

    assert np.allclose(found_k, k, atol=1e-6)
    assert np.allclose(found_r, rotation, atol=1e-8)
    assert np.allclose(found_t, t, atol=1e-8)


def test_distortion_of_pixels_is_that_of_the_plane_at_one_metre():
    """k1 of radii in pixels times the square of the focal length, k2 times its fourth power."""
    camera = replace(RING[0], distortion=np.array((2e-7, 1e-12, 1e-3, 2e-3, 0.0)))
    k1, k2, p1, p2, k3 = camera.with_pixel_distortion().distortion
    assert np.allclose((k1, k2), (2e-7 * 330.0**2, 1e-12 * 330.0**4))
    assert (p1, p2, k3) == (1e-3, 2e-3, 0.0)


def mirrored(folder):
    turntable.write_json(folder, RING)
    content = json.loads((folder / "cameras.json").read_text())
    content["cameras"][1]["R"][0] = [-one for one in content["cameras"][1]["R"][0]]
    (folder / "cameras.json").write_text(json.dumps(content))


def changed(folder, **values):
    turntable.write_json(folder, RING)
    content = json.loads((folder / "cameras.json").read_text())
    content["cameras"][1] = content["cameras"][1] | values
    (folder / "cameras.json").write_text(json.dumps(content))


def colmap_with(folder, model):
    turntable.write_colmap(folder, RING)
    file = folder / "sparse" / "0" / "cameras.txt"
    file.write_text(file.read_text().replace("OPENCV", model))


WRONG = {
    "no calibration": (lambda _: None, "no cameras.json, no cameras.txt with images.txt"),
    "no JSON": (lambda folder: (folder / "cameras.json").write_text("{"), "asked for JSON"),
    "a list": (lambda folder: (folder / "cameras.json").write_text("[]"), 'a list "cameras"'),
    "no camera": (
        lambda folder: (folder / "cameras.json").write_text('{"cameras": []}'), "no camera",
    ),
    "a mirror": (mirrored, "camera 1; found R that mirrors"),
    "no rotation": (partial(changed, R=[[2, 0, 0], [0, 2, 0], [0, 0, 2]]), "no rotation"),
    "no t": (partial(changed, t=[1, 2]), "camera 1; found K"),
    "words": (partial(changed, K="wide"), "numbers for camera 1"),
    "twice": (partial(changed, name="0"), "camera '0' twice"),
    "a unit": (lambda folder: turntable.write_json(folder, RING, unit="inch"), "found 'inch'"),
    "not finite": (partial(changed, t=[1, 2, float("nan")]), "not finite"),
    "a size": (partial(changed, width=3.5), "whole numbers of pixels"),
    "a model": (partial(colmap_with, model="FISHEYE"), "FISHEYE with 8 parameters"),
    "no P": (partial(changed, P=[[1, 2], [3, 4]]), "a projection 3 x 4 of camera 1"),
    "a row as P": (partial(changed, P=[1, 2, 3]), "a projection 3 x 4 of camera 1"),
    "a flat P": (partial(changed, P=[[0] * 4] * 3), "a projection 3 x 4 of camera 1"),
    "units": (lambda folder: turntable.write_json(folder, RING, unit=["m"]), "found ['m']"),
}  # fmt: skip


@pytest.mark.parametrize("name", WRONG)
def test_wrong_calibration_is_refused_in_one_line(tmp_path, name):
    """With the file, what was asked and what was found."""
    spoil, said = WRONG[name]
    spoil(tmp_path)

    with pytest.raises(InputFileError) as caught:
        read_cameras(tmp_path)

    assert said in str(caught.value)
    assert str(tmp_path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_folder_that_is_none_is_refused(tmp_path):
    """A file, or nothing at all."""
    (tmp_path / "file").touch()
    for name, said in (("file", "found a file"), ("absent", "no such folder")):
        with pytest.raises(InputFileError, match=said):
            read_cameras(tmp_path / name)
