"""The robot's loop in simulated time: each kind of silence brakes, old stamps are refused."""

import dataclasses
import math

import numpy as np
import pytest

from actors.geometry.arms.kinematics import capsules_at, end_velocities
from actors.geometry.capsules import capsule_distances
from actors.geometry.separation import Reaction, Separation
from actors.workcell.motion import (
    BRAKING_M_S2,
    CYCLE_S,
    FOLLOWING_RAD,
    ROBOT_S,
    CommandedArm,
    HostClock,
    Motion,
)
from actors.workcell.simulation.arm import ARM, HOME_RAD
from actors.workcell.vocabulary import Path, Speed

START_NS = 10**18
MS = 1_000_000
LEFT = np.array([-1.0, 0.9, 0.0, -1.1, 0.0, 1.1, 0.0])
RIGHT = np.array([0.9, 0.9, 0.0, -1.1, 0.0, 1.1, 0.0])
FULL = Speed(1.0, math.inf, math.inf, "no person is there", 250.0, START_NS, START_NS)


def path_of(waypoints, number=1, reason="", planned_ns=START_NS):
    waypoints = np.asarray(waypoints, float).reshape(-1, 7)
    return Path(waypoints, number, 0, 1, planned_ns, 0.0, reason)


def speed_at(now_ns, **changes):
    return dataclasses.replace(FULL, captured_ns=now_ns, joints_ns=now_ns, **changes)


class Loop:
    """Runs a motion cycle by cycle on a clock of its own."""

    def __init__(self, waypoints=(LEFT, RIGHT)):
        self.now_ns = START_NS
        self.motion = Motion(ARM, waypoints[0], self.now_ns)
        self.motion.follow(path_of(waypoints), self.now_ns)

    def run(self, seconds, commanded=True, **changes):
        """Run for some time, with a fresh command in each cycle or with none."""
        for _ in range(round(seconds / CYCLE_S)):
            self.now_ns += round(CYCLE_S * 1e9)
            if commanded:
                assert self.motion.obey(speed_at(self.now_ns, **changes), self.now_ns) == ""
            self.motion.cycle(self.now_ns)
            self.motion.measured(self.motion.q_rad, self.motion.dq_rad_s, self.now_ns)

    @property
    def moves(self):
        return bool(np.abs(self.motion.dq_rad_s).max() > 0.0)


def test_arm_follows_its_path_to_the_end():
    """It arrives exactly, dwells there, and has reached one goal."""
    loop = Loop()

    loop.run(6.0)

    np.testing.assert_allclose(loop.motion.q_rad, RIGHT, atol=1e-9)
    assert (loop.motion.doing.state, loop.motion.doing.goals_reached) == ("dwelling", 1)
    assert not loop.moves


@pytest.mark.parametrize("valid_ms", [120.0, 250.0])
def test_silence_brakes_once_the_command_is_no_longer_valid(valid_ms):
    """Until then it moves on; then it brakes in full and is at rest after v/a."""
    loop = Loop()
    loop.run(0.8, valid_ms=valid_ms, limit_m_s=1.2)

    loop.run(valid_ms / 1e3, commanded=False)
    before = loop.motion.doing
    loop.run(1.2 / BRAKING_M_S2 + ROBOT_S, commanded=False)

    assert before.state == "moving"
    assert before.speed_m_s > 0.7
    assert not loop.moves
    assert loop.motion.doing.state == "stopped"
    assert "ms old" in loop.motion.doing.reason


@pytest.mark.parametrize(
    ("silence", "reason"),
    [
        (lambda loop: loop.motion.silence("the robot's process ends"), "process ends"),
        (lambda loop: setattr(loop, "now_ns", loop.now_ns + 600 * MS), "ms old"),
        (lambda loop: setattr(loop, "now_ns", loop.now_ns - 600 * MS), "ms old"),
        (
            lambda loop: loop.motion.obey(
                speed_at(loop.now_ns, scale=0.0, reason="too near"), loop.now_ns
            ),
            "too near",
        ),
        (
            lambda loop: loop.motion.obey(
                speed_at(loop.now_ns, limit_m_s=math.nan, reason="nan"), loop.now_ns
            ),
            "nan",
        ),
    ],
    ids=["ends", "frozen", "clock set back", "scale 0", "not a number"],
)
def test_each_kind_of_silence_brakes(silence, reason):
    """A loop that was frozen, a clock that jumps, a limit that is none: rest, with the reason."""
    loop = Loop()
    loop.run(0.8)
    assert loop.moves

    silence(loop)
    loop.run(0.24, commanded=False)

    assert not loop.moves
    assert reason in loop.motion.doing.reason
    loop.now_ns = START_NS + 10 * 10**9
    loop.run(0.3)
    assert loop.moves


def test_robot_that_never_heard_a_command_rests():
    """A path alone moves nothing."""
    loop = Loop()

    loop.run(0.5, commanded=False)

    assert not loop.moves
    np.testing.assert_array_equal(loop.motion.q_rad, LEFT)


