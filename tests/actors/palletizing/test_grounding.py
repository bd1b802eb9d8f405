"""Skeletons: what binding refuses, what the nets hold, and that they run on springs."""

import dataclasses
import math

import numpy as np
import pytest

from actors.geometry.arms.kinematics import tool_poses
from actors.geometry.arms.reaching import reach
from actors.palletizing.control.resolved_rate import ACCELERATION_RAD_S2
from actors.palletizing.handling.grounding import (
    BESIDE_M,
    FOLDER,
    SKELETONS,
    Job,
    aside_net,
    easier_turn,
    ground,
)
from actors.palletizing.handling.net_files import text_of_net
from actors.palletizing.handling.nets import NetError
from actors.palletizing.placing import finger_room
from actors.palletizing.placing.finger_room import Grasp, Gripper
from actors.palletizing.placing.rows import RIM_M
from actors.palletizing.simulation.cell.scene import CellLayout

from .spring_arm import ARM, HOME_RAD, SpringArm, pose, run

GRASP = Grasp(np.array([-0.02, 0.0, 0.04]), np.array([0.0, 1.0, 0.0]), 0.095, 45.0, 0.03, 0.5)
FRAMES = {
    "package/17": pose(0.40, 0.45, 0.002),
    "place/3": pose(0.54, -0.20, 0.0),
    "bin": pose(0.1, 0.55, -0.1),
    "belt": pose(0.45, 0.62, -0.15),
}
JOB = Job(
    package="package/17",
    grasp=GRASP,
    size_m=np.array([0.20, 0.095, 0.07]),
    place="place/3",
    push=np.array([0.0, -1.0, 0.0]),
    bin="bin",
    turned=True,
)


def grounded(skeleton, *, grasp=None, frames=FRAMES, near_rad=HOME_RAD, **changes):
    """Return the net of a skeleton for the carton, with what is changed."""
    job = dataclasses.replace(JOB, grasp=dataclasses.replace(GRASP, **(grasp or {})), **changes)
    return ground(
        str(skeleton), job, arm=ARM, gripper=Gripper(), frames=frames.__getitem__,
        near_rad=near_rad,
    )  # fmt: skip


def test_the_cell_comes_with_six_skeletons():
    """Grasp, place, push, regrasp, reject, go aside; each leads to a success and to named failures."""
    nets = {name: grounded(name) for name in SKELETONS}

    assert {
        name: [end for end, good in net.ends.items() if good] for name, net in nets.items()
    } == {
        "go_aside": ["aside"],
        "grasp_from_belt": ["held"],
        "place": ["placed"],
        "push_into_contact": ["in_contact"],
        "regrasp": ["held"],
        "remove_to_reject": ["rejected"],
    }
    assert nets["place"].grounded == {"package": "package/17", "place": "place/3"}


@pytest.mark.parametrize("skeleton", SKELETONS)
def test_every_guarded_move_tares_and_asks_for_a_force_that_lasts(skeleton):
    """The wrist feels the hand's own acceleration: no force is asked for without both."""
    for name, primitive in grounded(skeleton).primitives.items():
        asked = [c for way in primitive.exits for c in way.when if c.quantity.startswith("force")]
        assert primitive.tare == bool(asked), name
        assert all(condition.hold_s >= 0.012 for condition in asked), name
    push = grounded("push_into_contact").primitives["push"]
    assert [str(way) for way in push.exits] == ["force_x < -10 N for 0.032 s", "distance > 0.097 m"]


