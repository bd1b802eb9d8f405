"""Each skeleton and each trap of manipulation as an exact case, in physics.

One cell for all: each test puts the packages it needs, and takes them away again.
"""

import dataclasses

import numpy as np
import pytest

from actors.geometry.poses import coordinates, on_tray
from actors.palletizing.control.execution import Executor
from actors.palletizing.handling.grounding import PUSH_GAP_M, Job, easier_turn, ground
from actors.palletizing.placing.finger_room import Grasp, Gripper
from actors.palletizing.simulation.cell.scene import ARM, HOME_RAD, TABLE_M
from actors.palletizing.simulation.physics import PhysicalCell

from .moves import carton
from .sound_nets import axes, net, primitive, way

pytest.importorskip("mujoco", exc_type=ImportError)

WIDTH_M, LENGTH_M = 0.095, 0.200
GRASP = Grasp(np.array([0.0, 0.0, 0.04]), np.array([0.0, 1.0, 0.0]), WIDTH_M, 45.0, 0.03, 0.5)
PUSH = np.array([0.0, -1.0, 0.0])
FAILED = way("failed", "force > 90")
WALL_Y_M = -0.45
"""Where the rim of the tray is, to which packages are pushed."""


class Worker:
    """Executes nets in a stepped cell."""

    def __init__(self, count=4):
        self.cell = PhysicalCell([carton(number) for number in range(count)], seed=3)
        self.cell.arm.start()
        self.frames = {
            "bin": self.cell.layout.base_from_bin,
            "belt": self.cell.layout.base_from_belt,
        }
        self.turned, self._last = False, None

    def put(self, number, x_m, y_m, yaw_rad=0.0):
        """Put a package on the table, let it settle, see it exactly."""
        pose = on_tray(x_m, y_m, yaw_rad)
        pose[2, 3] = TABLE_M
        self.cell.replace(number, pose)
        self.cell.step(60)
        self.see(number)

    def see(self, number, *, beside_m=(0.0, 0.0)):
        """Let the nets know where a package is, or beside that."""
        pose = self.cell.pose(number)
        pose[:2, 3] += beside_m
        self.frames[f"package/{number}"] = pose

    def plan(self, x_m, y_m, *, z_m=TABLE_M):
        pose = on_tray(x_m, y_m, 0.0)
        pose[2, 3] = z_m
        self.frames["place/1"] = pose
        return pose

    def ground(self, skeleton, number, **changes):
        job = Job(
            f"package/{number}", GRASP, np.array([LENGTH_M, WIDTH_M, 0.07]),
            "place/1" if "place/1" in self.frames else "", PUSH, "bin", self.turned,
        )  # fmt: skip
        near = self.cell.arm.measured().q if self._last is None else self._last
        known = {"arm": ARM, "frames": self.frames.__getitem__, "near_rad": near}
        if skeleton in {"grasp_from_belt", "regrasp"}:
            self.turned = easier_turn(job, **known)
        job = dataclasses.replace(job, turned=self.turned, **changes)
        return ground(skeleton, job, gripper=Gripper(), **known)

    def run(self, going, each=None):
        """Execute a net; return the executor."""
        executor = Executor(
            going, ARM, self.frames.__getitem__, posture_rad=np.array(HOME_RAD), from_rad=self._last
        )
        for _ in range(10_000):
            command = executor.step(self.cell.arm.measured(), self.cell.time_s)
            self._last = command.q
            self.cell.arm.command(command.q)
            if command.grip is not None and command.grip.kind == "width":
                self.cell.arm.grip_width(command.grip.value, 40.0)
            elif command.grip is not None:
                self.cell.arm.grip_force(command.grip.value)
            self.cell.step()
            if each is not None:
                each(executor)
            if command.result and command.at_rest:
                return executor
        raise AssertionError(f"{going.name} runs for ever: {executor.trace}")

    def do(self, number, *skeletons):
        """Ground and execute skeletons until one fails; return the last result."""
        for skeleton in skeletons:
            going = self.ground(skeleton, number)
            result = self.run(going).result
            if not going.outcome(result):
                break
        return result

    def truth(self, number):
        return self.cell.truth().packages[number]

    def off(self, number, plan):
        """Return how far a package is from a pose: mm in x, y, z, degrees in roll, pitch, yaw."""
        off = coordinates(plan, self.cell.pose(number))
        return np.concatenate((1e3 * off[:3], np.degrees(off[3:])))

    def clear(self):
        up = axes(z=("velocity", 0.4))
        self.run(net({"up": primitive(way("done", "distance > 0.15"), FAILED, axes=up)}))
        for truth in self.cell.truth().packages:
            self.cell.take_away(truth.number)
        self.cell.arm.grip_width(0.12, 40.0)
        self.cell.step(50)


@pytest.fixture(scope="module")
def shared():
    return Worker()


@pytest.fixture
def worker(shared):
    yield shared
    shared.clear()


BELT = (0.42, 0.62, 0.03)
FIRST = (0.58, WALL_Y_M + 0.5 * WIDTH_M + 0.001)
SECOND = (0.58, FIRST[1] + WIDTH_M + 0.0005)


