"""The moving arm goes over to a new path: on a path always, within every limit, or it brakes."""

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from actors.geometry.arms.joint_paths import JoinedPath, JointPath, PathFollower, PathSpeeds
from actors.geometry.arms.kinematics import end_velocities
from actors.workcell.motion import BRAKING_M_S2, CYCLE_S, NOMINAL_M_S, Motion
from actors.workcell.simulation.arm import ARM
from actors.workcell.vocabulary import NO_PATH, Path, Speed

START_NS = 10**18
CYCLE_NS = round(CYCLE_S * 1e9)
LEFT = np.array([-1.0, 0.9, 0.0, -1.1, 0.0, 1.1, 0.0])
RIGHT = np.array([0.9, 0.9, 0.0, -1.1, 0.0, 1.1, 0.0])
UP = np.array([0.4, 0.3, 0.0, -1.1, 0.0, 1.1, 0.0])
FULL = Speed(1.0, math.inf, math.inf, "no person is there", 250.0, START_NS, START_NS)


def drawn(draw, points):
    """Return random waypoints within the limits of the joints."""
    return draw.uniform(-0.8, 0.8, (points, 7)) * ARM.q_max


def speeds(line):
    return PathSpeeds(ARM, line, nominal_m_s=NOMINAL_M_S)


def leaving(line, at_rad, *behind, lead_rad=0.3):
    """Return waypoints that leave a path straight on, and go on over other states."""
    q, heading, _ = line.at(at_rad)
    return np.stack([q[0], q[0] + lead_rad * heading[0], *behind])


