"""Claims about the actors that pack with a robot, one by one, in process on the real core."""

import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("open3d", exc_type=ImportError)
pytest.importorskip("mujoco", exc_type=ImportError)

from actors.palletizing import vocabulary as words
from actors.palletizing.action import Action
from actors.palletizing.action_generator import ActionGenerator
from actors.palletizing.conveyor import BeltConveyor
from actors.palletizing.demo_lineage import show_packing
from actors.palletizing.demo_robot_cell import TEMPLATE, configured
from actors.palletizing.feedback import HandlingFeedback
from actors.palletizing.handling import UNRECOGNISED
from actors.palletizing.nets import Execution
from actors.palletizing.operator import Operator
from actors.palletizing.planning import RowPlanning
from actors.palletizing.simulation.cell_scene import HOME_RAD, CellLayout
from actors.palletizing.training_grasp import TrainingGrasp
from actors.workcell.vocabulary import JOINTS, JOINTS_KEPT, Joints
from enact_dist import Entity, Lock, View, ViewEach, Write, testing
from enact_dist.actor_check import check_cell
from enact_dist.config import load_config

REMOTE = "actors.palletizing.simulation.remote_cell"
ARM = f"{REMOTE}:arm?port=1"
PACKAGE, PLACE = Entity("package/a"), Entity("place/0")
NAMES = ("milk_carton", "meal_tray")


@pytest.fixture
def cell(trained):
    """A cell with two trained products, grasps, and a plan of four packages."""
    with testing.worlds("training", "online") as cell:
        training = cell.world("training")
        for name in NAMES:
            training.init(words.product_entity(name), words.SURFACE, trained(name))
        planned(cell)
        testing.run_once(TrainingGrasp("milk_carton=0.5 meal_tray=0.35"), cell)
        still = np.tile(np.array(HOME_RAD), (JOINTS_KEPT, 1))
        stamps = np.arange(JOINTS_KEPT, dtype=np.int64)
        write(cell, words.ROBOT, JOINTS, Joints(still, 0.0 * still, stamps))
        yield cell


def planned(cell):
    """Let planning have taken note of all results."""
    testing.run_once(RowPlanning(4, " ".join(NAMES), f"{REMOTE}:cell_frames"), cell)


def write(cell, entity, aspect, datum, world="online"):
    request = Write(cell.world(world), entity, aspect)
    with Lock(request) as lock:
        lock[request] = datum


def read(cell, entity, aspect, world="online"):
    request = View(cell.world(world), entity, aspect)
    return cell.world(world).view(request).get(request)


def each(cell, pattern, aspect, world="training"):
    request = ViewEach(cell.world(world), pattern, aspect)
    return dict(cell.world(world).view(request)[request])


def come(cell, *, product="milk_carton", number=0, package=PACKAGE):
    """Let perception have seen a package on the belt."""
    pose = np.eye(4)
    pose[0, 3] = -0.1
    seen = words.Sighting(0, pose, number, number, "belt", product)
    write(cell, package, words.SIGHTING, seen)


def executed(cell, result):
    """Let the robot have ended the attached net."""
    net = read(cell, words.SYSTEM, words.NET)
    doing = Execution(
        net.net.name, net.number, net.net.start, 7, (), result, np.zeros(6), 0.07, np.eye(4)
    )
    write(cell, words.ROBOT, words.EXECUTION, doing)


def looked(cell, seen, verdict="", *, error="", x_m=0.0, captured_ns=9, **neighbours):
    """Let perception and deviation detection have answered the outcome.

    Neighbours that have moved are verdicts by the number of their place: `place_0="tipped"`.
    """
    request = read(cell, words.SYSTEM, words.REQUEST)
    found = {request.place: verdict} if verdict else {}
    found |= {name.replace("_", "/"): one for name, one in neighbours.items()}
    look = words.Look(request.number, seen, captured_ns if found else 0, tuple(found), error)
    write(cell, words.SYSTEM, words.LOOK, look)
    flags = read(cell, words.SYSTEM, words.DEVIATIONS) or {}
    for place, judged in found.items():
        plan = each(cell, words.PLACES, words.PLAN)[Entity(place)]
        pose = np.array(plan.tray_from_product)
        pose[0, 3] += x_m
        flag = (PACKAGE.name, plan.product, judged, 1.0, 1.0, 1.0, 1.0, captured_ns)
        flags = {**flags, place: words.Deviation(*flag, tray_from_product=pose)}
    write(cell, words.SYSTEM, words.DEVIATIONS, flags)


