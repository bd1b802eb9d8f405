"""Fusion: the complete surface of a product from its views."""

from __future__ import annotations

from typing import TYPE_CHECKING

from actors.geometry.fusion import fuse_views
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
from enact_dist import Actor, ViewEach, World, WriteEach

if TYPE_CHECKING:
    from enact_dist import Entity, Lock


class Fusion(Actor):
    """Combine all views of a product into one surface, once the last one is there (ENACT 4.2)."""

    training = World("training")
    scans = ViewEach(training, PRODUCTS, SCAN)
    viewpoints = ViewEach(training, VIEWS, VIEWPOINT)
    surfaces = ViewEach(training, VIEWS, SURFACE)
    models = WriteEach(training, PRODUCTS, SURFACE)
    newest = WriteEach(training, PRODUCTS, NEWEST_VIEW)
    triggers = (surfaces,)

    def update(self, lock: Lock) -> None:
        """Fuse every product whose scan is complete and newer than its surface."""
        surfaces, viewpoints = lock[self.surfaces], lock[self.viewpoints]
        views: dict[Entity, list[Entity]] = {}
        for view in sorted(surfaces):
            views.setdefault(product_entity(product_of_view(view)), []).append(view)
        for product, seen in views.items():
            newest_ns = max(viewpoints[view].captured_ns for view in seen)
            complete = len(seen) >= lock[self.scans].get(product, len(seen) + 1)
            if complete and lock[self.newest].get(product, 0) < newest_ns:
                lock[self.models][product] = fuse_views(
                    [surfaces[view] for view in seen],
                    [viewpoints[view].acquisition for view in seen],
                )
                lock[self.newest][product] = newest_ns
