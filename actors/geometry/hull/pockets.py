"""Pockets: connected space that no camera can see and that is large enough to hold a person.

A person who enters one disappears from view.  A pocket is *held* from the set on in which whatever
visible touched it is gone, until as much visible volume stands beside it again; one that reaches
the side of the grid may be entered unseen and is always held.  While something visible touches a
pocket, the near part of it counts as occupied: a person half inside is only half seen.  One that
comes into being because a camera ceases to look is held if something was in it.

Rules a change must keep: a pocket smaller than a person is never held, because who reaches into it
stays visible outside; when other cameras than before give silhouettes, what was held stays held.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

if TYPE_CHECKING:
    import numpy.typing as npt

    from actors.geometry.hull.voxels import VoxelBlocks

    Flags = npt.NDArray[np.bool_]
    Rows = npt.NDArray[np.integer]

PERSON_M3_MIN: Final = 0.020
"""A pocket of less volume hides no person."""
LEFT_SHARE: Final = 0.5
"""If this share of the volume that touched a pocket stands beside it, it has come out."""
BESIDE_BLOCKS: Final = 3
"""How many blocks from a pocket are still beside it: what a person walks in one period."""


class Pockets:
    """The pockets of a grid, and which of them are held.

    Args:
        grid: The voxels.
        unseen: (voxels,) bool: no camera has a say, and no obstacle is there.
        before: The pockets until now, which were held with other cameras.
    """

    def __init__(self, grid: VoxelBlocks, unseen: Flags, before: Pockets | None = None) -> None:
        self._grid = grid
        self._of_row = np.zeros(0, np.int16)
        self._largest_m3 = np.zeros(0)
        self._held = np.zeros(0, bool)
        self._always = np.zeros(0, bool)
        self._touched = np.zeros(0, bool)
        self.held_blocks = np.zeros(grid.block_shape, bool)
        if float(unseen.sum()) * grid.voxel_m**3 >= PERSON_M3_MIN:
            self._find(unseen)
            if before is not None:
                self._take_over(before)
            self._update_blocks()

    @property
    def count(self) -> int:
        """How many pockets there are."""
        return len(self._held)

    @property
    def held(self) -> Flags:
        """Which of them are held, (count,)."""
        return self._held | self._always

    def _find(self, unseen: Flags) -> None:
        """Join unseen voxels to pockets and drop those too small to hide a person."""
        from scipy import ndimage

        grid = self._grid
        dense = np.zeros(grid.shape, bool)
        rows = np.flatnonzero(unseen)
        i, j, k = grid.indices(rows).T
        dense[i, j, k] = True
        labels, found = ndimage.label(dense)
        label = labels[i, j, k]
        volume = np.bincount(label, minlength=found + 1) * grid.voxel_m**3
        large = np.flatnonzero(volume[1:] >= PERSON_M3_MIN) + 1
        number = np.full(found + 1, -1, np.int16)
        number[large] = np.arange(len(large))
        self._of_row = np.full(grid.voxels, -1, np.int16)
        self._of_row[rows] = number[label]
        self._largest_m3 = np.zeros(len(large))
        self._held = np.zeros(len(large), bool)
        self._touched = np.zeros(len(large), bool)
        self._always = np.zeros(len(large), bool)
        wide, deep, _ = grid.shape
        side = (i == 0) | (i == wide - 1) | (j == 0) | (j == deep - 1)
        at_side = number[label[side]]
        self._always[at_side[at_side >= 0]] = True
        self._beside = []
        for pocket in range(len(large)):
            blocks = np.zeros(grid.block_shape, bool)
            blocks.ravel()[np.flatnonzero(self._of_row == pocket) >> 6] = True
            self._beside.append(
                np.asarray(
                    ndimage.binary_dilation(blocks, np.ones((3, 3, 3)), BESIDE_BLOCKS)
                ).ravel()
            )

    def _take_over(self, before: Pockets) -> None:
        """Hold what was held, and remember the volume that went in."""
        if not before.count or not self.count:
            return
        was = np.flatnonzero(before.held_voxels(np.arange(self._grid.voxels)))
        now = self._of_row[was]
        for pocket in np.unique(now[now >= 0]):
            rows = was[now == pocket]
            self._held[pocket] = True
            self._largest_m3[pocket] = before._largest_m3[before._of_row[rows]].max()

    def hold(self, rows: Rows) -> None:
        """Hold the pockets in which something was, before a camera that saw it ceased to look.

        Args:
            rows: (N,) voxels that were occupied.
        """
        if not self.count or not len(rows):
            return
        inside = self._of_row[rows]
        volume = np.bincount(inside[inside >= 0], minlength=self.count) * self._grid.voxel_m**3
        self._held |= volume > 0.0
        self._largest_m3 = np.maximum(self._largest_m3, volume)
        self._update_blocks()

    def _update_blocks(self) -> None:
        self.held_blocks[:] = False
        held = np.flatnonzero(self.held_voxels(np.arange(self._grid.voxels)))
        self.held_blocks.ravel()[held >> 6] = True

    def held_voxels(self, rows: Rows) -> Flags:
        """Return which voxels lie in a pocket that is held."""
        if not self.count or not self.held.any():
            return np.zeros(len(rows), bool)
        return np.asarray(np.append(self.held, False)[self._of_row[rows]])

    def entered(self, rows: Rows, touched: Flags, near: Flags) -> Flags:
        """Return which voxels a person can reach into who stands in the opening of a pocket.

        What of them is outside is seen, what is inside is not: it counts before they have vanished.

        Args:
            rows: (N,) voxels that no camera says to be free.
            touched: Blocks (i, j, k) that something visible touches.
            near: Blocks so near to something visible as a person reaches.
        """
        if not self.count:
            return np.zeros(len(rows), bool)
        pocket, block = self._of_row[rows], rows >> 6
        inside = pocket >= 0
        open_now = np.unique(pocket[inside & touched.ravel()[block]])
        return np.asarray(inside & near.ravel()[block] & np.isin(pocket, open_now))

    def note(self, rows: Rows, component: Rows, visible: Flags) -> bool:
        """Take what is occupied in a set; return whether a pocket is held from this set on.

        Its voxels belong to this set already: who went in is in no other place.

        Args:
            rows: (N,) voxels.
            component: (N,) number of the component of each.
            visible: (N,) a camera has a say about it.
        """
        if not self.count:
            return False
        voxel_m3 = self._grid.voxel_m**3
        held = self._held.copy()
        volume = np.bincount(component[visible]) * voxel_m3
        touching = self._of_row[rows]
        for pocket in range(self.count):
            components = np.unique(component[touching == pocket])
            components = components[components < len(volume)]
            visible_m3 = float(volume[components].sum())
            if visible_m3 >= PERSON_M3_MIN:
                self._touched[pocket] = True
                self._largest_m3[pocket] = max(self._largest_m3[pocket], visible_m3)
                continue
            if not (self._touched[pocket] or self._held[pocket]):
                continue
            near = self._beside[pocket][rows >> 6] & visible
            whole = np.unique(component[near])
            out = float(volume[whole].sum()) >= LEFT_SHARE * self._largest_m3[pocket]
            self._held[pocket], self._touched[pocket] = not out, False
            if out:
                self._largest_m3[pocket] = 0.0
        if not np.array_equal(held, self._held):
            self._update_blocks()
        return bool((self._held & ~held).any())
