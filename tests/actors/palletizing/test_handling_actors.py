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
from actors.palletizing.demo.lineage import show_packing
from actors.palletizing.demo.robot_cell import TEMPLATE, configured
from actors.palletizing.feedback import HandlingFeedback
from actors.palletizing.handling.expectation import last_forks
from actors.palletizing.handling.stages import felt_on
from actors.palletizing.simulation.cell.scene import CellLayout
from enact_dist import Lock, View, Write, testing
from enact_dist.actor.check import check_cell
from enact_dist.config.read import load_config

from .handled_cell import (
    ARM,
    PACKAGE,
    PLACE,
    come,
    each,
    executed,
    looked,
    packed,
    placed,
    read,
    write,
)


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


def test_a_second_grasp_goes_where_the_hand_has_felt_the_package(cell):
    """A finger came down on it twice: the net goes farther to that side each time."""
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
    step_m = felt_on(0.0, "blocked_left", grasp)
    assert y_m[1] - y_m[0] == pytest.approx(step_m)
    seen = (
        CellLayout().base_from_belt
        @ each(cell, words.PACKAGES, words.SIGHTING, "online")[PACKAGE].frame_from_package
    )
    at = (CellLayout().base_from_belt[:3, :3] @ grasp.axis) @ seen[:3, 3]
    assert y_m[0] - at == pytest.approx(step_m)


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


def forks(cell):
    """Return the forks in which is written what is expected."""
    return sorted(one for one in cell.worlds() if one.startswith("expected-"))


def test_what_is_expected_is_written_into_a_fork_before_each_risky_stage(cell):
    """So the deviation is a difference; forks of sound places, and of an earlier run, go."""
    online = cell.world("online")
    online.fork("expected-0")  # of a generator that has ended
    generator = ActionGenerator(ARM)
    come(cell)
    testing.run_once(HandlingFeedback(), cell)

    def run(*results):
        for result in results:
            testing.run_once(generator, cell)
            testing.run_once(Action(), cell)
            executed(cell, result)
        testing.run_once(generator, cell)

    run("held", "placed", "in_contact", "aside")
    assert forks(cell) == ["expected-1-place", "expected-1-push"]
    looked(cell, "tray", "moved", x_m=0.02)
    write(cell, PLACE, words.STANDING, words.Standing("milk_carton", "moved", 20.0, 0.0))
    [found] = cell.world("expected-1-push").diff(online, words.PLACES, words.STANDING)
    assert found.entity == PLACE
    assert last_forks(cell) == ["expected-1-push"]
    standing = View(cell.world("expected-1-place"), PLACE, words.STANDING)
    placed_at = cell.world("expected-1-place").view(standing).get(standing)
    assert (placed_at.state, placed_at.shift_mm) == ("ok", 20.0), "the push is still to come"
    on_tray = each(cell, words.PLACES, words.PLAN)[PLACE].tray_from_product
    seen = words.Sighting(0, on_tray, 0, 0, "tray", "milk_carton")
    write(cell, PACKAGE, words.SIGHTING, seen)
    request = read(cell, words.SYSTEM, words.REQUEST)
    first = ["expected-1-place", "expected-1-push"]
    for number, kept in ((2, first), (3, [])):
        again = replace(request, number=number, kind="regrasp", seen="tray")
        write(cell, words.SYSTEM, words.REQUEST, again)
        run("held", "lost", "aside")
        own = [f"expected-{number}-place", f"expected-{number}-regrasp"]
        assert forks(cell) == [*kept, *own]
        looked(cell, "tray", "ok")
    standing = View(cell.world("expected-3-regrasp"), PLACE, words.STANDING)
    empty = cell.world("expected-3-regrasp").view(standing).get(standing)
    assert empty.state == "missing"


def test_a_package_that_is_removed_is_expected_to_be_seen_nowhere(cell):
    """Perception writes the very same when it is gone, so that nothing differs."""
    come(cell)
    testing.run_once(HandlingFeedback(), cell)
    on_tray = each(cell, words.PLACES, words.PLAN)[PLACE].tray_from_product
    seen = words.Sighting(0, on_tray, 0, 0, "tray", "milk_carton")
    write(cell, PACKAGE, words.SIGHTING, seen)
    request = read(cell, words.SYSTEM, words.REQUEST)
    write(cell, words.SYSTEM, words.REQUEST, replace(request, kind="reject", seen="tray"))
    packed(cell, "held", "rejected", "aside")
    assert forks(cell) == ["expected-1-regrasp", "expected-1-remove"]
    online, expected = cell.world("online"), cell.world("expected-1-remove")
    assert expected.diff(online, words.PACKAGES, words.SIGHTING)
    write(cell, PACKAGE, words.SIGHTING, replace(seen, frame=""))
    assert not expected.diff(online, words.PACKAGES, words.SIGHTING)


def test_forks_of_an_earlier_generator_are_dropped_and_no_others(cell):
    """One that was cut short has no expectation and is made again; a person's stays."""
    online = cell.world("online")
    for name in ("expected-0", "expected-1-regrasp", "expected-by-me", "expected-1-copy"):
        online.fork(name)
    online.fork("idea").fork("expected-5")
    cell.create_world("expected-6")
    come(cell)
    testing.run_once(HandlingFeedback(), cell)
    packed(cell, "held")
    assert forks(cell) == [
        "expected-1-copy",
        "expected-1-place",
        "expected-5",
        "expected-6",
        "expected-by-me",
    ]
    standing = View(cell.world("expected-1-place"), PLACE, words.STANDING)
    assert cell.world("expected-1-place").view(standing).get(standing).state == "ok"