@pytest.mark.parametrize("direction", [(0.0, -1.0, 0.0), (0.0, 1.0, 0.0), (-1.0, 0.0, 0.0)])
def test_a_push_comes_from_behind_with_a_closed_hand(direction):
    """The hand stands behind the package, against the push, and does not touch it yet."""
    net = grounded("push_into_contact", push=np.array(direction))
    beside, push = net.primitives["beside"], net.primitives["push"]
    base_from_frame = FRAMES["place/3"] @ beside.frame.offset

    hand = base_from_frame @ [beside.axes[0].value, 0.0, beside.axes[2].value, 1.0]
    put_down = FRAMES["place/3"][:3, 3] - 0.02 * np.array(direction)
    behind_m = float((put_down - hand[:3]) @ direction)
    half_m = 0.0475 if direction[1] else 0.10

    thick_m = 0.0445 if direction[1] else 0.012
    assert behind_m == pytest.approx(half_m + thick_m + BESIDE_M, abs=1e-6)
    np.testing.assert_allclose(base_from_frame[:3, 0], direction, atol=1e-9)
    assert (net.primitives["behind"].tool, net.primitives["behind"].tool_value) == ("width", 0.066)
    assert (push.axes[0].mode, push.axes[0].value) == ("velocity", 0.08)
    assert hand[2] == pytest.approx(GRASP.push_height_m)


def test_the_hand_that_grasped_turned_round_places_so():
    """Relative to the package the hand stands the same at grasp and place, turned or not."""
    for turned_round in (False, True):
        near_rad = HOME_RAD + (0.0 if turned_round else -2.2) * np.eye(7)[6]
        nets = [
            grounded(name, turned=turned_round, near_rad=near_rad)
            for name in ("grasp_from_belt", "place")
        ]
        held = []
        for net, name, entity in zip(
            nets, ("down", "lower"), ("package/17", "place/3"), strict=True
        ):
            primitive = net.primitives[name]
            tool = tool_pose(primitive, FRAMES[entity])
            held.append(np.linalg.inv(FRAMES[entity][:3, :3]) @ tool[:3, :3])
        np.testing.assert_allclose(held[0], held[1], atol=1e-9)


def tool_pose(primitive, base_from_entity):
    """Return the pose that a primitive by positions goes to."""
    from actors.geometry.poses import turned

    values = [axis.value for axis in primitive.axes]
    target = pose(*values[:3], turned(*values[3:]))
    return base_from_entity @ primitive.frame.offset @ target


@pytest.mark.parametrize(
    ("along_m", "across_m", "turn_rad", "room"),
    [
        (0.201, 0.0, 0.0, True),  # behind it, where no finger goes
        (0.0, 0.0975, 0.0, False),  # beside it, in contact
        (0.0, 0.115, 0.0, False),
        (0.0, 0.117, 0.0, True),  # 7 mm on each side, 12 mm of finger, 2 mm to spare
        (0.0, -0.115, 0.0, False),
        (0.0, 0.117, 0.3, False),  # a corner stands in the way
        (0.13, 0.0975, 0.0, True),  # beside it, but past the fingers
    ],
)
def test_a_package_among_others_is_taken_only_where_the_fingers_have_room(
    along_m, across_m, turn_rad, room
):
    """A finger that came down on a neighbour would spoil it."""
    from actors.geometry.poses import turned

    stands = FRAMES["package/17"] @ pose(along_m, across_m, 0.0, turned(0.0, 0.0, turn_rad))
    beside = (("place/2", stands, JOB.size_m),)
    if room:
        assert grounded("regrasp", beside=beside)
        return
    with pytest.raises(NetError, match="place/2 leaves no room for a finger beside it"):
        grounded("regrasp", beside=beside)


def test_beside_the_rim_of_the_tray_a_package_is_held_higher():
    """A finger would come down on the rim; the tips end above it, and the place knows."""
    tray = pose(0.40, 0.45 - 0.067 - 0.325, 0.002)  # its rim is 20 mm beside the package
    plain = {name: grounded(name) for name in ("grasp_from_belt", "place")}
    beside = {name: grounded(name, frames={**FRAMES, "tray": tray}) for name in plain}

    raised = [
        each["grasp_from_belt"].primitives["reach"].frame.offset[2, 3] for each in (plain, beside)
    ]
    assert raised[0] == pytest.approx(0.040)
    assert raised[1] == pytest.approx(RIM_M + 0.003 + Gripper().tips_m)
    lowered = [each["place"].primitives["lower"].frame.offset[2, 3] for each in (plain, beside)]
    assert lowered[1] - lowered[0] == pytest.approx(raised[1] - raised[0])
    far = {**FRAMES, "tray": pose(0.40, 0.0, 0.002)}
    assert text_of_net(grounded("place", frames=far)) == text_of_net(plain["place"])
    low = np.array([0.20, 0.095, 0.044])
    assert grounded("grasp_from_belt", size_m=low)
    with pytest.raises(NetError, match="the rim of the tray leaves no room for a finger beside it"):
        grounded("grasp_from_belt", size_m=low, frames={**FRAMES, "tray": tray})


