"""The real-input runs end to end: files and report when right, one line and nothing when wrong."""

from __future__ import annotations

import json

import numpy as np
import pytest

from actors.geometry.poses import moved, small_motion
from actors.palletizing.real import pictures as real_pictures
from actors.palletizing.real.input import run_match, run_views

o3d = pytest.importorskip("open3d", exc_type=ImportError)

TRUE_POSE = small_motion(np.array([0.0, 0.0, 0.9, 0.05, -0.1, 0.0]))


@pytest.fixture(autouse=True)
def small_pictures(monkeypatch):
    """Draw a twenty-fifth of the pixels: these tests are about files and numbers."""
    monkeypatch.setattr(real_pictures, "TILE_PX", (160, 120))


def write_cloud(path, points):
    """Write a cloud; return its path."""
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    assert o3d.io.write_point_cloud(str(path), cloud)
    return path


def on_boxes(random, *edges):
    """Return points drawn on boxes (low corner, size)."""
    points = []
    for low, size in edges:
        box = o3d.geometry.TriangleMesh.create_box(*size)
        corners = np.asarray(box.vertices)[np.asarray(box.triangles)] + low
        area = np.linalg.norm(
            np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
        )
        chosen = random.choice(12, 9000, p=area / area.sum())
        weight = random.dirichlet((1, 1, 1), 9000)
        points.append(np.einsum("kc,kci->ki", weight, corners[chosen]))
    return np.concatenate(points)


@pytest.fixture
def clouds(tmp_path):
    """A model file and a scene file with the model in clutter."""
    random = np.random.default_rng(11)
    model = on_boxes(random, ((0, 0, 0), (0.2, 0.06, 0.05)), ((0, 0, 0.05), (0.05, 0.06, 0.09)))
    table = np.column_stack([random.uniform(-0.5, 0.5, (50_000, 2)), np.zeros(50_000)])
    clutter = on_boxes(random, ((0.25, 0.2, 0.0), (0.15, 0.14, 0.09)))
    scene = np.concatenate([table, clutter, moved(model, TRUE_POSE)])
    scene += random.normal(0.0, 0.001, scene.shape)
    return write_cloud(tmp_path / "model.ply", model), write_cloud(tmp_path / "scene.pcd", scene)


def names(folder):
    """Return the names of all files below a folder."""
    return sorted(path.name for path in folder.rglob("*")) if folder.exists() else []


def test_views_give_surface_picture_and_report(recording, tmp_path, place_distance):
    """A recording becomes a PLY that lies on the place, a picture, and lines with units."""
    lines = []

    status = run_views(recording.write(), tmp_path / "out", voxel_m=0.008, say=lines.append)

    assert status == 0
    assert names(tmp_path / "out") == ["surface.ply", "surface.png"]
    mesh = o3d.io.read_triangle_mesh(str(tmp_path / "out" / "surface.ply"))
    assert np.median(place_distance(np.asarray(mesh.vertices))) < 0.001
    report = "\n".join(lines)
    assert "6 views of 320 x 240 pixels" in report
    assert "grid of 8.0 mm" in report


def test_views_leave_nothing_when_the_recording_is_wrong(recording, tmp_path, capsys):
    """Depth in centimetres: status 1, one line that says so, no output folder."""
    recording.depth_mm = [np.rint(depth / 10.0).astype(np.uint16) for depth in recording.depth_mm]

    status = run_views(recording.write(), tmp_path / "out", say=print)

    heard = capsys.readouterr()
    assert status == 1
    assert heard.err.count("\n") == 1
    assert heard.err.startswith("error: ")
    assert not (tmp_path / "out").exists()


def test_views_leave_the_old_result_when_a_later_run_is_refused(recording, tmp_path, capsys):
    """What an earlier run wrote stays when the next input is damaged."""
    out = tmp_path / "out"
    out.mkdir()
    (out / "surface.ply").write_bytes(b"earlier")
    folder = recording.write()
    (folder / "trajectory.log").unlink()

    assert run_views(folder, out, say=print) == 1

    assert "trajectory.log" in capsys.readouterr().err
    assert (out / "surface.ply").read_bytes() == b"earlier"


def test_views_are_refused_when_the_output_folder_is_a_file(recording, tmp_path, capsys):
    """The disk's refusal is one line as well."""
    (tmp_path / "out").write_bytes(b"in the way")

    assert run_views(recording.write(), tmp_path / "out", voxel_m=0.02, say=print) == 1

    assert capsys.readouterr().err.count("\n") == 1
    assert (tmp_path / "out").read_bytes() == b"in the way"


def test_views_are_refused_when_no_surface_comes_out(recording, tmp_path, capsys):
    """An actor's failure ends the run with its reason in one line: all is beyond 6 m."""
    for number, depth in enumerate(recording.depth_mm):
        recording.depth_mm[number] = depth * 10
        recording.poses[number][:3, 3] *= 10.0

    assert run_views(recording.write(), tmp_path / "out", say=print) == 1

    heard = capsys.readouterr().err
    assert "no surface" in heard
    assert heard.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_match_gives_pose_fit_and_picture(clouds, tmp_path):
    """The model's pose in the scene is within 5 mm in file and report."""
    lines = []

    status = run_match(*clouds, tmp_path / "out", say=lines.append)

    facts = json.loads((tmp_path / "out" / "match.json").read_text(encoding="utf-8"))
    corners = np.array([[0, 0, 0], [0.2, 0, 0], [0, 0.06, 0.14]])
    error_m = moved(corners, np.array(facts["scene_from_model"])) - moved(corners, TRUE_POSE)
    assert status == 0
    assert names(tmp_path / "out") == ["match.json", "match.png"]
    assert np.linalg.norm(error_m, axis=1).max() < 0.005
    assert np.linalg.norm(facts["quaternion_xyzw"]) == pytest.approx(1.0)
    assert any(line.startswith("pose ") and "mm" in line for line in lines)


def test_match_says_not_found_when_the_model_is_absent(clouds, tmp_path, capsys):
    """A scene of clutter alone: status 1, the best score named, nothing written."""
    random = np.random.default_rng(12)
    table = np.column_stack([random.uniform(-0.5, 0.5, (50_000, 2)), np.zeros(50_000)])
    clutter = on_boxes(random, ((0.2, 0.2, 0.0), (0.15, 0.14, 0.09)))
    scene = write_cloud(tmp_path / "other.pcd", np.concatenate([table, clutter]))

    status = run_match(clouds[0], scene, tmp_path / "out", say=print)

    assert status == 1
    assert "is not in" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("which", [0, 1])
def test_match_is_refused_when_a_cloud_is_missing_or_empty(clouds, tmp_path, capsys, which):
    """Either file missing or without points: status 1, its name, nothing written."""
    for content in (None, b""):
        clouds[which].unlink()
        if content is not None:
            clouds[which].write_bytes(content)

        status = run_match(*clouds, tmp_path / "out", say=lambda _: None)

        heard = capsys.readouterr().err
        assert status == 1
        assert heard.count("\n") == 1
        assert str(clouds[which]) in heard
        assert not (tmp_path / "out").exists()
        clouds[which].touch()
