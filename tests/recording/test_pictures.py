"""What Foxglove and Rerun get to see: sizes, frames, units and stamps of images, clouds, meshes."""

import json
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from recording_samples import BEGIN_NS, Cloud, Mesh, data, datum, recorded

from enact_dist.config.shows import GUESSED, KINDS, Shows
from enact_dist.core.protocol.datum import Slot
from enact_dist.errors import ConfigError
from enact_dist.recording.drawing.geometry import quaternion
from enact_dist.recording.drawing.pictures import json_bytes, json_schema, pictures_of
from enact_dist.recording.exact import Recorded

TRIANGLE_M = np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0.5]], np.float32)
TURNED = np.array([[0.0, -1, 0, 0.1], [1, 0, 0, 0.2], [0, 0, 1, 0.3], [0, 0, 0, 1]])
"""A quarter turn about z."""


@dataclass(frozen=True, eq=False)
class Lens:
    width_px: int
    height_px: int
    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float


@dataclass(frozen=True, eq=False)
class Shot:
    depth_mm: np.ndarray
    before_mm: np.ndarray
    lens: Lens
    world_from_camera: np.ndarray


SHOT = Shot(
    np.arange(6, dtype=np.uint16).reshape(2, 3),
    np.full((2, 3), 9, np.uint16),
    Lens(3, 2, 10.0, 11.0, 1.5, 0.5),
    TURNED,
)


def shown(value, *kinds, entity="camera/1", stamp_ns=0, **options):
    """Return the messages of a datum by the suffix of their topic."""
    held = Recorded(Slot("online", entity, "x"), 3, BEGIN_NS, "left", 1, datum(value, stamp_ns))
    found = pictures_of(held, Shows(kinds, **options))
    return {picture.suffix: picture.message for picture in found.pictures} | {"unfit": found.unfit}


# ---------------------------------------------------------------- images


@pytest.mark.parametrize(
    ("pixels", "encoding", "step"),
    [
        (np.zeros((4, 5, 3), np.uint8), "rgb8", 15),
        (np.zeros((4, 5, 4), np.uint8), "rgba8", 20),
        (np.zeros((4, 5), np.uint8), "mono8", 5),
        (np.zeros((4, 5), ">u2"), "16UC1", 10),
        (np.zeros((4, 5), np.float32), "32FC1", 20),
    ],
)
def test_image_has_the_encoding_of_its_shape(pixels, encoding, step):
    """Rows without padding, little-endian, whatever the array was."""
    image = shown(pixels, "image")[""]
    assert (image.width, image.height, image.encoding, image.step) == (5, 4, encoding, step)
    assert len(image.data) == 4 * step


def test_image_keeps_its_pixels_whatever_their_order_in_memory():
    """A big-endian array in Fortran's order shows the same numbers."""
    pixels = np.asfortranarray(np.arange(6, dtype=">u2").reshape(2, 3))
    image = shown(pixels, "image")[""]
    assert np.array_equal(np.frombuffer(image.data, "<u2").reshape(2, 3), pixels)


def test_mask_is_black_and_white():
    """Bool is shown as 0 and 255."""
    image = shown(np.array([[True, False]]), "mask")[""]
    assert (image.encoding, image.data) == ("mono8", b"\xff\x00")


def test_stamp_is_the_capture_else_the_commit():
    """Images of one capture meet in time, however long their commits took."""
    pixels = np.zeros((2, 2), np.uint8)
    assert shown(pixels, "image")[""].timestamp.ToNanoseconds() == BEGIN_NS
    assert shown(pixels, "image", stamp_ns=77)[""].timestamp.ToNanoseconds() == 77


# ---------------------------------------------------------------- clouds, meshes, poses


def test_cloud_is_float32_metres():
    """Twelve bytes a point, in the frame that is said for the entity."""
    cloud = shown(Cloud(TRIANGLE_M), "point_cloud", frame={"camera/*": "tray"})[""]
    assert (cloud.frame_id, cloud.point_stride) == ("tray", 12)
    assert [(f.name, f.offset, f.type) for f in cloud.fields] == [
        ("x", 0, 7),
        ("y", 4, 7),
        ("z", 8, 7),
    ]
    assert np.array_equal(np.frombuffer(cloud.data, "<f4").reshape(-1, 3), TRIANGLE_M)
    assert cloud.pose.orientation.w == 1.0


