"""Claims about reaction times: causes, effects before and after them, and the jerk of an arm."""

import numpy as np
import pytest

from actors.workcell import vocabulary as words
from actors.workcell.demo.what_if import WhatIf, along_s, legs_s
from actors.workcell.motion import NOMINAL_M_S
from actors.workcell.scores.reaction import after_ms, reaction_of
from actors.workcell.scores.truth_of_run import truth_of
from actors.workcell.simulation.arm import ARM, HOME_RAD

from .runs import PERIOD_NS, START_NS, Run

MS = 1_000_000
STAMPS = np.arange(10, dtype=np.int64) * 10 * MS


def flags(*ones):
    return np.isin(np.arange(10), ones)


@pytest.mark.parametrize(
    ("effect", "found"),
    [
        (flags(5, 6), [20.0]),  # two samples after the cause
        (flags(1, 2, 3, 4), [-20.0]),  # it had begun two samples before
        (flags(), []),
        (flags(9), []),  # the cause had ended at 8
        (flags(0, 1, 5), [20.0]),  # what has ended before is none
    ],
)
def test_an_effect_counts_from_its_own_begin(effect, found):
    """It may begin before its cause; one that is over before, or comes after it, is none."""
    assert after_ms(STAMPS, flags(3, 4, 5, 6, 7), STAMPS, effect) == found


def test_two_causes_have_two_effects():
    """Each is paired with the effect within its own span."""
    assert after_ms(STAMPS, flags(1, 2, 5, 6, 7), STAMPS, flags(2, 6)) == [10.0, 10.0]


def test_a_lower_command_is_set_beside_the_true_distance():
    """The person of S3 comes to the table; commands fall 200 ms after the distance has."""
    run = Run("S3", 8.0)
    run.rest()
    truth, law_m = truth_of(run.trace()), 1.3
    near = [
        tick for tick in run.ticks if truth.distance_m(START_NS + tick * PERIOD_NS, run.q) < law_m
    ]
    for tick in run.ticks:
        limit = 0.3 if tick >= near[0] else float("inf")
        speed = words.Speed(0.2, limit, 1.0, "", 250.0, START_NS + tick * PERIOD_NS, 0)
        run.add(words.ROBOT.name, words.SPEED, speed, tick, late_ms=200.0)

    found = reaction_of(run.trace(), truth)

    assert abs(found["reaction_max_ms"]) < 700.0  # 1.3 m is near S(full speed), not the same
    assert found["rest_max_ms"] < 0.0  # it has been at rest all the time
    assert found["jerk_max_rad_s3"] == 0.0


def path_to(goal, *waypoints):
    return words.Path(np.array(waypoints), goal, 0, goal, START_NS, 0.0)


def test_a_leg_ends_when_its_last_path_has_been_followed():
    """A replan after a second costs that second; a path without points costs what waiting does."""
    home, aside = np.array(HOME_RAD), np.array(HOME_RAD) + np.array([0.6, 0, 0, 0, 0, 0, 0])
    straight = path_to(1, home, aside)
    way_s = along_s(ARM, straight)
    second = round(1e9)
    nothing = words.Path(np.empty((0, 7)), 2, 0, 1, START_NS, 0.0, reason="blocked")

    assert 0.3 < way_s < 3.0
    assert legs_s(ARM, [(START_NS, straight)]) == (way_s,)
    assert legs_s(ARM, [(0, straight), (second, straight)]) == (1.0 + way_s,)
    assert legs_s(ARM, [(0, nothing), (second, straight)]) == (way_s,)
    assert len(legs_s(ARM, [(0, straight), (second, path_to(0, aside, home))])) == 2
    assert NOMINAL_M_S > 1.0


def test_what_if_tells_what_is_saved_and_what_must_hold():
    """Only legs of both runs count; a stranger, or no path in the fork, fails a check."""
    found = WhatIf(2, 3, (2.0, 1.0), (2.5, 1.5, 4.0), strangers=0)
    assert found.saved_s == pytest.approx(1.0)  # the third leg is online only
    assert all(found.checks().values())
    assert found.facts()["legs_fork_s"] == [2.0, 1.0]
    assert not all(WhatIf(2, 3, (), (), strangers=1).checks().values())
    assert not all(WhatIf(0, 3, (), (), strangers=0).checks().values())
