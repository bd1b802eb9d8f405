"""Which request follows from a situation: decisions alone, without a cell."""

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("open3d", exc_type=ImportError)
pytest.importorskip("mujoco", exc_type=ImportError)

from actors.palletizing import vocabulary as words
from actors.palletizing.feedback import notice_of
from actors.palletizing.handling.data import TAKEN_OUT, UNRECOGNISED
from actors.palletizing.handling.requests import FollowUp, Said, Situation, follow_up
from actors.palletizing.operator import LOOKS, scripted
from enact_dist import Entity

PACKAGE = "package/a"
PLACED = words.Result(PACKAGE, "milk_carton", "ok", "placed", (), "it stands as planned", 5)
PACK = words.Request(4, "pack", "place/1", PACKAGE, "why")
ENDED = words.Outcome(4, "push", "in_contact", success=True, stamp_ns=7)


def sighting(frame="belt", product="meal_tray", *, unfit="", stop=1):
    return words.Sighting(0, np.eye(4), stop, stop, frame, product, unfit)


def flag(verdict, *, x_m=0.0, captured_ns=9):
    pose = np.eye(4)
    pose[0, 3] = x_m
    return words.Deviation(PACKAGE, "meal_tray", verdict, 0.0, 0.0, 0.0, 0.0, captured_ns, pose)


def situation(**known):
    """A cell that has placed one package; each test adds what else the cell knows."""
    results = {"place/0": PLACED}
    pushed = np.array([1.0, 0.0, 0.0])
    nothing = dict.fromkeys(("request", "sight", "outcome", "look", "grip", "gripper", "decision"))
    about = {
        "results": results,
        "plans": {Entity(f"place/{n}"): words.Plan("meal_tray", 0, np.eye(4), pushed) for n in (0, 1)},
        "planned": words.Planned({"place/0": "placed"}, ()),
        "grasps": {},
        "sightings": {Entity(PACKAGE): sighting()},
        "flags": {"place/0": flag("ok", captured_ns=5)},
    }  # fmt: skip
    return Situation(**{**nothing, **about, **known})


def looked(seen, verdict="", *, x_m=0.0, **known):
    """A request whose nets have ended and whose package was looked for."""
    judged = {"place/1": flag(verdict, x_m=x_m)} if verdict else {}
    look = words.Look(4, seen, 9 if judged else 0, tuple(judged))
    return situation(**{"request": PACK, "outcome": ENDED, "look": look, "flags": judged, **known})


@pytest.mark.parametrize(
    ("known", "kind", "reason"),
    [
        ({}, "pack", "meal_tray has come"),
        ({"sightings": {Entity(PACKAGE): sighting(product="milk_carton")}}, "ask",
         "milk_carton has come in place of meal_tray"),
        ({"sightings": {Entity(PACKAGE): sighting("belt", "", unfit="it lies")}}, "ask", "it lies"),
        ({"sightings": {}, "sight": words.Sight(1, "unplugged")}, "look", "unplugged"),
        ({"sightings": {}, "sight": words.Sight(1, ""),
          "request": words.Request(3, "look", "place/1", "", "why", tried=("look",))}, "look", ""),
    ],
)  # fmt: skip
def test_what_has_come_is_packed_or_asked_about(known, kind, reason):
    """By what it is, how it stands, and whether it was seen at all; it is the next number."""
    if known.get("request"):  # a look that has ended
        known = {**known, "outcome": words.Outcome(3, "aside", "aside", True, 7),
                 "look": words.Look(3, "", 0)}  # fmt: skip
        reason, kind = f"{UNRECOGNISED}; look was tried 2 times", "ask"
    found = follow_up(situation(**known))
    number = 1 if not known.get("request") else 4
    assert (found.request.number, found.request.kind, found.request.reason) == (
        number,
        kind,
        reason,
    )
    assert (found.question is not None) == (kind == "ask")


@pytest.mark.parametrize(
    "known",
    [
        {"planned": words.Planned({}, ())},
        {"sightings": {}},
        {"request": PACK},
        {"request": PACK, "outcome": replace(ENDED, request=3)},
        {"request": PACK, "outcome": ENDED, "look": words.Look(3, "tray", 9)},
        {"request": PACK, "outcome": ENDED, "look": words.Look(4, "tray", 9, ("place/1",))},
        {"request": replace(PACK, kind="ask"), "decision": words.Decision(3, "retry", "a test")},
    ],
    ids=[
        "no plan",
        "nothing came",
        "it moves",
        "old outcome",
        "old look",
        "no verdict",
        "no answer",
    ],
)
def test_nothing_follows_before_everything_is_known(known):
    """Each of these waits for one datum that is not there yet, or is of another request."""
    assert follow_up(situation(**known)) == FollowUp()


