"""Reconstruction: the boundary representation of each view."""

from __future__ import annotations

from typing import TYPE_CHECKING

from actors.geometry.surfaces.depth_reconstruction import reconstruct_view
from actors.palletizing.vocabulary import CLOUD, SURFACE, VIEWPOINT, VIEWS
from enact_dist import Actor, View, World, Write

if TYPE_CHECKING:
    from enact_dist import Lock


class Reconstruction(Actor):
    """Attach a boundary representation to every view that has a cloud (ENACT 4.2)."""

    training = World("training")
    cloud = View(training, VIEWS, CLOUD)
    viewpoint = View(training, VIEWS, VIEWPOINT)
    surface = Write(training, VIEWS, SURFACE)
    triggers = (cloud, viewpoint)

    def update(self, lock: Lock) -> None:
        """Reconstruct one view, in the frame of its camera."""
        camera = lock[self.viewpoint].acquisition.camera
        lock[self.surface] = reconstruct_view(lock[self.cloud], camera)
