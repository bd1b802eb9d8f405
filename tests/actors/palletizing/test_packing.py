"""The whole cell in one process: physics, sensors, nets, verdicts and what follows from them."""

import dataclasses

import numpy as np
import pytest

from actors.geometry.shapes import Surface
from actors.palletizing.packing import Packing
from actors.palletizing.packing_scores import (
    Tray,
    confusion,
    missed,
    packed_tray,
    scores_of,
)
from actors.palletizing.simulation.knocks import Knock
from actors.palletizing.simulation.packages import DEMO_PRODUCTS
from actors.palletizing.simulation.physical_packages import Spread, draw_packages
from actors.palletizing.simulation.products import product_mesh

MODELS = {name: Surface.free_form(*product_mesh(name)) for name in DEMO_PRODUCTS}


@pytest.fixture(scope="module")
def found():
    """Three packages of one tray, by seed."""
    tray = Tray(1007, 2.0, 0.4, 3, DEMO_PRODUCTS)
    return {tray: packed_tray(tray, MODELS)}


def test_packages_stand_in_contact_where_they_shall(found):
    packed = next(iter(found.values()))
    assert [step.reaction for each in packed for step in each.steps] == ["go_on"] * 3
    for each in packed:
        assert np.hypot(each.along_mm, each.across_mm) < 3.0
        assert abs(each.turn_deg) < 1.5
        assert abs(each.gap_mm) < 1.0
        assert each.cycle_s < 15.0
        assert max(each.dents_mm, default=0.0) < 1.0


def test_their_scores_meet_the_goals(found):
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
    packages = draw_packages(1, seed=3, products=["meal_tray"], spread=Spread(friction=(0.4, 0.4)))
    off = [dataclasses.replace(packages[0], pick_offset_m=(0.0, -0.012))]
    knocks = {0: Knock("missing", 0.1, (0.0, 0.0))}
    [packed] = Packing(off, MODELS, seed=3, knocks=knocks).run()
    assert [(step.request, step.stages[-1:]) for step in packed.steps[:2]] == [
        ("pack", (("grasp_from_belt", "blocked_left"),)),
        ("retry", (("place", "lost"),)),
    ]
    assert packed.judgements[0].truth == packed.judgements[0].verdict == "missing"
    assert packed.judgements[0].at_s == packed.steps[1].at_s, "nothing was put there before"
