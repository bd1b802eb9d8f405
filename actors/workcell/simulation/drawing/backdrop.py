"""What a simulated camera sees of the empty room: a picture, its depth, and how light falls on it.

Made once per camera by casting a ray per pixel at boxes, floor and walls, in numpy: no graphics
library, no display, 0.4 s for 640 x 480.  Surfaces bear a texture, so that a shifted or wrongly
projected image cannot pass for the right one.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from actors.workcell.simulation.room import HALF_M, HEIGHT_M, LAMP_M, Box

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy.typing as npt

    from actors.workcell.vocabulary import Calibration

    F32 = npt.NDArray[np.float32]
    F64 = npt.NDArray[np.float64]
    Floats = npt.NDArray[np.floating]
    Hit = tuple[F32, npt.NDArray[np.int64], F32]

AMBIENT: Final = 0.58
"""Share of the light that comes from everywhere; the lamp gives the rest."""
LAMP_PX: Final = 512
"""Columns and rows of the lamp's image."""
LAMP_TANGENT: Final = 1.9
"""It reaches 62 degrees to each side; what lies further out is never in a moving shadow."""
FLOOR_COLOUR: Final = (0.50, 0.53, 0.54)
WALL_COLOUR: Final = (0.68, 0.66, 0.64)
_ROOM: Final = Box("room", (0.0, 0.0, HEIGHT_M / 2), (HALF_M, HALF_M, HEIGHT_M / 2), WALL_COLOUR)


@dataclass(frozen=True, slots=True, eq=False)
class Backdrop:
    """The still part of a camera's images.

    Attributes:
        image: (H, W, 3) uint8, BGR, without noise.
        depth_m: (H, W) float32, along the optical axis.
        light: (H, W, 4) float32: column and row in the lamp's image, depth below the lamp (0 where
            its light never falls), factor of the brightness in full shadow.
    """

    image: npt.NDArray[np.uint8]
    depth_m: F32
    light: F32


def rays_of(calibration: Calibration) -> tuple[F64, F32]:
    """Return where a camera stands, (3,), and a ray per pixel, (H, W, 4): direction, depth per m.

    Directions are unit vectors in the cell; the lens' distortion is in them.
    """
    height, width = calibration.height, calibration.width
    k = calibration.camera_matrix
    row, column = np.mgrid[:height, :width].astype(np.float64)
    seen_y = (row - k[1, 2]) / k[1, 1]
    seen_x = (column - k[0, 2] - k[0, 1] * seen_y) / k[0, 0]
    flat = np.stack(_undistorted(seen_x, seen_y, calibration.distortion), -1)
    ahead = np.concatenate([flat, np.ones((height, width, 1))], -1)
    length = np.linalg.norm(ahead, axis=-1, keepdims=True)
    turn = calibration.camera_from_cell[:3, :3]
    rays = np.concatenate([ahead / length @ turn, 1.0 / length], -1)
    return -turn.T @ calibration.camera_from_cell[:3, 3], rays.astype(np.float32)


def _undistorted(seen_x: F64, seen_y: F64, distortion: F64) -> tuple[F64, F64]:
    """Return which points of the image plane at z = 1 the lens moves to those that are seen."""
    x, y = seen_x, seen_y
    k1, k2, p1, p2, k3 = distortion
    for _ in range(30 if np.any(distortion) else 0):
        squared = x * x + y * y
        factor = 1.0 + squared * (k1 + squared * (k2 + squared * k3))
        x, y = (
            (seen_x - 2.0 * p1 * x * y - p2 * (squared + 2.0 * x * x)) / factor,
            (seen_y - p1 * (squared + 2.0 * y * y) - 2.0 * p2 * x * y) / factor,
        )
    return x, y


def lamp() -> tuple[F64, F64]:
    """Return the lamp as a camera that looks straight down: its matrix (3, 3), lamp_from_cell."""
    middle, focal = (LAMP_PX - 1) / 2.0, LAMP_PX / 2.0 / LAMP_TANGENT
    matrix = np.array([[focal, 0.0, middle], [0.0, focal, middle], [0.0, 0.0, 1.0]])
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    pose[:3, 3] = -pose[:3, :3] @ np.array(LAMP_M)
    return matrix, pose


