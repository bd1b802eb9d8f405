"""The executor of primitive nets, each rule on its own, on an arm that is kinematics and springs."""

import math

import numpy as np
import pytest

from actors.geometry.poses import roll_pitch_yaw, turned
from actors.palletizing.control.execution import Executor, Grip
from actors.palletizing.control.resolved_rate import ACCELERATION_RAD_S2, rotation_vector
from actors.palletizing.handling.nets import NetError

from .sound_nets import axes, net, primitive, way
from .spring_arm import ARM, CYCLE_S, HOME_RAD, SpringArm, pose, run

FAILED = way("failed", "force > 90")
AT = ("error < 0.0015", "turn_error < 0.02")
START = SpringArm().tcp
FLOOR = ((0.0, 0.0, 0.10), (0.0, 0.0, 1.0))
STILL = {"rx": ("velocity", 0.0)}


def to(x, y, z, **given):
    """Return axes that go to a point and hold the tool's turn."""
    return axes(x=("position", x), y=("position", y), z=("position", z), **given)


def moving(**given):
    """Return axes that move with velocities."""
    return axes(**{name: ("velocity", value) for name, value in given.items()})


def one(*exits, **changes):
    """Return a net of one primitive, trial."""
    return net({"trial": primitive(*exits, FAILED, **changes)})


def test_position_axes_reach_their_target_within_all_limits():
    """The tool comes to point and turn; speed, acceleration and ranges are kept on the way."""
    arm, speeds = SpringArm(), []
    point = [0.5, 0.3, 0.15]
    turn = {"rx": ("position", math.pi), "ry": ("position", 0.0), "rz": ("position", 2.5)}
    last = [arm.tcp[:3, 3]]

    def watch(arm, _):
        speeds.append(np.linalg.norm(arm.tcp[:3, 3] - last[0]) / CYCLE_S)
        last[0] = arm.tcp[:3, 3]
        assert (np.abs(arm.q) < ARM.q_max).all()

    going = one(way("done", *AT), axes=to(*point, **turn), speed_m_s=0.4, limit_s=6.0)
    ended = run(going, arm, each=watch)

    assert ended.result == "done"
    np.testing.assert_allclose(arm.tcp[:3, 3], point, atol=2e-3)
    off = arm.tcp[:3, :3] @ turned(math.pi, 0.0, 2.5).T
    assert np.linalg.norm(rotation_vector(off)) < 0.03
    assert 0.3 < max(speeds) < 0.42
    assert arm.acceleration_max < ACCELERATION_RAD_S2 * 1.001
    assert arm.jerk_max < 600.0 * 1.001


def test_a_hurried_tool_goes_as_fast_as_its_joints():
    """1.5 m/s cannot be had: some joint goes with 95 % of its speed, none with more."""
    arm = SpringArm()
    hurried = one(way("done", *AT), axes=to(-0.1, 0.65, 0.3), speed_m_s=1.5, limit_s=6.0)

    assert run(hurried, arm).result == "done"
    assert 0.94 < arm.speed_share_max < 0.951
    assert arm.jerk_max < 600.0 * 1.001


@pytest.mark.parametrize(("follows", "moved_m"), [(False, 0.0), (True, 0.1)])
def test_a_frame_is_fixed_at_the_start_or_followed(follows, moved_m):
    """An entity that moves on takes the tool with it if the frame follows, and else does not."""
    arm = SpringArm()
    x, y, z = START[:3, 3]
    seen = {"package/1": pose(x, y, z, START[:3, :3])}

    def drive(arm, _):
        seen["package/1"] = pose(x, y + min(0.1 * arm.now_s, 0.1), z, START[:3, :3])

    staying = one(
        way("done", "elapsed_s > 1.9"), frame="package/1", follows=follows,
        axes=to(0.0, 0.0, 0.0),
    )  # fmt: skip
    ended = run(staying, arm, seen, each=drive)

    assert ended.result == "done"
    assert arm.tcp[1, 3] - y == pytest.approx(moved_m, abs=1e-3)