def test_colours_beside_points_are_shown():
    """Red, green and blue as they are, opaque."""
    cloud = shown(Cloud(TRIANGLE_M, np.array([[1, 2, 3]] * 3, np.uint8)), "point_cloud")[""]
    assert cloud.point_stride == 16
    assert [field.name for field in cloud.fields][3:] == ["red", "green", "blue", "alpha"]
    assert cloud.data[12:16] == bytes([1, 2, 3, 255])


def test_mesh_is_its_vertices_and_triangles():
    """Vertices as doubles in metres, indices as they are, one scene entity per slot."""
    update = shown(Mesh(TRIANGLE_M, np.array([[0, 1, 2]], np.int32)), "mesh", frame="world")[""]
    (entity,) = update.entities
    (triangles,) = entity.triangles
    assert (entity.frame_id, entity.id) == ("world", "online:camera/1/x")
    assert [(p.x, p.y, p.z) for p in triangles.points] == [tuple(map(float, p)) for p in TRIANGLE_M]
    assert list(triangles.indices) == [0, 1, 2]
    assert triangles.color.a == 1.0


def test_pose_and_transform_are_metres_and_a_unit_quaternion():
    """A quarter turn about z is (0, 0, sin 45, cos 45)."""
    found = shown(TURNED, "pose", "transform", frame="{entity}", parent="rig/{2}")
    pose, transform = found[""], found["/transform"]
    assert (pose.pose.position.x, pose.pose.position.y, pose.pose.position.z) == (0.1, 0.2, 0.3)
    assert pose.frame_id == "camera/1"
    assert (transform.parent_frame_id, transform.child_frame_id) == ("rig/1", "camera/1")
    rotation = transform.rotation
    expected = (0, 0, np.sqrt(0.5), np.sqrt(0.5))
    assert np.allclose((rotation.x, rotation.y, rotation.z, rotation.w), expected)


@given(st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: sum(x * x for x in q) > 0.01))
def test_quaternion_turns_as_its_matrix_does(q):
    """Any rotation, half turns included."""
    x, y, z, w = np.array(q) / np.linalg.norm(q)
    matrix = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    found = np.array(quaternion(matrix))
    assert np.isclose(abs(found @ (x, y, z, w)), 1.0)
    assert found[3] >= 0.0


def test_one_datum_shows_several_things():
    """An observation is an image, a camera and where that stands; each has a topic of its own."""
    found = shown(SHOT, "image", "calibration", "transform", frame="{entity}", parent="tray")
    assert np.frombuffer(found[""].data, "<u2").tolist() == list(range(6))
    camera = found["/calibration"]
    assert (camera.width, camera.height, camera.frame_id) == (3, 2, "camera/1")
    assert list(camera.K) == [10.0, 0, 1.5, 0, 11.0, 0.5, 0, 0, 1]
    assert found["/transform"].parent_frame_id == "tray"
    assert found["unfit"] == []


# ---------------------------------------------------------------- voxels, capsules, joints


@dataclass(frozen=True, eq=False)
class Occupied:
    voxels: np.ndarray
    voxel_m: float
    origin_m: np.ndarray


def faces_of(update):
    """Return the triangles (M, 3, 3) of a scene with one entity, metres."""
    (entity,) = update.entities
    (triangles,) = entity.triangles
    points = np.array([(point.x, point.y, point.z) for point in triangles.points])
    return points[np.array(triangles.indices).reshape(-1, 3)]


def volume_of(faces):
    """Return what closed triangles enclose, by the divergence theorem; negative if inside out."""
    return np.einsum("ij,ij->", faces[:, 0], np.cross(faces[:, 1], faces[:, 2])) / 6.0


def test_voxels_are_their_outer_faces():
    """Two cubes side by side have ten faces; place and size are those of the grid."""
    pair = Occupied(np.array([[4, 0, 0], [5, 0, 0]], np.int16), 0.5, np.array([1.0, 2.0, 3.0]))
    faces = faces_of(shown(pair)[""])
    assert len(faces) == 20
    assert faces.reshape(-1, 3).min(axis=0).tolist() == [3.0, 2.0, 3.0]
    assert faces.reshape(-1, 3).max(axis=0).tolist() == [4.0, 2.5, 3.5]
    assert np.isclose(volume_of(faces), 2 * 0.5**3)


