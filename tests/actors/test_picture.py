"""Pictures show what is there: places, colours, shadows, outlines; files are whole or absent."""

from __future__ import annotations

import numpy as np
import pytest

from actors.geometry.files import write_whole
from actors.geometry.pictures.cloud_picture import draw_points, with_box
from actors.geometry.pictures.mesh_picture import Body, draw_bodies, viewpoint
from actors.geometry.pictures.picture import (
    bars,
    depth_picture,
    png_bytes,
    tiles,
    with_label,
)
from actors.geometry.poses import inverse, looking_at, moved
from actors.geometry.shapes import Acquisition, Camera

cv2 = pytest.importorskip("cv2", exc_type=ImportError)

SMALL = (160, 120)
RED, GREEN, BLUE = (np.array(c, np.uint8) for c in ((200, 40, 40), (40, 180, 60), (40, 60, 200)))
CUBE = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
CUBE_FACES = np.array(
    [
        [0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
        [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3],
    ]
)  # fmt: skip


def cube(colour, *, at=(0.0, 0.0, 0.0), edge_m=0.1):
    """Return a cube with its lowest corner at a place."""
    return Body(CUBE * edge_m + at, CUBE_FACES, colour)


def pixel(view, place):
    """Return row and column of a place in a picture."""
    x, y, z = moved(np.array([place], float), inverse(view.world_from_camera))[0]
    camera = view.camera
    return round(y / z * camera.fy_px + camera.cy_px), round(x / z * camera.fx_px + camera.cx_px)


def hue(picture, at):
    """Return which channel is strongest at a pixel."""
    return "rgb"[int(np.argmax(picture[at]))]


@pytest.fixture
def ray_caster():
    """Skip where Open3D is missing."""
    return pytest.importorskip("open3d", exc_type=ImportError)


def test_viewpoint_sees_all_points_and_fills_the_picture():
    """Every corner falls inside, and the farthest comes within a tenth of the rim."""
    for azimuth_deg in (-120.0, 0.0, 45.0):
        view = viewpoint(CUBE, azimuth_deg=azimuth_deg, elevation_deg=20.0, size_px=SMALL)
        at = np.array([pixel(view, corner) for corner in CUBE])
        share = np.abs(at - (59.5, 79.5)) / (60.0, 80.0)
        assert share.max() < 0.95
        assert share.max() > 0.8


def test_nearer_body_hides_the_farther_one(ray_caster):
    """A red cube before a blue one is red where they overlap, and background is light."""
    bodies = [cube(BLUE), cube(RED, at=(0.3, 0.0, 0.0))]
    eye = np.array([1.5, 0.05, 0.05])
    view = Acquisition(
        Camera(160, 120, 300.0, 300.0, 79.5, 59.5), looking_at(eye, np.array([0.0, 0.05, 0.05]))
    )

    picture = draw_bodies(bodies, view)

    assert hue(picture, (60, 80)) == "r"
    assert picture[5, 5].min() > 220


def test_colours_may_be_per_triangle_or_per_vertex(ray_caster):
    """Both kinds reach the right faces."""
    by_face = np.tile(BLUE, (12, 1))
    by_face[10:] = RED  # the lid
    by_vertex = np.where((CUBE[:, 2] > 0.5)[:, None], RED, BLUE).astype(np.uint8)
    view = viewpoint(CUBE, elevation_deg=35.0, size_px=SMALL)

    for colours in (by_face, by_vertex):
        picture = draw_bodies([Body(CUBE, CUBE_FACES, colours)], view)
        assert hue(picture, pixel(view, (0.5, 0.5, 1.0))) == "r"
        assert hue(picture, pixel(view, (0.6, 0.0, 0.05))) == "b"


def test_body_is_refused_when_its_colours_fit_nothing():
    """Five colours fit neither 8 vertices nor 12 triangles."""
    with pytest.raises(ValueError, match="one per vertex"):
        Body(CUBE, CUBE_FACES, np.zeros((5, 3), np.uint8))


def test_floor_catches_a_shadow_beside_the_body(ray_caster):
    """The floor is darker at the foot of a cube than far from it."""
    view = viewpoint(CUBE * 0.1, elevation_deg=35.0, size_px=SMALL)

    with_floor = draw_bodies([cube(RED)], view, ground_z_m=0.0).astype(int)
    without = draw_bodies([cube(RED)], view).astype(int)

    darker = without.sum(2) - with_floor.sum(2)
    foot = pixel(view, (0.112, 0.05, 0.0))
    assert darker[foot] > 30
    assert abs(darker[2, 2]) < 6


def test_picture_is_the_same_when_drawn_again(ray_caster):
    """Equal input gives equal pixels."""
    view = viewpoint(CUBE * 0.1, size_px=SMALL)

    one, other = (draw_bodies([cube(GREEN)], view, ground_z_m=0.0) for _ in range(2))

    assert np.array_equal(one, other)


def test_unlit_body_keeps_its_colour_exactly(ray_caster):
    """With `relight` 0 a photograph's colours pass through."""
    view = viewpoint(CUBE * 0.1, size_px=SMALL)

    picture = draw_bodies([cube(GREEN)], view, relight=0.0)

    assert np.array_equal(picture[pixel(view, (0.05, 0.05, 0.1))], GREEN)


def test_nearer_point_hides_the_farther_one():
    """Of two points on one line of sight the nearer is drawn, in any order of the cloud."""
    view = Acquisition(Camera(40, 30, 40.0, 40.0, 19.5, 14.5), np.eye(4))
    points = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 2.0], [0.0, 0.0, -1.0]])

    for order in ([0, 1, 2], [1, 0, 2], [2, 1, 0]):
        colours = np.array([RED, BLUE, GREEN])[order]
        picture = draw_points(points[order], colours, view, size_m=0.2)
        assert hue(picture, (14, 19)) == "r"


