"""Paths with rounded corners; a parameter that keeps to them and to every limit."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from actors.geometry.arms.joint_paths import JointPath, PathFollower, PathSpeeds
from actors.geometry.arms.kinematics import capsules_at
from actors.workcell.simulation.arm import ARM

BRAKING_M_S2 = 6.0


def drawn(seed, points=4):
    """Return a path through random waypoints within the limits of the joints."""
    draw = np.random.default_rng(seed)
    return JointPath(draw.uniform(-0.8, 0.8, (points, 7)) * ARM.q_max)


def quickest_m(one, other):
    """Return how far the quickest capsule end is between two states."""
    ends = capsules_at(ARM, np.stack([one, other]))[..., :6].reshape(2, -1, 3)
    return np.linalg.norm(ends[1] - ends[0], axis=1).max()


@pytest.mark.parametrize("seed", range(6))
def test_derivatives_are_those_of_the_path(seed):
    """Both derivatives are continuous and what differences give; |q'| is at most 1."""
    path = drawn(seed, points=2 + seed)
    s = np.linspace(0.0, path.length_rad, 100_001)

    q, dq, ddq = path.at(s)

    step = s[1] - s[0]
    np.testing.assert_allclose(np.gradient(q, step, axis=0)[1:-1], dq[1:-1], atol=1e-6)
    np.testing.assert_allclose(np.gradient(dq, step, axis=0)[1:-1], ddq[1:-1], atol=1e-2)
    assert np.linalg.norm(dq, axis=1).max() <= 1.0 + 1e-12
    np.testing.assert_allclose(q[[0, -1]], path.waypoints[[0, -1]], atol=1e-9)


def test_path_stays_near_its_waypoints():
    """A corner is cut by less than three sixteenths of its width, straight pieces not at all."""
    corner = JointPath(np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]]))

    q = corner.states(0.0, corner.length_rad, 0.01)

    assert corner.length_rad == pytest.approx(2.0)
    assert np.linalg.norm(q - [1.0, 0.0], axis=1).min() == pytest.approx(0.5 * 0.1875 * 2**0.5)
    straight = (q[:, 0] < 0.5) | (q[:, 1] > 0.5)
    assert np.abs(q[straight] @ np.array([[0.0, 1.0], [1.0, 0.0]])).min(1).max() < 1.0 + 1e-9
    assert (q[q[:, 0] < 0.5, 1] == 0.0).all()
    assert (q[q[:, 1] > 0.5, 0] == 1.0).all()


def test_equal_waypoints_count_once():
    """A path of one place has no length; repeated waypoints change nothing."""
    place = np.full(7, 0.3)
    still = JointPath(np.stack([place, place]))

    assert still.length_rad == 0.0
    np.testing.assert_array_equal(still.at([0.0, 1.0])[0], [place, place])
    assert PathFollower(speeds(still), braking_m_s2=BRAKING_M_S2).arrived
    assert len(JointPath(np.array([[0.0], [0.0], [1.0], [1.0]])).waypoints) == 2


@pytest.mark.parametrize("waypoints", [np.empty((0, 7)), np.array([[np.nan]]), np.zeros(7)])
def test_waypoints_that_are_no_path_are_refused(waypoints):
    """The error shows the shape."""
    with pytest.raises(ValueError, match="waypoints of shape"):
        JointPath(waypoints)


@pytest.mark.parametrize("seed", range(4))
def test_nearest_place_is_found(seed):
    """A state of the path is found again, and so is one beside it."""
    path = drawn(seed)
    for s in np.linspace(0.0, path.length_rad, 17):
        q = path.at(s)[0][0]

        found = path.at(path.nearest_rad(q + 1e-3))[0][0]

        assert np.linalg.norm(found - q) < 0.01


def speeds(path, nominal_m_s=1.5):
    return PathSpeeds(ARM, path, nominal_m_s=nominal_m_s)


def test_reach_is_the_speed_of_the_quickest_end():
    """Turning the first joint only, the tool is quickest: its distance from the axis."""
    q = np.array([0.0, np.pi / 2, 0.0, 0.0, 0.0, 0.0, 0.0])
    there = q + np.array([0.5, 0, 0, 0, 0, 0, 0])

    reach_m = speeds(JointPath(np.stack([q, there]))).reach_m

    np.testing.assert_allclose(reach_m, 0.42 + 0.40 + 0.126 + 0.20, rtol=1e-9)


