"""Claims about what the sensors of the physical cell see."""

import numpy as np
import pytest

from actors.geometry.poses import inverse, moved, on_tray
from actors.geometry.shapes import VGA
from actors.geometry.surfaces.depth import metres, points_grid
from actors.geometry.surfaces.rendering import directions
from actors.palletizing.control.controller import ControllerError
from actors.palletizing.simulation import physical_sensors
from actors.palletizing.simulation.cell.picture import CellPictures
from actors.palletizing.simulation.packages import Truth, deformed, pressed
from actors.palletizing.simulation.physical_packages import (
    Damage,
    Dent,
    dented_mesh,
    face_of,
    patch_area,
)
from actors.palletizing.simulation.physical_sensors import (
    PhysicalBeltSensor,
    PhysicalTraySensor,
    arm_meshes,
    package_meshes,
    still_meshes,
)
from actors.palletizing.simulation.physics import PhysicalCell
from actors.palletizing.simulation.products import product_mesh
from actors.palletizing.simulation.sensors import true_depth

from .moves import carton

pytest.importorskip("open3d", exc_type=ImportError)
mujoco = pytest.importorskip("mujoco", exc_type=ImportError)


@pytest.fixture(scope="module")
def cell():
    """Return a cell with two cartons on the tray and one on the belt."""
    cell = PhysicalCell([carton(0), carton(1), carton(2, pick_offset_m=(0.004, -0.003))], seed=1)
    cell.put(0, cell.layout.base_from_tray @ on_tray(-0.2, 0.1, 0.3))
    cell.put(1, cell.layout.base_from_tray @ on_tray(0.25, -0.15, 1.4))
    cell.put(2, cell.layout.base_from_belt @ on_tray(-0.1, 0.01, 0.05))
    cell.step(100)
    return cell


def physics_depth_m(cell, base_from_camera, rows, columns):
    """Return what MuJoCo's own rays hit from a camera, along its optical axis."""
    rays = directions(VGA)[rows, columns].astype(float)
    turned = rays @ base_from_camera[:3, :3].T
    lengths = np.linalg.norm(turned, axis=1)
    seen = np.array([-1], np.int32)
    start = np.ascontiguousarray(base_from_camera[:3, 3])
    hits = [
        mujoco.mj_ray(cell.model, cell.data, start, ray / length, None, 1, -1, seen)
        for ray, length in zip(turned, lengths, strict=True)
    ]
    return np.array(hits) / lengths


@pytest.mark.parametrize("which", [PhysicalTraySensor, PhysicalBeltSensor])
def test_image_shows_what_physics_has(cell, which):
    """Packages, tray, belt, rim and arm are in the image where MuJoCo's rays hit them: 1 mm."""
    sensor = which(cell.shown, seed=1)
    frame = (
        cell.layout.base_from_tray if which is PhysicalTraySensor else cell.layout.base_from_belt
    )
    random = np.random.default_rng(3)
    rows, columns = random.integers(0, VGA.shape[0], 4000), random.integers(0, VGA.shape[1], 4000)

    seen = sensor.true_depth()[rows, columns]
    expected = physics_depth_m(cell, frame @ sensor.acquisition.world_from_camera, rows, columns)

    near = np.isfinite(seen) & (expected < 3.0)
    assert near.sum() > 3500
    wrong = np.abs(seen[near] - expected[near]) > 1e-3
    assert wrong.mean() < 0.01, "only pixels on edges, and the facets of round links, may differ"


def test_package_is_seen_where_physics_has_it(cell):
    """The points on a carton's block lie on its true top within 1 mm, noise included in the mean."""
    sensor = PhysicalTraySensor(cell.shown, seed=1)
    frame = sensor.capture(0)
    points = points_grid(metres(frame.depth_mm), VGA).reshape(-1, 3)
    world = moved(points[np.isfinite(points[:, 2])], frame.acquisition.world_from_camera)

    for number in (0, 1):
        product = moved(world, inverse(cell.truth().packages[number].tray_from_product))
        on_top = (np.abs(product[:, 0] + 0.025) < 0.06) & (np.abs(product[:, 1]) < 0.035)
        assert on_top.sum() > 1000
        assert np.median(product[on_top, 2]) == pytest.approx(0.07, abs=1e-3)


