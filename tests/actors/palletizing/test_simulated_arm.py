"""Claims about the controller of the simulated arm, on exact cases."""

import itertools

import numpy as np
import pytest

from actors.geometry.arms.kinematics import tool_poses
from actors.palletizing.control.controller import ControllerError, open_controller
from actors.palletizing.simulation.cell.arm import CYCLE_S, DDDQ_MAX, DDQ_MAX, JointLimiter
from actors.palletizing.simulation.cell.scene import (
    ARM,
    HOME_RAD,
)
from actors.palletizing.simulation.physics import PhysicalCell

from .moves import Hand, carton, on_belt

pytest.importorskip("open3d", exc_type=ImportError)
pytest.importorskip("mujoco", exc_type=ImportError)


def test_commands_are_limited():
    """A position far away is reached within the limits of speed, acceleration and jerk."""
    cell = PhysicalCell([carton()], seed=1)
    cell.arm.start()
    goal = np.add(HOME_RAD, [-1.2, 0.3, 0.4, 0.3, -0.5, -0.4, 1.0])
    told = []

    for _ in range(600):
        cell.arm.command(goal)
        cell.step()
        limiter = cell.arm.limiter
        told.append((limiter.q_rad, limiter.dq_rad_s, limiter.ddq_rad_s2))

    q, dq, ddq = (np.array(values) for values in zip(*told, strict=True))
    assert (np.abs(dq).max(0) <= ARM.dq_max + 1e-9).all()
    assert (np.abs(ddq).max(0) <= DDQ_MAX + 1e-9).all()
    assert (np.abs(np.diff(ddq, axis=0)).max(0) <= DDDQ_MAX * CYCLE_S + 1e-6).all()
    np.testing.assert_allclose(q[-1], goal, atol=1e-6)
    measured = cell.arm.measured()
    np.testing.assert_allclose(measured.q, goal, atol=2e-4)
    np.testing.assert_allclose(measured.tcp, tool_poses(ARM, measured.q)[0], atol=1e-9)


def test_smooth_commands_are_followed():
    """What keeps the limits is followed within 2 mrad, with no more acceleration than it has."""
    cell = PhysicalCell([carton()], seed=1)
    cell.arm.start()
    errors, accelerations = [], []

    for cycle in range(500):
        goal = np.array(HOME_RAD) + 0.2 * (1.0 - np.cos(3.0 * cycle * CYCLE_S))
        cell.arm.command(goal)
        cell.step()
        errors.append(np.abs(cell.arm.measured().q - goal).max())
        accelerations.append(np.abs(cell.arm.limiter.ddq_rad_s2).max())

    measured = cell.arm.measured()
    assert np.abs(measured.dq).max() > 0.05
    np.testing.assert_allclose(measured.tcp, tool_poses(ARM, measured.q)[0], atol=1e-9)
    assert max(errors) < 4e-3
    assert max(accelerations[20:]) < 1.3 * 0.2 * 3.0**2 + 0.5


@pytest.mark.parametrize("kept_out", [0, 7])
def test_limiter_catches_up_after_commands_beyond_its_limits(kept_out):
    """Speed that begins at once, or after some lost commands, is followed exactly soon after."""
    limiter, q = JointLimiter(np.array(HOME_RAD)), np.array(HOME_RAD)
    speed = np.array([0.8, -0.5, 0.3, 0.2, 0.0, 0.4, -0.6])
    behind, told = [], []

    for cycle in range(250):
        q = q + speed * CYCLE_S * min(1.0, max(0.0, (240 - cycle) / 90.0))
        if cycle < 100 or cycle >= 100 + kept_out:
            limiter.aim(q)
        limiter.advance(braking=False)
        behind.append(np.abs(limiter.q_rad - q).max())
        told.append((limiter.dq_rad_s, limiter.ddq_rad_s2))

    dq, ddq = (np.array(values) for values in zip(*told, strict=True))
    assert max(behind) > 0.01, "the stream is beyond the limits"
    assert behind[99] < 1e-9, "it has caught up with the first"
    assert behind[149] < 1e-9, "and after the gap"
    assert behind[-1] < 1e-9
    assert (np.abs(dq).max(0) <= ARM.dq_max + 1e-9).all()
    assert (np.abs(ddq).max(0) <= DDQ_MAX + 1e-9).all()
    assert (np.abs(np.diff(ddq, axis=0)).max(0) <= DDDQ_MAX * CYCLE_S + 1e-6).all()


