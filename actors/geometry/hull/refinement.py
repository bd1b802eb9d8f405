"""What of a visual hull is neither robot nor static nor impossible: refinement by knowledge.

====  ===========  =================================================  ===========================
rule  in counts    what                                               why it loses no person
====  ===========  =================================================  ===========================
R0    static       voxels within known obstacles go                   no person is inside them
R1    robot        voxels that touch the robot at the exposure go     it is at rest before a person
                                                                      comes that near
R2    small        a component with less than 0.5 l of visible        smaller than a hand; of a
                   volume that the robot does not explain goes, and   body at least one voxel has
                   so does one of less than 5 l that has no voxel     its centre in all silhouettes
                   with its centre in all silhouettes
R3    explained    a voxel within 10 cm of the robot goes if each     a hidden part of a body would
                   camera that sees it sees it on the robot           have to fit into that shell,
                                                                      which is thinner than the
                                                                      distance at which it rests
R4    unreachable  a block goes that is beyond reach at 3 m/s from    people do not appear out of
                   where something was in the last half second, or    nothing; if they seem to,
                   from outside; not the third set in a row in which  they have been overlooked
                   that takes the volume of a person away
R5    forgiven     where something was, and 5 cameras or more have a  camouflage, or a camera that
      (kept)       say, one that says "free" is overruled if others   is half blind
                   see what nothing else explains
R6    shadow       what a camera sees before a surface that is in     a camera that sees a person
                   shadow, and no camera as something dark elsewhere  before a lit place keeps them
====  ===========  =================================================  ===========================

A voxel that no camera can see is neither free nor an obstacle.  It counts as occupied while
something visible touches its block.  Where such voxels together could hold a person (a *pocket*),
and whatever touched them does not come back out, they stay occupied.

Rules a change must keep: the safe set (all voxels) is what protects; the tight set is within it and
serves figures, tracking and scores; without the pose of the robot no voxel is taken for the robot.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from actors.geometry.capsules import distance_to_points, fill, outlines
from actors.geometry.hull.overruled import grown, overruled
from actors.geometry.hull.pockets import Pockets
from actors.geometry.hull.silhouettes import packed, unpacked
from actors.geometry.hull.visibility import floor_seen, seen_by, static_voxels, surface_voxels
from actors.geometry.hull.voxels import PER_BLOCK

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy.typing as npt

    from actors.geometry.hull.visibility import Calibrated
    from actors.geometry.hull.visual_hull import VisualHull
    from actors.geometry.hull.voxels import VoxelBlocks

    Bits = npt.NDArray[np.uint8]
    Flags = npt.NDArray[np.bool_]
    Numbers = npt.NDArray[np.floating]
    Rows = npt.NDArray[np.int64]

ROBOT_MARGIN_M: Final = 0.01
"""R1: pose and shape of the robot are known this well."""
SHELL_M: Final = 0.10
"""R3: how far from the robot a voxel may be explained by it."""
EXPLAINED_GROWN_M: Final = 0.06
"""R3: by how much the robot's outlines are grown; its shadows and blurred edges."""
FINE_M: Final = 0.025
"""R3: that shell and that margin are for voxels of this edge; larger ones reach farther out."""
LOOKED_M: Final = 0.5
"""R2: what the robot explains within this distance makes no component visible."""
VISIBLE_M3_MIN: Final = 0.0005
"""R2: half a litre."""
RIM_M3_MAX: Final = 0.005
"""R2: a component with no voxel in the tight set is a rim of something; up to so much goes."""
SPEED_MAX_M_S: Final = 3.0
"""R4: faster than any person in a workcell."""
GAP_MAX_S: Final = 1.0
"""R4: after a longer gap between sets anything may be anywhere."""
RECENT_S: Final = 0.5
"""R4: so long after something was in a block it may still be there, overlooked."""
APPEARED_M3: Final = 0.020
"""R4: so much visible volume is a person, wherever they came from."""
APPEARED_SETS: Final = 3
"""R4: in so many sets in a row."""
SAMPLED: Final = 4
"""R4: one of so many voxels is looked at to find that volume; so it takes 0.3 ms."""
SAYS_MIN: Final = 5
"""R5: so many cameras must have a say for one to be outvoted."""
STEP_BLOCKS: Final = 1
"""R5: so many blocks people move on from one set to the next."""
ENTERED_BLOCKS: Final = 8
"""So deep in a pocket are the unseen parts of who stands in its opening: an arm and a trunk."""
NEAREST_M: Final = 0.5
"""People keep at least this far from each camera."""
NEIGHBOURS_MIN: Final = 14
"""A voxel of the tight set has at least so many of its 26 neighbours in it."""