def packed(cell, *results):
    """Run the stages of the present request with these results; the last one may fail."""
    generator, action = ActionGenerator(ARM), Action()
    stages = []
    for result in results:
        testing.run_once(generator, cell)
        testing.run_once(action, cell)
        stages.append(read(cell, words.SYSTEM, words.NET).stage)
        executed(cell, result)
    testing.run_once(generator, cell)
    return stages


def test_shipped_cell_fits_together():
    """No two actors write one slot, every trigger is written, every option can be read."""
    assert [f.text for f in check_cell(load_config(TEMPLATE)) if f.level == "error"] == []


def test_cell_of_a_run_has_its_own_hardware_seed_and_folders():
    """Every address names the run's port and seed; the actors are the shipped ones."""
    text = configured(
        TEMPLATE.read_text(),
        packages=5,
        seed=3,
        data=Path("/data"),
        ports=(7001, 7002),
        hardware=7999,
    )
    run = tomllib.loads(text)
    assert run["actors"].keys() == tomllib.loads(TEMPLATE.read_text())["actors"].keys()
    assert run["actors"]["planning"]["options"]["packages"] == 5
    assert "7460" not in text
    assert "seed=59" not in text


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


def closed(cell, **results):
    """Let feedback have closed places: `place_0="placed"`."""
    found = {
        name.replace("_", "/"): words.Result(f"package/{name}", "milk_carton", "", one, (), "why")
        for name, one in results.items()
    }
    write(cell, words.SYSTEM, words.RESULTS, found)


def test_scans_are_ordered_as_soon_as_the_tray_was_seen_empty(trained):
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


def test_a_package_is_grasped_placed_and_pushed(cell):
    """One request has three nets, one after the other, then the arm goes aside."""
    come(cell)
    testing.run_once(HandlingFeedback(), cell)
    assert read(cell, words.SYSTEM, words.REQUEST).kind == "pack"
    stages = packed(cell, "held", "placed", "in_contact", "aside")
    assert stages == ["grasp", "place", "push", "aside"]
    outcome = read(cell, words.SYSTEM, words.OUTCOME)
    assert (outcome.stage, outcome.result, outcome.success) == ("push", "in_contact", True)
    looked(cell, "tray", "ok")
    testing.run_once(HandlingFeedback(), cell)
    result = read(cell, words.SYSTEM, words.RESULTS)[PLACE.name]
    assert (result.result, result.reactions) == ("placed", ())


def test_net_names_where_its_entities_are(cell):
    """The frames that were known go with the net: package, place, nothing else."""
    come(cell)
    testing.run_once(HandlingFeedback(), cell)
    packed(cell, "held")
    candidate = read(cell, words.SYSTEM, words.CANDIDATE)
    plan = each(cell, words.PLACES, words.PLAN)[PLACE]
    assert candidate.stage == "place"
    assert set(candidate.frames) == {PLACE.name}
    expected = CellLayout().base_from_tray @ plan.tray_from_product
    np.testing.assert_allclose(candidate.frames[PLACE.name], expected)


def test_action_attaches_nothing_while_the_robot_moves(cell):
    """The candidate of the next stage waits until the net before has ended."""
    come(cell)
    testing.run_once(HandlingFeedback(), cell)
    generator, action = ActionGenerator(ARM), Action()
    testing.run_once(generator, cell)
    testing.run_once(action, cell)
    first = read(cell, words.SYSTEM, words.NET)
    candidate = read(cell, words.SYSTEM, words.CANDIDATE)
    write(cell, words.SYSTEM, words.CANDIDATE, replace(candidate, stage="place"))
    testing.run_once(action, cell)
    assert read(cell, words.SYSTEM, words.NET).number == first.number
    executed(cell, "held")
    testing.run_once(action, cell)
    assert read(cell, words.SYSTEM, words.NET).number == first.number + 1


