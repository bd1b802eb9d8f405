"""Conversions to Open3D: it writes into read-only arrays, and an actor's conversions never let it."""

from __future__ import annotations

import ast
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

ACTORS = Path(__file__).parents[2] / "actors"
CONVERSIONS = ACTORS / "geometry" / "open3d_arrays.py"
LOADER = ACTORS / "geometry" / "open3d_on_use.py"

SHARING = {"Tensor", "from_numpy", "from_dlpack", "from_legacy", "Image", "RGBDImage"}
"""Take an array, some as it lies there."""
CONTAINERS = {"PointCloud", "TriangleMesh", "LineSet"}
"""Open3D's take tensors when they are made; the actors' own are called by their bare names."""
TAKING_TENSORS = {
    "add_triangles", "cast_rays", "compute_closest_points", "compute_distance",
    "compute_occupancy", "compute_signed_distance", "count_intersections", "create_isosurfaces",
    "list_intersections", "test_occlusions",
}  # fmt: skip
"""An array given to these is shared without a word: theirs has to be a `tensor`."""


@pytest.fixture
def o3d():
    """Open3D, where it is installed."""
    return pytest.importorskip("open3d", exc_type=ImportError)


def received(array):
    """Return the array over immutable bytes, as one from a lock lies."""
    raw = np.asfortranarray(array) if array.flags.f_contiguous else array
    flat = np.frombuffer(raw.tobytes("A"), array.dtype)
    return flat.reshape(array.shape, order="F" if array.flags.f_contiguous else "C")


POINTS = np.random.default_rng(0).random((500, 3))
MATRIX = np.array([[0.0, -2.0, 0, 1], [2.0, 0, 0, 2], [0, 0, 2.0, 3], [0, 0, 0, 1.0]])


# ---------------------------------------------------------------- the conversions


def test_open3d_writes_into_read_only_memory_by_itself(o3d):
    """The trap is there: both of these change immutable bytes without an error."""
    for share in (o3d.core.Tensor.from_numpy, lambda a: o3d.t.geometry.Image(a).as_tensor()):
        array = received(POINTS.astype(np.float32))
        tensor = share(array)
        tensor += 5.0
        assert (array > 4.0).all()


def in_place_on_tensors(tensor, o3d):
    tensor += 3.0
    tensor *= 2.0
    tensor[0] = 9.0
    tensor.T()[1] = 8.0
    tensor.reshape([-1])[:] = 7.0
    np.asarray(tensor.numpy())[...] = 6.0
    o3d.core.Tensor.from_dlpack(tensor.to_dlpack())[:] = 5.0


def in_place_on_clouds(tensor, o3d):
    cloud = o3d.t.geometry.PointCloud(tensor)
    cloud.point.colors = tensor
    cloud.point.normals = tensor
    rotation = MATRIX[:3, :3] / 2.0
    cloud.transform(MATRIX).translate([1.0, 2.0, 3.0]).scale(2.0, [0.0, 0.0, 0.0])
    cloud.rotate(rotation, [0.0, 0.0, 0.0])
    cloud.paint_uniform_color([0.1, 0.2, 0.3])
    cloud.normalize_normals()
    cloud.estimate_normals(10, 0.3)
    cloud.orient_normals_to_align_with_direction([0.0, 0.0, 1.0])
    cloud.point.positions += 1.0


def in_place_on_meshes(tensor, o3d):
    mesh = o3d.t.geometry.TriangleMesh()
    mesh.vertex.positions = tensor
    mesh.triangle.indices = o3d.core.Tensor(np.arange(30, dtype=np.int32).reshape(10, 3))
    mesh.compute_vertex_normals()
    mesh.transform(MATRIX).translate([1.0, 2.0, 3.0]).scale(2.0, [0.0, 0.0, 0.0])
    mesh.vertex.positions *= 2.0


