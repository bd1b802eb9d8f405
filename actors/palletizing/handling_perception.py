"""Perception where a robot packs: looks at belt and tray whenever something ended there.

Rules a change must keep: a package keeps its entity from the belt to the tray; the tray is seen
with the arm aside only.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from actors.geometry.open3d_on_use import open3d
from actors.palletizing.handling.stages import (
    ASIDE,
    NOT_ASIDE,
    is_held,
    is_on_belt_first,
    way_aside,
)
from actors.palletizing.sight.belt_sight import BeltWatch
from actors.palletizing.sight.sensor import FRAMES as FRAMES_FUSED
from actors.palletizing.sight.sensor import SensorError, Watched, open_sensor
from actors.palletizing.sight.tray_changes import tray_alone
from actors.palletizing.sight.tray_sight import Tray, tray_sight
from actors.palletizing.vocabulary import (
    ARRIVAL,
    BELT,
    CELL,
    CLOUD,
    COMMAND,
    CONVEYOR,
    EMPTY,
    EXECUTION,
    FRAMES,
    GRASP,
    GRIPPER,
    LAST,
    LOOK,
    LOOKS,
    NET,
    OBSERVATION,
    OUTCOME,
    PACKAGES,
    PLACES,
    PLAN,
    PRODUCTS,
    REQUEST,
    ROBOT,
    SIGHT,
    SIGHTING,
    STATE,
    SURFACE,
    SYSTEM,
    TRAY,
    BeltLooks,
    Look,
    Sight,
    place_entity,
    product_entity,
)
from enact_dist import Actor, Entity, View, ViewEach, World, Write, WriteEach

if TYPE_CHECKING:
    from actors.palletizing.sight.sensor import TraySensor
    from actors.palletizing.vocabulary import Arrival, Outcome, Request
    from enact_dist import Lock


class EmptyBelt(Actor):
    """Take the image of the empty belt, before the first package comes.

    It tries once a second until the sensor has given one: no package comes before.

    Args:
        sensor: Address of the sensor above the belt; the world of its poses is the belt frame.
    """

    training = World("training")
    empty = Write(training, BELT, EMPTY)
    every_s = 1.0

    def __init__(self, sensor: str) -> None:
        self.sensor: TraySensor = open_sensor(sensor)

    def update(self, lock: Lock) -> None:
        """Take it, unless it is there."""
        if not lock.is_null(self.empty):
            return
        try:
            lock[self.empty] = self.sensor.capture_empty()
        except Exception as error:  # a driver raises what it likes
            raise SensorError(f"the belt sensor gave no image: {error}") from error


class HandlingPerception(Actor):
    """Create the entity of each package on the belt, and look where it went (ENACT 4.2, online).

    Args:
        belt_sensor: Address of the sensor above the belt, see `open_sensor`.
        tray_sensor: Address of the one above the tray (`TraySensor`).
        frames: How many images are fused into one.
    """

    training, online = World("training"), World("online")
    arrival = View(online, CONVEYOR, ARRIVAL)
    request = View(online, SYSTEM, REQUEST)
    outcome = View(online, SYSTEM, OUTCOME)
    attached = View(online, SYSTEM, NET)
    execution = View(online, ROBOT, EXECUTION)
    grip = View(online, GRIPPER, COMMAND)
    gripper = View(online, GRIPPER, STATE)
    plans = ViewEach(training, PLACES, PLAN)
    models = ViewEach(training, PRODUCTS, SURFACE)
    grasps = ViewEach(training, PRODUCTS, GRASP)
    empty_tray = View(training, TRAY, EMPTY)
    empty_belt = View(training, BELT, EMPTY)
    cell_frames = View(training, CELL, FRAMES)
    looks = Write(online, CONVEYOR, LOOKS)
    last = Write(online, TRAY, LAST)
    look = Write(online, SYSTEM, LOOK)
    sight = Write(online, CONVEYOR, SIGHT)
    observations = WriteEach(online, PLACES, OBSERVATION)
    clouds = WriteEach(online, PACKAGES, CLOUD)
    sightings = WriteEach(online, PACKAGES, SIGHTING)
    triggers = (arrival, outcome, execution)

    def __init__(self, belt_sensor: str, tray_sensor: str, frames: int = FRAMES_FUSED) -> None:
        self.belt_sensor = Watched(open_sensor(belt_sensor), "the belt sensor", frames)
        self.tray_sensor = Watched(open_sensor(tray_sensor), "the tray sensor", frames)

    def start(self) -> None:
        """Load Open3D before the first package comes: it takes a second or two."""
        open3d()

    def update(self, lock: Lock) -> None:
        """Look at the belt if a package has come, and where a request ended."""
        arrival, outcome = lock.get(self.arrival), lock.get(self.outcome)
        attached, before = lock.get(self.attached), lock.get(self.look)
        net, ended = way_aside(attached, lock.get(self.execution))
        aside = net if ended == ASIDE else 0
        if arrival is not None and lock.get(self.looks, BeltLooks()).is_due(arrival, aside):
            self._see_arrival(lock, arrival, aside)
        if outcome is None or attached is None or attached.request != outcome.request or not ended:
            return
        request = lock[self.request]
        is_new = before is None or before.request != outcome.request
        if not is_new or request.number != outcome.request:
            return
        if ended != ASIDE:
            lock[self.look] = Look(request.number, "", 0, error=NOT_ASIDE + ended)
            return
        try:
            lock[self.look] = self._look(lock, request, outcome)
        except SensorError as error:
            print(error, flush=True)
            lock[self.look] = Look(request.number, "", 0, error=str(error))

    def _see_arrival(self, lock: Lock, arrival: Arrival, aside: int) -> None:
        """Create the entity of the package that has come, unless it is known."""
        number, failure = arrival.number, ""
        is_known = seen = any(one.first_stop == number for one in lock[self.sightings].values())
        if not is_known:
            try:
                seen = self._see_belt(lock, Entity.fresh("package"), number)
            except SensorError as failed:
                print(failed, flush=True)
                failure = str(failed)
        looks = lock.get(self.looks, BeltLooks())
        looks = looks.after(arrival, aside, seen=seen, failed=bool(failure))
        lock[self.looks], error = looks, failure or looks.error(is_gone=arrival.is_gone)
        if not is_known and (error or lock.get(self.sight) is not None):
            lock[self.sight] = Sight(number, error)

    def _look(self, lock: Lock, request: Request, outcome: Outcome) -> Look:
        """Look where the package of a request is; return what was seen.

        Raises:
            SensorError: The sensor cannot be believed.
        """
        if not request.package:  # what has come was looked for just now
            sight = lock.get(self.sight)
            return Look(request.number, "", 0, error="" if sight is None else sight.error)
        package, arrival = Entity(request.package), lock.get(self.arrival)
        before = lock[self.sightings][package]
        grasp = lock[self.grasps].get(product_entity(before.product))
        if is_held(lock.get(self.grip), lock.get(self.gripper), grasp):
            return Look(request.number, "hand", 0)  # it would be seen above the tray
        stop = before.first_stop
        if is_on_belt_first(request, outcome) and self._see_belt(lock, package, stop):
            return Look(request.number, "belt", 0)
        number, empty = lock[self.plans][Entity(request.place)].tray, lock[self.empty_tray]
        frame, now_ns = tray_alone(self.tray_sensor.image(), empty), time.time_ns()
        tray = Tray(number, empty, lock[self.models], lock[self.plans], lock[self.sightings])
        last, kind = lock.get(self.last), request.kind
        found = tray_sight(frame, last, tray, package, kind=kind, captured_ns=now_ns)
        lock[self.sightings].update(found.sightings)
        lock[self.clouds].update(found.clouds)
        for place, observed in found.observations.items():
            lock[self.observations].put(place, observed, stamp_ns=now_ns)
        lock[self.last] = frame
        is_newest = arrival is None or arrival.number == stop  # later, the next one may lie there
        if package not in found.clouds and not outcome.success and is_newest:
            self._see_belt(lock, package, stop)  # it was lost on its way
        judged = tuple(place.name for place in found.observations)
        return Look(request.number, lock[self.sightings][package].frame, now_ns, judged)

    def _see_belt(self, lock: Lock, package: Entity, number: int) -> bool:
        """Look for a package on the belt; return whether there is one."""
        before, plan = lock[self.sightings].get(package), lock[self.plans].get(place_entity(number))
        product, tray = "" if before is None else before.product, 0 if plan is None else plan.tray
        empty, models, frames = lock[self.empty_belt], lock[self.models], lock.get(self.cell_frames)
        image = self.belt_sensor.image(number)
        sight = BeltWatch.of(empty, models, frames).sight(image, product)
        if sight is not None:
            lock[self.sightings][package] = sight.sighting(number, tray, product)
        return sight is not None