class Loop:
    """Runs a motion cycle by cycle, and keeps where it was at each."""

    def __init__(self, waypoints=(LEFT, RIGHT)):
        self.now_ns, self.numbers = START_NS, 0
        self.motion = Motion(ARM, waypoints[0], self.now_ns)
        self.states = [(self.motion.q_rad, self.motion.dq_rad_s)]
        self.follow(waypoints)

    def follow(self, waypoints, captured_ns=0):
        """Hand on a path."""
        self.numbers += 1
        rows = np.asarray(waypoints, float).reshape(-1, 7)
        self.motion.follow(
            Path(rows, self.numbers, 0, 1, START_NS, 0.0, "", 0.0, captured_ns or self.now_ns),
            self.now_ns,
        )

    def run(self, seconds, limit_m_s=math.inf):
        for _ in range(round(seconds / CYCLE_S)):
            self.now_ns += CYCLE_NS
            command = dataclasses.replace(
                FULL, limit_m_s=limit_m_s, scale=float(limit_m_s > 0.0), captured_ns=self.now_ns
            )
            assert self.motion.obey(command, self.now_ns) == ""
            self.motion.cycle(self.now_ns)
            self.states.append((self.motion.q_rad, self.motion.dq_rad_s))

    @property
    def line(self):
        return self.motion._follower.speeds.path

    @property
    def s_rad(self):
        return self.motion._follower.s_rad

    @property
    def speed_rad_s(self):
        return float(np.linalg.norm(self.motion.dq_rad_s))

    def check(self, *lines):
        """No joint jumps, none is too fast or accelerates too much, and all is on a path."""
        q, dq = (np.array(part) for part in zip(*self.states, strict=True))
        np.testing.assert_allclose(
            np.diff(q, axis=0), (dq[1:] + dq[:-1]) / 2.0 * CYCLE_S, atol=6e-4
        )
        assert (np.abs(dq) <= 1.001 * ARM.dq_max).all()
        assert (np.abs(np.diff(dq, axis=0)) / CYCLE_S <= 1.03 * ARM.ddq_max).all()
        for state in q[:: max(1, len(q) // 60)]:
            places = [line.at(line.nearest_rad(state))[0][0] for line in lines]
            assert min(np.linalg.norm(state - place) for place in places) < 1e-6


limits = st.lists(
    st.tuples(st.sampled_from([0.0, 0.1, 0.5, 1.2, math.inf]), st.integers(1, 25)), max_size=8
)


@settings(max_examples=20)
@given(st.integers(0, 10_000), st.integers(2, 4), st.floats(0.05, 2.0), st.floats(0.0, 0.6), limits)
def test_arm_changes_its_path_within_every_limit(seed, points, after_s, ahead_s, changes):
    """However the paths turn and the speed limit jumps: on a path, no jump, at last at the goal."""
    draw = np.random.default_rng(seed)
    loop = Loop(drawn(draw, points))
    loop.run(after_s)
    old = loop.line
    at_rad = old.straight_rad(loop.motion._follower.speeds.reached_rad(
        loop.s_rad, loop.speed_rad_s, ahead_s) + 0.01)  # fmt: skip
    at_rad = min(at_rad, old.length_rad)
    new = leaving(old, at_rad, *drawn(draw, points), lead_rad=float(draw.uniform(0.05, 0.4)))

    loop.follow(new)
    for limit_m_s, cycles in changes:
        loop.run(cycles * CYCLE_S, limit_m_s)
    loop.run(20.0)

    loop.check(old, JointPath(new))
    if loop.motion.refused_path == NO_PATH:
        np.testing.assert_allclose(loop.motion.q_rad, new[-1], atol=1e-9)
    else:
        assert loop.motion.doing.state == "waiting"


def test_arm_does_not_stop_where_the_corner_allows():
    """It goes over with the speed that it has, and the number is that of the new path."""
    loop = Loop()
    loop.run(0.8)
    before_rad_s, old = loop.speed_rad_s, loop.line
    new = leaving(old, loop.s_rad + 0.3, UP, lead_rad=0.4)

    loop.follow(new)
    loop.run(CYCLE_S)
    number = loop.motion.doing.path_number
    slowest = []
    while loop.motion.doing.state == "moving":
        loop.run(CYCLE_S)
        slowest.append(loop.speed_rad_s)

    assert before_rad_s > 1.0
    assert number == 2
    assert min(slowest[:40]) > 0.6
    np.testing.assert_allclose(loop.motion.q_rad, UP, atol=1e-9)
    assert loop.motion.doing.goals_reached == 1
    loop.check(old, JointPath(new))


def test_arm_brakes_on_the_old_path_before_a_corner_that_is_too_sharp():
    """A path that turns back after 0.05 rad is gone over to all the same, slowly."""
    loop = Loop()
    loop.run(0.8)
    old = loop.line
    at_rad = loop.s_rad + 0.5
    new = leaving(old, at_rad, LEFT - 0.6 * np.eye(7)[1], lead_rad=0.05)

    loop.follow(new)
    loop.run(0.1)
    while loop.motion.doing.state == "moving":
        loop.run(CYCLE_S)

    near = [
        np.linalg.norm(dq)
        for q, dq in loop.states
        if np.linalg.norm(q - new[1]) < 0.03
    ]  # fmt: skip
    assert 0.0 < max(near) < 0.4
    np.testing.assert_allclose(loop.motion.q_rad, new[-1], atol=1e-9)
    loop.check(old, JointPath(new))


@pytest.mark.parametrize("seed", [212, 228, 78])
def test_arm_that_brakes_when_it_goes_over_keeps_the_limit_behind(seed):
    """It ends its braking without such an acceleration as would carry it beyond the limit."""
    draw = np.random.default_rng(seed)
    loop = Loop(drawn(draw, 2))
    loop.run(1.0, 0.1)

    loop.follow(leaving(loop.line, loop.s_rad + 0.02, *drawn(draw, 2), lead_rad=0.1))
    loop.run(0.4, 0.1)

    q, dq = (np.array(part) for part in zip(*loop.states, strict=True))
    assert loop.motion.doing.path_number == 2
    assert np.linalg.norm(end_velocities(ARM, q, dq), axis=-1).max() <= 0.1


def test_path_that_comes_when_the_arm_has_passed_its_beginning_is_refused():
    """By name; the arm brakes on the old path, and goes over to the next one while it brakes."""
    loop = Loop()
    loop.run(0.8)
    old = loop.line
    late = leaving(old, loop.s_rad - 0.02, UP)

    loop.follow(late)
    loop.run(0.05)
    said = loop.motion.execution(START_NS, START_NS, "")
    braked_rad_s = loop.speed_rad_s
    new = leaving(old, loop.s_rad + 0.4, UP)
    loop.follow(new)
    loop.run(4.0)

    assert said.refused_path == (2, START_NS)
    assert said.path_refusal == (
        "path 2 is refused: the arm has passed the place where it leaves path 1"
    )
    assert 0.0 < braked_rad_s < 1.3
    assert min(np.linalg.norm(dq) for _, dq in loop.states[20:120]) > 0.3
    np.testing.assert_allclose(loop.motion.q_rad, UP, atol=1e-9)
    loop.check(old, JointPath(new))


def test_refused_path_is_not_followed_at_rest_either():
    """The planner plans again; the arm rests, and its reason names the refused path."""
    loop = Loop()
    loop.run(0.8)
    loop.follow(leaving(loop.line, loop.s_rad - 0.02, UP))

    loop.run(2.0)

    assert loop.speed_rad_s == 0.0
    assert loop.motion.doing.state == "waiting"
    assert "has passed the place where it leaves path 1" in loop.motion.doing.reason


def test_path_on_an_earlier_exposure_is_refused_and_changes_nothing():
    """Paths that overtake each other never bring an old one back; a set clock forgets the stamps."""
    loop = Loop()
    loop.run(0.8)
    stamp_ns = loop.now_ns

    loop.follow(leaving(loop.line, loop.s_rad + 0.3, UP), START_NS - 1)
    loop.run(0.1)

    assert loop.motion.path_refusal == (
        "path 2 is refused: it rests on an earlier exposure than the last path"
    )
    assert loop.motion.doing.path_number == 1
    assert loop.motion.doing.state == "moving"
    loop.motion.silence("the clock of the robot's host was set")
    loop.follow(leaving(loop.line, loop.s_rad + 0.3, UP), stamp_ns - 10**9)
    loop.run(0.1)
    assert loop.motion.doing.path_number == 3


def test_path_ahead_of_the_clock_is_refused_and_refuses_no_later_one():
    """Cameras whose clock was ahead for a moment do not keep the arm from all paths after it."""
    loop = Loop()
    loop.run(0.8)

    loop.follow(leaving(loop.line, loop.s_rad + 0.3, UP), loop.now_ns + 3600 * 10**9)
    refusal = loop.motion.path_refusal
    loop.follow(leaving(loop.line, loop.s_rad + 0.3, UP))
    loop.run(4.0)

    assert refusal == "path 2 is refused: it rests on images 3600000 ms ahead of this host's clock"
    np.testing.assert_allclose(loop.motion.q_rad, UP, atol=1e-9)


def test_path_that_turns_at_its_beginning_is_gone_over_to_at_rest():
    """Only a path that leads straight on can be gone over to while the arm moves."""
    loop = Loop()
    loop.run(0.4)
    away = loop.line.at(loop.s_rad + 0.6)[0][0]

    loop.follow([away, UP])
    loop.run(4.0)

    assert min(np.linalg.norm(dq) for _, dq in loop.states[50:200]) == 0.0
    np.testing.assert_allclose(loop.motion.q_rad, UP, atol=1e-9)


def test_arm_changes_its_path_again_before_the_first_change():
    """Three paths in a row; what lies behind the arm is forgotten."""
    loop = Loop()
    loop.run(0.7)
    first = loop.line
    second = leaving(first, loop.s_rad + 0.3, UP)
    loop.follow(second)
    loop.run(0.02)
    joined = loop.line
    third = leaving(joined, joined.straight_rad(loop.s_rad + 0.5), RIGHT)

    loop.follow(third)
    loop.run(CYCLE_S)
    pieces = len(loop.line.pieces)
    loop.run(5.0)

    assert pieces == 3
    np.testing.assert_allclose(loop.motion.q_rad, RIGHT, atol=1e-9)
    loop.check(first, JointPath(second), JointPath(third))


@pytest.mark.parametrize("seed", range(6))
def test_joined_path_is_both_paths(seed):
    """Its derivatives are continuous where it goes over; it is straight where they are."""
    draw = np.random.default_rng(seed)
    first = JointPath(drawn(draw, 3 + seed % 3))
    from_rad, to_rad = 0.2, first.straight_rad(0.6 * first.length_rad)
    second = JointPath(leaving(first, to_rad, *drawn(draw, 2)))

    both = JoinedPath(first, from_rad, to_rad, second)

    assert both.length_rad == pytest.approx(to_rad - from_rad + second.length_rad)
    s = np.linspace(0.0, both.length_rad, 50_001)
    q, dq, ddq = both.at(s)
    step = s[1] - s[0]
    np.testing.assert_allclose(np.gradient(q, step, axis=0)[1:-1], dq[1:-1], atol=1e-5)
    np.testing.assert_allclose(np.gradient(dq, step, axis=0)[1:-1], ddq[1:-1], atol=2e-2)
    np.testing.assert_allclose(q[[0, -1]], [first.at(from_rad)[0][0], second.waypoints[-1]])
    for place in np.linspace(0.0, both.length_rad, 40):
        straight = both.straight_rad(place)
        assert straight >= place - 1e-12
        assert np.abs(both.at(straight)[2]).max() < 1e-6
        assert both.nearest_rad(both.at(place)[0][0], place - 0.1) == pytest.approx(place, abs=1e-5)


@pytest.mark.parametrize("beside", [np.eye(7)[1] * 0.1, np.zeros(7)], ids=["gap", "kink"])
def test_paths_that_do_not_lead_into_each_other_are_not_joined(beside):
    """A gap or a kink would be a jump."""
    first = JointPath(np.stack([LEFT, RIGHT]))
    second = JointPath(np.stack([first.at(0.5)[0][0] + beside, UP]))

    with pytest.raises(ValueError, match="does not lead straight into"):
        JoinedPath(first, 0.0, 0.5, second)


@pytest.mark.parametrize("seed", range(4))
def test_arm_never_comes_farther_than_is_counted_on(seed):
    """`reached_rad` is an upper bound at any moment of a path, whatever limit held before."""
    draw = np.random.default_rng(seed)
    along = speeds(JointPath(drawn(draw, 4)))
    follower = PathFollower(along, braking_m_s2=BRAKING_M_S2)
    bounds = []
    for cycle in range(1500):
        bounds.append(along.reached_rad(follower.s_rad, follower.speed_rad_s, 0.2))
        follower.step([math.inf, 0.4][cycle // 70 % 2])
        if cycle >= 19:
            assert follower.s_rad <= bounds[cycle - 19] + 1e-3
    assert follower.arrived
