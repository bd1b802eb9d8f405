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

    from actors.geometry.shapes import Surface
    from actors.palletizing.vocabulary import Result
    from enact_dist import Entity, Lock


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
        self.packages, self.views = packages, views
        self.products = announced(packages, products, views)

    def update(self, lock: Lock) -> None:
        """Write the whole plan; the same plan again changes nothing that matters."""
        for product in self.products:
            lock[self.scans][product_entity(product)] = self.views
        for stop in range(self.packages):
            place, product = place_entity(stop), self.products[stop % len(self.products)]
            lock[self.plans][place] = Plan(product, tray_of(stop), planned_pose(stop))
            lock[self.standing][place] = Standing(product, "ok", 0.0, 0.0)


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
        self.packages, self.views = packages, views
        self.products = announced(packages, products, views)
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
        empty = left_out(self.packages, results, before)
        if before is None or empty != before.left_out:
            come = (number for number in range(self.packages) if number not in empty)
            products = {number: self.products[number % len(self.products)] for number in come}
            request, plans = lock.get(self.request), lock[self.plans]
            fixed = set(results) if request is None else {*results, request.place}
            for place, plan in plans_of(products, lock[self.surfaces]).items():
                if place.name not in fixed or place not in plans:
                    plans[place] = plan
                    lock[self.standing][place] = Standing(plan.product, "ok", 0.0, 0.0)
        lock[self.planned] = Planned(results_of(results), empty)


def announced(packages: int, products: str, views: int) -> list[str]:
    """Return the names of the products that will come.

    Raises:
        ValueError: There is nothing to plan, or too few views of it.
    """
    names = products.split()
    if packages < 1 or views < 3 or not names:
        raise ValueError("planning needs a package, a product and three views at least")
    return names


def left_out(
    packages: int, results: Mapping[str, Result], before: Planned | None
) -> tuple[int, ...]:
    """Return the packages whose places are filled by later ones.

    One that has no result has not come yet, whatever an online context before this one held.

    Args:
        packages: How many will come.
        results: What became of each so far, by name of its place.
        before: What the plan before took into account; None: there is none.
    """
    names = {number: place_entity(number).name for number in range(packages)}
    came = {number: results[name].result for number, name in names.items() if name in results}
    last = max((number for number, result in came.items() if result in STANDS), default=-1)
    gone = {number for number in came if number > last}
    left_before = set() if before is None else set(before.left_out)
    return tuple(sorted(gone | (left_before & came.keys())))


def plans_of(products: Mapping[int, str], surfaces: Mapping[Entity, Surface]) -> dict[Entity, Plan]:
    """Return the places of packages in rows in which they touch.

    Args:
        products: What comes, by its number, in its order.
        surfaces: Trained surface by product.

    Raises:
        ValueError: A product is wider or longer than a row.
    """
    models = {product: surfaces[product_entity(product)] for product in set(products.values())}
    sizes = {product: size_of(model) for product, model in models.items()}
    slots = planned_rows(list(products.values()), sizes, contacts_between(models))
    return {
        place_entity(number): Plan(product, slot.tray, slot.tray_from_product, slot.push)
        for (number, product), slot in zip(products.items(), slots, strict=True)
    }