@given(st.sets(st.tuples(*[st.integers(-3, 3)] * 3), min_size=1, max_size=40))
def test_faces_of_any_voxels_enclose_their_volume(voxels):
    """Fronts outside, none between two voxels, whatever their order; the size is of the cell."""
    array = np.array(sorted(voxels, reverse=True), np.int32)
    faces = faces_of(shown(array, "voxels", voxel_m=0.1, origin_m=(9.0, 9.0, 9.0))[""])
    assert np.isclose(volume_of(faces), len(voxels) * 1e-3)
    steps = np.eye(3, dtype=int)
    shared = sum(tuple(np.add(one, step)) in voxels for one in voxels for step in steps)
    assert len(faces) == 2 * (6 * len(voxels) - 2 * shared)


def test_voxels_without_a_size_are_told_and_none_is_an_empty_scene():
    """Nobody knows how large they are; a hull that is empty takes the last one away."""
    assert shown(np.zeros((2, 3), np.int16), "voxels")["unfit"] == ["voxels"]
    (entity,) = shown(np.zeros((0, 3), np.int16), "voxels", voxel_m=0.1)[""].entities
    assert not entity.triangles


def test_capsules_are_cylinders_with_spheres_at_their_ends():
    """The axis of the cylinder is that of the capsule; a ball has no cylinder."""
    rows = np.array([[0, 0, 1, 0.6, 0, 1, 0.1], [1, 1, 1, 1, 1, 1, 0.2]], np.float32)
    (entity,) = shown(rows, "capsules", frame="cell")[""].entities
    (cylinder,) = entity.cylinders
    assert entity.frame_id == "cell"
    assert np.allclose([cylinder.size.x, cylinder.size.y, cylinder.size.z], [0.2, 0.2, 0.6])
    at = cylinder.pose.position
    assert np.allclose([at.x, at.y, at.z], [0.3, 0.0, 1.0])
    turn = cylinder.pose.orientation
    axis = 2 * np.array([turn.x * turn.z + turn.w * turn.y, turn.y * turn.z - turn.w * turn.x, 0.5])
    axis[2] -= 2 * (turn.x**2 + turn.y**2)
    assert np.allclose(np.abs(axis), [1.0, 0.0, 0.0], atol=1e-6)
    assert sorted(round(ball.size.x, 3) for ball in entity.spheres) == [0.2, 0.2, 0.4, 0.4]


def test_a_trajectory_is_one_line_of_a_scene():
    """In its frame, place by place; what is no path is named as unfit."""
    path_m = np.stack([np.eye(4), TURNED])
    (entity,) = shown(path_m, "trajectory", frame="cell")[""].entities
    (line,) = entity.lines
    assert (entity.frame_id, line.type) == ("cell", line.LINE_STRIP)
    assert [(one.x, one.y, one.z) for one in line.points] == [(0, 0, 0), (0.1, 0.2, 0.3)]
    assert shown(np.zeros((3, 4)), "trajectory")["unfit"] == ["trajectory"]


@dataclass(frozen=True, eq=False)
class Arm:
    q: np.ndarray
    dq: np.ndarray
    stamp_ns: np.ndarray


def test_joints_are_the_newest_of_their_samples():
    """Positions, and velocities where they stand beside; names by the cell, or by number."""
    arm = Arm(np.array([[0.0, 0.1], [0.2, 0.3]]), np.array([[1.0, 2.0], [3.0, 4.0]]), np.arange(2))
    found = shown(arm, "joints", joints=("base", "tip"))[""]
    assert [(one.name, one.position, one.velocity) for one in found.joints] == [
        ("base", 0.2, 3.0), ("tip", 0.3, 4.0),
    ]  # fmt: skip
    (bare,) = shown(np.array([0.5]), "joints")[""].joints
    assert (bare.name, bare.position, bare.HasField("velocity")) == ("joint_1", 0.5, False)
    assert shown(arm, "joints", joints=("base",))["unfit"] == ["joints"]


@dataclass(frozen=True, eq=False)
class Eye:
    camera_matrix: np.ndarray
    distortion: np.ndarray
    camera_from_cell: np.ndarray
    width: int
    height: int


def test_camera_of_a_matrix_has_its_distortion_and_its_place_in_the_cell():
    """A transform that says where the cell is in the camera is turned round."""
    eye = Eye(np.diag([9.0, 8.0, 1.0]), np.array([0.1, 0.2, 0, 0, 0.3]), TURNED, 640, 480)
    found = shown(eye, "calibration", "transform", frame="{entity}", parent="cell", inverse=True)
    camera = found[""]
    assert (camera.width, camera.height, camera.distortion_model) == (640, 480, "plumb_bob")
    assert (list(camera.D), camera.K[4]) == ([0.1, 0.2, 0.0, 0.0, 0.3], 8.0)
    at = found["/transform"].translation
    assert np.allclose([at.x, at.y, at.z], np.linalg.inv(TURNED)[:3, 3])


