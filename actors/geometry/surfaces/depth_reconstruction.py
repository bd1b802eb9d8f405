"""One view's point cloud to a boundary representation: triangles and planar patches.

cloud -> depth grid -> normals -> planar patches (largest first) -> vertices slide along their
viewing rays onto their patch -> triangles between neighbours that no edge of the object separates

Rules a change must keep: a vertex moves along its own viewing ray only, so that the surface can
be put back into the image it came from (fusion does); a patch that bends systematically is no
patch, whatever its spread.

Source: ENACT 4.2 (reconstruction actor).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from actors.geometry.shapes import FREE_FORM, Camera, PointCloud, Surface
from actors.geometry.surfaces.depth import (
    depth_of_points,
    grid_normals,
    mean_known,
    median_known,
    points_grid,
    spread_m,
)

if TYPE_CHECKING:
    import numpy.typing as npt

    Points = npt.NDArray[np.floating]
    Plane = npt.NDArray[np.float64]

PATCH_SHARE_MIN: Final = 0.04
"""A patch covers at least this share of the view; smaller ones gain nothing over free form."""

PATCHES_MAX: Final = 8
"""A convex package shows at most a handful of faces to one camera."""

PATCH_ANGLE_COS: Final = float(np.cos(np.deg2rad(20.0)))
"""Normals of a patch lie within 20 degrees: single normals are off by about 8."""

BEND_MAX: Final = 0.35
"""Largest root mean square of the smoothed distances to a patch, in spreads of one pixel.

