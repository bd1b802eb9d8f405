"""Claims about what is recognised on the belt, and about images that are fused."""

import numpy as np
import pytest

pytest.importorskip("open3d", exc_type=ImportError)
pytest.importorskip("mujoco", exc_type=ImportError)

from actors.geometry.poses import inverse, on_tray, turned, yaw_between, yaw_of
from actors.geometry.shapes import VGA, Acquisition, DepthFrame
from actors.geometry.surfaces.depth import fused, metres
from actors.palletizing.sight.belt_sight import MISFIT_MAX_M, BeltWatch, seen_on_belt
from actors.palletizing.sight.sensor import steady
from actors.palletizing.simulation.physical_sensors import PhysicalBeltSensor
from actors.palletizing.simulation.physics import PhysicalCell
from actors.palletizing.simulation.products import PRODUCTS, product_mesh

from .moves import carton

pytestmark = pytest.mark.sampled(5, of="file")


class Belt:
    """The cell's belt with packages that are put where a test wants them; physics stands still."""

    def __init__(self, *products):
        packages = [carton(number, product=product) for number, product in enumerate(products)]
        self.cell = PhysicalCell(packages, seed=1)
        self.sensor = PhysicalBeltSensor(self.cell.shown, seed=2)
        self.empty_mm = steady(self.sensor.capture_empty).depth_mm

    def put(self, number, x_m, y_m, yaw_rad):
        self.cell.put(number, self.cell.layout.base_from_belt @ on_tray(x_m, y_m, yaw_rad))

    def seen(self, models, *, frames=8):
        frame = steady(lambda: self.sensor.capture(0), frames=frames)
        return seen_on_belt(frame, self.empty_mm, models)


@pytest.fixture(scope="module")
def models(trained):
    """The trained surfaces of all products."""
    return {product: trained(product) for product in PRODUCTS}


@pytest.mark.parametrize("product", PRODUCTS)
@pytest.mark.parametrize("place", [(-0.08, 0.01, 0.04), (-0.12, -0.02, 2.3)])
def test_product_is_recognised_and_posed(models, product, place):
    """Of three products the right one is seen, within 1.5 mm and, unless round, 1.5 degrees."""
    belt = Belt(product)
    belt.put(0, *place)

    (sight,) = belt.seen(models)

    assert sight.product == product
    assert sight.known
    assert np.hypot(*(sight.belt_from_product[:2, 3] - place[:2])) < 0.0015
    assert abs(sight.belt_from_product[2, 3]) < 1e-9
    turn = yaw_between(place[2], yaw_of(sight.belt_from_product))
    if product == "meal_tray":
        turn = min(turn, yaw_between(turn, np.pi), key=abs)
    if product != "yoghurt_cup":
        assert abs(turn) < np.deg2rad(1.5)


def test_one_image_is_enough_to_recognise(models):
    """Without fusing the misfit of a sound package stays below its limit."""
    belt = Belt("milk_carton")
    belt.put(0, -0.1, 0.0, 0.1)

    (sight,) = belt.seen(models, frames=1)

    assert sight.product == "milk_carton"
    assert sight.known


def test_empty_belt_has_no_sights(models):
    """Nothing on the belt is an empty list, also while packages stand on the tray in view."""
    belt = Belt("milk_carton")
    assert belt.seen(models) == []

    belt.cell.put(0, belt.cell.layout.base_from_tray @ on_tray(0.36, 0.2, 0.0))

    assert belt.seen(models) == []


def test_several_packages_are_several_sights(models):
    """Each is what it is; the one farthest along the belt comes first, one cut off is left out."""
    belt = Belt("yoghurt_cup", "milk_carton", "meal_tray")
    belt.put(0, -0.05, 0.0, 0.0)
    belt.put(1, -0.28, 0.01, 0.1)
    belt.put(2, -0.54, 0.0, 0.0)

    sights = belt.seen(models)

    assert [sight.product for sight in sights] == ["yoghurt_cup", "milk_carton"]
    assert all(sight.known for sight in sights)


def test_what_was_not_trained_is_a_misfit(models):
    """A product that no model is of resembles one of them, and does not fit it."""
    belt = Belt("meal_tray")
    belt.put(0, -0.1, 0.0, 0.0)
    others = {name: models[name] for name in ("milk_carton", "yoghurt_cup")}

    (sight,) = belt.seen(others)

    assert not sight.known
    assert sight.misfit_m > 1.5 * MISFIT_MAX_M
    assert belt.seen({})[0].product == ""
    assert not belt.seen({})[0].known


