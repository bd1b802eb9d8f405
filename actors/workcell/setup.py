"""The `Setup` actor: what is known of a cell before anything moves, written once.

Cameras with their calibrations, the grid, the arm, its task, boxes that a plan of the room knows.
Here it is that of the simulated room; a cell of one's own writes its own with an actor like this
one, from a program of your own or by hand with `enact world put`.
"""

from __future__ import annotations

import time
from typing import Final

import numpy as np

from actors.workcell.scenarios import DEFAULT, SECONDS, scenario_of
from actors.workcell.simulation.arm import ARM
from actors.workcell.simulation.room import boxes_of, cameras
from actors.workcell.vocabulary import (
    BOXES,
    CALIBRATION,
    CAMERA_COUNT,
    CAMERAS,
    EMPTY,
    GRID,
    MODEL,
    OBSTACLES,
    PERIOD_NS,
    PLAYING,
    ROBOT,
    SCENARIO,
    TASK,
    WORKSPACE,
    Grid,
    Playing,
    Task,
    camera_entity,
    obstacle_entity,
)
from enact_dist import Actor, Lock, World, Write, WriteEach

LOW_M: Final = (-2.0, -2.0, 0.0)
HIGH_M: Final = (2.0, 2.0, 2.2)
"""Corners of the watched volume in the cell frame."""
BLOCK: Final = 4
"""Voxels along the edge of a block; each side of the grid holds whole blocks."""
NEVER_NS: Final = 1 << 62
"""A start in the far future: nothing plays."""
GOALS_RAD: Final = (
    (-1.0, 0.9, 0.0, -1.1, 0.0, 1.1, 0.0),
    (0.9, 0.9, 0.0, -1.1, 0.0, 1.1, 0.0),
)
"""Over the front of the table, and over its back."""
DWELL_S: Final = 0.4
"""How long the tool stays at each goal."""


def grid_of(voxel_m: float) -> Grid:
    """Return the grid of the watched volume.

    Raises:
        ValueError: `voxel_m` is not positive.
    """
    if not voxel_m > 0.0:
        raise ValueError(f"voxel_m is {voxel_m}; an edge is longer than 0")
    blocks = np.ceil((np.array(HIGH_M) - LOW_M) / (voxel_m * BLOCK) - 1e-9).astype(int)
    x, y, z = (int(count) * BLOCK for count in blocks)
    return Grid(np.array(LOW_M), voxel_m, (x, y, z))


def task_of() -> Task:
    """Return the task: to and fro over the table, for ever."""
    return Task(np.array(GOALS_RAD), np.full(len(GOALS_RAD), DWELL_S), cyclic=True)


class Setup(Actor):
    """Write what is known of the simulated cell, once.

    Args:
        scenario: What the simulators will play.
        seed: Its seed.
        seconds: How long it lasts.
        voxel_m: Edge of a voxel.
        confirm: The cell is confirmed empty at once and the scenario begins when this many
            seconds have passed; 0: the operator does both.
        cameras: How many of the room's eight cameras the cell has, the first ones.
        scale: Of their images: 1 is 640 x 480 pixels.
    """

    online, truth = World("online"), World("truth")
    calibrations = WriteEach(online, CAMERAS, CALIBRATION)
    boxes = WriteEach(online, OBSTACLES, BOXES)
    grid = Write(online, WORKSPACE, GRID)
    empty = Write(online, WORKSPACE, EMPTY)
    model = Write(online, ROBOT, MODEL)
    task = Write(online, ROBOT, TASK)
    playing = Write(truth, SCENARIO, PLAYING)
    shared = (empty, playing)

    def __init__(
        self,
        scenario: str = DEFAULT,
        seed: int = 1,
        seconds: float = SECONDS,
        voxel_m: float = 0.025,
        confirm: float = 0.0,
        cameras: int = CAMERA_COUNT,
        scale: float = 1.0,
    ) -> None:
        scenario_of(scenario, seed, seconds)  # refuses what does not exist
        self.scenario, self.seed, self.seconds = scenario, seed, seconds
        self.voxel_m, self.confirm = voxel_m, confirm
        if not 2 <= cameras <= CAMERA_COUNT:
            raise ValueError(f"cameras is {cameras}; the room has 2 to {CAMERA_COUNT}")
        if not 0.25 <= scale <= 1.0:
            raise ValueError(f"scale is {scale:g}; images have 0.25 to 1 times 640 x 480 pixels")
        self.cameras, self.scale = cameras, scale

    def update(self, lock: Lock) -> None:
        """Write it."""
        for number, calibration in enumerate(cameras(self.scale)[: self.cameras]):
            lock[self.calibrations][camera_entity(number)] = calibration
        scenario = scenario_of(self.scenario, self.seed, self.seconds)
        for number, box in enumerate(boxes_of(scenario)):
            lock[self.boxes][obstacle_entity(number)] = box.row()[None]
        lock[self.grid] = grid_of(self.voxel_m)
        lock[self.model] = ARM
        lock[self.task] = task_of()
        now_ns, begin_ns = time.time_ns(), NEVER_NS
        if self.confirm > 0.0:
            # At a tick, so that the images show the scenario's seconds 0, 0.1, 0.2 …
            begin_ns = -(-(now_ns + round(self.confirm * 1e9)) // PERIOD_NS) * PERIOD_NS
            lock[self.empty] = now_ns
        lock[self.playing] = Playing(
            self.scenario, self.seed, begin_ns, self.seconds, robot=self.confirm > 0.0
        )
