"""Action skeletons and what binds them to a world context: a net for one package (ENACT 4.2).

`ground` binds the parameters of a skeleton to a `Job`.  In one line, before anything moves, it
refuses what lacks, what the gripper cannot hold and where the arm cannot go.

======================  ========  ==================================================================
parameter               type      is
======================  ========  ==================================================================
package, place, bin     entity    what the job names; belt: the cell's
grasp.frame             pose      in the package: between the fingers, y from one to the other, z up
grasp.width_m           m         between the fingers that hold it; grasp.open_m before
grasp.over_m            m         of the tool above the grasp when the fingers' tips are just above
                                  the package
grasp.height_m          m         of the fingers above the package's base
grasp.force_n           N         of the fingers
hand.turn_rad           rad       0, or π for the hand turned round
hand.bin_rad            rad       the hand over the bin
hand.aside_rad          rad       halfway between belt and tray, in the frame of the belt
push.frame              pose      in the place: origin as grasp.frame, x along the push, z up
hand.push_turn_rad      rad       the hand in it
push.gap_m              m         so far short of its place the package is put down, 0 if nothing
                                  pushes it
push.behind_m           m         from its grasp to the middle of the closed hand behind it
push.drop_m             m         so much lower than the grasp the hand pushes
push.force_n            N         tells the contact; push.travel_m (m) that there is none
gripper.closed_m        m         width of the closed gripper
clear_m                 m         height above the others while carrying
======================  ========  ==================================================================
"""

# The wire reads these annotations: they stay real types, without `from __future__`.

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from actors.geometry.arms.joint_paths import Arm
from actors.geometry.arms.reaching import reach
from actors.geometry.poses import inverse, roll_pitch_yaw, turned
from actors.palletizing.handling.net_files import net_of_document, read_document
from actors.palletizing.handling.nets import Net, NetError, Primitive
from actors.palletizing.handling.skeleton_files import bind
from actors.palletizing.placing import finger_room
from actors.palletizing.placing.finger_room import Beside, Grasp, Gripper

F64 = npt.NDArray[np.float64]
Frames = Callable[[str], F64]
Value = str | float | F64

FOLDER: Final = Path(__file__).parent / "skeletons"
SKELETONS: Final = tuple(sorted(file.stem for file in FOLDER.glob("*.toml")))
"""Names of the skeletons that come with the cell."""
CLEAR_M: Final = 0.13
PUSH_GAP_M: Final = 0.02
PUSH_FORCE_N: Final = 10.0
PUSH_TRAVEL_M: Final = 0.077
"""Beyond what the package stands short of its place."""
BESIDE_M: Final = 0.034
"""Between the closed hand and a package before a push; one grasped off its middle stands nearer."""
OVER_M: Final = 0.003
"""Between the tips and the package before they go down beside it."""
TAKING: Final = ("grasp_from_belt", "regrasp")
"""Skeletons that take a package with open fingers."""
SQUEEZE_M: Final = 0.006
"""So much less or more than its width a package between the fingers measures at most."""


@dataclass(frozen=True, slots=True, eq=False)
class Job:
    """What one action is about.

    Attributes:
        package: Entity of the package.
        grasp: Of its product.
        size_m: (3,) float64, the product's box, product frame.
        place: Entity of the place; "" if the action has none.
        push: (3,) float64, direction of the push, base frame; it is taken level.  Zeros: nothing
            pushes it.
        bin: Entity of the reject bin; "" if the action has none.
        turned: The hand is turned round by π: what was grasped so is placed so.
        gap_m: So far short of its place, against the push, the package is put down or stands.
        product: Name of its product, for errors.
        beside: Of each other package on the tray its entity, where it stands, base_from_product,
            (4, 4), metres, and the box of its product, (3,), metres.
    """

    package: str
    grasp: Grasp
    size_m: npt.NDArray[np.float64]
    place: str = ""
    push: npt.NDArray[np.float64] | None = None
    bin: str = ""
    turned: bool = False
    gap_m: float = PUSH_GAP_M
    product: str = ""
    beside: Beside = ()