@pytest.mark.parametrize(
    ("product", "roll_deg", "unfit"),
    [
        ("yoghurt_cup", 90.0, "the package lies on its side on the belt"),
        ("milk_carton", 90.0, "the package lies on its side on the belt"),
        ("milk_carton", 15.0, "the package leans on the belt by 15°"),
    ],
)
def test_how_a_package_lies_is_recognised(models, product, roll_deg, unfit):
    """It is not taken for one that stands, and what is the matter with it is known by name."""
    belt = Belt(product)
    pose = np.eye(4)
    pose[:3, :3] = turned(np.deg2rad(roll_deg), 0.0, 0.3)
    pose[:3, 3] = -0.1, 0.0, -float((product_mesh(product)[0] @ pose[2, :3]).min())
    belt.cell.put(0, belt.cell.layout.base_from_belt @ pose)

    (sight,) = belt.seen(models)

    assert not sight.known
    assert sight.product == product
    assert np.rad2deg(sight.tilt_rad) == pytest.approx(roll_deg, abs=2.0)
    assert sight.unfit.replace("14°", "15°").replace("16°", "15°") == unfit


def test_what_no_model_explains_is_said_so(models):
    """A cup on its head shows its foot, which no sensor saw in training."""
    belt = Belt("yoghurt_cup")
    head = on_tray(-0.1, 0.0, 0.0) @ np.diag([1.0, -1.0, -1.0, 1.0])
    head[2, 3] = 0.102
    belt.cell.put(0, belt.cell.layout.base_from_belt @ head)

    (sight,) = belt.seen(models)

    assert sight.unfit == "what is on the belt is no package that stands upright"


def test_a_package_that_stands_over_the_edge_of_the_belt_is_seen(models):
    """Half of it is over the gap to the tray, and a carton on the tray is right behind it."""
    belt = Belt("milk_carton", "milk_carton")
    belt.put(0, -0.067, -0.105, -0.14)
    belt.cell.put(1, belt.cell.layout.base_from_tray @ on_tray(0.348, 0.14, np.pi))
    layout = belt.cell.layout
    tray = inverse(layout.base_from_belt) @ layout.base_from_tray
    watch = BeltWatch(belt.sensor.capture_empty(), models, tray)
    frame = steady(lambda: belt.sensor.capture(0), frames=8)

    sight = watch.sight(frame, "milk_carton")

    assert sight.known
    assert np.hypot(*(sight.belt_from_product[:2, 3] - [-0.067, -0.105])) < 0.006
    assert watch.sight(frame, "meal_tray") is None, "a carton is no meal tray"


# Fused images


def test_fused_images_have_less_noise():
    """Eight images of one moment leave a third of the noise, and no whole millimetres."""
    belt = Belt("milk_carton")
    belt.put(0, -0.1, 0.0, 0.0)
    true_m = belt.sensor.true_depth()
    flat = np.zeros(VGA.shape, bool)
    flat[200:280, 270:330] = True

    one, eight = (steady(lambda: belt.sensor.capture(0), frames=count) for count in (1, 8))

    off = [np.nanstd((metres(each.depth_mm) - true_m)[flat]) for each in (one, eight)]
    assert off[1] < 0.45 * off[0]
    assert one.depth_mm.dtype == np.uint16
    assert eight.depth_mm.dtype == np.float32


def test_fusing_keeps_an_edge_and_what_is_unknown():
    """Depths of two sides are never mixed; a pixel that most images do not know stays unknown."""
    seen_by = Acquisition(VGA, np.eye(4))
    stack = np.full((5, *VGA.shape), 900, np.uint16)
    stack[:2, 10, 10] = 950
    stack[:4, 20, 20] = 0
    stack[:3, 30, 30] = 0
    stack[3:, 40, 40] = 901

    image = fused([DepthFrame(each, seen_by) for each in stack]).depth_mm

    assert image[10, 10] == pytest.approx(900.0)
    assert image[20, 20] == 0.0
    assert image[30, 30] == pytest.approx(900.0)
    assert image[40, 40] == pytest.approx(900.4)


def test_images_of_several_places_are_not_fused():
    """A sensor that moved in between is an error, and so is no image at all."""
    image = np.full(VGA.shape, 900, np.uint16)
    frames = [DepthFrame(image, Acquisition(VGA, on_tray(x, 0.0, 0.0))) for x in (0.0, 0.01)]

    with pytest.raises(ValueError, match="found 2 from several"):
        fused(frames)
    with pytest.raises(ValueError, match="found none"):
        fused([])
