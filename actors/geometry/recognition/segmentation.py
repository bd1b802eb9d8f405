"""What lies on the tray, piece by piece, from depth alone.

Rules a change must keep: pieces are parts of the image that are nearer to the sensor than the
same image of an earlier moment; two packages that touch are one piece (the place plan keeps them
apart; see `actors.palletizing.simulation` for what the demonstration does not show).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from actors.geometry.shapes import DepthFrame, PointCloud
from actors.geometry.surfaces.depth import frame_points, median_known, metres, points_grid

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy.typing as npt

    Points = npt.NDArray[np.floating]

    Mask = npt.NDArray[np.bool_]

RISE_MIN_M: Final = 0.008
"""Least height of a piece: after the median 12 spreads of the noise, and lower than any package."""

PIECE_AREA_MIN_M2: Final = 0.0004
"""4 cm2: a piece below is a ragged edge or a crumb; a foreign object of 2 cm width counts."""


HIDDEN_M: Final = 0.002
"""What is no more than this in front of what was there is not told from it."""

PLATE_M: Final = 0.004
"""Height above the plate from where points belong to the product: three spreads at 0.45 m."""

PRODUCT_RADIUS_M: Final = 0.25
"""Nothing that a gripper of 70 mm can take reaches farther from the plate's middle."""


@dataclass(frozen=True, slots=True, eq=False)
class Piece:
    """One connected thing that has come onto the tray.

    Attributes:
        mask: (H, W) bool, its pixels.
        cloud: Its points in the tray frame, metres.
        outline_m: (K, 2) float64, its points along the outline, tray frame, metres.
        area_m2: Area of its pixels at their own distance, square metres.
        centre_m: Mean of its points, (3,) float64, tray frame.
    """

    mask: Mask
    cloud: PointCloud
    outline_m: npt.NDArray[np.float64]
    area_m2: float
    centre_m: npt.NDArray[np.float64]


def new_pieces(frame: DepthFrame, before_mm: npt.NDArray[np.uint16 | np.float32]) -> list[Piece]:
    """Return the pieces that are in a frame and were not there before, the largest first.

    Args:
        frame: The image now.
        before_mm: (H, W) uint16, the same camera's image before (the empty tray, or the last
            stop), millimetres.
    """
    from scipy.ndimage import binary_opening, label

    rise_m = rise(frame, before_mm)
    with np.errstate(invalid="ignore"):
        risen = binary_opening(rise_m > RISE_MIN_M, iterations=2)
    labels, count = label(risen)
    if count == 0:
        return []
    points = frame_points(frame)
    with np.errstate(invalid="ignore"):
        # Along an outline single pixels show the ground beside the piece: no points of it.
        raised = metres(before_mm) - metres(frame.depth_mm) > RISE_MIN_M / 2.0
    area = pixel_area_m2(frame)
    areas = np.bincount(labels.ravel(), np.nan_to_num(area).ravel())
    pieces = []
    for number in np.argsort(-areas[1:], kind="stable") + 1:
        if areas[number] < PIECE_AREA_MIN_M2:
            break
        mask = labels == number
        cloud = points[mask & raised]
        outline = points[raised & outline_of(mask)][:, :2].astype(float)
        centre = cloud.mean(axis=0, dtype=float)
        pieces.append(Piece(mask, PointCloud(cloud), outline, float(areas[number]), centre))
    return pieces


def outline_of(mask: Mask) -> Mask:
    """Return the outermost pixels of a mask."""
    from scipy.ndimage import binary_erosion

    return np.asarray(mask & ~binary_erosion(mask))


def rise(
    frame: DepthFrame, before_mm: npt.NDArray[np.uint16 | np.float32]
) -> npt.NDArray[np.float32]:
    """Return how much nearer to the sensor each pixel is than before, (H, W) float32, metres."""
    now, before = (median_known(metres(each), 5) for each in (frame.depth_mm, before_mm))
    return np.asarray(before - now, np.float32)


def unhidden(
    rendered_m: npt.NDArray[np.float32], before_m: npt.NDArray[np.float32]
) -> npt.NDArray[np.float32]:
    """Return the image of a thing without what stood in front of it before, (H, W), metres."""
    with np.errstate(invalid="ignore"):
        hidden = before_m < rendered_m + HIDDEN_M
    return np.where(hidden, np.float32(np.nan), rendered_m)


def pixel_area_m2(frame: DepthFrame) -> npt.NDArray[np.float32]:
    """Return the area that each pixel covers at its distance, square on, (H, W); NaN unknown."""
    camera = frame.acquisition.camera
    return np.asarray(metres(frame.depth_mm) ** 2 / (camera.fx_px * camera.fy_px), np.float32)


def footprint_pose(cloud: PointCloud) -> npt.NDArray[np.float64]:
    """Return a pose that a piece itself suggests: its centre, x along its longer side.

    Good to a few millimetres and, for an outline that is not square, a few degrees; which end is
    the head it cannot tell.

    Args:
        cloud: Points in the tray frame, at least 3.

    Returns:
        tray_from_package, (4, 4) float64, z up, origin on the tray.
    """
    centre = cloud.points_m[:, :2].mean(axis=0, dtype=float)
    flat = cloud.points_m[:, :2] - centre
    axis = np.linalg.eigh(flat.T @ flat)[1][:, 1]
    pose = np.eye(4)
    pose[:2, :2] = np.array([[axis[0], -axis[1]], [axis[1], axis[0]]])
    pose[:2, 3] = centre
    return pose


def product_on_plate(frame: DepthFrame) -> PointCloud:
    """Return the points of a product that stands on a plate, seen by an eye-in-hand sensor.

    Args:
        frame: The image; its world is the product frame, the plate is z = 0.

    Returns:
        Points in the CAMERA frame (the acquisition pose carries them home), metres; without the
        lowest `PLATE_M` and what is farther than `PRODUCT_RADIUS_M` from the plate's middle.
    """
    world = frame_points(frame)
    with np.errstate(invalid="ignore"):
        product = (world[..., 2] > PLATE_M) & (
            np.hypot(world[..., 0], world[..., 1]) < PRODUCT_RADIUS_M
        )
    return PointCloud(points_grid(metres(frame.depth_mm), frame.acquisition.camera)[product])


MATCH_M: Final = 0.03
"""Farthest that a package moves between two stops and is still taken for the same one."""


def assigned(found_m: Sequence[Points], known_m: Sequence[Points]) -> list[int | None]:
    """Match places that are seen to places that are known, each at most once.

    Args:
        found_m: Positions (2,) seen, metres, tray frame.
        known_m: Positions (2,) known.

    Returns:
        For each seen position the number of the known one, or None; the sum of distances of
        all matches is least.
    """
    from scipy.optimize import linear_sum_assignment

    matches: list[int | None] = [None] * len(found_m)
    if found_m and known_m:
        apart = np.linalg.norm(np.array(found_m)[:, None] - np.array(known_m)[None], axis=2)
        # Beyond reach all costs are equal, so that a hopeless pair never spoils a good one.
        for row, column in zip(*linear_sum_assignment(np.minimum(apart, MATCH_M)), strict=True):
            if apart[row, column] < MATCH_M:
                matches[row] = int(column)
    return matches


def nearest(place_m: Points, candidates_m: Sequence[Points]) -> int | None:
    """Return the number of the candidate position nearest to a place, or None."""
    if not candidates_m:
        return None
    return int(np.argmin([float(np.hypot(*(each - place_m))) for each in candidates_m]))
