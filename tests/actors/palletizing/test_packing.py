"""The whole cell in one process: physics, sensors, nets, verdicts and what follows from them."""

import dataclasses

import numpy as np
import pytest

from actors.geometry.shapes import Surface
from actors.palletizing.packing import Packing
from actors.palletizing.packing_scores import (
    GOALS,
    Tray,
    confusion,
    confusion_text,
    missed,
    packed_tray,
    scores_of,
    trays_of,
)
from actors.palletizing.simulation.packages import DEMO_PRODUCTS
from actors.palletizing.simulation.physical_packages import Spread, draw_packages
from actors.palletizing.simulation.products import product_mesh
from enact_dist.cli.main import main

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


def test_scores_are_those_of_the_goals(found):
    scores = scores_of(found)
    assert scores.keys() <= GOALS.keys()
    assert scores["packages"] == 3.0
    assert not {"shift_p95_mm", "turn_p95_deg", "gap_p50_mm", "alarms_share"} & set(missed(scores))
    assert confusion(found).keys() == {("ok", "ok")}
    assert confusion_text(confusion(found)).splitlines()[1].split()[0] == "ok"


def test_a_hand_that_comes_down_on_a_package_feels_where_it_is():
    """Seen 12 mm beside where it is, a meal tray is grasped at the second try."""
    [package] = draw_packages(1, seed=3, products=["meal_tray"], spread=Spread(friction=(0.4, 0.4)))
    off = dataclasses.replace(package, pick_offset_m=(0.0, -0.012))
    [packed] = Packing([off], MODELS, seed=3).run()
    assert [step.request for step in packed.steps] == ["pack", "retry"]
    assert packed.steps[0].stages == (("grasp_from_belt", "blocked_left"),)
    assert packed.steps[1].reaction == "go_on"
    assert not packed.by_hand


def test_what_a_person_has_displaced_is_pushed_again():
    packages = draw_packages(1, seed=4, spread=Spread(friction=(0.4, 0.4)))
    cell = Packing(packages, MODELS, seed=4)
    [packed] = cell.run()
    back = cell.cell.pose(0)
    back[1, 3] -= 0.016
    cell.cell.put(0, back)
    packed.steps.clear()
    cell.pack(packed, [packed], request="look")
    assert [(step.request, step.reaction) for step in packed.steps] == [
        ("look", "push_again"),
        ("push_again", "go_on"),
    ]


def test_trays_take_the_settings_in_turn_and_held_out_seeds():
    trays = trays_of(40, seed=2)
    assert [tray.seed for tray in trays] == [2000, 2001, 2002, 2003]
    assert [tray.count for tray in trays] == [12, 12, 12, 4]
    assert len({(tray.sigma_mm, tray.friction) for tray in trays}) == 4


def test_the_bench_refuses_what_is_no_spread(capsys):
    with pytest.raises(SystemExit):
        main(["bench", "palletizing", "--spread", "much"])
    assert "asked for 'much'; it is SIGMA_MM,FRICTION" in capsys.readouterr().err
