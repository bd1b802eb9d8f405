"""Voxels and capsules as triangles and solids of Foxglove's scenes."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

_CORNERS: Final = {
    (0, 0): ((0, 0, 0), (0, 0, 1), (0, 1, 1), (0, 1, 0)),
    (0, 1): ((1, 0, 0), (1, 1, 0), (1, 1, 1), (1, 0, 1)),
    (1, 0): ((0, 0, 0), (1, 0, 0), (1, 0, 1), (0, 0, 1)),
    (1, 1): ((0, 1, 0), (0, 1, 1), (1, 1, 1), (1, 1, 0)),
    (2, 0): ((0, 0, 0), (0, 1, 0), (1, 1, 0), (1, 0, 0)),
    (2, 1): ((0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)),
}
"""Corners of the face of a unit cube by axis and side, counterclockwise as seen from outside."""
VOXELS_MAX: Final = 1 << 20
"""Largest plausible extent of a voxel grid along one axis."""
CELLS_MAX: Final = 1 << 26
"""In a grid of more cells, hidden voxels are not looked for."""

DENSE_TIMES: Final = 100
"""A grid of at most so many cells for each voxel is gone through as a whole, which is faster."""


def voxel_faces(voxels: NDArray[Any]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the outer faces of voxels: what lies between two of them is left out.

    Args:
        voxels: (N, 3) integers, indices into a grid; in any order, twice is once.

    Returns:
        (V, 3) corners in voxels and (M, 3) numbers of corners, two triangles per face, with their
        front outside.

    Raises:
        ValueError: The voxels lie more than `VOXELS_MAX` apart.
    """
    none = np.empty((0, 3), np.int64)
    if not len(voxels):
        return none, none
    numbered, lowest, extent = _coded(voxels)
    codes = np.unique(numbered)
    strides = np.array([extent[1] * extent[2], extent[2], 1])
    faces = []
    for (axis, side), corners in _CORNERS.items():
        beyond = codes + (2 * side - 1) * strides[axis]
        place = np.minimum(np.searchsorted(codes, beyond), len(codes) - 1)
        outer = codes[codes[place] != beyond]
        faces.append(outer[:, None] + np.array(corners) @ strides)
    quads = np.concatenate(faces)
    found, numbers = np.unique(quads, return_inverse=True)
    numbers = numbers.reshape(quads.shape)
    corners_at = np.stack(np.unravel_index(found, extent), axis=1) + lowest
    return corners_at, numbers[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)


def outer_voxels(voxels: NDArray[Any]) -> NDArray[np.int64]:
    """Return the voxels (N, 3) that have a free side; those with six neighbours are left out.

    Raises:
        ValueError: The voxels lie more than `VOXELS_MAX` apart.
    """
    if not len(voxels):
        return np.empty((0, 3), np.int64)
    codes, lowest, extent = _coded(voxels)
    cells = int(np.prod(extent, dtype=np.float64))
    if cells > CELLS_MAX:
        return np.stack(np.unravel_index(codes, extent), axis=1) + lowest
    occupied = np.zeros(cells, bool)
    occupied[codes] = True
    steps = (int(extent[1] * extent[2]), int(extent[2]), 1)
    if cells > DENSE_TIMES * len(codes):
        hidden = np.ones(len(codes), bool)
        for step in steps:
            hidden &= occupied[codes - step] & occupied[codes + step]
        outer = codes[~hidden]
    else:
        free = ~occupied
        shown = np.zeros(cells, bool)
        for step in steps:
            shown[step:] |= free[:-step]
            shown[:-step] |= free[step:]
        outer = np.flatnonzero(shown & occupied)
    return np.stack(np.unravel_index(outer, extent), axis=1) + lowest


def _coded(voxels: NDArray[Any]) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Return voxels as numbers, the lowest corner and the extent of their grid.

    A layer of nothing stands all around.
    """
    columns = np.ascontiguousarray(voxels.T)  # reducing along rows of three is 10 times slower
    corners = columns.min(axis=1), columns.max(axis=1)
    apart = max(float(high) - float(low) for low, high in zip(*corners, strict=True)) + 3.0
    if apart > VOXELS_MAX:
        raise ValueError(f"voxels lie {apart:.0f} apart; a grid has at most {VOXELS_MAX}")
    lowest = corners[0].astype(np.int64) - 1
    extent = corners[1].astype(np.int64) - lowest + 2
    codes = np.zeros(len(voxels), np.int64)
    for column, low, size in zip(columns, lowest, extent, strict=True):
        codes *= size
        codes += column.astype(np.int64) - low
    return codes, lowest, extent


class Capsule(NamedTuple):
    """A cylinder with half spheres at its ends.

    Attributes:
        ends_m: (2, 3) centres of the spheres.
        radius_m: Radius of all three.
        length_m: Between the centres.
        pose: (4, 4) rigid: middle of the cylinder, z along it.
    """

    ends_m: NDArray[np.float64]
    radius_m: float
    length_m: float
    pose: NDArray[np.float64]


def capsules_of(rows: NDArray[Any]) -> tuple[Capsule, ...]:
    """Return the capsules of rows (N, 7): end, end, radius."""
    ends_m = np.asarray(rows[:, :6], np.float64).reshape(-1, 2, 3)
    along = ends_m[:, 1] - ends_m[:, 0]
    lengths_m = np.linalg.norm(along, axis=1)
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3, 3] = ends_m.mean(axis=1)
    long = lengths_m > 0.0
    x, y, z = (along[long] / lengths_m[long, None]).T
    sign = np.copysign(1.0, z)
    a = -1.0 / (sign + z)  # two more axes without a case of their own (Duff et al. 2017)
    b = x * y * a
    axes = ((1.0 + sign * x * x * a, sign * b, -sign * x), (b, sign + y * y * a, -y), (x, y, z))
    poses[long, :3, :3] = np.array(axes).transpose(2, 1, 0)
    return tuple(map(Capsule, ends_m, rows[:, 6].tolist(), lengths_m.tolist(), poses))
