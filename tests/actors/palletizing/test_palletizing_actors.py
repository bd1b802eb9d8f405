"""Claims about the palletizing actors, run in process on the real core."""

import itertools

import numpy as np
import pytest

pytest.importorskip("open3d", exc_type=ImportError)

from slots import each, get, put_online

from actors.palletizing.conveyor import Conveyor
from actors.palletizing.deviation import DeviationDetection
from actors.palletizing.feedback import Feedback
from actors.palletizing.fusion import Fusion
from actors.palletizing.perception import OnlinePerception, TrainingPerception
from actors.palletizing.planning import Planning
from actors.palletizing.reconstruction import Reconstruction
from actors.palletizing.sight.sensor import open_sensor
from actors.palletizing.simulation.packages import VERDICT_OF_KIND, package_sequence
from actors.palletizing.vocabulary import (
    CLOUD,
    CONVEYOR,
    DEVIATIONS,
    EMPTY,
    NOTICES,
    PACKAGES,
    PLACES,
    PRODUCTS,
    REGION,
    SCAN,
    SIGHTING,
    STANDING,
    STOP,
    SURFACE,
    SYSTEM,
    TRAY,
    USER,
    VIEWS,
    product_entity,
    view_entity,
)
from enact_dist import testing

from .handled_cell import shape_of

SENSORS = "actors.palletizing.simulation.sensors"
PACKAGE_COUNT, SEED = 10, 83
OVERHEAD = f"{SENSORS}:tray_sensor?packages={PACKAGE_COUNT}&seed={SEED}"
NAMES = ("milk_carton", "meal_tray")


@pytest.fixture
def cell(trained):
    """A cell whose products are trained and whose tray is planned and empty."""
    with testing.worlds("training", "online") as cell:
        training = cell.world("training")
        testing.run_once(Planning(PACKAGE_COUNT, " ".join(NAMES)), cell)
        training.init(TRAY, EMPTY, open_sensor(OVERHEAD).capture_empty())
        for name in NAMES:
            training.init(product_entity(name), SURFACE, trained(name))
        yield cell


def test_cell_judges_a_sequence_of_packages(cell, capsys):
    """Every package of two trays gets the right flag, and the user reads a line for each."""
    actors = [Conveyor(), OnlinePerception(OVERHEAD), DeviationDetection(), Feedback()]

    for actor in itertools.chain.from_iterable(itertools.repeat(actors, PACKAGE_COUNT)):
        testing.run_once(actor, cell)

    truths = [package.truth.kind for package in package_sequence(PACKAGE_COUNT, seed=SEED)]
    flags = get(cell.world("online"), SYSTEM, DEVIATIONS)
    verdicts = [flags[f"place/{stop}"].verdict for stop in range(PACKAGE_COUNT)]
    assert verdicts == [VERDICT_OF_KIND[kind] for kind in truths]
    assert len(capsys.readouterr().out.splitlines()) == PACKAGE_COUNT
    assert len(get(cell.world("online"), USER, NOTICES)) == PACKAGE_COUNT
    for stop, kind in enumerate(truths):
        assert (flags[f"place/{stop}"].package == "") == (kind == "missing")
    diff = cell.world("training").diff(cell.world("online"), PLACES, STANDING)
    damaged = {f"place/{stop}": verdict for stop, verdict in enumerate(verdicts) if verdict != "ok"}
    assert {row.entity.name: row.right is not None for row in diff} == dict.fromkeys(damaged, True)
    for row in diff:
        assert f"'ok' against '{damaged[row.entity.name]}'" in row.difference.what
    assert diff.within + diff.equal == PACKAGE_COUNT - len(damaged)


