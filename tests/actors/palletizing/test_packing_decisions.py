"""Where packages shall stand, how they are held, and what follows from what was seen."""

import dataclasses

import numpy as np
import pytest

from actors.geometry.arms.reaching import reach
from actors.geometry.shapes import Surface
from actors.palletizing.handling.data import GripCommand, GripState
from actors.palletizing.handling.reactions import (
    MOST,
    REACTIONS,
    UNFIT_ON_BELT,
    Case,
    choices_of,
    react,
    worst,
)
from actors.palletizing.handling.stages import felt_on, fills, is_held
from actors.palletizing.placing.finger_room import Grasp
from actors.palletizing.placing.grasps import grasp_of, size_of
from actors.palletizing.placing.rows import contacts_between, planned_rows
from actors.palletizing.simulation.cell.scene import (
    ARM,
    HOME_RAD,
    CellLayout,
    centre_of_mass,
)
from actors.palletizing.simulation.products import PRODUCTS, product_mesh
from actors.palletizing.simulation.sensors import TRAY_M

SIZES = {
    "milk_carton": np.array([0.2, 0.095, 0.07]),
    "meal_tray": np.array([0.16, 0.12, 0.054]),
    "yoghurt_cup": np.array([0.095, 0.095, 0.102]),
}


def true_surface(product):
    vertices, triangles = product_mesh(product)
    return Surface.free_form(vertices, triangles)


def boxes(slots, products):
    """Return (least, greatest) x and y of each slot."""
    for slot, product in zip(slots, products, strict=True):
        half = np.abs(slot.tray_from_product[:2, :2]) @ SIZES[product][:2] / 2.0
        middle = slot.tray_from_product[:2, 3]
        yield middle - half, middle + half


def test_rows_stay_on_the_tray_and_never_overlap():
    """Forty packages of three products: boxes lie inside the tray and at most touch."""
    products = [PRODUCTS[n % 3] for n in range(40)]
    slots = planned_rows(products, SIZES)
    placed = list(boxes(slots, products))
    for number, (low, high) in enumerate(placed):
        assert (np.abs([low, high]) <= np.array(TRAY_M) / 2.0).all()
        for other in range(number):
            if slots[other].tray == slots[number].tray:
                apart = np.maximum(placed[other][0] - high, low - placed[other][1])
                assert apart.max() > -1e-9, "neighbours of a row touch"


def test_neighbours_of_a_row_touch_and_lie_where_the_push_goes():
    """The first stands at the rim, each next one against it, and all are pushed along x."""
    products = ["milk_carton", "meal_tray"] * 2
    slots = planned_rows(products, SIZES)
    placed = list(boxes(slots, products))
    assert placed[0][1][0] == pytest.approx(0.448)  # at the rim
    for one, next_one, slot in zip(placed, placed[1:], slots, strict=False):
        assert one[0][0] == pytest.approx(next_one[1][0])
        assert slot.push.tolist() == [1.0, 0.0, 0.0]


def test_a_cup_is_not_pushed_and_stands_in_a_row_of_its_own():
    """The products around it share the other row."""
    slots = planned_rows(["milk_carton", "yoghurt_cup", "meal_tray"], SIZES)
    assert not slots[1].push.any()
    assert slots[0].tray_from_product[1, 3] == slots[2].tray_from_product[1, 3]
    assert abs(slots[0].tray_from_product[1, 3] - slots[1].tray_from_product[1, 3]) > 0.1


def test_a_tray_takes_twelve_cartons_and_meal_trays():
    """Of fourteen in turn, the first tray has at least twelve."""
    slots = planned_rows(["milk_carton", "meal_tray"] * 7, SIZES)
    assert [slot.tray for slot in slots].count(0) >= 12


def test_contact_is_where_shapes_touch_not_their_boxes():
    """A carton goes under the rim of a meal tray, so the two stand nearer than their boxes."""
    contacts = contacts_between({name: true_surface(name) for name in PRODUCTS})
    assert contacts["milk_carton", "milk_carton"] == pytest.approx(0.2, abs=0.0015)
    assert contacts["meal_tray", "meal_tray"] == pytest.approx(0.16, abs=0.0015)
    assert contacts["milk_carton", "meal_tray"] == pytest.approx(
        0.1755, abs=0.0015
    )  # under the rim
    assert contacts["", "milk_carton"] == pytest.approx(0.1, abs=0.001)


