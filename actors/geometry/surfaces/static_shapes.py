"""Static obstacles of an empty cell, from depth images: surfaces, and boxes that fill them.

Points above the floor that lie close together are one thing.  What is below its points, between
them on three sides or four, behind them in some images, and was looked through in none, is solid:
so look into everything that is hollow.  Boxes are laid into what is solid, the largest first, and
their faces moved to where the points are.

Rules a change must keep: boxes must not extend beyond the points of an object, since people are not
searched for inside them; the cell's frame has z = 0 on the floor.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from actors.geometry.poses import inverse, moved
from actors.geometry.shapes import PointCloud, Surface
from actors.geometry.surfaces.depth import frame_points, metres, spread_m
from actors.geometry.surfaces.depth_reconstruction import reconstruct_view
from actors.geometry.surfaces.fusion import fuse_views

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy.typing as npt

    from actors.geometry.shapes import DepthFrame

    Numbers = npt.NDArray[np.float64]
    Flags = npt.NDArray[np.bool_]

FLOOR_M: Final = 0.03
"""What is lower belongs to the floor."""
CLUSTER_M: Final = 0.05
"""Points of one thing are in neighbouring cubes of this edge."""
HITS_MIN: Final = 4
"""So many points make a cube one with something in it."""
POINTS_MIN: Final = 400
"""A thing has at least so many points; a hand's width of a pole has."""
CUBE_M: Final = 0.025
"""Edge of the cubes in which what is solid is looked for."""
BEHIND_SPREADS: Final = 3.0
"""A cube is seen through if the measurement lies so many pixel spreads behind all of it."""
HIDDEN_MIN: Final = 2
"""A solid cube lies behind the measurement in at least so many images."""
SIDES_MIN: Final = 3
"""Of the four sides of what is solid so many have points; another thing may hide one."""
FAR_M: Final = 3.0
"""What was measured from further away is too uncertain to be a point of a thing."""
SOLID_SHARE: Final = 0.9
"""A box grows by a layer of cubes if this share of them is solid."""
BOXES_MAX: Final = 12
LEFT_SHARE: Final = 0.03
"""No more boxes are added once only this share of the solid cubes is uncovered."""
SNAP_CUBES: Final = 1.6
"""Points that are this near to a face of a box tell where it is."""
VIEW_POINTS_MIN: Final = 1000
"""A view that shows less of a thing adds nothing to its surface."""
VIEWS_MAX: Final = 12
"""So many views of a thing are fused, those that show most of it."""
SNAP_POINTS: Final = 40
UPRIGHT_RAD: Final = np.deg2rad(2.0)
"""A thing that is turned by less is taken to stand parallel to the cell."""


@dataclass(frozen=True, slots=True, eq=False)
class StaticShape:
    """One thing.

    Attributes:
        surface: Its boundary, in the cell.
        boxes: (n, 15) float64: centre (3), half sizes (3), rotation row by row (9), cell.
    """

    surface: Surface
    boxes: Numbers


def static_shapes(
    frames: Sequence[DepthFrame],
    low_m: Numbers,
    high_m: Numbers,
    *,
    voxel_m: float = 0.015,
) -> list[StaticShape]:
    """Return the obstacles of a cell, the largest first.

    Args:
        frames: Depth images of the empty cell; poses are in the cell.
        low_m: (3,) lowest corner of where to look.
        high_m: (3,) highest corner.
        voxel_m: Grid of the fusion.

    Raises:
        ValueError: No image, nothing in them above the floor, or a thing of walls so thin that no
            box fits into them.
    """
    if not frames:
        raise ValueError("scan: asked for depth images of the empty cell, found none")
    low = np.maximum(low_m, (-np.inf, -np.inf, FLOOR_M))
    points = np.concatenate([_points(frame, low, high_m) for frame in frames]).astype(np.float64)
    things = _things(points)
    if not things:
        raise ValueError(
            f"scan: asked for something above the floor, found {len(points)} points in"
            f" {len(frames)} images between {low_m} and {high_m}"
        )
    found = []
    for thing in things:
        boxes = _boxes(thing, frames)
        surface = _surface(thing, frames, voxel_m)
        if not len(boxes) or not len(surface.triangles):
            at = np.round(np.median(thing, axis=0), 2).tolist()
            raise ValueError(
                f"scan: asked for things that boxes fill, found {len(thing)} points around {at} m"
                " with next to nothing solid between them; scan it from more sides, or write its"
                " boxes by hand"
            )
        found.append(StaticShape(surface, boxes))
    return found