def test_standing_diff_names_a_damaged_package_when_it_is_judged(cell):
    """Deviation as a standing query: places come, and only what is wrong is told as changed."""
    actors = [Conveyor(), OnlinePerception(OVERHEAD), DeviationDetection()]
    training, online_world = cell.world("training"), cell.world("online")
    truths = [package.truth.kind for package in package_sequence(PACKAGE_COUNT, seed=SEED)]
    first_bad = next(stop for stop, kind in enumerate(truths) if kind != "ok")
    with training.watch_diff(online_world, PLACES, STANDING) as watch:
        planned = [watch.next(0) for _ in range(PACKAGE_COUNT)]
        assert {row.kind.value for row in planned} == {"only left"}
        for actor in itertools.chain.from_iterable(itertools.repeat(actors, first_bad + 1)):
            testing.run_once(actor, cell)
        told = {row.entity.name: row for row in iter(lambda: watch.next(0), None)}
    wanted = {f"place/{stop}": "equal" for stop in range(first_bad)} | {
        f"place/{first_bad}": "changed"
    }
    assert {name: row.kind.value for name, row in told.items()} == wanted
    assert told[f"place/{first_bad}"].difference.where == ".state"


def test_training_makes_one_entity_per_view_and_one_surface_per_product():
    """Clouds, poses and boundary representations per view; then the product's surface, once."""
    with testing.worlds("training", "online") as cell:
        perception = TrainingPerception(f"{SENSORS}:orbit_sensor?seed=2", OVERHEAD)
        fusion = Fusion()
        testing.run_once(Planning(1, "yoghurt_cup", views=6), cell)

        for _ in range(8):
            testing.run_once(perception, cell)
        testing.run_once(Reconstruction(), cell)
        testing.run_once(fusion, cell)

        clouds = each(cell.world("training"), VIEWS, CLOUD)
        assert set(clouds) == {view_entity("yoghurt_cup", number) for number in range(6)}
        assert set(each(cell.world("training"), VIEWS, SURFACE)) == set(clouds)
        surface = each(cell.world("training"), PRODUCTS, SURFACE)[product_entity("yoghurt_cup")]
        assert surface.vertices_m[:, 2].max() == pytest.approx(0.102, abs=0.003)
        assert testing.run_once(fusion, cell) == 0


def test_training_goes_on_after_a_crash():
    """A new perception takes the views that are missing and none that are there."""
    with testing.worlds("training", "online") as cell:
        address = f"{SENSORS}:orbit_sensor?seed=2"
        testing.run_once(Planning(1, "yoghurt_cup", views=4), cell)
        first = TrainingPerception(address, OVERHEAD)
        for _ in range(3):
            testing.run_once(first, cell)
        before = each(cell.world("training"), VIEWS, CLOUD)

        second = TrainingPerception(address, OVERHEAD)
        for _ in range(3):
            testing.run_once(second, cell)

        after = {
            info.entity: info.version
            for info in cell.world("training").list_slots(VIEWS, ("cloud",))
        }
        assert len(before) == 2
        assert after == {view_entity("yoghurt_cup", number): 1 for number in range(4)}


def test_fusion_waits_for_the_last_view():
    """While a view is missing a product has no surface."""
    with testing.worlds("training", "online") as cell:
        perception = TrainingPerception(f"{SENSORS}:orbit_sensor?seed=2", OVERHEAD)
        testing.run_once(Planning(1, "yoghurt_cup", views=5), cell)
        for _ in range(5):
            testing.run_once(perception, cell)
        testing.run_once(Reconstruction(), cell)

        testing.run_once(Fusion(), cell)

        assert each(cell.world("training"), PRODUCTS, SURFACE) == {}
        assert len(each(cell.world("training"), PRODUCTS, SCAN)) == 1


def test_two_perceptions_make_one_entity_of_a_package(cell):
    """Both see the same new packages; the second finds the entities that the first has made."""
    for stop in range(2):
        put_online(cell, CONVEYOR, STOP, stop)
        for _ in range(2):
            testing.run_once(OnlinePerception(OVERHEAD), cell)

    truths = [package.truth.kind for package in package_sequence(2, seed=SEED)]
    wanted = sum({"missing": 0, "extra": 2}.get(kind, 1) for kind in truths)
    assert len(each(cell.world("online"), PACKAGES, SIGHTING)) == wanted > 0


