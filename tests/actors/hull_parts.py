"""A small cell for the tests of hulls: a ring of cameras, exact silhouettes of capsules."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from actors.geometry.capsules import fill, outlines
from actors.geometry.hull.silhouettes import packed
from actors.geometry.hull.visibility import camera_table
from actors.geometry.hull.visual_hull import VisualHull
from actors.geometry.hull.voxels import VoxelBlocks
from actors.geometry.poses import inverse, looking_at

WIDTH, HEIGHT, FOCAL = 320, 240, 300.0
VOXEL_M = 0.05
BODY = np.array([[0.1, 0.05, 0.25, 0.1, 0.1, 0.9, 0.13], [0.1, 0.1, 0.8, -0.3, 0.2, 0.6, 0.07]])
"""A trunk that stands in the middle, and an arm."""


@dataclass(frozen=True)
class Camera:
    """A calibration, as the functions ask for it."""

    camera_matrix: np.ndarray
    distortion: np.ndarray
    camera_from_cell: np.ndarray
    width: int = WIDTH
    height: int = HEIGHT


def ring(number=8, distortion=(0.0,) * 5, up_m=1.6):
    """Return cameras around the cell that look at its middle."""
    matrix = np.array([[FOCAL, 0, (WIDTH - 1) / 2], [0, FOCAL, (HEIGHT - 1) / 2], [0, 0, 1]])
    turns = 2 * np.pi * (np.arange(number) + 0.3) / number
    return [
        Camera(
            matrix,
            np.array(distortion),
            inverse(
                looking_at(
                    np.array([2.4 * np.cos(turn), 2.4 * np.sin(turn), up_m + 0.1 * (place % 3)]),
                    np.array([0.0, 0.0, 0.6]),
                )
            ),
        )
        for place, turn in enumerate(turns)
    ]


def small_grid(voxel_m=VOXEL_M):
    """Return a cube of 1.6 m edge on the floor."""
    number = round(1.6 / voxel_m)
    return VoxelBlocks(np.array([-0.8, -0.8, 0.0]), voxel_m, (number, number, number))


def hull_of(grid, cameras, boxes=()):
    """Return the visual hull of cameras over a grid."""
    return VisualHull(grid, [camera_table(grid, camera, boxes) for camera in cameras])


def masks_of(capsules, cameras):
    """Return the silhouettes of capsules, (H, W) of each camera."""
    seen = [(c.camera_matrix, c.distortion, c.camera_from_cell) for c in cameras]
    lines = outlines(np.asarray(capsules, float).reshape(-1, 7), seen, sides=64)
    return list(fill(lines, HEIGHT, WIDTH))


def bits_of(capsules, cameras):
    """Return the packed silhouettes of capsules."""
    return [packed(mask) for mask in masks_of(capsules, cameras)]


def box_row(centre, half, yaw_rad=0.0):
    """Return a static box, (15,)."""
    cosine, sine = np.cos(yaw_rad), np.sin(yaw_rad)
    return np.array([*centre, *half, cosine, -sine, 0, sine, cosine, 0, 0, 0, 1.0])