def _points(frame: DepthFrame, low: Numbers, high: Numbers) -> npt.NDArray[np.floating]:
    """Return the points of an image within a box, without those from far away, (N, 3)."""
    points_m = frame_points(frame)[frame.depth_mm < 1e3 * FAR_M]
    with np.errstate(invalid="ignore"):
        inside = ((points_m > low) & (points_m < high)).all(1)
    return np.asarray(points_m[inside])


def _things(points_m: Numbers) -> list[Numbers]:
    """Return the points of each thing, that with the most first."""
    from scipy.ndimage import label

    if not len(points_m):
        return []
    corner = points_m.min(0)
    cubes = np.floor((points_m - corner) / CLUSTER_M).astype(np.int64)
    count = np.zeros(cubes.max(0) + 1, np.int32)
    np.add.at(count, tuple(cubes.T), 1)
    labels, _ = label(count >= HITS_MIN, np.ones((3, 3, 3)))
    of_point = labels[tuple(cubes.T)]
    sizes = np.bincount(of_point)
    sizes[0] = 0
    order = np.argsort(sizes)[::-1]
    return [points_m[of_point == number] for number in order if sizes[number] >= POINTS_MIN]


# ---------------------------------------------------------------- boxes


def _boxes(points_m: Numbers, frames: Sequence[DepthFrame]) -> Numbers:
    """Return the boxes (n, 15) that fill a thing."""
    turn = _turn(points_m)
    local = points_m @ turn  # coordinates along the thing's own axes
    low, high = np.quantile(local, 0.002, axis=0), np.quantile(local, 0.998, axis=0)
    low[2] = 0.0
    counts = np.maximum(1, np.ceil((high - low) / CUBE_M).astype(np.int64))
    solid = _hidden(low, counts, turn, frames) & _enclosed(local, low, counts)
    rows: list[Numbers] = []
    total = left = int(solid.sum())
    while left > LEFT_SHARE * total and len(rows) < BOXES_MAX:
        first, last = _largest(solid)
        if (last - first).min() < 1:
            break
        inner = tuple(slice(a, b) for a, b in zip(first, last, strict=True))
        solid[inner] = False
        before, left = left, int(solid.sum())
        if before - left < LEFT_SHARE * total:
            break
        box_low, box_high = _snapped(local, low + CUBE_M * first, low + CUBE_M * last)
        centre, half = 0.5 * (box_low + box_high), 0.5 * (box_high - box_low)
        rows.append(np.concatenate((turn @ centre, half, turn.ravel())))
    return np.array(rows).reshape(-1, 15)


def _turn(points_m: Numbers) -> Numbers:
    """Return the rotation (3, 3) about z whose columns are the axes of a thing."""
    import cv2

    flat = np.asarray(points_m[:, :2], np.float32)
    (_, _), _, degrees = cv2.minAreaRect(flat)
    angle = float(np.deg2rad(degrees)) % (np.pi / 2.0)
    angle -= np.pi / 2.0 * (angle > np.pi / 4.0)
    if abs(angle) < UPRIGHT_RAD:
        angle = 0.0
    cos, sin = np.cos(angle), np.sin(angle)
    return np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])


def _hidden(
    low: Numbers, counts: npt.NDArray[np.int64], turn: Numbers, frames: Sequence[DepthFrame]
) -> Flags:
    """Return which cubes of a grid lie behind measurements and were never seen through."""
    axes = [low[axis] + CUBE_M * (np.arange(counts[axis]) + 0.5) for axis in range(3)]
    local = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    centres = local @ turn.T
    left, behind = np.arange(len(centres)), np.zeros(len(centres), np.int32)
    reach_m = 0.5 * np.sqrt(3.0) * CUBE_M
    for frame in frames:
        camera = frame.acquisition.camera
        seen = moved(centres[left], inverse(frame.acquisition.world_from_camera))
        ahead = seen[:, 2] > 0.1
        depth = np.where(ahead, seen[:, 2], 1.0)
        u, v = np.rint(camera.column_row(seen[:, 0], seen[:, 1], depth))
        good = ahead & (u >= 0) & (v >= 0) & (u < camera.width_px) & (v < camera.height_px)
        row, column = (np.where(good, axis, 0).astype(np.int64) for axis in (v, u))
        measured = np.where(good, metres(frame.depth_mm)[row, column], np.nan)
        with np.errstate(invalid="ignore"):
            behind[left] += measured < depth
            through = measured > depth + reach_m + BEHIND_SPREADS * spread_m(measured)
        left = left[~through]
    solid = np.zeros(len(centres), bool)
    solid[left] = behind[left] >= HIDDEN_MIN
    return solid.reshape(tuple(counts))


