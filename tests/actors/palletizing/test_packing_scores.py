"""What the score makes of noted trays: every figure moves with what it is of."""

import dataclasses
import math

import numpy as np
import pytest

from actors.geometry.poses import on_tray
from actors.palletizing.demo.packing_report import row_of
from actors.palletizing.simulation.cell.truth import PackageTruth
from actors.palletizing.simulation.packages import DEMO_PRODUCTS
from actors.palletizing.simulation.physical_packages import Dent
from actors.palletizing.trials import packing_scores
from actors.palletizing.trials.packing_records import Judgement, Packed, Step, line_of, packed_of
from actors.palletizing.trials.packing_scores import (
    EVERY,
    GOALS,
    Tray,
    confusion,
    confusion_text,
    missed,
    scores_of,
    trays_of,
)
from actors.palletizing.trials.truth import badness, state_of
from actors.palletizing.vocabulary import Deviation, Plan, Result
from enact_dist.cli import bench
from enact_dist.cli.main import main

TRAY = Tray(1000, 2.0, 0.4, 1, DEMO_PRODUCTS)
ROUGH = dataclasses.replace(TRAY, seed=1001, sigma_mm=12.0)
PROVOKED = dataclasses.replace(TRAY, seed=1003, provoked=("moved",))


def judged(truth="ok", verdict="ok", pose_mm=0.2):
    return Judgement(0, verdict, truth, 1.0, 0.1, pose_mm, 0.0, 9.0)


def step(request="pack", before="belt", after="ok", *, harmed=0, result="in_contact", works=True):
    stages = (("push_into_contact", result),)
    return Step(request, stages, works, "go_on", "", "", 9.0, before, after, harmed, 9.0)


def package(*steps, **changes):
    """Return a sound package; a change spoils it."""
    sound = Packed(
        0, "milk_carton", 0.4, steps=list(steps) or [step()], judgements=[judged()], cycle_s=9.0,
        along_mm=1.0, across_mm=0.0, turn_deg=0.2, gap_mm=0.1,
    )  # fmt: skip
    for name, value in changes.items():
        setattr(sound, name, value)
    return sound


def test_a_sound_package_meets_every_goal_that_it_is_a_case_of():
    """A score without a case is None; every other score of a sound package meets its goal."""
    scores = scores_of({TRAY: [package()]})
    assert list(scores) == list(GOALS)
    assert not missed(scores)
    cases = {name for name, value in scores.items() if value is not None}
    assert cases == {
        "packages", "by_hand_share", "shift_p95_mm", "turn_p95_deg", "gap_p50_mm", "pose_p95_mm",
        "cycle_p50_s", "cycle_p95_s", "damaged_gentle", "damaged", "alarms_share", "provoked",
        "dented", "recoveries", "refused", "noticed_by_net", "moved_cases", "tipped_cases", "deformed_cases",
        "missing_cases",
    }  # fmt: skip


DENTED = {"dents_mm": (1.2,), "dented_by": ("left",)}
KNOCKED = {"dents_mm": (9.0,), "dented_by": ("outside",)}


@pytest.mark.parametrize(
    ("spoilt", "name", "value"),
    [
        (package(along_mm=3.1), "shift_p95_mm", 3.1),
        (package(across_mm=-3.1, along_mm=0.0), "shift_p95_mm", 3.1),
        (package(turn_deg=-1.6), "turn_p95_deg", 1.6),
        (package(gap_mm=-1.1), "gap_p50_mm", 1.1),
        (package(judgements=[judged(pose_mm=0.6)]), "pose_p95_mm", 0.6),
        (package(cycle_s=10.1), "cycle_p50_s", 10.1),
        (package(**DENTED), "damaged_gentle", 1),
        (package(judgements=[judged(verdict="moved")]), "alarms_share", 1.0),
        (package(step("regrasp", "moved", "moved")), "recovered_share", 0.0),
        (package(step("regrasp", "moved", "tipped")), "worsened", 1),
        (package(step("regrasp", "moved", "ok", harmed=2)), "worsened", 1),
        (package(judgements=[judged("moved", "ok")]), "moved_recall_share", 0.0),
        (package(judgements=[judged("ok", "tipped")]), "tipped_precision_share", 0.0),
        (package(judgements=[judged("missing", "extra")]), "missing_recall_share", 0.0),
    ],
)
def test_what_is_spoilt_misses_its_goal(spoilt, name, value):
    """One fault of one package shows in the score of this fault, which then misses its goal."""
    scores = scores_of({TRAY: [spoilt]})
    assert scores[name] == pytest.approx(value)
    assert name in missed(scores)


