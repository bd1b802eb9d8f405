"""Fusion: the complete surface of a product from its views."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from actors.geometry.surfaces.fusion import fuse_views
from actors.palletizing.vocabulary import (
    NEWEST_VIEW,
    PRODUCTS,
    SCAN,
    SURFACE,
    VIEWPOINT,
    VIEWS,
    product_entity,
    product_of_view,
)
from enact_dist import Actor, Entities, View, ViewEach, World, WriteEach

if TYPE_CHECKING:
    from enact_dist import Lock

EACH_VIEW: Final = Entities("view/**")
"""The views one by one; a class names a datum by one pattern in one way, by `VIEWS` all."""


class Fusion(Actor):
    """Combine all views of a product into one surface, once the last one is there (ENACT 4.2).

    One update per view, which looks at the views of its product alone: whatever an update looks at
    counts as a cause of the surface.

    Args:
        by_plate: Whether training perception knows its viewpoints by the plate.
    """

    training = World("training")
    new = View(training, EACH_VIEW, SURFACE)
    scans = ViewEach(training, PRODUCTS, SCAN)
    viewpoints = ViewEach(training, VIEWS, VIEWPOINT)
    surfaces = ViewEach(training, VIEWS, SURFACE)
    models = WriteEach(training, PRODUCTS, SURFACE)
    newest = WriteEach(training, PRODUCTS, NEWEST_VIEW)
    triggers = (new,)

    def __init__(self, *, by_plate: bool = True) -> None:
        self.by_plate = by_plate

    def update(self, lock: Lock) -> None:
        """Fuse the product of the view, if its scan is complete and newer than its surface."""
        name = product_of_view(lock.entity)
        product = product_entity(name)
        surfaces, viewpoints = lock[self.surfaces], lock[self.viewpoints]
        seen = sorted(view for view in surfaces if product_of_view(view) == name)
        if len(seen) < lock[self.scans].get(product, len(seen) + 1):
            return
        newest_ns = max(viewpoints[view].captured_ns for view in seen)
        if lock[self.newest].get(product, 0) < newest_ns:
            lock[self.models][product] = fuse_views(
                [surfaces[view] for view in seen],
                [viewpoints[view].acquisition for view in seen],
                by_plate=self.by_plate,
            )
            lock[self.newest][product] = newest_ns
