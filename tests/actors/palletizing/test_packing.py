"""The whole cell in one process: physics, sensors, nets, verdicts and what follows from them."""

import dataclasses

import numpy as np
import pytest

from actors.geometry.poses import on_tray
from actors.geometry.shapes import Surface
from actors.palletizing.simulation.knocks import Knock
from actors.palletizing.simulation.packages import DEMO_PRODUCTS
from actors.palletizing.simulation.physical_packages import Spread, draw_packages
from actors.palletizing.simulation.products import product_mesh
from actors.palletizing.trials.packing import Packing
from actors.palletizing.trials.packing_records import Packed
from actors.palletizing.trials.packing_scores import (
    Tray,
    confusion,
    missed,
    packed_tray,
    scores_of,
)

pytestmark = pytest.mark.sampled(5, of="file")

MODELS = {name: Surface.free_form(*product_mesh(name)) for name in DEMO_PRODUCTS}


@pytest.fixture(scope="module")
def found():
    """Three packages of one tray, by seed."""
    tray = Tray(1007, 2.0, 0.4, 3, DEMO_PRODUCTS)
    return {tray: packed_tray(tray, MODELS)}


def test_packages_stand_in_contact_where_they_shall(found):
    """Within 3 mm, 1.5 degrees and 15 s each, a gap under 1 mm, no dent of 1 mm, no reaction."""
    packed = next(iter(found.values()))
    assert [step.reaction for each in packed for step in each.steps] == ["go_on"] * 3
    for each in packed:
        assert np.hypot(each.along_mm, each.across_mm) < 3.0
        assert abs(each.turn_deg) < 1.5
        assert abs(each.gap_mm) < 1.0
        assert each.cycle_s < 15.0
        assert max(each.dents_mm, default=0.0) < 1.0


def test_their_scores_meet_the_goals(found):
    """No goal is missed, and every verdict is a right `ok`."""
    assert not missed(scores_of(found))
    assert confusion(found).keys() == {("ok", "ok")}


def test_a_hand_that_comes_down_on_a_package_feels_where_it_is():
    """Seen 12 mm beside where it is, a meal tray is grasped at the second try."""
    [package] = draw_packages(1, seed=3, products=["meal_tray"], spread=Spread(friction=(0.4, 0.4)))
    off = dataclasses.replace(package, pick_offset_m=(0.0, -0.012))
    [packed] = Packing([off], MODELS, seed=3).run()
    assert [step.request for step in packed.steps] == ["pack", "retry"]
    assert packed.steps[0].stages == (("grasp_from_belt", "blocked_left"),)
    assert packed.steps[1].reaction == "go_on"
    assert not packed.by_hand


def test_a_hand_goes_down_clear_of_a_package_that_was_grasped_off_its_middle():
    """Seen 22 mm beside where it is, along its row: it stands so far behind when it is pushed."""
    [package] = drawn("meal_tray")
    off = dataclasses.replace(package, pick_offset_m=(-0.022, 0.0))
    [packed] = Packing([off], MODELS, seed=3).run()
    assert [step.reaction for step in packed.steps] == ["go_on"]
    assert max(packed.dents_mm, default=0.0) < 1.0


def drawn(*products):
    """Return packages of one friction."""
    return draw_packages(
        len(products), seed=3, products=products, spread=Spread(friction=(0.4, 0.4))
    )


def test_a_carton_is_taken_anew_over_a_lower_package():
    """It stands nearer to the next row than a finger is thick, and the meal tray there is lower."""
    packages = drawn(*["meal_tray"] * 5, "milk_carton")
    cell = Packing(packages, MODELS, seed=3)
    packed = [Packed(each.number, each.product, each.friction) for each in packages]
    places = [cell.layout.base_from_tray @ slot.tray_from_product for slot in cell.slots]
    for number in range(5):
        cell.cell.replace(number, places[number])
        cell.pack(packed[number], packed, request="look")
    cell._flagged.clear()  # as before each package
    cell.cell.replace(5, places[5] @ on_tray(0.013, 0.021, 0.0))
    cell.pack(packed[5], packed, request="look")
    assert [step.request for step in packed[5].steps] == ["look", "regrasp"]
    assert packed[5].steps[-1].after == "ok"
    assert not packed[5].steps[-1].harmed