def test_a_followed_frame_is_kept_up_with_while_it_moves():
    """On a belt of 0.1 m/s the tool lags by millimetres, not by speed over gain (17 mm)."""
    arm, x, y, z = SpringArm(), *START[:3, 3]
    following = one(
        way("done", "elapsed_s > 1.5"), frame="package/1", follows=True, axes=to(0.0, 0.0, 0.0)
    )

    def frames(_):
        return pose(x, y + 0.1 * arm.now_s, z, START[:3, :3])

    ended = run(following, arm, frames)

    assert ended.result == "done"
    assert ended.quantities["error"] < 0.002
    assert arm.tcp[1, 3] - y > 0.14


def test_a_velocity_axis_moves_and_the_others_hold():
    """The tool goes down 50 mm at 50 mm/s; sideways and in turn it stays."""
    arm = SpringArm()
    ended = run(one(way("done", "distance > 0.05"), axes=moving(z=-0.05)), arm)

    step = ended.trace[0]
    moved = arm.tcp[:3, 3] - START[:3, 3]
    assert (step.to, step.elapsed_s) == ("done", pytest.approx(1.0, abs=0.2))
    assert abs(moved[0]) < 1e-3
    assert abs(moved[1]) < 1e-3
    assert np.linalg.norm(rotation_vector(arm.tcp[:3, :3] @ START[:3, :3].T)) < 0.005


def test_a_turning_axis_turns_about_the_axis_of_the_frame():
    """Rz as a velocity yaws the tool by the rate; its point stays."""
    arm = SpringArm()
    run(one(way("done", "elapsed_s > 1"), axes=moving(rz=0.3)), arm)

    yaw = roll_pitch_yaw(arm.tcp[:3, :3] @ START[:3, :3].T)[2]
    assert yaw == pytest.approx(0.3, abs=0.08)
    assert np.linalg.norm(arm.tcp[:3, 3] - START[:3, 3]) < 1e-3


def test_a_frame_that_is_turned_turns_its_axes():
    """X of a frame that is yawed by 90 degrees is y of the base, for moves and for forces."""
    arm = SpringArm(walls=[((0.0, 0.02, 0.0), (0.0, -1.0, 0.0))])
    sideways = one(way("done", "force_x < -8 0.032"), frame="place/1", axes=moving(x=0.05))
    ended = run(sideways, arm, {"place/1": pose(0.5, 0.0, 0.0, turned(0.0, 0.0, math.pi / 2))})

    assert ended.result == "done"
    assert 0.02 < arm.tcp[1, 3] < 0.03


def test_the_tool_as_a_frame_moves_along_the_fingers():
    """+z of the frame "tool" is out of the hand: downwards here."""
    arm = SpringArm()
    run(one(way("done", "distance > 0.03"), frame="tool", axes=moving(z=0.05)), arm)

    assert arm.tcp[2, 3] - START[2, 3] == pytest.approx(-0.03, abs=0.006)


def test_a_blocked_tool_presses_no_harder_than_its_lead():
    """Against a wall without a condition on force the commanded tool stays behind it."""
    pressing = one(
        way("done", "elapsed_s > 5"), axes=to(*START[:2, 3], 0.0), speed_m_s=0.05, limit_s=6.0
    )
    leads = []
    run(
        pressing, BlockedArm(walls=[(START[:3, 3] - [0.0, 0.0, 0.05], np.zeros(3))]),
        each=lambda arm, _: leads.append(arm.lead_m()),
    )  # fmt: skip

    assert 0.015 < max(leads) < 0.022


class BlockedArm(SpringArm):
    """An arm that a floor stops: what it measures never goes below, whatever is commanded."""

    def obey(self, command):
        before = self.q
        super().obey(command)
        if self.tcp[2, 3] < self.walls[0][0][2]:
            self.q, self.dq = before, np.zeros(7)

    def lead_m(self):
        """Return how far the command is ahead."""
        from actors.geometry.arms.kinematics import tool_poses

        return float(np.linalg.norm(tool_poses(ARM, self.commanded)[0, :3, 3] - self.tcp[:3, 3]))


