"""One camera against all others: where its word "free" does not count (rule R5 of `refinement`).

A camera is wrong about a place if a person there wears the colour of its background, or if
something hides the place from it.  The hull of all cameras then lacks a part of a person whom the
others see: they see foreground, and behind those pixels lies no voxel.  A camera that is right
contradicts nothing: what the others leave there, up to tens of litres beside a person near a
camera, lies in front of that person and behind them, and the person explains all that is seen.

How much one camera denies alone does not tell the two apart: near a corner of the cell it is a
sixth of the hull and more, while all cameras are right.

A gap of a few voxels that one camera cuts into a limb contradicts nothing, either: all others look
past it at the rest of the limb.  So it is closed.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

if TYPE_CHECKING:
    import numpy.typing as npt

    from actors.geometry.hull.visual_hull import VisualHull
    from actors.geometry.hull.voxels import VoxelBlocks

    Flags = npt.NDArray[np.bool_]
    Rows = npt.NDArray[np.int64]

CONTRADICTIONS_MIN: Final = 2
"""So many cameras must see something in a place that nothing else explains."""
CONTRADICTED_BLOCKS: Final = 2
"""Within so many blocks of such a place, too, the one camera is overruled."""
GAP_VOXELS: Final = 3
"""A gap is closed if something is so near on both sides of it."""


def overruled(hull: VisualHull, rows: Rows, raw: Rows, left: Rows) -> Rows:
    """Return the voxels about which the one camera that says "free" is wrong.

    Args:
        hull: The visual hull with the silhouettes of a set.
        rows: Voxels that exactly one camera says to be free.
        raw: Voxels that no camera says to be free; they explain what cameras see.
        left: Those of them that are something: not the robot, for example.
    """
    if not len(rows):
        return rows
    contradicted = np.zeros(hull.grid.block_shape, bool)
    wrong = rows[hull.contradictions(rows, raw) >= CONTRADICTIONS_MIN]
    contradicted.ravel()[wrong >> 6] = True
    near = grown(contradicted, CONTRADICTED_BLOCKS).ravel()[rows >> 6]
    return np.asarray(rows[near | _between(hull.grid, rows, left)])


def _between(grid: VoxelBlocks, rows: Rows, left: Rows) -> Flags:
    """Return which voxels have some of `left` on both sides of them along an axis."""
    result = np.zeros(len(rows), bool)
    if not len(left):
        return result
    inside = grid.indices(left).astype(np.int64)
    low = inside.min(0) - GAP_VOXELS
    shape = tuple((inside.max(0) - low + GAP_VOXELS + 1).tolist())
    dense = np.zeros(shape, bool)
    dense[tuple((inside - low).T)] = True
    asked = grid.indices(rows) - low
    within = ((asked >= GAP_VOXELS) & (asked < np.array(shape) - GAP_VOXELS)).all(1)
    asked, flat = asked[within], dense.ravel()
    place = np.ravel_multi_index(tuple(asked.T), shape)
    closed = np.zeros(len(place), bool)
    for stride in (shape[1] * shape[2], shape[2], 1):
        steps = range(stride, stride * GAP_VOXELS + 1, stride)
        behind = np.logical_or.reduce([flat[place - step] for step in steps])
        ahead = np.logical_or.reduce([flat[place + step] for step in steps])
        closed |= behind & ahead
    result[within] = closed
    return result


def grown(blocks: Flags, reach: int) -> Flags:
    """Return blocks (i, j, k) and all within so many blocks of them, along axes and diagonals."""
    import cv2

    if reach < 1:
        return blocks.copy()
    wide, deep, high = blocks.shape
    edge = 2 * reach + 1
    image = np.ascontiguousarray(blocks, np.uint8)
    flat = cv2.dilate(image, np.ones((edge, edge), np.uint8))
    lines = np.ascontiguousarray(flat).reshape(wide * deep, high)
    return np.asarray(cv2.dilate(lines, np.ones((1, edge), np.uint8)) > 0).reshape(blocks.shape)
