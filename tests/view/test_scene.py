"""From data to nodes: what is drawn, where, in which colour, and what is left out."""

import struct
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from io import BytesIO
from unittest.mock import patch

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as nps
from view_samples import shown, slot

from enact_dist.errors import ConfigError
from enact_dist.recording.drawing import solids
from enact_dist.recording.drawing.solids import outer_voxels, voxel_faces
from enact_dist.view.drawing import scene as scenes
from enact_dist.view.drawing.files import ply_of, png_of
from enact_dist.view.drawing.frames import InParent, placed
from enact_dist.view.drawing.nodes import (
    AxesNode,
    CapsulesNode,
    CubesNode,
    FrustumNode,
    LineNode,
    PointsNode,
    SurfaceNode,
)
from enact_dist.view.drawing.scene import extent_of, labels_of, scene_of
from enact_dist.view.drawing.shapes import capsule_bodies, capsule_ends, linear
from enact_dist.view.drawing.trails import Trails


def moved(x_m=0.0, y_m=0.0, z_m=0.0):
    matrix = np.eye(4)
    matrix[:3, 3] = x_m, y_m, z_m
    return matrix


@dataclass(frozen=True, eq=False)
class Cloud:
    points_m: np.ndarray
    colours: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class Mesh:
    vertices_m: np.ndarray
    triangles: np.ndarray


@dataclass(frozen=True, eq=False)
class Occupied:
    voxels: np.ndarray
    voxel_m: float


@dataclass(frozen=True, eq=False)
class Lens:
    camera_matrix: np.ndarray
    width: int
    height: int
    camera_from_cell: np.ndarray


def one_node(data):
    """Return the only node of a scene of one datum."""
    (node,) = scene_of({data.recorded.slot: data}).nodes.values()
    return node


# ---------------------------------------------------------------- frames


def test_frames_stand_where_their_chain_of_transforms_leads():
    """Two translations add up; only the frame without a parent is a root."""
    chain = {"hand": InParent("arm", moved(1.0)), "arm": InParent("cell", moved(0.0, 2.0))}
    found = placed(chain, ["hand"])
    assert found.poses["hand"][:3, 3].tolist() == [1.0, 2.0, 0.0]
    assert found.roots == ("cell",)


def test_frames_without_a_common_root_and_circles_are_named():
    """Nothing says where they are, so all stand at the origin."""
    circle = {"a": InParent("b", moved(1.0)), "b": InParent("a", moved(1.0))}
    found = placed(circle, ["a", "alone", "other"])
    assert found.roots == ("alone", "other")
    assert set(found.circular) == {"a", "b"}
    assert found.poses["a"].tolist() == np.eye(4).tolist()


def test_a_transform_moves_what_stands_in_its_frame():
    """Its parent and the cloud's frame are linked by the entity's name alone."""
    place = shown(moved(5.0), "transform", entity="tray", parent="cell")
    cloud = shown(Cloud(np.zeros((2, 3))), entity="pack", frame="tray")
    scene = scene_of({one.recorded.slot: one for one in (place, cloud)})
    low_m, high_m = extent_of(scene)
    assert (low_m.tolist(), high_m.tolist()) == ([5.0, 0.0, 0.0], [5.0, 0.0, 0.0])
    assert scene.remarks == ()


# ---------------------------------------------------------------- kinds


def test_a_cloud_keeps_its_colours_and_loses_what_is_not_finite():
    """The colour of a point goes with it, so the rest keep their own."""
    points = np.array([[0, 0, 0], [np.nan, 0, 0], [1, 1, 1]], np.float32)
    colours = np.array([[1, 2, 3], [4, 5, 6], [7, 8, 9]], np.uint8)
    node = one_node(shown(Cloud(points, colours)))
    assert isinstance(node, PointsNode)
    assert node.colours.tolist() == [[1, 2, 3], [7, 8, 9]]


def test_a_cloud_without_colours_is_lighter_where_it_is_higher():
    """A single point far away does not make the others dark; a flat cloud has one colour."""
    points = np.zeros((101, 3))
    points[:, 2] = np.arange(101.0)
    points[7, 2] = 1e30
    colours = one_node(shown(Cloud(points), "point_cloud")).colours
    assert (colours[0].tolist(), colours[100].tolist()) == ([20, 40, 90], [150, 195, 240])
    assert np.allclose(colours[50], [85, 117, 165], atol=3)
    flat = one_node(shown(Cloud(np.ones((3, 3))), "point_cloud")).colours
    assert flat.tolist() == [[20, 40, 90]] * 3


