"""What all views leave of a block of space: signed distances on a dense grid, and their surface.

    bounds -> every grid point into every view: free, near a surface, or hidden -> weighted mean
           -> down to the plate along the slope of the walls -> smoothed -> triangles

A dense grid and not a sparse one, since a package has half a million points only, and what a dense
one knows about hidden points closes the walls: no view ever saw them free, so they are solid.

Rules a change must keep: the grid's lowest layer is the plate, z = 0, so that the surface is open
where the product stands and nowhere else; what lies behind a measured surface says next to
nothing, or a film seen from above would fill the space under its rim.

Source: Curless and Levoy 1996 (distances with confidences, unseen space).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from actors.geometry.open3d_arrays import tensor
from actors.geometry.open3d_on_use import open3d
from actors.geometry.poses import inverse
from actors.geometry.surfaces.depth import grid_normals, mean_known, points_grid

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy.typing as npt

    from actors.geometry.shapes import Acquisition

    Floats = npt.NDArray[np.float32]
    Pose = npt.NDArray[np.float64]

REACH_VOXELS: Final = 3.0
"""Distances are cut off here: five spreads of a pixel at 2 mm."""

BEHIND_VOXELS: Final = (1.25, 2.75)
"""How far behind a surface its view has its full say and its last; noise of a pixel stays within
the first, or walls move inwards (0.4 mm when the say fell from 0 on)."""

HIDDEN_WEIGHT: Final = 0.01
"""Weight of "no view saw it free" against one perpendicular view: 0.15 moved every wall out by 0.4
mm.
"""

GRAZING_COS: Final = 0.15
"""Surfaces seen flatter than 81 degrees count as if at that, and so do the ends of a surface."""

MARGIN_VOXELS: Final = 4
"""Layers of the grid around everything that was seen."""

SEEN_FROM_M: Final = 0.005
"""Below, plate and product are one to a depth sensor (`segmentation.PLATE_M` and its noise)."""

FOOT_M: Final = 0.0075
"""Below, the surface goes on as it is above: clear of layers that smoothing leaves one-sided."""

SLOPE_LAYERS: Final = 5
"""Layers above the foot that give its slope: 8 mm."""

SLOPE_WITHIN: Final = 0.8
"""Distances up to here, in reaches, are certainly not truncated."""

SLOPE_SPREAD_VOXELS: Final = 2.0
"""Spread over which the slope is averaged: four times amplified, its noise would show."""

SMOOTH_VOXELS: Final = 0.6
"""Spread of the smoothing, which also closes gaps of single grid points between two pixels; rounds
an edge by half a millimetre at 2 mm."""

POINTS_MAX: Final = 20_000_000
"""Points of a grid, 500 MB at work; beyond, the grid is refused."""


@dataclass(frozen=True, slots=True, eq=False)
class SeenDepth:
    """What one view shows of an object.

    Attributes:
        depth_m: (H, W) float32, metres along the optical axis, NaN off the object.
        free: (H, W) bool, pixels that surely look past the object.
        acquisition: Camera and pose; the world is the product frame.
    """

    depth_m: Floats
    free: npt.NDArray[np.bool_]
    acquisition: Acquisition


def solid_surface(
    views: Sequence[SeenDepth],
    bounds_m: tuple[npt.NDArray[np.floating], npt.NDArray[np.floating]],
    *,
    voxel_m: float,
) -> tuple[Floats, npt.NDArray[np.int64]]:
    """Return the surface of what the views leave, standing on z = 0 and open there.

    Args:
        views: At least one.
        bounds_m: Least and greatest corner of what was seen, (3,) each, metres, product frame.
        voxel_m: Edge of the grid in metres, > 0.

    Returns:
        Vertices (N, 3) float32, metres; triangles (M, 3) int64, counter-clockwise from outside.

    Raises:
        ValueError: The grid would have more than `POINTS_MAX` points.
    """
    margin_m = MARGIN_VOXELS * voxel_m
    low = np.array([*(bounds_m[0][:2] - margin_m), 0.0])
    shape = np.ceil((bounds_m[1] + margin_m - low) / voxel_m).astype(int) + 1
    if shape.prod() > POINTS_MAX:
        raise ValueError(
            f"asked for a grid of {voxel_m * 1e3:.1f} mm over {shape * voxel_m} m, found"
            f" {shape.prod()} points of at most {POINTS_MAX}; use a coarser grid"
        )
    axes = [low[axis] + voxel_m * np.arange(shape[axis]) for axis in range(3)]
    field = _distances(views, axes, voxel_m)
    _down_to_the_plate(field, axes[2])
    return _zero_surface(field, low, voxel_m)


def _distances(views: Sequence[SeenDepth], axes: Sequence[Pose], voxel_m: float) -> Floats:
    """Return the mean signed distance at each grid point, (X, Y, Z), in reaches, -1 to 1."""
    shape = tuple(len(axis) for axis in axes)
    total = np.full(shape, -HIDDEN_WEIGHT, np.float32)
    weights = np.full(shape, HIDDEN_WEIGHT, np.float32)
    for view in views:
        facing = _facing(view)
        camera_from_world = inverse(view.acquisition.world_from_camera).astype(np.float32)
        x, y = (part.astype(np.float32) for part in np.meshgrid(axes[0], axes[1], indexing="ij"))
        for layer, height in enumerate(axes[2]):  # by layers, to stay within the cache
            flat = camera_from_world[:3, 3] + camera_from_world[:3, 2] * np.float32(height)
            local = [
                camera_from_world[i, 0] * x + camera_from_world[i, 1] * y + flat[i]
                for i in range(3)
            ]
            distance, weight = _seen_from(view, facing, local, voxel_m)
            total[..., layer] += weight * distance
            weights[..., layer] += weight
    blind = axes[2] < SEEN_FROM_M
    total[..., blind] = weights[..., blind] = 0.0
    # A point in no view's pixel takes its neighbours' mean; for all points that would shrink walls,
    # since free space is more certain than solid.
    lent = _blurred(total) / np.maximum(_blurred(weights), np.float32(1e-9))
    field = np.where(weights > 2.0 * HIDDEN_WEIGHT, total / np.maximum(weights, 1e-9), lent)
    field[..., ~blind] = _blurred(field[..., ~blind])
    return np.asarray(field, np.float32)


def _facing(view: SeenDepth) -> Floats:
    """Return the cosine between each pixel's surface and its viewing ray, (H, W)."""
    points = points_grid(mean_known(view.depth_m, 5), view.acquisition.camera)
    normals = grid_normals(points, reach_px=2)
    with np.errstate(invalid="ignore"):
        cosine = -np.einsum("ijk,ijk->ij", normals, points) / np.linalg.norm(points, axis=2)
    return np.asarray(np.clip(np.nan_to_num(cosine), GRAZING_COS, 1.0), np.float32)


