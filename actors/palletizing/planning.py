"""Planning: what to train, and what shall stand where on the trays."""

from __future__ import annotations

from typing import TYPE_CHECKING

from actors.palletizing.pallet import planned_pose, tray_of
from actors.palletizing.vocabulary import (
    PLACES,
    PLAN,
    PRODUCTS,
    SCAN,
    STANDING,
    Plan,
    Standing,
    place_entity,
    product_entity,
)
from enact_dist import Actor, World, WriteEach

if TYPE_CHECKING:
    from enact_dist import Lock


class Planning(Actor):
    """Order the scans of all products and plan one place for every package; runs once.

    The reference that makes *moved* and *missing* judgeable; the paper leaves open where its
    cell has it from.

    Args:
        packages: How many packages will come.
        products: Names of the products, separated by spaces; they come in turn.
        views: How many views of each product are wanted.
    """

    training = World("training")
    scans = WriteEach(training, PRODUCTS, SCAN)
    plans = WriteEach(training, PLACES, PLAN)
    standing = WriteEach(training, PLACES, STANDING)

    def __init__(self, packages: int, products: str, views: int = 14) -> None:
        self.packages, self.products, self.views = packages, products.split(), views
        if packages < 1 or views < 3 or not self.products:
            raise ValueError("planning needs a package, a product and three views at least")

    def update(self, lock: Lock) -> None:
        """Write the whole plan; the same plan again changes nothing that matters."""
        for product in self.products:
            lock[self.scans][product_entity(product)] = self.views
        for stop in range(self.packages):
            place, product = place_entity(stop), self.products[stop % len(self.products)]
            lock[self.plans][place] = Plan(product, tray_of(stop), planned_pose(stop))
            lock[self.standing][place] = Standing(product, "ok", shift_mm=0.0, turn_deg=0.0)