def test_box_is_drawn_where_its_corners_are():
    """Only pixels on the edges change."""
    view = viewpoint(CUBE, size_px=SMALL)
    plain = np.full((120, 160, 3), 255, np.uint8)

    picture = with_box(
        plain, view, (np.zeros(3), np.ones(3)), world_from_box=np.eye(4), colour=(0, 0, 255)
    )

    assert picture[pixel(view, (0.5, 0.0, 0.0))][0] < 128
    assert np.array_equal(picture[pixel(view, (0.5, 0.25, 1.0))], (255, 255, 255))


def test_unknown_depth_is_not_drawn_as_near_or_far():
    """Zeros are lighter than any measured pixel."""
    depth_mm = np.tile(np.linspace(500, 1500, 80).astype(np.uint16), (60, 1))
    depth_mm[:, :10] = 0

    picture = depth_picture(depth_mm)

    assert picture[30, 12:].max() < np.median(picture[:, :10])
    assert picture[30, 20, 0] > picture[30, 70, 0]


def test_label_changes_pixels_where_it_stands_and_nowhere_else():
    """A label at the rim is cut off, not refused."""
    plain = np.full((60, 80, 3), 120, np.uint8)

    inside, rim = with_label(plain, "5.2 mm", (5, 5)), with_label(plain, "5.2 mm", (60, 52))

    assert (inside[5:25, 5:60] != 120).any()
    assert (inside[40:] == 120).all()
    assert rim.shape == plain.shape


def test_tiles_hold_every_picture_unchanged():
    """Three pictures of two sizes find their places in two columns."""
    pictures = [np.full((h, 40, 3), v, np.uint8) for h, v in ((30, 10), (20, 20), (30, 30))]

    sheet = tiles(pictures, ["a", "b", "c"], columns=2)

    for picture, value in zip(pictures, (10, 20, 30), strict=True):
        assert (sheet == value).all(2).sum() == picture.shape[0] * picture.shape[1]


def test_bars_are_as_long_as_their_values():
    """The bar of 1.0 is twice as long as that of 0.5."""
    sheet = bars([("one", 1.0), ("half", 0.5)], size_px=(400, 150))

    full = (sheet[36] == (22, 163, 102)).all(1).sum()
    half = (sheet[82] == (168, 178, 190)).all(1).sum()
    assert full == pytest.approx(2 * half, abs=3)


def test_png_comes_back_as_it_was(tmp_path):
    """Red stays red through the file."""
    picture = np.zeros((20, 30, 3), np.uint8)
    picture[:, :, 0] = np.arange(30)

    write_whole({tmp_path / "new" / "a.png": png_bytes(picture)})

    assert np.array_equal(cv2.imread(str(tmp_path / "new" / "a.png"))[:, :, ::-1], picture)
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["a.png"]


def test_files_stay_as_they_were_when_one_of_a_set_cannot_be_written(tmp_path):
    """A directory in the place of one file leaves the other file untouched and no drafts."""
    old = tmp_path / "old.png"
    old.write_bytes(b"before")
    (tmp_path / "taken.png").mkdir()
    content = png_bytes(np.zeros((4, 4, 3), np.uint8))

    with pytest.raises(OSError, match="taken"):
        write_whole({old: content, tmp_path / "taken.png": content})

    assert old.read_bytes() == b"before"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["old.png", "taken.png"]