def test_an_empty_cloud_is_no_node():
    """A browser stops at a cloud without points."""
    empty = shown(Cloud(np.empty((0, 3))))
    assert scene_of({empty.recorded.slot: empty}).nodes == {}


def test_a_large_cloud_is_thinned_and_the_page_says_so():
    """One point more than twice the limit leaves one in three."""
    cloud = shown(Cloud(np.zeros((scenes.POINTS_MAX * 2 + 1, 3), np.float32)))
    scene = scene_of({cloud.recorded.slot: cloud})
    (node,) = scene.nodes.values()
    assert len(node.points_m) <= scenes.POINTS_MAX
    assert "one in 3 is shown" in scene.remarks[0]


def test_a_mesh_loses_triangles_of_vertices_that_it_has_not():
    """The triangle that names a fourth vertex goes, the other one stays."""
    mesh = shown(Mesh(np.eye(3), np.array([[0, 1, 2], [0, 1, 3]])))
    node = one_node(mesh)
    assert isinstance(node, SurfaceNode)
    assert node.triangles.tolist() == [[0, 1, 2]]


def test_voxels_are_cubes_around_their_middles():
    """Index and edge length give the middle, in metres."""
    node = one_node(shown(Occupied(np.array([[1, 0, 0]]), 0.5)))
    assert isinstance(node, CubesNode)
    assert node.centres_m.tolist() == [[0.75, 0.25, 0.25]]


def test_many_voxels_are_square_points():
    """Those inside a block cannot be seen and are left out."""
    grid = np.stack(np.meshgrid(*[np.arange(16)] * 3), axis=-1).reshape(-1, 3)
    node = one_node(shown(Occupied(grid, 0.5)))
    assert isinstance(node, PointsNode)
    assert node.size_m == 0.5
    assert len(node.points_m) == 16**3 - 14**3


@pytest.mark.parametrize("dense_times", [0, solids.DENSE_TIMES])
@given(nps.arrays(np.int16, st.tuples(st.integers(0, 60), st.just(3)), elements=st.integers(0, 4)))
def test_voxels_that_are_left_out_have_no_face(dense_times, voxels):
    """All faces of a set of voxels are faces of its outer ones, voxel by voxel or as a grid."""
    with patch.object(solids, "DENSE_TIMES", dense_times):
        outer = outer_voxels(voxels)
    there = {tuple(each) for each in voxels.tolist()}
    steps = [moved_by for axis in np.eye(3, dtype=int) for moved_by in (axis, -axis)]
    expected = {
        each for each in there if any(tuple(np.add(each, step)) not in there for step in steps)
    }
    assert {tuple(each) for each in outer.tolist()} == expected
    assert len(voxel_faces(voxels)[1]) >= len(expected)


def test_capsules_are_spheres_and_cylinders():
    """A capsule has a sphere of its diameter at each end and a cylinder between them."""
    rows = np.array([[0, 0, 0, 0, 0, 2.0, 0.25]])
    node = one_node(shown(rows, "capsules"))
    assert isinstance(node, CapsulesNode)
    ends, bodies = capsule_ends(node.capsules), capsule_bodies(node.capsules)
    assert ends.places_m.tolist() == [[0, 0, 0], [0, 0, 2]]
    assert ends.sizes_m.tolist() == [[0.5] * 3] * 2
    assert (bodies.places_m.tolist(), bodies.sizes_m.tolist()) == ([[0, 0, 1]], [[0.5, 0.5, 2.0]])


def test_a_datum_that_does_not_fit_its_kind_is_left_out_and_named():
    """There is a remark for each of its kinds, and no node."""
    wrong = shown(np.zeros(4), "capsules", "trajectory")
    assert scene_of({wrong.recorded.slot: wrong})[::2] == (
        {},
        tuple(
            f"online:thing/x v1 does not fit the kind {kind}" for kind in ("capsules", "trajectory")
        ),
    )


# ---------------------------------------------------------------- paths

PLACES_M = np.array([[0.0, 0, 1], [1, 0, 1], [1, 2, 1]])
TURNS = np.array([[1.0, 0, 0, 0], [0, 0.6, 0.8, 0], [0.5, 0.5, 0.5, 0.5]])


@dataclass(frozen=True, eq=False)
class Planned:
    name: str
    tool: np.ndarray


