"""What feedback decides, what it asks, and what the operator may answer."""

import io
from dataclasses import replace
from types import SimpleNamespace

import pytest
from lost_commits import lose_commit
from polling import until
from rich.console import Console

pytest.importorskip("open3d", exc_type=ImportError)
pytest.importorskip("mujoco", exc_type=ImportError)

from actors.palletizing import vocabulary as words
from actors.palletizing.demo.packing import follow
from actors.palletizing.feedback import HandlingFeedback
from actors.palletizing.handling.data import TAKEN_OUT, UNRECOGNISED
from actors.palletizing.operator import LOOKS, Operator
from actors.running_cell import DemoError
from enact_dist import Entity, testing

from .handled_cell import (
    PACKAGE,
    PLACE,
    come,
    each,
    looked,
    packed,
    placed,
    planned,
    read,
    write,
)


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


@pytest.mark.parametrize("unfit", ["", "the package lies on its side on the belt"])
def test_a_package_that_was_lost_and_is_on_the_belt_is_retried_if_it_stands(cell, unfit):
    """What lies is asked about at once, by name; nothing is tried that cannot succeed."""
    come(cell)
    testing.run_once(HandlingFeedback(), cell)
    packed(cell, "held", "lost", "aside")
    seen = each(cell, words.PACKAGES, words.SIGHTING, "online")[PACKAGE]
    write(cell, PACKAGE, words.SIGHTING, replace(seen, unfit=unfit))
    looked(cell, "belt", "missing")
    testing.run_once(HandlingFeedback(), cell)
    request = read(cell, words.SYSTEM, words.REQUEST)
    assert (request.kind, request.seen) == ("ask" if unfit else "retry", "belt")
    if unfit:
        assert request.reason == f"place: lost; {unfit}"
        assert read(cell, words.USER, words.QUESTION).choices == ("removed", "stop", "look")


def test_what_comes_lying_is_asked_about(cell):
    """A person sets it upright and lets the cell look: it is packed."""
    come(cell, product="")
    seen = each(cell, words.PACKAGES, words.SIGHTING, "online")[PACKAGE]
    write(cell, PACKAGE, words.SIGHTING, replace(seen, unfit="the package leans on the belt by 9°"))
    testing.run_once(HandlingFeedback(), cell)
    question = read(cell, words.USER, words.QUESTION)
    assert question.text == "place/0: the package leans on the belt by 9°"
    assert question.choices == ("removed", "stop", "look")


def deformed_and_refused(cell):
    """Let a package be placed and found deformed, and the operator reject it."""
    come(cell)
    testing.run_once(HandlingFeedback(), cell)
    packed(cell, "held", "placed", "in_contact", "aside")
    on_tray = each(cell, words.PLACES, words.PLAN)[PLACE].tray_from_product
    write(cell, PACKAGE, words.SIGHTING, words.Sighting(0, on_tray, 0, 0, "tray", "milk_carton"))
    looked(cell, "tray", "deformed")
    testing.run_once(HandlingFeedback(), cell)
    testing.run_once(Operator(answers="reject"), cell)
    testing.run_once(HandlingFeedback(), cell)


def test_operator_answers_and_the_robot_rejects(cell, capsys):
    """A deformed package goes to the bin when the operator says so; the result says why."""
    deformed_and_refused(cell)
    assert read(cell, words.SYSTEM, words.REQUEST).kind == "reject"
    assert packed(cell, "held", "rejected", "aside") == ["regrasp", "remove", "aside"]
    looked(cell, "")
    testing.run_once(HandlingFeedback(), cell)
    result = read(cell, words.SYSTEM, words.RESULTS)[PLACE.name]
    assert (result.result, result.reactions) == ("rejected", ("reject",))
    assert "place/0: it is deformed" in capsys.readouterr().out


def test_a_package_that_could_not_be_rejected_is_not_placed_again(cell):
    """Whatever a failed grasp would else lead to: the operator is asked once more."""
    deformed_and_refused(cell)

    packed(cell, "missed", "aside")
    looked(cell, "tray", "ok")
    testing.run_once(HandlingFeedback(), cell)

    request = read(cell, words.SYSTEM, words.REQUEST)
    assert request.kind == "ask"
    assert request.reason == "it could not be rejected: missed"


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


