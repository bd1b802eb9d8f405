"""Outlines of a product: the model's own from right above, and what a camera sees of it.

An outline in an image is not quite that from right above: walls are seen aslant, low parts count as
ground, and beside a neighbour most of it is the neighbour's.  `unbiased` draws what the camera
would see, neighbours included, finds the outline there as in the real image, and takes from both
only what is the product's own.

Rule a change must keep: both outlines are found by the same code (`new_pieces`) and fitted alike,
so that whatever that is off by drops out.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from actors.geometry.open3d_arrays import tensor
from actors.geometry.poses import inverse, on_tray, yaw_of
from actors.geometry.recognition.segmentation import new_pieces
from actors.geometry.shapes import Acquisition, DepthFrame
from actors.geometry.surfaces.rendering import directions, render_depth

if TYPE_CHECKING:
    import numpy.typing as npt

    from actors.geometry.shapes import Surface

    Pose = npt.NDArray[np.float64]
    Points = npt.NDArray[np.floating]
    Image = npt.NDArray[np.float32]

OUTLINE_CELL_M: Final = 0.001
"""Grid of the outline's distances; interpolation makes it finer than the sensor's 1.5 mm pixels."""

OUTLINE_MARGIN_M: Final = 0.05
"""How far around the product the distances reach; farther points count like the border."""

ROUNDS: Final = 3
"""How often the drawn image follows the pose: a neighbour hides another part each time. Trays of 12
that touch were found within 0.66 mm (p95) with one round, 0.38 with three."""

OWN_M: Final = 0.002
"""So near to where the outline would be without neighbours a point of it is the product's own …"""

NEAR_M: Final = 0.004
"""… and so near to the drawn outline is a point of the real one that belongs to the same part."""

OWN_POINTS: Final = 40
"""With fewer a pose is not corrected: the arcs of two corners have as many."""

AROUND_PX: Final = 24
"""What is looked at beside the drawn product: what the filters of `new_pieces` reach, and more."""


class OutlineField:
    """Distances to the outline of a surface as seen from above, on a grid."""

    def __init__(self, surface: Surface, scene: Any) -> None:
        from scipy.ndimage import binary_closing, distance_transform_edt

        self._low = surface.vertices_m[:, :2].min(axis=0) - OUTLINE_MARGIN_M
        high = surface.vertices_m[:, :2].max(axis=0) + OUTLINE_MARGIN_M
        columns, rows = np.ceil((high - self._low) / OUTLINE_CELL_M).astype(int)
        x = self._low[0] + OUTLINE_CELL_M * np.arange(columns)
        y = self._low[1] + OUTLINE_CELL_M * np.arange(rows)
        rays = np.zeros((rows, columns, 6), np.float32)
        rays[..., 0], rays[..., 1] = np.meshgrid(x, y)
        rays[..., 2], rays[..., 5] = surface.vertices_m[:, 2].max() + 0.1, -1.0
        hit = np.isfinite(scene.cast_rays(tensor(rays))["t_hit"].numpy())
        inside = binary_closing(hit, iterations=2) | hit
        outwards = distance_transform_edt(~inside) - distance_transform_edt(inside)
        # The outline runs between the last point inside and the first outside.
        self._distance_m = OUTLINE_CELL_M * (outwards - 0.5 * np.sign(outwards))
        self._slope = np.gradient(self._distance_m, OUTLINE_CELL_M)[::-1]

    def fitted(self, outline_m: Points, start: Pose) -> Pose:
        """Return the upright pose near `start` that puts points onto the outline, robustly.

        Args:
            outline_m: (K, 2), tray frame, metres.
            start: tray_from_product to start from; its z and tilt are ignored.
        """
        from scipy.ndimage import map_coordinates
        from scipy.optimize import least_squares

        centre = outline_m.mean(axis=0)
        back = inverse(start)

        def local(freedoms: Pose) -> tuple[Pose, Pose, Pose]:
            # Turning about the middle of the points keeps the freedoms independent.
            turn = back[:2, :2] @ on_tray(0.0, 0.0, -freedoms[2])[:2, :2]
            beside = outline_m - centre - freedoms[:2]
            at = beside @ turn.T + back[:2, :2] @ centre + back[:2, 3]
            return turn, beside, (at - self._low).T[::-1] / OUTLINE_CELL_M

        def distances(freedoms: Pose) -> Pose:
            cell = local(freedoms)[2]
            return np.asarray(map_coordinates(self._distance_m, cell, order=1, mode="nearest"))

        def slopes(freedoms: Pose) -> Pose:
            turn, beside, cell = local(freedoms)
            slope = np.stack(
                [map_coordinates(each, cell, order=1, mode="nearest") for each in self._slope], 1
            )
            round_it = np.column_stack([beside[:, 1], -beside[:, 0]]) @ turn.T
            return np.column_stack([-slope @ turn, np.einsum("ij,ij->i", slope, round_it)])

        solved = least_squares(
            distances,
            np.zeros(3),
            jac=slopes,
            loss="arctan",
            f_scale=0.004,
            x_scale=[0.01, 0.01, 0.1],
            max_nfev=40,
            xtol=1e-6,
            ftol=1e-6,
        )
        found = on_tray(0.0, 0.0, solved.x[2])
        found[:2, 3] = centre + solved.x[:2] - found[:2, :2] @ centre
        pose = found @ start
        return on_tray(pose[0, 3], pose[1, 3], yaw_of(pose))


