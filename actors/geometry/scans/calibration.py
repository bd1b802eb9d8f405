"""The two text files of an RGB-D recording: camera intrinsics (JSON) and camera poses (.log).

Both are checked before use: an intrinsics matrix must belong to the images, a pose
must be rigid, and camera positions must be in metres.
Open3D's own readers silently accept a mirrored or scaled matrix; these do not.
"""

from __future__ import annotations

import json
from itertools import pairwise
from typing import TYPE_CHECKING, Final

import numpy as np

from actors.geometry.files import InputFileError, existing_file
from actors.geometry.shapes import Camera

if TYPE_CHECKING:
    from pathlib import Path

    import numpy.typing as npt

RIGID_TOLERANCE: Final = 1e-3
"""Largest deviation of R'R from the identity; logs with six digits stay below 1e-5."""

TRAVEL_M_MAX: Final = 1000.0
"""A camera that travels further than this in one recording was logged in millimetres."""


def read_intrinsics(path: Path) -> Camera:
    """Read a pinhole camera as Open3D and Redwood store it.

    Args:
        path: JSON with `width`, `height` and `intrinsic_matrix`: nine numbers, column by column
            as Open3D writes them or row by row, or three rows of three.

    Raises:
        InputFileError: Not such a file, or a matrix no pinhole camera has.
    """
    asked = "camera intrinsics as JSON with width, height and intrinsic_matrix"
    existing_file(path, asked=asked)
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        width, height = int(content["width"]), int(content["height"])
        k = np.array(content["intrinsic_matrix"], dtype=np.float64).reshape(3, 3)
    except (ValueError, TypeError, KeyError) as error:
        raise InputFileError(
            path,
            asked=asked,
            found=f"something else ({type(error).__name__}: {error})",
            remedy="write it as open3d.io.write_pinhole_camera_intrinsic does",
        ) from error
    if k[0, 2] == 0.0 and k[1, 2] == 0.0:
        k = k.T
    fx, fy, cx, cy = (float(value) for value in (k[0, 0], k[1, 1], k[0, 2], k[1, 2]))
    sound = np.array_equal(k[2], (0.0, 0.0, 1.0)) and k[1, 0] == 0.0 and abs(k[0, 1]) < 1e-6
    inside = 0.0 < cx < width and 0.0 < cy < height
    if not (sound and inside and fx > 0.0 and fy > 0.0):
        raise InputFileError(
            path,
            asked="a pinhole camera with positive focal lengths and its centre in the image",
            found=f"matrix {k.tolist()} for {width} x {height} pixels",
            remedy="check fx, fy, cx, cy (in pixels, no skew)",
        )
    return Camera(width, height, fx, fy, cx, cy)


def read_trajectory(path: Path) -> npt.NDArray[np.float64]:
    """Read camera poses in Redwood's format: per frame a line of three integers, then 4 x 4.

    Args:
        path: The `.log` file; matrices are world_from_camera, metres.

    Returns:
        world_from_camera, (N, 4, 4).

    Raises:
        InputFileError: Not this format, frames out of order, a matrix that is not rigid, or
            positions that cannot be metres.
    """
    asked = "camera poses: per frame a line of three integers and four rows of four numbers"
    existing_file(path, asked=asked)
    lines = path.read_text(encoding="utf-8", errors="replace").split("\n")
    rows = [(number, line.split()) for number, line in enumerate(lines, 1) if line.strip()]
    if len(rows) % 5 or not rows:
        raise InputFileError(
            path,
            asked=asked,
            found=f"{len(rows)} lines, not a multiple of five",
            remedy="the file is cut off or of another format (TUM: one line per frame)",
        )
    poses = [_pose(path, rows[start : start + 5], asked) for start in range(0, len(rows), 5)]
    frames = [int(rows[start][1][0]) for start in range(0, len(rows), 5)]
    for before, after in pairwise(frames):
        if after <= before:
            raise InputFileError(
                path,
                asked="poses in the order of the frames",
                found=f"frame {after} after frame {before}",
                remedy="sort the poses, one per image",
            )
    travel_m = float(np.linalg.norm(np.ptp(np.array(poses)[:, :3, 3], axis=0)))
    if travel_m > TRAVEL_M_MAX:
        raise InputFileError(
            path,
            asked="camera positions in metres",
            found=f"positions {travel_m:.0f} apart",
            remedy="they look like millimetres: divide the last column by 1000",
        )
    return np.array(poses)


def _pose(path: Path, rows: list[tuple[int, list[str]]], asked: str) -> npt.NDArray[np.float64]:
    """Return one world_from_camera (4, 4) of five (line number, words), or refuse it."""
    number, words = rows[0][0], [line for _, line in rows]
    try:
        [int(word) for word in words[0]]
        matrix = np.array([[float(word) for word in line] for line in words[1:]])
        found = "" if len(words[0]) == 3 and matrix.shape == (4, 4) else f"{matrix.shape} numbers"
    except ValueError as error:
        found, matrix = str(error), np.eye(4)
    if found:
        raise InputFileError(
            path,
            asked=asked,
            found=f"something else from line {number} on ({found})",
            remedy="export the trajectory in Redwood's .log format",
        )
    turn = matrix[:3, :3]
    rigid = (
        np.isfinite(matrix).all()
        and np.abs(turn.T @ turn - np.eye(3)).max() < RIGID_TOLERANCE
        and np.linalg.det(turn) > 0.0
        and np.allclose(matrix[3], (0.0, 0.0, 0.0, 1.0))
    )
    if not rigid:
        raise InputFileError(
            path,
            asked="rigid poses (rotation and translation)",
            found=f"at line {number} a matrix with determinant {np.linalg.det(turn):.4g} and last"
            f" row {matrix[3].tolist()}",
            remedy="remove scale, shear and mirroring from the export",
        )
    return matrix
