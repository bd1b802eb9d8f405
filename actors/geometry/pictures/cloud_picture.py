"""Pictures of point clouds: splats into a depth buffer, edges darkened by depth differences.

Points have no normals to light, so shape comes from the depth buffer itself: a pixel is darkened
by how far it lies behind its neighbours.

Source: Boucheny 2009 (eye-dome lighting).
"""

from __future__ import annotations

from itertools import combinations, product
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from actors.geometry.pictures.mesh_picture import background, coarser, finer
from actors.geometry.poses import inverse, moved

if TYPE_CHECKING:
    import numpy.typing as npt

    from actors.geometry.shapes import Acquisition

    Floats = npt.NDArray[np.floating[Any]]
    Picture = npt.NDArray[np.uint8]

SPLAT_PX_MAX: Final = 9
"""Largest edge of a splat, in samples: a point near the camera is not to hide the rest."""

EDGE_REACH: Final = 3
EDGE_IGNORED: Final = 0.004
"""Relative step in depth that is no edge: splats on a slanted face make such steps."""

EDGE_STRENGTH: Final = 60.0
"""Darkening per relative step in depth; found by eye on a desk scene at 1 m."""


def draw_points(
    points_m: Floats, colours: npt.NDArray[np.uint8], view: Acquisition, *, size_m: float | Floats
) -> Picture:
    """Draw a coloured point cloud on a light background.

    Args:
        points_m: (N, 3), metres, world.
        colours: RGB, uint8, (N, 3).
        view: Camera and pose; `mesh_picture.viewpoint` makes one.
        size_m: Edge of the square that represents a point, one for all or (N,); about the spacing
            of the points.

    Returns:
        RGB, uint8, (H, W, 3).
    """
    camera = finer(view.camera)
    local = moved(points_m, inverse(view.world_from_camera))
    ahead = local[:, 2] > 1e-6
    local, colours = local[ahead], colours[ahead]
    size_m = np.broadcast_to(size_m, ahead.shape)[ahead]
    depth = local[:, 2].astype(np.float32)
    column, row = np.rint(camera.column_row(local[:, 0], local[:, 1], depth)).astype(np.int64)
    edge = np.clip(np.rint(size_m * camera.fx_px / depth), 1, SPLAT_PX_MAX).astype(np.int64)
    nearest = np.full(camera.shape, np.inf, np.float32)
    owner = np.full(camera.shape, -1, np.int64)
    for down in range(-(SPLAT_PX_MAX // 2), SPLAT_PX_MAX // 2 + 1):
        for right in range(-(SPLAT_PX_MAX // 2), SPLAT_PX_MAX // 2 + 1):
            reached = edge > 2 * max(abs(down), abs(right))
            _splat((nearest, owner), depth, (row + down, column + right), reached)
    picture = background(camera.shape)
    drawn = owner >= 0
    shade = _edges(nearest)
    picture[drawn] = colours[owner[drawn]] * shade[drawn][:, None]
    return coarser(picture)


def with_box(
    picture: Picture,
    view: Acquisition,
    box_m: tuple[Floats, Floats],
    *,
    world_from_box: npt.NDArray[np.float64],
    colour: tuple[int, int, int],
) -> Picture:
    """Draw the twelve edges of a box into a picture.

    Args:
        picture: (H, W, 3), of the size of the view's camera.
        view: Camera and pose of the picture.
        box_m: Lowest and highest corner, each (3,), frame of the box.
        world_from_box: (4, 4).
        colour: RGB of the lines.
    """
    import cv2

    corners = np.array(list(product(*zip(*box_m, strict=True))))
    local = moved(corners, inverse(view.world_from_camera) @ world_from_box)
    camera, result = view.camera, picture.copy()
    if local[:, 2].min() <= 1e-6:
        return result
    focal, centre = (camera.fx_px, camera.fy_px), np.array([camera.cx_px, camera.cy_px])
    pixel = np.rint((local[:, :2] / local[:, 2:] * focal + centre) * 16.0).astype(int)
    for one, other in combinations(range(8), 2):
        if (one ^ other).bit_count() == 1:  # corners that differ in one coordinate only
            start, end = (tuple(pixel[corner].tolist()) for corner in (one, other))
            cv2.line(result, start, end, colour, 2, cv2.LINE_AA, 4)
    return result


def _splat(
    buffers: tuple[npt.NDArray[np.float32], npt.NDArray[np.int64]],
    depth: npt.NDArray[np.float32],
    place: tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]],
    reached: npt.NDArray[np.bool_],
) -> None:
    """Put one sample of every point that reaches so far into the buffers, nearest first."""
    nearest, owner = buffers
    row, column = place
    inside = reached & (row >= 0) & (row < nearest.shape[0])
    inside &= (column >= 0) & (column < nearest.shape[1])
    index = np.flatnonzero(inside)
    if not len(index):
        return
    # Far points first: of several on one sample numpy keeps the last written.
    index = index[np.argsort(-depth[index], kind="stable")]
    sample = row[index] * nearest.shape[1] + column[index]
    front = depth[index] < nearest.ravel()[sample]
    index, sample = index[front], sample[front]
    owner.ravel()[sample] = index
    nearest.ravel()[sample] = depth[index]


def _edges(nearest: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """Return the factor of brightness of every sample, less behind an edge."""
    log_depth = np.log(np.where(np.isfinite(nearest), nearest, np.float32(1e3)))
    behind = np.zeros_like(log_depth)
    padded = np.pad(log_depth, EDGE_REACH, mode="edge")
    steps = [(0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1)]
    for down, right in steps:
        top, left = (EDGE_REACH + step * EDGE_REACH for step in (down, right))
        neighbour = padded[top : top + behind.shape[0], left : left + behind.shape[1]]
        behind += np.clip(log_depth - neighbour - EDGE_IGNORED, 0.0, 0.05)
    return np.asarray(np.exp(-EDGE_STRENGTH / 8.0 * behind), np.float32)