def _enclosed(local_m: Numbers, low: Numbers, counts: npt.NDArray[np.int64]) -> Flags:
    """Return which cubes have points above them, and on three of their sides or on all four."""
    at = np.floor((local_m - low) / CUBE_M).astype(np.int64)
    at = at[((at >= 0) & (at < counts)).all(1)]
    hits = np.zeros(tuple(counts), np.int32)
    np.add.at(hits, tuple(at.T), 1)
    hit = hits > 1
    sides = np.zeros(tuple(counts), np.int8)
    for axis in range(2):
        sides += np.logical_or.accumulate(hit, axis)
        sides += np.flip(np.logical_or.accumulate(np.flip(hit, axis), axis), axis)
    above = np.flip(np.logical_or.accumulate(np.flip(hit, 2), 2), 2)
    return above & (sides >= SIDES_MIN)


def _largest(solid: Flags) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Return a large box of solid cubes: its first and its last index, that one excluded.

    It grows from the cube that lies deepest, each time by the side with the most solid cubes.
    """
    from scipy.ndimage import distance_transform_cdt

    depth = distance_transform_cdt(np.pad(solid, 1), "chessboard")[1:-1, 1:-1, 1:-1]
    seed = np.array(np.unravel_index(int(np.argmax(depth)), solid.shape))
    first, last = seed.copy(), seed + 1
    if not solid[tuple(seed)]:
        return first, first
    while True:
        best, way = 0, None
        for axis in range(3):
            for up in (False, True):
                edge = last[axis] if up else first[axis] - 1
                if not 0 <= edge < solid.shape[axis]:
                    continue
                window = [slice(a, b) for a, b in zip(first, last, strict=True)]
                window[axis] = slice(edge, edge + 1)
                layer = solid[tuple(window)]
                count = int(np.count_nonzero(layer))
                if count >= SOLID_SHARE * layer.size and count > best:
                    best, way = count, (axis, up)
        if way is None:
            return first, last
        axis, up = way
        if up:
            last[axis] += 1
        else:
            first[axis] -= 1


def _snapped(points_m: Numbers, low: Numbers, high: Numbers) -> tuple[Numbers, Numbers]:
    """Return a box with its faces where the points near them are; its foot stays on the floor."""
    box = [low.copy(), high.copy()]
    room = SNAP_CUBES * CUBE_M
    for axis in range(3):
        others = [one for one in range(3) if one != axis]
        shrunk = 0.1 * (high - low)[others]
        beside = (points_m[:, others] > low[others] + shrunk).all(1)
        beside &= (points_m[:, others] < high[others] - shrunk).all(1)
        for side in (0, 1):
            if axis == 2 and side == 0 and low[2] < room:
                box[0][2] = 0.0
                continue
            away = points_m[beside, axis] - (low, high)[side][axis]
            near = away[np.abs(away) < room]
            if len(near) >= SNAP_POINTS:
                box[side][axis] += float(np.median(near))
    return box[0], np.maximum(box[1], box[0] + 1e-3)


# ---------------------------------------------------------------- surfaces


def _surface(thing_m: Numbers, frames: Sequence[DepthFrame], voxel_m: float) -> Surface:
    """Return the fused surface of a thing, in the cell."""
    low, high = thing_m.min(0) - 2.0 * voxel_m, thing_m.max(0) + 2.0 * voxel_m
    low[2] = FLOOR_M
    shown = [(_points(one, low, high), one) for one in frames]
    shown = [pair for pair in shown if len(pair[0]) >= VIEW_POINTS_MIN]
    shown.sort(key=lambda pair: len(pair[0]), reverse=True)
    views, acquisitions = [], []
    for world, frame in shown[:VIEWS_MAX]:
        pose = inverse(frame.acquisition.world_from_camera)
        cloud = PointCloud(np.ascontiguousarray(moved(world, pose), np.float32))
        views.append(reconstruct_view(cloud, frame.acquisition.camera))
        acquisitions.append(frame.acquisition)
    if not views:
        return Surface.free_form(np.empty((0, 3)), np.empty((0, 3), np.int32))
    return fuse_views(views, acquisitions, voxel_m=voxel_m)
