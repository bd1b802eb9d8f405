"""What has changed on a tray whose packages touch each other.

A package is judged against the picture as it would be without it: the empty tray with all others
where they stand now, since a push moves the neighbours too.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final, TypeVar

import numpy as np

from actors.geometry.shapes import DEPTH_UNKNOWN_MM, DepthFrame
from actors.geometry.surfaces.depth import median_known, metres
from actors.geometry.surfaces.rendering import directions, render_depth

if TYPE_CHECKING:
    from collections.abc import Hashable, Mapping, Sequence

    import numpy.typing as npt

    from actors.geometry.shapes import Surface

    F64 = npt.NDArray[np.float64]
    Depth = npt.NDArray[Any]
    Standing = tuple[Surface, F64]

Key = TypeVar("Key", bound="Hashable")

SEEN_M: Final = (1.00, 0.66)
"""Length and width of what is looked at, along x and y at the height of the tray: the tray, and as
much farther as the top of a package at its rim is seen."""
HIGHEST_M: Final = 0.22
"""What is higher does not stand on the tray: an upright carton is 0.2 m high."""
CHANGED_M: Final = 0.004
"""A pixel that is nearer or farther by more than this has changed."""
CHANGED_SHARE: Final = 0.03
"""A package has moved when this share of its pixels has changed."""


STANDS_M: Final = 0.012
"""Where a package is seen no farther away than this, it stands, be it dented."""
STANDS_SHARE: Final = 0.9
"""It surely stands where it was taken to if so much of it is seen there …"""
ABSENT_SHARE: Final = 0.5
"""… and surely does not with less."""


def where_seen(frame: DepthFrame, surface: Surface, poses: Sequence[F64]) -> F64 | None:
    """Return where a package is seen; None if at none of some places.

    Args:
        frame: The picture; its world is the tray frame.
        surface: Its trained surface.
        poses: tray_from_product of each place, the likely ones first.
    """
    seen_m, best, least = metres(frame.depth_mm), None, ABSENT_SHARE
    for pose in poses:
        rendered_m = render_depth([(surface, pose)], frame.acquisition)
        with np.errstate(invalid="ignore"):
            farther = seen_m > rendered_m + STANDS_M
            there = np.abs(seen_m - rendered_m) <= STANDS_M
        share = float(there.sum() / max(1, (there | farther).sum()))
        if share > STANDS_SHARE:
            return pose
        if share > least:
            best, least = pose, share
    return best


def tray_alone(frame: DepthFrame, empty: DepthFrame) -> DepthFrame:
    """Return a picture with nothing but the tray: what is beside it is as when it was empty.

    The hand that waits between belt and tray is seen beside the tray; one that is not aside is seen
    above it, and what it hides is unknown.

    Args:
        frame: The picture now; its world is the tray frame.
        empty: The empty tray, from the same place.
    """
    eye = empty.acquisition.world_from_camera
    rays = directions(empty.acquisition.camera) @ eye[:3, :3].T
    on_tray = eye[:2, 3] - rays[..., :2] * (eye[2, 3] / rays[..., 2:])
    beside = (2.0 * np.abs(on_tray) > SEEN_M).any(axis=-1)
    depth_mm = np.where(beside, empty.depth_mm, frame.depth_mm)
    high = eye[2, 3] + metres(depth_mm) * rays[..., 2] > HIGHEST_M
    depth_mm[high & ~beside] = DEPTH_UNKNOWN_MM
    return DepthFrame(depth_mm.astype(frame.depth_mm.dtype), frame.acquisition)


def without(frame: DepthFrame, empty_mm: Depth, others: Sequence[Standing]) -> Depth:
    """Return the picture as it would be with nothing but the others on the tray.

    Args:
        frame: The picture now; its world is the tray frame.
        empty_mm: (H, W), the empty tray.
        others: Trained surface and tray_from_product of every other package on it; those that the
            picture does not show there are left out.

    Returns:
        (H, W) float32, millimetres; not rounded, as the picture is of several images.
    """
    before_mm = empty_mm.astype(np.float32)
    standing = [each for each in others if where_seen(frame, each[0], [each[1]]) is not None]
    if standing:
        rendered_m = render_depth(standing, frame.acquisition)
        covered = np.isfinite(rendered_m)
        before_mm[covered] = 1000.0 * rendered_m[covered]
    return before_mm


def changed(now: DepthFrame, before: DepthFrame, packages: Mapping[Key, Standing]) -> list[Key]:
    """Return the packages whose pixels differ between two pictures of one tray.

    Args:
        now: The newer picture.
        before: The older one, from the same place.
        packages: Trained surface and tray_from_product of each.
    """
    newer_m, older_m = (median_known(metres(frame.depth_mm), 5) for frame in (now, before))
    with np.errstate(invalid="ignore"):
        differs = np.abs(newer_m - older_m) > CHANGED_M
    found = []
    for name, standing in packages.items():
        own = np.isfinite(render_depth([standing], now.acquisition))
        if own.any() and differs[own].mean() > CHANGED_SHARE:
            found.append(name)
    return found
