"""Run the training actors on a recording: three threads, one world context, in this process.

The actors are those that a cell runs as processes on shards; here they are the paper's threads of
one process, since a single recording needs no second host.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from actors.palletizing.real.recorded import (
    COLOURED_SURFACE,
    RECORDED,
    RecordedFusion,
    RecordedPerception,
)
from actors.palletizing.reconstruction import Reconstruction
from actors.palletizing.vocabulary import SURFACE, product_entity
from actors.threads import running
from enact_dist import View, local

if TYPE_CHECKING:
    from collections.abc import Callable

    from actors.geometry.surfaces.coloured_surface import ColouredSurface
    from enact_dist import Entity

LOOK_S: Final = 0.2
"""How often the wait for the surface looks whether an actor has failed."""


def trained_surface(
    perception: RecordedPerception,
    *,
    voxel_m: float,
    progress: Callable[[int], None] = lambda _: None,
) -> ColouredSurface:
    """Let perception, reconstruction and fusion make one surface of a recording.

    Blocks until the training context holds the surface or an actor fails; a second per view.

    Args:
        perception: With the recording read and checked.
        voxel_m: Edge of the fusion grid, metres; 0 for two pixels at the median depth.
        progress: Receives the number of views with a surface.

    Raises:
        Exception: What an actor's update raised, `FusionError` for example.
    """
    with local(worlds=("training",), actor="recording") as cell:
        training = cell.world("training")
        with (
            training.watch("**", SURFACE, COLOURED_SURFACE) as watch,
            running([perception, Reconstruction(), RecordedFusion(voxel_m)], cell) as failures,
        ):
            views: set[Entity] = set()
            while True:
                change = watch.next(LOOK_S)
                if failures:
                    raise failures[0]
                if change is None or change.null:
                    continue
                if change.aspect == COLOURED_SURFACE.name:
                    break
                views.add(change.entity)
                progress(len(views))
        request = View(training, product_entity(RECORDED), COLOURED_SURFACE)
        return training.view(request)[request]
