"""Reading clouds: all encodings come back, whatever is cut, empty or foreign is refused."""

from __future__ import annotations

import numpy as np
import pytest

from actors.geometry.files import InputFileError
from actors.geometry.scans.pointcloud_files import read_cloud
from actors.geometry.surfaces.surface_files import ply_bytes

o3d = pytest.importorskip("open3d", exc_type=ImportError)

POINTS = np.random.default_rng(1).random((200, 3))
ENCODINGS = [
    ("ascii.pcd", {"write_ascii": True}),
    ("binary.pcd", {}),
    ("packed.pcd", {"compressed": True}),
    ("ascii.ply", {"write_ascii": True}),
    ("binary.ply", {}),
]


def written(path, points=POINTS, **how):
    """Write points with Open3D; return the path."""
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    assert o3d.io.write_point_cloud(str(path), cloud, **how)
    return path


def refused(path):
    """Return the message with which a file is refused."""
    with pytest.raises(InputFileError) as caught:
        read_cloud(path)
    assert str(path) in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize(("name", "how"), ENCODINGS)
def test_cloud_comes_back_when_it_is_sound(tmp_path, name, how):
    """Every encoding returns its points in order."""
    read = read_cloud(written(tmp_path / name, **how))

    assert np.allclose(read.points_m, POINTS, atol=1e-6)
    assert read.left_out == 0
    assert not read.from_mesh


@pytest.mark.parametrize(("name", "how"), ENCODINGS)
def test_cloud_is_refused_when_it_is_cut_off(tmp_path, name, how):
    """Half a file is an error in every encoding, never half noise."""
    path = written(tmp_path / name, **how)
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])

    assert "cut off" in refused(path)


@pytest.mark.parametrize("name", ["x.pcd", "x.ply"])
@pytest.mark.parametrize("content", [b"", b"garbage" * 40, b"ply\nVERSION .7\n"])
def test_cloud_is_refused_when_it_is_foreign(tmp_path, name, content):
    """Empty files and other formats are refused."""
    path = tmp_path / name
    path.write_bytes(content)

    assert "found" in refused(path)


def test_cloud_is_refused_when_nothing_was_measured(tmp_path):
    """A cloud of NaN and a cloud of no points say which they are."""
    path = written(tmp_path / "nan.pcd", np.full((50, 3), np.nan))
    empty = tmp_path / "empty.ply"
    empty.write_bytes(
        b"ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nproperty float y\n"
        b"property float z\nend_header\n"
    )

    assert "0 finite points of 50" in refused(path)
    assert "no points" in refused(empty)


def test_cloud_is_refused_when_it_is_in_millimetres(tmp_path):
    """A span of 1,700 is not metres."""
    assert "millimetres" in refused(written(tmp_path / "mm.ply", POINTS * 1000.0))


def test_cloud_is_refused_when_its_ending_is_unknown(tmp_path):
    """The ending is named."""
    path = tmp_path / "cloud.xyz"
    path.write_text("0 0 0\n", encoding="utf-8")

    assert ".xyz" in refused(path)


def test_points_without_measurement_are_left_out_and_counted(tmp_path):
    """NaN among points is the camera's way to say nothing."""
    points = POINTS.copy()
    points[::4] = np.nan

    read = read_cloud(written(tmp_path / "some.pcd", points))

    assert read.left_out == 50
    assert len(read.points_m) == 150


def test_organised_cloud_tells_where_its_camera_stood(tmp_path):
    """Rows and columns mean one camera, at the VIEWPOINT."""
    path = written(tmp_path / "scan.pcd", write_ascii=True)
    text = path.read_text(encoding="ascii")
    text = text.replace("WIDTH 200", "WIDTH 20").replace("HEIGHT 1\n", "HEIGHT 10\n")
    path.write_text(text.replace("VIEWPOINT 0 0 0", "VIEWPOINT 1 2 3"), encoding="ascii")

    assert np.array_equal(read_cloud(path).eye_m, [1.0, 2.0, 3.0])
    assert read_cloud(written(tmp_path / "loose.pcd")).eye_m is None


def test_mesh_becomes_an_even_cloud(tmp_path):
    """A box of eight vertices gives points on all six faces, in proportion to their area."""
    box = o3d.geometry.TriangleMesh.create_box(0.1, 0.2, 0.3)
    path = tmp_path / "box.ply"
    path.write_bytes(ply_bytes(np.asarray(box.vertices), np.asarray(box.triangles)))

    read = read_cloud(path)

    on_top = np.mean(np.isclose(read.points_m[:, 2], 0.3, atol=1e-6))
    assert read.from_mesh
    assert on_top == pytest.approx(0.02 / 0.22, abs=0.01)


def test_mesh_is_refused_when_its_faces_are_cut_off(tmp_path):
    """A PLY whose vertices are whole and faces are not is refused."""
    box = o3d.geometry.TriangleMesh.create_box(0.1, 0.2, 0.3)
    content = ply_bytes(np.asarray(box.vertices), np.asarray(box.triangles))
    path = tmp_path / "box.ply"
    path.write_bytes(content[:-30])

    assert "cut off" in refused(path)


def test_mesh_without_an_area_is_refused(tmp_path):
    """A program that scales by 0 writes one: there is no point to draw that says anything."""
    path = tmp_path / "flat.ply"
    path.write_bytes(ply_bytes(np.full((3, 3), 0.1), np.array([[0, 1, 2]])))

    assert "all points coincide" in refused(path)
