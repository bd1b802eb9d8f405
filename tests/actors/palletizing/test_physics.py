"""Claims about the simulated cell with physics, on exact cases."""

import dataclasses

import numpy as np
import pytest

from actors.geometry.arms.kinematics import tool_poses
from actors.geometry.poses import on_tray
from actors.palletizing.control.controller import ControllerError
from actors.palletizing.simulation.cell.arm import CYCLE_S
from actors.palletizing.simulation.cell.scene import (
    ARM,
    BELT_M_S,
    HOME_RAD,
    TABLE_M,
    centre_of_mass,
)
from actors.palletizing.simulation.physical_packages import Spread, draw_packages
from actors.palletizing.simulation.physics import PhysicalCell

from .moves import Hand, above, carton, on_belt

pytest.importorskip("open3d", exc_type=ImportError)
pytest.importorskip("mujoco", exc_type=ImportError)

G = 9.81


# The gripper


def test_held_firmly_does_not_slip():
    """A carton of 0.5 kg held with 45 N stays in the hand at 6 rad/s², within a millimetre."""
    hand = Hand([carton()])
    hand.cell.put(0, on_belt())
    hand.grasp(0.38, 0.62, 45.0)
    before = hand.tool_from(0)

    hand.swing(6.0, 0.8)

    hand.cell.step(50)
    assert hand.package(0).where == "held"
    assert np.linalg.norm((hand.tool_from(0) - before)[:3, 3]) < 1e-3
    assert [event.kind for event in hand.cell.truth().events] == ["grasped"]
    assert hand.package(0).dents == ()


def test_carried_fast_does_not_creep():
    """A carton that is carried past the arm at 0.8 m/s stays in the hand within 1.5 mm.

    MuJoCo's contacts alone let it slip by 8 mm: they know nothing of a hand that turns.
    """
    hand = Hand([carton(friction=0.3, contact_s=0.014)])
    hand.cell.put(0, on_belt())
    hand.grasp(0.38, 0.62, 45.0)
    hand.to(above(0.45, 0.40, 0.24), 1.0)
    before = hand.tool_from(0)

    for step in range(1, 51):
        hand.to(above(0.45, 0.40 - 0.016 * step, 0.24), 0.02)

    slip_m = np.linalg.norm((hand.tool_from(0) - before)[:3, 3])
    assert hand.package(0).where == "held"
    assert slip_m < 1.5e-3


def test_held_weakly_is_lost():
    """With 5 N and a friction of 0.4 the same carton stays behind: 4 N do not carry 4.9 N."""
    hand = Hand([carton()])
    hand.cell.put(0, on_belt())

    hand.grasp(0.38, 0.62, 5.0)

    assert hand.package(0).where == "belt"
    assert hand.package(0).lost == 1
    assert [event.kind for event in hand.cell.truth().events] == ["grasped", "lost"]


def test_closing_beside_a_package_misses_it():
    """Fingers that close on nothing stop at their end, and the truth names what was near."""
    hand = Hand([carton()])
    hand.cell.put(0, on_belt())

    hand.grasp(0.38, 0.44, 45.0)

    assert hand.arm.measured().width_m == pytest.approx(0.065, abs=5e-4)
    assert hand.package(0).missed == 1
    assert hand.package(0).where == "belt"


def test_opening_releases():
    """What is put down and released counts as released, not lost, and lies where it was put."""
    hand = Hand([carton()])
    hand.cell.put(0, on_belt())
    hand.grasp(0.38, 0.62, 45.0)
    hand.to(above(0.50, 0.15, 0.20), 1.5)
    hand.to(above(0.50, 0.15, 0.036), 1.0)

    hand.arm.grip_width(0.12, 30.0)
    hand.cell.step(150)

    package = hand.package(0)
    assert (package.where, package.lost, package.tipped) == ("tray", 0, False)
    assert [event.kind for event in hand.cell.truth().events] == ["grasped", "released"]
    np.testing.assert_allclose(package.base_from_product[:3, 3], [0.52, 0.15, TABLE_M], atol=3e-3)