def test_an_answer_that_was_typed_is_given_until_it_stands(cell, monkeypatch):
    """A failed commit loses no typed answer, and the robot removes nothing twice."""
    removed = []
    hands = SimpleNamespace(remove=removed.append)
    monkeypatch.setattr("actors.palletizing.operator.open_controller", lambda _: hands)
    monkeypatch.setattr("sys.stdin", io.StringIO("removed\n"))
    operator = Operator(hands="any")
    placed(cell)
    looked(cell, "tray", "deformed")
    testing.run_once(HandlingFeedback(), cell)
    until(lambda: lose_commit(operator, cell) or removed)
    assert read(cell, words.SYSTEM, words.DECISION) is None
    testing.run_once(operator, cell)
    decision = read(cell, words.SYSTEM, words.DECISION)
    assert (decision.choice, decision.by, removed) == ("removed", "terminal", [0])


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
        request = read(cell, words.SYSTEM, words.REQUEST)
        assert request.seen == "", "it was taken from the belt, where the next one may stand"
        kinds.append(request.kind)
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


def test_a_script_that_looks_stops_where_looking_shows_nothing(cell, capsys):
    """A sensor that has failed for good ends in a stop, with its reason; a person can go on."""
    come(cell)
    feedback, operator = HandlingFeedback(), Operator(answers="reject removed look")
    testing.run_once(feedback, cell)
    packed(cell, "held", "placed", "in_contact", "aside")
    write(
        cell,
        PACKAGE,
        words.SIGHTING,
        replace(each(cell, words.PACKAGES, words.SIGHTING, "online")[PACKAGE], frame=""),
    )
    kinds = []
    for _ in range(4 * LOOKS):
        looked(cell, "", error="the tray sensor gave no image: unplugged")
        testing.run_once(feedback, cell)
        testing.run_once(operator, cell)
        testing.run_once(feedback, cell)
        kinds.append(read(cell, words.SYSTEM, words.REQUEST).kind)
        if kinds[-1] == "stop":
            break
        packed(cell, "aside")
    assert kinds == ["look"] * 2 + ["removed"] * 3 + ["look"] * 4 + ["stop"]
    assert "stop: after 6 looks the script looks no more" in capsys.readouterr().out
    shown = SimpleNamespace(packages=4, log="cell.log", check=lambda: None)
    with pytest.raises(DemoError, match="script has stopped the cell: place/0: the tray sensor"):
        follow(cell, shown, Console())
    number = read(cell, words.SYSTEM, words.REQUEST).number
    write(cell, words.SYSTEM, words.DECISION, words.Decision(number, "look", "a test"))
    testing.run_once(feedback, cell)
    assert read(cell, words.SYSTEM, words.REQUEST).kind == "look"


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


def test_what_is_taken_out_of_the_light_barrier_is_not_asked_about_any_more(cell):
    """The question ends by itself, with the reason; the next package is for the next place."""
    feedback = HandlingFeedback()
    write(cell, words.CONVEYOR, words.SIGHT, words.Sight(0, UNRECOGNISED))
    for _ in range(3):
        testing.run_once(feedback, cell)
        if read(cell, words.SYSTEM, words.REQUEST).kind == "look":
            packed(cell, "aside")
            looked(cell, "", error=UNRECOGNISED)
    assert read(cell, words.SYSTEM, words.REQUEST).kind == "ask"
    write(cell, words.CONVEYOR, words.SIGHT, words.Sight(0, TAKEN_OUT))
    testing.run_once(feedback, cell)
    result = read(cell, words.SYSTEM, words.RESULTS)[PLACE.name]
    assert (result.result, result.package, result.reason) == ("removed", "", TAKEN_OUT)
    planned(cell)
    come(cell, product="meal_tray", number=1, package=Entity("package/b"))
    testing.run_once(feedback, cell)
    request = read(cell, words.SYSTEM, words.REQUEST)
    assert (request.place, request.kind, request.tried) == ("place/1", "pack", ())


def test_what_is_taken_out_before_anyone_asked_or_while_the_arm_looks_ends_as_well(cell):
    """Without a request there is none to end; a look that is under way ends first."""
    feedback = HandlingFeedback()
    write(cell, words.CONVEYOR, words.SIGHT, words.Sight(0, TAKEN_OUT))
    testing.run_once(feedback, cell)
    assert read(cell, words.SYSTEM, words.RESULTS)[PLACE.name].result == "removed"
    planned(cell)
    write(cell, words.CONVEYOR, words.SIGHT, words.Sight(1, UNRECOGNISED))
    testing.run_once(feedback, cell)
    write(cell, words.CONVEYOR, words.SIGHT, words.Sight(1, TAKEN_OUT))
    testing.run_once(feedback, cell)
    assert "place/1" not in read(cell, words.SYSTEM, words.RESULTS)
    packed(cell, "aside")
    looked(cell, "", error=TAKEN_OUT)
    testing.run_once(feedback, cell)
    assert read(cell, words.SYSTEM, words.RESULTS)["place/1"].result == "removed"


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