Averaged over 9x9 pixels noise alone leaves 0.13; a film that rises 4 mm over 120 mm leaves 0.8."""

GRAZING_TANGENT: Final = 4.0
"""Steepest surface that is joined across two pixels, slope along the viewing ray (76 degrees)."""

ISLAND_SHARE: Final = 0.02
"""Pieces of an image below this share of its largest are no part of the object."""

SLIDE_M_MAX: Final = 0.01
"""Farthest that a point moves along its ray, by the median or onto its patch: where a ray only
grazes a plane, sliding leads nowhere."""


def reconstruct_view(cloud: PointCloud, camera: Camera) -> Surface:
    """Build the boundary representation of what one view shows.

    Args:
        cloud: Points of the object alone, (N, 3) float32, metres, camera frame, from one image.
        camera: The camera that took the image.

    Returns:
        Surface in the camera frame; empty if the cloud is. A point too grazing for triangles stays
        as a vertex, since it says that its viewing ray does not pass the object.
    """
    depth_m = _without_strays(depth_of_points(cloud.points_m, camera))
    window = _window(np.isfinite(depth_m), margin_px=6)
    part_m = depth_m[window]
    median_m = median_known(part_m, 3)
    # Beside the outline the median counts unknown pixels as 0: there the measured value stays.
    with np.errstate(invalid="ignore"):
        part_m = np.where(np.abs(median_m - part_m) < SLIDE_M_MAX, median_m, part_m)
    corner_px = window[0].start, window[1].start
    grid = points_grid(part_m, camera, corner_px=corner_px)
    smooth = points_grid(mean_known(part_m, 5), camera, corner_px=corner_px)
    patch, planes = find_patches(grid, grid_normals(smooth, reach_px=3))
    on_patch = patch != FREE_FORM
    slid = _slid(grid[on_patch], planes[patch[on_patch]])
    too_far = np.abs(slid[:, 2] - grid[on_patch][:, 2]) > SLIDE_M_MAX
    patch[on_patch] = np.where(too_far, FREE_FORM, patch[on_patch])
    grid[on_patch] = np.where(too_far[:, None], grid[on_patch], slid)
    triangles = grid_triangles(grid, camera)
    used = np.flatnonzero(np.isfinite(grid[..., 2]))
    renumbered = np.zeros(grid[..., 2].size, np.int32)
    renumbered[used] = np.arange(len(used))
    return Surface(
        vertices_m=grid.reshape(-1, 3)[used],
        triangles=renumbered[triangles],
        patch_of_vertex=patch.reshape(-1)[used],
        patch_planes=planes,
    )


def find_patches(
    grid: npt.NDArray[np.float32], normals: npt.NDArray[np.float32]
) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.float64]]:
    """Find the planar patches of an image of points, the largest first.

    Args:
        grid: (H, W, 3) float32, metres, camera frame, NaN off the object.
        normals: (H, W, 3) float32, towards the camera, NaN where not known.

    Returns:
        Patch number of each pixel, (H, W) int32, `FREE_FORM` for none; planes (P, 4) float64,
        camera frame, normals towards the camera.
    """
    free = np.isfinite(grid[..., 2])
    enough = PATCH_SHARE_MIN * free.sum()
    seeds = free & np.isfinite(normals[..., 2])
    patch = np.full(free.shape, FREE_FORM, np.int32)
    planes: list[Plane] = []
    for _ in range(2 * PATCHES_MAX):
        if len(planes) == PATCHES_MAX or seeds.sum() < max(enough, 16):
            break
        bin_of = _plane_bins(grid[seeds], normals[seeds])
        members = np.zeros_like(seeds)
        members[seeds] = bin_of == np.bincount(bin_of).argmax()
        grown, plane = _grown(grid, normals, members, free)
        if grown.sum() >= enough and _bend(grid, grown, plane) < BEND_MAX:
            patch[grown] = len(planes)
            planes.append(plane)
            free &= ~grown
        seeds &= free & ~grown & ~members
    return patch, np.array(planes).reshape(-1, 4)


def grid_triangles(
    grid_m: npt.NDArray[np.float32], camera: Camera, *, broken: bool = False
) -> npt.NDArray[np.int64]:
    """Join neighbouring pixels to triangles unless the surface breaks between them.

    Args:
        grid_m: (H, W, 3) float32, metres, camera frame, NaN off the object.
        camera: Gives the size of a pixel.
        broken: Join also where the surface breaks, as a curtain hung over it would.

    Returns:
        (M, 3), flat pixel numbers, counter-clockwise seen from the camera.
    """
    height, width = grid_m.shape[:2]
    number = np.arange(height * width).reshape(height, width)
    a, b = number[:-1, :-1].ravel(), number[:-1, 1:].ravel()
    c, d = number[1:, :-1].ravel(), number[1:, 1:].ravel()
    triangles = np.concatenate([np.column_stack([a, c, b]), np.column_stack([b, c, d])])
    # Corner by corner: a reduction over an axis of three is ten times slower.
    one, other, third = (grid_m[..., 2].ravel()[triangles[:, corner]] for corner in range(3))
    far = np.maximum(np.maximum(one, other), third)
    near = np.minimum(np.minimum(one, other), third)
    step_max = far * (GRAZING_TANGENT / camera.fx_px) + 2.0 * spread_m(far)
    with np.errstate(invalid="ignore"):
        return np.asarray(triangles[np.isfinite(far) if broken else far - near < step_max])


def _window(mask: npt.NDArray[np.bool_], *, margin_px: int) -> tuple[slice, slice]:
    """Return the rows and columns that hold a mask, with a margin."""
    spans = []
    for axis in (1, 0):
        hit = np.flatnonzero(mask.any(axis=axis))
        low, high = (hit[0], hit[-1] + 1) if len(hit) else (0, 0)
        spans.append(slice(max(0, int(low) - margin_px), int(high) + margin_px))
    return spans[0], spans[1]


def _without_strays(depth_m: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """Return the image without small islands: pixels of the plate that noise lifted over it."""
    from scipy.ndimage import label

    pieces, count = label(np.isfinite(depth_m), np.ones((3, 3)))
    sizes = np.bincount(pieces.ravel(), minlength=count + 1)
    sizes[0] = 0
    return np.where(sizes[pieces] > ISLAND_SHARE * sizes.max(), depth_m, np.float32(np.nan))


def _plane_bins(points_m: Points, normals: Points) -> npt.NDArray[np.int64]:
    """Number the coarse plane (normal and offset) that each point with its normal suggests."""
    offset = np.einsum("ij,ij->i", points_m, normals)
    turn = np.rint(normals[:, :2] * 5.0).astype(np.int64) + 5
    step = np.rint(offset / 0.008).astype(np.int64)
    step -= step.min()
    return np.asarray((step * 11 + turn[:, 0]) * 11 + turn[:, 1])


def _grown(
    grid_m: Points, normals: Points, members: npt.NDArray[np.bool_], free: npt.NDArray[np.bool_]
) -> tuple[npt.NDArray[np.bool_], Plane]:
    """Grow a patch from its first members to all pixels that fit, and refit; three rounds."""
    from scipy.ndimage import label

    plane = fitted_plane(grid_m[members])
    for _ in range(3):
        distance = np.abs(grid_m @ plane[:3] + plane[3])
        with np.errstate(invalid="ignore"):
            near = free & (distance < 2.5 * spread_m(grid_m[..., 2]))
            against = normals @ plane[:3] < PATCH_ANGLE_COS
        pieces, count = label(near & ~against)
        if count == 0:
            return np.zeros_like(free), plane
        members = pieces == np.bincount(pieces[pieces > 0]).argmax()
        plane = fitted_plane(grid_m[members])
    return members, plane


def fitted_plane(points_m: Points) -> Plane:
    """Return the least-squares plane of points, its normal towards the origin.

    Args:
        points_m: (N, 3), metres, N at least 3.

    Returns:
        (4,) float64, unit normal and offset: normal . x + offset = 0.
    """
    centre = points_m.mean(axis=0, dtype=np.float64)
    spread = (points_m - centre).T @ (points_m - centre)
    normal = np.linalg.eigh(spread)[1][:, 0]
    normal *= -1.0 if normal @ centre > 0.0 else 1.0
    return np.array([*normal, -normal @ centre])


def _bend(grid_m: Points, members: npt.NDArray[np.bool_], plane: Plane) -> float:
    """Return how much of the distance to a plane is shape, not noise, in spreads of one pixel."""
    distance = np.where(members, grid_m @ plane[:3] + plane[3], np.nan).astype(np.float32)
    smooth = mean_known(distance, 9)[members]
    return float(np.sqrt(np.nanmean(smooth**2)) / np.mean(spread_m(grid_m[members][:, 2])))


def _slid(points_m: Points, planes: Plane) -> npt.NDArray[np.float32]:
    """Slide points along their rays from the camera onto one plane each."""
    along = np.einsum("ij,ij->i", points_m, planes[:, :3])
    return np.asarray(points_m * (-planes[:, 3] / along)[:, None], np.float32)
