"""Points in the images of a calibrated camera: pinhole with OpenCV's five distortion coefficients.

Rules a change must keep: the centre of the first pixel is (0, 0), as in OpenCV and in
`shapes.Camera`; a point behind the camera or beyond the angle up to which its distortion is
one-to-one has no pixel (NaN), because the polynomial would fold it back into the image.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

if TYPE_CHECKING:
    import numpy.typing as npt

    Numbers = npt.NDArray[np.floating]

RADIUS_MAX: Final = 4.0
"""Tangent of the largest angle to the optical axis that is looked at: 76 degrees."""


def in_camera(points_m: Numbers, camera_from_cell: Numbers) -> Numbers:
    """Return points of the cell in the frame of a camera, in their own dtype.

    Args:
        points_m: (..., 3), metres, cell.
        camera_from_cell: (4, 4).

    Returns:
        (..., 3), metres, camera: x right, y down, z forward.
    """
    turn = camera_from_cell[:3, :3].astype(points_m.dtype)
    return np.asarray(points_m @ turn.T + camera_from_cell[:3, 3].astype(points_m.dtype))


def on_image(points_m: Numbers, camera_matrix: Numbers, distortion: Numbers) -> Numbers:
    """Return the pixels at which a camera sees points.

    Args:
        points_m: (..., 3), metres, camera.
        camera_matrix: (3, 3), pixels.
        distortion: (5,), k1 k2 p1 p2 k3 of OpenCV.

    Returns:
        (..., 2) column and row, pixels, in the dtype of the points; NaN where the camera has no
        pixel for a point.
    """
    z = points_m[..., 2]
    ahead = np.where(z > 0.0, z, np.nan).astype(points_m.dtype)
    x: Numbers = points_m[..., 0] / ahead
    y: Numbers = points_m[..., 1] / ahead
    if np.any(distortion):
        x, y = _distorted(x, y, distortion)
    k = camera_matrix
    return np.stack([k[0, 0] * x + k[0, 1] * y + k[0, 2], k[1, 1] * y + k[1, 2]], -1).astype(
        points_m.dtype
    )


def _distorted(x: Numbers, y: Numbers, distortion: Numbers) -> tuple[Numbers, Numbers]:
    """Return where distortion moves points of the image plane at z = 1; NaN past its fold."""
    k1, k2, p1, p2, k3 = (float(value) for value in distortion)
    squared = x * x + y * y
    squared = np.where(squared < _radius_max(k1, k2, k3) ** 2, squared, np.nan)
    factor = 1.0 + squared * (k1 + squared * (k2 + squared * k3))
    moved_x = x * factor + 2.0 * p1 * x * y + p2 * (squared + 2.0 * x * x)
    moved_y = y * factor + p1 * (squared + 2.0 * y * y) + 2.0 * p2 * x * y
    return moved_x, moved_y


def _radius_max(k1: float, k2: float, k3: float) -> float:
    """Return up to which radius at z = 1 the distorted radius grows."""
    radius = np.linspace(0.0, RADIUS_MAX, 2001)
    squared = radius**2
    distorted = radius * (1.0 + squared * (k1 + squared * (k2 + squared * k3)))
    shrinks = np.flatnonzero(np.diff(distorted) <= 0.0)
    return float(radius[shrinks[0]]) if len(shrinks) else RADIUS_MAX