@dataclass(frozen=True, slots=True, eq=False)
class Refined:
    """What is occupied, and what was taken away.

    Attributes:
        rows: (N,) int64, voxels of the safe set.
        clearance_m: (N,) float32, from the sphere around the voxel to the robot; metres.
        tight: (N,) bool, the tight set.
        component: (N,) int16, number of the connected component, the largest is 0.
        counts: Voxels per rule; `raw` before any of them, `forgiven` those that R5 kept.
        raw: (M,) int64, voxels before any rule.
    """

    rows: Rows
    clearance_m: npt.NDArray[np.float32]
    tight: Flags
    component: npt.NDArray[np.int16]
    counts: dict[str, int]
    raw: Rows

    @property
    def nearest(self) -> int:
        """Index of the voxel that is nearest to the robot; -1 if nothing is occupied."""
        return int(self.clearance_m.argmin()) if len(self.rows) else -1

    def limited(self, most: int) -> Refined:
        """Return the `most` voxels that are nearest to the robot; `counts` has "distant" more."""
        kept = np.sort(np.argpartition(self.clearance_m, most)[:most])
        return Refined(
            rows=self.rows[kept],
            clearance_m=self.clearance_m[kept],
            tight=self.tight[kept],
            component=self.component[kept],
            counts={**self.counts, "distant": len(self.rows) - most},
            raw=self.raw,
        )


@dataclass(frozen=True, slots=True, eq=False)
class _Beside:
    """Voxels that are not the robot: clearance in metres, and whether its outline explains them."""

    rows: Rows
    clearance_m: npt.NDArray[np.float32]
    explained: Flags

    def with_more(self, other: _Beside) -> _Beside:
        """Return these voxels and others behind them."""
        return _Beside(
            np.concatenate([self.rows, other.rows]),
            np.concatenate([self.clearance_m, other.clearance_m]),
            np.concatenate([self.explained, other.explained]),
        )


def moved_px(grid: VoxelBlocks, camera: Calibrated, moved_m: float) -> int:
    """Return by how many pixels something in the grid moves at most in an image.

    Args:
        grid: The voxels; what is nearer to the camera than `NEAREST_M` is left out.
        camera: Its calibration.
        moved_m: How far it moves.
    """
    if not moved_m:
        return 0
    rotation, shift = camera.camera_from_cell[:3, :3], camera.camera_from_cell[:3, 3]
    eye_m = -rotation.T @ shift
    high_m = grid.origin_m + grid.voxel_m * np.array(grid.shape)
    away_m = float(np.linalg.norm(eye_m - eye_m.clip(grid.origin_m, high_m)))
    matrix = camera.camera_matrix
    corners_px = np.array([(x, y) for x in (0, camera.width) for y in (0, camera.height)])
    slopes = (corners_px - matrix[:2, 2]) / matrix[[0, 1], [0, 1]]
    oblique = 1.0 + float((slopes**2).sum(1).max())
    focal_px = float(max(matrix[0, 0], matrix[1, 1]))
    return int(np.ceil(focal_px * moved_m * oblique / max(away_m, NEAREST_M)))


