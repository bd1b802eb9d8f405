"""A surface as a depth camera without noise would see it.

Rules a change must keep: depth along the optical axis (not along the ray); nothing behind the
camera; Open3D loads on the first call.
"""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from actors.geometry.open3d_arrays import tensor
from actors.geometry.open3d_on_use import open3d
from actors.geometry.poses import inverse, moved

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy.typing as npt

    from actors.geometry.shapes import Acquisition, Camera, Surface


@lru_cache(maxsize=8)
def _directions(
    shape: tuple[int, int], focal_px: tuple[float, float], centre_px: tuple[float, float]
) -> npt.NDArray[np.float32]:
    """Return the ray of every pixel with z = 1, (H, W, 3), so that its length is the depth."""
    rows, columns = np.meshgrid(
        np.arange(shape[0], dtype=np.float32), np.arange(shape[1], dtype=np.float32), indexing="ij"
    )
    rays = np.ones((*shape, 3), np.float32)
    rays[..., 0] = (columns - centre_px[0]) / focal_px[0]
    rays[..., 1] = (rows - centre_px[1]) / focal_px[1]
    rays.setflags(write=False)
    return rays


def directions(camera: Camera) -> npt.NDArray[np.float32]:
    """Return the viewing ray of every pixel, z = 1, (H, W, 3) float32, camera frame, read-only."""
    return _directions(camera.shape, (camera.fx_px, camera.fy_px), (camera.cx_px, camera.cy_px))


def ray_scene(vertices_m: npt.NDArray[np.floating], triangles: npt.NDArray[np.integer]) -> Any:
    """Return an Open3D scene of one mesh for ray casting and distances.

    Args:
        vertices_m: (N, 3), metres.
        triangles: (M, 3), vertex numbers.
    """
    scene = open3d().t.geometry.RaycastingScene()
    scene.add_triangles(tensor(vertices_m, np.float32), tensor(triangles, np.uint32))
    return scene


def render_depth(
    placed: Sequence[tuple[Surface, npt.NDArray[np.float64]]],
    acquisition: Acquisition,
) -> npt.NDArray[np.float32]:
    """Return the depth image of surfaces in the world.

    Args:
        placed: Surfaces and, for each, world_from_surface (4, 4).
        acquisition: Camera and pose.

    Returns:
        (H, W) float32, metres along the optical axis, NaN where nothing is hit.
    """
    depth_m = np.full(acquisition.camera.shape, np.nan, np.float32)
    if placed:
        camera_from_world = inverse(acquisition.world_from_camera)
        vertices, triangles, first = [], [], 0
        for surface, world_from_surface in placed:
            vertices.append(moved(surface.vertices_m, camera_from_world @ world_from_surface))
            triangles.append(surface.triangles + first)
            first += len(surface.vertices_m)
        mesh = np.concatenate(vertices), np.concatenate(triangles)
        covered, depth_m[covered] = depth_where_seen(*mesh, acquisition.camera)
    return depth_m


def depth_where_seen(
    vertices_m: npt.NDArray[np.floating],
    triangles: npt.NDArray[np.integer],
    camera: Camera,
) -> tuple[tuple[slice, slice], npt.NDArray[np.float32]]:
    """Return the rows and columns in which a camera sees a mesh, and its depth there.

    Args:
        vertices_m: (N, 3), camera frame, metres.
        triangles: (M, 3), vertex numbers.
        camera: What looks.

    Returns:
        The pixels around all vertices, and depth of their size, metres, NaN where nothing is hit.
    """
    low, high = np.zeros(2, int), np.array(camera.shape)
    away_m = vertices_m[:, 2]
    if away_m.min() > 0.0:  # else some of it is behind the camera, and may be anywhere
        row = camera.fy_px * vertices_m[:, 1] / away_m + camera.cy_px
        column = camera.fx_px * vertices_m[:, 0] / away_m + camera.cx_px
        seen = np.stack([row, column])
        low = np.maximum(low, np.floor(seen.min(axis=1)).astype(int))
        high = np.minimum(high, np.ceil(seen.max(axis=1)).astype(int) + 1)
    high = np.maximum(low, high)
    pixels = slice(int(low[0]), int(high[0])), slice(int(low[1]), int(high[1]))
    rays = directions(camera)[pixels]
    if not rays.size:
        return pixels, np.zeros(rays.shape[:2], np.float32)
    return pixels, cast(ray_scene(vertices_m, triangles), rays)


def cast(scene: Any, rays: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """Return the distance to the first hit along rays from the origin, in units of their length.

    Args:
        scene: From `ray_scene`, in the frame of the rays.
        rays: (H, W, 3) float32.

    Returns:
        (H, W) float32, NaN where nothing is hit.
    """
    full = np.zeros((*rays.shape[:2], 6), np.float32)
    full[..., 3:] = rays
    hit = scene.cast_rays(tensor(full))["t_hit"].numpy()
    return np.where(np.isfinite(hit), hit, np.float32(np.nan)).astype(np.float32)
