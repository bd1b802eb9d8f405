"""Conveyor: lets the next package come when the last one has been judged."""

from __future__ import annotations

from typing import TYPE_CHECKING

from actors.palletizing.vocabulary import (
    CONVEYOR,
    DEVIATIONS,
    PLACES,
    PLAN,
    PRODUCTS,
    STOP,
    SURFACE,
    SYSTEM,
    place_entity,
    product_entity,
)
from enact_dist import Actor, View, ViewEach, World, Write

if TYPE_CHECKING:
    from enact_dist import Lock


class Conveyor(Actor):
    """Advance by one stop at a time (ENACT 4.2: the conveyor belt delivers food packages).

    The cell's controller in a real plant; here the robot's hand is quicker than the eye. It waits
    until all planned products are trained, then until the last package is judged: so no check is
    ever overrun, however slow the machine.
    """

    training, online = World("training"), World("online")
    plans = ViewEach(training, PLACES, PLAN)
    surfaces = ViewEach(training, PRODUCTS, SURFACE)
    flags = View(online, SYSTEM, DEVIATIONS)
    stop_number = Write(online, CONVEYOR, STOP)
    triggers = (plans, surfaces, flags)

    def update(self, lock: Lock) -> None:
        """Advance if the last package is judged and there is a next one."""
        plans, trained = lock[self.plans], lock[self.surfaces].keys()
        if any(product_entity(plan.product) not in trained for plan in plans.values()):
            return
        judged = lock.get(self.flags, {})
        coming = lock.get(self.stop_number, -1) + 1
        last_is_judged = coming == 0 or place_entity(coming - 1).name in judged
        if last_is_judged and place_entity(coming) in plans:
            lock[self.stop_number] = coming
