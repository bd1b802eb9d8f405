"""Entities and aspects of the human-robot workcell (ENACT 4.1, Figure 4), with units and frames.

==================  ==================================================================  =========
entity              stands for                                                          contexts
==================  ==================================================================  =========
`camera/<i>`        one camera: calibration, image, background, silhouette              online
`workspace`         the watched volume: grid, hull, the operator's word that it is empty online
`obstacle/<n>`      one static thing in the cell: surface, boxes                        online
`human/<n>`         one person: track, limbs, prediction; in truth: the true body       both
`robot`             the arm: model, joints, task, path, speed, execution                online
`system`            the cell: state of safety, state of the cameras                     online
`scenario`          what the simulators play, and since when                            truth
==================  ==================================================================  =========

World contexts: *online* is the paper's single context.  *truth* is written by the simulators only
and read by simulated cameras and by the evaluation only; no actor that decides anything names it.

Frames: *cell* has its origin on the floor under the robot's base, x and y along the sides of the
workspace, z up.  *camera/<i>* is an optical frame: x right, y down, z forward.  *robot/tcp* is the
tool.  Metres, radians, seconds; stamps in nanoseconds since 1970.

The stamp of a set is that of the exposure.  Hull, tracks, predictions, path and speed carry it on,
so that each of them says on which images it rests.
"""

# The wire reads these annotations: they stay real types, without `from __future__`.

from dataclasses import dataclass, field
from typing import Final

import numpy as np
import numpy.typing as npt

from actors.geometry.shapes import Surface
from enact_dist import Aspect, Durability, Entities, Entity, Retention

CAMERAS: Final = Entities("camera/*")
OBSTACLES: Final = Entities("obstacle/*")
HUMANS: Final = Entities("human/*")
WORKSPACE: Final = Entity("workspace")
ROBOT: Final = Entity("robot")
SYSTEM: Final = Entity("system")
SCENARIO: Final = Entity("scenario")

CAMERA_COUNT: Final = 8
"""Cameras of the cell in its delivered configuration."""
PERIOD_S: Final = 0.1
"""Period of the capture and of all that follows from it."""
PERIOD_NS: Final = round(PERIOD_S * 1e9)
SET_BACK_NS: Final = 1_000_000_000
"""Stamps that fall by more are of a clock that was set back; what is known by it begins anew."""
IMAGES_COMPARED: Final = 4
"""An image that equals one of so many before it is stuck: a driver may alternate its buffers."""
JOINT_COUNT: Final = 7
"""Joints of the arm."""
JOINTS_KEPT: Final = 30
"""Samples in one datum of `JOINTS`: 0.3 s at 100 Hz."""
NO_PATH: Final = (-1, 0)
"""Identity of no path."""


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """Where a camera stands and how it projects (camera/*).

    Attributes:
        camera_matrix: (3, 3) float64, pixels; the centre of the first pixel is (0, 0).
        distortion: (5,) float64: k1, k2, p1, p2, k3 as OpenCV defines them.
        camera_from_cell: (4, 4) float64, metres.
        width: Columns of the image.
        height: Rows of the image.
    """

    camera_matrix: npt.NDArray[np.float64]
    distortion: npt.NDArray[np.float64]
    camera_from_cell: npt.NDArray[np.float64]
    width: int
    height: int


@dataclass(frozen=True, slots=True, eq=False)
class Background:
    """What a camera sees of the empty cell (camera/*).

    Attributes:
        mean: (H, W, 3) uint8, BGR, after the box filter of the subtraction.
        spread: (H, W, 3) uint8, standard deviation of the filtered images, levels, rounded up.
        frames: Number of images that it was learned from.
        captured_ns: Stamp of the last of them.
        hidden: (H, W / 8) uint8, as `Silhouette.packed`; a set bit was never free of the arm, so
            the camera never says *free* there.  (0, 0) if there is none.
        hidden_px: Number of its set bits.
    """

    mean: npt.NDArray[np.uint8]
    spread: npt.NDArray[np.uint8]
    frames: int
    captured_ns: int
    hidden: npt.NDArray[np.uint8] = field(default_factory=lambda: np.empty((0, 0), np.uint8))
    hidden_px: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class Silhouette:
    """Foreground of one image (camera/*).

    Attributes:
        packed: (H, W / 8) uint8, `numpy.packbits` along the rows; a set bit is foreground.
        foreground_px: Number of set bits.
        stand_in: The camera gave no image: all bits are set, so that it vetoes nothing.
        image_checksum: CRC-32 of the image; that of one of the last sets means that the image is
            stuck.  0 of a stand-in and of a mask that came as a mask.
        shade: As `packed`; a set bit is no foreground, but looks like a shadow: the camera says
            neither that something is there nor that it is free.  (0, 0) if there is none.
    """

    packed: npt.NDArray[np.uint8]
    foreground_px: int
    stand_in: bool = False
    image_checksum: int = 0
    shade: npt.NDArray[np.uint8] = field(default_factory=lambda: np.empty((0, 0), np.uint8))