@pytest.mark.parametrize(
    "path",
    [
        PLACES_M,
        PLACES_M.astype(np.float32),
        np.hstack((PLACES_M, TURNS)),
        np.stack([moved(*place) for place in PLACES_M]),
        Planned("to the goal", PLACES_M),
        np.vstack((PLACES_M[:2], np.full((1, 3), np.nan), PLACES_M[2:])),
    ],
)
def test_a_trajectory_is_a_line_through_its_places(path):
    """Places, poses, transforms or a plan; a place that is not finite is left out."""
    node = one_node(shown(path, "trajectory", frame="cell"))
    assert isinstance(node, LineNode)
    assert (node.frame, node.places_m.tolist()) == ("cell", PLACES_M.tolist())
    assert Trails().follow({"path": node}, 1) == {}


@pytest.mark.parametrize(
    "path",
    [
        np.zeros((3, 4)),
        np.zeros((3, 3), np.int64),
        np.hstack((PLACES_M, 2.0 * TURNS)),  # seven joints, or capsules
        np.stack([np.eye(4), 2.0 * np.eye(4)]),
        np.zeros((0, 5, 5)),
    ],
)
def test_what_is_no_path_does_not_fit_a_trajectory(path):
    """Wrong columns, whole numbers, quaternions that are not of length 1, no transforms."""
    assert shown(path, "trajectory").drawables == {"trajectory": None}


def test_a_path_of_two_coordinates_lies_at_height_0():
    """A path on the floor needs no third column."""
    node = one_node(shown(PLACES_M[:, :2].astype(np.float32), "trajectory", frame="cell"))
    assert node.places_m.tolist() == (PLACES_M * (1.0, 1.0, 0.0)).tolist()


def test_a_path_of_less_than_two_places_or_too_far_away_is_no_line():
    """It fits its kind, so there is no remark either."""
    for path in (np.zeros((0, 3)), np.zeros((1, 3)), np.full((2, 3), 1e300)):
        found = scene_of({slot("thing"): shown(path, "trajectory")})
        assert (found.nodes, found.remarks) == ({}, ())


def test_a_long_path_is_thinned_and_keeps_its_ends():
    """The remark gives both numbers, and the extent still reaches the last place."""
    path = np.arange(3.0 * 25_000).reshape(-1, 3)
    scene = scene_of({slot("thing"): shown(path, "trajectory")})
    (node,) = scene.nodes.values()
    assert len(node.places_m) == 8_334
    assert node.places_m[[0, -1]].tolist() == path[[0, -1]].tolist()
    assert scene.remarks == (
        "online:thing/x has 25000 places; a line through 8334 of them is shown",
    )
    assert extent_of(scene)[1].tolist() == path[-1].tolist()


def test_a_colour_of_a_difference_replaces_that_of_the_datum():
    """Also where each point has a colour; `linear` gives it in linear light."""
    cloud = shown(Cloud(np.zeros((1, 3)), np.zeros((1, 3), np.uint8)))
    scene = scene_of({cloud.recorded.slot: cloud}, tints={cloud.recorded.slot: (255, 150, 0)})
    (node,) = scene.nodes.values()
    assert node.colours == (255, 150, 0)
    assert linear((0, 255, 128)) == (0, 255, 56)


# ---------------------------------------------------------------- cameras


def lens(entity="camera/1"):
    matrix = np.array([[100.0, 0, 4], [0, 100.0, 3], [0, 0, 1]])
    return shown(
        Lens(matrix, 8, 6, moved(0.0, 0.0, -2.0)), "calibration", "transform",
        entity=entity, aspect="calibration", parent="cell", inverse=True,
    )  # fmt: skip


def test_an_image_stands_at_its_camera_with_its_mask_in_red():
    """The frustum has the opening of the calibration; the camera is where its transform says."""
    image = shown(
        np.full((6, 8, 3), (0, 0, 200), np.uint8), "image", entity="camera/1", encoding="bgr8"
    )
    mask = shown(np.eye(6, 8) > 0, "mask", entity="camera/1", aspect="mask")
    scene = scene_of({one.recorded.slot: one for one in (image, mask, lens())})
    (node,) = scene.nodes.values()
    assert isinstance(node, FrustumNode)
    assert node.field_rad == pytest.approx(2 * np.arctan(0.03))
    assert node.aspect == 8 / 6
    assert node.image[0, 1].tolist() == [200, 0, 0]  # blue, green, red is how it came
    assert node.image[0, 0].tolist() == [227, 25, 15]
    assert scene.frames["camera/1"][:3, 3].tolist() == [0.0, 0.0, 2.0]