@pytest.mark.parametrize(
    ("height_m", "point_m", "force_n"),
    [(0.030, 0.053, 45.0), (0.017, 0.040, 45.0), (0.054, 0.077, 25.0)],
)
def test_the_hand_grasps_over_what_is_low(height_m, point_m, force_n):
    """The rim of the tray, or a lower package; all stages of the request hold it so."""
    stands = FRAMES["package/17"] @ pose(0.0, 0.0975, 0.0)
    beside = (("place/2", stands, np.array([0.2, 0.095, height_m])),)
    plain = {name: grounded(name) for name in ("grasp_from_belt", "regrasp", "place")}
    over = {name: grounded(name, beside=beside) for name in plain}
    for name, primitive in (("grasp_from_belt", "reach"), ("regrasp", "down"), ("place", "lower")):
        offsets = [each[name].primitives[primitive].frame.offset[2, 3] for each in (plain, over)]
        assert offsets == pytest.approx([0.040, point_m])
        assert grounded(name, beside=(*beside, ("place/1", FRAMES["place/3"], JOB.size_m)))
    assert over["regrasp"].primitives["grasp"].tool_value == force_n
    high = (("place/2", stands, JOB.size_m),)
    with pytest.raises(NetError, match="place/2 leaves no room for a finger beside it"):
        grounded("grasp_from_belt", beside=high)
    offset = grounded("place", beside=high).primitives["lower"].frame.offset
    assert offset[2, 3] == pytest.approx(0.040), "what was taken is put down"


def test_the_rim_stands_around_the_tray():
    """What the hand goes over is as large as what stands in the cell."""
    layout = CellLayout()
    assert layout.rim_m == RIM_M
    rim = finger_room.rim_beside(layout.base_from_tray)
    corners = [np.abs(stands[:3, :3]) @ size_m / 2.0 for _, stands, size_m in rim]
    sides = [stands[:3, 3] for _, stands, _ in rim]
    ends = np.array([(at - half, at + half) for at, half in zip(sides, corners, strict=True)])
    middle = layout.base_from_tray[:2, 3]
    assert ends[:, 1, :2].max(axis=0) - middle == pytest.approx([0.322, 0.452], abs=0.004)
    assert middle - ends[:, 0, :2].min(axis=0) == pytest.approx([0.322, 0.452], abs=0.004)


def test_a_package_is_grasped_placed_and_pushed_into_contact():
    """The three nets one after another, on springs: the floor and the neighbour press back."""
    arm = SpringArm(held_m=None)
    frames = FRAMES.__getitem__
    behind_neighbour = FRAMES["place/3"][:3, 3] + [0.0, 0.0475 + 0.0395, 0.0]

    def world(arm, executor):
        at = executor.execution().primitive if executor.quantities else ""
        arm.held_m = 0.095 if at in {"grasp", "lift"} else arm.held_m
        if at == "touch":
            arm.walls = [((0.0, 0.0, 0.041), (0.0, 0.0, 1.0))]
        elif at == "release":
            arm.walls, arm.held_m = [], None
        elif at == "push":
            arm.walls = [(behind_neighbour, (0.0, 1.0, 0.0))]

    results, traces = [], []
    for name in ("grasp_from_belt", "place", "push_into_contact"):
        going = grounded(name, near_rad=arm.q)
        executor = run(
            going, arm, frames, each=world, until_s=arm.now_s + 20.0, from_rad=arm.commanded
        )
        results.append(executor.result)
        traces += [step.primitive for step in executor.trace]

    assert results == ["held", "placed", "in_contact"]
    assert traces == [
        "above", "down", "feel", "reach", "grasp", "lift", "carry", "lower", "settle", "touch",
        "release", "raise", "behind", "beside", "settle", "push", "contact", "retract",
    ]  # fmt: skip
    assert arm.now_s < 20.0
    assert arm.acceleration_max < ACCELERATION_RAD_S2 * 1.001


