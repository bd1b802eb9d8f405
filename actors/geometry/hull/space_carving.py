"""Shape from silhouettes of any calibrated cameras: bounds, carving, and how well both agree.

The cell's cameras are known beforehand and looked up in tables (`visual_hull`).  A set of pictures
from elsewhere is seen once and may have a hundred cameras; here each voxel is projected into each
camera, on what the others have left.  The principle is the same: a camera can only say *free*, and
only of a voxel that lies in its image and ahead of it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from actors.geometry.cameras.projection import in_camera, on_image
from actors.geometry.hull.voxels import EDGE, VoxelBlocks

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy.typing as npt

    from actors.geometry.cameras.camera_sets import SetCamera

    Mask = npt.NDArray[np.bool_]
    Numbers = npt.NDArray[np.floating]
    Rows = npt.NDArray[np.int64]
    Count = npt.NDArray[np.int16]

COARSE: Final = 48
"""Voxels along the edge of the first grid."""
SEARCHES_MAX: Final = 4
"""So many times the first grid is halved to what was found in it."""
WHOLE_MAX: Final = 1 << 15
"""A grid of more voxels is first looked at block by block."""
BEYOND: Final = 0.1
"""Share of its size that is left around what was found."""


@dataclass(frozen=True, slots=True, eq=False)
class Carved:
    """What silhouettes leave of a grid.

    Attributes:
        rows: (N,) voxels that, according to every camera, may meet its mask.
        outside: (N,) number of masks that do not contain the centre, and ...
        outside_of: (N,) ... the number of the last of those cameras.
        vetoes: (M,) rows that exactly one camera rejects, and ...
        denied_by: (M,) ... its number.
        denied_outside: (M,) number of masks that do not contain their centre.
    """

    rows: Rows
    outside: Count
    outside_of: Count
    vetoes: Rows
    denied_by: Count
    denied_outside: Count

    @property
    def tight_rows(self) -> Rows:
        """Voxels whose centre lies in each mask."""
        return np.asarray(self.rows[self.outside == 0])

    def without(self, number: int) -> Rows:
        """Return the voxels that are left if one camera is not asked."""
        return np.concatenate([self.rows, self.vetoes[self.denied_by == number]])

    def tight_without(self, number: int) -> Rows:
        """Return the voxels whose centre lies in each mask but perhaps that of one camera."""
        inside = (self.outside == 0) | ((self.outside == 1) & (self.outside_of == number))
        denied = (self.denied_outside == 1) & (self.denied_by == number)
        return np.concatenate([self.rows[inside], self.vetoes[denied]])


class Carver:
    """Carves grids by the silhouettes of some cameras.

    Args:
        cameras: With the sizes of their masks.
        masks: (H, W) each, true is foreground.
    """

    def __init__(self, cameras: Sequence[SetCamera], masks: Sequence[Mask]) -> None:
        import cv2

        self.cameras, self.masks = tuple(cameras), tuple(masks)
        self._away_px: list[npt.NDArray[np.float32]] = [
            np.asarray(cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, 5), np.float32)
            if mask.any()
            else np.full(mask.shape, np.inf, np.float32)
            for mask in self.masks
        ]

    def carve(self, grid: VoxelBlocks, *, seen_least: int = 1) -> Carved:
        """Return the voxels of a grid that remain.

        Args:
            grid: The voxels.
            seen_least: Voxels within view of fewer cameras are dropped.
        """
        return self._carved(grid, self._worth_asking(grid), seen_least)

    def _worth_asking(self, grid: VoxelBlocks) -> Rows:
        """Return the voxels of blocks that fewer than two cameras deny as a whole."""
        if any(edge % EDGE for edge in grid.block_shape) or grid.voxels <= WHOLE_MAX:
            return np.arange(grid.voxels)
        coarse = VoxelBlocks(grid.origin_m, EDGE * grid.voxel_m, grid.block_shape)
        carved = self._carved(coarse, self._worth_asking(coarse), 0)
        i, j, k = coarse.indices(np.concatenate([carved.rows, carved.vetoes])).astype(np.int64).T
        _, wide, high = grid.block_shape
        return grid.rows_in(np.sort((i * wide + j) * high + k))

    def _carved(self, grid: VoxelBlocks, rows: Rows, seen_least: int) -> Carved:
        vetoes, says, outside = (np.zeros(len(rows), np.int16) for _ in range(3))
        denied, last = (np.full(len(rows), -1, np.int16) for _ in range(2))
        for number in range(len(self.cameras)):
            away_px, reach_px, say = self._seen(number, grid, rows)
            says += say
            free, misses = say & (away_px > reach_px), say & (away_px > 0.0)
            vetoes += free
            outside += misses
            denied[free] = number
            last[misses] = number
            few = vetoes <= 1
            rows, vetoes, says, outside = rows[few], vetoes[few], says[few], outside[few]
            denied, last = denied[few], last[few]
        seen = says >= seen_least
        left, once = seen & (vetoes == 0), seen & (vetoes == 1)
        return Carved(
            rows[left], outside[left], last[left], rows[once], denied[once], outside[once]
        )

    def outline(self, number: int, grid: VoxelBlocks, rows: Rows, *, grown: bool = False) -> Mask:
        """Return where a camera sees some voxels, (H, W).

        Args:
            number: Of the camera.
            grid: The voxels.
            rows: Which of them.
            grown: All of each voxel, and not only its centre with what lies between centres.
        """
        import cv2

        height, width = self.masks[number].shape
        pixels, depth = self._pixels(number, grid, outer(grid, rows))
        good = np.isfinite(pixels).all(1) & (depth > 0.0)
        focal = self.cameras[number].camera_matrix[[0, 1], [0, 1]].max()
        reach_px = np.ceil(grid.half_diagonal_m * focal / np.where(good, depth, 1.0))
        reach = reach_px.clip(1, max(width, height)).astype(np.int64)
        at = np.rint(np.where(good[:, None], pixels, -1.0)).astype(np.int64)
        good &= (at >= 0).all(1) & (at[:, 0] < width) & (at[:, 1] < height)
        found = np.zeros((height, width), np.uint8)
        if good.any():
            found[at[good, 1], at[good, 0]] = 1
            kernel = np.ones((2 * int(reach[good].max()) + 1,) * 2, np.uint8)
            way = cv2.MORPH_DILATE if grown else cv2.MORPH_CLOSE
            found = np.asarray(cv2.morphologyEx(found, way, kernel), np.uint8)
        return found > 0

    def agreement(self, grid: VoxelBlocks, rows: Rows) -> list[float]:
        """Return, per camera, the intersection over union of its mask and some voxels' outline."""
        return [
            intersection_over_union(self.outline(number, grid, rows), mask)
            for number, mask in enumerate(self.masks)
        ]

    def _pixels(
        self, number: int, grid: VoxelBlocks, rows: Rows
    ) -> tuple[Numbers, npt.NDArray[np.floating]]:
        camera = self.cameras[number]
        local = in_camera(grid.centres(rows), camera.camera_from_cell)
        return on_image(local, camera.camera_matrix, camera.distortion), local[:, 2]

    def _seen(self, number: int, grid: VoxelBlocks, rows: Rows) -> tuple[Numbers, Numbers, Mask]:
        """Return pixels to the nearest foreground, pixels a voxel reaches, whether it has a say."""
        camera = self.cameras[number]
        height, width = self.masks[number].shape
        pixels, depth = self._pixels(number, grid, rows)
        ahead = np.isfinite(pixels).all(1) & (depth > grid.half_diagonal_m)
        focal = max(camera.camera_matrix[0, 0], camera.camera_matrix[1, 1])
        nearest = np.where(ahead, depth - grid.half_diagonal_m, 1.0)
        # off the axis a sphere looks longer by the slant of the ray, and lenses bend by little
        slant = np.linalg.norm(np.nan_to_num(pixels) - camera.camera_matrix[:2, 2], axis=1) / focal
        reach_px = focal * grid.half_diagonal_m / nearest * (1.0 + slant**2) + 1.0
        u, v = (np.where(ahead, axis, -1.0) for axis in pixels.T)
        say = ahead & (u - reach_px >= -0.5) & (u + reach_px <= width - 0.5)
        say &= (v - reach_px >= -0.5) & (v + reach_px <= height - 0.5)
        column = np.rint(u).clip(0, width - 1).astype(np.int64)
        row = np.rint(v).clip(0, height - 1).astype(np.int64)
        return self._away_px[number][row, column], np.asarray(reach_px), np.asarray(say)


