"""Pictures of a run: masks and hulls as in ENACT's Figure 3, Figure 1's panels; Figure 4.

All are drawn from the versions of its recording; but for Figure 4 they are RGB, uint8, (H, W, 3).
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from actors.geometry.arms.kinematics import capsules_at
from actors.geometry.hull.refinement import Refinement
from actors.geometry.hull.visibility import camera_table
from actors.geometry.hull.visual_hull import VisualHull
from actors.geometry.hull.voxels import VoxelBlocks
from actors.geometry.pictures.cloud_picture import draw_points
from actors.geometry.pictures.mesh_picture import viewpoint
from actors.geometry.pictures.picture import png_bytes, tiles, with_label
from actors.workcell import vocabulary as words
from actors.workcell.scores.plots import ARM, plan_figure, timeline_figure
from actors.workcell.scores.truth_of_run import truth_of
from actors.workcell.vocabulary import PERIOD_NS
from enact_dist.actor.check import declarations_of
from enact_dist.actor.graph import graph_of, svg_of
from enact_dist.config.read import load_config

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    import numpy.typing as npt

    from actors.workcell.scores.trace import Trace
    from actors.workcell.scores.truth_of_run import Truth
    from actors.workcell.vocabulary import Grid, Hull, Silhouette

    F64 = npt.NDArray[np.float64]
    Picture = npt.NDArray[np.uint8]
    Cloud = tuple[F64, npt.NDArray[np.uint8], float]

SAME: Final = (150, 156, 164)
"""What was there in the set before."""
CHANGED: Final = (226, 92, 40)
"""What was not."""
GONE: Final = (214, 178, 84)
"""What the refinement removed."""
CAPSULE_POINTS: Final = 1500
STEEL: Final = (196, 202, 210)
SKIN: Final = (92, 130, 196)
LIGHT: Final = np.array([0.45, -0.35, 0.82])
VIEW_PX: Final = (900, 660)
CORNERS: Final = np.array([[x, y, z] for x in (-1.5, 1.7) for y in (-1.6, 1.6) for z in (0.0, 1.7)])


def figure4(config: Path) -> bytes:
    """Draw the actors of a cell and the data that they declare to read and write, as SVG."""
    parsed = load_config(config)
    actors, _ = declarations_of(parsed)
    return svg_of(graph_of(actors), f"cell {parsed.name}").encode()


def pictures_of(trace: Trace, nearest_ns: int) -> dict[str, bytes]:
    """Draw a run: its nearest approach, and its whole course.

    Args:
        trace: What was recorded.
        nearest_ns: Stamp of the nearest approach; one that was not recorded whole is looked for.

    Returns:
        PNG by name of the file; pictures for which the run has no data are left out.
    """
    truth = truth_of(trace)
    found = {"timeline.png": timeline_figure(trace, truth)}
    seen = [
        {kept.stamp_ns for kept in trace.of(camera, words.SILHOUETTE)}
        for camera in trace.entities(words.SILHOUETTE)
    ]
    whole = set.intersection(*seen) if seen else set()
    during = {
        kept.stamp_ns: kept
        for kept in trace.of(words.WORKSPACE.name, words.HULL)
        if truth.covers(kept.stamp_ns) and kept.stamp_ns in whole
    }
    if during:
        stamp_ns = nearest_ns
        if stamp_ns not in during:
            stamp_ns = min(during, key=lambda stamp: during[stamp].datum.nearest_m)
        found |= _moment(trace, truth, during[stamp_ns].datum, stamp_ns)
    return {name: png_bytes(picture) for name, picture in found.items()}


def _moment(trace: Trace, truth: Truth, hull: Hull, stamp_ns: int) -> dict[str, Picture]:
    """Draw what was at one exposure."""
    grid, boxes = trace.newest(words.WORKSPACE.name, words.GRID), trace.boxes()
    arm = capsules_at(truth.arm, trace.joints().at(stamp_ns))[0]
    limbs = [np.empty((0, 7)), *trace.people_at(words.LIMBS, stamp_ns).values()]
    lines = _properties(trace, stamp_ns, truth.at_s(stamp_ns))
    masks, old_masks = (_masks(trace, stamp) for stamp in (stamp_ns, stamp_ns - PERIOD_NS))
    hulls = trace.of(words.WORKSPACE.name, words.HULL)
    old = [kept.datum for kept in hulls if kept.stamp_ns == stamp_ns - PERIOD_NS]
    raw = _unrefined(trace, grid, masks, arm)
    return {
        "plan.png": plan_figure(trace, truth, hull, stamp_ns),
        "figure1.png": world_figure(grid, boxes, arm, hull, np.concatenate(limbs), lines),
        "figure3_bottom.png": hull_figure(grid, boxes, arm, (raw, hull), old[0] if old else None),
        "figure3_top.png": masks_figure(masks, old_masks),
    }


def _masks(trace: Trace, stamp_ns: int) -> dict[str, Silhouette]:
    return {
        camera: kept.datum
        for camera in trace.entities(words.SILHOUETTE)
        for kept in trace.of(camera, words.SILHOUETTE)
        if kept.stamp_ns == stamp_ns
    }


def _unrefined(
    trace: Trace, grid: Grid, masks: dict[str, Silhouette], arm: F64
) -> npt.NDArray[np.int16]:
    """Return the voxels (n, 3) of a set before the refinement, carved once more."""
    boxes, names = [trace.boxes()], trace.entities(words.CALIBRATION)
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
    speed = trace.at(words.ROBOT.name, words.SPEED, stamp_ns)
    safety = trace.at(words.SYSTEM.name, words.SAFETY, stamp_ns)
    path = trace.at(words.ROBOT.name, words.PATH, stamp_ns)
    if speed is not None:
        lines += [f"speed: {speed.scale:.0%} of nominal", f"nearest: {speed.nearest_m:.2f} m"]
    if safety is not None:
        lines.append(f"safety: {safety.state}")
    if path is not None:
        lines.append(f"path {path.number}: {len(path.waypoints)} points to goal {path.to_goal}")
    for human, track in trace.people_at(words.TRACK, stamp_ns).items():
        (x, y), fast = track.position_m[:2], float(np.linalg.norm(track.velocity_m_s))
        lines.append(f"{human}: at {x:.1f}, {y:.1f} m, {fast:.1f} m/s, {track.height_m:.2f} m")
    return lines


def unpacked(mask: Silhouette) -> npt.NDArray[np.bool_]:
    """Return a silhouette as (H, W) bool."""
    return np.unpackbits(mask.packed, axis=1).astype(np.bool_)


def masks_figure(now: Mapping[str, Silhouette], before: Mapping[str, Silhouette]) -> Picture:
    """Show the masks of one set as in Figure 3, top: only changed pixels are coloured.

    Args:
        now: By name of the camera.
        before: The set before; a camera that is missing there has changed as a whole.
    """
    pictures, captions = [], []
    for name in sorted(now):
        mask = unpacked(now[name])
        old = unpacked(before[name]) if name in before else np.zeros_like(mask)
        picture = np.full((*mask.shape, 3), 252, np.uint8)
        picture[mask & old] = SAME
        picture[mask & ~old] = CHANGED
        pictures.append(np.ascontiguousarray(picture[::2, ::2]))
        captions.append(f"{name}{' (stand-in)' if now[name].stand_in else ''}")
    return tiles(pictures, captions, columns=4)


def shaded(points_m: F64, normals: F64, colour: Sequence[int], size_m: float = 0.017) -> Cloud:
    """Return points with a colour that is lit from one side, and the edge of their squares."""
    light = 0.62 + 0.38 * np.clip(normals @ LIGHT, -0.4, 1.0)
    return points_m, np.clip(light[:, None] * np.array(colour), 0, 255).astype(np.uint8), size_m


def box_points(boxes: F64, colour: Sequence[int] = STEEL, step_m: float = 0.012) -> Cloud:
    """Return points on the faces of boxes.

    Args:
        boxes: (n, 15): centre, half sizes, rotation row by row.
        colour: RGB.
        step_m: Distance of the points.
    """
    points, normals = [np.empty((0, 3))], [np.empty((0, 3))]
    for box in boxes:
        centre, half, turn = box[:3], box[3:6], box[6:].reshape(3, 3)
        for axis in range(3):
            others = [other for other in range(3) if other != axis]
            sides = [np.arange(-half[other], half[other] + step_m, step_m) for other in others]
            face = np.stack(np.meshgrid(*sides, indexing="ij"), -1).reshape(-1, 2)
            for sign in (-1.0, 1.0):
                local = np.empty((len(face), 3))
                local[:, others], local[:, axis] = face, sign * half[axis]
                points.append(centre + local @ turn.T)
                normals.append(np.tile(sign * turn[:, axis], (len(face), 1)))
    return shaded(np.concatenate(points), np.concatenate(normals), colour, 1.4 * step_m)


def capsule_points(capsules: F64, colour: Sequence[int]) -> Cloud:
    """Return points on the surfaces of capsules, spread evenly.

    Args:
        capsules: (n, 7).
        colour: RGB.
    """
    number = np.arange(CAPSULE_POINTS) + 0.5
    up, turn = 1.0 - 2.0 * number / CAPSULE_POINTS, number * math.pi * (3.0 - math.sqrt(5.0))
    round_ = np.sqrt(1.0 - up * up)
    sphere = np.stack([round_ * np.cos(turn), round_ * np.sin(turn), up], 1)
    points, normals = [np.empty((0, 3))], [np.empty((0, 3))]
    for capsule in np.asarray(capsules, np.float64):
        one, other, radius = capsule[:3], capsule[3:6], capsule[6]
        axis = other - one
        length = float(np.linalg.norm(axis))
        ends = np.where((sphere @ axis)[:, None] > 0.0, other, one)
        points.append(ends + radius * sphere)
        normals.append(sphere)
        if length > 1e-6:
            across = np.linalg.svd(axis[None] / length)[2][1:]
            ring = np.cos(turn)[:, None] * across[0] + np.sin(turn)[:, None] * across[1]
            points.append(one + (number / CAPSULE_POINTS)[:, None] * axis + radius * ring)
            normals.append(ring)
    return shaded(np.concatenate(points), np.concatenate(normals), colour)


def voxel_points(grid: Grid, voxels: npt.NDArray[np.integer], colours: npt.NDArray[Any]) -> Cloud:
    """Return points on the visible faces of voxels: those with no neighbour, lit by their side.

    Args:
        grid: The grid.
        voxels: (N, 3), indices.
        colours: RGB, (N, 3) or (3,).
    """
    if not len(voxels):
        return np.empty((0, 3)), np.empty((0, 3), np.uint8), grid.voxel_m
    index = np.asarray(voxels, np.int64)
    taken = np.zeros(np.array(grid.shape) + 2, np.bool_)
    taken[tuple((index + 1).T)] = True
    colours = np.broadcast_to(np.asarray(colours), (len(index), 3))
    points, tones = [], []
    for axis in range(3):
        for sign in (-1, 1):
            step = np.zeros(3, np.int64)
            step[axis] = sign
            bare = ~taken[tuple((index + 1 + step).T)]
            centre = grid.origin_m + (index[bare] + 0.5 + 0.5 * step) * grid.voxel_m
            light = 0.62 + 0.38 * np.clip(float(step @ LIGHT), -0.4, 1.0)
            points.append(centre)
            tones.append(np.clip(colours[bare] * light, 0, 255))
    return np.concatenate(points), np.concatenate(tones).astype(np.uint8), 1.2 * grid.voxel_m


def scene_picture(clouds: Sequence[Cloud], *, size_px: tuple[int, int] = VIEW_PX) -> Picture:
    """Draw clouds of points as one scene from above at an angle."""
    view = viewpoint(CORNERS, azimuth_deg=-52.0, elevation_deg=34.0, size_px=size_px)
    points, colours = (np.concatenate([cloud[part] for cloud in clouds]) for part in (0, 1))
    sizes = np.concatenate([np.full(len(cloud[0]), cloud[2]) for cloud in clouds])
    return draw_points(points, colours.astype(np.uint8), view, size_m=sizes)


def hull_figure(
    grid: Grid,
    boxes: F64,
    arm: F64,
    hulls: tuple[npt.NDArray[np.integer], Hull],
    before: Hull | None,
) -> Picture:
    """Show the hull before and after refinement over the scene, as in Figure 3, bottom.

    Args:
        grid: The grid.
        boxes: (n, 15), static obstacles.
        arm: (k, 7), the arm at the exposure.
        hulls: Voxels before the refinement, (N, 3), and the hull after it.
        before: The hull of the previous set: only changes are coloured.
    """
    raw, hull = hulls
    shape = grid.shape
    old = _numbers(before.voxels, shape) if before is not None else np.empty(0, np.int64)
    kept, mine = _numbers(hull.voxels, shape), _numbers(raw, shape)
    left = np.where(np.isin(mine, kept)[:, None], SAME, GONE)
    right = np.where(np.isin(kept, old)[:, None], SAME, CHANGED)
    room = box_points(boxes)
    pictures = [
        scene_picture([room, voxel_points(grid, raw, left)]),
        scene_picture([room, capsule_points(arm, ARM), voxel_points(grid, hull.voxels, right)]),
    ]
    ruled = [f"{count:,} {rule}" for rule, count in hull.counts.items() if count and rule != "raw"]
    for row, text in enumerate(ruled):
        pictures[1] = with_label(pictures[1], text, (10, 10 + 22 * row), height_px=16)
    captions = [
        f"before refinement: {len(raw):,} voxels (yellow: removed)",
        f"after: {len(hull.voxels):,} (red: new); voxels of each rule below",
    ]
    return tiles(pictures, captions)


def _numbers(voxels: npt.NDArray[np.integer], shape: tuple[int, int, int]) -> npt.NDArray[np.int64]:
    if not len(voxels):
        return np.empty(0, np.int64)
    return np.asarray(np.ravel_multi_index(tuple(np.asarray(voxels, np.int64).T), shape))


def world_figure(
    grid: Grid, boxes: F64, arm: F64, hull: Hull, limbs: F64, lines: Sequence[str]
) -> Picture:
    """Show one world context at one stamp in four panels, as Figure 1 does.

    Args:
        grid: The grid.
        boxes: (n, 15), static obstacles.
        arm: (k, 7), the arm.
        hull: Occupied voxels.
        limbs: (n, 7), capsules of people's limbs.
        lines: High-level properties, one per line.
    """
    room, size = box_points(boxes), (640, 470)
    sheet = np.full((size[1], size[0], 3), 248, np.uint8)
    for number, line in enumerate(lines):
        sheet = with_label(sheet, line, (24, 22 + 34 * number), height_px=18, paper=None)
    floor = box_points(
        np.array([[0, 0, -0.01, 2.0, 2.0, 0.005, *np.eye(3).ravel()]]), (232, 234, 237), 0.03
    )
    pictures = [
        scene_picture([floor, capsule_points(limbs, SKIN)], size_px=size),
        scene_picture([floor, voxel_points(grid, hull.voxels, np.array(SAME))], size_px=size),
        scene_picture([room, capsule_points(arm, ARM)], size_px=size),
        sheet,
    ]
    return tiles(pictures, ["limbs", "voxels", "models", "properties"])
