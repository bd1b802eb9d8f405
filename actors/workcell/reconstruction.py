"""Reconstruction (ENACT 4.1): which voxels are occupied, of a set of silhouettes of one stamp."""

from __future__ import annotations

import math
import time
from collections import deque
from typing import TYPE_CHECKING, Final, Self

import numpy as np

from actors.geometry.arms.kinematics import capsules_at
from actors.geometry.hull.refinement import Refinement
from actors.geometry.hull.visibility import camera_table, check_calibration
from actors.geometry.hull.visual_hull import VisualHull
from actors.geometry.hull.voxels import VoxelBlocks
from actors.workcell.background import one_thread
from actors.workcell.vocabulary import (
    BOXES,
    CALIBRATION,
    CAMERA_COUNT,
    CAMERAS,
    GRID,
    HULL,
    IMAGES_COMPARED,
    JOINTS,
    MODEL,
    OBSTACLES,
    PERIOD_S,
    RAW_HULL,
    ROBOT,
    SILHOUETTE,
    SURFACE,
    WANTED,
    WORKSPACE,
    Calibration,
    Hull,
    Joints,
    Silhouette,
    camera_entity,
)
from enact_dist import Actor, Together, View, ViewEach, World, Write

if TYPE_CHECKING:
    from collections.abc import Container, Iterable, Mapping

    import numpy.typing as npt

    from actors.geometry.hull.refinement import Refined
    from actors.geometry.hull.visibility import CameraTable
    from actors.workcell.vocabulary import ArmModel
    from enact_dist import Entity, Lock

    F64 = npt.NDArray[np.float64]

AHEAD_NS_MAX: Final = 100_000_000
"""So long after the newest sample of the joints their speed still tells where they are."""
VOXELS_MAX: Final = 150_000
"""A hull of more voxels, ten times those of a person, keeps the nearest to the robot: all cameras
in the dark fill the grid, and 100 versions of that would take 3 GB of the shard."""
HUMAN_M_S: Final = 1.6
"""Speed of a person, ISO/TS 15066, as in speed control."""
GAP_S: Final = 0.5
"""After so long without a hull a late one is better than none: it says why the robot stands."""

_ONLINE: Final = World("online")


def _sets(cameras: int, within_s: float, least: int) -> Together[Silhouette]:
    views = [View(_ONLINE, camera_entity(number), SILHOUETTE) for number in range(cameras)]
    return Together(views, least=least, within_s=within_s, newest_only=True)


_SILHOUETTES: Final = _sets(CAMERA_COUNT, 0.0, 1)