def outer(grid: VoxelBlocks, rows: Rows) -> Rows:
    """Return those of some voxels that are not all around among others of them."""
    inside = np.pad(grid.dense(rows), 1)
    for axis in range(3):
        inside = inside & np.roll(inside, 1, axis) & np.roll(inside, -1, axis)
    i, j, k = grid.indices(rows).T
    return np.asarray(rows[~inside[1:-1, 1:-1, 1:-1][i, j, k]])


def intersection_over_union(one: Mask, other: Mask) -> float:
    """Return the share that two masks have in common; 1 of two that are empty."""
    union = np.count_nonzero(one | other)
    return np.count_nonzero(one & other) / union if union else 1.0


def grid_of(low_m: Numbers, high_m: Numbers, count: int) -> VoxelBlocks:
    """Return a grid of cubes over a box, with so many along its longest edge.

    Raises:
        ValueError: The box is invalid, or there would be too many voxels.
    """
    size = np.asarray(high_m, np.float64) - np.asarray(low_m, np.float64)
    if not np.isfinite(size).all() or (size <= 0.0).any():
        raise ValueError(
            f"asked for a box with its low corner below its high one, found"
            f" {np.asarray(low_m).tolist()} to {np.asarray(high_m).tolist()}"
        )
    voxel_m = float(size.max()) / count
    step = EDGE * EDGE  # whole blocks of whole blocks, see `Carver.carve`
    edges = [step * max(1, int(np.ceil(edge / voxel_m / step - 1e-9))) for edge in size]
    middle = 0.5 * (np.asarray(low_m) + np.asarray(high_m))
    return VoxelBlocks(middle - 0.5 * voxel_m * np.array(edges), voxel_m, tuple(edges))