def test_a_package_that_slips_out_of_the_hand_is_lost():
    """The width tells it while carrying."""
    arm = SpringArm(held_m=0.095)
    arm.width_m = arm.goal_m = 0.095

    def drop(arm, executor):
        if arm.now_s > 0.2:
            arm.held_m, arm.goal_m = None, 0.065

    ended = run(grounded("place"), arm, FRAMES.__getitem__, each=drop)

    assert ended.result == "lost"
    assert ended.trace[-1].primitive == "carry"


def test_without_a_neighbour_the_push_ends_by_distance():
    """The hand goes back and up before the net ends."""
    ended = run(grounded("push_into_contact"), SpringArm(), FRAMES.__getitem__)

    assert ended.result == "no_neighbour"
    assert [step.primitive for step in ended.trace[-3:]] == ["push", "alone", "retract_alone"]


def test_the_easier_turn_spares_the_wrist():
    """A two-finger hand is the same turned round: the nearer of both is taken."""
    turns = {
        yaw: easier_turn(
            dataclasses.replace(JOB, grasp=dataclasses.replace(GRASP, axis=np.array(axis))),
            arm=ARM, frames=FRAMES.__getitem__, near_rad=HOME_RAD,
        )
        for yaw, axis in ((0, (0.0, 1.0, 0.0)), (180, (0.0, -1.0, 0.0)))
    }  # fmt: skip

    assert turns == {0: True, 180: False}


@pytest.mark.parametrize(
    ("skeleton", "changes", "message"),
    [
        (
            "grasp_from_belt", {"grasp": {"width_m": 0.131}},
            "for package/17: it is 131 mm wide where it is grasped; the gripper takes at most 125",
        ),
        (
            "regrasp", {"grasp": {"width_m": 0.068}},
            "it is 68 mm wide where it is grasped; the gripper holds no less than 71 mm",
        ),
        (
            "grasp_from_belt", {"grasp": {"force_n": 80.0}},
            "its grasp asks for 80 N; the gripper has at most 60 N",
        ),
        (
            "grasp_from_belt", {"grasp": {"mass_kg": 2.4}, "product": "milk_carton"},
            "a milk_carton of 2.4 kg; the gripper carries more than 0 and at most 2 kg",
        ),
        (
            "regrasp", {"grasp": {"mass_kg": math.nan}},
            "a package of nan kg; the gripper carries",
        ),
        (
            "grasp_from_belt", {"grasp": {"axis": np.array([0.0, 0.0, 1.0])}},
            "the axis of its grasp [0.0, 0.0, 1.0] is not level",
        ),
        (
            "place", {"frames": FRAMES | {"place/3": pose(1.4, 0.2, 0.0)}},
            "package/17: primitive carry: x 1.380, y 0.220, z 0.170 m of the base is out of reach;",
        ),
        (
            "grasp_from_belt", {"turned": False, "near_rad": HOME_RAD + 0.6 * np.eye(7)[6]},
            "primitive above: the arm comes to x 0.380, y 0.450, z 0.172 m of the base in another",
        ),
        (
            "place", {"place": ""},
            "place.toml: parameter place (entity) is not bound; bound: package, grasp.frame,",
        ),
        ("place", {"push": None}, "place.toml: parameter push.frame (pose) is not bound; bound:"),
        ("place", {"place": "place/9"}, "it is not known where place/9 is"),
        (
            "push_into_contact", {"push": np.array([0.0, 0.0, 1.0])},
            "push of package/17 at place/3: [0.0, 0.0, 1.0] is no level direction",
        ),
        (
            "grasp_from_belt", {"grasp": {"width_m": math.nan}},
            "it is nan mm wide where it is grasped",
        ),
    ],
)  # fmt: skip
def test_what_cannot_be_done_is_refused_before_anything_moves(skeleton, changes, message):
    """One line each: too wide, too narrow, too hard, out of reach, a parameter that lacks."""
    with pytest.raises(NetError) as refused:
        grounded(skeleton, **changes)

    assert message in str(refused.value)
    assert "\n" not in str(refused.value)