def test_a_finger_over_the_film_of_a_meal_tray_is_felt_before_it_dents():
    """The film lies lower than the rim: the hand feels its way down to it."""
    [package] = draw_packages(1, seed=3, products=["meal_tray"], spread=Spread(friction=(0.4, 0.4)))
    off = dataclasses.replace(package, pick_offset_m=(-0.018, -0.010))
    [packed] = Packing([off], MODELS, seed=3).run()
    assert packed.steps[0].stages[-1][1] == "blocked_left"
    assert packed.steps[0].after == "belt", "it is not dented"


def test_each_error_is_provoked_by_physics_seen_and_answered():
    """A dent, a fall, a slide: what the camera says is what physics did, and each has its answer.

    The knocks are given, not drawn, so that each falls on a package of a known product.
    """
    packages = draw_packages(3, seed=4, spread=Spread(friction=(0.4, 0.4)))
    knocks = {
        0: Knock("deformed", 9.0, (0.1, 0.1)),
        1: Knock("tipped", 0.0, (0.0, 1.0)),
        2: Knock("moved", 0.016, (np.pi, 0.0)),
    }
    moments = []
    cell = Packing(
        packages, MODELS, seed=4, knocks=knocks, watch=lambda *moment: moments.append(moment)
    )
    packed = cell.run()
    first = [each.judgements[0] for each in packed]
    assert [(each.truth, each.verdict) for each in first] == [
        (kind, kind) for kind in ("deformed", "tipped", "moved")
    ]
    assert [each.knock for each in packed] == ["deformed", "tipped", "moved"]
    assert [each.by_hand for each in packed] == [True, True, False]
    assert [step.request for step in packed[2].steps] == ["pack", "push_again"]
    assert packed[2].steps[-1].after == "ok"
    assert moments == [(n, when) for n in range(3) for when in ("before", "error", "after")]
    assert max(packed[0].dents_mm) == pytest.approx(9.0, abs=0.5)
    assert packed[0].dented_by == ("outside",), "the dent stays noted when the package is replaced"
    after = [len(each.judgements) for each in packed[:2]]
    assert after == [1, 1], "what a person has put down is not judged for the score"


def test_a_package_that_the_gripper_drops_is_missing_and_is_not_counted_before():
    """Its first judgement comes after the step that dropped it, and says missing."""
    packages = draw_packages(1, seed=3, products=["meal_tray"], spread=Spread(friction=(0.4, 0.4)))
    off = [dataclasses.replace(packages[0], pick_offset_m=(0.0, -0.012))]
    knocks = {0: Knock("missing", 0.1, (0.0, 0.0))}
    [packed] = Packing(off, MODELS, seed=3, knocks=knocks).run()
    assert [(step.request, step.stages[-1:]) for step in packed.steps[:2]] == [
        ("pack", (("grasp_from_belt", "blocked_left"),)),
        ("retry", (("place", "lost"),)),
    ]
    assert packed.judgements[0].truth == packed.judgements[0].verdict == "missing"
    assert packed.judgements[0].at_s > packed.steps[0].at_s, "nothing was put there before"


@pytest.mark.parametrize(
    ("product", "stages", "reaction"),
    [
        ("meal_tray", ["lost", "in_contact"], "it stands as planned"),
        ("milk_carton", ["lost"], "place: lost; the package leans on the belt by 28°"),
    ],
)
def test_what_is_dropped_over_the_edge_of_the_belt_is_taken_from_there_if_it_stands(
    product, stages, reaction
):
    """A finger would come down on the tray's rim beside it; one that leans is asked about."""
    packages = draw_packages(1, seed=3, products=[product], spread=Spread(friction=(0.4, 0.4)))
    knocks = {0: Knock("missing", 0.1, (0.0, 0.0))}
    [packed] = Packing(packages, MODELS, seed=3, knocks=knocks).run()
    assert [step.stages[-1][1] for step in packed.steps] == stages
    assert packed.steps[-1].reason == reaction
    assert packed.by_hand == (len(stages) == 1)