def test_a_tool_that_was_held_up_does_not_rush_afterwards():
    """A velocity axis that was blocked for a second makes up for 15 mm at most."""
    arm = BlockedArm(walls=[(START[:3, 3], np.zeros(3))])

    def hold(arm, _):
        depth_m = 0.025 if 0.6 < arm.now_s < 1.6 else 1.0
        arm.walls = [(START[:3, 3] - [0.0, 0.0, depth_m], np.zeros(3))]

    run(one(way("done", "elapsed_s > 2.4"), axes=moving(z=-0.05)), arm, each=hold)

    assert 0.06 < START[2, 3] - arm.tcp[2, 3] < 0.10


def test_a_force_axis_keeps_its_force_while_another_moves():
    """The axis z presses with 10 N while x slides along the floor: the hybrid move."""
    arm = SpringArm(walls=[FLOOR])
    down = primitive(way("slide", "force_z > 4"), FAILED, axes=moving(z=-0.08), limit_s=5.0)
    slide = primitive(
        way("done", "distance > 0.08"), FAILED, axes=axes(z=("force", 10.0), y=("velocity", 0.05))
    )
    presses = []

    def watch(arm, executor):
        if executor.trace:
            presses.append(arm.force()[2] + arm.weight_n)

    ended = run(net({"down": down, "slide": slide}), arm, each=watch)

    assert ended.result == "done"
    assert presses[-1] == pytest.approx(10.0, abs=0.5)
    assert np.ptp(presses[len(presses) // 2 :]) < 1.0
    assert arm.tcp[1, 3] == pytest.approx(0.08, abs=0.01)


@pytest.mark.parametrize(("tare", "result"), [(True, "done"), (False, "failed")])
def test_a_tare_makes_the_wrench_of_the_start_zero(tare, result):
    """What the hand lifted before counts as force unless the primitive tares."""
    arm = SpringArm()
    wait = primitive(way("guarded", "elapsed_s > 0.3"), axes=moving())
    guarded = primitive(
        way("failed", "force > 4"), way("done", "elapsed_s > 0.2"), axes=moving(), tare=tare
    )

    def lift(arm, _):
        arm.weight_n = 8.0 if arm.now_s < 0.1 else 13.0

    ended = run(net({"wait": wait, "guarded": guarded}), arm, each=lift)

    assert ended.result == result


@pytest.mark.parametrize(("knock_s", "result"), [(0.016, "done"), (0.1, "failed")])
def test_a_condition_has_to_hold(knock_s, result):
    """A knock that is shorter than `hold_s` takes no exit; after a break the time counts anew."""
    arm = SpringArm()
    waiting = one(way("failed", "force > 8 0.06"), way("done", "elapsed_s > 1.0"))

    def knock(arm, _):
        hit = any(0.0 <= arm.now_s - at_s < knock_s for at_s in (0.2, 0.3, 0.4))
        arm.weight_n = 38.0 if hit else 8.0

    assert run(waiting, arm, each=knock).result == result


def test_exits_are_asked_in_order_and_need_all_their_conditions():
    """Of two exits that hold the first is taken; one whose second condition fails is not."""
    both = way("failed", "elapsed_s > 0.1", "width < 0.05")
    first, second = way("done", "elapsed_s > 0.2"), way("late", "elapsed_s > 0.2")
    ends = {"done": True, "late": True, "failed": False}
    ended = run(net({"a": primitive(both, first, second)}, ends=ends), SpringArm())

    assert [(step.primitive, step.to) for step in ended.trace] == [("a", "done")]
    assert ended.trace[0].because.startswith("elapsed_s > 0.2 s: elapsed_s 0.2")


def test_a_primitive_that_takes_too_long_ends_the_net():
    """The result names the primitive; exits are asked before the limit."""
    slow = one(way("done", "width < 0.01"), limit_s=0.5)
    ended = run(slow, SpringArm())

    assert ended.result == "timeout:trial"
    assert not slow.outcome(ended.result)
    assert ended.trace[-1].elapsed_s == pytest.approx(0.5, abs=0.01)


def test_the_gripper_gets_each_command_once():
    """A tool command goes out with the first step of its primitive; "keep" sends none."""
    arm, grips = SpringArm(held_m=0.095), []
    close = primitive(
        way("failed", "width < 0.085"), way("hold", "width < 0.1", "width_rate > -0.001 0.1"),
        tool="force", tool_value=45.0,
    )  # fmt: skip
    hold = primitive(way("open", "elapsed_s > 0.1"))
    wide = primitive(way("done", "width > 0.11"), FAILED, tool="width", tool_value=0.12)
    chain = net({"close": close, "hold": hold, "open": wide})
    executor = Executor(chain, ARM, {}.__getitem__)
    while not executor.result:
        command = executor.step(arm.measured(), arm.now_s)
        arm.obey(command)
        grips += [] if command.grip is None else [command.grip]

    assert grips == [Grip("force", 45.0), Grip("width", 0.12)]
    assert executor.result == "done"


def test_a_missed_package_is_told_by_the_width():
    """The fingers close on nothing: the same primitive leaves by its other exit."""
    close = one(
        way("failed", "width < 0.085"), way("done", "width < 0.1", "width_rate > -0.001 0.1"),
        tool="force", tool_value=45.0,
    )  # fmt: skip
    assert run(close, SpringArm(held_m=None)).result == "failed"


def test_a_braked_net_ends_and_the_arm_comes_to_rest():
    """Brakes act in any primitive, keep the acceleration, and the first reason stands."""
    arm = SpringArm()

    def stop(arm, executor):
        if arm.now_s > 0.3:
            executor.brake("operator")
            executor.brake("again")

    ended = run(one(way("done", *AT), axes=to(0.5, 0.5, 0.3), speed_m_s=0.8), arm, each=stop)

    assert ended.result == "braked:operator"
    assert ended.trace[-1].to == "braked:operator"
    assert arm.now_s < 0.6
    assert arm.acceleration_max < ACCELERATION_RAD_S2 * 1.001


def test_a_net_is_never_begun_again():
    """A new process that finds its net half executed moves nothing and tells where it was."""
    chain = net(
        {
            "first": primitive(way("second", "elapsed_s > 0.1")),
            "second": primitive(way("done", *AT), FAILED, axes=to(0.5, 0.2, 0.2)),
        }
    )
    arm = SpringArm()
    killed = Executor(chain, ARM, {}.__getitem__, net_version=7)
    while arm.now_s < 0.4:
        arm.obey(killed.step(arm.measured(), arm.now_s))
    rested = SpringArm(arm.q)

    again = run(chain, rested, net_version=7, before=killed.execution())

    assert again.result == "interrupted:second"
    assert [step.to for step in again.trace] == ["second", "interrupted:second"]
    assert again.execution().primitive == "second"
    np.testing.assert_array_equal(rested.q, arm.q)
    newer = run(chain, rested, net_version=8, before=killed.execution())
    assert newer.result == "done"


def test_at_scale_zero_the_arm_waits_where_it_is():
    """A pause of twice the time limit ends nothing; afterwards the move goes on from there."""
    arm, waits = SpringArm(), []

    def scale(now_s):
        return 0.0 if 0.5 < now_s < 4.5 else 1.0

    def watch(arm, executor):
        if 1.5 < arm.now_s < 4.5:
            waits.append((arm.tcp[:3, 3], executor.execution().primitive))

    going = one(way("done", *AT), axes=to(0.5, 0.4, 0.3), speed_m_s=0.4, limit_s=2.5)
    ended = run(going, arm, scale=scale, each=watch)

    assert ended.result == "done"
    assert {name for _, name in waits} == {"trial"}
    assert np.ptp([point for point, _ in waits], axis=0).max() < 1e-4
    assert 0.02 < np.linalg.norm(waits[0][0] - START[:3, 3]) < 0.3


def freeze(arm, seen):
    arm.frozen = True


def blind(arm, seen):
    arm.weight_n = math.nan


def lose(arm, seen):
    seen.clear()


def shove(arm, seen):
    arm.q = arm.q + 0.5 * np.eye(7)[3]


@pytest.mark.parametrize(
    ("fault", "result"),
    [
        (freeze, "sensor:frozen"),
        (blind, "sensor:not_a_number"),
        (lose, "no_frame:package/1"),
        (shove, "not_following:4"),
    ],
)
def test_what_cannot_be_relied_on_ends_the_net(fault, result):
    """A frozen sensor, no numbers, a lost frame and an arm elsewhere: brakes, and a result."""
    arm, seen = SpringArm(), {"package/1": pose(0.5, 0.2, 0.2)}
    done = []

    def break_once(arm, _):
        if arm.now_s > 0.3 and not done:
            done.append(fault(arm, seen))

    going = one(way("done", *AT), frame="package/1", follows=True, axes=to(0.0, 0.0, 0.0))
    ended = run(going, arm, seen.__getitem__, each=break_once)

    assert ended.result == result
    assert arm.now_s < 0.8


def test_a_net_in_an_unknown_place_does_not_start():
    """The line names net, primitive and entity before anything moves."""
    lost = one(way("done", *AT), frame="place/9", axes=to(0.0, 0.0, 0.0))

    with pytest.raises(NetError, match=r"net trial: primitive trial: .* where place/9 is"):
        Executor(lost, ARM, {}.__getitem__)


def test_the_elbow_goes_home_without_moving_the_tool():
    """The seventh joint's freedom serves the posture."""
    arm = SpringArm()
    posture = HOME_RAD + 0.4 * (np.eye(7)[0] - np.eye(7)[2])
    before = np.linalg.norm(arm.q - posture)

    run(one(way("done", "elapsed_s > 2.5")), arm, posture_rad=posture)

    assert np.linalg.norm(arm.q - posture) < 0.8 * before
    assert np.linalg.norm(arm.tcp[:3, 3] - START[:3, 3]) < 1e-3


def test_an_execution_says_how_far_the_net_is():
    """Net, version, primitive, its start, wrench since the tare, width and tool."""
    chain = net(
        {"first": primitive(way("second", "elapsed_s > 0.1")), "second": primitive(
            way("done", "elapsed_s > 0.2"), FAILED)}
    )  # fmt: skip
    arm = SpringArm()
    executor = Executor(chain, ARM, {}.__getitem__, net_version=4)
    with pytest.raises(RuntimeError, match="before the first step"):
        executor.execution()
    while not executor.trace:
        arm.obey(executor.step(arm.measured(), arm.now_s))

    found = executor.execution()

    assert (found.net_name, found.net_version) == ("trial", 4)
    assert (found.primitive, found.result) == ("second", "")
    assert found.since_ns == pytest.approx(0.104e9, abs=1e7)
    assert np.abs(found.wrench).max() < 1.0
    assert (found.width_m, found.tcp[2, 3]) == (0.12, pytest.approx(START[2, 3], abs=1e-3))


def test_a_tool_at_the_end_of_a_joint_stays_in_range():
    """A target out of reach ends by time; no joint leaves its range, the tool does not shake."""
    arm = SpringArm()
    ranges = []
    far = one(way("done", *AT), axes=to(1.6, 0.0, 0.2), speed_m_s=0.5, limit_s=5.0)
    ended = run(far, arm, each=lambda arm, _: ranges.append(np.abs(arm.q)))

    assert ended.result == "timeout:trial"
    assert (np.max(ranges, axis=0) <= ARM.q_max).all()
    assert arm.acceleration_max < ACCELERATION_RAD_S2 * 1.001