@pytest.mark.parametrize(
    ("results", "seen", "verdict", "x_m", "wanted"),
    [
        (("missed", "aside"), "belt", "", 0.0, "retry"),
        (("held", "lost", "aside"), "tray", "missing", 0.0, "regrasp"),
        (("held", "placed", "in_contact", "aside"), "tray", "moved", 0.02, "regrasp"),
        (("held", "placed", "in_contact", "aside"), "tray", "deformed", 0.0, "ask"),
        (("held", "not_following:3"), "tray", "", 0.0, "ask"),
    ],
)
def test_feedback_decides_by_what_was_seen(cell, results, seen, verdict, x_m, wanted):
    """Missed and moved are tried again; what could become worse is asked, with the reason."""
    come(cell)
    testing.run_once(HandlingFeedback(), cell)
    packed(cell, *results)
    looked(cell, seen, verdict, x_m=x_m)
    testing.run_once(HandlingFeedback(), cell)
    request = read(cell, words.SYSTEM, words.REQUEST)
    assert request.kind == wanted
    assert request.reason
    assert (read(cell, words.USER, words.QUESTION) is not None) == (wanted == "ask")


def test_operator_answers_and_the_robot_rejects(cell, capsys):
    """A deformed package goes to the bin when the operator says so; the result says why."""
    come(cell)
    testing.run_once(HandlingFeedback(), cell)
    packed(cell, "held", "placed", "in_contact", "aside")
    on_tray = each(cell, words.PLACES, words.PLAN)[PLACE].tray_from_product
    write(cell, PACKAGE, words.SIGHTING, words.Sighting(0, on_tray, 0, 0, "tray", "milk_carton"))
    looked(cell, "tray", "deformed")
    testing.run_once(HandlingFeedback(), cell)
    testing.run_once(Operator(answers="reject"), cell)
    testing.run_once(HandlingFeedback(), cell)
    assert read(cell, words.SYSTEM, words.REQUEST).kind == "reject"
    assert packed(cell, "held", "rejected", "aside") == ["regrasp", "remove", "aside"]
    looked(cell, "")
    testing.run_once(HandlingFeedback(), cell)
    result = read(cell, words.SYSTEM, words.RESULTS)[PLACE.name]
    assert (result.result, result.reactions) == ("rejected", ("reject",))
    assert "place/0: it is deformed" in capsys.readouterr().out


def test_a_package_that_could_not_be_rejected_is_not_placed_again(cell):
    """Whatever a failed grasp would else lead to: the operator is asked once more."""
    come(cell)
    testing.run_once(HandlingFeedback(), cell)
    packed(cell, "held", "placed", "in_contact", "aside")
    on_tray = each(cell, words.PLACES, words.PLAN)[PLACE].tray_from_product
    write(cell, PACKAGE, words.SIGHTING, words.Sighting(0, on_tray, 0, 0, "tray", "milk_carton"))
    looked(cell, "tray", "deformed")
    testing.run_once(HandlingFeedback(), cell)
    testing.run_once(Operator(answers="reject"), cell)
    testing.run_once(HandlingFeedback(), cell)

    packed(cell, "missed", "aside")
    looked(cell, "tray", "ok")
    testing.run_once(HandlingFeedback(), cell)

    request = read(cell, words.SYSTEM, words.REQUEST)
    assert request.kind == "ask"
    assert request.reason == "it could not be rejected: missed"


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"width_m": 0.18}, "180 mm wide"),
        (
            {"mass_kg": 3.5},
            "a milk_carton of 3.5 kg; the gripper carries more than 0 and at most 2",
        ),
    ],
)
def test_a_package_that_cannot_be_carried_is_refused_before_anything_moves(cell, change, why):
    """One line says so; the operator is asked."""
    come(cell)
    carton = words.product_entity("milk_carton")
    grasp = read(cell, carton, words.GRASP, "training")
    write(cell, carton, words.GRASP, replace(grasp, **change), "training")
    testing.run_once(HandlingFeedback(), cell)
    generator = ActionGenerator(ARM)
    testing.run_once(generator, cell)
    outcome = read(cell, words.SYSTEM, words.OUTCOME)
    assert why in outcome.result
    assert "\n" not in outcome.result
    looked(cell, "belt")
    testing.run_once(HandlingFeedback(), cell)
    assert read(cell, words.SYSTEM, words.REQUEST).kind == "ask"
    assert read(cell, words.USER, words.QUESTION).choices == ("removed", "stop")


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
    """The next one comes while the robot places the one before, not earlier."""
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
    assert (belt.runs, read(cell, words.CONVEYOR, words.ARRIVAL).number) == (2, 1)