def test_what_the_operator_touched_is_no_sound_placement_but_counts_as_damaged():
    """Its position does not count, its dents and the operator's hand do."""
    scores = scores_of({TRAY: [package(along_mm=9.0, by_hand=True, **DENTED), package()]})
    assert scores["shift_p95_mm"] == 1.0
    assert scores["by_hand_share"] == 0.5
    assert scores["damaged_gentle"] == 1


def test_damage_that_was_provoked_is_not_that_of_the_robot():
    """Dents by a knock do not count; those on a rough tray count as damaged, not as gentle."""
    assert scores_of({TRAY: [package(**KNOCKED)]})["damaged_gentle"] == 0
    rough = scores_of({ROUGH: [package(**DENTED)]})
    assert (rough["damaged_gentle"], rough["damaged"]) == (None, 1)


def test_provoked_trays_count_for_verdicts_and_recoveries_only():
    """Their positions and cycle times leave the scores of the other trays as they are."""
    spoilt = package(
        step("regrasp", "moved", "moved"),
        judgements=[judged("moved", "ok")],
        along_mm=9.0,
        cycle_s=30.0,
        knock="moved",
    )
    scores = scores_of({TRAY: [package()], PROVOKED: [spoilt]})
    assert (scores["shift_p95_mm"], scores["cycle_p50_s"], scores["provoked"]) == (1.0, 9.0, 1)
    assert (scores["recovered_share"], scores["moved_recall_share"]) == (0.0, 0.0)


def test_a_retry_whose_package_was_knocked_is_no_failed_recovery():
    """The same retry without a knock is one, and worsened the package."""
    knocked = dataclasses.replace(step("retry", "belt", "tipped"), stages=(("place", "placed"),))
    blocked = step("pack", "belt", "belt", result="blocked", works=False)
    scores = scores_of({PROVOKED: [package(blocked, knocked, knock="tipped")]})
    assert (scores["recoveries"], scores["worsened"]) == (0, None)
    scores = scores_of({TRAY: [package(blocked, knocked)]})
    assert (scores["recoveries"], scores["recovered_share"], scores["worsened"]) == (1, 0.0, 1)


@pytest.mark.parametrize("stages", [(), (("regrasp", "no_net: regrasp for it: no room"),)])
def test_what_the_robot_refused_before_it_moved_is_no_recovery_that_was_tried(stages):
    """It is counted apart; one that was refused in its second stage was tried."""
    refused = dataclasses.replace(step("regrasp", "moved", "moved", works=False), stages=stages)
    scores = scores_of({TRAY: [package(refused, step("retry"))]})
    assert (scores["recoveries"], scores["refused"], scores["recovered_share"]) == (1, 1, 1.0)
    assert scores["noticed_by_net"] == 0, "no net ran that could have noticed anything"
    later = dataclasses.replace(refused, stages=(("grasp_from_belt", "held"), *stages))
    assert scores_of({TRAY: [package(later)]})["recovered_share"] == 0.0