class Refinement:
    """Turns sets of silhouettes into what is occupied, set by set.

    Args:
        hull: The visual hull of the cell's cameras.
        calibrations: Of the same cameras, in the same order.
        boxes: Static obstacles, (n, 15) each: centre, half sizes, rotation; cell frame.
        moved_m: How far people move between the exposures of a set.  Silhouettes grow by it, but
            not from the robot's outlines, so that each camera leaves who was there at the first.
    """

    def __init__(
        self,
        hull: VisualHull,
        calibrations: Sequence[Calibrated],
        boxes: Sequence[Numbers],
        *,
        moved_m: float = 0.0,
    ) -> None:
        self._moved_px = [moved_px(hull.grid, camera, moved_m) for camera in calibrations]
        self._hull, self._grid = hull, hull.grid
        self._cameras = [(c.camera_matrix, c.distortion, c.camera_from_cell) for c in calibrations]
        self._sizes = [(c.height, c.width) for c in calibrations]
        self._coarse_m = max(0.0, (self._grid.voxel_m - FINE_M) * np.sqrt(3.0) / 2.0)
        self._static = static_voxels(self._grid, boxes)
        self._surface = surface_voxels(self._grid, boxes)
        self._floor = floor_seen(self._grid, calibrations, boxes)
        self._before: Flags | None = None
        self._since_s = np.full(self._grid.block_shape, np.inf, np.float32)
        self._appeared = 0
        self._live: tuple[int, ...] | None = None
        self._says = np.empty(0, np.uint8)
        self._unseen = self._seen_blocks = np.empty(0, np.int64)
        self._pockets = Pockets(self._grid, np.zeros(self._grid.voxels, bool))

    def step(
        self,
        silhouettes: Sequence[Bits | None],
        robot: Numbers | None,
        elapsed_s: float,
        shades: Sequence[Bits | None] = (),
    ) -> Refined:
        """Return what is occupied at an exposure.

        Args:
            silhouettes: (H, W / 8) uint8 per camera, None for a camera without one.
            robot: (n, 7) capsules at the exposure, metres, cell; None if the pose is not known:
                then nothing is taken for the robot, and everything is at distance 0.
            elapsed_s: Time since the set of the last call; beyond `GAP_MAX_S` the state is reset.
            shades: As `silhouettes`, what looks like a shadow and is no foreground; () if nothing.

        Raises:
            ValueError: Silhouettes of another number or size than the calibrations.
        """
        self._note_live(tuple(n for n, bits in enumerate(silhouettes) if bits is not None))
        outline = self._explaining(robot)
        with_robot = self._with_robot(self._moved(silhouettes, outline), robot)
        self._hull.load(with_robot, self._moved(shades, outline) if shades else ())
        found, one_veto = self._hull.carve_leniently(self._was_near(), self._seen_blocks)
        found = found[self._says[found] > 0]
        raw = np.concatenate([found, self._unseen])
        rows = found[~self._static[found]]
        counts = {"raw": len(raw), "static": len(found) - len(rows)}
        dark = self._hull.in_shadow(rows[self._surface[rows]], self._floor)
        shadow = self._hull.shaded(rows, dark)
        rows = np.concatenate([rows[~shadow], self._unseen])
        counts["shadow"] = int(shadow.sum())
        kept = self._possible(rows, elapsed_s, robot, outline)
        counts["unreachable"] = len(rows) - len(kept)
        counts["robot"] = counts["explained"] = 0
        away = self._beside_robot(kept, robot, outline, counts)
        forgiven = self._forgiven(one_veto, raw, away.rows)
        forgiven = forgiven[~self._hull.shaded(forgiven, dark)]
        counts["forgiven"] = len(forgiven)
        more = self._beside_robot(forgiven, robot, outline, counts)
        tight = np.zeros(len(away.rows) + len(more.rows), bool)
        seen = np.flatnonzero(self._says[away.rows] > 0)
        tight[seen] = self._hull.tight(away.rows[seen])
        solid = tight.copy()
        solid[seen] |= self._hull.dark(away.rows[seen])
        return self._components(away.with_more(more), (tight, solid), counts, raw)

    def _with_robot(
        self, silhouettes: Sequence[Bits | None], robot: Numbers | None
    ) -> Sequence[Bits | None]:
        """Return silhouettes in which the robot is foreground, whatever the camera took it for.

        What lies behind the robot no camera sees; a link of the colour of the wall, taken for a
        shadow on it, would say that it is free.
        """
        if robot is None or not len(robot):
            return silhouettes
        masks = self._drawn(np.asarray(robot, np.float64))
        result = []
        for bits, mask in zip(silhouettes, masks, strict=True):
            drawn = packed(mask)
            fits = bits is not None and bits.shape == drawn.shape
            result.append(bits | drawn if bits is not None and fits else bits)
        return result

    def _moved(
        self, silhouettes: Sequence[Bits | None], outline: list[npt.NDArray[np.uint8]]
    ) -> list[Bits | None]:
        """Return silhouettes grown by how far people move between the exposures."""
        import cv2

        result = list(silhouettes)
        for number, (bits, size) in enumerate(zip(silhouettes, self._sizes, strict=True)):
            px = self._moved_px[number]
            if px and bits is not None and bits.shape == (size[0], -(-size[1] // 8)):
                seen = unpacked(bits, size[1])
                if outline:
                    seen[outline[number] > 0] = 0
                edge = 2 * px + 1
                result[number] = bits | packed(
                    np.asarray(cv2.dilate(seen, np.ones((edge, edge), np.uint8)), np.uint8)
                )
        return result

    def _drawn(self, robot: Numbers) -> list[npt.NDArray[np.uint8]]:
        """Return the masks of capsules in all cameras."""
        lines = outlines(robot, self._cameras)
        return [
            fill(of_camera[None], *size)[0]
            for of_camera, size in zip(lines, self._sizes, strict=True)
        ]

    def _note_live(self, live: tuple[int, ...]) -> None:
        """Recount the cameras that see each voxel, if other cameras gave silhouettes."""
        if live == self._live:
            return
        self._live = live
        tables, said = self._hull.tables, self._says
        self._says = (
            seen_by([tables[n] for n in live]) if live else np.zeros(self._grid.voxels, np.uint8)
        )
        unseen = (self._says == 0) & ~self._static
        self._unseen = np.flatnonzero(unseen)
        self._seen_blocks = np.flatnonzero(self._says.reshape(-1, PER_BLOCK).any(1))
        self._pockets = Pockets(self._grid, unseen, self._pockets)
        if self._before is not None:
            rows = self._grid.rows_in(np.flatnonzero(self._before.ravel()))
            self._pockets.hold(rows[(said[rows] > 0) & (self._says[rows] == 0)])

    def _possible(
        self,
        rows: Rows,
        elapsed_s: float,
        robot: Numbers | None,
        outline: list[npt.NDArray[np.uint8]],
    ) -> Rows:
        """Return the voxels that people can have reached (R4), or all if a person has appeared."""
        reachable = self._reachable(elapsed_s)
        if reachable is None:
            self._appeared = 0
            return rows
        can_be = reachable.ravel()[rows >> 6]
        others = rows[~can_be][::SAMPLED]
        others = others[self._says[others] > 0]
        solid = others[self._hull.tight(others)]
        counts = {"robot": 0, "explained": 0}
        beside = self._beside_robot(solid, robot, outline, counts)
        volume_m3 = float((~beside.explained).sum()) * SAMPLED * self._grid.voxel_m**3
        self._appeared = self._appeared + 1 if volume_m3 >= APPEARED_M3 else 0
        return rows if self._appeared >= APPEARED_SETS else rows[can_be]

    def _reachable(self, elapsed_s: float) -> Flags | None:
        """Return which blocks (i, j, k) may be occupied now (R4); None if all."""
        if self._before is None or not 0.0 <= elapsed_s <= GAP_MAX_S:
            self._since_s[:] = np.inf
            return None
        block_m = self._grid.voxel_m * 4
        reach = int(np.ceil(SPEED_MAX_M_S * elapsed_s / block_m - 1e-9))
        recent = self._since_s <= RECENT_S
        self._since_s += np.float32(elapsed_s)
        result = grown(recent | self._pockets.held_blocks, reach)
        result[:reach] = result[-reach:] = True
        result[:, :reach] = result[:, -reach:] = True
        return result

    def _was_near(self) -> Flags:
        """Return the blocks (i, j, k) where something was, or a step away: R5 is about them."""
        if self._before is None or not self._before.any():
            return np.zeros(self._grid.block_shape, bool)
        return grown(self._before, STEP_BLOCKS)

    def _forgiven(self, one_veto: Rows, raw: Rows, left: Rows) -> Rows:
        """Return the voxels about which the one camera that says "free" is wrong (R5)."""
        rows = one_veto[self._says[one_veto] >= SAYS_MIN]
        return overruled(self._hull, rows[~self._static[rows]], raw, left)

    def _explaining(self, robot: Numbers | None) -> list[npt.NDArray[np.uint8]]:
        """Return where cameras may see the robot, its shadows and blurred edges."""
        if robot is None or not len(robot):
            return []
        larger = np.array(robot, np.float64)
        larger[:, 6] += EXPLAINED_GROWN_M + self._coarse_m
        return self._drawn(larger)

    def _beside_robot(
        self,
        rows: Rows,
        robot: Numbers | None,
        outline: list[npt.NDArray[np.uint8]],
        counts: dict[str, int],
    ) -> _Beside:
        """Return what of voxels is neither robot (R1) nor in the shell that it explains (R3)."""
        half_m = np.float32(self._grid.half_diagonal_m)
        explained = np.zeros(len(rows), bool)
        if robot is None:
            return _Beside(rows, np.zeros(len(rows), np.float32) - half_m, explained)
        near_m = distance_to_points(robot, self._grid.centres(rows))
        touches = near_m <= half_m + ROBOT_MARGIN_M
        candidates = np.flatnonzero((near_m < LOOKED_M) & ~touches & (self._says[rows] > 0))
        if len(candidates) and outline:
            explained[candidates] = self._hull.on_masks(rows[candidates], outline)
        gone = explained & (near_m < SHELL_M + self._coarse_m)
        counts["robot"] += int(touches.sum())
        counts["explained"] += int(gone.sum())
        stays = ~(touches | gone)
        return _Beside(rows[stays], near_m[stays] - half_m, explained[stays])

    def _components(
        self, beside: _Beside, sure: tuple[Flags, Flags], counts: dict[str, int], raw: Rows
    ) -> Refined:
        """Join blocks to components, drop the small ones (R2) and what is unseen and untouched."""
        from scipy import ndimage

        rows, clearance = beside.rows, beside.clearance_m
        tight, dark = sure
        shape = self._grid.block_shape
        voxel_m3 = self._grid.voxel_m**3
        visible = self._says[rows] > 0
        touched = np.zeros(shape, bool)
        touched.ravel()[rows[visible] >> 6] = True
        near, touched = grown(touched, ENTERED_BLOCKS), grown(touched, 1)
        held = self._pockets.held_voxels(rows)
        stays = visible | touched.ravel()[rows >> 6] | held
        stays |= self._pockets.entered(rows, touched, near)
        counts["unseen"] = int(len(rows) - stays.sum())
        occupied = np.zeros(shape, bool)
        occupied.ravel()[rows[stays] >> 6] = True
        labels, found = ndimage.label(occupied, np.ones((3, 3, 3)))
        label = np.where(stays, labels.ravel()[rows >> 6], 0)
        counted = visible & ~beside.explained
        volume = np.bincount(label[counted], minlength=found + 1) * voxel_m3
        solid = np.bincount(label[dark], minlength=found + 1) > 0
        good = (volume >= VISIBLE_M3_MIN) & (solid | (volume >= RIM_M3_MAX))
        good[label[held]] = True
        good[0] = False
        order = np.argsort(np.where(good, -volume, np.inf), kind="stable")
        number = np.empty(found + 1, np.int64)
        number[order] = np.arange(found + 1)
        kept = good[label]
        counts["small"] = int(stays.sum() - kept.sum())
        rows, label, visible = rows[kept], label[kept], visible[kept]
        self._before = np.zeros(shape, bool)
        self._before.ravel()[rows >> 6] = True
        self._since_s[self._before] = 0.0
        if self._pockets.note(rows, label, visible):
            return self._components(beside, sure, counts, raw)  # once: what is held stays held
        return Refined(
            rows=rows,
            clearance_m=clearance[kept],
            tight=self._without_corners(rows, tight[kept]),
            component=number[label].astype(np.int16),
            counts=counts,
            raw=raw,
        )

    def _without_corners(self, rows: Rows, tight: Flags) -> Flags:
        """Return the tight set without voxels that stick out.

        The corners that a hull of few cameras has, and a body has not, have few neighbours.
        """
        inside = rows[tight]
        if not len(inside):
            return tight
        index = self._grid.indices(inside).astype(np.int64)
        low = index.min(0) - 1
        dense = np.zeros(index.max(0) - low + 2, np.uint8)
        i, j, k = (index - low).T
        dense[i, j, k] = 1
        for axis in range(3):
            total = dense.copy()
            ahead = [slice(None)] * 3
            behind = [slice(None)] * 3
            ahead[axis], behind[axis] = slice(1, None), slice(None, -1)
            total[tuple(behind)] += dense[tuple(ahead)]
            total[tuple(ahead)] += dense[tuple(behind)]
            dense = total
        result = tight.copy()
        result[tight] = dense[i, j, k] > NEIGHBOURS_MIN
        return result
