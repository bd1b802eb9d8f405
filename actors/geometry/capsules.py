"""Capsules: all points within a radius of a segment; what arms, limbs and people are made of here.

An array of capsules is (n, 7): first end (3), second end (3), radius; metres, all in one frame.
A segment is (n, 6): the two ends.

Rules a change must keep: distances are signed, negative inside; of no capsules or no points they
are empty, and their least is infinity; outlines never lie inside the true outline of a capsule.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from actors.geometry.cameras.projection import in_camera, on_image

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy.typing as npt

    Numbers = npt.NDArray[np.floating]

AT_ONCE: Final = 8192
"""Points whose distances to the capsules of an arm fit a processor's cache."""
NEAR_M: Final = 0.05
"""Nearer to a camera's plane than this nothing of a capsule is drawn."""


def bounds(capsules: Numbers) -> npt.NDArray[np.float64]:
    """Return the axis-parallel box around each capsule, (n, 2, 3): lowest, highest corner."""
    one, other, radius = capsules[:, :3], capsules[:, 3:6], capsules[:, 6:]
    low, high = np.minimum(one, other) - radius, np.maximum(one, other) + radius
    return np.stack([low, high], 1).astype(np.float64)


def volume_m3(capsules: Numbers) -> npt.NDArray[np.float64]:
    """Return the volume of each capsule, (n,), cubic metres."""
    length = np.linalg.norm(capsules[:, 3:6] - capsules[:, :3], axis=1)
    radius = capsules[:, 6].astype(np.float64)
    return np.asarray(np.pi * radius**2 * (length + radius * 4.0 / 3.0))


def distances_to_points(capsules: Numbers, points_m: Numbers) -> npt.NDArray[np.float32]:
    """Return the signed distance of every point to every capsule.

    One matrix product for all of them, in float32: accurate to 0.1 mm within 10 m of the capsules.

    Args:
        capsules: (n, 7), metres.
        points_m: (P, 3), metres, the same frame.

    Returns:
        (n, P), metres.
    """
    if not len(capsules) or not len(points_m):
        return np.empty((len(capsules), len(points_m)), np.float32)
    origin = capsules[:, :6].reshape(-1, 3).mean(0)
    start = (capsules[:, :3] - origin).astype(np.float32)
    along = (capsules[:, 3:6] - capsules[:, :3]).astype(np.float32)
    points = np.ascontiguousarray((points_m - origin).T, np.float32)
    squared_length = (along * along).sum(1)[:, None]
    ahead = along @ points - (along * start).sum(1)[:, None]
    share = np.clip(ahead / np.maximum(squared_length, np.float32(1e-12)), 0.0, 1.0)
    squared = np.asarray(start @ points, np.float32)
    squared *= -2.0
    squared += (points * points).sum(0)
    squared += (start * start).sum(1)[:, None]
    squared += share * (share * squared_length - 2.0 * ahead)
    np.maximum(squared, 0.0, out=squared)
    np.sqrt(squared, out=squared)
    squared -= capsules[:, 6:].astype(np.float32)
    return np.asarray(squared)


def distance_to_points(capsules: Numbers, points_m: Numbers) -> npt.NDArray[np.float32]:
    """Return the signed distance of every point to the nearest capsule, (P,), metres.

    Args:
        capsules: (n, 7), metres.
        points_m: (P, 3), metres, the same frame.
    """
    if not len(capsules):
        return np.full(len(points_m), np.inf, np.float32)
    nearest = np.empty(len(points_m), np.float32)
    for first in range(0, len(points_m), AT_ONCE):
        part = slice(first, first + AT_ONCE)
        nearest[part] = distances_to_points(capsules, points_m[part]).min(0)
    return nearest