def backdrop_of(calibration: Calibration, boxes: Sequence[Box]) -> Backdrop:
    """Return what a camera sees of the room with boxes in it."""
    height, width = calibration.height, calibration.width
    origin, rays = rays_of(calibration)
    directions = rays[..., :3].reshape(-1, 3)
    starts = np.broadcast_to(origin.astype(np.float32), directions.shape)
    far, which, normals = _first_hit(starts, directions, boxes)
    points = starts + far[:, None] * directions
    to_lamp = np.array(LAMP_M, np.float32) - points
    away = np.linalg.norm(to_lamp, axis=1)
    to_lamp /= away[:, None]
    facing = (normals * to_lamp).sum(1).clip(0.0)
    shadowed = _first_hit(points + 1e-3 * normals, to_lamp, boxes)[0] < away - 2e-3
    direct = np.where(shadowed, 0.0, (1.0 - AMBIENT) * facing)
    colours = np.array([*(box.colour for box in boxes), WALL_COLOUR, FLOOR_COLOUR], np.float32)
    which = np.where((which == len(boxes)) & (normals[:, 2] > 0.5), which + 1, which)
    # The room keeps its texture, whatever is put into it: only what moves may change an image.
    bears = np.where(which >= len(boxes), which - len(boxes) - 2, which)
    albedo = colours[which] * _texture(points, normals, bears)[:, None]
    image = np.clip(255.0 * albedo * (AMBIENT + direct)[:, None] * 1.25, 0.0, 255.0)
    matrix, lamp_from_cell = lamp()
    under = points @ lamp_from_cell[:3, :3].T + lamp_from_cell[:3, 3]
    lit = (direct > 0.0) & (under[:, 2] > 0.1)
    per_m = matrix[0, 0] / np.where(lit, under[:, 2], 1.0)
    light = np.stack(
        [
            under[:, 0] * per_m + matrix[0, 2],
            under[:, 1] * per_m + matrix[1, 2],
            np.where(lit, under[:, 2], 0.0),
            AMBIENT / (AMBIENT + direct),
        ],
        axis=1,
    )
    return Backdrop(
        image=image.astype(np.uint8).reshape(height, width, 3),
        depth_m=np.ascontiguousarray(far.reshape(height, width) * rays[..., 3]),
        light=light.astype(np.float32).reshape(height, width, 4),
    )


def _first_hit(starts: F32, directions: F32, boxes: Sequence[Box]) -> Hit:
    """Return what rays hit first: how far (N,), which box (the room is the last), normals (N, 3).

    All rays start in the room and outside of the boxes.
    """
    with np.errstate(divide="ignore"):
        inverse = (1.0 / directions).astype(np.float32)
    low, high = _slabs(starts, inverse, _ROOM)
    far = high.min(1)
    axis = high.argmin(1)
    which = np.full(len(far), len(boxes))
    inwards = np.full(len(far), True)
    for number, box in enumerate(boxes):
        low, high = _slabs(starts, inverse, box)
        near = low.max(1)
        hit = (near > 0.0) & (near < high.min(1)) & (near < far)
        far = np.where(hit, near, far)
        axis = np.where(hit, low.argmax(1), axis)
        which[hit] = number
        inwards[hit] = False
    normals = np.zeros_like(directions)
    rows = np.arange(len(far))
    normals[rows, axis] = -np.sign(directions[rows, axis])
    return far, which, normals


def _slabs(starts: F32, inverse: F32, box: Box) -> tuple[F32, F32]:
    """Return where rays enter and leave the three slabs of a box, (N, 3) each."""
    centre, half = np.array(box.centre_m, np.float32), np.array(box.half_m, np.float32)
    one, other = (centre - half - starts) * inverse, (centre + half - starts) * inverse
    return np.minimum(one, other), np.maximum(one, other)


def _texture(points: F32, normals: F32, which: npt.NDArray[np.int64]) -> F32:
    """Return the brightness of surfaces at points, about 1: tiles and grain of two sizes."""
    side = np.abs(normals).argmax(1)
    across = np.where(side == 0, points[:, 1], points[:, 0])
    along = np.where(side == 2, points[:, 1], points[:, 2])
    tiles = (np.floor(across / 0.6) + np.floor(along / 0.6)) % 2.0
    seed = which * 7 + side
    grain = _grain(across / 0.22, along / 0.22, seed) + 0.6 * _grain(
        across / 0.05, along / 0.05, seed
    )
    return np.asarray(0.94 + 0.07 * tiles + 0.09 * (grain - 0.8), np.float32)


def _grain(x: Floats, y: Floats, seed: npt.NDArray[np.int64]) -> F32:
    """Return smooth noise over a lattice of unit cells, 0 to 1."""
    column, row = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    right, down = x - column, y - row
    right, down = right * right * (3 - 2 * right), down * down * (3 - 2 * down)
    upper = _hash(column, row, seed) * (1 - right) + _hash(column + 1, row, seed) * right
    lower = _hash(column, row + 1, seed) * (1 - right) + _hash(column + 1, row + 1, seed) * right
    return np.asarray(upper * (1 - down) + lower * down, np.float32)


def _hash(
    column: npt.NDArray[np.int64], row: npt.NDArray[np.int64], seed: npt.NDArray[np.int64]
) -> npt.NDArray[np.float64]:
    """Return a number from 0 to 1 for each cell of a lattice."""
    mixed = (column * 73856093) ^ (row * 19349663) ^ (seed * 83492791)
    mixed = ((mixed ^ (mixed >> 13)) * 1274126177) & 0x7FFFFFFF
    return np.asarray(((mixed >> 8) & 0xFFFF) / 65535.0)