def test_a_tray_is_changed_by_a_plan_that_knows_all_results(cell, monkeypatch):
    """The last one was rejected: the plan before that ended the tray, the one after does not."""
    belt = Belt()
    monkeypatch.setattr("actors.palletizing.conveyor.open_controller", lambda _: belt)
    conveyor = BeltConveyor("any")
    write(cell, words.CONVEYOR, words.ARRIVAL, words.Arrival(1, 7))
    write(cell, words.BELT, words.EMPTY, empty_belt(), "training")
    for number in (2, 3):  # as if two packages filled a tray
        place = Entity(f"place/{number}")
        plan = each(cell, words.PLACES, words.PLAN)[place]
        write(cell, place, words.PLAN, replace(plan, tray=1), "training")
    closed(cell, place_0="placed", place_1="rejected")
    testing.run_once(conveyor, cell)
    assert (belt.changed, belt.runs) == (0, 0)
    planned(cell)
    testing.run_once(conveyor, cell)
    assert (belt.changed, belt.runs) == (0, 1)  # the third finds room in place of the second


def test_a_tray_is_changed_when_all_of_its_places_are_closed(cell, monkeypatch):
    """A neighbour that was opened again keeps it there."""
    belt = Belt()
    monkeypatch.setattr("actors.palletizing.conveyor.open_controller", lambda _: belt)
    conveyor = BeltConveyor("any")
    write(cell, words.CONVEYOR, words.ARRIVAL, words.Arrival(1, 7))
    write(cell, words.BELT, words.EMPTY, empty_belt(), "training")
    for number in (2, 3):
        place = Entity(f"place/{number}")
        plan = each(cell, words.PLACES, words.PLAN)[place]
        write(cell, place, words.PLAN, replace(plan, tray=1), "training")
    closed(cell, place_1="placed")
    planned(cell)
    testing.run_once(conveyor, cell)
    assert (belt.changed, belt.runs) == (0, 0)
    closed(cell, place_0="placed", place_1="placed")
    planned(cell)
    testing.run_once(conveyor, cell)
    assert (belt.changed, belt.runs) == (1, 1)


def test_why_goes_back_from_a_verdict_to_net_and_grasp(cell, capsys):
    """What the demonstration prints names picture, nets and grasp of this package alone."""
    from rich.console import Console

    come(cell)
    testing.run_once(HandlingFeedback(), cell)
    packed(cell, "held", "placed", "in_contact", "aside")
    looked(cell, "tray", "ok")
    testing.run_once(HandlingFeedback(), cell)
    online = cell.world("online")
    net, region = View(online, words.SYSTEM, words.NET), Write(online, PLACE, words.REGION)
    with Lock(net, region) as lock:
        assert lock[net].stage == "aside"
        lock[region] = np.zeros((2, 2), bool)
    show_packing(cell, Console(width=300))
    printed = capsys.readouterr().out
    assert "enact why online place/0/region" in printed
    assert "training:product/milk_carton/grasp v1" in printed
    assert "online:system/candidate v1" in printed
    assert "training:product/meal_tray" not in printed


def placed(cell, number=0, *, package=PACKAGE, product="milk_carton", captured_ns=9):
    """Let a package have come, been packed and judged sound."""
    come(cell, number=number, package=package, product=product)
    testing.run_once(HandlingFeedback(), cell)
    packed(cell, "held", "placed", "in_contact", "aside")
    on_tray = each(cell, words.PLACES, words.PLAN)[Entity(f"place/{number}")].tray_from_product
    seen = words.Sighting(0, on_tray, number, number, "tray", product)
    write(cell, package, words.SIGHTING, seen)