def test_width_and_force_are_measured():
    """Closed on a carton, the gripper reports its width and the force that was asked for."""
    hand = Hand([carton()])
    hand.cell.put(0, on_belt())
    open_m = hand.arm.measured().width_m

    hand.grasp(0.38, 0.62, 45.0)

    measured = hand.arm.measured()
    assert open_m == pytest.approx(0.135, abs=5e-4)
    assert measured.width_m == pytest.approx(0.095, abs=1e-3)
    assert measured.grip_force_n == pytest.approx(45.0, abs=0.5)
    assert abs(measured.width_rate_m_s) < 1e-3


@pytest.mark.parametrize("weight_kg", [0.3, 0.7])
def test_wrist_carries_the_weight(weight_kg):
    """The wrist's force grows by the weight of what is lifted, along the tool's z, down."""
    hand = Hand([carton(mass_kg=weight_kg)])
    hand.cell.put(0, on_belt())
    hand.to(above(0.40, 0.62, 0.25), 1.2)
    hand.cell.step(50)
    empty = np.mean([(hand.cell.step(), hand.arm.measured().wrench)[1] for _ in range(50)], axis=0)

    hand.grasp(0.38, 0.62, 60.0)
    hand.cell.step(100)
    full = np.mean([(hand.cell.step(), hand.arm.measured().wrench)[1] for _ in range(50)], axis=0)

    np.testing.assert_allclose((full - empty)[:3], [0.0, 0.0, weight_kg * G], atol=0.1)


# Damage


def test_press_dents_above_the_yield_only():
    """A finger that presses on the top with 20 N leaves nothing; the dent of 100 N is as ruled."""
    hand = Hand([carton()])
    hand.cell.put(0, on_belt())
    hand.arm.grip_width(0.066, 50.0)
    hand.to(above(0.40, 0.62, 0.092), 1.5)
    hand.cell.step(25)
    tare_n = hand.arm.measured().wrench[2]

    def press_until(force_n):
        z_m = tool_poses(ARM, hand.q)[0, 2, 3] - TABLE_M
        while tare_n - hand.arm.measured().wrench[2] < force_n:
            z_m -= 1e-4
            hand.to(above(0.40, 0.62, z_m), 0.02)

    press_until(20.0)
    light = hand.package(0).dents
    press_until(100.0)
    dents = hand.package(0).dents

    assert light == ()
    assert {dent.face for dent in dents} == {"top"}
    assert {dent.by for dent in dents} <= {"left", "right"}
    deepest = max(dents, key=lambda dent: dent.depth_mm)
    assert deepest.depth_mm == pytest.approx((deepest.force_n - 40.0) / 5.0)
    assert 50.0 < deepest.force_n < 110.0
    assert deepest.at_m[2] == pytest.approx(0.07, abs=2e-3)


# Belt


def test_belt_reaches_its_speed_and_stops_without_drift():
    """A package moves with 0.25 m/s, stops in the light barrier and stays there, unturned."""
    cell = PhysicalCell([carton()], seed=1)
    cell.feed()
    cell.run_belt()
    cell.step(150)

    along = cell.pose(0)[0, 3]
    cell.step(100)
    speed = (cell.pose(0)[0, 3] - along) / (100 * CYCLE_S)
    while not cell.arrived():
        cell.step()
        assert cell.time_s < 6.0
    cell.step(100)
    stopped = cell.pose(0)
    cell.step(250)

    assert speed == pytest.approx(BELT_M_S, abs=0.002)
    assert np.abs(cell.pose(0) - stopped).max() < 1e-5
    head = (cell.pose(0) @ [0.1, 0.0, 0.0, 1.0])[0]
    assert head == pytest.approx(0.45, abs=0.03)


def test_belt_stopped_by_hand_stops():
    """A belt that is stopped has nothing in its light barrier, and goes on when it is run."""
    cell = PhysicalCell([carton()], seed=1)
    cell.feed()
    cell.run_belt()
    cell.step(100)

    cell.stop_belt()
    cell.step(100)
    along = cell.pose(0)[0, 3]
    cell.step(50)
    stood = cell.pose(0)[0, 3]
    cell.run_belt()
    cell.step(50)

    assert not cell.arrived()
    assert stood == pytest.approx(along, abs=1e-5)
    assert cell.pose(0)[0, 3] > stood + 0.02