def test_empty_image_has_no_package(cell):
    """The image of the empty tray differs from the present one where packages are, not elsewhere."""
    sensor = PhysicalTraySensor(cell.shown, seed=1)

    empty, full = sensor.capture_empty(), sensor.capture(0)

    change = np.abs(metres(empty.depth_mm) - metres(full.depth_mm)) > 0.03
    grid = points_grid(sensor.true_depth(), VGA)
    high = grid[..., 2] < 0.95 - 0.03
    assert change[high].mean() > 0.8
    assert change[~high & np.isfinite(grid[..., 2])].mean() < 0.02


def test_image_is_that_of_all_meshes_at_once_and_only_what_has_moved_is_drawn_again(cell):
    """At rest nothing is drawn; a package that moves by 1 mm is drawn once."""
    sensor = PhysicalTraySensor(cell.shown, seed=1)
    shown = cell.shown()
    meshes = [*still_meshes(cell.layout), *arm_meshes(shown)]
    meshes += [mesh for package in shown.packages for mesh in package_meshes(package)]
    tray_from_base = inverse(cell.layout.base_from_tray)
    placed = [(moved(vertices, tray_from_base), triangles) for vertices, triangles in meshes]

    np.testing.assert_array_equal(sensor.true_depth(), true_depth(placed, sensor.acquisition))

    drawn = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(physical_sensors, "drawn", lambda *what: drawn.append(what) or nothing)
        nothing = (slice(0, 0), slice(0, 0)), np.zeros((0, 0), np.float32)
        sensor.true_depth()
        assert not drawn
        cell.put(0, cell.pose(0) @ on_tray(0.001, 0.0, 0.0))
        sensor.true_depth()
    assert len(drawn) == 1


def test_images_of_one_moment_are_equal(cell):
    """Two sensors of one seed see the same; the next moment has other noise."""
    one, other = (PhysicalTraySensor(cell.shown, seed=4) for _ in range(2))

    first, second = one.capture(0), other.capture(0)
    cell.step()
    third = one.capture(0)

    np.testing.assert_array_equal(first.depth_mm, second.depth_mm)
    assert (first.depth_mm != third.depth_mm).any()


def test_belt_sensor_is_off_by_the_packages_error(cell):
    """What it reports of its pose is off by the pick's error of the package that lies there."""
    sensor = PhysicalBeltSensor(cell.shown, seed=1)

    frame = sensor.capture(2)

    off = frame.acquisition.world_from_camera - sensor.acquisition.world_from_camera
    np.testing.assert_allclose(off[:3, 3], [0.004, -0.003, 0.0], atol=1e-12)
    assert not off[:3, :3].any()
    empty = sensor.capture_empty().acquisition.world_from_camera
    np.testing.assert_array_equal(empty, sensor.acquisition.world_from_camera)


# Dents, as a rule and as a shape


def test_dent_follows_the_rule():
    """Twice the same peak over two cycles is the dent (F - F_yield) / 5 N per mm, once."""
    damage = Damage(carton())
    at, inwards = np.array([0.0, 0.01, 0.07]), np.array([0.0, 0.0, -1.0])

    for _ in range(20):
        damage.press("left", 39.9, 0.0, at, inwards)
    sound = list(damage.dents)
    for _ in range(20):
        damage.press("left", 65.0, 0.0, at, inwards)
    deep = list(damage.dents)
    damage.press("left", 50.0, 0.0, at + 0.005, inwards)

    assert sound == []
    assert len(deep) == 1
    assert deep[0].depth_mm == pytest.approx((65.0 - 40.0) / 5.0, abs=0.01)
    assert damage.dents == deep, "less force at the same spot makes it no deeper"


def test_single_spike_and_wide_patches_do_no_harm():
    """One cycle of 70 N is a solver's spike; 70 N on a patch of 24 x 70 mm is no dent."""
    spike, wide = Damage(carton()), Damage(carton())
    at, inwards = np.array([0.0, 0.0475, 0.03]), np.array([0.0, -1.0, 0.0])

    spike.press("left", 70.0, 0.0, at, inwards)
    for _ in range(20):
        wide.press("left", 70.0, 0.024 * 0.070, at, inwards)

    assert spike.dents == wide.dents == []


