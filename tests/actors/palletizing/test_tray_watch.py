"""Claims about the places of one tray that are judged beside each other, and about slight dents."""

import numpy as np
import pytest

pytest.importorskip("open3d", exc_type=ImportError)

from actors.geometry.poses import moved, on_tray
from actors.geometry.recognition.deviation import inspect_place
from actors.palletizing.sight.tray_changes import where_seen
from actors.palletizing.sight.tray_watch import Seen, TrayWatch
from actors.palletizing.simulation.packages import pressed
from actors.palletizing.simulation.products import box_mesh, product_mesh
from actors.palletizing.simulation.sensors import shifted

from .tray_pictures import looked_at

CARTON, MEAL = on_tray(0.30, -0.12, np.pi), on_tray(0.05, -0.12, np.pi)
PLACES = {0: ("milk_carton", CARTON), 1: ("meal_tray", MEAL)}


@pytest.fixture
def watch(trained):
    """A tray that was empty."""
    return TrayWatch(looked_at(seed=9), {name: trained(name) for name, _ in PLACES.values()})


def test_neighbour_that_was_mistaken_is_not_extra_at_another_place(watch):
    """A package that is off by 25 mm is moved, though its neighbour was last taken to lie 70 mm off."""
    watch.judged(looked_at(("milk_carton", CARTON)), PLACES, newest=0)
    watch.seen[0] = Seen("moved", on_tray(0.23, -0.12, np.pi), 70.0, 0.0, 70.0)
    off = on_tray(0.025, 0.0, 0.0) @ MEAL

    found = watch.judged(looked_at(("milk_carton", CARTON), ("meal_tray", off)), PLACES, newest=1)

    assert found[1].verdict == "moved"
    assert found[1].shift_mm == pytest.approx(25.0, abs=1.0)


def test_neighbour_that_nobody_found_is_not_extra_at_another_place(watch):
    """What lies where another package was planned is judged there, be it where no fit found it."""
    watch.seen[0] = Seen("extra", on_tray(0.30, 0.25, np.pi), 370.0, 0.0, 370.0)
    lies = on_tray(0.32, -0.07, 2.3)

    found = watch.judged(looked_at(("milk_carton", lies), ("meal_tray", MEAL)), PLACES, newest=1)

    assert found[1].verdict == "ok"


def test_hand_above_the_tray_is_not_on_it(watch):
    """What hangs 0.25 m above a place and beside it is nothing extra, and no package."""
    hand = shifted(box_mesh((0.12, 0.10, 0.15)), [0.12, -0.06, 0.25])

    empty = watch.judged(looked_at(things=[hand]), PLACES, newest=1)
    filled = watch.judged(looked_at(("meal_tray", MEAL), things=[hand]), PLACES, newest=1)

    assert empty[1].verdict == "missing"
    assert filled[1].verdict == "ok"


def test_package_is_seen_where_it_stands_even_if_something_hides_half_of_it(trained):
    """Of several places the one that the picture shows is chosen; of wrong ones none."""
    beam = shifted(box_mesh((0.10, 0.30, 0.02)), [0.32, -0.12, 0.15])
    frame, carton = looked_at(("milk_carton", CARTON), things=[beam]), trained("milk_carton")
    aside, away = on_tray(0.0, 0.05, 0.0) @ CARTON, on_tray(0.0, 0.3, 0.0) @ CARTON

    assert where_seen(frame, carton, [away, aside, CARTON]) is CARTON
    assert where_seen(frame, carton, [away]) is None


def verdict_on_dent(surface, product, at_m, *, depth_m, sigma_m):
    """What is said of a package with a dent in its top."""
    vertices, triangles = product_mesh(product)
    down = np.array([0.0, 0.0, -1.0])
    bent = pressed(vertices, np.array(at_m), down, depth_m=depth_m, sigma_m=sigma_m)
    frame = looked_at(things=[(moved(bent, MEAL), triangles)])
    return inspect_place(frame, looked_at(seed=2).depth_mm, surface, MEAL)


def test_wide_dent_in_the_lid_of_a_cup_is_found(trained):
    """A dent of 3 mm that is nearly as wide as the lid is none of the sensor's height."""
    found = verdict_on_dent(
        trained("yoghurt_cup"), "yoghurt_cup", (0.003, 0.0, 0.1), depth_m=0.003, sigma_m=0.020
    )

    assert found.verdict == "deformed"
    assert found.deviation_mm == pytest.approx(3.0, abs=0.5)


def test_dent_of_a_millimetre_is_no_deformation(trained):
    """A dent of 1.3 mm, however wide, is less than what counts as one."""
    found = verdict_on_dent(
        trained("meal_tray"), "meal_tray", (0.02, 0.01, 0.053), depth_m=0.0013, sigma_m=0.022
    )

    assert found.verdict == "ok"