@dataclass(frozen=True, slots=True, eq=False)
class Grid:
    """The voxels of the workspace (workspace).

    Attributes:
        origin_m: (3,) float64, lowest corner in the cell frame.
        voxel_m: Edge of a voxel.
        shape: Voxels along x, y, z, each a multiple of 4.  The centre of voxel (i, j, k) is
            ``origin_m + (index + 0.5) * voxel_m``.
    """

    origin_m: npt.NDArray[np.float64]
    voxel_m: float
    shape: tuple[int, int, int]


@dataclass(frozen=True, slots=True, eq=False)
class Hull:
    """What is occupied and neither robot nor static (workspace); the stamp is the exposure's.

    All of `voxels` are the safe set: what protects uses all of them.  Of more than 150,000 only the
    nearest to the robot are there.

    Attributes:
        voxels: (N, 3) int16, indices into the grid.
        clearance_m: (N,) float32, from the voxel (its surrounding sphere) to the robot's surface.
        tight: (N,) bool, the voxel belongs to the tight set: figures, tracking, scores.
        component: (N,) int16, number of its connected component, from 0.
        counts: Voxels that each rule of the refinement removed, by name of the rule; "raw" is the
            number before refinement, "distant" how many are left out because there are too many.
        cameras: Names of the cameras that gave an image, in order; the others stood in.
        nearest_m: Least clearance; infinite if nothing is occupied.
        nearest_voxel: Row of `voxels` that has it; -1 if nothing is occupied.
    """

    voxels: npt.NDArray[np.int16]
    clearance_m: npt.NDArray[np.float32]
    tight: npt.NDArray[np.bool_]
    component: npt.NDArray[np.int16]
    counts: dict[str, int]
    cameras: tuple[str, ...]
    nearest_m: float
    nearest_voxel: int


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """Where a person is and where to they walk (human/*); the stamp is the exposure's.

    Attributes:
        position_m: (3,) float64: x, y of the middle of the body; z of the top of the head.
        velocity_m_s: (3,) float64; the third is 0.
        covariance: (6, 6) float64 of position and velocity.
        height_m: Height of the person.
        volume_m3: Volume of the tight hull of the person.
        first_ns: Stamp of the set in which the track began.
        hidden: No camera sees the person now; they are where none can look.
        seen_ns: Stamp of the set in which they were last seen.
        foreign: Low and still for a while: an object that was left, or a person who lies.
    """

    position_m: npt.NDArray[np.float64]
    velocity_m_s: npt.NDArray[np.float64]
    covariance: npt.NDArray[np.float64]
    height_m: float
    volume_m3: float
    first_ns: int
    hidden: bool
    seen_ns: int = 0
    foreign: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class Prediction:
    """Where a person will be (human/*); for planning only, never for the protective distance.

    Attributes:
        at_s: (K,) float64, seconds after the stamp; K = 10 over 1 s.
        centre_m: (K, 2) float64, x and y in the cell frame.
        radius_m: (K,) float64, of an upright cylinder around it that holds the person.
    """

    at_s: npt.NDArray[np.float64]
    centre_m: npt.NDArray[np.float64]
    radius_m: npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class ArmModel:
    """Kinematics, shape and limits of the arm (robot).

    Frame 0 is the base, frame i stands behind joint i, frame 7 is the flange.

    Attributes:
        dh: (7, 4) float64, per joint: d (m), a (m), alpha (rad), offset of theta (rad); classic
            Denavit-Hartenberg.
        base: (4, 4) float64, cell from frame 0.
        capsules: (n, 5) float64: first frame, offset along its z (m), second frame, offset along
            its z (m), radius (m).
        q_max: (7,) float64, rad; the limits are symmetric.
        dq_max: (7,) float64, rad/s.
        ddq_max: (7,) float64, rad/s².
        payload_kg: What the flange may carry, the hand and what it holds; 0: not known, so nothing.
    """

    dh: npt.NDArray[np.float64]
    base: npt.NDArray[np.float64]
    capsules: npt.NDArray[np.float64]
    q_max: npt.NDArray[np.float64]
    dq_max: npt.NDArray[np.float64]
    ddq_max: npt.NDArray[np.float64]
    payload_kg: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Joints:
    """The arm's last 0.3 s at 100 Hz (robot), so that a reader interpolates at the exposure.

    Attributes:
        q: (30, 7) float64, rad, oldest first.
        dq: (30, 7) float64, rad/s.
        stamp_ns: (30,) int64, when each was measured; increasing.
    """

    q: npt.NDArray[np.float64]
    dq: npt.NDArray[np.float64]
    stamp_ns: npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class Task:
    """What the robot shall do (robot): go from goal to goal.

    Attributes:
        goals: (n, 7) float64, rad.
        dwell_s: (n,) float64, how long it stays at each.
        cyclic: After the last goal comes the first.
    """

    goals: npt.NDArray[np.float64]
    dwell_s: npt.NDArray[np.float64]
    cyclic: bool