@dataclass(frozen=True, eq=False)
class Bits:
    packed: np.ndarray


def test_packed_mask_is_unpacked():
    """Eight pixels in a byte, the first in its highest bit."""
    image = shown(Bits(np.array([[0x81, 0x00]], np.uint8)), "mask")[""]
    assert (image.width, image.height) == (16, 1)
    assert image.data == b"\xff" + bytes(6) + b"\xff" + bytes(8)


def test_of_names_the_part_to_look_at():
    """Where the first image of a datum is not the wanted one."""
    assert shown(SHOT, "image", of="before_mm")[""].data == np.full(6, 9, "<u2").tobytes()


# ---------------------------------------------------------------- guesses, misfits, null


@pytest.mark.parametrize(
    ("value", "schema"),
    [
        (np.zeros((4, 5, 3), np.uint8), "foxglove.RawImage"),
        (TURNED, "foxglove.PoseInFrame"),
        (Cloud(TRIANGLE_M), "foxglove.PointCloud"),
        (Mesh(TRIANGLE_M, np.zeros((0, 3), np.int32)), "foxglove.SceneUpdate"),
        (np.zeros((4, 5), np.float64), ""),
        (SHOT, ""),
        (3, ""),
    ],
)
def test_what_nobody_says_is_guessed_by_shape(value, schema):
    """The rest is JSON."""
    message = shown(value)[""]
    assert (schema == "") if isinstance(message, dict) else message.DESCRIPTOR.full_name == schema


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind != "json"])
def test_datum_that_does_not_fit_is_told_and_shown_as_json(kind):
    """A declaration that is wrong costs no datum and is not silent."""
    found = shown("text", kind, parent="x")
    assert found["unfit"] == [kind]
    assert found["/json"]["value"] == "text"


def test_extended_precision_is_shown_as_numbers():
    """What no JSON number is becomes one, in whatever it stands; it ended the recording."""
    message = shown({"a": np.array([1.5, np.inf], np.longdouble)})[""]
    assert json.loads(json_bytes(message))["value"] == {"a": [1.5, "inf"]}


def test_null_takes_a_mesh_away_and_empties_a_cloud():
    """What was deleted does not stand in the scene for ever."""
    gone = recorded("piece", None, null="DELETED")
    wanted = Shows(("mesh", "point_cloud", "voxels", "capsules", "joints", "trajectory"))
    (mesh, cloud, voxels, capsules, joints, path) = pictures_of(gone, wanted).pictures
    for scene in (mesh, voxels, capsules, path):
        assert [one.id for one in scene.message.deletions] == ["online:piece/value"]
    assert not joints.message.joints
    assert cloud.message.data == b""
    (null,) = pictures_of(gone, GUESSED).pictures
    assert null.message["null"] == "DELETED"


@given(data)
def test_any_datum_is_some_picture(held):
    """Nothing that can be committed stops a recording; JSON is JSON, numbers that are none too."""
    for kinds in ((), *((kind,) for kind in KINDS)):
        version = Recorded(Slot("online", "a", "b"), 1, BEGIN_NS, "left", 1, held)
        for picture in pictures_of(version, Shows(kinds, parent="x")).pictures:
            if isinstance(picture.message, dict):
                read = json.loads(json_bytes(picture.message), parse_constant=pytest.fail)
                assert json_schema(read)["type"] == "object"
            else:
                assert picture.message.SerializeToString()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ({"kinds": ("film",)}, "film"),
        ({"kinds": ("transform",)}, "parent"),
        ({"kinds": ("image",), "encoding": "rgb9"}, "rgb9"),
        ({"kinds": ("pose",), "frame": "a/{x}"}, "a/{x}"),
        ({"kinds": ("pose",), "frame": {"a b": "x"}}, "pattern"),
        ({"kinds": ("voxels",), "origin_m": (0.0, 1.0)}, "three numbers"),
    ],
)
def test_declaration_that_makes_no_sense_is_refused(words, said):
    """With what it may be."""
    with pytest.raises(ConfigError, match=said):
        Shows(**words)