def test_a_neighbour_that_a_push_has_spoiled_is_answered_before_the_next_package(cell):
    """Its place is opened again, as soon as it is judged; then the next one comes."""
    placed(cell)
    looked(cell, "tray", "ok")
    feedback = HandlingFeedback()
    testing.run_once(feedback, cell)
    planned(cell)
    second = Entity("package/b")
    placed(cell, 1, package=second, product="meal_tray")
    number = read(cell, words.SYSTEM, words.REQUEST).number
    looked(cell, "tray", "ok", captured_ns=20, place_0="ok")
    flags = read(cell, words.SYSTEM, words.DEVIATIONS)
    stale = replace(flags["place/0"], captured_ns=9)
    write(cell, words.SYSTEM, words.DEVIATIONS, {**flags, "place/0": stale})
    come(cell, number=2, package=Entity("package/c"))
    testing.run_once(feedback, cell)
    assert read(cell, words.SYSTEM, words.REQUEST).number == number  # the neighbour is not judged
    looked(cell, "tray", "ok", captured_ns=20, place_0="moved", x_m=0.012)
    testing.run_once(feedback, cell)
    request = read(cell, words.SYSTEM, words.REQUEST)
    assert (request.place, request.package, request.kind) == ("place/0", "package/a", "regrasp")
    assert set(read(cell, words.SYSTEM, words.RESULTS)) == {"place/1"}
    packed(cell, "held", "placed", "in_contact", "aside")
    looked(cell, "tray", "ok", captured_ns=30)
    testing.run_once(feedback, cell)
    results = read(cell, words.SYSTEM, words.RESULTS)
    assert {place: one.result for place, one in results.items()} == {
        "place/0": "placed",
        "place/1": "placed",
    }
    assert results["place/0"].reactions == ("regrasp",)
    planned(cell)
    testing.run_once(feedback, cell)
    assert read(cell, words.SYSTEM, words.REQUEST).place == "place/2"


def test_of_two_spoiled_neighbours_the_worse_one_is_answered_and_an_accepted_one_stays(cell):
    """The operator lets it stand as it is: it is asked about once."""
    feedback = HandlingFeedback()
    names = "milk_carton", "meal_tray", "milk_carton"
    for number, (name, letter) in enumerate(zip(names, "abc", strict=True)):
        placed(cell, number, package=Entity(f"package/{letter}"), product=name)
        spoiled = {} if number < 2 else {"place_0": "deformed", "place_1": "tipped"}
        looked(cell, "tray", "ok", captured_ns=10 * (number + 1), **spoiled)
        testing.run_once(feedback, cell)
        planned(cell)
    request = read(cell, words.SYSTEM, words.REQUEST)
    assert (request.place, request.kind) == ("place/1", "ask")
    asked = []
    for _ in range(2):
        testing.run_once(Operator(answers="go_on"), cell)
        asked.append(read(cell, words.SYSTEM, words.REQUEST).place)
        testing.run_once(feedback, cell)
    assert asked == ["place/1", "place/0"]
    results = read(cell, words.SYSTEM, words.RESULTS)
    assert [results[f"place/{n}"].result for n in range(3)] == ["accepted", "accepted", "placed"]


def test_an_arm_that_did_not_come_aside_is_asked_about(cell):
    """Nothing was seen: the operator is asked, by the name of what stopped it."""
    come(cell)
    testing.run_once(HandlingFeedback(), cell)
    packed(cell, "held", "placed", "in_contact", "blocked")
    looked(cell, "", error="the arm is not aside: blocked")
    testing.run_once(HandlingFeedback(), cell)
    question = read(cell, words.USER, words.QUESTION)
    assert question.text == "place/0: the arm is not aside: blocked"
    assert "look" in question.choices


@pytest.mark.parametrize(("answer", "done"), [("reject", "rejected"), ("removed", "removed")])
def test_what_shall_be_gone_and_is_seen_is_asked_about(cell, answer, done):
    """The place is closed only when the package is seen nowhere."""
    placed(cell)
    looked(cell, "tray", "deformed")
    feedback = HandlingFeedback()
    testing.run_once(feedback, cell)
    testing.run_once(Operator(answers=answer), cell)
    testing.run_once(feedback, cell)
    assert read(cell, words.SYSTEM, words.REQUEST).kind == answer
    packed(cell, *(("held", "rejected", "aside") if answer == "reject" else ("aside",)))
    looked(cell, "tray")
    testing.run_once(feedback, cell)
    assert read(cell, words.SYSTEM, words.RESULTS) is None
    request = read(cell, words.SYSTEM, words.REQUEST)
    assert (request.kind, request.reason) == (
        "ask",
        f"it could not be {done}: it is still seen: tray",
    )
    testing.run_once(Operator(answers="removed"), cell)
    testing.run_once(feedback, cell)
    packed(cell, "aside")
    looked(cell, "")
    testing.run_once(feedback, cell)
    assert read(cell, words.SYSTEM, words.RESULTS)[PLACE.name].result == "removed"