def _seen_from(
    view: SeenDepth, facing: Floats, local_m: Sequence[Floats], voxel_m: float
) -> tuple[Floats, Floats]:
    """Return what one view says about points in its camera frame: distance, in reaches; weight."""
    camera = view.acquisition.camera
    x, y, depth = local_m
    column, row = np.rint(camera.column_row(x, y, depth)).astype(np.int64)
    inside = (column >= 0) & (column < camera.width_px) & (row >= 0) & (row < camera.height_px)
    inside &= depth > 0.0
    pixel = np.where(inside, row * camera.width_px + column, 0)
    cosine = facing.ravel()[pixel]
    distance = (view.depth_m.ravel()[pixel] - depth) * cosine / np.float32(voxel_m)
    known = np.isfinite(distance) & inside
    distance = np.where(known, distance, np.float32(0.0))
    full, last = BEHIND_VOXELS
    say = np.clip((distance + last) / (last - full), 0.0, 1.0)
    weight = np.where(known, cosine * say, 0.0)
    past = view.free.ravel()[pixel] & inside
    distance = np.where(past, np.float32(REACH_VOXELS), distance)
    weight = np.where(past, np.float32(1.0), weight)
    return np.clip(distance / REACH_VOXELS, -1.0, 1.0), weight.astype(np.float32)


def _down_to_the_plate(field: Floats, heights_m: Pose) -> None:
    """Let the surface run on to the plate as it runs above `FOOT_M`, in place.

    The slope comes from points near the surface alone and is lent to those around: farther ones
    are cut off, and a wall that leans by 35 degrees would end in a step.
    """
    from scipy.ndimage import gaussian_filter

    above = int(np.searchsorted(heights_m, FOOT_M))
    if above + SLOPE_LAYERS > field.shape[2]:
        return
    layers = field[..., above : above + SLOPE_LAYERS]
    near = np.abs(layers) < SLOPE_WITHIN
    both = (near[..., 1:] & near[..., :-1]).astype(np.float32)
    rise = (np.diff(layers, axis=2) * both).sum(axis=2)
    known = gaussian_filter(both.sum(axis=2), SLOPE_SPREAD_VOXELS)
    slope = gaussian_filter(rise, SLOPE_SPREAD_VOXELS) / np.maximum(known, np.float32(1e-6))
    for layer in range(above):
        field[..., layer] = np.clip(layers[..., 0] - slope * (above - layer), -1.0, 1.0)


def _blurred(field: Floats) -> Floats:
    from scipy.ndimage import gaussian_filter

    return np.asarray(gaussian_filter(field, SMOOTH_VOXELS, mode="nearest"), np.float32)


def _zero_surface(
    field: Floats, low_m: Pose, voxel_m: float
) -> tuple[Floats, npt.NDArray[np.int64]]:
    """Return the triangles where the distance is zero, in metres."""
    volume = tensor(field.transpose(2, 1, 0))
    mesh = open3d().t.geometry.TriangleMesh.create_isosurfaces(volume, [0.0])
    vertices = mesh.vertex.positions.numpy()
    if len(vertices) == 0:
        return np.empty((0, 3), np.float32), np.empty((0, 3), np.int64)
    return (
        (vertices * voxel_m + low_m).astype(np.float32),
        mesh.triangle.indices.numpy().astype(np.int64)[:, ::-1],
    )
