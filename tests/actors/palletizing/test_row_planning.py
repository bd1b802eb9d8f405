"""Plans, belt and trays: what comes when, and whether the plan knows what became of the rest."""

import time
from dataclasses import replace

import numpy as np
import pytest
from lost_commits import lose_commit

pytest.importorskip("open3d", exc_type=ImportError)
pytest.importorskip("mujoco", exc_type=ImportError)

from actors.palletizing import vocabulary as words
from actors.palletizing.action import Action
from actors.palletizing.conveyor import OVERLOOKED_S, BeltConveyor, Came
from actors.palletizing.feedback import HandlingFeedback
from actors.palletizing.planning import RowPlanning, left_out
from enact_dist import Entity, testing

from .handled_cell import (
    NAMES,
    PLACE,
    REMOTE,
    closed,
    come,
    each,
    executed,
    packed,
    planned,
    read,
    write,
)


def test_planning_makes_rows_and_closes_the_gap_of_a_rejected_package(cell):
    """All places touch; the place of the next package moves up when one was rejected."""
    before = each(cell, words.PLACES, words.PLAN)
    assert len(before) == 4
    assert all(plan.push.any() for plan in before.values())
    rejected = words.Result("package/a", "milk_carton", "deformed", "rejected", (), "why")
    write(cell, words.SYSTEM, words.RESULTS, {PLACE.name: rejected})
    planned(cell)
    after = each(cell, words.PLACES, words.PLAN)
    np.testing.assert_array_equal(after[PLACE].tray_from_product, before[PLACE].tray_from_product)
    first, second = Entity("place/1"), Entity("place/2")
    assert after[first].product == before[first].product
    x = after[first].tray_from_product[0, 3], before[first].tray_from_product[0, 3]
    assert abs(x[0]) > abs(x[1]) + 0.1
    assert abs(after[second].tray_from_product[0, 3]) < abs(x[0])


def test_scans_are_ordered_as_soon_as_the_tray_was_seen_empty():
    """No product is trained yet; planning waits for what happens and looks at nothing else."""
    from actors.palletizing.simulation.physical_sensors import PhysicalTraySensor
    from actors.palletizing.simulation.physics import PhysicalCell

    planning = RowPlanning(4, " ".join(NAMES), f"{REMOTE}:cell_frames")
    with testing.worlds("training", "online") as cell:
        assert testing.run_once(planning, cell) == 0
        empty = PhysicalTraySensor(PhysicalCell(1, seed=1).shown, seed=1).capture_empty()
        cell.world("training").init(words.TRAY, words.EMPTY, empty)
        testing.run_once(planning, cell)
        assert len(each(cell, words.PRODUCTS, words.SCAN)) == 2
        assert read(cell, words.CELL, words.FRAMES, "training").keys() == {"tray", "belt", "bin"}
        assert testing.run_once(planning, cell) == 0
    assert planning.every_s is None


def test_a_place_between_others_stays_empty_and_the_plan_after_it_stands(cell):
    """What stands behind a package that was taken away does not move up, nor what comes."""
    closed(cell, place_0="placed", place_1="placed", place_2="placed")
    planned(cell)
    before = each(cell, words.PLACES, words.PLAN)
    closed(cell, place_0="placed", place_1="removed", place_2="placed")
    planned(cell)
    after = each(cell, words.PLACES, words.PLAN)
    for place, plan in before.items():
        np.testing.assert_array_equal(after[place].tray_from_product, plan.tray_from_product)
    assert read(cell, words.CELL, words.PLANNED, "training").left_out == ()


def test_a_place_in_progress_is_not_planned_anew(cell):
    """A place that was opened again keeps its plan, though one after it was rejected."""
    closed(cell, place_0="placed", place_2="rejected")
    write(cell, words.SYSTEM, words.REQUEST, words.Request(7, "regrasp", "place/1", "b", "why"))
    before = each(cell, words.PLACES, words.PLAN)
    write(
        cell, Entity("place/1"), words.PLAN, replace(before[Entity("place/1")], tray=9), "training"
    )
    planned(cell)
    after = each(cell, words.PLACES, words.PLAN)
    assert after[Entity("place/1")].tray == 9
    third = Entity("place/3")
    assert (after[third].tray_from_product != before[third].tray_from_product).any()


def test_a_plan_begins_anew_with_the_online_context(cell):
    """What was left out before has not come yet: all packages have places of their own."""
    before = each(cell, words.PLACES, words.PLAN)
    closed(cell, place_0="placed", place_1="rejected")
    planned(cell)
    assert read(cell, words.CELL, words.PLANNED, "training").left_out == (1,)
    write(cell, words.SYSTEM, words.RESULTS, {})
    planned(cell)
    assert read(cell, words.CELL, words.PLANNED, "training").left_out == ()
    after = each(cell, words.PLACES, words.PLAN)
    for place, plan in before.items():
        np.testing.assert_array_equal(after[place].tray_from_product, plan.tray_from_product)