def test_what_no_row_takes_is_refused():
    """The error names the size of the product and the room of a row."""
    with pytest.raises(ValueError, match=r"slab is 300 x 200 mm large; a row takes 808 x 125 mm"):
        planned_rows(["slab"], {"slab": np.array([0.3, 0.2, 0.05])})


def test_the_arm_reaches_all_places():
    """Pointing down, low and high above each place, its hand is off by less than 1 mm."""
    layout = CellLayout()
    slots = planned_rows(["milk_carton"] * 20 + ["yoghurt_cup"] * 20, SIZES)
    for slot in slots:
        pose = layout.base_from_tray @ slot.tray_from_product
        for height in (0.04, 0.2):
            down = pose @ np.diag([1.0, -1.0, -1.0, 1.0])
            down[2, 3] += height
            assert reach(ARM, down, np.array(HOME_RAD)).off_m < 1e-3


@pytest.mark.parametrize("product", PRODUCTS)
def test_a_product_is_held_over_its_centre_of_mass_where_it_is_narrow(product):
    """The fingers close along y, as wide as the product, at its true centre."""
    surface = true_surface(product)
    grasp = grasp_of(surface, mass_kg=0.5)
    assert abs(grasp.axis @ [0.0, 1.0, 0.0]) > 0.99
    assert grasp.width_m == pytest.approx(SIZES[product][1], abs=0.0008)
    assert np.abs(grasp.point[:2] - centre_of_mass(product)[:2]).max() < 0.0015
    assert size_of(surface) == pytest.approx(SIZES[product], abs=0.001)


def test_flat_faces_are_pressed_harder_than_rims():
    """The carton takes more force than the tray and the cup, which take the same."""
    force_n = {name: grasp_of(true_surface(name), mass_kg=0.5).force_n for name in PRODUCTS}
    assert force_n["milk_carton"] > force_n["meal_tray"] == force_n["yoghurt_cup"]


@pytest.mark.parametrize(
    ("case", "kind"),
    [
        (Case("push_into_contact", "in_contact", success=True, verdict="ok"), "go_on"),
        (Case("grasp_from_belt", "missed", success=False, seen="belt"), "retry"),
        (Case("place", "lost", success=False, verdict="missing", seen="tray"), "regrasp"),
        (Case("place", "lost", success=False, verdict="missing"), "ask"),
        (Case("place", "blocked", success=False, seen="hand"), "reject"),
        (Case("push_into_contact", "in_contact", True, "moved", along_mm=-14.0), "push_again"),
        (Case("push_into_contact", "in_contact", True, "moved", across_mm=14.0), "regrasp"),
        (Case("push_into_contact", "in_contact", True, "moved", -30.0, -26.0), "regrasp"),
        (Case("push_into_contact", "in_contact", True, "moved", -21.0, 17.0), "regrasp"),
        (Case("push_into_contact", "in_contact", True, "moved", -35.0, 7.0), "push_again"),
        (Case("push_into_contact", "in_contact", True, "moved", -80.0, 7.0), "ask"),
        (Case("push_into_contact", "in_contact", True, "moved", across_mm=64.0), "ask"),
        (Case("push_into_contact", "in_contact", True, "tipped"), "ask"),
        (Case("push_into_contact", "in_contact", True, "deformed"), "ask"),
        (Case("grasp_from_belt", "not_seen", success=False, seen="belt"), "retry"),
        (Case("place", "lost", success=False, verdict="missing", seen="belt"), "retry"),
        (Case("place", "lost", False, "missing", seen="belt", unfit="it lies"), "ask"),
        (Case("regrasp", "no_net: no room", False, "moved", across_mm=14.0), "ask"),
        (Case("place", "sensor:frozen", success=False, seen="hand"), "stop"),
        (Case("place", "interrupted:carry", success=False, seen="hand"), "stop"),
    ],
)
def test_a_reaction_follows_from_what_was_seen(case, kind):
    """Result, verdict, place and offset of a case decide what the robot does next."""
    assert react(case).kind == kind