def ground(
    skeleton: str, job: Job, *, arm: Arm, gripper: Gripper, frames: Frames, near_rad: F64
) -> Net:
    """Return the net of a skeleton for one package.

    Args:
        skeleton: One of `SKELETONS`, or the path of a file.
        job: What the action is about.
        arm: Kinematics and ranges; its base is the frame of `frames`.
        gripper: What holds the package.
        frames: Returns base_from_entity, (4, 4); KeyError if the entity is not known.  A package
            that stands so near to the entity "tray" that a finger goes down over its rim is held
            higher.
        near_rad: (n,), where the arm is.

    Raises:
        NetError: One line: a parameter lacks or is ill-typed, the package is too wide, too narrow
            or too heavy to hold, a finger has no room beside it, or a pose is out of
            the arm's reach.
        OSError: The skeleton cannot be read.
    """
    file = FOLDER / f"{skeleton}.toml" if skeleton in SKELETONS else Path(skeleton)
    about = f"{file.stem} for {job.package}"
    _check_grip(about, job, gripper)
    _check_payload(about, job, arm, gripper)
    job = _over_low(file.stem, job, gripper, frames)
    if file.stem in TAKING:
        _check_room(file.stem, about, job, gripper, frames)
    net = _bound(file, parameters(job, gripper, frames))
    _check_reach(about, net, arm, frames, near_rad)
    return net


def aside_net(*, turned: bool) -> Net:
    """Return the net that takes the tool between belt and tray, where it hides nothing.

    It needs no package: it is also for a hand that could do nothing with one.

    Args:
        turned: Whether the hand is turned round.
    """
    return _bound(FOLDER / "go_aside.toml", {"belt": "belt", "hand.aside_rad": _aside_rad(turned)})


def _aside_rad(turned: bool) -> float:
    return 0.75 * math.pi if turned else -0.25 * math.pi


def _bound(file: Path, values: Mapping[str, Value]) -> Net:
    """Return the net of a skeleton with its parameters; it names the entities that it is about."""
    skeleton = read_document(file)
    document = bind(skeleton, values, str(file))
    kinds = skeleton.get("parameters", {}).items()
    entities = ["package", *(name for name, kind in kinds if kind == "entity")]
    document["grounded"] = {name: values[name] for name in entities if name in values}
    return net_of_document(document, str(file))


def easier_turn(job: Job, *, arm: Arm, frames: Frames, near_rad: F64) -> bool:
    """Return whether the hand has less to turn when it grasps turned round, see `Job.turned`.

    What it turns on the way to the place, if there is one, counts as well.

    Raises:
        NetError: It is not known where the package or its place is.
    """
    entities = [job.package, job.place] if job.place else [job.package]
    travel = []
    for turn_rad in (0.0, math.pi):
        away, q_rad = 0.0, near_rad
        for entity in entities:
            pose = _known(frames, entity) @ _grasp_frame(job.grasp)
            pose[:3, :3] = pose[:3, :3] @ turned(math.pi, 0.0, turn_rad)
            reached = reach(arm, pose, q_rad)
            if not (reached.there and reached.nearby):
                away = np.inf
                break
            away += float(np.abs(reached.q_rad - q_rad).max())
            q_rad = reached.q_rad
        travel.append(away)
    return travel[1] < travel[0]


def parameters(job: Job, gripper: Gripper, frames: Frames) -> dict[str, Value]:
    """Return the values of all parameters that a job has, by name; see the module.

    Raises:
        NetError: It is not known where the place is, or the push has no level direction.
    """
    grasp = job.grasp
    values: dict[str, Value] = {
        "package": job.package,
        "grasp.frame": _grasp_frame(grasp),
        "grasp.width_m": grasp.width_m,
        "grasp.open_m": finger_room.open_m(grasp, gripper, on_belt=True),
        "grasp.over_m": float(job.size_m[2] - grasp.point[2]) + gripper.tips_m + OVER_M,
        "grasp.height_m": float(grasp.point[2]),
        "grasp.force_n": grasp.force_n,
        "hand.turn_rad": math.pi if job.turned else 0.0,
        "hand.aside_rad": _aside_rad(job.turned),
        "hand.bin_rad": 0.5 * math.pi if job.turned else -0.5 * math.pi,
        "belt": "belt",
        "gripper.closed_m": gripper.least_m + 0.001,
        "clear_m": CLEAR_M,
    }
    if job.bin:
        values["bin"] = job.bin
    if job.place:
        values["place"] = job.place
    if job.place and job.push is not None:
        values |= _push_values(job, gripper, _known(frames, job.place))
    return values