def test_package_comes_from_the_belt_into_contact_with_its_neighbour(worker):
    """Grasped, placed, pushed: on its plan within 3 mm and 1.5°, 1 mm from the neighbour, unhurt."""
    worker.put(0, *FIRST)
    neighbour = worker.cell.pose(0)
    worker.put(1, *BELT)
    plan = worker.plan(*SECOND)

    result = worker.do(1, "grasp_from_belt", "place", "push_into_contact")

    off = worker.off(1, plan)
    assert result == "in_contact"
    assert np.linalg.norm(off[:2]) < 3.0
    assert abs(off[5]) < 1.5
    assert abs(off[2]) < 0.5
    gap_mm = 1e3 * (worker.cell.pose(1)[1, 3] - worker.cell.pose(0)[1, 3] - WIDTH_M)
    assert abs(gap_mm) < 1.0
    assert np.abs(worker.cell.pose(0) - neighbour)[:3, 3].max() < 0.002
    assert [worker.truth(number).dents for number in (0, 1)] == [(), ()]


def test_push_with_the_package_between_the_fingers_ends_too_early(worker):
    """A finger is between it and the wall: hence the closed hand pushes from behind."""
    worker.put(1, *FIRST[:1], FIRST[1] + 0.06)
    assert worker.do(1, "regrasp") == "held"
    worker.plan(FIRST[0], FIRST[1] + 0.03)
    pushes = primitive(
        way("done", "force_y > 14 0.032"), way("failed", "distance > 0.2"),
        axes=axes(y=("velocity", -0.06)), tare=True, speed_m_s=0.08, limit_s=6.0,
    )  # fmt: skip
    down = axes(z=("velocity", -0.1))
    lowers = primitive(way("pushes", "force_z > 6 0.032"), axes=down, tare=True, limit_s=6.0)

    ended = worker.run(net({"lowers": lowers, "pushes": pushes}))

    gap_m = worker.cell.pose(1)[1, 3] - 0.5 * WIDTH_M - WALL_Y_M
    assert ended.result == "done"
    assert gap_m > 0.010, "the finger is 12 mm thick"


def test_hand_that_draws_back_takes_nothing_with_it(worker):
    """Back by distance, then up: the package is neither lifted nor dragged along."""
    worker.put(0, *FIRST)
    worker.put(1, SECOND[0], SECOND[1] + PUSH_GAP_M)
    worker.plan(*SECOND)
    seen = []

    def watch(executor):
        if executor.execution().primitive in {"contact", "retract"}:
            seen.append(worker.cell.pose(1)[:3, 3])

    ended = worker.run(worker.ground("push_into_contact", 1), watch)

    assert ended.result == "in_contact"
    path = np.array(seen) - seen[0]
    assert len(seen) > 50
    assert np.abs(path[:, 2]).max() < 0.001
    assert np.abs(path[:, :2]).max() < 0.001


def test_force_of_the_hands_own_acceleration_is_no_contact(worker):
    """The sensor feels most of the 6 N of a touch on the way down; touch ends on the tray."""
    worker.put(1, *BELT)
    plan = worker.plan(*FIRST)
    assert worker.do(1, "grasp_from_belt") == "held"
    felt, touched = [], []

    def watch(executor):
        now = executor.execution()
        if now.primitive in {"carry", "lower"} and executor.quantities:
            felt.append(abs(executor.quantities["force_z"]))
        if now.primitive == "release" and not touched:
            touched.append(worker.off(1, plan)[2])

    ended = worker.run(worker.ground("place", 1), watch)

    assert ended.result == "placed"
    assert max(felt) > 4.0
    assert abs(touched[0]) < 0.5, "mm above the tray when it was let go"


def test_held_package_does_not_slip_on_its_way(worker):
    """With the force of its grasp and the acceleration of nets it stays within 1 mm and 0.5°."""
    worker.put(1, *BELT)
    worker.plan(*SECOND)
    assert worker.do(1, "grasp_from_belt") == "held"
    start = np.linalg.inv(worker.cell.arm.measured().tcp) @ worker.cell.pose(1)
    slips = []

    def watch(executor):
        if executor.execution().primitive in {"carry", "lower", "settle"}:
            held = np.linalg.inv(worker.cell.arm.measured().tcp) @ worker.cell.pose(1)
            slips.append(np.abs(coordinates(start, held)))

    worker.run(worker.ground("place", 1), watch)

    slips = np.array(slips)
    assert slips[:, :3].max() < 0.001
    assert np.degrees(slips[:, 3:].max()) < 0.5


def test_package_that_stands_wrong_is_grasped_again_and_set_right(worker):
    """20 mm and 6° off, 22 mm from its neighbour: afterwards it is sound, the neighbour where it was."""
    worker.put(0, *FIRST)
    worker.put(1, SECOND[0] + 0.02, SECOND[1] + 0.022, np.radians(6.0))
    neighbour = worker.cell.pose(0)
    plan = worker.plan(*SECOND)

    result = worker.do(1, "regrasp", "place", "push_into_contact")

    off = worker.off(1, plan)
    assert result == "in_contact"
    assert np.linalg.norm(off[:2]) < 3.0
    assert abs(off[5]) < 1.5
    assert np.abs(worker.cell.pose(0) - neighbour)[:3, 3].max() < 0.002
    assert worker.truth(1).dents == ()


