"""The renderer against geometry worked out here: outlines, depth, shadows, light, noise."""

import functools

import cv2
import numpy as np
import pytest

from actors.geometry.arms.kinematics import capsules_at
from actors.geometry.capsules import fill, outlines
from actors.workcell.scenarios import scenario_of
from actors.workcell.simulation.arm import ARM, HOME_RAD
from actors.workcell.simulation.drawing.render import NOISE_LEVELS, View
from actors.workcell.simulation.room import BOXES, LAMP_M, cameras
from actors.workcell.simulation.stage import Stage

SCALE = 0.25
LENS = (-0.12, 0.03, 0.001, -0.002, 0.0)


@functools.cache
def view(number, distortion=(0.0,) * 5):
    return View(cameras(SCALE, distortion)[number], seed=5)


def sphere(x, y, z, radius):
    return np.array([[x, y, z, x, y, z, radius]])


def grey(count):
    return np.full((count, 3), 0.5)


def rays(calibration):
    """Directions of all pixels in the camera's frame, worked out without the renderer."""
    height, width = calibration.height, calibration.width
    column, row = np.meshgrid(np.arange(width), np.arange(height))
    k = calibration.camera_matrix
    return np.stack(
        [(column - k[0, 2]) / k[0, 0], (row - k[1, 2]) / k[1, 1], np.ones_like(row, float)], -1
    )


def seen(calibration, point):
    pose = calibration.camera_from_cell
    return pose[:3, :3] @ point + pose[:3, 3]


def pixel(calibration, point):
    flat, _ = cv2.projectPoints(
        np.asarray(point, float)[None],
        cv2.Rodrigues(calibration.camera_from_cell[:3, :3])[0],
        calibration.camera_from_cell[:3, 3],
        calibration.camera_matrix,
        calibration.distortion,
    )
    return flat.ravel()


@pytest.mark.parametrize("number", [0, 5])
def test_outline_and_depth_of_a_sphere_are_exact(number):
    """A pixel shows a ball if its ray passes within the radius, at the depth of the first cut."""
    camera, centre, radius = view(number).calibration, np.array([0.2, -0.4, 1.6]), 0.22
    drawn = view(number).render(sphere(*centre, radius), grey(1))
    middle, way = seen(camera, centre), rays(camera)
    along = way @ middle / (way * way).sum(-1)
    closest = np.linalg.norm(middle - along[..., None] * way, axis=-1)
    expected = closest < radius
    assert expected.sum() > 100
    assert ((drawn.names > 0) != expected).sum() <= 2
    inside = expected & (drawn.names > 0)
    half = np.sqrt(radius**2 - closest[inside] ** 2) / np.linalg.norm(way[inside], axis=-1)
    np.testing.assert_allclose(drawn.depth_m[inside], along[inside] - half, atol=2e-4)


@pytest.mark.parametrize("ends", [(2.0, 3.0), (3.0, 2.0)])
def test_a_capsule_seen_along_its_axis_shows_its_nearer_end(ends):
    """In whichever order its ends are given."""
    from actors.workcell.simulation.drawing.kernels import draw

    depth_m = np.full((1, 1), np.inf, np.float32)
    capsule = np.array([[ends[0], 0.0, 0.0, ends[1], 0.0, 0.0, 0.1]])
    ray, window = np.array([[[1.0, 0.0, 0.0, 1.0]]], np.float32), np.array([[0, 0, 1, 1]], np.int32)
    image, names = np.empty((0, 0, 3), np.uint8), np.empty((0, 0), np.int16)
    draw(image, depth_m, names, np.zeros(3), ray, window, capsule, grey(1), np.zeros(3), 0)
    assert depth_m[0, 0] == pytest.approx(1.9)


def test_capsules_of_arm_and_person_fill_their_outlines():
    """Nothing is drawn outside the outlines, and almost nothing is left open inside."""
    scene = Stage(scenario_of("visit", 1)).scene_at(6.0, capsules_at(ARM, np.array(HOME_RAD))[0])
    camera = view(3).calibration
    drawn = view(3).render(scene.capsules, scene.colours, ())
    around = outlines(
        scene.capsules, [(camera.camera_matrix, camera.distortion, camera.camera_from_cell)]
    )
    mask = fill(around, camera.height, camera.width)[0] > 0
    shown = drawn.names > 0
    assert not (shown & ~mask).any()
    assert (mask & ~shown).sum() < 0.2 * shown.sum()  # outlines are drawn with their border
    eroded = cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    assert (eroded & ~shown).sum() < 0.02 * shown.sum()  # gaps between limbs