@pytest.mark.parametrize("kind", sorted(MOST.keys() - {"push_again", "look"}))
def test_what_was_tried_often_enough_is_asked(kind):
    """After its most tries the operator is asked, and the reason says how often it was tried."""
    seen = {"regrasp": "tray", "retry": "belt", "reject": "hand"}[kind]
    case = Case("place", "lost", success=False, seen=seen)
    assert react(case).kind == kind
    again = Case("place", "lost", success=False, seen=seen, tried={kind: MOST[kind]})
    assert react(again).kind == "ask"
    assert react(again).reason.endswith(f"{kind} was tried {MOST[kind]} times")
    assert kind in REACTIONS


def test_the_worst_place_is_answered_first_wherever_it_is():
    """A tipped package precedes moved ones; sound and excepted places are no answer."""
    verdicts = {1: "ok", 2: "moved", 3: "tipped", 4: "moved", 5: "ok"}
    assert worst(verdicts) == 3
    assert worst(verdicts, but={3}) == 2
    assert worst(verdicts, but={2, 3, 4}) is None
    assert worst({}) is None


GRASP = Grasp(np.zeros(3), np.array([0.0, 1.0, 0.0]), 0.095, 40.0, 0.03, 0.5)
PRESS, OPEN = GripCommand(4, "force", 40.0), GripCommand(4, "width", 0.107)


def measured(width_m, number=4):
    return GripState(number, width_m, 0.0, 40.0, 7)


@pytest.mark.parametrize(
    ("grip", "gripper", "held"),
    [
        (PRESS, measured(0.094), True),  # in whatever stage, however it ended
        (PRESS, measured(0.065), False),  # closed on nothing
        (PRESS, measured(0.120), False),
        (PRESS, None, True),  # a gripper that is silent is not empty
        (OPEN, measured(0.107), False),
        (OPEN, measured(0.095), False),  # it opens past this width, and presses on nothing
        (OPEN, measured(0.095, number=3), True),  # it still does what it was told before
        (None, measured(0.095), False),
    ],
)
def test_what_the_hand_holds_is_known_by_what_it_does(grip, gripper, held):
    """Its width under force decides; a gripper that is silent is not taken for empty."""
    assert is_held(grip, gripper, GRASP) is held
    assert not is_held(grip, gripper, None)
    assert fills(0.0, GRASP) is False


MEAL_TRAY = dataclasses.replace(GRASP, width_m=0.120)


@pytest.mark.parametrize(
    ("grasp", "results", "felt_mm"),
    [
        (GRASP, ["blocked_left"], 27.0),  # the hand had 15 mm of room
        (GRASP, ["blocked_left", "blocked_right"], 13.5),
        (MEAL_TRAY, ["blocked_left"], 13.5),  # 7.5 mm
        (MEAL_TRAY, ["blocked_right", "blocked_right"], -27.0),
        (MEAL_TRAY, ["blocked_right", "blocked", "missed"], -13.5),
    ],
)
def test_a_second_grasp_goes_as_far_as_the_hand_had_no_room(grasp, results, felt_mm):
    """Two grasps of a meal tray find one that is 20 mm beside where it was seen."""
    felt_m = 0.0
    for result in results:
        felt_m = felt_on(felt_m, result, grasp)
    assert 1e3 * felt_m == pytest.approx(felt_mm)


@pytest.mark.parametrize(
    ("verdict", "seen", "tried", "wanted"),
    [
        ("", "hand", (), ("reject", "removed", "stop", "look")),
        ("", "hand", ("reject",), ("removed", "stop", "look")),
        ("", "belt", (), ("retry", "reject", "removed", "stop", "look")),
        ("", "belt", ("retry",) * 3, ("reject", "removed", "stop", "look")),
        ("moved", "tray", (), ("regrasp", "go_on", "reject", "removed", "stop", "look")),
        ("deformed", "tray", (), ("go_on", "reject", "removed", "stop", "look")),
        ("tipped", "tray", (), ("go_on", "removed", "stop", "look")),
        (UNFIT_ON_BELT, "belt", (), ("removed", "stop", "look")),
        ("missing", "", (), ("go_on", "removed", "stop", "look")),
    ],
)
def test_the_operator_is_offered_what_can_be_done_now(verdict, seen, tried, wanted):
    """A full hand grasps nothing, nothing is grasped where it was not seen."""
    assert choices_of(verdict, seen, tried) == wanted


def test_what_the_robot_cannot_take_is_left_to_the_operator():
    """Neither a retry nor a rejection is offered, nor another look."""
    assert choices_of("", "belt", can_take=False) == ("removed", "stop")
