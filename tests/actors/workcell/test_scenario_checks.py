"""Claims about the checks of the scenarios: a good run holds them, none or a wrong one does not."""

import dataclasses

import numpy as np
import pytest

from actors.workcell import vocabulary as words
from actors.workcell.scenarios import SCENARIOS
from actors.workcell.scores.scenario_checks import NEEDED, checks_of

from .runs import PERIOD_NS, START_NS, Run

MEASURED = {**dict.fromkeys(NEEDED, 0.0), "violations": 0.0, "moments": 1e6}


def speed(scale: float, tick: int) -> words.Speed:
    """Return a command of a tick."""
    stamp = START_NS + tick * PERIOD_NS
    return words.Speed(scale, scale, np.inf, "", 250.0, stamp, stamp)


def track(middle: np.ndarray) -> words.Track:
    """Return the track of a person who stands there."""
    return words.Track(
        np.array([*middle[:2], 1.7]), np.zeros(3), np.eye(6), 1.7, 0.07, START_NS, hidden=False
    )


def held(run: Run, text: str) -> bool:
    """Return whether the check whose words contain a text was held."""
    found = checks_of(run.trace(), MEASURED)
    return next(value for words_, value in found.items() if text in words_)


@pytest.mark.parametrize("name", [name for name in SCENARIOS if name not in {"visit", "S9"}])
def test_run_that_did_nothing_fails_its_scenario(name: str) -> None:
    """Beside what holds for all: each scenario has a check that an empty recording does not pass."""
    found = checks_of(Run(name, 6.0).trace(), MEASURED)

    assert sum(not value for value in found.values()) >= 1


@pytest.mark.parametrize("name", SCENARIOS)
def test_run_without_a_figure_fails(name: str) -> None:
    """What was not measured is no goal that was met; nor are a few moments all of them."""
    trace = Run(name, 6.0).trace()

    assert checks_of(trace, MEASURED)["every figure was measured"]
    for lacking in NEEDED:
        some = {key: value for key, value in MEASURED.items() if key != lacking}
        assert not checks_of(trace, some)["every figure was measured"]
    assert not checks_of(trace, {**MEASURED, "moments": 100.0})["every figure was measured"]


def test_full_speed_is_judged_only_where_everybody_has_left() -> None:
    """S2: a run that ends before says nothing; one that stays slow fails."""
    outcomes = []
    for seconds, last in ((3.0, 1.0), (60.0, 1.0), (60.0, 0.5)):
        run = Run("S2", seconds)
        for tick in run.ticks[::2]:
            inside = any(
                (body := person.capsules_at(tick / 10)) is not None
                and (np.abs(body[:, :2]) < 2.0).all(1).any()
                for person in run.people
            )
            for each in (tick, tick + 1):
                scale = 0.5 if inside else last
                run.add(words.ROBOT.name, words.SPEED, speed(scale, each), each)
        outcomes.append(held(run, "full speed a second after"))

    assert outcomes == [False, True, False]


@pytest.mark.parametrize(("shift", "kept"), [(0, True), (30, False)])
def test_place_of_who_hides_is_where_they_are(shift: int, kept: bool) -> None:
    """S4: something occupied 1.5 m away is not their place."""
    run = Run("S4", 12.0)
    for tick in run.ticks[::5]:
        run.hull(tick)
        slot = run.versions["online", words.WORKSPACE.name, "hull"]
        hull = slot[-1].datum
        moved = (hull.voxels + np.array([shift, 0, 0])).astype(np.int16)
        slot[-1] = dataclasses.replace(slot[-1], held=dataclasses.replace(hull, voxels=moved))

    assert held(run, "the place of who hides") is kept


@pytest.mark.parametrize(("which", "two"), [((0, 1), True), ((0, 0), False), ((0,), False)])
def test_two_tracks_are_those_of_two_people(which: tuple[int, ...], two: bool) -> None:
    """S11: two tracks of one person are one."""
    run = Run("S11", 20.0)
    none = np.empty(0)
    hull = words.Hull(np.empty((0, 3), np.int16), none, none, none, {}, (), np.inf, -1)
    for tick in run.ticks[::3]:
        run.add(words.WORKSPACE.name, words.HULL, hull, tick)
        middles = [person.centre_at(tick / 10) for person in run.people]
        for human, number in enumerate(which):
            middle = middles[number]
            if middle is not None:
                run.add(f"human/{human}", words.TRACK, track(middle), tick)

    assert held(run, "two tracks") is two


@pytest.mark.parametrize(("moves_s", "rests"), [(0.5, True), (0.65, False)])
def test_robot_rests_when_commands_stay_away(moves_s: float, rests: bool) -> None:
    """S8: within the validity of the last command and the time that braking takes."""
    run = Run("S8", 10.0)
    for tick in run.ticks:
        if not 30 <= tick < 60:
            run.add(words.ROBOT.name, words.SPEED, speed(1.0, tick), tick)
        stamps = START_NS + tick * PERIOD_NS + np.arange(10) * 10_000_000
        moving = stamps < START_NS + 29 * PERIOD_NS + round(moves_s * 1e9)
        turning = np.zeros((10, 7))
        turning[:, 0] = moving
        joints = words.Joints(np.tile(run.q, (10, 1)), turning, stamps)
        run.add(words.ROBOT.name, words.JOINTS, joints, tick)

    assert held(run, "at rest within 250 ms") is rests