def test_a_dent_that_was_there_before_makes_nothing_worse():
    """A dented package that stands beside its place is brought there, and is as dented as before."""
    planned, beside = np.eye(4), on_tray(0.02, 0.0, 0.0)
    dent = Dent("top", (0.0, 0.0, 0.07), (0.0, 0.0, -1.0), 60.0, 5.0, "left")
    states = {
        (at is beside, bool(dents)): state_of(
            PackageTruth(0, "milk_carton", "tray", at, at, 0.0, dents, 0, 0, 0.4, 0.5), planned
        )
        for at in (planned, beside)
        for dents in ((), (dent,))
    }
    assert states[True, True] == states[False, True] == "deformed"
    assert (states[True, False], states[False, False]) == ("moved", "ok")


def test_a_failure_that_the_net_noticed_is_counted():
    """A blocked step that its net reported, answered by a retry, counts once."""
    failed = step("pack", "belt", "belt", result="blocked", works=False)
    assert scores_of({TRAY: [package(failed, step("retry"))]})["noticed_by_net"] == 1


@pytest.mark.parametrize(("dent_mm", "slight"), [(1.4, False), (1.6, True)])
def test_a_slight_dent_is_neither_sound_nor_deformed(dent_mm, slight):
    """Flagged or not, it is counted apart; a wrong kind of flag is held against that kind."""
    dented = dataclasses.replace(judged("ok", "deformed"), dent_mm=dent_mm)
    scores = scores_of({TRAY: [package(judgements=[dented, judged()])]})
    assert scores["dented"] == slight
    assert scores["dented_flagged_share"] == (1.0 if slight else None)
    assert scores["alarms_share"] == (0.0 if slight else 0.5)
    assert scores["deformed_precision_share"] == (None if slight else 0.0)
    wrong = dataclasses.replace(dented, verdict="moved")
    assert scores_of({TRAY: [package(judgements=[wrong])]})["moved_precision_share"] == 0.0


@pytest.mark.parametrize(
    ("depth_mm", "truth", "right"),
    [
        (1.0, "ok", {"ok"}),
        (2.5, "dented", {"ok", "deformed"}),
        (5.0, "deformed", {"deformed"}),
    ],
)
def test_a_slight_dent_in_the_demo_may_be_flagged_or_not(depth_mm, truth, right):
    """It is counted there as in the bench: physics calls it sound, perception is to find it."""
    dent = Dent("top", (0.0, 0.0, 0.07), (0.0, 0.0, -1.0), 60.0, depth_mm, "left")
    plan = Plan("milk_carton", 0, np.eye(4))
    stands = PackageTruth(
        0, "milk_carton", "tray", np.eye(4), np.eye(4), 0.0, (dent,), 0, 0, 0.4, 0.5
    )
    result = Result("package/a", "milk_carton", "", "placed", (), "why")
    flags = {
        verdict: Deviation("package/a", "milk_carton", verdict, 1.0, 1.0, 1.0, 1.0, 9)
        for verdict in ("ok", "deformed", "moved")
    }
    rows = {
        verdict: row_of("place/0", plan, stands, flag, result, None)
        for verdict, flag in flags.items()
    }
    assert {row.truth for row in rows.values()} == {truth}
    assert {verdict for verdict, row in rows.items() if row.correct} == right


def test_the_table_sets_truth_against_verdict():
    """Judgements are counted by pair, and printed with one row per truth that occurs."""
    found = {TRAY: [package(judgements=[judged(), judged("moved", "extra")])]}
    assert confusion(found) == {("ok", "ok"): 1, ("moved", "extra"): 1}
    head, ok, moved = (line.split() for line in confusion_text(confusion(found)).splitlines())
    assert head == ["truth", "ok", "moved", "tipped", "deformed", "missing", "extra"]
    assert ok == ["ok", "1", *"....."]
    assert moved == ["moved", *".....", "1"]


def test_states_have_an_order():
    """From sound over moved and bin to tipped; what stands beside is as bad as what is deformed."""
    states = ("ok", "moved", "bin", "tipped")
    assert sorted(states, key=badness) == list(states)
    assert badness("beside") == badness("deformed") > badness("bin")