def test_packages_come_one_after_the_other():
    """No package comes onto another, and none after the last; both are one line."""
    cell = PhysicalCell(2, seed=1)
    assert cell.feed() == 0

    with pytest.raises(ControllerError, match="package 1 cannot come: package 0 stands"):
        cell.feed()
    cell.run_belt()
    cell.step(300)
    assert cell.feed() == 1
    with pytest.raises(ControllerError, match="all 2 packages have come"):
        cell.feed()


def test_failures_show_and_end():
    """The belt stands and goes on, the gripper lets go, measurements and pictures stand still."""
    cell = PhysicalCell([carton()], seed=1)
    cell.feed()
    cell.run_belt()
    cell.step(100)
    cell.fail("belt", 0.8)
    cell.step(150)
    along = cell.pose(0)[0, 3]
    cell.step(40)
    assert cell.pose(0)[0, 3] == pytest.approx(along, abs=1e-5)
    cell.step(60)
    assert cell.pose(0)[0, 3] > along + 0.01

    cell.fail("wrist", 0.04)
    cell.fail("camera", 0.08)
    stamp_ns, seen_ns = cell.arm.measured().stamp_ns, cell.shown().stamp_ns
    cell.step(9)
    assert (cell.arm.measured().stamp_ns, cell.shown().stamp_ns) == (stamp_ns, seen_ns)
    cell.step(1)
    assert cell.arm.measured().stamp_ns == stamp_ns + 10 * 4_000_000
    assert cell.shown().stamp_ns == seen_ns
    cell.step(10)
    assert cell.shown().stamp_ns == seen_ns + 20 * 4_000_000
    with pytest.raises(ControllerError, match="the failure 'arm'; this cell has belt, gripper"):
        cell.fail("arm", 1.0)


def test_failure_waits_until_something_is_so():
    """The belt fails when it begins to move; from when to when is known."""
    cell = PhysicalCell([carton()], seed=1)
    cell.feed()
    cell.fail("belt", 0.4, "running")
    cell.step(50)
    assert cell.failures() == {}
    cell.run_belt()
    cell.step(3)
    ((began_s, ends_s),) = cell.failures().values()
    along = cell.pose(0)[0, 3]
    while cell.time_s < ends_s:
        cell.step()
    assert cell.pose(0)[0, 3] == pytest.approx(along, abs=5e-3)
    cell.step(100)
    assert cell.pose(0)[0, 3] > along + 0.02
    assert (began_s, ends_s) == (pytest.approx(0.204, abs=0.009), pytest.approx(began_s + 0.4))
    with pytest.raises(ControllerError, match="the moment 'soon'; this cell has none, carried"):
        cell.fail("belt", 1.0, "soon")


def test_gripper_that_fails_loses_its_package():
    """It opens in the air, and closes on nothing afterwards."""
    hand = Hand([carton()])
    hand.cell.put(0, on_belt())
    hand.grasp(0.38, 0.62, 45.0)
    hand.cell.fail("gripper", 0.3)
    hand.cell.step(75)
    opened_m = hand.arm.measured().width_m
    hand.cell.step(150)

    assert opened_m > 0.12
    assert hand.package(0).lost == 1
    assert hand.arm.measured().width_m < 0.07


# The truth


def test_pose_is_that_of_the_product_at_once():
    """A pose set by hand is true before the next step, though MuJoCo moves a mesh's geom."""
    cell = PhysicalCell([carton()], seed=1)
    pose = on_belt(0.3, 0.6, 0.4)

    cell.put(0, pose)

    truth = cell.truth().packages[0]
    np.testing.assert_allclose(truth.base_from_product, pose, atol=1e-12)
    geom = cell.data.geom("package0").xpos
    assert np.linalg.norm(geom - pose[:3, 3]) > 0.03, "the geom is not where the product frame is"


