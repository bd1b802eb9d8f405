"""What pictures of belt and tray show of one package, without a cell."""

import numpy as np
import pytest

pytest.importorskip("open3d", exc_type=ImportError)

from actors.geometry.poses import on_tray
from actors.palletizing import vocabulary as words
from actors.palletizing.handling.data import TAKEN_OUT, UNRECOGNISED, UNSEEN_LOOKS
from actors.palletizing.handling.grounding import aside_net
from actors.palletizing.handling.nets import Execution
from actors.palletizing.handling.stages import (
    is_on_belt_first,
    way_aside,
)
from actors.palletizing.sight.tray_sight import GONE_M, Tray, tray_sight
from enact_dist import Entity

from .handled_cell import shape_of
from .tray_pictures import looked_at

CARTON, MEAL = on_tray(0.30, -0.12, np.pi), on_tray(0.05, -0.12, np.pi)
PLANNED = {"milk_carton": CARTON, "meal_tray": MEAL}
FIRST, SECOND = Entity("package/a"), Entity("package/b")


@pytest.fixture(scope="module")
def tray():
    """A carton was seen at its place on the tray, a meal tray on the belt."""
    return Tray(
        number=0,
        empty=looked_at(seed=9),
        models={words.product_entity(name): shape_of(name) for name in PLANNED},
        plans={
            words.place_entity(stop): words.Plan(name, 0, pose)
            for stop, (name, pose) in enumerate(PLANNED.items())
        },
        sightings={
            FIRST: words.Sighting(0, CARTON, 0, 0, "tray", "milk_carton"),
            SECOND: words.Sighting(0, np.eye(4), 1, 1, "belt", "meal_tray", "it leans"),
        },
    )


def sight(tray, *packages, before=(("milk_carton", CARTON),), about=SECOND, kind="pack"):
    """What two pictures of the tray, one after the other, show of a package."""
    last, now = looked_at(*before, seed=2), looked_at(*packages, seed=3)
    return tray_sight(now, last, tray, about, kind=kind, captured_ns=7)


def test_what_was_put_down_is_seen_and_its_neighbour_that_stands_is_not_judged(tray):
    """The package is on the tray, fit for the hand again; the carton is as it was before."""
    found = sight(tray, ("milk_carton", CARTON), ("meal_tray", MEAL))
    assert list(found.sightings) == [SECOND]
    seen = found.sightings[SECOND]
    assert (seen.frame, seen.product, seen.unfit, seen.first_stop) == ("tray", "meal_tray", "", 1)
    assert np.hypot(*(seen.frame_from_package - MEAL)[:2, 3]) < 0.005
    (place,) = found.observations
    assert place == words.place_entity(1)
    assert found.observations[place].packages == (SECOND.name,)
    assert found.clouds.keys() == {SECOND}


def test_a_neighbour_that_was_pushed_is_seen_where_it_is_now(tray):
    """Both places are judged, each beside where the other one stands now."""
    off = on_tray(0.0, 0.04, 0.0) @ CARTON
    found = sight(tray, ("milk_carton", off), ("meal_tray", MEAL))
    assert list(found.sightings) == [SECOND, FIRST]
    assert np.hypot(*(found.sightings[FIRST].frame_from_package - off)[:2, 3]) < 0.005
    assert set(found.observations) == {words.place_entity(0), words.place_entity(1)}
    beside = found.observations[words.place_entity(1)].before_mm
    alone = tray.without(FIRST, looked_at(seed=3))
    assert (beside < alone - 20.0).any(), "the carton stands in the picture without the meal tray"


@pytest.mark.parametrize("kind", ["pack", "reject"])
def test_what_is_nowhere_has_left_the_tray(tray, kind):
    """It keeps its last pose; its place is judged unless it was to be gone."""
    found = sight(tray, about=FIRST, kind=kind)
    assert found.sightings[FIRST].frame == ""
    assert found.sightings[FIRST].frame_from_package is CARTON
    assert found.clouds == {}
    judged = [seen.packages for seen in found.observations.values()]
    assert judged == ([] if kind == "reject" else [()])


def test_what_is_far_from_where_a_package_shall_be_gone_is_something_else(tray):
    """After a removal another thing on the tray is not taken for it; after a placement it is."""
    far = on_tray(0.0, GONE_M + 0.1, 0.0) @ CARTON
    assert sight(tray, ("milk_carton", far), about=FIRST, kind="removed").clouds == {}
    assert sight(tray, ("milk_carton", far), about=FIRST).clouds.keys() == {FIRST}


def test_the_belt_is_looked_at_once_and_again_whenever_the_arm_has_gone_aside():
    """What was not seen may have been hidden; what is known is not looked for again."""
    arrival, looks = words.Arrival(3, 7), words.BeltLooks()
    assert looks.is_due(arrival, 0)
    unseen = looks.after(arrival, 0, seen=False, failed=False)
    assert [unseen.is_due(arrival, aside) for aside in (0, 5)] == [False, True]
    assert not unseen.after(arrival, 5, seen=False, failed=False).is_due(arrival, 5)
    known = unseen.after(arrival, 5, seen=True, failed=False)
    assert not known.is_due(arrival, 6)
    assert known.is_due(words.Arrival(3, 8), 0)


def test_looks_that_show_nothing_end_in_an_error():
    """A look that the sensor failed to take does not count, and the next package starts anew."""
    arrival, looks = words.Arrival(3, 7), words.BeltLooks()
    errors = []
    for failed in (True, *[False] * UNSEEN_LOOKS):
        looks = looks.after(arrival, 0, seen=False, failed=failed)
        errors.append(looks.error(is_gone=False))
    assert errors == [*[""] * UNSEEN_LOOKS, UNRECOGNISED]
    assert looks.error(is_gone=True) == TAKEN_OUT
    assert looks.after(arrival, 0, seen=True, failed=False).error(is_gone=True) == ""
    following = looks.after(words.Arrival(4, 8), 0, seen=False, failed=False)
    assert following.error(is_gone=False) == ""


@pytest.mark.parametrize(
    ("stage", "version", "wanted"),
    [("aside", 4, (4, "blocked")), ("aside", 3, (4, "")), ("push", 4, (0, ""))],
)
def test_only_the_net_that_takes_the_arm_aside_tells_that_it_is_there(stage, version, wanted):
    """The execution of an older net, or of another stage, tells nothing."""
    attached = words.Attached(4, 2, stage, aside_net(turned=False), {})
    doing = Execution("go", version, "go", 7, (), "blocked", np.zeros(6), 0.07, np.eye(4))
    assert way_aside(attached, doing) == wanted
    assert way_aside(None, doing) == way_aside(attached, None) == (0, "")


@pytest.mark.parametrize(
    ("kind", "seen", "stage", "success", "wanted"),
    [
        ("pack", "belt", "grasp", False, True),
        ("pack", "belt", "push", True, False),
        ("look", "belt", "aside", True, True),
        ("look", "tray", "aside", True, False),
        ("reject", "belt", "remove", True, False),
    ],
)
def test_the_belt_is_looked_at_first_where_the_package_may_be_still(
    kind, seen, stage, success, wanted
):
    """After a grasp that failed, and where it was seen there and nothing has moved it."""
    request = words.Request(1, kind, "place/1", SECOND.name, "why", seen)
    outcome = words.Outcome(1, stage, "any", success, 7)
    assert is_on_belt_first(request, outcome) is wanted
