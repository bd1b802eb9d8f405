"""A grid of voxels, numbered block by block: 4 x 4 x 4 voxels in a row, so that a block is a slice.

Row `64 * block + inner` is voxel (i, j, k) = 4 * (block's i, j, k) + (inner's i, j, k); the last
index counts fastest in both.  The centre of a voxel is `origin_m + (its i, j, k + 0.5) * voxel_m`.

Rules a change must keep: a row means the same everywhere; nothing here knows cameras.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

if TYPE_CHECKING:
    import numpy.typing as npt

    Numbers = npt.NDArray[np.floating]
    Rows = npt.NDArray[np.integer]

EDGE: Final = 4
"""Voxels along the edge of a block."""
PER_BLOCK: Final = EDGE**3
HALF_DIAGONAL: Final = 0.5 * math.sqrt(3.0)
"""Distance from the centre of a cube to its corners, in edges."""
VOXELS_MAX: Final = 50_000_000
"""More voxels than this are a mistake in the unit of the grid."""


class VoxelBlocks:
    """Where the voxels of a grid are.

    Args:
        origin_m: (3,), lowest corner in the cell frame.
        voxel_m: Edge of a voxel, above 0.
        shape: Voxels along x, y, z, each a multiple of 4.

    Raises:
        ValueError: Not such a grid, or one of more than `VOXELS_MAX` voxels.
    """

    def __init__(self, origin_m: Numbers, voxel_m: float, shape: tuple[int, ...]) -> None:
        origin = np.asarray(origin_m, np.float64)
        sound = origin.shape == (3,) and np.isfinite(origin).all() and 0.0 < voxel_m < np.inf
        if not sound or len(shape) != 3 or any(n < EDGE or n % EDGE for n in shape):
            raise ValueError(
                "grid: asked for an origin (3,), a voxel above 0 m and three numbers of voxels,"
                f" multiples of {EDGE}; found {origin.tolist()}, {voxel_m}, {tuple(shape)}"
            )
        if int(np.prod(shape, dtype=np.int64)) > VOXELS_MAX:
            raise ValueError(
                f"grid: asked for at most {VOXELS_MAX:,} voxels, found"
                f" {' x '.join(str(n) for n in shape)}; lengths are metres"
            )
        self.origin_m = origin
        self.voxel_m = float(voxel_m)
        self.shape = (int(shape[0]), int(shape[1]), int(shape[2]))
        self.block_shape = (shape[0] // EDGE, shape[1] // EDGE, shape[2] // EDGE)
        self._corner = np.indices(self.block_shape, np.int16).reshape(3, -1).T * np.int16(EDGE)
        self._inner = np.indices((EDGE,) * 3, np.int16).reshape(3, -1).T

    @property
    def blocks(self) -> int:
        """Number of blocks."""
        return len(self._corner)

    @property
    def voxels(self) -> int:
        """Number of voxels."""
        return self.blocks * PER_BLOCK

    @property
    def half_diagonal_m(self) -> float:
        """Distance of a voxel's centre to its corners."""
        return HALF_DIAGONAL * self.voxel_m

    def indices(self, rows: Rows) -> npt.NDArray[np.int16]:
        """Return (i, j, k) of rows, (N, 3)."""
        return np.asarray(self._corner[rows >> 6] + self._inner[rows & 63])

    def centres(self, rows: Rows) -> npt.NDArray[np.float32]:
        """Return the centres of rows, (N, 3), metres."""
        origin = (self.origin_m + 0.5 * self.voxel_m).astype(np.float32)
        scaled = self.indices(rows).astype(np.float32)
        scaled *= np.float32(self.voxel_m)
        scaled += origin
        return scaled

    def rows_of(self, indices: npt.NDArray[np.integer]) -> npt.NDArray[np.int64]:
        """Return the rows of voxels (N, 3) that are (i, j, k) within the grid."""
        i, j, k = np.asarray(indices, np.int64).T
        _, wide, high = self.block_shape
        block = ((i // EDGE) * wide + j // EDGE) * high + k // EDGE
        return np.asarray(block * PER_BLOCK + ((i % EDGE) * EDGE + j % EDGE) * EDGE + k % EDGE)

    def rows_in(self, blocks: Rows) -> npt.NDArray[np.int64]:
        """Return all rows of blocks, block by block."""
        first = np.asarray(blocks, np.int64)[:, None] * PER_BLOCK
        return np.asarray((first + np.arange(PER_BLOCK)).ravel())

    def block_major(self, dense: npt.NDArray[np.generic]) -> npt.NDArray[np.generic]:
        """Return an array over (i, j, k) as one over rows."""
        wide, deep, high = self.block_shape
        split = dense.reshape(wide, EDGE, deep, EDGE, high, EDGE)
        return split.transpose(0, 2, 4, 1, 3, 5).reshape(-1)

    def dense(self, rows: Rows) -> npt.NDArray[np.bool_]:
        """Return an array over (i, j, k) that is true at rows."""
        result = np.zeros(self.shape, bool)
        i, j, k = self.indices(np.asarray(rows)).T
        result[i, j, k] = True
        return result

    def lattice(self) -> tuple[Numbers, Numbers, Numbers]:
        """Return x, y, z of the corners of all voxels, each shaped to be broadcast; metres."""
        x, y, z = (
            origin + self.voxel_m * np.arange(n + 1)
            for origin, n in zip(self.origin_m, self.shape, strict=True)
        )
        return x[:, None, None], y[None, :, None], z[None, None, :]
