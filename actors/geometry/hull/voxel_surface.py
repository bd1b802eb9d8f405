"""The surface of voxels as triangles: surface nets, closed, with its front outside.

A vertex lies in each cube of eight voxel centres with both kinds, where the smoothed border
passes; each pair of neighbouring voxels of different kinds makes a quad.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import numpy.typing as npt

    from actors.geometry.hull.voxels import VoxelBlocks

    Numbers = npt.NDArray[np.float64]


def voxel_surface(
    occupied: npt.NDArray[np.bool_], origin_m: Numbers, voxel_m: float
) -> tuple[Numbers, npt.NDArray[np.int32]]:
    """Return the surface of voxels.

    Vertices lie on the border of the occupancy averaged over 3 x 3 x 3 voxels, at most half a voxel
    from where they lay else.

    Args:
        occupied: (I, J, K).
        origin_m: (3,), lowest corner of the grid, metres.
        voxel_m: Edge of a voxel.

    Returns:
        Vertices (V, 3), metres, and triangles (T, 3).
    """
    padded = np.pad(occupied, 2)
    level = np.where(padded, 1.0, -1.0).astype(np.float32)
    blurred = _averaged(level)
    # the sign decides which voxels there are; the average only where the border passes
    level = np.where(padded, np.maximum(blurred, 0.05), np.minimum(blurred, -0.05))
    corners = _corners(padded)
    mixed = (corners > 0) & (corners < 8)
    cells = np.argwhere(mixed)
    number = np.full(mixed.shape, -1, np.int32)
    number[mixed] = np.arange(len(cells), dtype=np.int32)
    vertices = _vertices(level, cells)
    triangles = _triangles(padded, number)
    return np.asarray(origin_m) + (vertices - 2.0 + 0.5) * voxel_m, triangles


def surface_of(
    grid: VoxelBlocks, rows: npt.NDArray[np.integer]
) -> tuple[Numbers, npt.NDArray[np.int32]]:
    """Return the surface of some voxels of a grid: vertices (V, 3), metres, triangles (T, 3)."""
    return voxel_surface(grid.dense(rows), grid.origin_m, grid.voxel_m)


def _averaged(level: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    for axis in range(3):
        level = (np.roll(level, 1, axis) + level + np.roll(level, -1, axis)) / np.float32(3.0)
    return level


def _corners(occupied: npt.NDArray[np.bool_]) -> npt.NDArray[np.uint8]:
    """Return how many of the eight voxels at the corners of each cell are occupied."""
    count = occupied.astype(np.uint8)
    for axis in range(3):
        low = count[(slice(None),) * axis + (slice(None, -1),)]
        count = low + count[(slice(None),) * axis + (slice(1, None),)]
    return count


def _vertices(level: npt.NDArray[np.float32], cells: npt.NDArray[np.int64]) -> Numbers:
    """Return, per cell, the mean of the places at which its twelve edges pass the border."""
    total = np.zeros((len(cells), 3))
    count = np.zeros((len(cells), 1))
    for axis in range(3):
        others = [one for one in range(3) if one != axis]
        for shift in np.ndindex(2, 2):
            begin = np.zeros(3, np.int64)
            begin[others] = shift
            end = begin.copy()
            end[axis] = 1
            low = level[tuple((cells + begin).T)].astype(np.float64)
            high = level[tuple((cells + end).T)].astype(np.float64)
            passes = (low > 0.0) != (high > 0.0)
            share = np.where(passes, low / np.where(passes, low - high, 1.0), 0.0)
            place = np.tile(begin.astype(np.float64), (len(cells), 1))
            place[:, axis] = share
            total += place * passes[:, None]
            count += passes[:, None]
    return np.asarray(cells + total / count)


def _triangles(
    occupied: npt.NDArray[np.bool_], number: npt.NDArray[np.int32]
) -> npt.NDArray[np.int32]:
    quads = []
    for axis in range(3):
        second, third = (axis + 1) % 3, (axis + 2) % 3
        low = occupied[(slice(None),) * axis + (slice(None, -1),)]
        high = occupied[(slice(None),) * axis + (slice(1, None),)]
        for outward, border in ((True, low & ~high), (False, high & ~low)):
            edges = np.argwhere(border)
            around = []
            for back in ((1, 1), (0, 1), (0, 0), (1, 0)):
                cell = edges.copy()
                cell[:, second] -= back[0]
                cell[:, third] -= back[1]
                around.append(number[tuple(cell.T)])
            quad = np.stack(around, 1)
            quads.append(quad if outward else quad[:, ::-1])
    faces = np.concatenate(quads)
    return np.asarray(faces[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3), np.int32)