def test_records_go_through_json():
    """A package is the same after a line of JSON, a pose error that is no number included."""
    whole = package(judgements=[judged(pose_mm=math.nan)], **DENTED)
    [back] = packed_of(line_of([whole]))
    assert dataclasses.astuple(back)[:5] == dataclasses.astuple(whole)[:5]
    assert math.isnan(back.judgements[0].pose_error_mm)
    assert (back.dents_mm, back.dented_by) == (whole.dents_mm, whole.dented_by)


def test_an_interrupted_run_goes_on_with_the_trays_that_are_left(monkeypatch, tmp_path):
    """Noted trays are not packed again, except one whose line was cut off."""
    trays = trays_of(48, provoke=("moved",))
    packed = []

    def pack(tray, _models, _pictures):
        if len(packed) == 3:
            raise KeyboardInterrupt
        packed.append(tray)
        return [package(number=tray.seed)]

    monkeypatch.setattr(packing_scores, "packed_tray", pack)
    monkeypatch.setattr(packing_scores, "train", lambda *_, **__: None)
    with pytest.raises(KeyboardInterrupt):
        packing_scores.played(trays, out=tmp_path)
    packed.clear()
    found = packing_scores.played(trays, out=tmp_path)
    assert packed == trays[3:]
    assert list(found) == trays
    assert [each.number for [each] in found.values()] == [tray.seed for tray in trays]
    packed.clear()
    assert list(packing_scores.played(trays, out=tmp_path)) == trays
    assert not packed
    noted = tmp_path / packing_scores.NOTED
    whole = noted.read_bytes()
    noted.write_bytes(whole[:-20])  # killed while it wrote the last line
    packing_scores.played(trays, out=tmp_path)
    assert noted.read_bytes() == whole
    assert packed == trays[-1:]


def test_trays_take_the_settings_in_turn_and_held_out_seeds():
    """Forty packages make trays of 12, 12, 12 and 4, each with its own setting and seed."""
    trays = trays_of(40, seed=2)
    assert [tray.seed for tray in trays] == [2000, 2001, 2002, 2003]
    assert [tray.count for tray in trays] == [12, 12, 12, 4]
    assert len({(tray.sigma_mm, tray.friction) for tray in trays}) == 4


def test_errors_are_provoked_with_every_setting_alike():
    """Each of the nine settings has one provoked tray."""
    trays = trays_of(12 * 9 * EVERY, provoke=("moved",))
    provoked = [(tray.sigma_mm, tray.friction) for tray in trays if tray.provoked]
    assert len(provoked) == len(set(provoked)) == 9


@pytest.mark.parametrize(
    "spread", ["much", "2", "2,0.4,1", "nan,0.4", "2,nan", "inf,0.4", "2,inf", "-1,0.4", "2,0"]
)
def test_the_bench_refuses_what_is_no_spread(spread, capsys):
    """A usage error quotes what was given and shows a spread that would do."""
    with pytest.raises(SystemExit):
        main(["bench", "palletizing", f"--spread={spread}"])
    last = capsys.readouterr().err.splitlines()[-1]
    assert f"asked for '{spread}'; it is SIGMA_MM,FRICTION, such as 2,0.4" in last


def test_the_bench_refuses_an_error_that_cannot_be_provoked(capsys):
    """A usage error quotes it and lists those that can be provoked."""
    with pytest.raises(SystemExit):
        main(["bench", "palletizing", "--provoke", "moved,burnt"])
    last = capsys.readouterr().err.splitlines()[-1]
    assert "asked for 'burnt'; errors that can be provoked: moved, tipped" in last


def test_the_bench_names_the_errors_of_the_simulation():
    """The errors that the option takes are those that the simulation provokes."""
    knocks = pytest.importorskip("actors.palletizing.simulation.knocks", exc_type=ImportError)
    assert bench.PROVOKED == knocks.KNOCKS
