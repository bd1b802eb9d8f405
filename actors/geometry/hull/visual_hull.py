"""The visual hull of a set of silhouettes: all voxels that no camera says to be free.

Two levels: blocks of 4 x 4 x 4 voxels are looked up in pooled masks, the rest voxel by voxel,
each camera only on what the last one left.  More levels of an octree do not pay.

What looks like a shadow is no veto: a person in grey before a grey wall looks like one, too.
`shaded` finds the voxels that are before a real shadow.  A shadow lies on a surface, and each
camera that sees the place sees it dark: where a known surface is dark to all cameras, and looks
like shadow to two of them, it is in shadow.  Whatever has a lit place behind it is a thing.  Height
above the surface would not tell the two apart: cameras that look down upon a shadow leave a pyramid
over it, half as high as it is wide.

Rules a change must keep: numpy only; a camera without a silhouette vetoes nothing; the result is
the same in whatever order the cameras are asked.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from actors.geometry.hull.silhouettes import unpacked
from actors.geometry.hull.visibility import GROWN_PX, POOL_PX, POOLS
from actors.geometry.hull.voxels import PER_BLOCK

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy.typing as npt

    from actors.geometry.hull.visibility import CameraTable
    from actors.geometry.hull.voxels import VoxelBlocks

    Bits = npt.NDArray[np.uint8]
    Rows = npt.NDArray[np.integer]


FOREGROUND: Final = 255
SHADE: Final = 1
"""Value of a pixel near which is shadow and no foreground; background is 0."""
SURFACE_NEAR: Final = np.ones((11, 11), np.uint8)
"""Places on a surface lie so many pixels apart in an image, and shadows have soft edges."""
SHADE_SAYS_MIN: Final = 2
"""So many cameras must see a place on a surface as shadow."""
FILLED_PX_MIN: Final = POOL_PX * POOL_PX // 2
"""So many pixels of a cell that show something are no edge and no noise."""
EXPLAINING_STEP: Final = 3
"""One of so many voxels is projected to find what they explain: several fall into each cell."""
BITS_SET: Final = np.unpackbits(np.arange(256, dtype=np.uint8)[:, None], axis=1).sum(1, np.uint8)


class Masks:
    """One camera's silhouette as its table looks it up: grown, pooled, with sentinels."""

    def __init__(self, table: CameraTable) -> None:
        self._table = table
        shape = (1 + len(GROWN_PX), table.height, table.width)
        self.pixels = np.zeros(table.sentinel + 1, np.uint8)
        self.pixels[-1] = 255
        self._levels = self.pixels[:-1].reshape(shape)
        self.cells = np.zeros(table.pool_sentinel + 1, np.uint8)
        self.cells[-1] = 255
        self._pools = self.cells[:-1].reshape(len(POOLS), *table.pool_shape)
        self._dirty = (slice(0, 0), slice(0, 0))
        self._dark: Bits = np.empty((0, 0), np.uint8)
        self.shades = False

    def load(self, bits: Bits, name: str, shade: Bits | None = None) -> None:
        """Take the silhouette of a set.

        Args:
            bits: (H, W / 8) uint8, as `silhouettes.packed` makes them.
            name: What an error calls it.
            shade: As `bits`, what looks like a shadow; None or empty if nothing does.

        Raises:
            ValueError: The silhouette is not of the size of the calibration.
        """
        import cv2

        table = self._table
        asked = (table.height, -(-table.width // 8))
        if bits.shape != asked or bits.dtype != np.uint8:
            raise ValueError(
                f"{name}: asked for {table.width} x {table.height} pixels as in the"
                f" calibration (uint8 of shape {asked}), found {bits.dtype} of shape {bits.shape}"
            )
        self.shades = shade is not None and shade.size > 0
        dark = bits
        if shade is not None and self.shades:
            if shade.shape != bits.shape or shade.dtype != np.uint8:
                raise ValueError(
                    f"{name}: asked for shade as uint8 of shape {asked}, found {shade.dtype} of"
                    f" shape {shade.shape}"
                )
            dark = bits | shade
        self._dark = dark
        self._load_pools(dark)
        rows = np.flatnonzero(dark.any(1))
        columns = np.flatnonzero(dark.any(0))
        self._levels[:, *self._dirty] = 0
        if not len(rows):
            self._dirty = (slice(0, 0), slice(0, 0))
            return
        most = GROWN_PX[-1]
        top, bottom = max(rows[0] - most, 0), min(rows[-1] + 1 + most, table.height)
        left = max(8 * columns[0] - most, 0)
        right = min(8 * columns[-1] + 8 + most, table.width)
        region = self._dirty = (slice(top, bottom), slice(left, right))
        levels = self._levels[:, *region]
        levels[0] = unpacked(bits, table.width)[region]
        if shade is not None and self.shades:
            np.maximum(levels[0], unpacked(shade, table.width)[region] & SHADE, out=levels[0])
        before = 0
        for place, grown in enumerate(GROWN_PX, 1):
            kernel = np.ones((2 * (grown - before) + 1,) * 2, np.uint8)
            cv2.dilate(levels[place - 1], kernel, dst=levels[place])
            before = grown

    def unexplained(self, pixels: Rows) -> npt.NDArray[np.uint8]:
        """Return which cells show something, and have none of these pixels in or beside them.

        Returns:
            `pool_shape` of the table, uint8, 0 or 1.
        """
        import cv2

        explained = np.zeros(self._table.pool_shape, np.uint8)
        explained.ravel()[self._table.cell_of_pixel(pixels)] = 1
        filled = BITS_SET[_by_cell(self._dark)].sum(1, np.uint8) >= FILLED_PX_MIN
        return np.asarray(filled > cv2.dilate(explained, np.ones((3, 3), np.uint8)), np.uint8)

    def _load_pools(self, bits: Bits) -> None:
        """Pool the bits to cells and grow these."""
        import cv2

        pooled = np.bitwise_or.reduce(_by_cell(bits), axis=1)
        before, grown = 0, (pooled > 0).astype(np.uint8)
        for place, reach in enumerate(POOLS):
            kernel = np.ones((2 * (reach - before) + 1,) * 2, np.uint8)
            grown = np.asarray(cv2.dilate(grown, kernel), np.uint8)
            self._pools[place] = grown
            before = reach


class VisualHull:
    """Carves the voxels of a grid by silhouettes.

    Args:
        grid: The voxels.
        tables: What each camera can say, of the same grid.
    """

    def __init__(self, grid: VoxelBlocks, tables: Sequence[CameraTable]) -> None:
        self.grid = grid
        self.tables = tuple(tables)
        self._masks = tuple(Masks(table) for table in self.tables)
        self._given: tuple[int, ...] = ()

    def load(self, silhouettes: Sequence[Bits | None], shades: Sequence[Bits | None] = ()) -> None:
        """Take a set of silhouettes, one per camera in the order of the tables.

        Args:
            silhouettes: (H, W / 8) uint8 each; None where a camera has none and vetoes nothing.
            shades: Of the same cameras, what looks like a shadow; () if nothing does.

        Raises:
            ValueError: Another number of silhouettes than of cameras, or one of another size.
        """
        if len(silhouettes) != len(self.tables):
            raise ValueError(
                f"asked for {len(self.tables)} silhouettes, one per camera,"
                f" found {len(silhouettes)}"
            )
        given = []
        shades = shades or (None,) * len(silhouettes)
        for number, (bits, shade) in enumerate(zip(silhouettes, shades, strict=True)):
            if bits is not None:
                self._masks[number].load(bits, f"silhouette {number}", shade)
                given.append(number)
        self._given = tuple(given)

    def carve(self, blocks: Rows) -> npt.NDArray[np.int64]:
        """Return the rows of all voxels of some blocks that no camera says to be free."""
        for number in self._given:
            cells, table = self._masks[number].cells, self.tables[number]
            blocks = blocks[cells[table.cell[blocks]] > 0]
        rows = self.grid.rows_in(blocks)
        for number in self._given:
            pixels, table = self._masks[number].pixels, self.tables[number]
            rows = rows[pixels[table.pixel[rows]] > 0]
        return rows

    def carve_leniently(
        self, near: npt.NDArray[np.bool_], blocks: Rows | None = None
    ) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
        """Return the rows of all voxels that no camera, and of those that one says to be free.

        Args:
            near: Blocks (i, j, k) of which those are looked for that one camera says to be free.
            blocks: Numbers of the blocks to look at; all when absent.
        """
        start = (~near).ravel().astype(np.uint8)
        if blocks is None:
            blocks = np.arange(self.grid.blocks)
        vetoes = start[blocks]
        for number in self._given:
            free = self._masks[number].cells[self.tables[number].cell[blocks]] == 0
            vetoes = vetoes + free
            few = vetoes <= 1
            blocks, vetoes = blocks[few], vetoes[few]
        rows = self.grid.rows_in(blocks)
        vetoes = np.repeat(start[blocks], PER_BLOCK)
        for number in self._given:
            free = self._masks[number].pixels[self.tables[number].pixel[rows]] == 0
            vetoes += free
            few = vetoes <= 1
            rows, vetoes = rows[few], vetoes[few]
        one = vetoes > start[rows >> 6]
        return rows[~one], rows[one]

    def in_shadow(
        self, surface: Rows, floor: npt.NDArray[np.int32]
    ) -> list[npt.NDArray[np.uint8] | None]:
        """Return where cameras see known surfaces that are in shadow.

        Args:
            surface: Voxels on obstacles that no camera says to be free.
            floor: As `visibility.floor_seen` returns it.

        Returns:
            (H, W) uint8 per camera, not 0 where it does; None of a camera that sees no shadow.
        """
        import cv2

        result: list[npt.NDArray[np.uint8] | None] = [None] * len(self.tables)
        shady = [number for number in self._given if self._masks[number].shades]
        if not shady:
            return result
        places = np.arange(floor.shape[1])
        for number in self._given:
            places = places[self._masks[number].pixels[floor[number, places]] > 0]
        looked = {
            number: np.concatenate([self.tables[number].pixel[surface], floor[number, places]])
            for number in shady
        }
        says = np.zeros(len(surface) + len(places), np.uint8)
        for number in shady:
            says += self._masks[number].pixels[looked[number]] == SHADE
        for number in shady:
            table = self.tables[number]
            index = looked[number][says >= SHADE_SAYS_MIN]
            index = index[index != table.sentinel]
            mask = np.zeros((table.height, table.width), np.uint8)
            mask.ravel()[index % table.mask_px] = 255
            result[number] = np.asarray(cv2.dilate(mask, SURFACE_NEAR), np.uint8)
        return result

    def shaded(
        self, rows: Rows, in_shadow: Sequence[npt.NDArray[np.uint8] | None]
    ) -> npt.NDArray[np.bool_]:
        """Return which voxels a camera sees before a shadow, and none as something dark.

        Args:
            rows: Any voxels.
            in_shadow: As the method of that name returns it.
        """
        free = np.zeros(len(rows), bool)
        doubtful = np.zeros(len(rows), bool)
        for number, mask in enumerate(in_shadow):
            if mask is None:
                continue
            table = self.tables[number]
            index = table.pixel[rows]
            at = np.flatnonzero(self._masks[number].pixels[index] == SHADE)
            behind = mask.ravel()[index[at] % table.mask_px] > 0
            free[at[behind]] = True
            doubtful[at[~behind]] = True
        return free & ~doubtful

    def contradictions(self, rows: Rows, hull: Rows) -> npt.NDArray[np.uint8]:
        """Return how many cameras see something where a voxel is, and no voxel of a hull.

        Args:
            rows: Any voxels.
            hull: Voxels that explain what cameras see.
        """
        result = np.zeros(len(rows), np.uint8)
        some = hull[::EXPLAINING_STEP]
        for number in self._given:
            table = self.tables[number]
            index = table.pixel[some]
            seen = index[index != table.sentinel] % table.mask_px
            unexplained = self._masks[number].unexplained(seen)
            if unexplained.any():
                index = table.pixel[rows]
                cells = table.cell_of_pixel(index % table.mask_px)
                result += unexplained.ravel()[cells] & (index != table.sentinel)
        return result

    def tight(self, rows: Rows) -> npt.NDArray[np.bool_]:
        """Return which voxels have their centre in every silhouette, as it came."""
        return self._centres(rows, FOREGROUND)

    def dark(self, rows: Rows) -> npt.NDArray[np.bool_]:
        """Return which voxels have their centre in every silhouette or what looks like shadow."""
        return self._centres(rows, SHADE)

    def _centres(self, rows: Rows, least: int) -> npt.NDArray[np.bool_]:
        result = np.ones(len(rows), bool)
        for number in self._given:
            table = self.tables[number]
            index = table.pixel[rows]
            silent = index == table.sentinel
            result &= silent | (self._masks[number].pixels[index % table.mask_px] >= least)
        return result

    def on_masks(self, rows: Rows, masks: Sequence[npt.NDArray[np.uint8]]) -> npt.NDArray[np.bool_]:
        """Return which voxels lie on given masks for every camera that sees them.

        Cameras without a silhouette count, too: so a camera that dies takes no voxel away.

        Args:
            rows: Any voxels.
            masks: (H, W) uint8 per camera, not 0 where it is.
        """
        left = np.arange(len(rows))
        for table, mask in zip(self.tables, masks, strict=True):
            index = table.pixel[rows[left]]
            silent = index == table.sentinel
            left = left[silent | (mask.ravel()[index % table.mask_px] > 0)]
        result = np.zeros(len(rows), bool)
        result[left] = True
        return result


def _by_cell(bits: Bits) -> Bits:
    """Return the bytes of each cell of a mask, (rows of cells, `POOL_PX`, columns of cells)."""
    missing = -len(bits) % POOL_PX
    if missing:
        bits = np.concatenate([bits, np.zeros((missing, bits.shape[1]), np.uint8)])
    return bits.reshape(-1, POOL_PX, bits.shape[1])
