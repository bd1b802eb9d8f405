"""The two loops over pixels that numpy is too slow for, compiled by numba on first use.

Compiled code is kept in `__pycache__` beside this file, or where numba keeps it for a package
that may not be written.  Both loops let other threads run.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numba
import numpy as np

if TYPE_CHECKING:
    import numpy.typing as npt

    F32 = npt.NDArray[np.float32]
    F64 = npt.NDArray[np.float64]


@numba.njit(cache=True, fastmath=True, nogil=True)
def _first_cut(
    be: float, oe: float, bb: float, bo: float, c: float, far: float, far_other: float
) -> tuple[float, float]:
    """Return where a ray enters a capsule: how far along the ray (-1: nowhere), place on the axis.

    Args:
        be: Product of axis and direction; the axis leads from the first end to the other.
        oe: Product of the ray's start, seen from the first end, and its direction.
        bb: Squared length of the axis.
        bo: Product of the axis and the start.
        c: ``bb * far - bo * bo``.
        far: Squared distance of the start from the first end, less the squared radius.
        far_other: Likewise of the other end.

    Returns:
        Metres; and product of the axis and the point that was hit, 0 to bb.
    """
    a = bb - be * be
    b = bb * oe - bo * be
    h = b * b - a * c
    if h < 0.0:
        return -1.0, 0.0
    # A ray along the axis that meets the capsule at all entered its endless cylinder long before.
    t = (-b - math.sqrt(h)) / a if a > 1e-9 else -1e9
    y = bo + t * be
    if 0.0 < y < bb:
        return t, y
    on = oe if y <= 0.0 else oe - be
    h = on * on - (far if y <= 0.0 else far_other)
    if h < 0.0:
        return -1.0, 0.0
    return -on - math.sqrt(h), (0.0 if y <= 0.0 else bb)


@numba.njit(cache=True, fastmath=True, nogil=True)
def draw(
    image: npt.NDArray[np.uint8],
    depth_m: F32,
    names: npt.NDArray[np.int16],
    origin_m: F64,
    rays: F32,
    windows: npt.NDArray[np.int32],
    capsules: F64,
    colours: F64,
    lamp_m: F64,
    first_name: int,
) -> None:
    """Draw capsules over an image where nothing nearer is in it.

    Args:
        image: (H, W, 3), drawn into; without a row only depth is drawn.
        depth_m: (H, W), along the optical axis, drawn into.
        names: (H, W), drawn into: `first_name` + number of the capsule; not without an image.
        origin_m: (3,), the camera in the cell.
        rays: (H, W, 4): unit direction of each pixel in the cell, depth per metre of it.
        windows: (n, 4): first column, first row, last column + 1, last row + 1.
        capsules: (n, 7), cell.
        colours: (n, 3), 0 to 1, in the order of the image's channels.
        lamp_m: (3,), cell.
        first_name: Name of the first capsule.
    """
    coloured = image.shape[0] > 0
    for k in range(capsules.shape[0]):
        ax, ay, az = capsules[k, 0], capsules[k, 1], capsules[k, 2]
        bx, by, bz = capsules[k, 3] - ax, capsules[k, 4] - ay, capsules[k, 5] - az
        radius = capsules[k, 6]
        ox, oy, oz = origin_m[0] - ax, origin_m[1] - ay, origin_m[2] - az
        bb = bx * bx + by * by + bz * bz
        bo = bx * ox + by * oy + bz * oz
        oo = ox * ox + oy * oy + oz * oz
        far = oo - radius * radius
        c = bb * far - bo * bo
        far_other = far - 2.0 * bo + bb
        for v in range(windows[k, 1], windows[k, 3]):
            for u in range(windows[k, 0], windows[k, 2]):
                ex, ey, ez = rays[v, u, 0], rays[v, u, 1], rays[v, u, 2]
                be, oe = bx * ex + by * ey + bz * ez, ox * ex + oy * ey + oz * ez
                t, y = _first_cut(be, oe, bb, bo, c, far, far_other)
                z = t * rays[v, u, 3]
                if t <= 0.0 or z >= depth_m[v, u]:
                    continue
                depth_m[v, u] = z
                if not coloured:
                    continue
                names[v, u] = first_name + k
                along = y / bb if bb > 1e-12 else 0.0
                px, py, pz = ox + t * ex, oy + t * ey, oz + t * ez
                nx, ny, nz = px - along * bx, py - along * by, pz - along * bz
                lx, ly, lz = lamp_m[0] - ax - px, lamp_m[1] - ay - py, lamp_m[2] - az - pz
                away = math.sqrt(lx * lx + ly * ly + lz * lz)
                lit = max(0.0, (nx * lx + ny * ly + nz * lz) / away)
                facing = max(0.0, -(nx * ex + ny * ey + nz * ez))
                shade = 255.0 * (0.35 + (0.45 * lit + 0.25 * facing) / radius)
                stripe = int(y / math.sqrt(bb + 1e-12) * 18.0 + 100.0) + (nx > ny)
                shade *= 0.86 if stripe & 1 else 1.0
                for channel in range(3):
                    image[v, u, channel] = min(255.0, colours[k, channel] * shade)


@numba.njit(cache=True, fastmath=True, nogil=True)
def _covered(lamp_depth_m: F32, column: float, row: float, below_m: float) -> float:
    """Return which share of the four texels around a place is nearer to the lamp than `below_m`."""
    left, top = int(column), int(row)
    right, down = column - left, row - top
    dark = 0.0
    if lamp_depth_m[top, left] < below_m:
        dark += (1.0 - right) * (1.0 - down)
    if lamp_depth_m[top, left + 1] < below_m:
        dark += right * (1.0 - down)
    if lamp_depth_m[top + 1, left] < below_m:
        dark += (1.0 - right) * down
    if lamp_depth_m[top + 1, left + 1] < below_m:
        dark += right * down
    return dark


@numba.njit(cache=True, fastmath=True, nogil=True)
def cast_shadows(
    image: npt.NDArray[np.uint8],
    depth_m: F32,
    still_depth_m: F32,
    light: F32,
    before_m: F32,
    after_m: F32,
    window: tuple[int, int, int, int],
) -> None:
    """Darken what stands still where something new between it and the lamp was drawn.

    Args:
        image: (H, W, 3), darkened.
        depth_m: (H, W); where it is nearer than `still_depth_m`, nothing is darkened.
        still_depth_m: (H, W), of what stands still.
        light: (H, W, 4) per pixel of what stands still: column and row in the lamp's image, its
            depth there (0: never lit), the factor of full shadow.
        before_m: (L, L), the lamp's image of what has thrown its shadow already.
        after_m: (L, L), the same and what throws its shadow now.
        window: First column, first row, last column + 1, last row + 1 of what is looked at.
    """
    last = after_m.shape[0] - 1
    for v in range(window[1], window[3]):
        for u in range(window[0], window[2]):
            column, row, below = light[v, u, 0], light[v, u, 1], light[v, u, 2] - 0.04
            if below < 0.0 or not (0.0 <= column < last and 0.0 <= row < last):
                continue
            dark = _covered(after_m, column, row, below)
            if dark == 0.0 or depth_m[v, u] < still_depth_m[v, u]:
                continue
            lost = 1.0 - light[v, u, 3]
            factor = (1.0 - dark * lost) / (1.0 - _covered(before_m, column, row, below) * lost)
            for channel in range(3):
                image[v, u, channel] = image[v, u, channel] * factor + 0.5