def segment_distances(one_m: Numbers, other_m: Numbers) -> npt.NDArray[np.float64]:
    """Return the distance of every segment to every other, exactly; points are segments, too.

    Two segments are nearest either at an end of one of them or at two inner points whose
    connection is perpendicular to both.

    Args:
        one_m: (n, 6), metres.
        other_m: (m, 6), metres, the same frame.

    Returns:
        (n, m), metres.
    """
    a, b = (np.asarray(one_m[:, k : k + 3], np.float64)[:, None] for k in (0, 3))
    c, d = (np.asarray(other_m[:, k : k + 3], np.float64)[None] for k in (0, 3))
    ends = [_point_segment(a, c, d), _point_segment(b, c, d)]
    ends += [_point_segment(c, a, b), _point_segment(d, a, b)]
    nearest = np.minimum.reduce(ends)
    u, v, w = b - a, d - c, a - c
    uu, uv, vv = (u * u).sum(-1), (u * v).sum(-1), (v * v).sum(-1)
    uw, vw = (u * w).sum(-1), (v * w).sum(-1)
    determinant = uu * vv - uv * uv
    crossing = determinant > 1e-12 * np.maximum(uu * vv, 1e-30)
    safe = np.where(crossing, determinant, 1.0)
    s, t = (uv * vw - vv * uw) / safe, (uu * vw - uv * uw) / safe
    inner = crossing & (s > 0.0) & (s < 1.0) & (t > 0.0) & (t < 1.0)
    between = np.linalg.norm(w + s[..., None] * u - t[..., None] * v, axis=-1)
    return np.asarray(np.where(inner, np.minimum(between, nearest), nearest))


def _point_segment(point: Numbers, start: Numbers, end: Numbers) -> Numbers:
    """Return the distance of points to segments, over their common shape."""
    along = end - start
    squared = np.maximum((along * along).sum(-1), 1e-30)
    share = np.clip(((point - start) * along).sum(-1) / squared, 0.0, 1.0)
    return np.asarray(np.linalg.norm(point - start - share[..., None] * along, axis=-1))


def capsule_distances(one: Numbers, other: Numbers) -> npt.NDArray[np.float64]:
    """Return the signed distance of every capsule to every other.

    Args:
        one: (n, 7), metres.
        other: (m, 7), metres, the same frame.

    Returns:
        (n, m), metres; where two capsules overlap, minus how far.
    """
    radii = one[:, 6].astype(np.float64)[:, None] + other[:, 6].astype(np.float64)[None]
    return np.asarray(segment_distances(one[:, :6], other[:, :6]) - radii)


def distance_between(one: Numbers, other: Numbers) -> float:
    """Return the least distance of two arrays of capsules, metres; infinity if one is empty."""
    return float(capsule_distances(one, other).min(initial=np.inf))


def outlines(
    capsules: Numbers,
    cameras: Sequence[tuple[Numbers, Numbers, Numbers]],
    *,
    sides: int = 16,
) -> npt.NDArray[np.float32]:
    """Return points whose convex hulls are the outlines of capsules in the images of cameras.

    The outline of a sphere is the circle in which its tangents from the camera touch it, that of
    a capsule the convex hull of those of its two end spheres.  Each circle is a polygon around
    it, so that the hull never lies inside the true outline.  A capsule is cut off where it comes
    nearer to the camera's plane than `NEAR_M`.

    Args:
        capsules: (n, 7), metres, cell.
        cameras: Per camera its matrix (3, 3) in pixels, distortion (5,), camera_from_cell (4, 4).
        sides: Corners per circle.

    Returns:
        (cameras, n, 2 x sides, 2) column and row, pixels; NaN for a capsule that the camera
        cannot show.
    """
    angle = np.linspace(0.0, 2.0 * np.pi, sides, endpoint=False)
    around = np.stack([np.cos(angle), np.sin(angle)], 1) / np.cos(np.pi / sides)
    result = np.full((len(cameras), len(capsules), 2 * sides, 2), np.nan, np.float32)
    radius = capsules[:, 6].astype(np.float64)
    for place, (matrix, distortion, camera_from_cell) in enumerate(cameras):
        ends = in_camera(capsules[:, :6].reshape(-1, 2, 3).astype(np.float64), camera_from_cell)
        ends, shown = _cut_off(ends, radius + NEAR_M)
        circles = _tangent_circles(ends, radius[:, None], around)
        pixels = on_image(circles.reshape(len(capsules), 2 * sides, 3), matrix, distortion)
        shown &= np.isfinite(pixels).all((1, 2))
        result[place, shown] = pixels[shown]
    return result


