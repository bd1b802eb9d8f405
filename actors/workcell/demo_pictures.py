"""The pictures of a run, of the versions of its recording."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from actors.geometry.kinematics import capsules_at, end_velocities, tool_poses
from actors.geometry.picture import png_bytes
from actors.geometry.refinement import Refinement
from actors.geometry.separation import Separation
from actors.geometry.visibility import camera_table
from actors.geometry.visual_hull import VisualHull
from actors.geometry.voxels import VoxelBlocks
from actors.workcell import plots
from actors.workcell import vocabulary as words
from actors.workcell.evaluation import along
from actors.workcell.figures import hull_figure, masks_figure, world_figure
from actors.workcell.truth_of_run import PERIOD_NS, truth_of
from enact_dist.actor_check import declarations_of
from enact_dist.actor_graph import graph_of
from enact_dist.actor_graph_svg import svg_of
from enact_dist.config import load_config

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    import numpy.typing as npt

    from actors.workcell.demo_conduct import Notes
    from actors.workcell.trace import Kept, Trace
    from actors.workcell.truth_of_run import Truth
    from enact_dist import Aspect

    F64 = npt.NDArray[np.float64]
    Picture = npt.NDArray[np.uint8]


LEFT_NS: Final = 4 * PERIOD_NS
"""Of whom nothing newer is known, that person has left."""
WAY_NS: Final = 100 * PERIOD_NS
"""A plan shows the ways of people as long as this."""


def figure4(config: Path) -> bytes:
    """Draw the actors of a cell and the data that they declare to read and write, as SVG.

    Args:
        config: Its `cell.toml`.
    """
    parsed = load_config(config)
    actors, _ = declarations_of(parsed)
    return svg_of(graph_of(actors), f"cell {parsed.name}").encode()


def pictures_of(trace: Trace, notes: Notes) -> dict[str, bytes]:
    """Draw a run: its nearest approach, and its whole course.

    Args:
        trace: What was recorded.
        notes: With the stamp of the nearest approach.

    Returns:
        PNG by name of the file; pictures for which the run has no data are left out.
    """
    truth = truth_of(trace)
    hulls = {kept.stamp_ns: kept for kept in trace.of(words.WORKSPACE.name, words.HULL)}
    found = {"timeline.png": _timeline(trace, truth)}
    seen = [
        {kept.stamp_ns for kept in trace.of(camera, words.SILHOUETTE)}
        for camera in trace.entities(words.SILHOUETTE)
    ]
    whole = set.intersection(*seen) if seen else set()
    during = sorted(stamp for stamp in hulls if truth.covers(stamp) and stamp in whole)
    if during:
        stamp_ns = notes.nearest_ns
        if stamp_ns not in during:
            stamp_ns = min(during, key=lambda stamp: hulls[stamp].datum.nearest_m)
        found |= _moment(trace, truth, hulls, stamp_ns)
    return {name: png_bytes(picture) for name, picture in found.items()}


def _datum(trace: Trace, entity: str, aspect: Aspect[Any], stamp_ns: int, since_ns: int = 0) -> Any:
    """Return the newest datum of a slot from one stamp to another, or None."""
    before = [kept for kept in trace.of(entity, aspect) if since_ns <= kept.stamp_ns <= stamp_ns]
    return before[-1].datum if before else None


def _of_people(trace: Trace, aspect: Aspect[Any], stamp_ns: int) -> dict[str, Any]:
    """Return what was known at a stamp of people who had not left by then, by name."""
    found = {
        human: _datum(trace, human, aspect, stamp_ns, stamp_ns - LEFT_NS)
        for human in trace.entities(aspect)
    }
    return {human: datum for human, datum in found.items() if datum is not None}


def _masks(trace: Trace, stamp_ns: int) -> dict[str, words.Silhouette]:
    return {
        camera: kept.datum
        for camera in trace.entities(words.SILHOUETTE)
        for kept in trace.of(camera, words.SILHOUETTE)
        if kept.stamp_ns == stamp_ns
    }


def _moment(
    trace: Trace, truth: Truth, hulls: Mapping[int, Kept[words.Hull]], stamp_ns: int
) -> dict[str, Picture]:
    """Draw what was at one exposure."""
    grid = trace.newest(words.WORKSPACE.name, words.GRID)
    parts = [trace.newest(name, words.BOXES) for name in trace.entities(words.BOXES)]
    boxes = np.concatenate([np.empty((0, 15)), *parts])
    hull, last = hulls[stamp_ns].datum, hulls.get(stamp_ns - PERIOD_NS)
    before = last.datum if last is not None else None
    arm = capsules_at(truth.arm, trace.joints().at(stamp_ns))[0]
    limbs = _of_people(trace, words.LIMBS, stamp_ns).values()
    shown = np.concatenate([np.empty((0, 7)), *limbs])
    second = truth.at_s(stamp_ns)
    found = {
        "plan.png": _plan(trace, truth, (grid, boxes, hull, arm), stamp_ns),
        "figure1.png": world_figure(
            grid, boxes, arm, hull, shown, _properties(trace, stamp_ns, second)
        ),
    }
    masks = _masks(trace, stamp_ns)
    if masks:
        raw = _unrefined(trace, masks, arm)
        found["figure3_bottom.png"] = hull_figure(grid, boxes, arm, (raw, hull), before)
        found["figure3_top.png"] = masks_figure(masks, _masks(trace, stamp_ns - PERIOD_NS))
    return found


def _unrefined(trace: Trace, masks: dict[str, words.Silhouette], arm: F64) -> npt.NDArray[np.int16]:
    """Return the voxels (n, 3) of a set before the refinement, carved once more."""
    grid = trace.newest(words.WORKSPACE.name, words.GRID)
    boxes = [trace.newest(name, words.BOXES) for name in trace.entities(words.BOXES)]
    names = trace.entities(words.CALIBRATION)
    calibrations = [trace.newest(name, words.CALIBRATION) for name in names]
    blocks = VoxelBlocks(grid.origin_m, grid.voxel_m, grid.shape)
    tables = [camera_table(blocks, calibration, boxes) for calibration in calibrations]
    refinement = Refinement(VisualHull(blocks, tables), calibrations, boxes)
    seen = [masks[name] if name in masks and not masks[name].stand_in else None for name in names]
    found = refinement.step(
        [one.packed if one else None for one in seen],
        arm,
        math.inf,
        [one.shade if one else None for one in seen],
    )
    return blocks.indices(found.raw)


def _properties(trace: Trace, stamp_ns: int, second: float) -> list[str]:
    """Return the high-level properties of a moment, a line each."""
    lines = [f"second {second:.1f}"]
    speed = _datum(trace, words.ROBOT.name, words.SPEED, stamp_ns)
    safety = _datum(trace, words.SYSTEM.name, words.SAFETY, stamp_ns)
    path = _datum(trace, words.ROBOT.name, words.PATH, stamp_ns)
    if speed is not None:
        lines += [f"speed: {speed.scale:.0%} of nominal", f"nearest: {speed.nearest_m:.2f} m"]
    if safety is not None:
        lines.append(f"safety: {safety.state}")
    if path is not None:
        lines.append(f"path {path.number}: {len(path.waypoints)} points to goal {path.to_goal}")
    for human, track in _of_people(trace, words.TRACK, stamp_ns).items():
        (x, y), fast = track.position_m[:2], float(np.linalg.norm(track.velocity_m_s))
        lines.append(f"{human}: at {x:.1f}, {y:.1f} m, {fast:.1f} m/s, {track.height_m:.2f} m")
    return lines


def _plan(
    trace: Trace, truth: Truth, scene: tuple[words.Grid, F64, words.Hull, F64], stamp_ns: int
) -> Picture:
    grid, boxes, hull, arm = scene
    path = _datum(trace, words.ROBOT.name, words.PATH, stamp_ns)
    tool = np.empty((0, 3))
    if path is not None and len(path.waypoints):
        tool = tool_poses(truth.arm, along(path.waypoints))[:, :3, 3]
    tracks = _of_people(trace, words.TRACK, stamp_ns)
    predictions = _of_people(trace, words.PREDICTION, stamp_ns)
    ways = [
        np.array([kept.datum.position_m[:2] for kept in trace.of(human, words.TRACK)
                  if 0 <= stamp_ns - kept.stamp_ns < WAY_NS])
        for human in tracks
    ]  # fmt: skip
    shown = plots.Plan(
        grid, boxes, hull, arm, tool, ways, [*tracks.values()], [*predictions.values()],
        truth.bodies_at(stamp_ns),
    )  # fmt: skip
    return plots.plan_figure(shown, f"second {truth.at_s(stamp_ns):.1f}")


def _timeline(trace: Trace, truth: Truth) -> Picture:
    """Draw distance and speed over the whole run."""
    motion = trace.joints()
    chosen = np.array([truth.covers(int(stamp)) for stamp in motion.stamp_ns], np.bool_)
    stamps, q, dq = motion.stamp_ns[chosen][::5], motion.q[chosen][::5], motion.dq[chosen][::5]
    at_s = (stamps - truth.start_ns) / 1e9
    true_m = np.array([truth.distance_m(int(s), one) for s, one in zip(stamps, q, strict=True)])
    fast = np.empty(0)
    if len(q):
        fast = np.linalg.norm(end_velocities(truth.arm, q, dq), axis=-1).max((1, 2))
    spent = Separation(reaction_s=0.0)
    limit = np.array([spent.speed_max_m_s(float(one)) for one in true_m])
    speeds = [
        kept for kept in trace.of(words.ROBOT.name, words.SPEED) if truth.covers(kept.stamp_ns)
    ]
    seen_s = np.array([truth.at_s(kept.stamp_ns) for kept in speeds])
    top = math.ceil(12.0 * float(fast.max(initial=0.5))) / 10.0
    return plots.timeline(
        [
            (
                "distance of the nearest to the arm, m",
                3.0,
                [
                    plots.Line("true", at_s, np.where(true_m < 3.0, true_m, np.nan), plots.TRUE),
                    plots.Line(
                        "estimated",
                        seen_s,
                        np.array([k.datum.nearest_m for k in speeds]),
                        plots.ARM,
                    ),
                ],
            ),
            (
                "speed of the quickest point, m/s",
                top,
                [
                    plots.Line("allowed for the true distance", at_s, limit, plots.TRUE),
                    plots.Line(
                        "commanded limit",
                        seen_s,
                        np.array([k.datum.limit_m_s for k in speeds]),
                        plots.ARM,
                    ),
                    plots.Line("actual", at_s, fast, plots.TRACK),
                ],
            ),
        ]
    )
