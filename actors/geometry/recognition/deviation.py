"""Compare a place of the tray with its expected content: missing, extra, tipped, moved, deformed.

what is new -> register the trained surface -> render it into the sensor -> compare pixel by pixel
(median 5, mean 7x7, limit from the sensor's spread, a band along edges left out) -> largest blob
what an upright package does not explain -> the same surface with six freedoms: does it lean?

Packages in contact are distinguished by the image before, in which the neighbours stand already.

Rules a change must keep: depth is the only evidence; limits carry the numbers they come from;
what an overhead sensor cannot see (a dent below `Limits`, or in a face seen flat) is not claimed.

Source: ENACT 4.2 (deviation detection actor).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from actors.geometry.poses import moved, yaw_between, yaw_of
from actors.geometry.recognition.registration import Registration, leaning, register, tilt_of
from actors.geometry.recognition.segmentation import (
    Piece,
    new_pieces,
    pixel_area_m2,
    rise,
    unhidden,
)
from actors.geometry.surfaces.depth import mean_known, median_known, metres, spread_m
from actors.geometry.surfaces.rendering import render_depth

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy.typing as npt

    from actors.geometry.shapes import DepthFrame, Surface

    Pose = npt.NDArray[np.float64]
    Image = npt.NDArray[np.float32]
    Mask = npt.NDArray[np.bool_]

VERDICTS: Final = ("ok", "missing", "extra", "tipped", "moved", "deformed")

LEANS_CLEARLY: Final = 0.6
"""A package leans if that leaves at most this share of the distance that standing leaves …"""

LEANS_M: Final = 0.002
LEANS_FUSED_M: Final = 0.0012
"""… and at most this, in one image and in several fused ones: leaning packages of right shape left
1.3 mm and 0.4 to 0.8, the best tilt of a bulge of 13 to 15 mm left 1.6 to 2.4."""

OUTLINE_PX: Final = 1
"""Within so much of an outline a pixel may show the ground: nothing is read from it."""

OPEN_FOOT: Final = 4.0
"""Beside a leaning package more counts as foreign: its model is open where it used to stand."""


@dataclass(frozen=True, slots=True)
class Limits:
    """Where a difference becomes a deviation.

    Calibrated on fused images: of 96 sound packages of three products none had a blob at all, and
    of 96 dents of 3 mm, 14 to 22 mm wide, anywhere in seen faces, 92 had more than 100 mm2.

    Attributes:
        height_m: What all of a package may seem too high or too low, metres: sound ones by up to
            0.12 mm. A wide dent in a small lid moves the middle of all differences by 1.5 mm.
        depth_spreads: Of the sensor's spread at the pixel, part of the limit of a depth difference;
            the filters leave 0.12 spreads of noise.
        depth_m: The other part: what model and registration are off on a flat face, metres.
        slope_m: What registration is off in the plane, metres; counts by the model's slope.
        edge_px: Width of the band along outlines that is left out: half of it the filters need,
            registration is off by less than 1.
        beside_px: Width of the band around the product where nothing counts as foreign.
        deformed_m2: Least area of a deformation, square metres.
        deformed_m: Least depth of one, metres: dents of 3 mm were measured as 1.9 and more.
        extra_m2: Least area of a foreign object outside the band, square metres.
        moved_m: Largest shift of a package in its place, metres.
        turned_rad: Largest turn.
        tipped_rad: Largest tilt.
        present_share: Share of the product's area that must have come for it to be there.
    """

    height_m: float = 0.0003
    depth_spreads: float = 0.3
    depth_m: float = 0.0006
    slope_m: float = 0.0007
    edge_px: int = 4
    beside_px: int = 6
    deformed_m2: float = 0.0001
    deformed_m: float = 0.0015
    extra_m2: float = 0.00025
    moved_m: float = 0.010
    turned_rad: float = float(np.deg2rad(8.0))
    tipped_rad: float = float(np.deg2rad(5.0))
    present_share: float = 0.35


@dataclass(frozen=True, slots=True, eq=False)
class Finding:
    """What was found at a place.

    Attributes:
        verdict: One of `VERDICTS`; of several the first that applies in that order.
        deviation_mm: deformed: 95th percentile of the depth difference over the blob; moved: the
            shift; missing: height of what is not there; extra: height of what is too much; tipped:
            how far the highest point of the product is off its height.
        area_mm2: Area of the deviating region.
        shift_mm: Distance of the registered from the planned position.
        turn_deg: Yaw of the registered against the planned pose.
        tilt_deg: Tilt of the registered pose; 0 unless tipped.
        tray_from_product: Registered pose, (4, 4), upright unless tipped; the planned one if
            missing.
        region: (H, W) bool, the deviating pixels.
    """

    verdict: str
    deviation_mm: float
    area_mm2: float
    shift_mm: float
    turn_deg: float
    tilt_deg: float
    tray_from_product: Pose
    region: Mask


def inspect_place(
    frame: DepthFrame,
    before_mm: npt.NDArray[np.uint16 | np.float32],
    surface: Surface,
    planned: Pose,
    *,
    limits: Limits | None = None,
    others: Sequence[Pose] = (),
) -> Finding:
    """Judge what has come onto the tray since an earlier image.

    Args:
        frame: The image now; its world is the tray frame.
        before_mm: (H, W), the image before the package came, millimetres.
        surface: The trained product, product frame.
        planned: tray_from_product as planned, (4, 4).
        limits: Where a difference becomes a deviation; the calibrated ones when absent.
        others: tray_from_product of what stands at other places: a thing that lies nearer to one
            of these, apart from this package, is nothing extra here.

    Returns:
        The verdict with its evidence.
    """
    limits = limits or Limits()
    pieces = new_pieces(frame, before_mm)
    area_m2 = np.nan_to_num(pixel_area_m2(frame))
    expected = render_depth([(surface, planned)], frame.acquisition)
    least_m2 = limits.present_share * float(_areas_of(expected, frame).sum())
    piece = _package(pieces, least_m2, planned)
    if piece is None:
        return _missing(expected, before_mm, frame, planned)
    before_m = metres(before_mm)
    found = register(
        piece.cloud, piece.outline_m, surface, planned, seen_by=frame.acquisition, before_m=before_m
    )
    pose = found.tray_from_product
    shift_m = float(np.hypot(*(pose[:2, 3] - planned[:2, 3])))
    turn = yaw_between(yaw_of(planned), yaw_of(pose))
    rendered = render_depth([(surface, pose)], frame.acquisition)
    pieces = [piece, *_beside_it(pieces, piece, (planned, pose), others)]
    foreign = _foreign(pieces, np.isfinite(rendered), limits)
    bent, bent_m = _deformed(frame, unhidden(rendered, before_m), limits)

    def finding(verdict: str, deviation_m: float, region: Mask) -> Finding:
        area = float(area_m2[region].sum())
        return _finding(verdict, deviation_m, region, area, shift_m, turn, pose)

    too_much = area_m2[foreign].sum() >= limits.extra_m2
    off = shift_m > limits.moved_m or abs(turn) > limits.turned_rad
    if too_much or off or bent_m:
        leaves_m = LEANS_FUSED_M if frame.depth_mm.dtype == np.float32 else LEANS_M
        lies = _tipped(piece, surface, found, limits.tipped_rad, leaves_m)
        if lies is not None:
            pose = lies
            shift_m = _beside(surface, pose, planned)
            rendered = render_depth([(surface, pose)], frame.acquisition)
            foreign = _foreign(pieces, np.isfinite(rendered), limits)
            too_much = area_m2[foreign].sum() >= OPEN_FOOT * limits.extra_m2
    if too_much:
        height = rise(frame, before_mm)[foreign]
        return finding("extra", float(np.nanpercentile(height, 95)), foreign)
    if tilt_of(pose) > limits.tipped_rad:
        return finding("tipped", _higher(surface, pose), np.isfinite(rendered))
    if off:
        return finding("moved", shift_m, np.isfinite(rendered))
    if bent_m:
        return finding("deformed", bent_m, bent)
    return finding("ok", 0.0, np.zeros_like(bent))


def _finding(
    verdict: str,
    deviation_m: float,
    region: Mask,
    area_m2: float,
    shift_m: float,
    turn_rad: float,
    pose: Pose,
) -> Finding:
    return Finding(
        verdict=verdict,
        deviation_mm=1000.0 * deviation_m,
        area_mm2=1e6 * area_m2,
        shift_mm=1000.0 * shift_m,
        turn_deg=float(np.rad2deg(turn_rad)),
        tilt_deg=float(np.rad2deg(tilt_of(pose))),
        tray_from_product=pose,
        region=region,
    )


def depth_difference(frame: DepthFrame, rendered_m: Image, limits: Limits) -> tuple[Image, Image]:
    """Compare an image with a rendered surface, away from edges.

    Args:
        frame: The image.
        rendered_m: (H, W) float32, the surface as it should look, metres, NaN beside it.
        limits: Band along edges, and the parts of the limit.

    Returns:
        Smoothed difference, metres, positive where the object is nearer than it should be, NaN
        where no statement is possible; and the limit of its absolute value, metres. (H, W) float32.
    """
    known = np.isfinite(rendered_m)
    raw = rendered_m - metres(frame.depth_mm)
    raw[~_shrunk(known, OUTLINE_PX)] = np.nan  # or the filters would carry the ground inwards
    smooth = mean_known(median_known(raw, 5), 7)
    inside = _shrunk(known, limits.edge_px)
    smooth[~inside] = np.nan
    if inside.any():
        # Two calibrations (arm and overhead) disagree a little in height.
        median_m = np.nanmedian(smooth[inside])
        smooth -= np.float32(np.clip(median_m, -limits.height_m, limits.height_m))
    slope_limit = limits.slope_m * slope_of(rendered_m, frame.acquisition.camera.fx_px)
    limit = limits.depth_spreads * spread_m(rendered_m) + limits.depth_m + slope_limit
    return smooth, limit.astype(np.float32)


def slope_of(rendered_m: Image, focal_px: float) -> Image:
    """Return by how much a surface falls away from the sensor, metres per metre across; (H, W)."""
    import cv2

    filled = np.nan_to_num(rendered_m).astype(np.float32)
    slope = np.hypot(cv2.Sobel(filled, cv2.CV_32F, 1, 0), cv2.Sobel(filled, cv2.CV_32F, 0, 1)) / 8.0
    return np.asarray(slope / (rendered_m / focal_px), np.float32)


def _deformed(frame: DepthFrame, rendered_m: Image, limits: Limits) -> tuple[Mask, float]:
    """Return the largest deformed region and its depth, metres; 0 if it is too small or slight."""
    difference, limit_m = depth_difference(frame, rendered_m, limits)
    area_m2 = np.nan_to_num(pixel_area_m2(frame))
    with np.errstate(invalid="ignore"):
        bent = _largest_blob(np.abs(difference) > limit_m, area_m2)
    if area_m2[bent].sum() < limits.deformed_m2:
        return bent, 0.0
    depth_m = float(np.percentile(np.abs(difference[bent]), 95))
    return bent, depth_m if depth_m >= limits.deformed_m else 0.0


def _missing(
    expected_m: Image,
    before_mm: npt.NDArray[np.uint16 | np.float32],
    frame: DepthFrame,
    planned: Pose,
) -> Finding:
    region = np.isfinite(expected_m)
    height = metres(before_mm)[region] - expected_m[region]
    return Finding(
        verdict="missing",
        deviation_mm=1000.0 * float(np.nanpercentile(height, 95)) if region.any() else 0.0,
        area_mm2=1e6 * float(_areas_of(expected_m, frame).sum()),
        shift_mm=0.0,
        turn_deg=0.0,
        tilt_deg=0.0,
        tray_from_product=planned,
        region=region,
    )


def _package(pieces: Sequence[Piece], least_m2: float, planned: Pose) -> Piece | None:
    """Return the piece that is taken for the package: the nearest that is large enough."""
    large = (each for each in pieces if each.area_m2 >= least_m2)
    return min(large, key=lambda each: math.dist(each.centre_m[:2], planned[:2, 3]), default=None)


def _beside_it(
    pieces: Sequence[Piece], package: Piece, own: Sequence[Pose], others: Sequence[Pose]
) -> list[Piece]:
    """Return the pieces that lie nearer to a package, or its place, than to all others."""

    def nearest_m(piece: Piece, poses: Sequence[Pose]) -> float:
        away = [math.dist(piece.centre_m[:2], pose[:2, 3]) for pose in poses]
        return min(away, default=math.inf)

    return [
        each
        for each in pieces
        if each is not package and nearest_m(each, own) < nearest_m(each, others)
    ]


def _foreign(pieces: list[Piece], product: Mask, limits: Limits) -> Mask:
    """Return the pixels of all pieces that lie outside the product and its edge band."""
    beside = ~_grown(product, limits.beside_px)
    every = np.any([piece.mask for piece in pieces], axis=0)
    return np.asarray(every & beside)


def _tipped(
    piece: Piece, surface: Surface, upright: Registration, tipped_rad: float, leaves_m: float
) -> Pose | None:
    """Return the pose of a package that leans or lies; None if it stands, whatever its shape."""
    found = leaning(piece.cloud, surface, upright.tray_from_product)
    if tilt_of(found.tray_from_product) <= tipped_rad:
        return None
    clearly = found.distance_m < min(leaves_m, LEANS_CLEARLY * upright.distance_m)
    return found.tray_from_product if clearly else None


def _beside(surface: Surface, pose: Pose, planned: Pose) -> float:
    """Return how far the middle of a product is beside where it should be, metres."""
    middle = (surface.vertices_m.min(axis=0) + surface.vertices_m.max(axis=0))[None] / 2.0
    return float(np.hypot(*(moved(middle, pose) - moved(middle, planned))[0, :2]))


def _higher(surface: Surface, pose: Pose) -> float:
    """Return how far the highest point of a product is off its height, metres."""
    top = float(moved(surface.vertices_m, pose)[:, 2].max())
    return abs(top - float(surface.vertices_m[:, 2].max()))


def _largest_blob(mask: Mask, area_m2: Image) -> Mask:
    """Return the connected part of a mask that covers the largest area."""
    from scipy.ndimage import label

    labels, count = label(mask)
    if count == 0:
        return np.zeros_like(mask)
    areas = np.bincount(labels.ravel(), area_m2.ravel())
    areas[0] = 0.0
    return np.asarray(labels == areas.argmax())


def _areas_of(depth_m: Image, frame: DepthFrame) -> Image:
    camera = frame.acquisition.camera
    return np.nan_to_num(depth_m) ** 2 / (camera.fx_px * camera.fy_px)


def _shrunk(mask: Mask, reach_px: int) -> Mask:
    import cv2

    return np.asarray(cv2.erode(mask.astype(np.uint8), _disc(reach_px)) > 0)


def _grown(mask: Mask, reach_px: int) -> Mask:
    import cv2

    return np.asarray(cv2.dilate(mask.astype(np.uint8), _disc(reach_px)) > 0)


def _disc(reach_px: int) -> npt.NDArray[np.uint8]:
    import cv2

    size = 2 * reach_px + 1
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size)), np.uint8)
