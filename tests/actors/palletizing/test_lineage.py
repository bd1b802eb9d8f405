"""Where a verdict of the palletizing cell comes from, and what came of a view of a product."""

import itertools

import pytest

pytest.importorskip("open3d", exc_type=ImportError)

from actors.palletizing.conveyor import Conveyor
from actors.palletizing.demo.lineage import verdict_causes, view_effects
from actors.palletizing.deviation import DeviationDetection
from actors.palletizing.feedback import Feedback
from actors.palletizing.fusion import Fusion
from actors.palletizing.perception import OnlinePerception, TrainingPerception
from actors.palletizing.planning import Planning
from actors.palletizing.reconstruction import Reconstruction
from enact_dist import testing

SENSORS = "actors.palletizing.simulation.sensors"
OVERHEAD = f"{SENSORS}:tray_sensor?packages=3&seed=59"
PRODUCTS, VIEWS = ("milk_carton", "meal_tray"), 4


@pytest.fixture(scope="module")
def cell():
    """A cell that has trained two products from four views each and judged three packages."""
    with testing.worlds("training", "online") as cell:
        testing.run_once(Planning(3, " ".join(PRODUCTS), views=VIEWS), cell)
        perception = TrainingPerception(f"{SENSORS}:orbit_sensor?seed=2", OVERHEAD)
        for _ in range(1 + VIEWS * len(PRODUCTS)):
            testing.run_once(perception, cell)
        testing.run_once(Reconstruction(), cell)
        testing.run_once(Fusion(), cell)
        actors = [Conveyor(), OnlinePerception(OVERHEAD), DeviationDetection(), Feedback()]
        for actor in itertools.chain.from_iterable(itertools.repeat(actors, 3)):
            testing.run_once(actor, cell)
        yield cell


def slots(trees):
    return {f"{one.world}:{one.entity}/{one.aspect}" for one in trees}


def views(product, aspect):
    return {f"training:view/{product}/{number}/{aspect}" for number in range(VIEWS)}


def test_verdict_comes_from_its_depth_frame_and_the_views_of_its_product(cell):
    """The third package is a milk carton: its image, its plan, its model, the views of that."""
    tree = verdict_causes(cell)

    direct = slots(tree.children)
    assert {
        "online:place/2/observation",
        "training:place/2/plan",
        "training:product/milk_carton/surface",
    } <= direct
    assert "training:product/meal_tray/surface" not in direct
    observation = next(one for one in tree.children if one.aspect == "observation")
    assert observation.stamp_ns > 0
    assert {"online:conveyor/stop", "training:tray/empty"} <= slots(observation.children)


def test_model_comes_from_the_views_of_its_product_alone(cell):
    """What another product was made of is no cause, though the same actor fused it."""
    model = cell.why("training", "product/milk_carton", "surface")

    made_of = slots(model.walk())
    for aspect in ("cloud", "surface", "viewpoint"):
        assert views("milk_carton", aspect) <= made_of
        assert not views("meal_tray", aspect) & made_of


@pytest.mark.parametrize(("product", "verdicts"), [("milk_carton", {1, 3}), ("meal_tray", {2})])
def test_view_led_to_its_model_and_to_the_verdicts_that_rest_on_it(cell, product, verdicts):
    """Impact names the one product model, and of the verdicts those on that product."""
    tree = view_effects(cell, product)

    models = {one.entity.name for one in tree.walk() if one.entity.name.startswith("product/")}
    found = {one.version for one in tree.walk() if one.aspect == "deviation"}
    assert (models, found) == ({f"product/{product}"}, verdicts)


def test_chain_of_a_verdict_is_whole(cell):
    """Nothing in it is forgotten or unknown, back to the plan."""
    kinds = {one.kind for one in cell.why("online", "system", "deviation").walk()}

    assert kinds <= {"commit", "null"}
