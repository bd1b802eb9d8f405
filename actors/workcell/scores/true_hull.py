"""The hull that a perfect eye would see: the voxels of true bodies, and their true distances."""

from __future__ import annotations

import itertools
import math
from typing import TYPE_CHECKING

import numpy as np

from actors.geometry.arms.kinematics import capsules_at
from actors.geometry.capsules import distance_between, distance_to_points
from actors.workcell.setup import task_of
from actors.workcell.simulation.arm import HOME_RAD
from actors.workcell.simulation.room import Box, boxes_of
from actors.workcell.simulation.stage import Stage
from actors.workcell.vocabulary import Hull

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy.typing as npt

    from actors.workcell.scenarios import Scenario
    from actors.workcell.vocabulary import ArmModel, Grid

    F64 = npt.NDArray[np.float64]

_PLACES = 40
"""Places of the arm between two goals that make the room that a task sweeps."""


class TrueVoxels:
    """The voxels of the grid in which there can be a person, and whether they count.

    Args:
        grid: The voxels.
        boxes: Static obstacles, (n, 15) each.
    """

    def __init__(self, grid: Grid, boxes: Sequence[F64]) -> None:
        self.origin_m, self.voxel_m = grid.origin_m, grid.voxel_m
        self.shape = grid.shape
        self.boxes = [rows.reshape(-1, 15) for rows in boxes]

    def centres(self, index: npt.NDArray[np.integer]) -> F64:
        """Return the centres of voxels, (n, 3), metres."""
        return np.asarray(self.origin_m + (index + 0.5) * self.voxel_m)

    def of(self, body: F64) -> npt.NDArray[np.int64]:
        """Return the voxels (n, 3) whose centres lie in a body and in no static obstacle."""
        ends, radius = body[:, :6].reshape(-1, 2, 3), body[:, 6:]
        low = ((ends.min(1) - radius).min(0) - self.origin_m) / self.voxel_m
        high = ((ends.max(1) + radius).max(0) - self.origin_m) / self.voxel_m
        first = np.clip(np.floor(low).astype(int), 0, self.shape)
        last = np.clip(np.ceil(high).astype(int) + 1, 0, self.shape)
        axes = [np.arange(one, other) for one, other in zip(first, last, strict=True)]
        index = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
        if not len(index):
            return index
        index = index[distance_to_points(body, self.centres(index)) <= 0.0]
        return index[~self.static(self.centres(index))]

    def static(self, points_m: F64) -> npt.NDArray[np.bool_]:
        """Say which points lie in a static obstacle, or within one and a half voxels of it."""
        inside = np.zeros(len(points_m), np.bool_)
        for box in (row for rows in self.boxes for row in rows):
            local = (points_m - box[:3]) @ box[6:].reshape(3, 3)
            inside |= (np.abs(local) <= box[3:6] + 1.5 * self.voxel_m).all(1)
        return inside

    def number(self, index: npt.NDArray[np.integer]) -> npt.NDArray[np.int64]:
        """Return one number per voxel."""
        return np.asarray(np.ravel_multi_index(tuple(index.T.astype(np.int64)), self.shape))


class TrueHull:
    """What an oracle and a fixed zone go by."""

    def __init__(self, scenario: Scenario, grid: Grid, arm: ArmModel) -> None:
        self._stage, self._arm = Stage(scenario), arm
        self._voxels = TrueVoxels(grid, [box.row() for box in boxes_of(scenario)])
        goals = [np.array(HOME_RAD), *task_of().goals]
        share = np.linspace(0.0, 1.0, _PLACES)[:, None]
        states = [one + share * (other - one) for one, other in itertools.pairwise(goals)]
        self._swept = capsules_at(arm, np.concatenate(states)).reshape(-1, 7)

    def hull_at(self, at_s: float, q_rad: F64) -> Hull:
        """Return the true bodies as a hull, with the true distance to the arm."""
        arm = capsules_at(self._arm, q_rad)[0]
        things = [capsules_in(box) for box in self._stage.things_at(at_s)]
        bodies = [*self._stage.bodies_at(at_s).values(), *things]
        parts = [self._voxels.of(body) for body in bodies]
        count = [np.full(len(part), number, np.int16) for number, part in enumerate(parts)]
        index = np.concatenate([np.empty((0, 3), np.int64), *parts])
        clearance = distance_to_points(arm, self._voxels.centres(index))
        nearest = min((distance_between(arm, body) for body in bodies), default=math.inf)
        component = np.concatenate([np.empty(0, np.int16), *count])
        return _hull(index, clearance, component, nearest)

    def zone_at(self, at_s: float, radius_m: float) -> Hull:
        """Return an empty hull: infinitely far, or at distance 0 while a person is in the zone.

        Args:
            at_s: Time of the scenario.
            radius_m: How far the zone reaches beyond all places of the task.
        """
        bodies = self._stage.bodies_at(at_s).values()
        inside = any(distance_between(self._swept, body) <= radius_m for body in bodies)
        none = np.empty(0, np.int16)
        return _hull(np.empty((0, 3)), none, none, 0.0 if inside else math.inf)


def _hull(
    index: npt.NDArray[np.generic],
    clearance: npt.NDArray[np.generic],
    component: npt.NDArray[np.int16],
    nearest_m: float,
) -> Hull:
    return Hull(
        voxels=index.astype(np.int16),
        clearance_m=clearance.astype(np.float32),
        tight=np.ones(len(index), np.bool_),
        component=component,
        counts={},
        cameras=(),
        nearest_m=nearest_m,
        nearest_voxel=int(clearance.argmin()) if len(index) else -1,
    )


def capsules_in(box: Box) -> F64:
    """Return capsules that fill a box, (n, 7)."""
    step = 0.05
    axes = [
        np.linspace(m - h + step, m + h - step, max(2, math.ceil(2 * h / step)))
        for m, h in zip(box.centre_m, box.half_m, strict=True)
    ]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    return np.concatenate([points, points, np.full((len(points), 1), step)], 1)