def test_arm_without_commands_comes_to_rest():
    """An arm whose commands stay away in the middle of a motion stops by itself, near by."""
    cell = PhysicalCell([carton()], seed=1)
    cell.arm.start()
    q = np.array(HOME_RAD)
    for _ in range(100):
        q = q + np.array([0.8 * CYCLE_S, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
        cell.arm.command(q)
        cell.step()

    cell.step(200)

    measured = cell.arm.measured()
    assert np.abs(measured.dq).max() < 2e-3
    assert np.abs(measured.q - q).max() < 0.02


def test_brake_stops_and_holds():
    """A braked arm stops at once, keeps what it holds, and takes commands after a start only."""
    hand = Hand([carton()])
    hand.cell.put(0, on_belt())
    hand.grasp(0.38, 0.62, 45.0)
    q = hand.q
    for cycle in range(100):
        speed = min(0.8, 4.0 * cycle * CYCLE_S)
        q = q - np.array([speed * CYCLE_S, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
        hand.send(q)

    hand.arm.brake()
    hand.cell.step(round(0.8 / DDQ_MAX[0] / CYCLE_S) + 10)
    told = hand.arm.limiter.dq_rad_s
    hand.cell.step(100)

    measured = hand.arm.measured()
    assert np.abs(told).max() < 1e-9
    assert np.abs(measured.dq).max() < 5e-3
    assert abs(measured.q[0] - q[0]) < 0.8**2 / 2.0 / DDQ_MAX[0] + 0.02
    assert hand.package(0).where == "held"
    with pytest.raises(ControllerError, match=r"braked .* call start\(\) first"):
        hand.arm.command(q)
    hand.arm.start()
    hand.arm.command(measured.q)
    hand.cell.step(50)
    assert hand.package(0).where == "held"


def test_impossible_commands_are_one_line():
    """A position out of range, a width or a force that the gripper has not: named with its limit."""
    arm = PhysicalCell([carton()], seed=1).arm
    arm.start()

    with pytest.raises(ControllerError, match=r"joint 2 at 143.2°; its range is ±120°"):
        arm.command(np.array([0.0, 2.5, 0.0, 0.0, 0.0, 0.0, 0.0]))
    with pytest.raises(ControllerError, match="seven finite numbers"):
        arm.command(np.array([0.0, np.nan, 0.0, 0.0, 0.0, 0.0, 0.0]))
    with pytest.raises(ControllerError, match=r"asked for 140.0 mm .* opens from 65 to 135 mm"):
        arm.grip_width(0.14, 20.0)
    with pytest.raises(
        ControllerError, match="grip of 300 N; this gripper presses with up to 100 N"
    ):
        arm.grip_force(300.0)


@pytest.mark.parametrize(
    ("address", "text"),
    [
        ("actors.palletizing", "is no controller; write MODULE:FUNCTION"),
        ("actors.palletizing.nowhere:arm", "no controller at"),
        ("actors.palletizing.control.controller:ControllerError?hue=3", "refuses its values"),
    ],
)
def test_wrong_addresses_are_one_line(address, text):
    """An address that leads nowhere says why."""
    with pytest.raises(ValueError, match=text) as caught:
        open_controller(address)
    assert "\n" not in str(caught.value)


def test_stamps_are_simulated_time():
    """Each cycle's measurement is 4 ms younger than the one before, from the epoch on."""
    cell = PhysicalCell([carton()], seed=1, epoch_ns=7_000_000_000)
    stamps = [cell.arm.measured().stamp_ns]

    for _ in range(5):
        cell.step()
        stamps.append(cell.arm.measured().stamp_ns)

    assert stamps[0] == 7_000_000_000
    assert {late - early for early, late in itertools.pairwise(stamps)} == {4_000_000}