def test_weak_faces_yield_first():
    """The film of a meal tray yields to 25 N, its rim does not."""
    top, side = Damage(carton(product="meal_tray")), Damage(carton(product="meal_tray"))

    for _ in range(20):
        top.press("left", 45.0, 0.0, np.array([0.0, 0.0, 0.05]), np.array([0.0, 0.0, -1.0]))
        side.press("left", 45.0, 0.0, np.array([0.0, 0.06, 0.04]), np.array([0.0, -1.0, 0.0]))

    assert [dent.face for dent in top.dents] == ["top"]
    assert top.dents[0].depth_mm == pytest.approx(4.0, abs=0.01)
    assert side.dents == []


def test_dented_shape_has_the_dents_depth():
    """A dent in the side goes as deep as it says, where it says, and nowhere else."""
    at, inwards = (0.01, 0.0475, 0.035), (0.0, -1.0, 0.0)
    vertices, triangles = product_mesh("milk_carton")

    bent, same = dented_mesh("milk_carton", [Dent("left", at, inwards, 70.0, 6.0, "left")])

    moved_m = np.linalg.norm(bent - vertices, axis=1)
    deepest = int(np.argmax(moved_m))
    assert moved_m[deepest] == pytest.approx(0.006, abs=3e-4)
    assert np.linalg.norm(vertices[deepest] - at) < 0.008
    assert moved_m[vertices[:, 1] < -0.03].max() == 0.0
    assert moved_m[np.linalg.norm(vertices - at, axis=1) > 0.09].max() < 1e-6
    np.testing.assert_array_equal(same, triangles)


def test_dents_of_both_simulators_are_one():
    """A dent from above is what the list-driven packages have: down, fading towards the base."""
    vertices, _ = product_mesh("milk_carton")
    random, again = np.random.default_rng(8), np.random.default_rng(8)

    bent = deformed(vertices, Truth("dent", 9.0), random)

    half = np.abs(vertices[vertices[:, 2] > 0.063, :2]).max(axis=0)
    centre, sigma = again.uniform(-0.5, 0.5, 2) * half, again.uniform(0.014, 0.022)
    expected = pressed(
        vertices,
        np.array([*centre, 0.07]),
        np.array([0.0, 0.0, -1.0]),
        depth_m=0.009,
        sigma_m=sigma,
    )
    np.testing.assert_array_equal(bent, expected)
    assert (bent[:, :2] == vertices[:, :2]).all()
    assert 0.008 < (vertices - bent)[:, 2].max() <= 0.009
    assert (bent[vertices[:, 2] < 0.02] == vertices[vertices[:, 2] < 0.02]).all()


@pytest.mark.parametrize(
    ("inwards", "face"),
    [
        ([0, 0, -1], "top"), ([0, 0, 1], "bottom"), ([-1, 0, 0.2], "front"), ([1, 0, 0], "back"),
        ([0.3, -1, 0], "left"), ([0, 1, 0], "right"),
    ],
)  # fmt: skip
def test_faces_have_names(inwards, face):
    """A force into the package names the face that it goes through."""
    assert face_of(np.array(inwards, float)) == face


def test_area_of_a_patch():
    """Corners in any order span the area of their polygon; a line spans none."""
    corners = np.array([[0, 0, 0.3], [0.02, 0.07, 0.3], [0.02, 0, 0.3], [0, 0.07, 0.3]])

    assert patch_area(corners, np.array([0.0, 0.0, 1.0])) == pytest.approx(0.0014)
    assert patch_area(corners[:2], np.array([0.0, 0.0, 1.0])) == 0.0


# Pictures


def test_picture_shows_the_cell():
    """MuJoCo draws the cell; a package that is taken away changes the picture."""
    cell = PhysicalCell([carton()], seed=1)
    cell.put(0, cell.layout.base_from_tray @ on_tray(0.0, 0.0, 0.0))
    try:
        pictures = CellPictures(cell, width=320, height=240)
    except ControllerError as error:
        pytest.skip(str(error))
    there = pictures.draw()

    cell.take_away(0)
    gone = pictures.draw()
    pictures.close()

    assert there.shape == (240, 320, 3)
    assert there.std() > 10.0
    changed = (np.abs(there.astype(int) - gone).max(axis=2) > 20).mean()
    assert 0.001 < changed < 0.2


def test_picture_that_is_too_large_is_one_line():
    """The greatest size is named."""
    with pytest.raises(
        ControllerError, match="asked for a picture of 4000 x 10 px; at most 960 x 720"
    ):
        CellPictures(PhysicalCell([carton()], seed=1), width=4000, height=10)