def test_the_way_aside_needs_no_package():
    """A hand that could do nothing with a package goes aside all the same, by the same file."""
    net = aside_net(turned=True)
    assert (net.grounded, net.ends) == ({"belt": "belt"}, {"aside": True, "blocked": False})
    with_package = dataclasses.replace(grounded("go_aside", turned=True), grounded=net.grounded)
    assert text_of_net(net) == text_of_net(with_package)


def test_the_arm_carries_the_gripper_too():
    """A gripper that could hold it does not help where the arm cannot lift both."""
    heavy = dataclasses.replace(JOB, grasp=dataclasses.replace(GRASP, mass_kg=9.5))
    with pytest.raises(NetError, match=r"of 9\.5 kg; the arm carries more than 0 and at most 9 kg"):
        ground(
            "grasp_from_belt", heavy, arm=ARM, gripper=Gripper(payload_kg=50.0, mass_kg=5.0),
            frames=FRAMES.__getitem__, near_rad=HOME_RAD,
        )  # fmt: skip


@pytest.mark.parametrize(
    ("found", "written", "message"),
    [
        (
            'bin = "entity"', 'bin = "thing"',
            "parameters.bin: unknown type 'thing'; known: entity, pose, m, rad",
        ),
        (
            '"grasp.width_m" = "m"', '"grasp.width_m" = "pose"',
            "parameter grasp.width_m is 0.095; it must be: pose",
        ),
        (
            '"grasp.width_m" = "m"', "",
            "primitives.raise_first.exits[1].when[1]: parameter grasp.width_m is not declared; declared:",
        ),
        (
            "{grasp.width_m} - 0.006 m", "{hand.bin_rad} - 0.006 m",
            "primitives.raise_first.exits[1].when[1]: hand.bin_rad has the type rad, not m",
        ),
        ("speed_m_s = 0.8", 'speed_m_s = "{clear_m}"', "speed_m_s: clear_m has the type m, not m/s"),
        ('entity = "{bin}"', 'entity = "{clear_m}"', "frame.entity: it is 0.13; it must be a string"),
    ],
)  # fmt: skip
def test_a_faulty_skeleton_names_file_and_parameter(tmp_path, found, written, message):
    """Parameters have types, and units that are checked where they stand."""
    text = (FOLDER / "remove_to_reject.toml").read_text("utf-8")
    assert found in text
    file = tmp_path / "own.toml"
    file.write_text(text.replace(found, written, 1), "utf-8")

    with pytest.raises(NetError) as refused:
        grounded(file)

    assert message in str(refused.value)
    assert str(file) in str(refused.value)


def test_poses_that_the_arm_has_are_reached_again():
    """40 random poses, each from home: within half a millimetre, and in range."""
    random = np.random.default_rng(3)
    states = random.uniform(-0.9, 0.9, (40, 7)) * ARM.q_max

    nearby = 0
    for number, wanted in enumerate(tool_poses(ARM, states)):
        found = reach(ARM, wanted, HOME_RAD)
        assert found.there, (number, found)
        nearby += found.nearby
        np.testing.assert_allclose(tool_poses(ARM, found.q_rad)[0], wanted, atol=4e-3)
        assert (np.abs(found.q_rad) <= ARM.q_max).all()
    assert 0 < nearby < 40