def test_a_sensor_that_fails_is_looked_through_again_before_the_operator_is_asked(cell):
    """Twice by itself, since it may recover; then the question names the sensor."""
    error = "the tray sensor gave no image: unplugged"
    come(cell)
    feedback = HandlingFeedback()
    testing.run_once(feedback, cell)
    packed(cell, "held", "placed", "in_contact", "aside")
    kinds = []
    for _ in range(3):
        looked(cell, "", error=error)
        testing.run_once(feedback, cell)
        kinds.append(read(cell, words.SYSTEM, words.REQUEST).kind)
        if kinds[-1] == "look":
            packed(cell, "aside")
    assert kinds == ["look", "look", "ask"]
    asked = read(cell, words.USER, words.QUESTION).text
    assert asked == f"place/0: {error}; look was tried 2 times"
    testing.run_once(Operator(answers="look"), cell)
    testing.run_once(feedback, cell)
    packed(cell, "aside")
    looked(cell, "tray", "ok")
    testing.run_once(feedback, cell)
    assert read(cell, words.SYSTEM, words.RESULTS)[PLACE.name].result == "placed"


def test_a_package_that_came_unseen_is_looked_for_and_asked_about(cell):
    """The belt's sensor failed when it came: no request is about it, so one is made."""
    error = "the belt sensor stands still: 9 images in a row are the very same"
    feedback = HandlingFeedback()
    write(cell, words.CONVEYOR, words.SIGHT, words.Sight(0, error))
    kinds = []
    for _ in range(3):
        testing.run_once(feedback, cell)
        kinds.append(read(cell, words.SYSTEM, words.REQUEST).kind)
        if kinds[-1] == "look":
            packed(cell, "aside")
            looked(cell, "", error=error)
    assert kinds == ["look", "look", "ask"]
    testing.run_once(Operator(answers="look"), cell)
    testing.run_once(feedback, cell)
    packed(cell, "aside")
    write(cell, words.CONVEYOR, words.SIGHT, words.Sight(0, ""))
    come(cell)
    looked(cell, "")
    testing.run_once(feedback, cell)
    request = read(cell, words.SYSTEM, words.REQUEST)
    assert (request.kind, request.package) == ("pack", PACKAGE.name)


def test_what_has_come_and_is_not_recognised_is_asked_about(cell):
    """The belt's sensor works again and shows no package: two looks, then a question."""
    feedback = HandlingFeedback()
    write(cell, words.CONVEYOR, words.SIGHT, words.Sight(0, "the belt sensor gave no image"))
    testing.run_once(feedback, cell)
    write(cell, words.CONVEYOR, words.SIGHT, words.Sight(0, ""))
    kinds = []
    for _ in range(2):
        packed(cell, "aside")
        looked(cell, "")
        testing.run_once(feedback, cell)
        kinds.append(read(cell, words.SYSTEM, words.REQUEST).kind)
    assert kinds == ["look", "ask"]
    question = read(cell, words.USER, words.QUESTION)
    assert question.text == f"place/0: {UNRECOGNISED}; look was tried 2 times"
    assert question.choices == ("stop", "look")
    testing.run_once(Operator(answers="look"), cell)
    testing.run_once(feedback, cell)
    packed(cell, "aside")
    come(cell)
    looked(cell, "")
    testing.run_once(feedback, cell)
    assert read(cell, words.SYSTEM, words.REQUEST).kind == "pack"


def test_what_the_operator_accepted_is_not_asked_about_again(cell):
    """A newer picture shows the same: the place stays closed; another verdict opens it."""
    feedback = HandlingFeedback()
    placed(cell)
    looked(cell, "tray", "deformed")
    testing.run_once(feedback, cell)
    testing.run_once(Operator(answers="go_on"), cell)
    testing.run_once(feedback, cell)
    planned(cell)
    placed(cell, 1, package=Entity("package/b"), product="meal_tray")
    looked(cell, "tray", "ok", captured_ns=20, place_0="deformed")
    testing.run_once(feedback, cell)
    results = read(cell, words.SYSTEM, words.RESULTS)
    assert {place: one.result for place, one in results.items()} == {
        "place/0": "accepted",
        "place/1": "placed",
    }
    planned(cell)
    placed(cell, 2, package=Entity("package/c"))
    looked(cell, "tray", "ok", captured_ns=30, place_0="tipped")
    testing.run_once(feedback, cell)
    request = read(cell, words.SYSTEM, words.REQUEST)
    assert (request.place, request.reason) == ("place/0", "it is tipped")


