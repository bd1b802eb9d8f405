"""Reconstruction (ENACT 4.1): which voxels are occupied, of a set of silhouettes of one stamp."""

from __future__ import annotations

import math
import time
from collections import deque
from typing import TYPE_CHECKING, Any, Final, Self

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
    from collections.abc import Callable, Container, Iterable, Mapping

    import numpy.typing as npt

    from actors.geometry.hull.refinement import Refined
    from actors.geometry.hull.visibility import CameraTable
    from actors.workcell.vocabulary import ArmModel, Grid
    from enact_dist import Entity, Lock

    F64 = npt.NDArray[np.float64]

AHEAD_NS_MAX: Final = 100_000_000
"""So long after the newest sample of the joints their speed still tells where they are."""
SETS_OF: Final = ("cameras", "within_s", "least")
"""Options by which the sets are made."""
VOXELS_MAX: Final = 150_000
"""A hull of more voxels, ten times those of a person, keeps the nearest to the robot: all cameras
in the dark fill the grid, and 100 versions of that would take 3 GB of the shard."""
HUMAN_M_S: Final = 1.6
"""Speed of a person, ISO/TS 15066, as in speed control."""
GAP_S: Final = 0.5
"""After so long without a hull a late one is better than none: it says why the robot stands."""

NO_ARM: Final[F64 | None] = np.empty((0, 7))
"""Capsules of a robot that is not there."""

_ONLINE: Final = World("online")


def _sets(
    cameras: int = CAMERA_COUNT, within_s: float = 0.0, least: int = 1
) -> Together[Silhouette]:
    """Return the sets of a cell.

    Args:
        cameras: How many it has, 2 or more.
        within_s: How far the exposures of a set may lie apart; less than half the period.
        least: With how many silhouettes a set is used, at least.

    Raises:
        ValueError: One of them is out of range.
    """
    if not within_s < PERIOD_S / 2:
        raise ValueError(
            f"within_s is {within_s:g}; with half the period, {PERIOD_S / 2:g} s, or more it"
            " cannot be known which image belongs to which set"
        )
    views = [View(_ONLINE, camera_entity(number), SILHOUETTE) for number in range(cameras)]
    return Together(views, least=least, within_s=within_s, newest_only=True)


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
    silhouettes = _sets()
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
        self.robot, self.stuck, sets = robot, stuck, self.silhouettes
        if cameras not in (None, len(sets.requests)) or within_s not in (None, sets.within_s):
            raise ValueError(
                f"asked for {cameras} cameras within {within_s} s; this class is for"
                f" {len(sets.requests)} within {sets.within_s:g} s; Reconstruction.of_options"
                " returns another"
            )
        self._images = NewImages()
        self._carving: tuple[object, Carving] | None = None
        self._written = 0, 0
        """Version of the last hull if it stands, and when it was written, ns since 1970."""

    @classmethod
    def of_options(cls, options: Mapping[str, Any]) -> type[Self]:
        """Return the reconstruction of a cell by `cameras`, `within_s` and `least`, see `_sets`."""
        every = _sets(**{name: options[name] for name in SETS_OF if options.get(name) is not None})
        names = {"silhouettes": every, "triggers": (every,), "__module__": cls.__module__}
        return cls if every == cls.silhouettes else type(cls.__name__, (cls,), names)

    def start(self) -> None:
        """Let OpenCV work in the actor's own thread."""
        one_thread()

    def now_ns(self) -> int:
        """Return the time, ns since 1970; a simulation has its own."""
        return time.time_ns()

    def update(self, lock: Lock) -> None:
        """Write the occupied voxels with the stamp of the set; skip a set that is too late."""
        stamp_ns, now_ns = lock.stamp_ns(self.silhouettes), self.now_ns()
        version, written_ns = self._written
        hulls_come = version == lock.version(self.hull) and now_ns - written_ns < GAP_S * 1e9
        if hulls_come and now_ns - stamp_ns > self.late_s * 1e9:
            return
        carving, arm = self._carving_of(lock), NO_ARM
        if self.robot:
            arm = arm_at(lock.get(self.model), lock.get(self.joints), stamp_ns)
        hull, raw = carving.of_set(lock[self.silhouettes], stamp_ns, arm, stuck=self.stuck)
        self._written = lock.version(self.hull) + 1, now_ns
        lock[self.hull] = hull
        if lock.get(self.wanted, 0) > 0:
            lock[self.raw_hull] = carving.blocks.indices(raw)

    def tables(
        self, blocks: VoxelBlocks, calibrations: list[Calibration], boxes: list[F64]
    ) -> list[CameraTable]:
        """Return what each camera can say about the voxels of a grid."""
        return [camera_table(blocks, calibration, boxes) for calibration in calibrations]

    def _carving_of(self, lock: Lock) -> Carving:
        """Return the carving of the cell; it begins anew if the cell has changed."""
        names = [str(view.entity) for view in self.silhouettes.requests]
        known = {entity.name: one for entity, one in lock[self.calibrations].items()}
        boxes = dict(sorted(lock[self.boxes].items()))
        has_grid = not lock.is_null(self.grid)
        check_known(names, known, boxes, lock[self.surfaces], has_grid=has_grid)
        cameras, shapes = {name: known[name] for name in names}, list(boxes.values())
        made_of = lock.version(self.grid), _bytes_of(list(cameras.values()), shapes)
        if self._carving is None or self._carving[0] != made_of:
            moved_m = HUMAN_M_S * self.silhouettes.within_s
            grid, images = lock[self.grid], self._images
            carving = Carving(grid, cameras, shapes, self.tables, images, moved_m=moved_m)
            self._carving = made_of, carving
        return self._carving[1]