def _grasp_frame(grasp: Grasp) -> F64:
    """Return product_from_grasp: y is the fingers' way, z is up."""
    frame = np.eye(4)
    across = np.array([grasp.axis[0], grasp.axis[1], 0.0])
    frame[:3, 1] = across / np.linalg.norm(across)
    frame[:3, 0] = np.cross(frame[:3, 1], [0.0, 0.0, 1.0])
    frame[:3, 3] = grasp.point
    return frame


def _push_values(job: Job, gripper: Gripper, base_from_place: F64) -> dict[str, Value]:
    """Return what a push at a place needs."""
    grasp = job.grasp
    push = np.asarray(job.push, np.float64)
    along = inverse(base_from_place)[:3, :3] @ push
    along[2] = 0.0
    length = float(np.linalg.norm(along))
    gap_m = job.gap_m if push.any() else 0.0
    if not push.any():
        along, length = np.array([1.0, 0.0, 0.0]), 1.0
    if not length > 0.5:
        found = np.round(push, 3).tolist()
        raise NetError(f"push of {job.package} at {job.place}: {found} is no level direction")
    along /= length
    frame, held = np.eye(4), _grasp_frame(grasp)
    frame[:3, 0], frame[:3, 3] = along, grasp.point
    frame[:3, 1] = np.cross([0.0, 0.0, 1.0], along)
    yaw = float(roll_pitch_yaw(frame[:3, :3].T @ held[:3, :3])[2])
    yaw += math.pi if job.turned else 0.0
    package_m = 0.5 * float(np.abs(along[:2]) @ np.asarray(job.size_m)[:2])
    hand = np.abs(held[:3, :2].T @ along) @ [gripper.half_across_m, gripper.half_m]
    ahead_m = float(along @ grasp.point)
    return {
        "push.frame": frame,
        "hand.push_turn_rad": math.remainder(yaw, 2.0 * math.pi),
        "push.gap_m": gap_m,
        "push.behind_m": package_m + ahead_m + float(hand) + BESIDE_M,
        "push.drop_m": float(grasp.point[2]) - grasp.push_height_m,
        "push.force_n": PUSH_FORCE_N,
        "push.travel_m": PUSH_TRAVEL_M + gap_m,
    }


def _known(frames: Frames, entity: str) -> F64:
    try:
        return frames(entity)
    except KeyError:
        raise NetError(f"it is not known where {entity} is") from None


def _check_grip(about: str, job: Job, gripper: Gripper) -> None:
    grasp = job.grasp
    most_m = gripper.most_m - gripper.play_m
    if not grasp.width_m <= most_m:
        raise NetError(
            f"{about}: it is {1e3 * grasp.width_m:.0f} mm wide where it is grasped; the gripper"
            f" takes at most {1e3 * most_m:.0f} mm"
        )
    if not grasp.width_m >= gripper.least_m + SQUEEZE_M:
        raise NetError(
            f"{about}: it is {1e3 * grasp.width_m:.0f} mm wide where it is grasped; the gripper"
            f" holds no less than {1e3 * (gripper.least_m + SQUEEZE_M):.0f} mm"
        )
    if not 0.0 < grasp.force_n <= gripper.force_n_max:
        raise NetError(
            f"{about}: its grasp asks for {grasp.force_n:g} N; the gripper has at most"
            f" {gripper.force_n_max:g} N"
        )
    if not np.hypot(*grasp.axis[:2]) > 0.5:
        found = np.round(grasp.axis, 3).tolist()
        raise NetError(f"{about}: the axis of its grasp {found} is not level")