@pytest.mark.parametrize("order", ["C", "F"])
@pytest.mark.parametrize("dtype", ["<f4", "<f8", ">f4"])
@pytest.mark.parametrize("use", [in_place_on_tensors, in_place_on_clouds, in_place_on_meshes])
def test_a_tensor_is_changed_and_the_array_is_not(o3d, use, dtype, order):
    """Everything that works in place, on the tensor and on what is made of it."""
    from actors.geometry.open3d_arrays import tensor

    array = received(POINTS.astype(dtype, order=order))
    before = array.tobytes()
    made = tensor(array)
    np.testing.assert_array_equal(made.numpy(), array)
    use(made, o3d)
    assert (made.numpy() != array).any()
    assert array.tobytes() == before


def test_an_array_of_ones_own_is_copied_too(o3d):
    """Writable or not, of the asked dtype already or not: the tensor has memory of its own."""
    from actors.geometry.open3d_arrays import tensor

    for dtype in (None, np.float64, np.float32):
        own = POINTS.copy()
        made = tensor(own, dtype)
        made += 1.0
        np.testing.assert_array_equal(own, POINTS)


def test_a_tensor_outlives_its_array(o3d):
    """The memory below a tensor is not given to anybody else."""
    from actors.geometry.open3d_arrays import tensor

    made = [tensor(received(np.full((50, 3), float(k)))) for k in range(200)]
    assert all((each.numpy() == k).all() for k, each in enumerate(made))


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_an_image_is_changed_and_the_array_is_not(o3d, dtype):
    """Depth and colour images, changed in place."""
    from actors.geometry.open3d_arrays import image

    array = received((POINTS[:300] * 100.0).astype(dtype).reshape(15, 20, 3))
    before = array.tobytes()
    made = image(array)
    made.as_tensor()[:] = 1
    np.asarray(made.to_legacy())[...] = 2
    assert (made.as_tensor().numpy() == 1).all()
    assert array.tobytes() == before


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("writable", [False, True])
def test_a_legacy_cloud_is_changed_and_the_array_is_not(o3d, dtype, writable):
    """Moved, painted, given normals, and written through numpy's view of its points."""
    from actors.geometry.open3d_arrays import point_cloud

    points_m, normals = (
        np.array(a, dtype) if writable else received(a.astype(dtype))
        for a in (POINTS, POINTS[::-1])
    )
    before = points_m.tobytes(), normals.tobytes()
    cloud = point_cloud(points_m, normals)
    np.testing.assert_array_equal(np.asarray(cloud.points), points_m)
    np.testing.assert_array_equal(np.asarray(cloud.normals), normals)
    cloud.transform(MATRIX).translate([1.0, 2.0, 3.0]).scale(2.0, [0.0, 0.0, 0.0])
    cloud.rotate(MATRIX[:3, :3] / 2.0)
    cloud.paint_uniform_color([0.1, 0.2, 0.3])
    cloud.normalize_normals()
    cloud.estimate_normals()
    cloud.orient_normals_consistent_tangent_plane(5)
    np.asarray(cloud.points)[...] = 0.0
    assert (points_m.tobytes(), normals.tobytes()) == before


# ---------------------------------------------------------------- what actors do


def test_fusing_and_comparing_leave_what_was_received(o3d, recording):
    """Depth, colour and surface as from a lock: bit-equal after fusion and residual."""
    from actors.geometry.scans.recordings import read_recording
    from actors.geometry.surfaces.rgbd_fusion import fuse_frames, residual

    frames = [
        replace(
            frame,
            depth=replace(frame.depth, depth_mm=received(frame.depth.depth_mm)),
            colour=received(frame.colour),
        )
        for frame in read_recording(recording.write()).frames[:3]
    ]
    made = fuse_frames(frames, voxel_m=0.01, depth_m_max=2.0)
    surface = replace(
        made, vertices_m=received(made.vertices_m), triangles=received(made.triangles)
    )
    arrays = [surface.vertices_m, surface.triangles]
    arrays += [array for frame in frames for array in (frame.depth.depth_mm, frame.colour)]
    before = [array.tobytes() for array in arrays]
    assert residual(surface, frames, depth_m_max=2.0).median_m < 0.01
    fuse_frames(frames, voxel_m=0.01, depth_m_max=2.0)
    assert [array.tobytes() for array in arrays] == before


