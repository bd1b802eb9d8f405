"""Plots of a run: the cell from above, and distance and speed over time."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from actors.geometry.arms.kinematics import capsules_at, tool_poses
from actors.geometry.pictures.picture import INK, with_label
from actors.workcell import vocabulary as words
from actors.workcell.scores.evaluation import along
from actors.workcell.scores.truth_of_run import allowed_m_s, course_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy.typing as npt

    from actors.workcell.scores.trace import Trace
    from actors.workcell.scores.truth_of_run import Truth
    from actors.workcell.vocabulary import Hull

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
LEGEND: Final = (
    ("hull", OCCUPIED), ("arm", ARM), ("track, 0.5 s", TRACK), ("prediction", AHEAD),
    ("truth", TRUE), ("path", PATH),
)  # fmt: skip
WAY_NS: Final = 10_000_000_000
"""The plan shows the ways of people as long as this."""


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


def plan_figure(trace: Trace, truth: Truth, hull: Hull, stamp_ns: int) -> Picture:
    """Show the cell from above: hull, arm, tracks, predictions, path, and the truth as outlines."""
    import cv2

    sheet = np.full((PLAN_PX, PLAN_PX, 3), 252, np.uint8)
    grid = trace.newest(words.WORKSPACE.name, words.GRID)
    low = grid.origin_m[:2]
    size = np.array(grid.shape[:2]) * grid.voxel_m
    cv2.rectangle(sheet, _at(low), _at(low + size), GREY, 2)
    for box in trace.boxes():
        turn = box[6:].reshape(3, 3)[:2, :2]
        rim = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * box[3:5]
        cv2.fillConvexPoly(sheet, _px(box[:2] + rim @ turn.T), GREY, cv2.LINE_AA)
    for corner in low + np.unique(hull.voxels[:, :2], axis=0) * grid.voxel_m:
        cv2.rectangle(sheet, _at(corner), _at(corner + grid.voxel_m), OCCUPIED, cv2.FILLED)
    for capsule in capsules_at(truth.arm, trace.joints().at(stamp_ns))[0]:
        ends, thick = (_at(capsule[:3]), _at(capsule[3:6])), 2 * _length(capsule[6])
        cv2.line(sheet, *ends, ARM, thick, cv2.LINE_AA)
    for capsule in (capsule for body in truth.bodies_at(stamp_ns) for capsule in body):
        for end in (capsule[:2], capsule[3:5]):
            cv2.circle(sheet, _at(end), _length(capsule[6]), TRUE, 1, cv2.LINE_AA)
    tracks = trace.people_at(words.TRACK, stamp_ns)
    for human, track in tracks.items():
        past = [  # another person may have had the name before
            kept.datum.position_m[:2]
            for kept in trace.of(human, words.TRACK)
            if 0 <= stamp_ns - kept.stamp_ns < WAY_NS and kept.datum.first_ns == track.first_ns
        ]
        cv2.polylines(sheet, [_px(np.array(past))], False, TRACK, 2, cv2.LINE_AA)
    for prediction in trace.people_at(words.PREDICTION, stamp_ns).values():
        for centre, radius in zip(prediction.centre_m, prediction.radius_m, strict=True):
            cv2.circle(sheet, _at(centre), _length(radius), AHEAD, 1, cv2.LINE_AA)
    for track in tracks.values():
        here, ahead = track.position_m[:2], track.velocity_m_s[:2] * 0.5
        cv2.circle(sheet, _at(here), 7, TRACK, cv2.FILLED, cv2.LINE_AA)
        cv2.arrowedLine(sheet, _at(here), _at(here + ahead), TRACK, 2, cv2.LINE_AA)
    path = trace.at(words.ROBOT.name, words.PATH, stamp_ns)
    if path is not None and len(path.waypoints):
        tool = tool_poses(truth.arm, along(path.waypoints))[:, :2, 3]
        cv2.polylines(sheet, [_px(tool)], False, PATH, 3, cv2.LINE_AA)
    sheet = with_label(sheet, f"second {truth.at_s(stamp_ns):.1f}", (12, 10), height_px=20)
    return _legend(sheet, LEGEND)


def _px(points_m: F64) -> npt.NDArray[np.int32]:
    """Return pixels, x to the right, y up."""
    points = np.asarray(points_m, np.float64)[..., :2]
    place = (points * np.array([1.0, -1.0]) + PLAN_M) / (2.0 * PLAN_M) * PLAN_PX
    return np.asarray(np.rint(place), np.int32)


def _at(point_m: F64) -> tuple[int, int]:
    x, y = _px(point_m).tolist()
    return x, y


def _length(metres: float) -> int:
    return max(1, round(float(metres) / (2.0 * PLAN_M) * PLAN_PX))


def _legend(sheet: Picture, entries: Sequence[tuple[str, tuple[int, int, int]]]) -> Picture:
    import cv2

    left = 16
    for name, colour in entries:
        top = sheet.shape[0] - 30
        cv2.rectangle(sheet, (left, top + 5), (left + 14, top + 17), colour, cv2.FILLED)
        sheet = with_label(sheet, name, (left + 18, top - 2), height_px=16, paper=None)
        left += 40 + 10 * len(name)
    return sheet


def timeline_figure(trace: Trace, truth: Truth) -> Picture:
    """Draw distance and speed over the whole run."""
    course = course_of(trace, truth, every=5)
    at_s = (course.stamp_ns - truth.start_ns) / 1e9
    true_m, fast = course.distance_m, course.fastest_m_s
    speeds = [
        kept for kept in trace.of(words.ROBOT.name, words.SPEED) if truth.covers(kept.stamp_ns)
    ]
    seen_s = np.array([truth.at_s(kept.stamp_ns) for kept in speeds])
    seen_m = np.array([kept.datum.nearest_m for kept in speeds])
    told = np.array([kept.datum.limit_m_s for kept in speeds])
    distances = [
        Line("true", at_s, np.where(true_m < 3.0, true_m, np.nan), TRUE),
        Line("estimated", seen_s, seen_m, ARM),
    ]
    moved = [
        Line("allowed for the true distance", at_s, allowed_m_s(course), TRUE),
        Line("commanded limit", seen_s, told, ARM),
        Line("actual", at_s, fast, TRACK),
    ]
    top = math.ceil(12.0 * float(fast.max(initial=0.5))) / 10.0
    return timeline(
        [
            ("distance of the nearest to the arm, m", 3.0, distances),
            ("speed of the quickest point, m/s", top, moved),
        ]
    )


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
        left, right, up, down = 60, width - 16, 34, height - 54
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
