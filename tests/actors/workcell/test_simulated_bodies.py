"""The simulated arm and people: exact poses, feet on the floor, hands at their targets, no jumps."""

import itertools
import math

import numpy as np
import pytest

from actors.geometry.arms.kinematics import capsules_at, tool_poses
from actors.geometry.capsules import bounds
from actors.workcell.scenarios import SCENARIOS, Pause, Walk, scenario_of
from actors.workcell.simulation.arm import ARM, BASE_HEIGHT_M, HOME_RAD
from actors.workcell.simulation.human import CAPSULES, HEAD, RIGHT_HAND, Person, Posture, body
from actors.workcell.simulation.stage import Stage
from actors.workcell.simulation.truth import body_of

TRUNK = slice(6, 11)


def test_stretched_arm_stands_as_high_as_its_links_are_long():
    """At zero all links point up: 0.36 + 0.42 + 0.40 + 0.126 m to the flange, 0.2 m of tool."""
    tool = tool_poses(ARM, np.zeros(7))[0]
    np.testing.assert_allclose(tool[:3, 3], [0, 0, BASE_HEIGHT_M + 1.306 + 0.2], atol=1e-12)
    np.testing.assert_allclose(tool[:3, :3], np.eye(3), atol=1e-12)


def test_arm_bent_at_the_shoulder_lies_level():
    """Joint 2 at 90° lays everything behind the shoulder along x; joint 1 turns it to y."""
    q = np.zeros(7)
    q[1] = math.pi / 2
    reach = 0.42 + 0.40 + 0.126 + 0.2
    tip = capsules_at(ARM, q)[0, -1, 3:6]
    np.testing.assert_allclose(tip, [reach, 0, BASE_HEIGHT_M + 0.36], atol=1e-12)
    q[0] = math.pi / 2
    tip = capsules_at(ARM, q)[0, -1, 3:6]
    np.testing.assert_allclose(tip, [0, reach, BASE_HEIGHT_M + 0.36], atol=1e-12)


def test_bent_elbow_brings_the_tool_down():
    """Elbow at -90° above a stretched upper arm: the forearm lies level along x."""
    q = np.zeros(7)
    q[3] = -math.pi / 2
    tip = capsules_at(ARM, q)[0, -1, 3:6]
    np.testing.assert_allclose(tip, [0.726, 0, BASE_HEIGHT_M + 0.78], atol=1e-12)


def test_home_is_within_the_limits_and_above_the_table():
    """The tip of the tool is more than 85 cm up."""
    assert (np.abs(HOME_RAD) < ARM.q_max).all()
    assert capsules_at(ARM, np.array(HOME_RAD))[0, -1, 5] > 0.85


@pytest.mark.parametrize("height_m", [1.6, 1.75, 1.9])
def test_lower_foot_stands_on_the_floor_and_the_head_at_the_height(height_m):
    """At every phase of a step the lowest point is at zero."""
    for phase in np.linspace(0.0, 2.0 * np.pi, 25):
        capsules = body(Posture(0.3, -0.2, 1.0, phase_rad=phase, swing=1.0), height_m)
        assert capsules.shape == (CAPSULES, 7)
        assert bounds(capsules)[:, 0, 2].min() == pytest.approx(0.0, abs=1e-12)
    upright = body(Posture(0.0, 0.0, 0.0), height_m)
    assert bounds(upright)[HEAD, 1, 2] == pytest.approx(height_m, abs=0.005)


def test_limbs_keep_their_lengths_while_walking():
    """No capsule becomes longer or shorter over a step."""

    def lengths(phase):
        capsules = body(Posture(0.0, 0.0, 0.0, phase_rad=phase, swing=1.0))
        return np.linalg.norm(capsules[:, 3:6] - capsules[:, :3], axis=1)

    for phase in np.linspace(0.0, 6.0, 13):
        np.testing.assert_allclose(lengths(phase), lengths(0.0), atol=1e-12)


def test_body_turns_and_moves_as_a_whole():
    """A posture elsewhere is the same one, turned and shifted."""
    posture = Posture(0.0, 0.0, 0.0, phase_rad=0.7, swing=0.8)
    here, there = body(posture), body(Posture(2.0, -1.0, math.pi / 2, phase_rad=0.7, swing=0.8))
    np.testing.assert_allclose(there[:, 0], 2.0 - here[:, 1], atol=1e-12)
    np.testing.assert_allclose(there[:, 1], -1.0 + here[:, 0], atol=1e-12)
    np.testing.assert_allclose(there[:, [2, 5, 6]], here[:, [2, 5, 6]], atol=1e-12)


@pytest.mark.parametrize("target_m", [(0.5, -0.3, 1.1), (0.45, 0.1, 1.4), (0.3, -0.4, 0.8)])
def test_hand_reaches_what_is_near_enough(target_m):
    """The right hand is at its target, and limbs keep the lengths they have at rest."""
    capsules = body(Posture(0.0, 0.0, 0.0, target_m=target_m, reach=1.0))
    np.testing.assert_allclose(capsules[RIGHT_HAND, 3:6], target_m, atol=1e-6)
    lengths = np.linalg.norm(capsules[:, 3:6] - capsules[:, :3], axis=1)
    hanging = body(Posture(0.0, 0.0, 0.0))
    expected = np.linalg.norm(hanging[:, 3:6] - hanging[:, :3], axis=1)
    np.testing.assert_allclose(lengths, expected, atol=1e-9)


