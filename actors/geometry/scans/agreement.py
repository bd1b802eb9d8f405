"""Do the depth images of a recording agree with its camera poses?

Each image alone may look sound in a wrong unit: 2600 is 2.6 m in millimetres and 52 cm in the
fifths of millimetres of the TUM recordings.  Two views of one place decide: what one camera saw,
carried to the other by the poses, must lie where the other saw it, and only at the right scale
does it.  The upper quartile of the differences tells, not the median: most of a view is floor
and wall, which fit at any scale.  On five frames of a Redwood recording that span 10 cm it is
0.6 % in millimetres and 14 % if stored in fifths of them; 1 cm of pose noise makes it 4 %.
"""

from __future__ import annotations

from itertools import combinations
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from actors.geometry.files import InputFileError
from actors.geometry.poses import inverse, moved
from actors.geometry.surfaces.depth import metres, points_grid

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    import numpy.typing as npt

    from actors.geometry.shapes import RecordedFrame


UNITS: Final = {0.1: "tenths of millimetres", 0.2: "fifths of millimetres (TUM)", 10.0: "cm"}
"""Other units in use, as millimetres per step."""

QUARTILE: Final = 0.75
DISAGREEMENT_NORMAL: Final = 0.005
"""Relative disagreement (upper quartile) below which nothing is asked further."""

CLEARLY_LESS: Final = 0.4
"""Another explanation is believed when its disagreement is below this share of the present one."""

DISAGREEMENT_MAX: Final = 0.10
"""Median relative disagreement of two near views above which poses and depth do not belong
together; noise of a depth camera stays below 0.03."""

FRAMES_COMPARED_MAX: Final = 40
"""Number of frames examined, evenly spread, so that long recordings cost no more."""


def check_agreement(directory: Path, frames: Sequence[RecordedFrame]) -> None:
    """Refuse depth in a unit, or poses of a kind, that contradict each other.

    Returns no finding if no two views are close enough to be compared.

    Args:
        directory: The recording, for the message.
        frames: With depth in what should be millimetres.

    Raises:
        InputFileError: Another unit fits much better, the poses fit when inverted, or nothing
            fits.
    """
    pair = _widest_near_pair(frames)
    if pair is None:
        return
    poses = pair[0].world_from_camera, pair[1].world_from_camera
    inverted = inverse(poses[0]), inverse(poses[1])
    now = _disagreement(pair, poses, scale=1.0)
    if np.isnan(now) or now <= DISAGREEMENT_NORMAL:
        return
    between = f"frames {pair[0].name} and {pair[1].name} disagree by {now:.1%}"
    others = [(_disagreement(pair, poses, scale=s), s) for s in UNITS]
    others.append((_disagreement(pair, inverted, scale=1.0), 0.0))
    then, scale = min((other for other in others if not np.isnan(other[0])), default=(now, 1.0))
    if then < CLEARLY_LESS * now and scale > 0.0:
        raise InputFileError(
            directory,
            asked="depth in millimetres",
            found=f"{UNITS[scale]}: {between} as millimetres and by {then:.1%} as these",
            remedy=f"multiply the depth images by {scale:g}",
        )
    if then < CLEARLY_LESS * now:
        raise InputFileError(
            directory / "trajectory.log",
            asked="poses world_from_camera",
            found=f"camera_from_world: {between}, and by {then:.1%} with the poses inverted",
            remedy="invert each matrix",
        )
    typical = _disagreement(pair, poses, scale=1.0, share=0.5)
    if typical > DISAGREEMENT_MAX:
        raise InputFileError(
            directory / "trajectory.log",
            asked="poses in metres that agree with the depth images",
            found=f"that frames {pair[0].name} and {pair[1].name} disagree by {typical:.0%}",
            remedy="poses and images are of different recordings, or the poses not in metres",
        )


def _widest_near_pair(
    frames: Sequence[RecordedFrame],
) -> tuple[RecordedFrame, RecordedFrame] | None:
    """Return the two frames farthest apart among those that must see the same surfaces.

    They do if they look within 25 degrees the same way from within a quarter of their depth.
    """
    step = max(1, len(frames) // FRAMES_COMPARED_MAX)
    chosen = frames[::step]
    depth_m = [frame.median_m for frame in chosen]
    best, best_baseline_m = None, 0.005
    for (i, a), (j, b) in combinations(enumerate(chosen), 2):
        same_way = a.world_from_camera[:3, 2] @ b.world_from_camera[:3, 2] > np.cos(np.radians(25))
        baseline_m = np.linalg.norm(a.world_from_camera[:3, 3] - b.world_from_camera[:3, 3])
        near = baseline_m < 0.25 * min(depth_m[i], depth_m[j])
        if same_way and near and baseline_m > best_baseline_m:
            best, best_baseline_m = (a, b), float(baseline_m)
    return best


def _disagreement(
    pair: tuple[RecordedFrame, RecordedFrame],
    poses: tuple[npt.NDArray[Any], npt.NDArray[Any]],
    *,
    scale: float,
    share: float = QUARTILE,
) -> float:
    """Return the relative difference of depth, first view carried to the second, at a quantile."""
    camera = pair[0].depth.acquisition.camera
    here = points_grid(metres(pair[0].depth.depth_mm) * np.float32(scale), camera)[::6, ::6]
    there = pair[1].depth.depth_mm * (scale / 1000.0)
    point_m = here[np.isfinite(here).all(axis=2)]
    x, y, z = moved(point_m, inverse(poses[1]) @ poses[0]).T
    front = z > 1e-6
    x, y, z = x[front], y[front], z[front]
    column, row = np.rint(camera.column_row(x, y, z))
    inside = (column >= 0) & (row >= 0) & (column < camera.width_px) & (row < camera.height_px)
    seen = there[row[inside].astype(int), column[inside].astype(int)]
    difference = np.abs(z[inside] - seen)[seen > 0] / seen[seen > 0]
    return float(np.quantile(difference, share)) if difference.size >= 100 else float("nan")
