"""How far a request is, and what is known for its next stage: decisions without a cell."""

import numpy as np
import pytest

pytest.importorskip("open3d", exc_type=ImportError)
pytest.importorskip("mujoco", exc_type=ImportError)

from actors.geometry.poses import on_tray
from actors.palletizing import vocabulary as words
from actors.palletizing.handling.nets import Execution, NetError
from actors.palletizing.handling.stages import Known, Progress, handled_of, progress
from actors.palletizing.placing.finger_room import Grasp
from actors.palletizing.placing.grasps import size_of
from enact_dist import Entity

from .handled_cell import PACKAGE, shape_of
from .sound_nets import net, primitive, way

PUSHED = words.Plan("meal_tray", 0, on_tray(0.1, -0.12, np.pi), np.array([1.0, 0.0, 0.0]))
REQUEST = words.Request(4, "pack", "place/1", PACKAGE.name, "why")
NET = net({"hold": primitive(way("done", "elapsed_s > 0.5"), way("failed", "force > 20"))})
GRASP = Grasp(np.array([0.0, 0.0, 0.04]), np.array([0.0, 1.0, 0.0]), 0.095, 45.0, 0.03, 0.5)
MEAL, CARTON = words.product_entity("meal_tray"), words.product_entity("milk_carton")
SURFACES = {MEAL: shape_of("meal_tray"), CARTON: shape_of("milk_carton")}
CELL = {"tray": on_tray(0.6, 0.0, 0.0), "belt": np.eye(4)}


def at(stage, result, *, version=7, request=4):
    """A net that the robot has ended, or is at."""
    attached = words.Attached(7, request, stage, NET, {}, turned=True)
    doing = Execution("net", version, "hold", 7, (), result, np.zeros(6), 0.07, np.eye(4))
    return attached, doing


@pytest.mark.parametrize(
    ("attached", "wanted"),
    [
        ((None, None), Progress(("grasp", "place", "push"))),
        (at("aside", "aside", request=3), Progress(("grasp", "place", "push"))),
        (at("grasp", ""), None),
        (at("grasp", "done", version=6), None),
        (at("aside", "aside"), None),
    ],
    ids=["nothing attached", "another request's", "moving", "not begun", "goes aside"],
)
def test_a_request_is_where_the_robot_is(attached, wanted):
    """The net of another request, or the execution of another net, tells nothing of it."""
    assert progress(REQUEST, PUSHED, *attached) == wanted


@pytest.mark.parametrize(("result", "success"), [("done", True), ("timeout:hold", False)])
def test_the_stages_after_one_that_has_ended_are_left(result, success):
    """The hand stays as it was turned, and the end of the net says whether it succeeded."""
    found = progress(REQUEST, PUSHED, *at("grasp", result))
    assert found == Progress(("place", "push"), "grasp", result, success, turned=True)


def test_a_package_that_is_not_pushed_is_done_when_it_is_placed():
    """Nothing is left."""
    plan = words.Plan("meal_tray", 0, np.eye(4))
    assert progress(REQUEST, plan, *at("place", "done")).left == ()


def sighting(frame="belt", product="meal_tray"):
    return words.Sighting(0, np.eye(4), 1, 1, frame, product)


def about(request, *, seen=None, grasps=None):
    """What is known for a request in a cell that knows more."""
    plans = {Entity("place/0"): PUSHED, Entity("place/1"): PUSHED}
    sightings = {PACKAGE: seen or sighting(), Entity("package/b"): sighting()}
    return Known.about(request, CELL, plans, sightings, {MEAL: GRASP} if grasps is None else grasps)


def test_no_more_is_known_than_what_a_request_is_about():
    """Whatever is looked at becomes a cause of the net."""
    known = about(REQUEST)
    assert (set(known.plans), set(known.sightings)) == ({"place/1"}, {PACKAGE.name})
    nothing = about(words.Request(4, "look", "", "", "why"))
    assert (nothing.plans, nothing.sightings) == ({}, {})


@pytest.mark.parametrize(("frame", "grasps", "y_m"), [("belt", None, 0.02), ("tray", None, 0.0), ("belt", {}, 0.0)])  # fmt: skip
def test_a_package_is_where_fingers_have_felt_it_on_the_belt(frame, grasps, y_m):
    """Along the axis of its grasp; on the tray it has been seen since."""
    request = words.Request(4, "retry", "place/1", PACKAGE.name, "why", felt_m=0.02)
    known = about(request, seen=sighting(frame), grasps=grasps)
    assert known.sightings[PACKAGE.name].frame_from_package[1, 3] == pytest.approx(y_m)


def flag(verdict, product="milk_carton"):
    pose = on_tray(0.2, 0.0, 0.0)
    return words.Deviation("", product, verdict, 0.0, 0.0, 0.0, 0.0, 9, pose)


@pytest.mark.parametrize(
    ("kind", "verdict", "other", "beside"),
    [
        ("regrasp", "ok", PUSHED, True),
        ("retry", "ok", PUSHED, True),
        ("pack", "ok", PUSHED, False),
        ("push_again", "ok", PUSHED, False),
        ("regrasp", "missing", PUSHED, False),
        ("regrasp", "ok", words.Plan("milk_carton", 1, np.eye(4)), False),
    ],
    ids=["taken anew", "again", "first of all", "no grasp", "nothing there", "another tray"],
)
def test_what_stands_beside_matters_where_a_hand_goes_down(kind, verdict, other, beside):
    """In the frame of the arm's base, with the size of its product."""
    request = words.Request(4, kind, "place/1", PACKAGE.name, "why", "tray")
    flags = {"place/0": flag(verdict), "place/1": flag("moved", "meal_tray")}
    plans = {Entity("place/0"): other, Entity("place/1"): PUSHED}
    handled = handled_of(
        request, about(request), grasps={MEAL: GRASP}, surfaces=SURFACES, plans=plans, flags=flags
    )
    np.testing.assert_allclose(handled.size_m, size_of(SURFACES[MEAL]))
    assert [name for name, _, _ in handled.beside] == (["place/0"] if beside else [])
    for _, pose, size_m in handled.beside:
        np.testing.assert_allclose(pose, on_tray(0.8, 0.0, 0.0))
        np.testing.assert_allclose(size_m, size_of(SURFACES[CARTON]))


@pytest.mark.parametrize(
    ("seen", "grasps", "why"),
    [
        (sighting(product=""), {MEAL: GRASP}, "it is not known what package/a is"),
        (sighting(), {}, "no grasp of meal_tray is known"),
    ],
)
def test_what_is_not_known_cannot_be_handled(seen, grasps, why):
    """One line says what is missing."""
    known = about(REQUEST, seen=seen)
    with pytest.raises(NetError, match=f"pack: {why}"):
        handled_of(REQUEST, known, grasps=grasps, surfaces=SURFACES, plans={}, flags={})
