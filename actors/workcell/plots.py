"""Plots of a run: the cell from above, and distance and speed over time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from actors.geometry.picture import INK, with_label

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy.typing as npt

    from actors.workcell.vocabulary import Grid, Hull, Prediction, Track

    F64 = npt.NDArray[np.float64]
    Picture = npt.NDArray[np.uint8]

PLAN_PX: Final = 900
"""Edge of the plan."""
PLAN_M: Final = 2.4
"""The plan shows from minus this to this along x and y."""
GREY: Final = (206, 211, 216)
OCCUPIED: Final = (232, 160, 130)
ARM: Final = (240, 146, 58)
TRACK: Final = (40, 90, 190)
AHEAD: Final = (120, 160, 220)
TRUE: Final = (20, 140, 90)
PATH: Final = (150, 60, 160)


@dataclass(frozen=True, slots=True, eq=False)
class Line:
    """A curve of a timeline.

    Attributes:
        name: Its name.
        at_s: (n,), seconds.
        values: (n,); what is not finite is a gap.
        colour: RGB.
    """

    name: str
    at_s: F64
    values: F64
    colour: tuple[int, int, int]


@dataclass(frozen=True, slots=True, eq=False)
class Plan:
    """What a plan shows, all of one stamp.

    Attributes:
        grid: The grid.
        boxes: (n, 15), static obstacles.
        hull: Occupied voxels.
        arm: (k, 7), the arm.
        tool_path: (n, 3), the tool along the path.
        ways: (n, 2) each, positions of people so far.
        tracks: Present positions of people.
        predictions: Predicted positions of people.
        bodies: The true bodies, each (n, 7).
    """

    grid: Grid
    boxes: F64
    hull: Hull
    arm: F64
    tool_path: F64
    ways: Sequence[F64]
    tracks: Sequence[Track]
    predictions: Sequence[Prediction]
    bodies: Sequence[F64]


def plan_figure(plan: Plan, caption: str) -> Picture:
    """Show the cell from above: hull, arm, tracks, predictions, path, and the truth as outlines.

    Args:
        plan: What to show.
        caption: A line over it.
    """
    import cv2

    sheet = np.full((PLAN_PX, PLAN_PX, 3), 252, np.uint8)
    half = np.array(plan.grid.shape[:2]) * plan.grid.voxel_m / 2.0
    middle = plan.grid.origin_m[:2] + half
    corners = [tuple(_px(middle + sign * half).tolist()) for sign in (-1.0, 1.0)]
    cv2.rectangle(sheet, corners[0], corners[1], GREY, 2)
    for box in plan.boxes:
        turn = box[6:].reshape(3, 3)[:2, :2]
        rim = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * box[3:5]
        cv2.fillConvexPoly(sheet, _px(box[:2] + rim @ turn.T), GREY, cv2.LINE_AA)
    if len(plan.hull.voxels):
        columns = np.unique(plan.hull.voxels[:, :2], axis=0)
        for low in plan.grid.origin_m[:2] + columns * plan.grid.voxel_m:
            one, other = _px(low), _px(low + plan.grid.voxel_m)
            cv2.rectangle(sheet, tuple(one.tolist()), tuple(other.tolist()), OCCUPIED, cv2.FILLED)
    for capsule in plan.arm:
        _stroke(sheet, capsule, ARM)
    for body in plan.bodies:
        for capsule in body:
            cv2.circle(
                sheet, tuple(_px(capsule[:2]).tolist()), _length(capsule[6]), TRUE, 1, cv2.LINE_AA
            )
    for way in plan.ways:
        cv2.polylines(sheet, [_px(way)], False, TRACK, 2, cv2.LINE_AA)
    for prediction in plan.predictions:
        for centre, radius in zip(prediction.centre_m, prediction.radius_m, strict=True):
            cv2.circle(sheet, tuple(_px(centre).tolist()), _length(radius), AHEAD, 1, cv2.LINE_AA)
    for track in plan.tracks:
        here = _px(track.position_m[:2])
        ahead = _px(track.position_m[:2] + 0.5 * track.velocity_m_s[:2])
        cv2.circle(sheet, tuple(here.tolist()), 7, TRACK, cv2.FILLED, cv2.LINE_AA)
        cv2.arrowedLine(sheet, tuple(here.tolist()), tuple(ahead.tolist()), TRACK, 2, cv2.LINE_AA)
    if len(plan.tool_path) > 1:
        cv2.polylines(sheet, [_px(plan.tool_path[:, :2])], False, PATH, 3, cv2.LINE_AA)
    sheet = with_label(sheet, caption, (12, 10), height_px=20)
    legend = [
        ("hull", OCCUPIED),
        ("arm", ARM),
        ("track, 0.5 s", TRACK),
        ("prediction", AHEAD),
        ("truth", TRUE),
        ("path", PATH),
    ]
    return _legend(sheet, legend)


def _px(points_m: F64) -> npt.NDArray[np.int32]:
    """Return pixels, x to the right, y up."""
    points = np.asarray(points_m, np.float64)[..., :2]
    place = (points * np.array([1.0, -1.0]) + PLAN_M) / (2.0 * PLAN_M) * PLAN_PX
    return np.asarray(np.rint(place), np.int32)


def _length(metres: float) -> int:
    return max(1, round(float(metres) / (2.0 * PLAN_M) * PLAN_PX))


def _stroke(sheet: Picture, capsule: F64, colour: tuple[int, int, int]) -> None:
    import cv2

    one, other = (tuple(_px(end).tolist()) for end in (capsule[:3], capsule[3:6]))
    cv2.line(sheet, one, other, colour, 2 * _length(capsule[6]), cv2.LINE_AA)


def _legend(sheet: Picture, entries: Sequence[tuple[str, tuple[int, int, int]]]) -> Picture:
    import cv2

    left = 16
    for name, colour in entries:
        top = sheet.shape[0] - 30
        cv2.rectangle(sheet, (left, top + 5), (left + 14, top + 17), colour, cv2.FILLED)
        sheet = with_label(sheet, name, (left + 18, top - 2), height_px=16, paper=None)
        left += 40 + 10 * len(name)
    return sheet


def timeline(
    panels: Sequence[tuple[str, float, Sequence[Line]]], *, size_px: tuple[int, int] = (1300, 260)
) -> Picture:
    """Draw curves over time, one panel under the other.

    Args:
        panels: Of each its title with the unit, the value at its top, and its curves; 0 is at its
            bottom.
        size_px: Width and height of each panel.
    """
    import cv2

    width, height = size_px
    every = [line.at_s for _, _, lines in panels for line in lines if len(line.at_s)]
    end_s = max((float(each.max()) for each in every), default=1.0)
    sheets = []
    for title, top, lines in panels:
        sheet = np.full((height, width, 3), 255, np.uint8)
        left, right, up, down = 60, width - 16, 34, height - 40
        for share in (0.0, 0.5, 1.0):
            y = round(down + (up - down) * share)
            cv2.line(sheet, (left, y), (right, y), (226, 230, 235), 1)
            sheet = with_label(sheet, f"{top * share:.3g}", (8, y - 12), height_px=14, paper=None)
        for second in np.arange(0.0, end_s + 1e-9, _step(end_s)):
            x = round(left + (right - left) * second / end_s)
            cv2.line(sheet, (x, up), (x, down), (240, 242, 245), 1)
            sheet = with_label(sheet, f"{second:g} s", (x - 12, down + 2), height_px=13, paper=None)
        for line in lines:
            known = np.isfinite(line.values)
            columns = left + (right - left) * line.at_s / end_s
            rows = down + (up - down) * np.clip(line.values, 0.0, top) / top
            places = np.stack([columns, rows], 1) * 16.0
            for part in np.split(np.arange(len(places)), np.flatnonzero(~known)):
                chosen = part[known[part]]
                if len(chosen) > 1:
                    points = np.rint(places[chosen]).astype(np.int32)
                    cv2.polylines(sheet, [points], False, line.colour, 2, cv2.LINE_AA, 4)
        sheet = with_label(sheet, title, (left, 2), height_px=17, paper=None, colour=INK)
        sheets.append(_legend(sheet, [(line.name, line.colour) for line in lines]))
    return np.concatenate(sheets)


def _step(end_s: float) -> float:
    return next((step for step in (1.0, 2.0, 5.0, 10.0, 30.0, 60.0) if end_s / step <= 14.0), 120.0)
