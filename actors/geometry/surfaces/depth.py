"""Depth images and points: conversion, normals, filters, and how far a sensor is off.

Rules a change must keep: depth in metres is float32 with NaN where unknown, depth in millimetres
is uint16, or float32 where several images were fused, with 0 where unknown; what is unknown never
becomes a number by filtering alone.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from actors.geometry.shapes import DEPTH_UNKNOWN_MM, Camera, DepthFrame

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy.typing as npt

    Image = npt.NDArray[np.float32]
    Mask = npt.NDArray[np.bool_]

SPREAD_NEAR_M: Final = 0.0012
"""Standard deviation of the sensor at 0.4 m, metres."""

SPREAD_GROWTH: Final = 0.0019
"""Its growth with the square of the distance beyond 0.4 m, 1/m."""

FUSED_REACH_M: Final = 0.008
"""Of several images, depths farther from a pixel's median belong to something else: the ground
beside an edge, not the noise (four spreads at the tray)."""


def spread_m(depth_m: npt.NDArray[np.floating] | float) -> npt.NDArray[np.float64]:
    """Return the standard deviation of one depth pixel, metres.

    Args:
        depth_m: Distances along the optical axis, metres.

    Source: Nguyen, Izadi and Lovell 2012, axial noise of a structured-light sensor.
    """
    beyond = np.asarray(depth_m, np.float64) - 0.4
    return np.asarray(SPREAD_NEAR_M + SPREAD_GROWTH * beyond**2)


def fused(frames: Sequence[DepthFrame]) -> DepthFrame:
    """Return one image of several: per pixel the mean of those near the median.

    The noise of n images falls by the root of n, and so do the sensor's whole millimetres, which
    noise dithers; an edge becomes sharp, because most images agree on its side.

    Args:
        frames: At least one, of one scene that stands still, from one place.

    Returns:
        float32 millimetres; unknown where two of three images do not know. The one image itself
        where there is only one.

    Raises:
        ValueError: No image, or images of several places.
    """
    if not frames:
        raise ValueError("asked for images of one scene, found none")
    first = frames[0]
    if len(frames) == 1:
        return first
    poses = [frame.acquisition.world_from_camera for frame in frames]
    if not all(np.array_equal(pose, poses[0]) for pose in poses):
        raise ValueError(f"asked for images from one place, found {len(frames)} from several")
    every = np.sort(np.stack([metres(frame.depth_mm) for frame in frames]), axis=0)
    known = np.isfinite(every).sum(axis=0)
    median = np.take_along_axis(every, np.maximum(known - 1, 0)[None] // 2, axis=0)
    with np.errstate(invalid="ignore"):
        near = np.abs(every - median) < FUSED_REACH_M
    total = np.where(near, every, np.float32(0.0)).sum(axis=0)
    mean_mm = 1000.0 * total / np.maximum(near.sum(axis=0), 1)
    enough = 3 * known >= len(frames)
    return DepthFrame(np.where(enough, mean_mm, 0.0).astype(np.float32), first.acquisition)


def metres(depth_mm: npt.NDArray[np.uint16 | np.float32]) -> Image:
    """Return (H, W) float32 metres of a depth image in millimetres; NaN where unknown."""
    depth_m = depth_mm.astype(np.float32) / np.float32(1000.0)
    depth_m[depth_mm == DEPTH_UNKNOWN_MM] = np.nan
    return depth_m


def millimetres(depth_m: npt.NDArray[np.floating]) -> npt.NDArray[np.uint16]:
    """Return (H, W) uint16 millimetres, rounded; what is unknown or beyond 65 m becomes 0."""
    valid = np.isfinite(depth_m) & (depth_m > 0.0) & (depth_m < 65.0)
    return np.where(valid, np.rint(np.where(valid, depth_m, 0.0) * 1000.0), 0).astype(np.uint16)


def points_grid(
    depth_m: npt.NDArray[np.floating], camera: Camera, *, corner_px: tuple[int, int] = (0, 0)
) -> npt.NDArray[np.float32]:
    """Return the point behind every pixel.

    Args:
        depth_m: (H, W), metres; the whole image or a part of it.
        camera: The camera of the whole image.
        corner_px: Row and column of the part's first pixel.

    Returns:
        (H, W, 3) float32, metres, camera frame; NaN where the depth is.
    """
    height, width = depth_m.shape
    first_row, first_column = corner_px
    columns = (np.arange(width, dtype=np.float32) + first_column - camera.cx_px) / camera.fx_px
    rows = (np.arange(height, dtype=np.float32) + first_row - camera.cy_px) / camera.fy_px
    grid = np.empty((height, width, 3), np.float32)
    grid[..., 0] = depth_m * columns[None, :]
    grid[..., 1] = depth_m * rows[:, None]
    grid[..., 2] = depth_m
    return grid


def frame_points(frame: DepthFrame) -> npt.NDArray[np.float32]:
    """Return the point behind every pixel of a frame in the world, (H, W, 3) float32, metres."""
    pose = frame.acquisition.world_from_camera.astype(np.float32)
    grid = points_grid(metres(frame.depth_mm), frame.acquisition.camera)
    return np.asarray(grid @ pose[:3, :3].T + pose[:3, 3], np.float32)


def depth_of_points(points_m: npt.NDArray[np.floating], camera: Camera) -> Image:
    """Put points back into the image they came from; the inverse of `points_grid`.

    Args:
        points_m: (N, 3), metres, camera frame; points outside the image are left out.
        camera: The camera that saw them.

    Returns:
        (H, W) float32, metres; NaN where no point falls, the nearest where several do.
    """
    ahead = points_m[points_m[:, 2] > 0.0]
    column, row = np.rint(camera.column_row(*ahead.T)).astype(np.int64)
    inside = (column >= 0) & (column < camera.width_px) & (row >= 0) & (row < camera.height_px)
    depth_m = np.full(camera.shape, np.inf, np.float32)
    np.minimum.at(depth_m, (row[inside], column[inside]), ahead[inside, 2].astype(np.float32))
    depth_m[np.isinf(depth_m)] = np.nan
    return depth_m


def mean_known(image: Image, width_px: int) -> Image:
    """Return the mean over a square of the known pixels; unknown where fewer than a third are.

    Args:
        image: (H, W) float32, NaN where unknown.
        width_px: Edge of the square, odd.
    """
    from scipy.ndimage import uniform_filter

    known = np.isfinite(image)
    share = uniform_filter(known.astype(np.float32), width_px)
    total = uniform_filter(np.where(known, image, np.float32(0.0)), width_px)
    with np.errstate(divide="ignore", invalid="ignore"):
        mean = total / share
    return np.where(share > 1.0 / 3.0, mean, np.float32(np.nan)).astype(np.float32)


def median_known(image: Image, width_px: int) -> Image:
    """Return the median over a square; unknown pixels take part as their neighbours' mean.

    A plain median would count each dropout as one of its two extremes.

    Args:
        image: (H, W) float32, NaN where unknown.
        width_px: Edge of the square, odd, 3 or 5 (OpenCV's limits for floats).
    """
    import cv2

    filled = np.where(np.isfinite(image), image, mean_known(image, width_px))
    known = np.isfinite(filled)
    smooth = cv2.medianBlur(np.where(known, filled, np.float32(0.0)), width_px)
    return np.where(known, smooth, np.float32(np.nan)).astype(np.float32)


def grid_normals(grid_m: npt.NDArray[np.float32], *, reach_px: int = 2) -> npt.NDArray[np.float32]:
    """Return the normals of an image of points, towards the camera.

    Args:
        grid_m: (H, W, 3) float32, metres, camera frame, NaN where unknown.
        reach_px: Distance of the neighbours whose difference gives the tangents.

    Returns:
        (H, W, 3) float32, unit length; NaN at the border and where a neighbour is unknown.
    """
    normals = np.full_like(grid_m, np.nan)
    inner = slice(reach_px, -reach_px)
    along_columns = grid_m[inner, 2 * reach_px :] - grid_m[inner, : -2 * reach_px]
    along_rows = grid_m[2 * reach_px :, inner] - grid_m[: -2 * reach_px, inner]
    cross = np.cross(along_rows, along_columns)
    with np.errstate(invalid="ignore", divide="ignore"):
        normals[inner, inner] = cross / np.linalg.norm(cross, axis=2, keepdims=True)
    return normals