@pytest.mark.parametrize(
    ("age_ms", "refused"),
    [(0, ""), (249, ""), (251, "251 ms old, 250 are allowed"), (-10, ""), (-30, "30 ms ahead")],
)
def test_command_on_old_images_is_refused(age_ms, refused):
    """What counts is the age of the exposure; the error shows it, and the counter grows."""
    motion = Motion(ARM, LEFT, START_NS)

    said = motion.obey(speed_at(START_NS - age_ms * MS), START_NS)

    assert refused in said
    assert bool(said) == bool(refused) == bool(motion.refused)


@pytest.mark.parametrize("valid_ms", [math.nan, math.inf])
def test_command_without_an_end_is_refused(valid_ms):
    """A command that would never grow too old moves nothing."""
    motion = Motion(ARM, LEFT, START_NS)

    said = motion.obey(speed_at(START_NS, valid_ms=valid_ms), START_NS)

    assert f"{valid_ms:.0f}" in said
    assert motion.refused == 1


def test_command_on_an_earlier_exposure_is_refused():
    """Commands that overtake each other never raise the speed again."""
    motion = Motion(ARM, LEFT, START_NS)
    motion.obey(speed_at(START_NS, scale=0.0), START_NS)

    said = motion.obey(speed_at(START_NS - 50 * MS), START_NS)

    assert "earlier exposure" in said


def test_refused_command_does_not_replace_the_last():
    """The arm stops when the last good command ends, as if the old one had not come."""
    loop = Loop()
    loop.run(0.5)
    loop.motion.obey(speed_at(loop.now_ns - 300 * MS), loop.now_ns)

    loop.run(0.2, commanded=False)
    moved_on = loop.moves
    loop.run(0.45, commanded=False)

    assert moved_on
    assert not loop.moves


def test_arm_goes_over_to_a_path_where_it_leaves_the_old_one():
    """It rests at the place that both share, then follows the new one; every state is on a path."""
    loop = Loop()
    loop.run(0.4)
    away = LEFT + (RIGHT - LEFT) * 0.6
    aside = away + np.array([0.0, -0.4, 0.0, 0.2, 0.0, 0.0, 0.0])
    loop.motion.follow(path_of([away, aside], 2), loop.now_ns)
    seen = []

    for _ in range(400):
        loop.run(CYCLE_S)
        seen.append((loop.motion.q_rad, loop.motion.doing.path_number, loop.moves))

    first = np.array([q for q, number, _ in seen if number == 1])
    np.testing.assert_allclose(np.linalg.norm(np.cross(
        (first - LEFT)[:, [0, 1, 3]], (RIGHT - LEFT)[[0, 1, 3]]), axis=1), 0.0, atol=1e-9)  # fmt: skip
    assert (np.diff(first[:, 0]) >= 0.0).all()
    np.testing.assert_allclose(first[-1], away, atol=2e-2)
    np.testing.assert_allclose(seen[-1][0], aside, atol=1e-9)
    assert loop.motion.doing.goals_reached == 1


def test_path_that_begins_elsewhere_is_not_followed():
    """The arm brakes, waits, and says why; a path from where it is goes on."""
    loop = Loop()
    loop.run(0.4)
    loop.motion.follow(path_of([RIGHT + 0.3, LEFT], 2), loop.now_ns)

    loop.run(0.6)
    waiting = loop.motion.doing
    loop.motion.follow(path_of([loop.motion.q_rad, LEFT], 3), loop.now_ns)
    loop.run(5.0)

    assert (waiting.state, waiting.reason) == ("waiting", "path 2 is refused: it starts elsewhere")
    assert loop.motion.doing.path_number == 3
    np.testing.assert_allclose(loop.motion.q_rad, LEFT, atol=1e-9)


def test_path_of_another_life_of_the_shard_is_followed_though_its_number_was_used():
    """Numbers begin anew with the shard; when a path was planned tells it from the old one."""
    loop = Loop()
    loop.run(0.4)

    loop.motion.follow(path_of([], 1, "no path was found", START_NS + 10**9), loop.now_ns)
    loop.run(0.6)

    assert not loop.moves
    assert loop.motion.doing.reason == "no path was found"


@pytest.mark.parametrize("off_rad", [1.01 * FOLLOWING_RAD, math.nan])
def test_arm_that_is_not_where_it_was_commanded_ends_the_loop(off_rad):
    """An arm that was stopped by its own controller must not jump after the loop later."""
    motion = Motion(ARM, LEFT, START_NS)
    motion.measured(LEFT + 0.9 * FOLLOWING_RAD, np.zeros(7), START_NS)
    off = np.array([0, 0, off_rad, 0, 0, 0, 0])

    with pytest.raises(RuntimeError, match=r"joint 3 is .* rad from where it was commanded"):
        motion.measured(LEFT + off, np.zeros(7), START_NS)