def test_a_neighbour_that_is_missing_is_sought_nowhere_on_the_tray(cell):
    """A push swept it away: it cannot be taken from where it is not seen."""
    feedback = HandlingFeedback()
    placed(cell)
    looked(cell, "tray", "ok")
    testing.run_once(feedback, cell)
    planned(cell)
    placed(cell, 1, package=Entity("package/b"), product="meal_tray")
    seen = each(cell, words.PACKAGES, words.SIGHTING, "online")[PACKAGE]
    write(cell, PACKAGE, words.SIGHTING, replace(seen, frame=""))
    looked(cell, "tray", "ok", captured_ns=20, place_0="missing")
    testing.run_once(feedback, cell)
    request = read(cell, words.SYSTEM, words.REQUEST)
    assert (request.place, request.kind, request.seen) == ("place/0", "ask", "")
    assert read(cell, words.USER, words.QUESTION).choices == ("go_on", "removed", "stop", "look")


def test_a_tipped_package_that_is_still_there_is_not_offered_to_the_robot(cell):
    """A removal is not judged: what was last seen of the package holds."""
    feedback = HandlingFeedback()
    placed(cell)
    looked(cell, "tray", "tipped")
    testing.run_once(feedback, cell)
    first = read(cell, words.USER, words.QUESTION).choices
    testing.run_once(Operator(answers="removed"), cell)
    testing.run_once(feedback, cell)
    packed(cell, "aside")
    looked(cell, "tray")
    testing.run_once(feedback, cell)
    assert read(cell, words.USER, words.QUESTION).choices == first
    assert not {"regrasp", "reject"} & set(first)


def test_stop_stays_stopped_until_the_operator_looks(cell):
    """A script that said so answers nothing more; a person can let the arm look."""
    placed(cell)
    looked(cell, "tray", "deformed")
    feedback, operator = HandlingFeedback(), Operator(answers="stop")
    testing.run_once(feedback, cell)
    for _ in range(3):
        testing.run_once(operator, cell)
        testing.run_once(feedback, cell)
    request = read(cell, words.SYSTEM, words.REQUEST)
    assert (request.kind, request.number) == ("stop", 3)
    assert read(cell, words.USER, words.QUESTION).choices == ("look",)
    write(cell, words.SYSTEM, words.DECISION, words.Decision(3, "look", "a test"))
    testing.run_once(feedback, cell)
    assert read(cell, words.SYSTEM, words.REQUEST).kind == "look"


def test_a_robot_that_stopped_while_it_lifted_is_asked_about_with_a_full_hand(cell):
    """What presses and is as wide as the package holds it, whatever the stage was."""
    come(cell)
    testing.run_once(HandlingFeedback(), cell)
    grasp = read(cell, words.product_entity("milk_carton"), words.GRASP, "training")
    write(cell, words.GRIPPER, words.COMMAND, words.GripCommand(2, "force", 40.0))
    state = words.GripState(2, grasp.width_m + 0.001, 0.0, 40.0, 7)
    write(cell, words.GRIPPER, words.STATE, state)
    packed(cell, "interrupted:lift")
    testing.run_once(HandlingFeedback(), cell)
    choices = read(cell, words.USER, words.QUESTION).choices
    assert choices == ("reject", "removed", "stop", "look")
    assert read(cell, words.SYSTEM, words.REQUEST).seen == "hand"


def test_a_second_grasp_goes_where_the_hand_has_felt_the_package(cell):
    """A finger came down on it twice: the net goes 10 mm farther to that side each time."""
    come(cell)
    grasp = read(cell, words.product_entity("milk_carton"), words.GRASP, "training")
    feedback, y_m = HandlingFeedback(), []
    testing.run_once(feedback, cell)
    for result in ("blocked_left", "blocked_left"):
        packed(cell, result, "aside")
        looked(cell, "belt")
        testing.run_once(feedback, cell)
        assert read(cell, words.SYSTEM, words.REQUEST).kind == "retry"
        testing.run_once(ActionGenerator(ARM), cell)
        frame = read(cell, words.SYSTEM, words.CANDIDATE).frames[PACKAGE.name]
        y_m.append(float((CellLayout().base_from_belt[:3, :3] @ grasp.axis) @ frame[:3, 3]))
    assert y_m[1] - y_m[0] == pytest.approx(0.010)
    seen = (
        CellLayout().base_from_belt
        @ each(cell, words.PACKAGES, words.SIGHTING, "online")[PACKAGE].frame_from_package
    )
    at = (CellLayout().base_from_belt[:3, :3] @ grasp.axis) @ seen[:3, 3]
    assert y_m[0] - at == pytest.approx(0.010)


