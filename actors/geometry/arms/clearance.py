"""Whether states of an arm touch what is occupied, many states at once.

The arm is covered by spheres along its capsules.  What is occupied lies in a grid, grown once per
radius of a sphere, so that a sphere is one look-up and 60 states take less than a millisecond.

Rules a change must keep: it is conservative.  A state that counts as free keeps every capsule at
least the margin away from every occupied cell, itself and the floor; beyond the grid is free.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from actors.geometry.arms.kinematics import capsules_at

if TYPE_CHECKING:
    import numpy.typing as npt

    from actors.geometry.arms.joint_paths import Arm

    F64 = npt.NDArray[np.float64]
    Cells = npt.NDArray[np.uint8]

SPACING_M: Final = 0.11
"""Greatest distance of two neighbouring spheres of a capsule."""
FLOOR_M: Final = 0.03
"""Height below which nothing of the arm may come."""


class ArmSpheres:
    """Spheres that cover the capsules of an arm.

    Attributes:
        radius_m: (n,), of each sphere.
        moves: (n,) bool, it belongs to a capsule that a joint can move off its place.
        pairs: (p, 2), spheres that must not meet: of capsules that are not neighbours.
    """

    def __init__(self, arm: Arm) -> None:
        self._arm = arm
        at_rest = capsules_at(arm, np.zeros(arm.q_max.shape))[0]
        draw = np.random.default_rng(0).uniform(-1.0, 1.0, (16, len(arm.q_max)))
        moving = np.ptp(capsules_at(arm, draw * arm.q_max)[..., :6], axis=0).max(1) > 1e-6
        lengths = np.linalg.norm(at_rest[:, 3:6] - at_rest[:, :3], axis=1)
        counts = np.maximum(2, np.ceil(lengths / SPACING_M).astype(int) + 1)
        self._capsule = np.repeat(np.arange(len(lengths)), counts)
        self._share = np.concatenate([np.linspace(0.0, 1.0, count) for count in counts])
        half = (lengths / (counts - 1) / 2.0)[self._capsule]
        self.radius_m = np.hypot(at_rest[self._capsule, 6], half)
        self.moves = moving[self._capsule]
        one, other = np.triu_indices(len(self._capsule), 1)
        room = np.array([
            lengths[i + 1 : j].sum() > at_rest[i, 6] + at_rest[j, 6] + SPACING_M
            for i, j in zip(self._capsule[one], self._capsule[other], strict=True)
        ])  # fmt: skip
        self.pairs = np.stack([one, other], 1)[room]
        self._apart_m = self.radius_m[self.pairs].sum(1)

    def centres(self, q_rad: F64) -> F64:
        """Return the centres of all spheres, (m, n, 3), metres, cell."""
        capsules = capsules_at(self._arm, q_rad)[:, self._capsule]
        share = self._share[:, None]
        return np.asarray(capsules[..., :3] * (1.0 - share) + capsules[..., 3:6] * share)

    def apart(self, centres_m: F64, slack_m: float = 0.0) -> npt.NDArray[np.bool_]:
        """Return which states, (m,), keep the arm off itself, or less than `slack_m` too near."""
        between = centres_m[:, self.pairs[:, 0]] - centres_m[:, self.pairs[:, 1]]
        squared = np.einsum("mpk,mpk->mp", between, between)
        return np.asarray((squared >= (self._apart_m - slack_m) ** 2).all(1))


class CellGrid:
    """Cells that may be occupied.

    Args:
        origin_m: (3,), lowest corner, cell frame.
        cell_m: Edge of a cell.
        shape: Cells along x, y, z.

    Attributes:
        occupied: (shape) uint8, 0 or 1.
    """

    def __init__(self, origin_m: F64, cell_m: float, shape: tuple[int, int, int]) -> None:
        self.origin_m, self.cell_m = np.asarray(origin_m, np.float64), cell_m
        self.occupied: Cells = np.zeros(shape, np.uint8)

    def mark_indices(self, indices: npt.NDArray[np.integer]) -> None:
        """Mark cells by their indices, (N, 3), all of them within the grid."""
        self.occupied[tuple(np.asarray(indices, np.intp).T)] = 1

    def mark_boxes(self, boxes: F64) -> None:
        """Mark every cell that boxes touch.

        Args:
            boxes: (n, 15): centre, half sizes, rotation row by row; metres, cell frame.
        """
        for box in np.reshape(boxes, (-1, 15)):
            turn = box[6:].reshape(3, 3)
            around = np.abs(turn) @ box[3:6] + self.cell_m
            low = np.floor((box[:3] - around - self.origin_m) / self.cell_m).astype(np.intp)
            high = np.ceil((box[:3] + around - self.origin_m) / self.cell_m).astype(np.intp)
            low, high = (np.clip(end, 0, self.occupied.shape) for end in (low, high))
            cells = tuple(slice(*ends) for ends in zip(low, high, strict=True))
            index = np.moveaxis(np.asarray(np.mgrid[cells]), 0, -1)
            off = self.origin_m + (index + 0.5) * self.cell_m - box[:3]
            reach = box[3:6] + self.cell_m / 2.0 * np.abs(turn).sum(0)
            self.occupied[cells] |= (np.abs(off @ turn) <= reach).all(-1).astype(np.uint8)

    def mark_cylinders(self, centres_m: F64, radii_m: F64, height_m: float) -> None:
        """Mark every cell that upright cylinders on the floor touch.

        Args:
            centres_m: (n, 2), x and y.
            radii_m: (n,).
            height_m: From z = 0 on.
        """
        x, y = (
            self.origin_m[k] + (np.arange(self.occupied.shape[k]) + 0.5) * self.cell_m
            for k in range(2)
        )
        top = int(np.ceil((height_m - self.origin_m[2]) / self.cell_m))
        for (cx, cy), radius in zip(centres_m, radii_m, strict=True):
            near = (x[:, None] - cx) ** 2 + (y[None] - cy) ** 2
            self.occupied[near <= (radius + 0.71 * self.cell_m) ** 2, : max(top, 0)] = 1

    def grown(self, radius_m: float) -> Cells:
        """Return the cells in which a sphere of a radius may touch an occupied cell."""
        import cv2

        cells = self.occupied
        reach = int(np.ceil(radius_m / self.cell_m))
        step = np.maximum(np.abs(np.arange(-reach, reach + 1)) - 1, 0) * self.cell_m
        kernel = (np.hypot(step[:, None], step[None]) < radius_m).astype(np.uint8)
        parts = [  # images with few channels: as many as every OpenCV takes
            cv2.dilate(np.ascontiguousarray(cells[..., k : k + 64]), kernel).reshape(
                *cells.shape[:2], -1
            )
            for k in range(0, cells.shape[2], 64)
        ]
        flat: Cells = np.concatenate(parts, 2).astype(np.uint8, copy=False)
        out = flat.copy()
        for k in range(1, min(reach, cells.shape[2] - 1) + 1):
            out[..., k:] |= flat[..., :-k]
            out[..., :-k] |= flat[..., k:]
        return out


class GrownGrid:
    """A grid, grown once for each size of an arm's spheres.

    Args:
        spheres: Of the arm.
        grid: What is occupied.
        margin_m: How far the arm has to keep from it.
    """

    def __init__(self, spheres: ArmSpheres, grid: CellGrid, margin_m: float) -> None:
        self._origin_m, self._cell_m = grid.origin_m, grid.cell_m
        radii = spheres.radius_m[spheres.moves] + margin_m
        steps = np.ceil(radii / grid.cell_m).astype(np.intp)
        # Spheres whose growth takes as many cells share a map, that of the largest of them.
        sizes = np.unique(steps)
        self._map = np.searchsorted(sizes, steps)
        grown = [grid.grown(float(radii[steps == size].max())) for size in sizes]
        self._maps = np.pad(np.stack(grown), ((0, 0), (1, 1), (1, 1), (1, 1)))

    def touched(self, centres_m: F64) -> npt.NDArray[np.bool_]:
        """Return which states touch what is occupied, (m,).

        Args:
            centres_m: (m, n, 3), of the spheres that move.
        """
        index = np.floor((centres_m - self._origin_m) / self._cell_m).astype(np.intp) + 1
        np.clip(index, 0, np.array(self._maps.shape[1:]) - 1, out=index)
        touched = self._maps[self._map, index[..., 0], index[..., 1], index[..., 2]]
        return np.asarray(touched.any(1))


class Clearance:
    """Answers which states of an arm are free.

    Args:
        spheres: Of the arm.
        arm: Its limits.
        grids: What is occupied.
        slack_m: How much less than that, and than the room that the arm needs beside itself, is
            enough.
    """

    def __init__(
        self,
        spheres: ArmSpheres,
        arm: Arm,
        grids: list[GrownGrid],
        *,
        slack_m: float = 0.0,
    ) -> None:
        self._spheres, self._q_max, self._grids = spheres, np.asarray(arm.q_max), grids
        self._floor_m = spheres.radius_m[spheres.moves] + FLOOR_M - slack_m
        self._slack_m = slack_m

    def free(self, q_rad: F64) -> npt.NDArray[np.bool_]:
        """Return which states are free.

        Args:
            q_rad: (m, n), or (n,) for one.

        Returns:
            (m,) bool.
        """
        q = np.atleast_2d(q_rad)
        centres = self._spheres.centres(q)
        moving = centres[:, self._spheres.moves]
        free = self._spheres.apart(centres, self._slack_m)
        free &= (moving[..., 2] >= self._floor_m).all(1)
        free &= (np.abs(q) <= self._q_max + 1e-9).all(1)
        for grid in self._grids:
            free &= ~grid.touched(moving)
        return np.asarray(free)
