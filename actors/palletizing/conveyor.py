"""Conveyor: lets the next package come when the last one is out of the way."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Final

from actors.palletizing.control.controller import open_controller
from actors.palletizing.handling.stages import is_current
from actors.palletizing.vocabulary import (
    ARRIVAL,
    BELT,
    CELL,
    CONVEYOR,
    DEVIATIONS,
    EMPTY,
    GRASP,
    NET,
    OUTCOME,
    PLACES,
    PLAN,
    PLANNED,
    PRODUCTS,
    REQUEST,
    RESULTS,
    STOP,
    SURFACE,
    SYSTEM,
    Arrival,
    place_entity,
    product_entity,
)
from enact_dist import Actor, View, ViewEach, World, Write

if TYPE_CHECKING:
    from actors.palletizing.control.controller import BeltController
    from enact_dist import Lock

OFF_THE_BELT: Final = ("place", "push", "remove")
"""Stages after which the package is not on the belt, if they have succeeded."""
LOOK_S: Final = 0.1
OVERLOOKED_S: Final = 8.0
"""When a package that has come was still not seen, it is reported again."""
FREE_S: Final = 2.0
"""After so long in which nothing stands in the light barrier it is free."""
LATE_S: Final = 15.0
"""A belt that has brought nothing for so long is started again, and says so."""


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


class BeltConveyor(Actor):
    """Run the belt until a package stands in its light barrier, as soon as the last one is off it.

    It waits until there are a plan and a grasp of every product.  A tray that is full is changed
    when its last package is done with.

    Args:
        controller: Address of the belt (`BeltController`), see `open_controller`.
    """

    training, online = World("training"), World("online")
    plans = ViewEach(training, PLACES, PLAN)
    planned = View(training, CELL, PLANNED)
    grasps = ViewEach(training, PRODUCTS, GRASP)
    empty = View(training, BELT, EMPTY)
    request = View(online, SYSTEM, REQUEST)
    attached = View(online, SYSTEM, NET)
    outcome = View(online, SYSTEM, OUTCOME)
    results = View(online, SYSTEM, RESULTS)
    arrival = Write(online, CONVEYOR, ARRIVAL)
    every_s = LOOK_S

    def __init__(self, controller: str) -> None:
        self.belt: BeltController = open_controller(controller)
        self._runs_s = self._free_s = 0.0

    def update(self, lock: Lock) -> None:
        """Start the belt, or say that a package has come."""
        plans, trained = lock[self.plans], lock[self.grasps].keys()
        last = lock.get(self.arrival)
        coming = 0 if last is None else last.number + 1
        place = place_entity(coming)
        if last is not None and not self._runs_s and self._is_overlooked(lock, last):
            lock[self.arrival] = Arrival(last.number, time.time_ns())
            return
        if last is not None and not self._runs_s and self._is_gone(lock, last):
            lock[self.arrival] = Arrival(last.number, time.time_ns(), is_gone=True)
            return
        if place not in plans or lock.is_null(self.empty):
            return
        if not self._runs_s:
            if any(product_entity(plan.product) not in trained for plan in plans.values()):
                return
            if last is not None and not self._is_free(lock, last.number):
                return
            self._run()
        elif self.belt.arrived():
            lock[self.arrival] = Arrival(coming, time.time_ns())
            self._runs_s = 0.0
        elif time.monotonic() - self._runs_s > LATE_S:
            print(f"package {coming} has not come for {LATE_S:g} s; the belt is run again")
            self._run()

    def _run(self) -> None:
        self.belt.run_belt()
        self._runs_s = time.monotonic()

    def _is_overlooked(self, lock: Lock, last: Arrival) -> bool:
        """Return whether no request is about what has come: it was not seen, and is reported again.

        A package that fell back onto the belt stops it in the light barrier, too; when that is
        taken away, the one after it comes unseen.
        """
        name, request = place_entity(last.number).name, lock.get(self.request)
        results = lock.get(self.results, {})
        is_idle = request is None or (request.place != name and request.place in results)
        waits_s = 1e-9 * (time.time_ns() - last.stamp_ns)
        return is_idle and name not in results and waits_s > OVERLOOKED_S and self.belt.arrived()

    def _is_gone(self, lock: Lock, last: Arrival) -> bool:
        """Return whether what has come was taken out of the light barrier before it was recognised.

        Whatever a request names as its package is followed by perception; what came and was not
        recognised has no name.
        """
        name, request = place_entity(last.number).name, lock.get(self.request)
        named = request is not None and request.place == name and bool(request.package)
        closed = name in lock.get(self.results, {})
        if last.is_gone or named or closed or self.belt.arrived():
            self._free_s = 0.0
            return False
        self._free_s = self._free_s or time.monotonic()
        return time.monotonic() - self._free_s >= FREE_S

    def _is_free(self, lock: Lock, number: int) -> bool:
        """Return whether a package is off the belt; change the tray if it was its last one.

        A tray is changed when no place is open any more, and by a plan that knows all results:
        when a package was rejected, the one after it may still find room.
        """
        place, plans, results = place_entity(number), lock[self.plans], lock.get(self.results, {})
        done = place.name in results
        if plans[place_entity(number + 1)].tray != plans[place].tray:
            closed = len(results) == number + 1 and is_current(lock.get(self.planned), results)
            if closed:
                self.belt.change_tray()
            return closed
        request, attached = lock.get(self.request), lock.get(self.attached)
        if request is None or request.place != place.name:
            return done
        is_pushed = (
            attached is not None and attached.request == request.number and attached.stage == "push"
        )
        outcome = lock.get(self.outcome)
        is_off = (
            outcome is not None
            and outcome.request == request.number
            and (outcome.success and outcome.stage in OFF_THE_BELT)
        )
        return done or is_pushed or is_off
