"""Training grasp: where and how each product is held, from its trained surface."""

from __future__ import annotations

from typing import TYPE_CHECKING

from actors.palletizing.placing.grasps import grasp_of
from actors.palletizing.vocabulary import GRASP, PRODUCTS, SURFACE
from enact_dist import Actor, View, World, Write

if TYPE_CHECKING:
    from enact_dist import Lock


class TrainingGrasp(Actor):
    """Attach a grasp to every product that has a surface.

    Args:
        masses_kg: Mass of each product: ``milk_carton=0.5 meal_tray=0.35``.
    """

    training = World("training")
    surface = View(training, PRODUCTS, SURFACE)
    grasp = Write(training, PRODUCTS, GRASP)
    triggers = (surface,)

    def __init__(self, masses_kg: str) -> None:
        pairs = (each.partition("=") for each in masses_kg.split())
        try:
            self.masses_kg = {product: float(mass) for product, _, mass in pairs}
        except ValueError as error:
            raise ValueError(f"masses_kg is {masses_kg!r}; write PRODUCT=KG …") from error

    def update(self, lock: Lock) -> None:
        """Find the grasp of one product."""
        product = lock.entity.name.removeprefix("product/")
        if product not in self.masses_kg:
            known = " ".join(self.masses_kg)
            raise ValueError(f"masses_kg of training grasp names no {product}, only {known}")
        lock[self.grasp] = grasp_of(lock[self.surface], mass_kg=self.masses_kg[product])