class Reconstruction(Actor):
    """Intersect the silhouettes of all cameras, and take out what is known.

    A camera that gives no silhouette, a stand-in, or the image of one of the last four sets, vetoes
    nothing: its rays count as occupied, the hull can only grow.  `Hull.cameras` names those that
    did.  Without joints that tell where the robot was at the exposure nothing is taken for the
    robot, and everything is at distance 0.

    Attributes:
        robot: There is one; False for a cell of cameras only: everything is infinitely far from it.
        within_s: How far the exposures of one set may lie apart; above 0 for cameras without a
            common trigger.  What is occupied, and the uncertainty of its distance, grow by what a
            person walks in that time: the hull holds who was there at the oldest exposure.
        stuck: An image that equals one of the last four counts as none; False for pictures without
            noise.
    """

    online = _ONLINE
    silhouettes = _SILHOUETTES
    calibrations = ViewEach(online, CAMERAS, CALIBRATION)
    boxes = ViewEach(online, OBSTACLES, BOXES)
    surfaces = ViewEach(online, OBSTACLES, SURFACE)
    grid = View(online, WORKSPACE, GRID)
    model = View(online, ROBOT, MODEL)
    joints = View(online, ROBOT, JOINTS)
    wanted = View(online, WORKSPACE, WANTED)
    hull = Write(online, WORKSPACE, HULL)
    raw_hull = Write(online, WORKSPACE, RAW_HULL)
    triggers = (silhouettes,)

    robot: bool = True
    stuck: bool = True
    late_s: float = math.inf
    """A set this old is passed over while hulls come: no robot may move on it, and the next sets
    would be late, too.  After `GAP_S` without a hull it is taken all the same."""

    def __init__(
        self,
        *,
        robot: bool = True,
        stuck: bool = True,
        cameras: int | None = None,
        within_s: float | None = None,
    ) -> None:
        every = self.silhouettes
        if cameras not in (None, len(every.requests)) or within_s not in (None, every.within_s):
            raise ValueError(
                f"asked for {cameras} cameras within {within_s} s; this class is for"
                f" {len(every.requests)} within {every.within_s:g} s; Reconstruction.of(cameras,"
                " within_s) returns another"
            )
        self.robot, self.stuck, self.within_s = robot, stuck, every.within_s
        self._made_of: object = None
        self._made: tuple[Refinement, VoxelBlocks] | None = None
        self._last_ns = self._written_ns = 0
        self._images = NewImages()

    @classmethod
    def of(
        cls, cameras: int = CAMERA_COUNT, within_s: float = 0.0, *, least: int = 1
    ) -> type[Self]:
        """Return the reconstruction of a cell.

        Args:
            cameras: How many it has, 2 or more.
            within_s: See the class; less than half the period.
            least: With how many silhouettes a set is used, at least.

        Raises:
            ValueError: One of them is out of range.
        """
        if not within_s < PERIOD_S / 2:
            raise ValueError(
                f"within_s is {within_s:g}; with half the period, {PERIOD_S / 2:g} s, or more it"
                " cannot be known which image belongs to which set"
            )
        every = _sets(cameras, within_s, least)
        if every == cls.silhouettes:
            return cls
        names = {"silhouettes": every, "triggers": (every,), "__module__": cls.__module__}
        return type(cls.__name__, (cls,), names)

    @classmethod
    def of_options(cls, options: Mapping[str, object]) -> type[Self]:
        """Return the reconstruction of a cell by the options `cameras` and `within_s`."""
        cameras, within_s = options.get("cameras"), options.get("within_s")
        return cls.of(
            cameras if isinstance(cameras, int) else len(cls.silhouettes.requests),
            within_s if isinstance(within_s, float) else cls.silhouettes.within_s,
        )

    def start(self) -> None:
        """Let OpenCV work in the actor's own thread."""
        one_thread()

    def now_ns(self) -> int:
        """Return the time, ns since 1970; a simulation has its own."""
        return time.time_ns()

    def update(self, lock: Lock) -> None:
        """Write the occupied voxels with the stamp of the set; skip a set that is too late."""
        stamp_ns, now_ns = lock.stamp_ns(self.silhouettes), self.now_ns()
        fresh = now_ns - self._written_ns < GAP_S * 1e9
        if fresh and now_ns - stamp_ns > self.late_s * 1e9:
            return
        refinement, blocks = self._prepared(lock)
        found = dict(zip(self._names, lock[self.silhouettes], strict=True))
        given = self._images.of(found, or_repeated=not self.stuck)
        seen = [given.get(name) for name in self._names]
        arm: F64 | None = np.empty((0, 7))
        if self.robot:
            arm = arm_at(lock.get(self.model), lock.get(self.joints), stamp_ns)
        occupied = refinement.step(
            [one.packed if one else None for one in seen],
            arm,
            (stamp_ns - self._last_ns) / 1e9 if self._last_ns else math.inf,
            [one.shade if one else None for one in seen],
        )
        self._last_ns, self._written_ns = stamp_ns, now_ns
        if self.robot and len(occupied.rows) > VOXELS_MAX:
            occupied = occupied.limited(VOXELS_MAX)
        lock[self.hull] = hull_of(occupied, blocks, tuple(given), self._moved_m)
        if lock.get(self.wanted, 0) > 0:
            lock[self.raw_hull] = blocks.indices(occupied.raw)

    def tables(
        self, blocks: VoxelBlocks, calibrations: list[Calibration], boxes: list[F64]
    ) -> list[CameraTable]:
        """Return what each camera can say about the voxels of a grid."""
        return [camera_table(blocks, calibration, boxes) for calibration in calibrations]

    def _prepared(self, lock: Lock) -> tuple[Refinement, VoxelBlocks]:
        """Return refinement and grid; rebuild the tables if the cell has changed.

        Raises:
            ValueError: Grid or calibration of a camera are missing or wrong, or an obstacle has a
                surface and no boxes; in one line.
        """
        of_camera = {entity.name: one for entity, one in lock[self.calibrations].items()}
        of_obstacle = dict(lock[self.boxes].items())
        check_known(
            self._names, of_camera, of_obstacle, lock[self.surfaces],
            has_grid=not lock.is_null(self.grid),
        )  # fmt: skip
        calibrations = [of_camera[name] for name in self._names]
        boxes = [of_obstacle[entity] for entity in sorted(of_obstacle, key=str)]
        made_of = (lock.version(self.grid), _bytes_of(calibrations, boxes))
        if self._made is not None and made_of == self._made_of:
            return self._made
        for name, calibration in zip(self._names, calibrations, strict=True):
            check_calibration(name, calibration)
        grid = lock[self.grid]
        blocks = VoxelBlocks(grid.origin_m, grid.voxel_m, grid.shape)
        tables = self.tables(blocks, calibrations, boxes)
        hull = VisualHull(blocks, tables)
        self._made = Refinement(hull, calibrations, boxes, moved_m=self._moved_m), blocks
        self._made_of, self._last_ns = made_of, 0
        return self._made

    @property
    def _moved_m(self) -> float:
        """How far a person walks between two exposures of one set."""
        return HUMAN_M_S * self.within_s

    @property
    def _names(self) -> list[str]:
        """The names of the cameras, in the order of their silhouettes."""
        return [str(view.entity) for view in self.silhouettes.requests]