def test_clouds_and_scenes_leave_what_was_received(o3d):
    """Thinning, clusters, ray casting and matching's features on read-only points."""
    from actors.geometry.recognition.clutter import clusters_of, thinned
    from actors.geometry.recognition.matching import _Described
    from actors.geometry.surfaces.rendering import cast, ray_scene

    points_m = received(POINTS)
    triangles = received(np.arange(300, dtype=np.uint32).reshape(100, 3))
    rays = received(np.ones((4, 5, 3), np.float32))
    before = points_m.tobytes(), triangles.tobytes(), rays.tobytes()
    assert len(thinned(points_m, 0.2)) < len(POINTS)
    assert clusters_of(points_m, gap_m=0.2, points_min=10)
    _Described(points_m, 0.1)
    assert cast(ray_scene(points_m, triangles), rays).shape == (4, 5)
    assert (points_m.tobytes(), triangles.tobytes(), rays.tobytes()) == before


# ---------------------------------------------------------------- nothing else converts


def called(node):
    """Return the last name of what a call calls."""
    return getattr(node.func, "attr", getattr(node.func, "id", ""))


def is_raw(name):
    """Say whether an attribute of this name takes an array; those of vectors do, too."""
    return name in SHARING or (name[0].isupper() and name.endswith("Vector"))


def is_own(node):
    """Say whether an argument is a tensor of its own, or no array at all."""
    if isinstance(node, ast.Call):
        return called(node) in {"tensor", "image"}
    return isinstance(node, ast.Constant | ast.List)


def raw_conversions(text):
    """Return where an actor's file converts by itself."""
    nodes = list(ast.walk(ast.parse(text)))
    tensors = {
        name.id
        for node in nodes
        if isinstance(node, ast.Assign) and is_own(node.value)
        for name in node.targets
        if isinstance(name, ast.Name)
    }
    found = []
    for node in nodes:
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names if alias.name.split(".")[0] == "open3d"]
        elif isinstance(node, ast.ImportFrom) and node.module.split(".")[0] == "open3d":
            found.append(node.module)
        elif isinstance(node, ast.Attribute) and is_raw(node.attr):
            found.append(node.attr)
        elif isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
            if called(node) in CONTAINERS and node.args:
                found.append(called(node))
            elif called(node) in TAKING_TENSORS:
                found += [
                    f"{called(node)}({ast.unparse(part)})"
                    for part in node.args
                    if not is_own(part) and getattr(part, "id", "") not in tensors
                ]
    return found


def test_no_actor_converts_by_itself():
    """All conversions to Open3D stand in one file."""
    files = sorted(set(ACTORS.rglob("*.py")) - {CONVERSIONS, LOADER})
    assert len(files) > 30
    found = {
        str(file.relative_to(ACTORS)): raw_conversions(file.read_text("utf-8")) for file in files
    }
    assert {name: lines for name, lines in found.items() if lines} == {}


@pytest.mark.parametrize(
    "line",
    [
        "import open3d as o3d",
        "from open3d.core import Tensor",
        "o3d.core.Tensor(array)",
        "make = open3d().core.Tensor",
        "core.Tensor.from_numpy(array)",
        "o3d.utility.Vector3dVector(array)",
        "o3d.utility.Vector3iVector(array)",
        "o3d.utility.DoubleVector(array)",
        "o3d.t.geometry.PointCloud(array)",
        "o3d.t.geometry.Image(array)",
        "o3d.geometry.TriangleMesh(a, b)",
        "scene.cast_rays(array)",
        "scene.compute_distance(points_m.astype(np.float32), nthreads=1)",
    ],
)
def test_a_planted_conversion_is_found(line):
    """The check bites."""
    assert raw_conversions(line)