@pytest.mark.parametrize("number", [1, 6])
def test_distorted_lens_shows_things_where_opencv_projects_them(number):
    """Small balls lie within 0.35 pixels of their projection."""
    one, camera = view(number, LENS), view(number, LENS).calibration
    for centre in ((1.3, 0.9, 1.4), (-0.5, 0.2, 1.9), (0.0, -1.6, 0.5)):
        names = one.render(sphere(*centre, 0.06), grey(1), ()).names
        where = np.argwhere(names > 0).mean(0)[::-1]
        np.testing.assert_allclose(where, pixel(camera, centre), atol=0.35)


def test_nearer_things_hide_what_is_behind_in_any_order():
    """Of two balls on one ray the nearer one shows, whichever is given first."""
    camera = view(0).calibration
    eye = -camera.camera_from_cell[:3, :3].T @ camera.camera_from_cell[:3, 3]
    toward = np.array([0.0, 0.0, 0.7]) - eye
    near, far = sphere(*(eye + 0.5 * toward), 0.1), sphere(*(eye + 0.7 * toward), 0.1)
    row, column = np.rint(pixel(camera, near[0, :3])).astype(int)[::-1]
    for capsules, name in ((np.vstack([near, far]), 1), (np.vstack([far, near]), 2)):
        drawn = view(0).render(capsules, grey(2), ())
        assert drawn.names[row, column] == name
    distance = 0.5 * np.linalg.norm(toward) - 0.1
    assert drawn.depth_m[row, column] == pytest.approx(distance, abs=0.01)


def test_boxes_hide_what_is_behind_them():
    """Camera 2 looks over the conveyor: a ball behind it shows without it only."""
    behind = sphere(-0.3, -0.95, 0.2, 0.08)
    assert (view(2).render(behind, grey(1), ()).names > 0).any()
    assert not (view(2).render(behind, grey(1), BOXES).names > 0).any()


def test_floor_and_table_have_the_depth_of_their_planes():
    """Three points of table and floor are as deep as the planes that they lie in."""
    camera, depth = view(4).calibration, view(4).backdrop().depth_m
    for point in ((1.0, 0.2, 0.75), (0.9, -1.0, 0.0), (0.8, 1.0, 0.0)):
        column, row = np.rint(pixel(camera, point)).astype(int)
        way = rays(camera)[row, column] @ camera.camera_from_cell[:3, :3]
        eye = -camera.camera_from_cell[:3, :3].T @ camera.camera_from_cell[:3, 3]
        assert depth[row, column] == pytest.approx((point[2] - eye[2]) / way[2], abs=1e-4)


def test_two_views_agree_on_where_surfaces_are():
    """What camera 0 measures lies, for camera 4, on its own surface or behind it."""
    scene = Stage(scenario_of("visit", 2)).scene_at(7.0, capsules_at(ARM, np.array(HOME_RAD))[0])
    first, other = (view(n).render(scene.capsules, scene.colours) for n in (0, 4))
    one, two = view(0).calibration, view(4).calibration
    moving = first.names > 0
    points = rays(one)[moving] * first.depth_m[moving][:, None]
    cell = (points - one.camera_from_cell[:3, 3]) @ one.camera_from_cell[:3, :3]
    there = cell @ two.camera_from_cell[:3, :3].T + two.camera_from_cell[:3, 3]
    flat = there @ two.camera_matrix.T
    column, row = np.rint(flat[:, :2] / flat[:, 2:]).astype(int).T
    inside = (column >= 0) & (column < two.width) & (row >= 0) & (row < two.height)
    column, row, there, names = (
        values[inside] for values in (column, row, there, first.names[moving])
    )
    assert inside.sum() > 300
    measured = other.depth_m[row, column]
    # At an outline the nearest pixel of the other camera may look past the thing.
    border = cv2.dilate(other.names.astype(np.float32), np.ones((3, 3))) != cv2.erode(
        other.names.astype(np.float32), np.ones((3, 3))
    )
    clear = ~border[row, column]
    assert (measured[clear] <= there[clear, 2] + 0.06).all()
    same = clear & (other.names[row, column] == names)
    on_surface = np.abs(measured - there[:, 2])[same] < 0.05
    assert on_surface.sum() > 20