class NewImages:
    """Tells silhouettes of new images from stand-ins, and from those of images that came before."""

    def __init__(self) -> None:
        self._checksums: dict[str, deque[int]] = {}

    def of(
        self, found: Mapping[str, Silhouette | None], *, or_repeated: bool = False
    ) -> dict[str, Silhouette]:
        """Return the silhouettes of a set that come of new images, by name of the camera.

        Args:
            found: Of each camera, in their order; None: it gave none.
            or_repeated: An image that equals one of the last four counts as new, too.
        """
        given = {}
        for name, silhouette in found.items():
            if silhouette is None or silhouette.stand_in:
                continue
            checksum = silhouette.image_checksum
            before = self._checksums.setdefault(name, deque(maxlen=IMAGES_COMPARED))
            if or_repeated or not checksum or checksum not in before:
                given[name] = silhouette
            before.append(checksum)
        return given


def check_known(
    cameras: Iterable[str],
    calibrations: Container[str],
    boxes: Container[Entity],
    surfaces: Iterable[Entity],
    *,
    has_grid: bool,
) -> None:
    """Refuse a cell of which too little is known.

    Args:
        cameras: Names of those that give silhouettes.
        calibrations: Names of those that are calibrated.
        boxes: Obstacles that have boxes.
        surfaces: Obstacles that have a surface.
        has_grid: Whether the voxels are known.

    Raises:
        ValueError: Something is missing; in one line.
    """
    missing = [name for name in cameras if name not in calibrations]
    if missing or not has_grid:
        what = f"calibration of {', '.join(missing)}" if missing else "workspace/grid"
        raise ValueError(f"{what} is null; write it before the first image")
    bare = sorted(one.name for one in surfaces if one not in boxes)
    if bare:
        raise ValueError(
            f"{', '.join(bare)}: a surface without boxes; cameras"
            " would be taken to see through it, so write its boxes, too"
        )


def hull_of(found: Refined, blocks: VoxelBlocks, cameras: tuple[str, ...], moved_m: float) -> Hull:
    """Return what is occupied as a datum.

    Args:
        found: What is occupied.
        blocks: Its voxels.
        cameras: Names of those that have seen it.
        moved_m: By how much less everything may be distant than it was seen.
    """
    nearest, clearance_m = found.nearest, found.clearance_m - np.float32(moved_m)
    return Hull(
        voxels=blocks.indices(found.rows),
        clearance_m=clearance_m,
        tight=found.tight,
        component=found.component,
        counts=found.counts,
        cameras=cameras,
        nearest_m=float(clearance_m[nearest]) if nearest >= 0 else math.inf,
        nearest_voxel=nearest,
    )


def arm_at(model: ArmModel | None, joints: Joints | None, stamp_ns: int) -> F64 | None:
    """Return the robot's capsules at an exposure, (n, 7), metres; None if they are not known."""
    q_rad = None if joints is None else joints_at(joints, stamp_ns)
    return None if model is None or q_rad is None else capsules_at(model, q_rad)[0]


def joints_at(joints: Joints, stamp_ns: int) -> F64 | None:
    """Return where the joints were, (7,) rad.

    Args:
        joints: The robot's last samples.
        stamp_ns: When; up to `AHEAD_NS_MAX` after the newest sample.

    Returns:
        Interpolated, or carried on by the newest speed; None for a stamp that the samples do not
        reach.
    """
    stamps = joints.stamp_ns
    if not len(stamps) or not stamps[0] <= stamp_ns <= stamps[-1] + AHEAD_NS_MAX:
        return None
    if stamp_ns > stamps[-1]:
        return np.asarray(joints.q[-1] + joints.dq[-1] * ((stamp_ns - stamps[-1]) / 1e9))
    since_s = (stamps - stamps[0]) / 1e9
    at_s = (stamp_ns - stamps[0]) / 1e9
    return np.array([np.interp(at_s, since_s, joint) for joint in joints.q.T])


def _bytes_of(calibrations: list[Calibration], boxes: list[F64]) -> bytes:
    """Return what tells whether calibrations and boxes are those of before."""
    parts = [box.tobytes() for box in boxes]
    for one in calibrations:
        parts += [one.camera_matrix.tobytes(), one.distortion.tobytes()]
        parts += [one.camera_from_cell.tobytes(), f"{one.width} {one.height}".encode()]
    return b"|".join(parts)