@pytest.mark.parametrize(("step_ms", "was_set"), [(0, False), (-100, True), (100, True)])
def test_a_clock_that_was_set_is_noticed(step_ms, was_set):
    """What tells is how it goes on beside a clock that nobody can set; a held-up loop does not."""
    clock = HostClock()

    assert not clock.was_set(1000 * MS, 7 * MS, 7 * MS)
    assert not clock.was_set(3000 * MS, 2007 * MS, 2007 * MS)
    assert not clock.was_set(3100 * MS, 2017 * MS, 2107 * MS)
    assert clock.was_set((3110 + step_ms) * MS, 2117 * MS, 2117 * MS) == was_set
    assert not clock.was_set((3120 + step_ms) * MS, 2127 * MS, 2127 * MS)


def test_no_path_ends_the_motion():
    """A path without waypoints stops the arm on the old one and shows the planner's reason."""
    loop = Loop()
    loop.run(0.4)

    loop.motion.follow(path_of([], 2, "no path was found"), loop.now_ns)
    loop.run(0.6)

    assert not loop.moves
    assert (loop.motion.doing.state, loop.motion.doing.reason) == ("waiting", "no path was found")


def test_joints_are_the_last_three_tenths_of_a_second():
    """Thirty samples, increasing stamps; before the start, the first one stands."""
    loop = Loop()
    early = loop.motion.joints()
    loop.run(0.8)
    late = loop.motion.joints()

    for joints in (early, late):
        assert joints.q.shape == joints.dq.shape == (30, 7)
        assert (np.diff(joints.stamp_ns) == 10 * MS).all()
    np.testing.assert_array_equal(early.q, np.tile(LEFT, (30, 1)))
    assert late.stamp_ns[-1] == loop.now_ns
    np.testing.assert_allclose(np.diff(late.q, axis=0) / CYCLE_S, late.dq[1:], atol=0.05)


def test_commanded_arm_goes_on_where_it_was():
    """At the first start it stands at home; an address may say where that is."""
    np.testing.assert_array_equal(CommandedArm().open(None), HOME_RAD)
    np.testing.assert_array_equal(CommandedArm("1 2 3 4 5 6 7").open(None), [1, 2, 3, 4, 5, 6, 7])
    np.testing.assert_array_equal(CommandedArm().open(LEFT), LEFT)
    with pytest.raises(ValueError, match="7 numbers"):
        CommandedArm("1 2")


@pytest.mark.parametrize("seed", range(6))
def test_robot_never_moves_faster_than_the_true_distance_allows(seed):
    """Someone walks up at 1.6 m/s; images come late by a drawn latency, some never.

    At 100 Hz, the speed of the quickest point is at most what ISO/TS 15066 allows for the true
    distance without any reaction time; before someone could touch the arm, it rests.
    """
    draw = np.random.default_rng(seed)
    reaction = Reaction(period_s=0.1, robot_s=ROBOT_S)
    loop = Loop()
    angle, pending, number, violations, ran = draw.uniform(-0.8, 0.8), [], 1, 0, False
    body = np.array([np.cos(angle), np.sin(angle)])
    for cycle in range(900):
        now_s = cycle * CYCLE_S
        along = 3.2 - 1.6 * min(max(now_s - 4.0, 0.0), 1.6)
        person = np.r_[body * along, 0.2, body * along, 1.6, 0.15][None]
        if cycle % 10 == 0 and draw.random() > 0.05:
            near_m = float(capsule_distances(capsules_at(ARM, loop.motion.q_rad)[0], person).min())
            arrives = cycle + int(draw.integers(4, 12))
            pending.append((arrives, loop.now_ns, near_m - draw.uniform(0.0, 0.05)))
        for _, captured_ns, near_m in [one for one in pending if one[0] <= cycle]:
            age_s = (loop.now_ns - captured_ns) / 1e9
            reaction.seen(captured_ns, age_s)
            limit = Separation(reaction.reaction_s).speed_max_m_s(near_m)
            command = speed_at(captured_ns, limit_m_s=limit, scale=float(limit > 0.0),
                               valid_ms=1e3 * reaction.valid_s)  # fmt: skip
            loop.motion.obey(command, loop.now_ns)
        pending = [one for one in pending if one[0] > cycle]
        if loop.motion.doing.state == "dwelling":
            number += 1
            ends = [LEFT, RIGHT] if number % 2 else [RIGHT, LEFT]
            loop.motion.follow(path_of(ends, number), loop.now_ns)
        loop.run(CYCLE_S, commanded=False)
        true_m = float(capsule_distances(capsules_at(ARM, loop.motion.q_rad)[0], person).min())
        ends = end_velocities(ARM, loop.motion.q_rad, loop.motion.dq_rad_s)
        fastest = float(np.linalg.norm(ends, axis=-1).max())
        ran = ran or fastest > 0.8
        violations += fastest > Separation(reaction_s=0.0).speed_max_m_s(true_m) + 1e-6

    assert ran
    assert violations == 0
    assert not loop.moves