def test_a_plan_that_does_not_know_the_last_result_is_waited_for(cell):
    """The next package is requested when the plan has moved up, not before."""
    closed(cell, place_0="rejected")
    come(cell, product="meal_tray", number=1, package=Entity("package/b"))
    feedback = HandlingFeedback()
    testing.run_once(feedback, cell)
    assert read(cell, words.SYSTEM, words.REQUEST) is None
    planned(cell)
    testing.run_once(feedback, cell)
    assert read(cell, words.SYSTEM, words.REQUEST).place == "place/1"


class Belt:
    """A belt that brings a package as soon as it is run."""

    def __init__(self):
        self.runs, self.changed, self.there = 0, 0, False

    def run_belt(self):
        self.runs += 1
        self.there = True

    def arrived(self):
        return self.there

    def change_tray(self):
        self.changed += 1


def empty_belt():
    """Return an image of the empty belt."""
    from actors.palletizing.simulation.physical_sensors import PhysicalBeltSensor
    from actors.palletizing.simulation.physics import PhysicalCell

    return PhysicalBeltSensor(PhysicalCell(1, seed=1).shown, seed=1).capture_empty()


def test_belt_waits_until_the_package_before_is_off_it(cell, monkeypatch):
    """The next one comes when the one before was put down: what is lost may lie on the belt."""
    belt = Belt()
    monkeypatch.setattr("actors.palletizing.conveyor.open_controller", lambda _: belt)
    conveyor = BeltConveyor("any")
    testing.run_once(conveyor, cell)
    assert belt.runs == 0  # the belt has not been seen empty
    empty = each(cell, words.PRODUCTS, words.SCAN)
    assert empty
    write(cell, words.BELT, words.EMPTY, empty_belt(), "training")
    for _ in range(4):
        testing.run_once(conveyor, cell)
    assert (belt.runs, read(cell, words.CONVEYOR, words.ARRIVAL).number) == (1, 0)
    come(cell)
    testing.run_once(HandlingFeedback(), cell)
    packed(cell, "held")
    testing.run_once(Action(), cell)
    for _ in range(3):
        testing.run_once(conveyor, cell)
    assert belt.runs == 1
    executed(cell, "placed")
    packed(cell)
    testing.run_once(Action(), cell)
    for _ in range(3):
        testing.run_once(conveyor, cell)
    assert (belt.runs, read(cell, words.CONVEYOR, words.ARRIVAL).number) == (2, 1)


def test_what_is_taken_out_of_the_light_barrier_unrecognised_is_reported(cell, monkeypatch):
    """When the barrier has been free for a while; a package that has a name is followed by it."""
    belt = Belt()
    monkeypatch.setattr("actors.palletizing.conveyor.open_controller", lambda _: belt)
    monkeypatch.setattr("actors.palletizing.conveyor.FREE_S", 0.0)
    conveyor = BeltConveyor("any")
    write(cell, words.BELT, words.EMPTY, empty_belt(), "training")
    write(cell, words.CONVEYOR, words.ARRIVAL, words.Arrival(0, time.time_ns()))

    def gone():
        testing.run_once(conveyor, cell)
        return read(cell, words.CONVEYOR, words.ARRIVAL).is_gone

    belt.there = True
    assert not gone()
    belt.there = False
    request = words.Request(1, "ask", PLACE.name, "package/a", "why")
    write(cell, words.SYSTEM, words.REQUEST, request)
    assert not gone()
    write(cell, words.SYSTEM, words.REQUEST, replace(request, package=""))
    assert gone()
    assert belt.runs == 0
    closed(cell, place_0="removed")
    planned(cell)
    testing.run_once(conveyor, cell)
    assert belt.runs == 1


def test_an_arrival_is_reported_until_it_stands(cell, monkeypatch):
    """Its commit fails: the belt is not run again under the package in the light barrier."""
    belt = Belt()
    monkeypatch.setattr("actors.palletizing.conveyor.open_controller", lambda _: belt)
    conveyor = BeltConveyor("any")
    write(cell, words.BELT, words.EMPTY, empty_belt(), "training")
    testing.run_once(conveyor, cell)
    lose_commit(conveyor, cell)
    assert read(cell, words.CONVEYOR, words.ARRIVAL) is None
    testing.run_once(conveyor, cell)
    assert (belt.runs, read(cell, words.CONVEYOR, words.ARRIVAL).number) == (1, 0)


def two_on_a_tray(cell, monkeypatch):
    """Return belt and conveyor of a cell in which two packages fill a tray, when both have come."""
    belt = Belt()
    monkeypatch.setattr("actors.palletizing.conveyor.open_controller", lambda _: belt)
    conveyor = BeltConveyor("any")
    write(cell, words.CONVEYOR, words.ARRIVAL, words.Arrival(1, 7))
    write(cell, words.BELT, words.EMPTY, empty_belt(), "training")
    for number in (2, 3):
        place = Entity(f"place/{number}")
        plan = each(cell, words.PLACES, words.PLAN)[place]
        write(cell, place, words.PLAN, replace(plan, tray=1), "training")
    return belt, conveyor