limits = st.lists(
    st.tuples(st.sampled_from([0.0, 0.05, 0.3, 1.0, 2.0, np.inf]), st.integers(1, 40)),
    min_size=1,
    max_size=30,
)


@settings(max_examples=40)
@given(st.integers(0, 200), st.integers(2, 6), limits)
def test_follower_keeps_every_limit_while_the_limit_jumps(seed, points, changes):
    """Never back, never beyond the end, joints within speed and acceleration, at last arrived."""
    path = drawn(seed, points)
    follower = PathFollower(speeds(path), braking_m_s2=BRAKING_M_S2)
    jumps = [limit for limit, cycles in changes for _ in range(cycles)]
    states = [(0.0, 0.0, 0.0)]

    for limit in itertools.chain(jumps, itertools.repeat(np.inf, 4000)):
        follower.step(limit)
        states.append((follower.s_rad, follower.speed_rad_s, follower.acceleration_rad_s2))
        if follower.arrived:
            break

    s, v, a = np.array(states).T
    assert follower.arrived
    assert s[-1] == path.length_rad
    assert (np.diff(s) >= 0.0).all()
    _, dq, ddq = path.at(s)
    assert (np.abs(dq * v[:, None]) <= 1.001 * ARM.dq_max).all()
    assert (np.abs(dq * a[:, None] + ddq * v[:, None] ** 2) <= 1.02 * ARM.ddq_max).all()


@pytest.mark.parametrize("seed", range(8))
def test_stop_takes_no_longer_than_the_separation_counts_on(seed):
    """Under a limit v the quickest end stands after v/a and the ramps, and v²/(2a) and theirs."""
    path, draw = drawn(seed), np.random.default_rng(seed)
    along = speeds(path, nominal_m_s=9.0)
    for _ in range(6):
        limit, cycles = draw.uniform(0.1, 2.0), int(draw.integers(5, 120))
        follower = PathFollower(along, braking_m_s2=BRAKING_M_S2)
        for _ in range(cycles):
            follower.step(limit)
        moved_m, took_s, before = 0.0, 0.0, path.at(follower.s_rad)[0][0]

        while follower.speed_rad_s > 0.0 and not follower.arrived:
            follower.step(0.0)
            here = path.at(follower.s_rad)[0][0]
            moved_m, took_s, before = moved_m + quickest_m(before, here), took_s + 0.01, here

        ramps_s = 0.03  # from full acceleration to full deceleration, and the cycle in it
        assert took_s <= limit / BRAKING_M_S2 + ramps_s + 1e-9
        assert moved_m <= limit**2 / (2.0 * BRAKING_M_S2) + limit * ramps_s + 1e-9


@pytest.mark.parametrize("seed", range(4))
def test_limit_is_kept_once_it_could_be_reached(seed):
    """No capsule end is quicker than a limit that has held for long enough to brake."""
    path = drawn(seed)
    follower = PathFollower(speeds(path), braking_m_s2=BRAKING_M_S2)
    limit, since = 1.5, 0
    before = path.at(0.0)[0][0]
    quicker = []
    for cycle in range(3000):
        if cycle % 60 == 59:
            lower = [1.5, 0.8, 0.4, 0.1][cycle // 60 % 4]
            since, limit = (0 if lower < limit else since), lower
        follower.step(limit)
        since += 1
        here = path.at(follower.s_rad)[0][0]
        if since > 35:
            quicker.append(quickest_m(before, here) / 0.01 - limit)
        before = here
        if follower.arrived:
            break

    assert max(quicker) <= 0.0


def test_path_can_end_earlier_where_the_arm_can_still_stop():
    """`end_at` behind the way to stop is kept to; before it, it is refused and changes nothing."""
    path = drawn(3)
    follower = PathFollower(speeds(path), braking_m_s2=BRAKING_M_S2)
    for _ in range(60):
        follower.step(np.inf)
    here = follower.s_rad

    assert follower.end_at(here + 1e-3) is False
    assert follower.end_at(here + 1.0) is True
    for _ in range(2000):
        follower.step(np.inf)

    assert follower.arrived
    assert follower.s_rad == pytest.approx(here + 1.0)
