"""Each scenario holds what it must, on its truth: the whole cell, tick by tick on a manual clock.

``ENACT_SCENARIO_SEED=7`` plays another seed.  What only processes can show (a killed shard, Ctrl-C)
is in `test_demo_faults`.
"""

from __future__ import annotations

import os
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import pytest

from actors.workcell import vocabulary as words
from actors.workcell.demo.conduct import DEPTH, Notes
from actors.workcell.demo.report import stop_checks
from actors.workcell.planning import PathPlanning
from actors.workcell.scores.evaluation import score
from actors.workcell.scores.scenario_checks import checks_of
from actors.workcell.scores.trace import ASPECTS, ONLINE
from enact_dist import Lock, View, Write, testing
from enact_dist.access.reads import slot_of
from enact_dist.wire.payload import encode_datum

from . import stepped as stepping
from .stepped import stepped

if TYPE_CHECKING:
    from enact_dist.core.protocol.datum import Datum
    from enact_dist.world.context import WorldContext

    from .stepped import Stepped

SEED = int(os.environ.get("ENACT_SCENARIO_SEED", "1"))
RESTART_S = 0.8
"""So long an actor that was killed is away."""


class Part(NamedTuple):
    """Which part of a scenario is played: all that decides, and little more.

    Attributes:
        seconds: How long the scenario lasts.
        begin_s: Where the part begins; nobody is in the workspace.
        end_s: Where it ends.
    """

    seconds: float
    begin_s: float
    end_s: float


PARTS = {
    "S1": Part(3.0, 0.0, 3.0),
    "S2": Part(16.0, 1.4, 7.4),
    "S3": Part(20.0, 1.2, 6.0),
    "S4": Part(8.0, 1.2, 6.4),
    "S5": Part(30.0, 1.2, 6.6),
    "S6": Part(20.0, 4.5, 11.5),
    "S7": Part(6.0, 0.0, 6.0),
    "S8": Part(6.0, 0.0, 6.0),
    "S10": Part(6.0, 1.4, 6.0),
    "S11": Part(20.0, 1.4, 5.0),
    "S12": Part(20.0, 1.2, 6.0),
}


def play(cell: Stepped, part: Part) -> dict[str, bool]:
    """Play the part of a scenario and return what held."""
    cell.until(part.end_s, before=lambda: cell.break_as_planned(RESTART_S))
    trace = cell.trace()
    return checks_of(trace, score(trace, every=5), part.end_s - part.begin_s)


@pytest.mark.sampled(3)
@pytest.mark.parametrize("name", PARTS)
def test_a_scenario_holds_what_it_must(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """What the demo checks on the truth; S12 traces its stop back to the images, too."""
    part = PARTS[name]
    with stepped(monkeypatch, name, seed=SEED, seconds=part.seconds, begin_s=part.begin_s) as cell:
        held = play(cell, part)
        if name == "S12":
            notes = Notes(stop=cell.cell.why("online", words.ROBOT, words.SPEED, depth=DEPTH))
            held |= stop_checks(notes)

    assert len(held) > 1
    assert [what for what, right in held.items() if not right] == []


def test_a_coarse_grid_does_not_hold_the_robot_after_a_restart(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A reconstruction that knows nothing of before takes no rim of the arm for a person.

    The arm rests while it is away, so a rim would stay where it is, and the arm with it.
    """
    monkeypatch.setattr(stepping, "VOXEL_M", 0.05)
    monkeypatch.setattr(stepping, "_tables", {})
    with stepped(monkeypatch, "S1", seed=SEED, seconds=3.0) as cell:
        cell.until(0.5)
        cell.kill("reconstruction")
        cell.until(1.8)
        cell.start("reconstruction")
        cell.until(2.1)

        assert len(cell.newest(words.WORKSPACE, words.HULL).voxels) == 0
        assert cell.newest(words.ROBOT, words.SPEED).scale == 1.0


def test_online_never_sees_what_the_planner_of_a_fork_does(monkeypatch: pytest.MonkeyPatch) -> None:
    """S9: the fork gets hulls, predictions and joints as they come, and plans paths of its own."""
    read = (
        (words.WORKSPACE, words.HULL),
        (words.human_entity(0), words.PREDICTION),
        (words.ROBOT, words.JOINTS),
    )
    with stepped(monkeypatch, "S9", seed=SEED, seconds=20.0, begin_s=0.8) as cell:
        cell.until(1.2)
        online, fork = cell.cell.world("online"), cell.cell.world("online").fork("what_if")
        planner, seen = PathPlanning(), []
        planner.predict = False

        def hand_on() -> None:
            for entity, aspect in read:
                view, copy = View(online, entity, aspect), Write(fork, entity, aspect)
                seen_there = online.view(view)
                state = seen_there._readings.state(slot_of(view))
                if state is not None and seen_there.get(view) is not None:
                    with Lock(copy) as lock:
                        lock.put(copy, seen_there[view], stamp_ns=state.captured_ns)
            before = _newest_path(online)
            testing.run_once(planner, cell.cell, {"online": "what_if"})
            assert _newest_path(online) == before
            seen.append(_newest_path(fork))

        begun = _newest_path(fork)
        while seen[-1:] in ([], [begun]) and cell.at_s < 9.0:
            cell.until(cell.at_s + 0.1, after=hand_on)

        assert seen[-1] > begun  # it did plan
        view = View(fork, words.ROBOT, words.PATH)
        assert len(fork.view(view)[view].waypoints) > 1


def test_nothing_tells_that_commits_have_failed(monkeypatch: pytest.MonkeyPatch) -> None:
    """S3: each step of an actor with triggers is done twice; all data are those of one that stood."""
    written = []
    for loses in (False, True):
        with stepped(monkeypatch, "S3", seed=SEED, seconds=20.0, begin_s=1.2) as cell:
            cell.actors["planning"].limit_s = 3600.0  # type: ignore[attr-defined]
            cell.loses = loses
            cell.until(3.0)
            written.append(_all_written(cell))

    assert (ONLINE, "human/0", "track") in written[0]
    assert [slot for slot, data in written[0].items() if written[1].get(slot) != data] == []


def _all_written(cell: Stepped) -> dict[tuple[str, str, str], list[Datum]]:
    """Return all data by slot, without how long it took to plan them."""
    kept = {
        slot: [(one.stamp_ns, one.datum) for one in all_] for slot, all_ in cell.versions.items()
    }
    path = ONLINE, words.ROBOT.name, words.PATH.name
    kept[path] = [(stamp_ns, replace(one, took_ms=0.0)) for stamp_ns, one in kept[path]]
    return {
        slot: [
            encode_datum(one, ASPECTS[slot[2]].datum_type, stamp_ns=at_ns) for at_ns, one in all_
        ]
        for slot, all_ in kept.items()
    }


def _newest_path(world: WorldContext) -> int:
    """Return the number of the newest version of the path in a world context."""
    return world.history(words.ROBOT, words.PATH, count=1)[-1].version