def _over_low(skeleton: str, job: Job, gripper: Gripper, frames: Frames) -> Job:
    """Return the job with a grasp over what is low beside the package, if that can hold it.

    All stages of a request get the same one, as long as it is not known to be elsewhere.
    """
    try:
        base_from_package = frames(job.package)
    except KeyError:
        return job
    beside, opened_m = _beside(skeleton, job, gripper, frames)
    base_from_grasp = base_from_package @ _grasp_frame(job.grasp)
    grasp = finger_room.over_low(job.grasp, job.size_m, base_from_grasp, beside, gripper, opened_m)
    return replace(job, grasp=grasp)


def _check_room(skeleton: str, about: str, job: Job, gripper: Gripper, frames: Frames) -> None:
    """Refuse a grasp of which a finger would come down on something beside the package."""
    beside, opened_m = _beside(skeleton, job, gripper, frames)
    base_from_grasp = _known(frames, job.package) @ _grasp_frame(job.grasp)
    entity = finger_room.in_the_way(base_from_grasp, beside, gripper, opened_m)
    if entity is not None:
        raise NetError(f"{about}: {entity} leaves no room for a finger beside it")


def _beside(skeleton: str, job: Job, gripper: Gripper, frames: Frames) -> tuple[Beside, float]:
    """Return what stands beside a package, and how wide the hand is open when it takes it."""
    beside, on_belt = job.beside, skeleton != "regrasp"
    try:
        base_from_tray, base_from_package = frames("tray"), frames(job.package)
    except KeyError:
        pass
    else:
        beside = (*beside, *finger_room.rim_beside(base_from_tray))
        if skeleton not in TAKING:
            on_belt = not finger_room.on_tray(base_from_tray, base_from_package)
    return beside, finger_room.open_m(job.grasp, gripper, on_belt=on_belt)


def _check_payload(about: str, job: Job, arm: Arm, gripper: Gripper) -> None:
    mass_kg = job.grasp.mass_kg
    if not arm.payload_kg > 0.0:
        raise NetError(f"{about}: the payload of the arm is not known; its model has to state it")
    limits_kg = {"gripper": gripper.payload_kg, "arm": arm.payload_kg - gripper.mass_kg}
    weaker = min(limits_kg, key=lambda which: limits_kg[which])
    if not 0.0 < mass_kg <= limits_kg[weaker]:
        raise NetError(
            f"{about}: a {job.product or 'package'} of {mass_kg:g} kg; the {weaker} carries more"
            f" than 0 and at most {limits_kg[weaker]:g} kg"
        )


def _check_reach(about: str, net: Net, arm: Arm, frames: Frames, near_rad: F64) -> None:
    """Refuse a net with a target that the arm cannot come to, or not without swinging round."""
    q_rad = near_rad
    for name, pose in _targets(net, frames):
        reached = reach(arm, pose, q_rad)
        x, y, z = pose[:3, 3]
        if not reached.there:
            raise NetError(
                f"{about}: primitive {name}: x {x:.3f}, y {y:.3f}, z {z:.3f} m of the base is out"
                f" of reach; the arm comes within {1e3 * reached.off_m:.0f} mm and"
                f" {math.degrees(reached.off_rad):.0f}° of it"
            )
        if not reached.nearby:
            raise NetError(
                f"{about}: primitive {name}: the arm comes to x {x:.3f}, y {y:.3f}, z {z:.3f} m of"
                " the base in another posture only; turn the hand round, or begin elsewhere"
            )
        q_rad = reached.q_rad


def _targets(net: Net, frames: Frames) -> Iterator[tuple[str, F64]]:
    """Yield the poses, base_from_tool, that the primitives of a net go to by position."""
    for name in net.reachable(net.start):
        primitive = net.primitives.get(name)
        if primitive is not None and _goes_to_a_pose(primitive):
            frame, values = primitive.frame, [axis.value for axis in primitive.axes]
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = turned(*values[3:]), values[:3]
            entity = np.eye(4) if frame.entity == "base" else _known(frames, frame.entity)
            yield name, entity @ frame.offset @ pose


def _goes_to_a_pose(primitive: Primitive) -> bool:
    modes = {axis.mode for axis in primitive.axes}
    return modes == {"position"} and primitive.frame.entity != "tool"