def test_shadow_falls_behind_a_thing_as_the_lamp_sees_it():
    """Where the ray from lamp through ball lands, the image darkens by its light factor."""
    one, ball = view(4), np.array([0.0, -0.4, 1.75])
    landed = np.array(LAMP_M) + (ball - LAMP_M) * LAMP_M[2] / (LAMP_M[2] - ball[2])
    lit, drawn = one.backdrop().image, one.render(sphere(*ball, 0.2), grey(1))
    column, row = np.rint(pixel(one.calibration, landed)).astype(int)
    factor = one.backdrop().light[row, column, 3]
    assert factor < 0.9
    expected = lit[row, column] * factor
    np.testing.assert_allclose(drawn.image[row, column], expected, atol=1.0)
    assert drawn.names[row, column] == 0
    changed = (drawn.image != lit).any(-1) & (drawn.names == 0)
    assert changed.sum() < 0.2 * changed.size
    away = np.linalg.norm(np.argwhere(changed) - [row, column], axis=1)
    assert away.max() < 40


def test_drawing_in_two_steps_is_drawing_at_once():
    """First the people, then the arm over them: same depth, same shadows where both fall."""
    scene = Stage(scenario_of("visit", 1)).scene_at(5.0, capsules_at(ARM, np.array(HOME_RAD))[0])
    one, arm = view(7), slice(None, 5)
    at_once = one.render(scene.capsules, scene.colours)
    people = one.render(scene.capsules[5:], scene.colours[5:])
    steps = one.render(scene.capsules[arm], scene.colours[arm], onto=people)
    np.testing.assert_array_equal(steps.depth_m, at_once.depth_m)
    np.testing.assert_allclose(steps.image, at_once.image.astype(int), atol=2.0)
    np.testing.assert_array_equal(steps.lamp_m, at_once.lamp_m)
    unseen = one.render(scene.capsules, None)
    np.testing.assert_array_equal(unseen.depth_m, at_once.depth_m)
    np.testing.assert_array_equal(unseen.image, one.backdrop().image)


def test_nothing_moves_nothing_changes():
    """Without capsules the image is the backdrop and no pixel has a name."""
    drawn = view(0).render(np.empty((0, 7)), np.empty((0, 3)))
    np.testing.assert_array_equal(drawn.image, view(0).backdrop().image)
    assert not drawn.names.any()


def test_images_of_one_stamp_are_equal_and_of_others_differ_by_noise_only():
    """The spread of the difference is that of two noises."""
    still = view(1).backdrop().image
    stamp_ns = 1_700_000_000_000_000_000
    first = view(1).exposed(still, stamp_ns)
    np.testing.assert_array_equal(first, View(view(1).calibration, 5).exposed(still, stamp_ns))
    other = view(1).exposed(still, stamp_ns + 100_000_000)
    assert (first != other).any()
    difference = first.astype(int) - other
    assert difference.std() == pytest.approx(NOISE_LEVELS * np.sqrt(2.0), rel=0.1)
    assert np.abs(difference).max() < 8 * NOISE_LEVELS


def test_light_that_drops_darkens_the_image():
    """At 0.7 of the light the mean of the image is 0.7 of what it was."""
    still, dark = view(1).backdrop().image, view(1).exposed(view(1).backdrop().image, 1, 0.7)
    assert dark.mean() == pytest.approx(0.7 * still.mean(), rel=0.01)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_no_camera_sees_who_hides_in_the_cabinet(seed):
    """None of eight cameras does; at least six see the person outside it."""
    stage = Stage(scenario_of("S4", seed, 20.0))
    hidden = stage.scene_at(8.0)
    out = stage.scene_at(15.5)
    for number in range(8):
        names = view(number).render(hidden.capsules, hidden.colours, hidden.boxes).names
        assert not names.any(), number
    seen = [view(n).render(out.capsules, out.colours, out.boxes).names.any() for n in range(8)]
    assert sum(seen) >= 6


def test_stage_says_what_was_left_and_how_bright_it_is():
    """A box appears at its second, the light drops at its own, people are counted."""
    left, dark = Stage(scenario_of("S6", 1, 20.0)), Stage(scenario_of("S10", 1, 20.0))
    from_s = left.scenario.things[0].from_s
    assert left.things_at(from_s - 0.01) == ()
    assert [box.name for box in left.things_at(from_s)] == ["thing-0"]
    assert left.rooms == (left.boxes, left.boxes + left.things_at(from_s))
    assert (dark.brightness_at(9.9), dark.brightness_at(10.1)) == (1.0, 0.7)
    assert len(Stage(scenario_of("S11", 1, 20.0)).bodies_at(3.0)) == 2
    assert Stage(scenario_of("S1", 1)).scene_at(5.0).capsules.shape == (0, 7)