def _cut_off(ends: Numbers, depth: Numbers) -> tuple[Numbers, npt.NDArray[np.bool_]]:
    """Return segments (n, 2, 3) without what is nearer than `depth` (n,), and which are left."""
    z = ends[..., 2]
    shown = z.max(1) > depth
    span = z[:, ::-1] - z
    share = np.where(z < depth[:, None], (depth[:, None] - z) / np.where(span, span, 1.0), 0.0)
    cut = ends + share[..., None] * (ends[:, ::-1] - ends)
    return np.where(shown[:, None, None], cut, [0.0, 0.0, 10.0]), shown


def _tangent_circles(centres: Numbers, radius: Numbers, around: Numbers) -> Numbers:
    """Return polygons about the circles in which tangents from the origin touch spheres.

    Args:
        centres: (..., 3), metres.
        radius: (...) or alike, metres; less than the distance of the centre.
        around: (sides, 2), the polygon about the unit circle.

    Returns:
        (..., sides, 3), metres.
    """
    far = np.linalg.norm(centres, axis=-1, keepdims=True)
    radius = np.broadcast_to(radius[..., None], far.shape)
    inside = np.minimum((radius / far) ** 2, 0.999)
    normal = centres / far
    helper = np.where(np.abs(normal[..., 1:2]) < 0.9, [0.0, 1.0, 0.0], [1.0, 0.0, 0.0])
    first = np.cross(normal, helper)
    first /= np.linalg.norm(first, axis=-1, keepdims=True)
    second = np.cross(normal, first)
    reach = (radius * np.sqrt(1.0 - inside))[..., None, :]
    turned = around[:, :1] * first[..., None, :] + around[:, 1:] * second[..., None, :]
    return np.asarray((centres * (1.0 - inside))[..., None, :] + reach * turned)


def fill(outlines_px: Numbers, height: int, width: int) -> npt.NDArray[np.uint8]:
    """Return the masks of capsules that have these outlines.

    Args:
        outlines_px: (cameras, n, points, 2) of `outlines`.
        height: Rows of the masks.
        width: Columns of the masks.

    Returns:
        (cameras, height, width), 255 where any capsule is.
    """
    import cv2

    masks = np.zeros((len(outlines_px), height, width), np.uint8)
    for mask, of_camera in zip(masks, outlines_px, strict=True):
        for points in of_camera:
            if np.isfinite(points[0, 0]):
                hull = cv2.convexHull(np.clip(points, -1e5, 1e5))
                cv2.fillConvexPoly(mask, np.rint(hull * 16.0).astype(np.int32), 255, shift=4)
    return masks


def image_boxes(outlines_px: Numbers, height: int, width: int) -> npt.NDArray[np.int32]:
    """Return which pixels outlines span.

    Args:
        outlines_px: (..., points, 2) of `outlines`.
        height: Rows of the image.
        width: Columns of the image.

    Returns:
        (..., 4): first column, first row, last column + 1, last row + 1; zeros where nothing of
        the outline lies in the image.
    """
    finite = np.isfinite(outlines_px[..., 0, 0])[..., None]
    low, high = np.floor(outlines_px.min(-2)), np.ceil(outlines_px.max(-2)) + 1.0
    size = np.array([width, height], np.float32)
    low, high = np.clip(low, 0.0, size), np.clip(high, 0.0, size)
    seen = finite & (low < high).all(-1, keepdims=True)
    return np.where(seen, np.concatenate([low, high], -1), 0.0).astype(np.int32)