@pytest.mark.parametrize(
    ("seen", "verdict", "x_m", "kind", "short_m"),
    [
        ("tray", "moved", -0.02, "push_again", 0.02),
        ("tray", "moved", 0.02, "regrasp", 0.0),
        ("tray", "tipped", 0.0, "ask", 0.0),
        ("belt", "missing", 0.0, "retry", 0.0),
    ],
)
def test_what_was_seen_decides_and_is_told(seen, verdict, x_m, kind, short_m):
    """The request says where the package is and how short of its place; the user reads why."""
    now = looked(seen, verdict, x_m=x_m)
    found = follow_up(now)
    assert (found.request.kind, found.request.seen, found.request.tried) == (kind, seen, ("pack",))
    assert found.request.short_m == pytest.approx(short_m)
    assert found.said == (Said("place/1", now.flags["place/1"], f"{kind}: {found.request.reason}"),)
    assert found.results is None


def test_a_sound_place_is_closed_and_the_next_package_follows_at_once():
    """One answer closes the place; it waits for the plan before the next package."""
    found = follow_up(looked("tray", "ok"))
    assert (found.request, found.question) == (None, None)
    assert found.results["place/1"].result == "placed"
    assert found.results["place/0"] is PLACED


def test_the_worst_place_that_was_spoiled_is_opened_again():
    """Its result is taken back in the same answer that closes the last place."""
    both = {"place/0": flag("tipped"), "place/1": flag("ok")}
    found = follow_up(looked("tray", "ok", flags=both))
    assert set(found.results) == {"place/1"}
    assert (found.request.place, found.request.kind) == ("place/0", "ask")
    assert [one.place for one in found.said] == ["place/1", "place/0"]
    assert found.question.request == found.request.number == 5


@pytest.mark.parametrize(("tried", "kind"), [((), "look"), (("look", "look"), "ask")])
def test_after_looks_that_show_nothing_the_operator_is_asked(tried, kind):
    """A package that was taken up need not be where it was."""
    look = words.Look(4, "", 0, error="the tray sensor gave no image")
    found = follow_up(looked("", look=look, request=replace(PACK, tried=tried)))
    assert (found.request.kind, found.request.seen) == (kind, "")


@pytest.mark.parametrize(
    ("choice", "result", "choices"),
    [("go_on", "accepted", None), ("stop", None, ("look",)), ("regrasp", None, None)],
)
def test_the_operators_answer_is_done(choice, result, choices):
    """To go on closes the place; a stop leaves one way out; anything else is the robot's."""
    ask = replace(PACK, kind="ask", seen="tray")
    found = follow_up(situation(request=ask, decision=words.Decision(4, choice, "a test")))
    assert (found.results["place/1"].result if found.results else None) == result
    assert (found.question.choices if found.question else None) == choices
    assert result or (found.request.kind, found.request.number) == (choice, 5)


def test_a_question_about_what_was_taken_out_ends_by_itself():
    """Nobody has to answer: the place is closed, with the reason."""
    ask = replace(PACK, kind="ask", package="")
    found = follow_up(situation(request=ask, sight=words.Sight(1, TAKEN_OUT)))
    assert (found.results["place/1"].result, found.results["place/1"].reason) == (
        "removed",
        TAKEN_OUT,
    )


def test_a_notice_of_a_verdict_says_how_old_its_picture_is():
    """The latency counts from the picture, the stamp is the picture's; without one it is now."""
    judged = notice_of(Said("place/1", flag("ok"), "go_on: sound"), 2_000_009)
    assert judged == words.Notice("place/1: meal_tray stands as planned; go_on: sound", 9, 2.0)
    plain = notice_of(Said("place/1", None, "stop: braked:hold"), 7)
    assert plain == words.Notice("place/1: stop: braked:hold", 7, 0.0)


@pytest.mark.parametrize(
    ("choices", "looks", "answer"),
    [
        (("regrasp", "reject", "stop"), 0, "reject"),
        (("go_on", "removed", "stop", "look"), LOOKS, "removed"),
        (("stop", "look"), LOOKS - 1, "look"),
        (("stop", "look"), LOOKS, "stop"),
        (("look",), LOOKS, "look"),
        (("retry", "go_on"), 0, "retry"),
    ],
    ids=["preferred", "not a look", "looks", "looked enough", "no other way", "of none the first"],
)
def test_a_script_takes_the_first_word_that_can_be_answered(choices, looks, answer):
    """It looks so often and no more, where it can stop, and says so."""
    question = words.Question(5, "place/0: why", choices)
    found, why = scripted(question, ("reject", "removed", "look"), looks)
    assert found == answer
    assert bool(why) == (answer == "stop")