@dataclass(frozen=True, slots=True, eq=False)
class Path:
    """A path of the joints (robot); the stamp is that of the hull that it was planned on.

    Attributes:
        waypoints: (n, 7) float64, rad, joined by straight lines; none while no path exists.
        number: Counts the paths since the shard's start.
        from_goal: Goal that it comes from, -1 at the start.
        to_goal: Goal that it leads to.
        planned_ns: When planning ended.
        length_rad: Sum of the Euclidean lengths of its pieces.
        reason: Why there is no path, or why it replaced the last one.
        took_ms: Duration of planning.
        captured_ns: Exposure of the hull that it was planned on.
    """

    waypoints: npt.NDArray[np.float64]
    number: int
    from_goal: int
    to_goal: int
    planned_ns: int
    length_rad: float
    reason: str = ""
    took_ms: float = 0.0
    captured_ns: int = 0

    @property
    def identity(self) -> tuple[int, int]:
        """What tells it from all others: after a restart of the shard numbers begin anew."""
        return self.number, self.planned_ns


@dataclass(frozen=True, slots=True)
class Speed:
    """How fast the robot may be (robot); the stamp is the exposure's.

    Attributes:
        scale: 0 to 1 of the path's nominal speed.
        limit_m_s: For the quickest point of the arm; infinite where nothing limits.
        nearest_m: Distance that it was made of.
        reason: What limits, in words.
        valid_ms: How long after `captured_ns` it may be moved on.
        captured_ns: Exposure of the set that it rests on.
        joints_ns: Stamp of the newest joint sample that it rests on.
        human_m_s: Speed of people (v_h) that it was made with.
    """

    scale: float
    limit_m_s: float
    nearest_m: float
    reason: str
    valid_ms: float
    captured_ns: int
    joints_ns: int
    human_m_s: float = 1.6


@dataclass(frozen=True, slots=True)
class Execution:
    """What the robot made of the newest command (robot); the stamp is the exposure's.

    Attributes:
        state: "moving", "dwelling", "waiting" (for a path), "stopped" (scale 0) or "refused" (the
            stamps of the command are too old, or cannot be).
        scale: Share of the nominal speed at which it moves now, 0 to 1.
        speed_m_s: Of the quickest point of the arm now.
        captured_ns: Exposure on which the command rests.
        received_ns: When the command reached the robot's loop.
        path_number: Number of the path that it follows.
        goals_reached: How many goals it has reached since its start.
        refused: How many commands it has refused since its start because they were too old.
        reason: Why the command was refused, or why the arm brakes or rests; empty if nothing
            keeps it from moving.
        refused_path: Identity of the last path that it has refused: the arm had passed the place
            where it begins, or its exposure is earlier than that of the path before, or ahead of
            the robot's clock.
        path_refusal: Why, in words; empty if it has refused none.
    """

    state: str
    scale: float
    speed_m_s: float
    captured_ns: int
    received_ns: int
    path_number: int
    goals_reached: int
    refused: int
    reason: str = ""
    refused_path: tuple[int, int] = NO_PATH
    path_refusal: str = ""


@dataclass(frozen=True, slots=True)
class Safety:
    """State of the cell (system).

    Attributes:
        state: "run", "slow", "stop" or "fault".
        reason: Why, in words.
        since_ns: Exposure from which on it holds.
    """

    state: str
    reason: str
    since_ns: int


@dataclass(frozen=True, slots=True)
class CameraState:
    """How a camera does.

    Attributes:
        alive: It gave the image of the newest set.
        last_ns: Stamp of its last own silhouette.
        sets_missed: Sets in which another stood in for it.
        trouble: "" or what is wrong: "silent", "stuck", "background no longer fits".
    """

    alive: bool
    last_ns: int
    sets_missed: int
    trouble: str = ""


@dataclass(frozen=True, slots=True)
class Playing:
    """What the simulators play (scenario, truth).

    Attributes:
        scenario: Name of the scenario.
        seed: Its seed.
        start_ns: Stamp of its second 0.  Before it, the cell is empty.
        seconds: How long it lasts.
        robot: The images show the arm.  Not while backgrounds are learned.
    """

    scenario: str
    seed: int
    start_ns: int
    seconds: float
    robot: bool


