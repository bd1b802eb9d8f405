"""The pictures of a folder through the cell's own actors: subtraction and reconstruction.

The box of the hull is scaled to the size of a workcell while the actors work on it: what they take
for noise is measured in litres, and a set of pictures may show a thing of a hand's size.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Final

import numpy as np

from actors.geometry.hull.silhouettes import packed
from actors.threads import running
from actors.workcell.background import BackgroundSubtraction
from actors.workcell.reconstruction import Reconstruction
from actors.workcell.vocabulary import (
    BACKGROUND,
    CALIBRATION,
    GRID,
    HULL,
    IMAGE,
    SILHOUETTE,
    WORKSPACE,
    Background,
    Calibration,
    Grid,
    Silhouette,
    camera_entity,
)
from enact_dist import Lock, View, Write, local

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy.typing as npt

    from actors.geometry.cameras.camera_sets import SetCamera
    from actors.geometry.hull.voxels import VoxelBlocks
    from actors.workcell.folders.pictures import Shot
    from enact_dist import WorldContext

    Image = npt.NDArray[np.uint8]

CELL_M: Final = 2.0
"""Longest edge of the box while the actors work on it."""
TABLES_BYTES_MAX: Final = 1 << 30
"""Cameras and voxels whose tables take more memory are carved without them."""
HULL_S: Final = 120.0
"""How long the actors may take; the largest tables take some seconds."""
LOOK_S: Final = 0.2
"""How often the wait for the hull looks whether an actor has failed."""


def fits(shots: Sequence[Shot], grid: VoxelBlocks) -> bool:
    """Whether the tables of the reconstruction for these cameras stay in bounds."""
    return 4 * len(shots) * grid.voxels <= TABLES_BYTES_MAX


def hull_by_actors(shots: Sequence[Shot], grid: VoxelBlocks) -> npt.NDArray[np.int64]:
    """Return the voxels of the tight hull that the cell's actors make of pictures, as rows.

    Args:
        shots: Pictures with a background go through the subtraction, masks are silhouettes.
        grid: The voxels.

    Raises:
        TimeoutError: There is no hull after `HULL_S`.
        Exception: What an actor's update raised.
    """
    scale = CELL_M / (grid.voxel_m * max(grid.shape))
    with local(worlds=("online",), actor="folder") as cell:
        online = cell.world("online")
        online.init(WORKSPACE, GRID, Grid(scale * grid.origin_m, scale * grid.voxel_m, grid.shape))
        for number, shot in enumerate(shots):
            online.init(camera_entity(number), CALIBRATION, _calibration(shot.camera, scale))
        count = len(shots)
        reconstruction = Reconstruction.of_options({"cameras": count, "least": count})
        actors = [BackgroundSubtraction(), reconstruction(robot=False, stuck=False)]
        with (
            online.watch(str(WORKSPACE), HULL) as watch,
            running(actors, cell) as failures,
        ):
            _write(online, shots)
            end_s = time.monotonic() + HULL_S
            while (change := watch.next(LOOK_S)) is None or change.null:
                if failures:
                    raise failures[0]
                if time.monotonic() > end_s:
                    raise TimeoutError(
                        f"the actors made no hull of {len(shots)} pictures and {grid.voxels:,}"
                        f" voxels within {HULL_S:g} s; choose a coarser --grid, or try again when"
                        " the machine is less busy"
                    )
        hull = View(online, WORKSPACE, HULL)
        found = online.view(hull)[hull]
        return grid.rows_of(found.voxels[found.tight])


def _calibration(camera: SetCamera, scale: float) -> Calibration:
    pose = camera.camera_from_cell.copy()
    pose[:3, 3] *= scale
    return Calibration(camera.camera_matrix, camera.distortion, pose, camera.width, camera.height)


def _write(online: WorldContext, shots: Sequence[Shot]) -> None:
    """Write what the cameras saw, all with one stamp."""
    stamp_ns = time.time_ns()
    images: list[tuple[Write[Image], Image]] = []
    masks: list[tuple[Write[Silhouette], Silhouette]] = []
    for number, shot in enumerate(shots):
        entity = camera_entity(number)
        if shot.background is not None and shot.image is not None:
            mean, spread = shot.background
            online.init(entity, BACKGROUND, Background(mean, spread, 1, stamp_ns))
            images.append((Write(online, entity, IMAGE), shot.image))
        else:
            bits = packed(shot.mask.astype(np.uint8))
            silhouette = Silhouette(bits, int(np.count_nonzero(shot.mask)))
            masks.append((Write(online, entity, SILHOUETTE), silhouette))
    with Lock(*(write for write, _ in images), *(write for write, _ in masks)) as lock:
        for request, image in images:
            lock.put(request, image, stamp_ns=stamp_ns)
        for other, mask in masks:
            lock.put(other, mask, stamp_ns=stamp_ns)