def test_package_is_removed_into_the_bin(worker):
    """From the tray beside another one: it lies in the bin, the other has not moved."""
    worker.put(0, *FIRST)
    worker.put(1, SECOND[0], SECOND[1] + 0.02)
    stands = worker.cell.pose(0)

    result = worker.do(1, "regrasp", "remove_to_reject")
    worker.cell.step(100)

    assert result == "rejected"
    assert worker.truth(1).where == "bin"
    assert np.abs(worker.cell.pose(0) - stands)[:3, 3].max() < 5e-4


def test_package_that_is_held_low_is_raised_before_it_is_removed(worker):
    """The hand was stopped while it began to lift, another package in the way to the bin."""
    worker.put(1, *BELT)
    worker.put(0, BELT[0], BELT[1] - 0.16)

    def stop(executor):
        if executor.execution().primitive == "lift" and not executor.result:
            executor.brake("stopped")

    assert worker.run(worker.ground("grasp_from_belt", 1), stop).result == "braked:stopped"
    assert worker.truth(1).where == "held"
    assert worker.do(1, "remove_to_reject") == "rejected"
    worker.cell.step(100)
    assert worker.truth(1).where == "bin"


def test_package_that_is_not_there_is_missed(worker):
    """The fingers close on nothing: the width tells, the hand goes up open."""
    worker.put(1, *BELT)
    worker.see(1, beside_m=(-0.25, 0.0))

    assert worker.do(1, "grasp_from_belt") == "missed"
    assert worker.truth(1).where == "belt"


def test_finger_upon_a_package_is_blocked(worker):
    """50 mm beside where it is, a finger comes down on the carton: the hand goes up again."""
    worker.put(1, *BELT)
    worker.see(1, beside_m=(0.0, 0.05))

    assert worker.do(1, "grasp_from_belt") == "blocked_right"
    assert worker.truth(1).where == "belt"


@pytest.mark.parametrize("stage", ["carry", "lower"])
def test_package_that_falls_is_lost(worker, stage):
    """The gripper opens on the way: the net ends by the width, the hand above what fell."""
    worker.put(1, *BELT)
    worker.plan(*SECOND)
    assert worker.do(1, "grasp_from_belt") == "held"
    failed = []

    def watch(executor):
        if executor.execution().primitive == stage and not failed:
            worker.cell.fail("gripper", 0.2)
            failed.append(worker.cell.time_s)

    ended = worker.run(worker.ground("place", 1), watch)

    assert ended.result == "lost"
    assert worker.truth(1).lost
    assert worker.cell.arm.measured().tcp[2, 3] > TABLE_M + 0.1


def test_package_falls_when_it_hangs_over_the_tray(worker):
    """A failure that was ordered before the grasp waits for that, whatever the host is busy with."""
    worker.put(1, *BELT)
    worker.plan(*SECOND)
    before = worker.truth(1).lost
    worker.cell.fail("gripper", 0.4, "carried")

    assert worker.do(1, "grasp_from_belt") == "held"
    assert worker.cell.failures() == {}
    assert worker.do(1, "place") == "lost"
    assert worker.truth(1).lost == before + 1


def test_place_without_a_floor_is_told(worker):
    """40 mm above the tray nothing is touched: the hand goes up again with what it holds."""
    worker.put(1, *BELT)
    worker.plan(*SECOND, z_m=TABLE_M + 0.04)

    assert worker.do(1, "grasp_from_belt", "place") == "no_floor"
    assert worker.truth(1).where == "held"


def test_empty_hand_goes_aside(worker):
    """After its work it stands between belt and tray, above both, and hides neither."""
    worker.put(1, *FIRST)

    assert worker.do(1, "go_aside") == "aside"

    at = worker.cell.arm.measured().tcp[:3, 3]
    assert at[2] > TABLE_M + 0.25
    assert 0.28 < at[1] < 0.5


def test_push_without_a_neighbour_is_told(worker):
    """85 mm and nothing to push against: the net ends by distance, with its own name."""
    worker.put(1, 0.58, PUSH_GAP_M)
    worker.plan(0.58, 0.0)

    assert worker.do(1, "push_into_contact") == "no_neighbour"
    assert not worker.truth(1).tipped


def test_package_too_wide_or_out_of_reach_moves_nothing(worker):
    """One line before anything moves."""
    worker.put(1, *BELT)
    before = worker.cell.arm.measured().q
    wide = dataclasses.replace(GRASP, width_m=0.131)

    with pytest.raises(ValueError, match=r"131 mm wide .* takes at most 125 mm"):
        worker.ground("grasp_from_belt", 1, grasp=wide)
    worker.frames["package/1"] = on_tray(1.4, 0.0, 0.0)
    with pytest.raises(ValueError, match=r"out of reach|another posture"):
        worker.ground("grasp_from_belt", 1)

    worker.cell.step(10)
    assert np.abs(worker.cell.arm.measured().q - before).max() < 1e-3
