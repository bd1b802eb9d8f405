"""Conveyor: lets the next package come when the last one is out of the way."""

from __future__ import annotations

import time
from dataclasses import dataclass
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
from enact_dist import Actor, Entity, View, ViewEach, World, Write

if TYPE_CHECKING:
    from collections.abc import Mapping

    from actors.palletizing.control.controller import BeltController
    from actors.palletizing.vocabulary import Attached, Outcome, Plan, Planned, Request, Result
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
        self._runs_for, self._runs_s, self._free_s = -1, 0.0, 0.0

    def update(self, lock: Lock) -> None:
        """Start the belt, or say that a package has come."""
        last, plans, trained = lock.get(self.arrival), lock[self.plans], lock[self.grasps].keys()
        number, came = 0, None
        if last is not None:
            request, attached = lock.get(self.request), lock.get(self.attached)
            outcome, results = lock.get(self.outcome), lock.get(self.results, {})
            number, came = last.number + 1, Came(last, request, attached, outcome, results)
        runs, is_planned = self._runs_for == number, place_entity(number) in plans
        if came is not None and not runs and (again := self._again(came)) is not None:
            lock[self.arrival] = again
        elif not is_planned or lock.is_null(self.empty):
            return
        elif runs and self.belt.arrived():
            lock[self.arrival] = Arrival(number, time.time_ns())
        elif runs and time.monotonic() - self._runs_s > LATE_S:
            print(f"package {number} has not come for {LATE_S:g} s; the belt is run again")
            self._run(number)
        elif not runs and all(product_entity(plan.product) in trained for plan in plans.values()):
            is_last = came is not None and came.ends_tray(plans)
            if came is None or came.is_off(lock.get(self.planned), ends_tray=is_last):
                if is_last:
                    self.belt.change_tray()
                self._run(number)

    def _run(self, number: int) -> None:
        """Run the belt for a package: until the world knows that it has arrived."""
        self.belt.run_belt()
        self._runs_for, self._runs_s = number, time.monotonic()

    def _again(self, came: Came) -> Arrival | None:
        """Return what came last as it is reported again, None if it need not be."""
        number, now_ns = came.last.number, time.time_ns()
        if came.is_overlooked(now_ns) and self.belt.arrived():
            return Arrival(number, now_ns)
        if came.last.is_gone or came.is_followed or self.belt.arrived():
            self._free_s = 0.0
            return None
        self._free_s = self._free_s or time.monotonic()
        is_gone = time.monotonic() - self._free_s >= FREE_S
        return Arrival(number, now_ns, is_gone=True) if is_gone else None


@dataclass(frozen=True, slots=True, eq=False)
class Came:
    """The package that came last, and what has become of it.

    Attributes:
        last: Its arrival.
        request: The last one, about whatever.
        attached: The net that the robot executes; None: none.
        outcome: How the last request ended.
        results: What became of each package so far, by name of its place.
    """

    last: Arrival
    request: Request | None
    attached: Attached | None
    outcome: Outcome | None
    results: Mapping[str, Result]

    @property
    def place(self) -> str:
        """Name of the place that it is for."""
        return place_entity(self.last.number).name

    def is_overlooked(self, now_ns: int) -> bool:
        """Return whether no request is about it: if it is there, it was not seen.

        A package that fell back onto the belt stops it in the light barrier, too; when that is
        taken away, the one after it comes unseen.
        """
        request, waits_s = self.request, 1e-9 * (now_ns - self.last.stamp_ns)
        is_idle = request is None or (request.place != self.place and request.place in self.results)
        return is_idle and self.place not in self.results and waits_s > OVERLOOKED_S

    @property
    def is_followed(self) -> bool:
        """Whether it was recognised, or its place is closed.

        Whatever a request names as its package is followed by perception; what came and was not
        recognised has no name: the light barrier alone tells when it is taken out.
        """
        request = self.request
        is_named = request is not None and request.place == self.place and bool(request.package)
        return is_named or self.place in self.results

    def ends_tray(self, plans: Mapping[Entity, Plan]) -> bool:
        """Return whether the package after it is for another tray; there is one."""
        following = place_entity(self.last.number + 1)
        return plans[following].tray != plans[Entity(self.place)].tray

    def is_off(self, planned: Planned | None, *, ends_tray: bool) -> bool:
        """Return whether the next one can come: this one is off the belt.

        A tray is changed when no place is open any more, and by a plan that knows all results:
        when a package was rejected, the one after it may still find room.

        Args:
            planned: What the plans take into account.
            ends_tray: The tray has to be changed first.
        """
        request, attached, outcome = self.request, self.attached, self.outcome
        if ends_tray:
            is_closed = len(self.results) == self.last.number + 1
            return is_closed and is_current(planned, self.results)
        if self.place in self.results:
            return True
        if request is None or request.place != self.place:
            return False
        if attached is not None and (attached.request, attached.stage) == (request.number, "push"):
            return True
        if outcome is None or outcome.request != request.number:
            return False
        return outcome.success and outcome.stage in OFF_THE_BELT