def test_hand_points_at_what_is_too_far():
    """The arm is stretched towards the target, as long as it is."""
    capsules = body(Posture(0.0, 0.0, 0.0, target_m=(3.0, -0.24, 1.4), reach=1.0))
    shoulder, tip = capsules[RIGHT_HAND - 2, :3], capsules[RIGHT_HAND, 3:6]
    way, wanted = tip - shoulder, np.array([3.0, -0.24, 1.4]) - shoulder
    assert way @ wanted == pytest.approx(np.linalg.norm(way) * np.linalg.norm(wanted), rel=1e-9)
    assert np.linalg.norm(way) == pytest.approx(0.429 * 1.75, abs=2e-3)


def test_arm_that_begins_to_reach_hangs_where_it_hung():
    """No elbow jumps when the hand leaves for its target."""
    at_rest = body(Posture(0.0, 0.0, 0.0, phase_rad=0.4, swing=0.5))
    leaving = body(
        Posture(0.0, 0.0, 0.0, phase_rad=0.4, swing=0.5, target_m=(0.6, -0.2, 1.0), reach=1e-6)
    )
    np.testing.assert_allclose(leaving, at_rest, atol=1e-4)


def test_person_stands_turns_and_reaches_where_the_walk_says():
    """Absent before and after its walk; at the pause the hand is at its target."""
    pause = Pause(1, 8.0, reach_m=(0.75, -0.25, 1.0), lean_rad=0.25, facing_rad=np.pi)
    walk = Walk(((2.9, -0.9), (1.35, -0.3), (2.9, -0.9)), begin_s=2.0, pauses=(pause,))
    person = Person(walk)
    assert person.capsules_at(1.99) is None
    arrived_s = 2.0 + math.hypot(1.55, 0.6) / 1.2
    capsules = person.capsules_at(arrived_s + 5.0)
    assert np.linalg.norm(capsules[RIGHT_HAND, 3:6] - [0.75, -0.25, 1.0]) < 0.02
    assert person.capsules_at(person.end_s + 0.01) is None


@pytest.mark.parametrize("repeats", [False, True])
def test_true_velocity_is_that_of_walking_from_the_first_moment_to_the_last(repeats):
    """Also where who walks a way again starts anew, far from its end: that is no step of theirs."""
    person = Person(Walk(((0.0, 0.0), (6.0, 0.0)), begin_s=1.0, speed_m_s=1.2, repeats=repeats))
    for at_s in (1.0, 1.02, 3.0, 5.96, *((6.0, 6.02) if repeats else ())):
        found = body_of(person, at_s)
        assert found is not None
        assert found.velocity_m_s[0] == pytest.approx(1.2, abs=0.8)
        assert abs(found.velocity_m_s[1]) < 0.1


@pytest.mark.parametrize("name", SCENARIOS)
def test_scenarios_repeat_by_seed_and_nobody_jumps(name):
    """Same seed, same bodies; no trunk is faster than 2.5 m/s, no foot than 6."""
    one, other, third = (
        [Person(walk) for walk in scenario_of(name, seed, 20.0).walks] for seed in (3, 3, 4)
    )
    for person, again, different in zip(one, other, third, strict=True):
        times = np.arange(person.begin_s + 0.01, min(person.end_s, 20.0) - 0.02, 0.02)
        path = np.stack([person.capsules_at(at_s) for at_s in times])
        np.testing.assert_array_equal(path[7], again.capsules_at(times[7]))
        assert (path[7] != different.capsules_at(times[7])).any()
        inside = [
            k
            for k, k1 in itertools.pairwise(range(len(path)))
            if np.abs(path[[k, k1], 8, :2]).max() < 2.4
        ]
        speed = np.linalg.norm(np.diff(path[:, :, :3], axis=0), axis=2)[inside] / 0.02
        assert speed[:, TRUNK].max(initial=0.0) < 2.5
        assert speed.max(initial=0.0) < 6.0
        assert np.abs(path[:, :, 2]).max() < 2.0


@pytest.mark.parametrize("name", SCENARIOS)
def test_nobody_walks_through_what_stands_there(name):
    """A sleeve may brush an edge; bodies stay out of boxes by all but 8 cm."""
    stage = Stage(scenario_of(name, 4, 60.0))
    for at_s in np.arange(0.0, 60.0, 0.4):
        for capsules in stage.bodies_at(at_s).values():
            share = np.linspace(0.0, 1.0, 4)[:, None, None]
            axes = capsules[:, :3] + share * (capsules[:, 3:6] - capsules[:, :3])
            for box in stage.boxes + stage.things_at(at_s):
                beyond = np.abs(axes - np.array(box.centre_m)) - np.array(box.half_m)
                outside = np.linalg.norm(np.maximum(beyond, 0.0), axis=-1)
                depth = capsules[:, 6] - outside - np.minimum(beyond.max(-1), 0.0)
                assert depth.max() < 0.08, (box.name, at_s)