@dataclass(frozen=True, slots=True, eq=False)
class Body:
    """The true body of a person (human/*, truth) at the stamp.

    Attributes:
        capsules: (n, 7) float32: end, end, radius, in the cell frame.
        centre_m: (2,) float64, x and y of the middle of the body.
        velocity_m_s: (2,) float64, of that.
    """

    capsules: npt.NDArray[np.float32]
    centre_m: npt.NDArray[np.float64]
    velocity_m_s: npt.NDArray[np.float64]


_FLOW: Final = Durability.VOLATILE

CALIBRATION: Final = Aspect("calibration", Calibration, Durability.DURABLE)
"""Where a camera stands (camera/*)."""
IMAGE: Final = Aspect("image", np.ndarray, _FLOW, retention=Retention(versions=16))
"""(H, W, 3) uint8, BGR, as captured (camera/*)."""
BACKGROUND: Final = Aspect("background", Background, Durability.OS)
"""The empty cell (camera/*)."""
SILHOUETTE: Final = Aspect("silhouette", Silhouette, _FLOW, retention=Retention(versions=16))
"""Foreground of the image with the same stamp (camera/*)."""
ABSENT: Final = Aspect("absent_ns", int, _FLOW, retention=1)
"""Stamp of the newest set that needs a substitute silhouette (camera/*)."""
GRID: Final = Aspect("grid", Grid, Durability.DURABLE)
"""The voxels (workspace)."""
EMPTY: Final = Aspect("empty_ns", int, Durability.OS)
"""When the operator last confirmed that the cell is empty (workspace): backgrounds are learned from
images with a later stamp, and reachability begins with an empty cell."""
HULL: Final = Aspect("hull", Hull, _FLOW, retention=Retention(versions=100))
"""What is occupied (workspace)."""
RAW_HULL: Final = Aspect("raw_hull", np.ndarray, _FLOW, retention=Retention(versions=4))
"""(N, 3) int16, voxels before the refinement (workspace); only while `WANTED` is above 0."""
WANTED: Final = Aspect("wanted", int, _FLOW, retention=1)
"""How many look at `RAW_HULL` (workspace)."""
SURFACE: Final = Aspect("surface", Surface, Durability.DURABLE)
"""Boundary representation in the cell frame (obstacle/*)."""
BOXES: Final = Aspect("boxes", np.ndarray, Durability.DURABLE)
"""(n, 15) float64: centre (3), half sizes (3), rotation row by row (9), cell frame (obstacle/*)."""
TRACK: Final = Aspect("track", Track, _FLOW, retention=Retention(versions=600))
"""Where a person is (human/*)."""
LIMBS: Final = Aspect("limbs", np.ndarray, _FLOW, retention=Retention(versions=100))
"""(n, 7) float32 capsules in the cell frame: end, end, radius (human/*)."""
PREDICTION: Final = Aspect("prediction", Prediction, _FLOW, retention=Retention(versions=100))
"""Where a person will be (human/*)."""
MODEL: Final = Aspect("model", ArmModel, Durability.DURABLE)
"""The arm (robot)."""
JOINTS: Final = Aspect("joints", Joints, _FLOW, retention=Retention(versions=100))
"""Where the arm was and is (robot)."""
TASK: Final = Aspect("task", Task, Durability.DURABLE)
"""What the robot shall do (robot)."""
PATH: Final = Aspect("path", Path, _FLOW, retention=Retention(versions=100))
"""Along what it moves (robot)."""
SPEED: Final = Aspect("speed", Speed, _FLOW, retention=Retention(versions=600))
"""How fast it may (robot)."""
EXECUTION: Final = Aspect("execution", Execution, _FLOW, retention=Retention(versions=600))
"""What it does (robot)."""
SAFETY: Final = Aspect("safety", Safety, Durability.OS)
"""State of the cell (system)."""
CAMERA_STATES: Final = Aspect("cameras", dict[str, CameraState], _FLOW)
"""How the cameras do, by name of the entity (system)."""
PLAYING: Final = Aspect("playing", Playing, Durability.OS)
"""What is played (scenario, truth)."""
BODY: Final = Aspect("body", Body, _FLOW, retention=Retention(versions=600))
"""The true body (human/*, truth)."""


def camera_entity(number: int) -> Entity:
    """Return the entity of a camera, numbered from 0."""
    return Entity(f"camera/{number}")


def human_entity(number: int) -> Entity:
    """Return the entity of a person, numbered from 0."""
    return Entity(f"human/{number}")


def obstacle_entity(number: int) -> Entity:
    """Return the entity of a static obstacle, numbered from 0."""
    return Entity(f"obstacle/{number}")