def test_a_node_is_made_once_for_each_version():
    """Pages send a node only if it is another object."""
    image = shown(np.zeros((6, 8, 3), np.uint8), "image", entity="camera/1")
    newer = shown(np.zeros((6, 8, 3), np.uint8), "image", entity="camera/1", version=2)
    camera = lens()
    first, again, other = (
        scene_of({each.recorded.slot: each for each in (one, camera)}).nodes[
            "online:camera/1/x#camera"
        ]
        for one in (image, image, newer)
    )
    assert first is again
    assert first is not other


def test_of_two_images_in_one_frame_one_is_drawn_and_the_other_named():
    """A colour and a depth image of one camera lie in one another."""
    pixels = np.zeros((6, 8, 3), np.uint8)
    colour = shown(pixels, "image", entity="camera/1", aspect="colour")
    depth = shown(np.ones((6, 8), np.uint16), "image", entity="camera/1", aspect="depth")
    both = scene_of({one.recorded.slot: one for one in (colour, depth, lens())})
    alone = scene_of({one.recorded.slot: one for one in (depth, lens())})
    assert [type(node) for node in both.nodes.values()] == [FrustumNode]
    assert any("camera/1/depth is behind online:camera/1/colour" in one for one in both.remarks)
    (node,) = alone.nodes.values()
    assert node.image.shape[:2] == (6, 8)


def test_pictures_of_one_image_with_masks_of_many_versions_are_few():
    """They would keep the masks alive; pages of several threads make them at once."""
    image = shown(np.zeros((6, 8, 3), np.uint8), "image", entity="camera/1")

    def draw(first):
        for number in range(first, first + 300):
            mask = shown(np.eye(6, 8) > 0, "mask", entity="camera/1", aspect="mask", version=number)
            scene_of({one.recorded.slot: one for one in (image, mask)})

    with ThreadPoolExecutor(3) as threads:
        list(threads.map(draw, (1, 1001, 2001)))
    assert len(image.made) <= scenes.VARIANTS_MAX + 4  # three threads, and the node of no mask


@pytest.mark.parametrize(
    ("pixels", "corner"),
    [
        (np.array([[7, 0], [0, 0]], np.uint8), [7, 7, 7]),
        (np.array([[500, 100], [0, 0]], np.uint16), [255, 255, 255]),
        (np.array([[np.nan, 1.0], [2.0, 3.0]], np.float32), [0, 0, 0]),
    ],
)
def test_images_of_numbers_are_grey(pixels, corner):
    """Bytes stay as they are; other numbers are stretched, and what is not finite is black."""
    node = one_node(shown(pixels, "image"))
    assert node.image[0, 0].tolist() == corner


def test_a_large_image_is_made_small():
    """Both sides shrink by the same factor."""
    node = one_node(shown(np.zeros((480, 640, 3), np.uint8), "image"))
    assert node.image.shape == (240, 320, 3)


@pytest.mark.parametrize("packs", [True, False])
@pytest.mark.parametrize("box", [(8, 24, 16, 40), (0, 48, 0, 64), (17, 18, 21, 22), (5, 44, 3, 62)])
def test_an_image_is_as_large_as_its_side_asks_and_its_mask_fits_it(box, packs):
    """Of a mask no more is unpacked than is shown, and around the box that it covers nothing."""
    top, bottom, left, right = box
    covers = np.zeros((48, 64), bool)
    covers[top:bottom, left:right] = True
    image = shown(np.full((48, 64, 3), 100, np.uint8), "image", entity="camera/1")
    for covered in (covers, np.zeros_like(covers)):
        value = {"packed": np.packbits(covered, axis=1)} if packs else covered
        mask = shown(value, "mask", entity="camera/1", aspect="mask")
        assert (mask.drawables["mask"].pixels == 255 * covered).all()
        data = {one.recorded.slot: one for one in (image, mask)}
        for side_px, step in ((64, 1), (32, 2), (22, 3), (16, 4), (4, 16)):
            (node,) = scene_of(data, sides_px={"camera/1": side_px}).nodes.values()
            red = (node.image == (177, 75, 65)).all(axis=2)
            assert (red == covered[::step, ::step]).all()


# ---------------------------------------------------------------- poses, labels, files