def test_a_package_that_stands_far_short_is_pushed_from_behind_it(cell):
    """The hand goes down behind where it stands, not behind where packages are put down."""
    placed(cell)
    looked(cell, "tray", "moved", x_m=-0.045)
    testing.run_once(HandlingFeedback(), cell)
    request = read(cell, words.SYSTEM, words.REQUEST)
    assert (request.kind, request.short_m) == ("push_again", pytest.approx(0.045))
    testing.run_once(ActionGenerator(ARM), cell)
    again = read(cell, words.SYSTEM, words.CANDIDATE).net
    write(cell, words.SYSTEM, words.REQUEST, replace(request, number=9, short_m=0.0))
    testing.run_once(ActionGenerator(ARM), cell)
    usual = read(cell, words.SYSTEM, words.CANDIDATE).net
    behind = [net.primitives["behind"].axes[0].value for net in (again, usual)]
    assert behind[0] == pytest.approx(behind[1] - 0.025)


def test_what_is_expected_is_written_into_a_fork_before_a_risky_stage(cell):
    """So the deviation is a difference; forks of sound places, and of an earlier run, go."""
    online = cell.world("online")
    online.fork("expected-0")  # of a generator that has ended
    feedback, generator, action = HandlingFeedback(), ActionGenerator(ARM), Action()
    come(cell)
    testing.run_once(feedback, cell)
    for result in ("held", "placed", "in_contact", "aside"):
        testing.run_once(generator, cell)
        testing.run_once(action, cell)
        executed(cell, result)
    testing.run_once(generator, cell)
    assert [one for one in cell.worlds() if one.startswith("expected-")] == ["expected-1"]
    looked(cell, "tray", "moved", x_m=0.02)
    wrong = words.Standing("milk_carton", "moved", 20.0, 0.0)
    write(cell, PLACE, words.STANDING, wrong)
    [found] = cell.world("expected-1").diff(online, words.PLACES, [words.STANDING])
    assert found.entity == PLACE
    on_tray = each(cell, words.PLACES, words.PLAN)[PLACE].tray_from_product
    write(cell, PACKAGE, words.SIGHTING, words.Sighting(0, on_tray, 0, 0, "tray", "milk_carton"))
    request = read(cell, words.SYSTEM, words.REQUEST)
    executed(cell, "aside")
    for number, kept in ((2, ["expected-1", "expected-2"]), (3, ["expected-3"])):
        again = replace(request, number=number, kind="regrasp", seen="tray")
        write(cell, words.SYSTEM, words.REQUEST, again)
        testing.run_once(generator, cell)
        testing.run_once(action, cell)
        executed(cell, "held")
        testing.run_once(generator, cell)
        assert sorted(one for one in cell.worlds() if one.startswith("expected-")) == kept
        testing.run_once(action, cell)
        executed(cell, "lost")
        looked(cell, "tray", "ok")


def test_forks_of_an_earlier_generator_are_dropped_and_no_others(cell):
    """One that was cut short has no expectation and is made again; a person's stays."""
    online = cell.world("online")
    for name in ("expected-0", "expected-1", "expected-by-me", "expected-1-copy"):
        online.fork(name)
    online.fork("idea").fork("expected-5")
    cell.create_world("expected-6")
    come(cell)
    testing.run_once(HandlingFeedback(), cell)
    packed(cell, "held")
    assert sorted(one for one in cell.worlds() if one.startswith("expected-")) == [
        "expected-1",
        "expected-1-copy",
        "expected-5",
        "expected-6",
        "expected-by-me",
    ]
    standing = View(cell.world("expected-1"), PLACE, words.STANDING)
    assert cell.world("expected-1").view(standing).get(standing).state == "ok"