class Carving:
    """Carves what is occupied out of the grid of a cell, one set of silhouettes after the other.

    Args:
        grid: The voxels.
        cameras: Calibrations by name, in the order of the silhouettes.
        boxes: Static obstacles, (n, 15) each.
        tables: Returns what each camera can say about the voxels, see `camera_table`.
        images: Which images came before.
        moved_m: How far a person walks between two exposures of one set.

    Attributes:
        blocks: The voxels.

    Raises:
        ValueError: Grid or calibration of a camera are wrong; in one line.
    """

    def __init__(
        self,
        grid: Grid,
        cameras: Mapping[str, Calibration],
        boxes: list[F64],
        tables: Callable[[VoxelBlocks, list[Calibration], list[F64]], list[CameraTable]],
        images: NewImages,
        *,
        moved_m: float,
    ) -> None:
        for name, calibration in cameras.items():
            check_calibration(name, calibration)
        calibrations = list(cameras.values())
        self.blocks = VoxelBlocks(grid.origin_m, grid.voxel_m, grid.shape)
        hull = VisualHull(self.blocks, tables(self.blocks, calibrations, boxes))
        self._refinement = Refinement(hull, calibrations, boxes, moved_m=moved_m)
        self._names, self._images, self._moved_m = list(cameras), images, moved_m
        self._last: tuple[int, Hull, npt.NDArray[np.int64]] | None = None

    def of_set(
        self,
        silhouettes: Iterable[Silhouette | None],
        stamp_ns: int,
        arm: F64 | None,
        *,
        stuck: bool = True,
    ) -> tuple[Hull, npt.NDArray[np.int64]]:
        """Return the hull of a set, and the rows of its voxels before refinement.

        The set of the last call has the same hull again: its images came before, and no time has
        passed.

        Args:
            silhouettes: Of each camera, in their order; None: it gave none.
            stamp_ns: Exposure of the set.
            arm: Capsules of the robot then, (n, 7), see `arm_at`.
            stuck: An image that came before counts as none.
        """
        last = self._last
        if last is None or last[0] != stamp_ns:
            found = dict(zip(self._names, silhouettes, strict=True))
            given = self._images.of(found, or_repeated=not stuck)
            seen = [given.get(name) for name in self._names]
            occupied = self._refinement.step(
                [one.packed if one else None for one in seen],
                arm,
                math.inf if last is None else (stamp_ns - last[0]) / 1e9,
                [one.shade if one else None for one in seen],
            )
            if (arm is None or len(arm)) and len(occupied.rows) > VOXELS_MAX:
                occupied = occupied.limited(VOXELS_MAX)
            hull = hull_of(occupied, self.blocks, tuple(given), self._moved_m)
            self._last = last = stamp_ns, hull, occupied.raw
        return last[1:]


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
