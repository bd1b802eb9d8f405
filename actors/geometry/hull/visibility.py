"""What each camera can say about each voxel: tables that are made once per calibration.

A camera can only ever say that a voxel is free.  It has a say if it sees all of the voxel: its
centre and all of its corners lie in the image, at least `NEAREST_M` ahead, and no static obstacle
hides one of them; corners within an obstacle do not count.

`pixel[v]` is where the camera looks for voxel v: an index into its masks, stored one after another,
each grown by a different number of pixels.  The mask used is the one grown by the distance in the
image from the voxel's centre to its corners, so a voxel is free only if *no part* of it meets
foreground.  If the camera does not see the voxel, the index is that of the *sentinel*, one more
byte after the masks that is always foreground.  `cell[b]` is the same for whole blocks in pooled
masks.

Distortion lives in these tables; no image is ever undistorted.

Rules a change must keep: in doubt a camera has no say; a block is free only where each of its
voxels is, so that looking at blocks first changes nothing but the time.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Protocol

import numpy as np

from actors.geometry.cameras.projection import in_camera, on_image
from actors.geometry.hull.voxels import PER_BLOCK
from actors.geometry.poses import inverse

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy.typing as npt

    from actors.geometry.hull.voxels import VoxelBlocks

    Numbers = npt.NDArray[np.floating]
    Flags = npt.NDArray[np.bool_]
    Index = npt.NDArray[np.int32]

NEAREST_M: Final = 0.2
"""What is nearer to a camera's plane than this it has no say about."""
GROWN_PX: Final = (3, 4, 5, 7, 10)
"""By how many pixels the masks are grown; a voxel that looks larger gets no say."""
MARGIN_PX: Final = 1
"""Pixels that a mask may lack at its edge."""
POOL_PX: Final = 8
"""Pixels along the edge of a cell of the pooled masks."""
POOLS: Final = (1, 2, 3, 4, 6, 9, 13)
"""By how many cells the pooled masks are grown; a block that looks larger gets no say as one."""
AROUND_M: Final = 2.0
"""So far beyond the sides of the grid the floor is known."""
FLOOR_STEP_M: Final = 0.04
"""Between places on the floor that are looked at."""
INSIDE_M: Final = 0.005
"""How deep within an obstacle's box a line of sight must pass to be cut off."""