def nearest_to_axes(cameras: Sequence[SetCamera]) -> npt.NDArray[np.float64]:
    """Return the point that is nearest to the optical axes of all cameras, (3,), metres."""
    total, wanted = np.zeros((3, 3)), np.zeros(3)
    for camera in cameras:
        across = np.eye(3) - np.outer(camera.axis, camera.axis)
        total += across
        wanted += across @ camera.centre_m
    return np.asarray(np.linalg.lstsq(total, wanted, rcond=None)[0])


def in_front(cameras: Sequence[SetCamera], point_m: Numbers) -> float:
    """Return the share of the cameras that have a point in front of them."""
    ahead = [camera.axis @ (point_m - camera.centre_m) > 0.0 for camera in cameras]
    return float(np.mean(ahead))


def found_bounds(carver: Carver) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]] | None:
    """Return the box around what the silhouettes leave near the cameras' axes; None of nothing."""
    centre = nearest_to_axes(carver.cameras)
    distances = [float(np.linalg.norm(camera.centre_m - centre)) for camera in carver.cameras]
    radius = 0.5 * max(min(distances), 0.1 * max(distances))
    if not radius > 0.0:
        return None
    low, high = centre - radius, centre + radius
    for _ in range(SEARCHES_MAX):
        grid = grid_of(low, high, COARSE)
        rows = carver.carve(grid, seen_least=min(2, len(carver.cameras))).rows
        if not len(rows):
            return None
        corners = grid.origin_m + grid.voxel_m * grid.indices(rows).astype(np.float64)
        found_low, found_high = corners.min(0), corners.max(0) + grid.voxel_m
        room = BEYOND * (found_high - found_low)
        small = (found_high - found_low).max() < 0.5 * (high - low).max()
        low, high = found_low - room, found_high + room
        if not small:
            break
    return low, high