def test_a_pose_leaves_a_trail_that_a_step_back_ends():
    """It begins with the second place and does not return with the earlier moment."""
    trails = Trails()
    nodes = [{"p": AxesNode("cell", moved(x_m))} for x_m in (0.0, 1.0, 2.0)]
    assert trails.follow(nodes[0], 1) == {}
    assert trails.follow(nodes[1], 2)["trail p"].places_m[:, 0].tolist() == [0.0, 1.0]
    assert trails.follow(nodes[2], 3)["trail p"].places_m[:, 0].tolist() == [0.0, 1.0, 2.0]
    assert trails.follow(nodes[1], 2) == {}


def test_labels_stand_at_their_entities():
    """In the middle of what is drawn, in its frame; an entity that is not drawn has none."""
    cloud = shown(
        Cloud(np.array([[0, 0, 0], [2, 0, 0]], np.float32)), entity="pack/1", frame="tray"
    )
    scene = scene_of({cloud.recorded.slot: cloud})
    (label,) = labels_of(scene, {"pack/1": "dented", "pack/2": "gone"}).values()
    assert (label.text, label.frame, label.place_m.tolist()) == ("dented", "tray", [1.0, 0.0, 0.0])


def test_a_mesh_is_a_file_that_others_read():
    """Three vertices of three floats, one face with a count and three numbers."""
    content = ply_of(shown(Mesh(np.eye(3), np.array([[0, 1, 2]]))))
    head, body = content.split(b"end_header\n")
    assert b"element vertex 3" in head
    assert struct.unpack("<9f", body[:36]) == tuple(np.eye(3).ravel())
    assert struct.unpack("<B3i", body[36:]) == (3, 0, 1, 2)


def test_an_image_is_a_png_in_full_size():
    """The file is not thinned as the picture on the page is."""
    imageio = pytest.importorskip("imageio.v3")
    pixels = np.arange(400 * 3, dtype=np.uint8).reshape(1, 400, 3)
    content = png_of(shown(pixels, "image"))
    assert np.array_equal(imageio.imread(BytesIO(content)), pixels)


@pytest.mark.parametrize("make", [ply_of, png_of])
def test_a_datum_without_a_shape_is_no_file(make):
    """The refusal says how the datum is shown instead."""
    with pytest.raises(ConfigError, match="is shown as json"):
        make(shown(1.5))


def test_an_empty_image_is_no_file():
    """An image without rows is refused in words, not by the encoder."""
    with pytest.raises(ConfigError, match=r"the image of .* is empty"):
        png_of(shown(np.zeros((0, 3), np.uint8), "mask"))


def test_a_label_stands_at_the_image_of_a_camera():
    """Its node is named as all others are."""
    image = shown(np.zeros((6, 8, 3), np.uint8), "image", entity="camera/1")
    scene = scene_of({image.recorded.slot: image})
    assert list(labels_of(scene, {"camera/1": "late"})) == ["label camera/1"]


def test_an_image_of_numbers_is_a_png_of_the_same_numbers():
    """A depth in millimetres has 16 bits."""
    import imageio.v3 as imageio

    depth = np.array([[1000, 2000], [3000, 65535]], np.uint16)
    assert imageio.imread(png_of(shown(depth, "image"))).tolist() == depth.tolist()


def test_what_lies_too_far_apart_or_in_another_type_is_left_out_not_raised():
    """A thread of all pages draws it."""
    far = np.array([[-(2**63), 0, 0], [2**63 - 1, 0, 0]], np.int64)
    voxels = shown(Occupied(far, 0.1), "voxels")
    assert scene_of({voxels.recorded.slot: voxels}).nodes == {}
    half = shown(np.eye(4, dtype=np.float16), "transform", inverse=True, parent="cell")
    assert scene_of({half.recorded.slot: half}).nodes == {}
    bits = shown({"packed": np.ones((4, 1), bool)}, "mask")
    assert scene_of({bits.recorded.slot: bits}).nodes


def test_named_fields_go_before_those_that_look_alike():
    """Colours are no triangles, and normals no points."""
    corners, faces = np.eye(3), np.array([[0, 1, 2]])
    mesh = shown(
        {"colours": np.zeros((3, 3), np.uint8), "vertices_m": corners, "triangles": faces}, "mesh"
    )
    cloud = shown({"normals": np.zeros((3, 3)), "points_m": corners}, "point_cloud")
    assert mesh.drawables["mesh"].triangles.tolist() == faces.tolist()
    assert cloud.drawables["point_cloud"].points_m.tolist() == corners.tolist()