def test_package_keeps_its_entity_from_stop_to_stop(cell):
    """A package that stays is seen again as itself; another tray has entities of its own."""
    perception = OnlinePerception(OVERHEAD)
    for stop in (0, 1, 2, 8):
        put_online(cell, CONVEYOR, STOP, stop)
        testing.run_once(perception, cell)

    sightings = each(cell.world("online"), PACKAGES, SIGHTING).values()

    assert {
        (seen.tray, seen.first_stop, seen.last_stop) for seen in sightings if seen.first_stop == 0
    } == {(0, 0, 2)}
    assert {seen.tray for seen in sightings if seen.first_stop == 8} == {1}


def test_conveyor_waits_for_the_products():
    """Before every planned product is trained nothing comes."""
    with testing.worlds("training", "online") as cell:
        testing.run_once(Planning(4, " ".join(NAMES)), cell)
        conveyor = Conveyor()
        cell.world("training").init(product_entity(NAMES[0]), SURFACE, shape_of(NAMES[0]))
        testing.run_once(conveyor, cell)
        early = get(cell.world("online"), CONVEYOR, STOP)

        cell.world("training").init(product_entity(NAMES[1]), SURFACE, shape_of(NAMES[1]))
        testing.run_once(conveyor, cell)

        assert (early, get(cell.world("online"), CONVEYOR, STOP)) == (None, 0)


def test_conveyor_waits_for_the_verdict(cell):
    """It advances by one stop per judged package, however often it runs."""
    perception, detection = OnlinePerception(OVERHEAD), DeviationDetection()
    for _ in range(3):
        testing.run_once(Conveyor(), cell)
    waiting = get(cell.world("online"), CONVEYOR, STOP)

    testing.run_once(perception, cell)
    testing.run_once(detection, cell)
    testing.run_once(Conveyor(), cell)

    assert (waiting, get(cell.world("online"), CONVEYOR, STOP)) == (0, 1)


def test_detection_gives_the_same_flags_after_a_restart(cell):
    """A detection that starts anew judges what is there again and changes no flag.

    Lengths may differ by 0.2 mm: Open3D's registration adds up in parallel, in no fixed order.
    """
    for stop in range(2):
        put_online(cell, CONVEYOR, STOP, stop)
        testing.run_once(OnlinePerception(OVERHEAD), cell)
        testing.run_once(DeviationDetection(), cell)
    before = get(cell.world("online"), SYSTEM, DEVIATIONS)

    again = testing.run_once(DeviationDetection(), cell)

    assert again == 2
    after = get(cell.world("online"), SYSTEM, DEVIATIONS)
    assert after.keys() == before.keys()
    for name, flag in before.items():
        same = ("package", "product", "verdict", "captured_ns")
        assert [getattr(after[name], f) for f in same] == [getattr(flag, f) for f in same]
        assert after[name].deviation_mm == pytest.approx(flag.deviation_mm, abs=0.2)
        assert after[name].shift_mm == pytest.approx(flag.shift_mm, abs=0.2)
    regions = each(cell.world("online"), PLACES, REGION)
    assert all(region.dtype == np.bool_ for region in regions.values())


def test_feedback_tells_each_verdict_once(cell, capsys):
    """A second feedback finds in the context what the user knows already."""
    put_online(cell, CONVEYOR, STOP, 0)
    testing.run_once(OnlinePerception(OVERHEAD), cell)
    testing.run_once(DeviationDetection(), cell)

    testing.run_once(Feedback(), cell)
    testing.run_once(Feedback(), cell)

    assert len(capsys.readouterr().out.splitlines()) == 1


@pytest.mark.parametrize(
    "address", ["nothing", "actors.nowhere:sensor", "actors.palletizing.sight.sensor:none"]
)
def test_sensor_address_that_leads_nowhere_is_refused(address):
    """The error shows the address."""
    with pytest.raises(ValueError, match=address):
        open_sensor(address)