def test_a_tray_is_changed_by_a_plan_that_knows_all_results(cell, monkeypatch):
    """The last one was rejected: the plan before that ended the tray, the one after does not."""
    belt, conveyor = two_on_a_tray(cell, monkeypatch)
    closed(cell, place_0="placed", place_1="rejected")
    testing.run_once(conveyor, cell)
    assert (belt.changed, belt.runs) == (0, 0)
    planned(cell)
    testing.run_once(conveyor, cell)
    assert (belt.changed, belt.runs) == (0, 1)  # the third finds room in place of the second


def test_a_tray_is_changed_when_all_of_its_places_are_closed(cell, monkeypatch):
    """A neighbour that was opened again keeps it there."""
    belt, conveyor = two_on_a_tray(cell, monkeypatch)
    closed(cell, place_1="placed")
    planned(cell)
    testing.run_once(conveyor, cell)
    assert (belt.changed, belt.runs) == (0, 0)
    closed(cell, place_0="placed", place_1="placed")
    planned(cell)
    testing.run_once(conveyor, cell)
    assert (belt.changed, belt.runs) == (1, 1)


def became(**results):
    """What became of packages: `place_0="placed"`."""
    return {
        name.replace("_", "/"): words.Result("package/a", "milk_carton", "", one, (), "why")
        for name, one in results.items()
    }


@pytest.mark.parametrize(
    ("results", "before", "wanted"),
    [
        ({}, None, ()),
        ({"place_0": "rejected"}, None, (0,)),
        ({"place_0": "rejected", "place_1": "placed"}, None, ()),
        ({"place_0": "rejected", "place_1": "placed"}, (0,), (0,)),
        ({"place_0": "placed", "place_1": "skipped", "place_2": "removed"}, None, (1, 2)),
        ({"place_1": "placed"}, (0,), ()),
        ({"place_9": "rejected"}, None, ()),
    ],
    ids=["none came", "the last", "between", "was left out", "after the last that stands",
         "has not come yet", "of no plan"],
)  # fmt: skip
def test_later_packages_fill_the_places_after_the_last_that_stands(results, before, wanted):
    """A gap between others stays; one that was closed before stays closed while its package came."""
    planned_before = None if before is None else words.Planned({}, before)
    assert left_out(4, became(**results), planned_before) == wanted


REQUEST = words.Request(4, "pack", "place/1", "package/b", "why")


def came(request=None, *, stage="", outcome=None, **results):
    """The second package, of which is known what the test says."""
    attached = words.Attached(1, 4, stage, None, {}) if stage else None
    return Came(words.Arrival(1, 7), request, attached, outcome, became(**results))


@pytest.mark.parametrize(
    ("about", "overlooked", "followed"),
    [
        (came(), True, False),
        (came(replace(REQUEST, place="place/0")), False, False),
        (came(replace(REQUEST, place="place/0"), place_0="placed"), True, False),
        (came(REQUEST), False, True),
        (came(replace(REQUEST, package="")), False, False),
        (came(place_1="removed"), False, True),
    ],
    ids=["nothing requested", "busy", "idle", "packed", "not recognised", "closed"],
)
def test_a_package_that_no_request_is_about_was_overlooked(about, overlooked, followed):
    """After a while; one that has a name is followed by perception, not by the light barrier."""
    waited_ns = 8 + round(OVERLOOKED_S * 1e9)
    assert about.is_overlooked(waited_ns) is overlooked
    assert not about.is_overlooked(waited_ns - 1)
    assert about.is_followed is followed


PLACED = words.Outcome(4, "place", "placed", success=True, stamp_ns=9)


@pytest.mark.parametrize(
    ("about", "is_off"),
    [
        (came(), False),
        (came(place_1="rejected"), True),
        (came(REQUEST, stage="place"), False),
        (came(REQUEST, stage="push"), True),
        (came(replace(REQUEST, number=5), stage="push"), False),
        (came(REQUEST, outcome=PLACED), True),
        (came(REQUEST, outcome=replace(PLACED, success=False)), False),
        (came(REQUEST, outcome=replace(PLACED, stage="grasp")), False),
        (came(replace(REQUEST, place="place/0"), outcome=PLACED), False),
    ],
)
def test_a_package_is_off_the_belt_when_it_was_put_down(about, is_off):
    """What was lost on its way may lie on the belt: the next one waits for its result."""
    assert about.is_off(None, ends_tray=False) is is_off


def test_a_full_tray_is_changed_when_every_place_is_closed_and_planned_for():
    """The plan has to know the results: the next package may still find room."""
    plans = {Entity(f"place/{n}"): words.Plan("any", n // 2, np.eye(4)) for n in range(4)}
    full = came(place_0="placed", place_1="rejected")
    assert full.ends_tray(plans)
    assert not replace(full, last=words.Arrival(0, 7)).ends_tray(plans)
    known = words.Planned({"place/0": "placed", "place/1": "rejected"}, (1,))
    assert full.is_off(known, ends_tray=True)
    assert not full.is_off(words.Planned({"place/0": "placed"}, ()), ends_tray=True)
    opened = came(place_1="rejected")
    assert not opened.is_off(words.Planned({"place/1": "rejected"}, (1,)), ends_tray=True)