def unbiased(
    field: OutlineField,
    outline_m: Points,
    surface: Surface,
    fitted: Pose,
    seen_by: Acquisition,
    before_m: Image | None = None,
) -> Pose:
    """Return a fitted pose without what fitting outlines of this product is off there.

    Args:
        field: Of the surface.
        outline_m: (K, 2), the points along the outline that was seen, tray frame, metres.
        surface: Product frame.
        fitted: What `OutlineField.fitted` made of them, within 4 mm.
        seen_by: The camera that saw them, and its pose in the tray frame.
        before_m: (H, W), its image without the product, metres; a bare tray when absent.
    """
    from scipy.spatial import cKDTree

    ground_m = _ground(seen_by)
    pose = fitted
    for _ in range(ROUNDS):
        depth_m = render_depth([(surface, pose)], seen_by)
        alone = _drawn_outline(depth_m, ground_m, seen_by)
        drawn = alone if before_m is None else _drawn_outline(depth_m, before_m, seen_by)
        if not len(alone) or not len(drawn):
            return pose
        own = cKDTree(alone).query(drawn)[0] < OWN_M
        apart_m, nearest = cKDTree(drawn).query(outline_m)
        chosen = outline_m[(apart_m < NEAR_M) & own[nearest]]
        if min(len(chosen), int(own.sum())) < OWN_POINTS:
            return pose
        seen, again = field.fitted(chosen, pose), field.fitted(drawn[own], pose)
        pose = np.asarray(seen @ inverse(again) @ pose)
    return pose


def _drawn_outline(depth_m: Image, before_m: Image, seen_by: Acquisition) -> Points:
    """Return the outline of a drawn product as `new_pieces` finds it, (K, 2), tray frame, metres.

    Args:
        depth_m: (H, W), the product alone, NaN beside it.
        before_m: (H, W), what is there without it.
        seen_by: What looks.
    """
    rows, columns = (np.flatnonzero(np.isfinite(depth_m).any(axis=axis)) for axis in (1, 0))
    if not len(rows):
        return np.empty((0, 2))
    window = tuple(
        slice(max(0, part[0] - AROUND_PX), part[-1] + 1 + AROUND_PX) for part in (rows, columns)
    )
    part_m, there_m = depth_m[window], before_m[window]
    seen_m = np.where(there_m < part_m, there_m, part_m)
    seen_m = np.where(np.isfinite(part_m), seen_m, there_m)
    frame = DepthFrame(_millimetres(seen_m), _part_of(seen_by, window, seen_m.shape))
    pieces = new_pieces(frame, _millimetres(there_m))
    return pieces[0].outline_m if pieces else np.empty((0, 2))


def _part_of(
    seen_by: Acquisition, window: tuple[slice, ...], shape: tuple[int, ...]
) -> Acquisition:
    camera, (rows, columns) = seen_by.camera, window
    part = replace(
        camera,
        height_px=shape[0],
        width_px=shape[1],
        cx_px=camera.cx_px - columns.start,
        cy_px=camera.cy_px - rows.start,
    )
    return Acquisition(part, seen_by.world_from_camera)


def _millimetres(depth_m: Image) -> Image:
    return np.asarray(np.nan_to_num(1000.0 * depth_m), np.float32)


def _ground(seen_by: Acquisition) -> Image:
    """Return the image of the bare plane z = 0, (H, W), metres; NaN where it is not seen."""
    eye = seen_by.world_from_camera
    down = directions(seen_by.camera) @ eye[2, :3]
    with np.errstate(divide="ignore"):
        depth_m = -eye[2, 3] / down
    return np.where(depth_m > 0.0, depth_m, np.nan).astype(np.float32)