class Calibrated(Protocol):
    """What is needed of a calibration; see `workcell.vocabulary.Calibration`."""

    @property
    def camera_matrix(self) -> npt.NDArray[np.float64]:
        """(3, 3), pixels."""
        ...

    @property
    def distortion(self) -> npt.NDArray[np.float64]:
        """(5,)."""
        ...

    @property
    def camera_from_cell(self) -> npt.NDArray[np.float64]:
        """(4, 4), metres."""
        ...

    @property
    def width(self) -> int:
        """Columns of the image."""
        ...

    @property
    def height(self) -> int:
        """Rows of the image."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class CameraTable:
    """What one camera can say.

    Attributes:
        width: Columns of its masks.
        height: Rows of its masks.
        pixel: (voxels,) int32, into the masks; `sentinel` where it has no say.
        cell: (blocks,) int32, into the pooled masks; `pool_sentinel` where it has no say.
    """

    width: int
    height: int
    pixel: Index
    cell: Index

    @property
    def mask_px(self) -> int:
        """Pixels of one mask."""
        return self.width * self.height

    @property
    def sentinel(self) -> int:
        """Index of the byte that is always foreground, behind the mask as it came and the grown."""
        return self.mask_px * (1 + len(GROWN_PX))

    @property
    def pool_shape(self) -> tuple[int, int]:
        """Rows and columns of the pooled masks."""
        return -(-self.height // POOL_PX), -(-self.width // POOL_PX)

    def cell_of_pixel(self, pixel: npt.NDArray[np.integer]) -> npt.NDArray[np.int64]:
        """Return in which cell of the pooled masks pixels lie."""
        row, column = np.divmod(pixel, self.width)
        return np.asarray(row // POOL_PX * self.pool_shape[1] + column // POOL_PX, np.int64)

    @property
    def pool_sentinel(self) -> int:
        """Index of the byte behind the pooled masks."""
        rows, columns = self.pool_shape
        return rows * columns * len(POOLS)


def check_calibration(name: str, calibration: Calibrated) -> None:
    """Raise `ValueError`, in one line, unless this can be the calibration of a camera."""
    matrix, pose = np.asarray(calibration.camera_matrix), np.asarray(calibration.camera_from_cell)
    found = ""
    if matrix.shape != (3, 3) or pose.shape != (4, 4) or calibration.distortion.shape != (5,):
        found = f"matrices {matrix.shape}, {pose.shape}, {calibration.distortion.shape}"
    elif not all(np.isfinite(part).all() for part in (matrix, pose, calibration.distortion)):
        found = "numbers that are not finite"
    elif min(calibration.width, calibration.height) < 1:
        found = f"an image of {calibration.width} x {calibration.height} pixels"
    elif min(matrix[0, 0], matrix[1, 1]) <= 0.0 or not np.array_equal(matrix[2], (0, 0, 1)):
        found = f"a camera matrix {matrix.tolist()}"
    elif not (0 < matrix[0, 2] < calibration.width and 0 < matrix[1, 2] < calibration.height):
        found = (
            f"a centre at {matrix[0, 2]:.0f}, {matrix[1, 2]:.0f} of an image of"
            f" {calibration.width} x {calibration.height} pixels"
        )
    elif np.abs(pose[:3, :3] @ pose[:3, :3].T - np.eye(3)).max() > 1e-3:
        found = "a pose that is not rigid"
    elif np.linalg.det(pose[:3, :3]) < 0.0:
        found = "a pose that mirrors"
    if found:
        raise ValueError(
            f"calibration of {name}: asked for a pinhole (3, 3) whose centre lies in the image,"
            f" five distortion coefficients and a rigid camera_from_cell (4, 4); found {found}"
        )


def camera_table(
    grid: VoxelBlocks, calibration: Calibrated, boxes: Sequence[Numbers]
) -> CameraTable:
    """Return what a camera can say about the voxels of a grid.

    Args:
        grid: The voxels.
        calibration: The camera.
        boxes: Static obstacles, (n, 15) each: centre, half sizes, rotation row by row; cell frame.
    """
    width, height = calibration.width, calibration.height
    pose = calibration.camera_from_cell
    x, y, z = (axis.astype(np.float32) for axis in grid.lattice())
    corners = _projected(calibration, x, y, z)
    eye = inverse(pose)[:3, 3]
    good = corners[2] > NEAREST_M
    for axis, size in ((0, width), (1, height)):
        with np.errstate(invalid="ignore"):
            good &= (corners[axis] > -0.5) & (corners[axis] < size - 0.5)
    for box in (row for of_obstacle in boxes for row in of_obstacle):
        good &= ~hidden_by(box, eye, (x, y, z))
    for box in (row for of_obstacle in boxes for row in of_obstacle):
        good |= inside(box, (x, y, z), 0.0)
    half = np.float32(grid.voxel_m / 2.0)
    u, v, depth = _projected(calibration, x[:-1] + half, y[:, :-1] + half, z[:, :, :-1] + half)
    u, v = np.rint(u), np.rint(v)
    with np.errstate(invalid="ignore"):  # corners within an obstacle may lie beside the image
        say = (depth > NEAREST_M) & (u >= 0) & (u < width) & (v >= 0) & (v < height)
    reach = np.zeros(u.shape, np.float32)
    for shift in np.ndindex(2, 2, 2):
        part = tuple(slice(s, s + n) for s, n in zip(shift, grid.shape, strict=True))
        say &= good[part]
        np.fmax(reach, np.abs(corners[0][part] - u), out=reach)
        np.fmax(reach, np.abs(corners[1][part] - v), out=reach)
    needed = np.floor(reach + 0.5).astype(np.int32) + MARGIN_PX
    say &= needed <= GROWN_PX[-1]
    slot = np.searchsorted(GROWN_PX, needed).astype(np.int32) + 1
    column, row = (np.where(say, values, 0.0).astype(np.int32) for values in (u, v))
    pixel = np.where(say, (slot * height + row) * width + column, -1)
    grown = np.array((0, *GROWN_PX, 0), np.int32)[slot]
    cell = _cells(grid, (width, height), say, (column, row, grown))
    flat = grid.block_major(pixel).astype(np.int32)
    table = CameraTable(width, height, flat, cell)
    flat[flat < 0] = table.sentinel
    return table


def _projected(
    calibration: Calibrated, x: Numbers, y: Numbers, z: Numbers
) -> tuple[Numbers, Numbers, Numbers]:
    """Return column, row (pixels) and depth (metres) of the points of a lattice."""
    points = np.stack(np.broadcast_arrays(x, y, z), -1)
    local = in_camera(points, calibration.camera_from_cell)
    pixels = on_image(local, calibration.camera_matrix, calibration.distortion)
    return pixels[..., 0], pixels[..., 1], local[..., 2]


def _cells(
    grid: VoxelBlocks, size: tuple[int, int], say: Flags, place: tuple[Index, Index, Index]
) -> Index:
    """Return, per block, where in the pooled masks lies all that its voxels look at.

    Args:
        grid: The voxels.
        size: Width and height of the masks.
        say: Over (i, j, k): the camera has a say.
        place: Column, row and growth in pixels, over (i, j, k).
    """
    width, height = size
    column, row, grown = place

    def over_block(values: Index, *, most: bool) -> Index:
        of_block = grid.block_major(values).reshape(-1, PER_BLOCK)
        return np.asarray(of_block.max(1) if most else of_block.min(1), np.int32)

    whole = grid.block_major(say).reshape(-1, PER_BLOCK).all(1)
    low_u, high_u = over_block(column - grown, most=False), over_block(column + grown, most=True)
    low_v, high_v = over_block(row - grown, most=False), over_block(row + grown, most=True)
    columns, rows = -(-width // POOL_PX), -(-height // POOL_PX)
    spans = []
    for low, high, count in ((low_u, high_u, columns), (low_v, high_v, rows)):
        first = np.clip(low // POOL_PX, 0, count - 1)
        last = np.clip(high // POOL_PX, 0, count - 1)
        middle = (first + last) // 2
        spans.append((middle, last - middle))
    (cell_u, reach_u), (cell_v, reach_v) = spans
    reach = np.maximum(reach_u, reach_v)
    whole &= reach <= POOLS[-1]
    slot = np.minimum(np.searchsorted(POOLS, reach), len(POOLS) - 1)
    index = (slot * rows + cell_v) * columns + cell_u
    return np.where(whole, index, rows * columns * len(POOLS)).astype(np.int32)


def _in_box(box: Numbers, axes: tuple[Numbers, Numbers, Numbers]) -> list[Numbers]:
    """Return coordinates in the frame of a box, relative to its centre.

    Each is shaped as the sum of the axes that it depends on, so that a box along the axes of the
    cell costs one line of numbers each, not a lattice.
    """
    rotation = np.asarray(box[6:15], np.float64).reshape(3, 3)
    result = []
    for k in range(3):
        terms = [
            np.float32(rotation[j, k]) * (axes[j] - np.float32(box[j]))
            for j in range(3)
            if abs(rotation[j, k]) > 1e-9
        ]
        result.append(sum(terms[1:], terms[0]))
    return result


def inside(
    box: Numbers, axes: tuple[Numbers, Numbers, Numbers], beyond_m: float
) -> npt.NDArray[np.bool_]:
    """Return which points of a lattice lie within a box that is larger by a margin.

    Args:
        box: (15,): centre, half sizes, rotation row by row (its columns are the box's axes).
        axes: x, y, z of the points, to be broadcast; metres, cell.
        beyond_m: Margin on each side.
    """
    x, y, z = (np.abs(part) for part in _in_box(box, axes))
    a, b, c = (np.float32(size + beyond_m) for size in box[3:6])
    return np.asarray((x <= a) & (y <= b) & (z <= c))


def hidden_by(
    box: Numbers, eye_m: Numbers, axes: tuple[Numbers, Numbers, Numbers]
) -> npt.NDArray[np.bool_]:
    """Return to which points of a lattice the line of sight passes through a box.

    Args:
        box: (15,): centre, half sizes, rotation row by row (its columns are the box's axes).
        eye_m: (3,), where the camera is.
        axes: x, y, z of the points, to be broadcast; metres, cell.
    """
    points = _in_box(box, axes)
    one = np.ones((1, 1, 1), np.float32)
    eye = _in_box(box, (one * np.float32(eye_m[0]), one * eye_m[1], one * eye_m[2]))
    enter: Numbers = np.zeros((1, 1, 1), np.float32)
    leave: Numbers = np.ones((1, 1, 1), np.float32)
    for point, start, size in zip(points, eye, box[3:6], strict=True):
        half = np.float32(max(size - INSIDE_M, 0.0))
        along = point - start
        along = np.where(np.abs(along) < 1e-9, np.float32(1e-9), along)
        first, second = (-half - start) / along, (half - start) / along
        enter = np.maximum(enter, np.minimum(first, second))
        leave = np.minimum(leave, np.maximum(first, second))
    return np.asarray(enter < leave)


def static_voxels(grid: VoxelBlocks, boxes: Sequence[Numbers]) -> npt.NDArray[np.bool_]:
    """Return which voxels (rows) have their centre in an obstacle or within a quarter voxel of it.

    Args:
        grid: The voxels.
        boxes: (n, 15) each.
    """
    return np.asarray(grid.block_major(_near(grid, boxes, grid.voxel_m / 4.0)), bool)


def surface_voxels(grid: VoxelBlocks, boxes: Sequence[Numbers]) -> npt.NDArray[np.bool_]:
    """Return which voxels (rows) lie on an obstacle, not in it.

    Args:
        grid: The voxels.
        boxes: (n, 15) each.
    """
    near = grid.block_major(_near(grid, boxes, 1.5 * grid.voxel_m))
    return np.asarray(near, bool) & ~static_voxels(grid, boxes)


def floor_seen(
    grid: VoxelBlocks, calibrations: Sequence[Calibrated], boxes: Sequence[Numbers]
) -> Index:
    """Return where cameras see places on the floor, z = 0, under a grid and around it.

    Args:
        grid: The voxels; shadows of what is near its sides lie beyond them.
        calibrations: The cameras.
        boxes: Static obstacles, (n, 15) each.

    Returns:
        (cameras, places) int32, as `CameraTable.pixel`, in the mask that is grown least.
    """
    x, y, _ = grid.lattice()
    ends = (float(x[0, 0, 0]), float(x[-1, 0, 0])), (float(y[0, 0, 0]), float(y[0, -1, 0]))
    along, across = (np.arange(a - AROUND_M, b + AROUND_M, FLOOR_STEP_M) for a, b in ends)
    x, y = along.astype(np.float32)[:, None, None], across.astype(np.float32)[None, :, None]
    axes = x, y, np.zeros((1, 1, 1), np.float32)
    covered = np.zeros((len(along), len(across), 1), bool)
    for box in (row for of_obstacle in boxes for row in of_obstacle):
        covered |= inside(box, axes, 0.0)
    result = []
    for one in calibrations:
        u, v, depth = _projected(one, *axes)
        eye = inverse(one.camera_from_cell)[:3, 3]
        with np.errstate(invalid="ignore"):
            seen = (depth > NEAREST_M) & (u >= 0) & (v >= 0) & ~covered
            seen &= (u < one.width - 1) & (v < one.height - 1)
        for box in (row for of_obstacle in boxes for row in of_obstacle):
            seen &= ~hidden_by(box, eye, axes)
        column, row = (np.rint(np.where(seen, part, 0)).astype(np.int32) for part in (u, v))
        mask_px = one.width * one.height
        pixel = np.where(seen, mask_px + row * one.width + column, mask_px * (1 + len(GROWN_PX)))
        result.append(pixel.ravel().astype(np.int32))
    return np.stack(result)[:, ~covered.ravel()]


def _near(grid: VoxelBlocks, boxes: Sequence[Numbers], margin_m: float) -> Flags:
    """Return which voxels (i, j, k) have their centre within a margin of an obstacle."""
    half = np.float32(grid.voxel_m / 2.0)
    x, y, z = (axis.astype(np.float32) for axis in grid.lattice())
    axes = (x[:-1] + half, y[:, :-1] + half, z[:, :, :-1] + half)
    result = np.zeros(grid.shape, bool)
    for box in (row for of_obstacle in boxes for row in of_obstacle):
        result |= inside(box, axes, margin_m)
    return result


def seen_by(tables: Sequence[CameraTable]) -> npt.NDArray[np.uint8]:
    """Return how many cameras have a say about each voxel, (voxels,); tables are of one grid."""
    count = np.zeros(len(tables[0].pixel) if tables else 0, np.uint8)
    for table in tables:
        count += table.pixel != table.sentinel
    return count