def test_truth_says_where_a_package_is():
    """Every place has its name; what leans by more than 5° has tipped."""
    cell = PhysicalCell([carton(n) for n in range(6)], seed=1)
    layout = cell.layout
    tilted = np.eye(4)
    tilted[:3, :3] = [[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]
    tilted[:3, 3] = 0.0, 0.0, 0.049

    cell.put(0, layout.base_from_tray @ on_tray(-0.1, 0.0, 0.0))
    cell.put(1, on_belt())
    cell.put(2, layout.base_from_bin)
    cell.put(3, layout.base_from_tray @ on_tray(0.2, 0.1, 0.0) @ tilted)
    beside = on_tray(-0.6, -0.5, 0.0)
    beside[2, 3] = TABLE_M - 0.12
    cell.put(4, beside)
    cell.step(100)

    packages = cell.truth().packages
    assert [package.where for package in packages] == [
        "tray", "belt", "bin", "tray", "beside", "coming",
    ]  # fmt: skip
    assert [package.tipped for package in packages] == [False, False, False, True, False, False]
    shift_m, turn_rad = packages[0].beside_plan(on_tray(-0.1, 0.003, 0.02))
    assert shift_m == pytest.approx(0.003, abs=2e-4)
    assert turn_rad == pytest.approx(0.02, abs=1e-3)
    assert cell.change_tray() == [0, 3]
    assert [package.where for package in cell.truth().packages[:4]] == [
        "away",
        "belt",
        "bin",
        "away",
    ]


def test_nothing_moves_that_nothing_moves():
    """Packages at rest on the tray stay within 50 µm for two seconds, those to come in place."""
    cell = PhysicalCell(4, seed=5)
    for number, x in enumerate((-0.3, 0.0, 0.3)):
        cell.put(number, cell.layout.base_from_tray @ on_tray(x, 0.1, 0.3))
    cell.step(100)
    before = [cell.pose(number) for number in range(3)]

    cell.step(500)

    for number in range(3):
        assert np.abs(cell.pose(number) - before[number])[:3, 3].max() < 5e-5
    assert [package.dents for package in cell.truth().packages] == [()] * 4


def test_same_commands_give_the_same_truth():
    """Two cells of one seed that get the same commands agree in every bit; another seed differs."""

    def run(seed):
        cell = PhysicalCell(2, seed=seed)
        cell.feed()
        cell.run_belt()
        cell.arm.start()
        for cycle in range(300):
            cell.arm.command(np.array(HOME_RAD) + 0.1 * np.sin(cycle * CYCLE_S * 4.0))
            if cycle == 150:
                cell.arm.grip_force(30.0)
            cell.step()
        return cell.pose(0), cell.arm.measured()

    (pose, measured), (again, measured_again), (other, _) = run(3), run(3), run(4)

    np.testing.assert_array_equal(pose, again)
    for field in dataclasses.fields(measured):
        one, two = getattr(measured, field.name), getattr(measured_again, field.name)
        np.testing.assert_array_equal(one, two)
    assert not np.array_equal(pose, other)


def test_packages_are_a_function_of_the_seed():
    """They keep the spread, and a longer sequence begins with the shorter one."""
    spread = Spread()

    few, many = draw_packages(3, seed=9), draw_packages(200, seed=9)

    assert few == many[:3]
    assert few != draw_packages(3, seed=10)
    friction = [package.friction for package in many]
    assert 0.2 <= min(friction) < 0.25
    assert 0.55 < max(friction) <= 0.6
    masses = [package.mass_kg for package in many if package.product == "milk_carton"]
    assert 0.35 <= min(masses) < 0.38
    assert 0.62 < max(masses) <= 0.65
    picked = np.std([package.pick_offset_m for package in many])
    assert picked == pytest.approx(spread.pick_m, rel=0.15)
    with pytest.raises(ValueError, match="no product 'brick'; there are milk_carton"):
        draw_packages(1, seed=1, products=["brick"])


def test_centre_of_mass_is_that_of_the_shape():
    """A carton's is that of a block of 150 mm and a wedge of 50 mm, at half its height."""
    block, wedge = 0.150 * 0.095 * 0.070, 0.050 * 0.095 * 0.070 / 2.0
    along = (block * -0.025 + wedge * (0.050 + 0.050 / 3.0)) / (block + wedge)

    np.testing.assert_allclose(centre_of_mass("milk_carton"), [along, 0.0, 0.035], atol=1e-9)
