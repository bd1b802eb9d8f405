"""Shape reconstruction (ENACT 4.1): the static obstacles, before people are tracked."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from actors.geometry.scans.recordings import read_recording
from actors.geometry.surfaces.static_shapes import static_shapes
from actors.workcell.vocabulary import (
    BOXES,
    GRID,
    OBSTACLES,
    SURFACE,
    WORKSPACE,
    obstacle_entity,
)
from enact_dist import Actor, View, World, WriteEach

if TYPE_CHECKING:
    from collections.abc import Sequence

    from actors.geometry.shapes import DepthFrame
    from enact_dist import Lock

SIMULATED = "simulated"


class ShapeReconstruction(Actor):
    """Make surface and boxes of each static obstacle from a scan of the empty cell; runs once.

    A depth sensor was carried around the cell.  Space that is enclosed by surface and was never
    seen into counts as solid, and people are not searched for in solid space: scan the inside of
    everything that a person fits into.  Obstacles of an earlier scan that are missing from this one
    are deleted.

    Args:
        scan: A folder with a recording, as `geometry.recordings` describes, its trajectory in the
            frame of the cell; or ``simulated:SEED``.
        fusion_m: Grid of the fusion, metres.
    """

    online = World("online")
    grid = View(online, WORKSPACE, GRID)
    surfaces = WriteEach(online, OBSTACLES, SURFACE)
    boxes = WriteEach(online, OBSTACLES, BOXES)

    hold_s = 300.0

    def __init__(self, scan: str = f"{SIMULATED}:1", fusion_m: float = 0.015) -> None:
        if not fusion_m > 0.0:
            raise ValueError(f"fusion_m is {fusion_m}; a grid has an edge above 0")
        self.scan, self.fusion_m = scan, fusion_m
        self._frames: Sequence[DepthFrame] = ()

    def start(self) -> None:
        """Read the scan."""
        self._frames = frames_of(self.scan)

    def update(self, lock: Lock) -> None:
        """Write surface and boxes of each obstacle.

        Raises:
            ValueError: There is no grid yet, or the scan is empty; a one-line message.
        """
        if lock.is_null(self.grid):
            raise ValueError("workspace/grid is null; write it before the scan is looked at")
        grid = lock[self.grid]
        low = np.asarray(grid.origin_m)
        high = low + grid.voxel_m * np.array(grid.shape)
        found = static_shapes(self._frames, low, high, voxel_m=self.fusion_m)
        surfaces, boxes = lock[self.surfaces], lock[self.boxes]
        for entity in {*surfaces, *boxes}:
            for of_obstacle in (surfaces, boxes):
                if entity in of_obstacle:
                    del of_obstacle[entity]
        for number, shape in enumerate(found):
            surfaces[obstacle_entity(number)] = shape.surface
            boxes[obstacle_entity(number)] = shape.boxes


def frames_of(scan: str) -> Sequence[DepthFrame]:
    """Return the depth images of a scan.

    Raises:
        InputFileError: The folder holds no recording.
        ValueError: The seed is invalid.
    """
    kind, _, seed = scan.partition(":")
    if kind != SIMULATED:
        return [recorded.depth for recorded in read_recording(Path(scan)).frames]
    if not seed.isdecimal():
        raise ValueError(f"scan is {scan!r}; write {SIMULATED}:SEED or the name of a folder")
    from actors.workcell.simulation.scan import scan_of_room

    return scan_of_room(int(seed))
