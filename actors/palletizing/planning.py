"""Planning: what to train, and what shall stand where on the trays."""

from __future__ import annotations

from typing import TYPE_CHECKING

from actors.palletizing.control.controller import open_controller
from actors.palletizing.handling.stages import STANDS, is_current, results_of
from actors.palletizing.placing.grasps import size_of
from actors.palletizing.placing.pallet import planned_pose, tray_of
from actors.palletizing.placing.rows import contacts_between, planned_rows
from actors.palletizing.vocabulary import (
    CELL,
    EMPTY,
    FRAMES,
    PLACES,
    PLAN,
    PLANNED,
    PRODUCTS,
    REQUEST,
    RESULTS,
    SCAN,
    STANDING,
    SURFACE,
    SYSTEM,
    TRAY,
    Plan,
    Planned,
    Standing,
    place_entity,
    product_entity,
)
from enact_dist import Actor, View, ViewEach, World, Write, WriteEach

if TYPE_CHECKING:
    from collections.abc import Mapping

    from actors.palletizing.vocabulary import Result
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


class RowPlanning(Actor):
    """Order the scans; when all products are trained, plan rows in which packages touch.

    A package that does not come onto the tray leaves no gap: the places after its own are planned
    anew, as if it had not been announced.  One that is taken away from between others leaves its
    place empty, since those after it stand where they do.  `PLANNED` says which results a plan
    knows; who acts on a plan waits until that is all of them.

    Args:
        packages: How many packages will come.
        products: Names of the products, separated by spaces; they come in turn.
        frames: Address of what returns where tray, belt and bin stand, see `vocabulary.FRAMES`.
        views: How many views of each product are wanted.
    """

    training, online = World("training"), World("online")
    surfaces = ViewEach(training, PRODUCTS, SURFACE)
    empty = View(training, TRAY, EMPTY)
    request = View(online, SYSTEM, REQUEST)
    results = View(online, SYSTEM, RESULTS)
    frames = Write(training, CELL, FRAMES)
    planned = Write(training, CELL, PLANNED)
    scans = WriteEach(training, PRODUCTS, SCAN)
    plans = WriteEach(training, PLACES, PLAN)
    standing = WriteEach(training, PLACES, STANDING)
    triggers = (empty, surfaces, results)  # the tray is seen empty when training begins

    def __init__(self, packages: int, products: str, frames: str, views: int = 14) -> None:
        self.packages, self.products, self.views = packages, products.split(), views
        if packages < 1 or views < 3 or not self.products:
            raise ValueError("planning needs a package, a product and three views at least")
        self.cell_frames = open_controller(frames)

    def update(self, lock: Lock) -> None:
        """Write what is missing; plan anew when a package has left its place empty."""
        if lock.is_null(self.frames):
            lock[self.frames] = self.cell_frames
        for product in map(product_entity, self.products):
            if product not in lock[self.scans]:
                lock[self.scans][product] = self.views
        trained = lock[self.surfaces].keys()
        if any(product_entity(product) not in trained for product in self.products):
            return
        results, before = lock.get(self.results, {}), lock.get(self.planned)
        if is_current(before, results):
            return
        left_out = self._left_out(results, before)
        if before is None or left_out != before.left_out:
            self._plan(lock, [n for n in range(self.packages) if n not in left_out], set(results))
        lock[self.planned] = Planned(results_of(results), left_out)

    def _left_out(self, results: Mapping[str, Result], before: Planned | None) -> tuple[int, ...]:
        """Return the packages whose places are filled by later ones.

        One that has no result has not come yet, whatever an online context before this one held.
        """
        came = {n: results[name] for n in range(self.packages) if (name := _name(n)) in results}
        stands = [number for number, result in came.items() if result.result in STANDS]
        last = max(stands, default=-1)
        gone = {number for number in came if number > last}
        left_before = set() if before is None else set(before.left_out)
        return tuple(sorted(gone | (left_before & came.keys())))

    def _plan(self, lock: Lock, coming: list[int], done: set[str]) -> None:
        """Plan the places of the packages that come, except of those that are there."""
        request = lock.get(self.request)
        fixed = done if request is None else {*done, request.place}
        products = [self.products[number % len(self.products)] for number in coming]
        models = {
            product: lock[self.surfaces][product_entity(product)] for product in set(products)
        }
        sizes = {product: size_of(model) for product, model in models.items()}
        slots = planned_rows(products, sizes, contacts_between(models))
        for number, product, slot in zip(coming, products, slots, strict=True):
            place = place_entity(number)
            if place.name not in fixed or place not in lock[self.plans]:
                lock[self.plans][place] = Plan(
                    product, slot.tray, slot.tray_from_product, slot.push
                )
                lock[self.standing][place] = Standing(product, "ok", shift_mm=0.0, turn_deg=0.0)


def _name(number: int) -> str:
    return place_entity(number).name
