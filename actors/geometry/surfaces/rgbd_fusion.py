"""From posed RGB-D frames to one coloured surface.

    frames -> per view: cloud in the world -> all views: signed distance on a sparse grid -> mesh

Two halves on purpose: a cell's perception keeps one cloud and pose per view, its fusion the
surface; a direct run does both in a row.  Open3D is loaded on the first call.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from actors.geometry.open3d_arrays import image, tensor
from actors.geometry.open3d_on_use import open3d
from actors.geometry.poses import inverse
from actors.geometry.surfaces.coloured_surface import ColouredSurface
from actors.geometry.surfaces.depth import frame_points
from actors.geometry.surfaces.rendering import ray_scene

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy.typing as npt

    from actors.geometry.shapes import Camera, RecordedFrame

    Floats = npt.NDArray[np.float64]
    Colours = npt.NDArray[np.uint8]

DEPTH_M_MAX: Final = 6.0
"""Beyond, the spread of an RGB-D camera exceeds 6 cm and would smear the near surface."""

VOXEL_M_LIMITS: Final = (0.001, 0.02)
"""Finer is noise for any depth camera; coarser loses the edges of a package."""

BLOCK_EDGE: Final = 8
"""Voxels per edge of a block: 16 took 1.7 s for five frames and 8 takes 0.5 s, as fewer voxels
lie far from any surface."""

BLOCKS: Final = 16_000
"""Blocks made ready at the start, 160 MB; the grid grows beyond by itself."""

BLOCKS_MAX: Final = 250_000
"""2.5 GB; a hall on a grid of a millimetre is refused instead of filling the memory."""

ISLAND_SHARE: Final = 0.002
"""Connected pieces below this share of all triangles are flying pixels of edges."""


@dataclass(frozen=True, slots=True)
class Residual:
    """How far measured points lie from the fused surface, in metres."""

    median_m: float
    p95_m: float


class FusionError(ValueError):
    """The frames are sound, but no surface comes out of them."""


def view_cloud(
    frame: RecordedFrame, *, stride: int = 1, depth_m_max: float = DEPTH_M_MAX
) -> tuple[npt.NDArray[np.float32], Colours]:
    """Return what one frame measured, as points in the world.

    Args:
        frame: Depth, colour and pose.
        stride: Take every n-th row and column.
        depth_m_max: Farther measurements are left out.

    Returns:
        Points (N, 3) float32, metres, world frame; colours (N, 3), RGB, uint8.
    """
    depth_mm = frame.depth.depth_mm[::stride, ::stride]
    measured = (depth_mm > 0) & (depth_mm <= depth_m_max * 1000.0)
    grid_m = frame_points(frame.depth)[::stride, ::stride]
    return grid_m[measured], frame.colour[::stride, ::stride][measured]


def natural_voxel_m(frames: Sequence[RecordedFrame]) -> float:
    """Return a grid edge that suits a recording: two pixels at the median depth, in metres."""
    median_m = float(np.median([frame.median_m for frame in frames]))
    camera = frames[0].depth.acquisition.camera
    return float(np.clip(2.0 * median_m / camera.fx_px, *VOXEL_M_LIMITS))


def fuse_frames(
    frames: Sequence[RecordedFrame], *, voxel_m: float, depth_m_max: float = DEPTH_M_MAX
) -> ColouredSurface:
    """Merge posed frames into one coloured surface.

    Args:
        frames: At least one.
        voxel_m: Edge of the grid, metres; the surface is truncated 8 voxels behind each
            measurement.
        depth_m_max: Farther measurements are ignored.

    Returns:
        The surface in the world frame, small islands removed.

    Raises:
        FusionError: No surface came out, because nothing lies nearer than `depth_m_max`; or
            the grid would fill the memory.

    Source: ENACT 4.2 (fusion); method after Curless and Levoy 1996.
    """
    o3d = open3d()
    core = o3d.core
    grid = o3d.t.geometry.VoxelBlockGrid(
        attr_names=("tsdf", "weight", "color"),
        attr_dtypes=(core.float32, core.float32, core.float32),
        attr_channels=((1,), (1,), (3,)),
        voxel_size=voxel_m,
        block_resolution=BLOCK_EDGE,
        block_count=BLOCKS,
    )
    matrix = tensor(_matrix(frames[0].depth.acquisition.camera))
    depth_mm_max = depth_m_max * 1000.0
    in_reach = [
        f for f in frames if ((f.depth.depth_mm > 0) & (f.depth.depth_mm < depth_mm_max)).any()
    ]
    for frame in in_reach:  # Open3D raises on a frame that touches nothing
        camera_from_world = tensor(inverse(frame.world_from_camera))
        # uint16 with uint8 is one of the two pairs that Open3D integrates; mixed ones raise.
        depth = image(frame.depth.depth_mm)
        colour = image(frame.colour)
        view = (matrix, camera_from_world, 1000.0, depth_m_max)
        blocks = grid.compute_unique_block_coordinates(depth, *view)
        grid.integrate(blocks, depth, colour, matrix, matrix, *view[1:])
        if grid.hashmap().size() > BLOCKS_MAX:
            raise FusionError(
                f"asked to fuse {len(frames)} frames on a grid of {voxel_m * 1e3:.1f} mm; at"
                f" {frame.name} it needs more than {BLOCKS_MAX} blocks; use a coarser grid"
            )
    mesh = None
    if in_reach:
        mesh = grid.extract_triangle_mesh(weight_threshold=min(2.5, 0.5 * len(frames)))
    if mesh is None or mesh.triangle.indices.shape[0] == 0:
        raise FusionError(
            f"asked to fuse {len(frames)} frames on a grid of {voxel_m * 1e3:.1f} mm; no surface"
            f" came out; is anything nearer than {depth_m_max:g} m?"
        )
    return _without_islands(mesh.to_legacy())


def residual(
    surface: ColouredSurface,
    frames: Sequence[RecordedFrame],
    *,
    depth_m_max: float = DEPTH_M_MAX,
) -> Residual:
    """Measure how well all views agree with the surface made of them.

    Args:
        surface: The fused surface.
        frames: The views; every eighth pixel is compared.
        depth_m_max: Farther measurements are left out.

    Returns:
        Median and 95th percentile of the unsigned distance.
    """
    scene = ray_scene(surface.vertices_m, surface.triangles)
    points_m = np.concatenate(
        [view_cloud(frame, stride=8, depth_m_max=depth_m_max)[0] for frame in frames]
    )
    distance_m = scene.compute_distance(tensor(points_m, np.float32)).numpy()
    return Residual(float(np.median(distance_m)), float(np.quantile(distance_m, 0.95)))


def _matrix(camera: Camera) -> Floats:
    """Return the camera matrix K, (3, 3), for Open3D's integration.

    It cuts pixel coordinates off instead of rounding them, which shifts every image by half a
    pixel and slanted surfaces by 1.3 mm at 1 m (320 x 240): the centre moves to undo that.
    """
    return np.array(
        [
            [camera.fx_px, 0.0, camera.cx_px + 0.5],
            [0.0, camera.fy_px, camera.cy_px + 0.5],
            [0.0, 0.0, 1.0],
        ]
    )


def _without_islands(mesh: Any) -> ColouredSurface:  # an Open3D mesh; Open3D has no types
    """Drop small connected pieces and return plain arrays."""
    labels, sizes, _ = mesh.cluster_connected_triangles()
    small = np.asarray(sizes) < ISLAND_SHARE * len(mesh.triangles)
    mesh.remove_triangles_by_mask(small[np.asarray(labels)])
    mesh.remove_unreferenced_vertices()
    mesh.compute_vertex_normals()
    colours = np.asarray(mesh.vertex_colors)
    return ColouredSurface(
        np.asarray(mesh.vertices).astype(np.float32),
        np.asarray(mesh.vertex_normals).astype(np.float32),
        np.rint(colours * 255.0).clip(0, 255).astype(np.uint8),
        np.asarray(mesh.triangles).astype(np.int32),
    )
