"""Perception where a robot packs: looks at belt and tray whenever something ended there.

Rules a change must keep: a package keeps its entity from the belt to the tray; the tray is seen
with the arm aside only; a package is judged beside what stands around it now, see `tray_changes`.
"""

from __future__ import annotations

import math
import time
from collections import Counter
from typing import TYPE_CHECKING, Any, Final

from actors.geometry.open3d_on_use import open3d
from actors.geometry.poses import inverse
from actors.geometry.recognition.registration import register
from actors.geometry.recognition.segmentation import new_pieces
from actors.geometry.surfaces.depth import metres
from actors.palletizing.handling.stages import (
    ASIDE,
    GONE,
    NOT_ASIDE,
    TAKEN_OUT,
    UNRECOGNISED,
    is_held,
)
from actors.palletizing.sight.belt_sight import BeltWatch
from actors.palletizing.sight.sensor import FRAMES as FRAMES_FUSED
from actors.palletizing.sight.sensor import SensorError, Watched, open_sensor
from actors.palletizing.sight.tray_changes import changed, tray_alone, without
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
    Look,
    Observation,
    Sight,
    Sighting,
    product_entity,
)
from enact_dist import Actor, Entity, View, ViewEach, World, Write, WriteEach

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from actors.geometry.shapes import DepthFrame, Surface
    from actors.palletizing.sight.sensor import TraySensor
    from actors.palletizing.vocabulary import Arrival, Outcome, Request
    from enact_dist import Lock

    F64 = npt.NDArray[np.float64]
    Depth = npt.NDArray[Any]


GONE_M: Final = 0.15
"""What is farther from where a package stood is something else, when it shall be gone."""
UNSEEN_LOOKS: Final = 3
"""After so many looks that show nothing of what has come, the sight says so as an error."""


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
        self._arrived_ns = 0
        self._is_unseen = False
        self._unseen: Counter[int] = Counter()
        self._looked = 0

    def start(self) -> None:
        """Load Open3D before the first package comes: it takes a second or two."""
        open3d()

    def update(self, lock: Lock) -> None:
        """Look at the belt if a package has come, and where a request ended."""
        arrival, outcome = lock.get(self.arrival), lock.get(self.outcome)
        went, ended = self._way_aside(lock)
        if arrival is not None and self._looks_for(arrival.stamp_ns, went if ended == ASIDE else 0):
            self._see_arrival(lock, arrival)
        attached = lock.get(self.attached)
        if outcome is None or attached is None or attached.request != outcome.request or not ended:
            return
        before, request = lock.get(self.look), lock[self.request]
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

    def _way_aside(self, lock: Lock) -> tuple[int, str]:
        """Return the number of the net that takes the arm aside and how it ended; (0, "") if none.

        An arm that ended otherwise than aside stands anywhere and hides what is below.
        """
        attached, doing = lock.get(self.attached), lock.get(self.execution)
        if attached is None or doing is None or attached.stage != ASIDE:
            return 0, ""
        return attached.number, doing.result if doing.net_version == attached.number else ""

    def _looks_for(self, arrived_ns: int, aside: int) -> bool:
        """Return whether to look at the belt for a package that has come.

        At once, and as long as it was not seen, each time the arm has gone aside: an arm that
        stopped above the belt hides it.
        """
        looks = arrived_ns != self._arrived_ns or (
            self._is_unseen and aside not in {0, self._looked}
        )
        if looks:
            self._arrived_ns, self._looked = arrived_ns, aside
        return looks

    def _see_arrival(self, lock: Lock, arrival: Arrival) -> None:
        """Create the entity of the package that has come, unless it is known."""
        number = arrival.number
        known = lock[self.sightings].values()
        self._is_unseen = all(seen.first_stop != number for seen in known)
        if not self._is_unseen:
            return
        error = ""
        try:
            self._is_unseen = not self._see_belt(lock, Entity.fresh("package"), number)
            self._unseen[number] += self._is_unseen
            if self._is_unseen and arrival.is_gone:
                error = TAKEN_OUT
            elif self._is_unseen and self._unseen[number] >= UNSEEN_LOOKS:
                error = UNRECOGNISED
        except SensorError as failed:
            error = str(failed)
            print(error, flush=True)
        before = lock.get(self.sight)
        if error or before is not None:
            lock[self.sight] = Sight(number, error)

    def _look(self, lock: Lock, request: Request, outcome: Outcome) -> Look:
        """Look where the package of a request is; return what was seen.

        Raises:
            SensorError: The sensor cannot be believed.
        """
        if not request.package:  # what has come was looked for just now
            sight = lock.get(self.sight)
            return Look(request.number, "", 0, error="" if sight is None else sight.error)
        package, place = Entity(request.package), Entity(request.place)
        before = lock[self.sightings][package]
        grasp = lock[self.grasps].get(product_entity(before.product))
        if is_held(lock.get(self.grip), lock.get(self.gripper), grasp):
            return Look(request.number, "hand", 0)  # it would be seen above the tray
        missed = not outcome.success and outcome.stage == "grasp"
        on_belt = request.seen == "belt" and request.kind in {"look", "removed"}
        if (missed or on_belt) and self._see_belt(lock, package, before.first_stop):
            return Look(request.number, "belt", 0)
        empty = lock[self.empty_tray]
        frame, now_ns = tray_alone(self.tray_sensor.image(), empty), time.time_ns()
        tray = lock[self.plans][place].tray
        last = lock.get(self.last)
        moved = [] if last is None else changed(frame, last, self._standing(lock, tray))
        names = tuple(dict.fromkeys((package.name, *moved)))
        there = {}
        for name in names:  # the newest first: what it was pushed against is seen beside it
            before_mm = self._without(lock, name, tray, frame)
            near_m = GONE_M if name == package.name and request.kind in GONE else math.inf
            there[name] = self._see_tray(lock, Entity(name), frame, before_mm, near_m)
        judged = names[1:] if request.kind in GONE else names
        places = tuple(f"place/{lock[self.sightings][Entity(name)].first_stop}" for name in judged)
        for name, at in zip(judged, places, strict=True):  # where all of them stand is known now
            before_mm = self._without(lock, name, tray, frame)
            seen = Observation(frame, before_mm, (name,) if there[name] else (), now_ns)
            lock[self.observations].put(Entity(at), seen, stamp_ns=now_ns)
        lock[self.last] = frame
        if not there[package.name] and not outcome.success and self._is_newest(lock, before):
            self._see_belt(lock, package, before.first_stop)  # it was lost on its way
        return Look(request.number, lock[self.sightings][package].frame, now_ns, places)

    def _without(self, lock: Lock, name: str, tray: int, frame: DepthFrame) -> Depth:
        """Return the picture of a tray as it would be without a package."""
        standing = self._standing(lock, tray)
        others = [standing[other] for other in standing if other != name]
        return without(frame, lock[self.empty_tray].depth_mm, others)

    def _standing(self, lock: Lock, tray: int) -> dict[str, tuple[Surface, F64]]:
        """Return what stands on a tray: surface and tray_from_product by name of the package."""
        return {
            package.name: (
                lock[self.models][product_entity(seen.product)],
                seen.frame_from_package,
            )
            for package, seen in lock[self.sightings].items()
            if seen.frame == "tray" and seen.tray == tray
        }

    def _is_newest(self, lock: Lock, seen: Sighting) -> bool:
        """Return whether no package has come after one: later, the next one may lie there."""
        arrival = lock.get(self.arrival)
        return arrival is None or arrival.number == seen.first_stop

    def _see_belt(self, lock: Lock, package: Entity, number: int) -> bool:
        """Look for a package on the belt; return whether there is one."""
        before, frames = lock[self.sightings].get(package), lock.get(self.cell_frames)
        between = None if frames is None else inverse(frames["belt"]) @ frames["tray"]
        watch = BeltWatch(lock[self.empty_belt], self._models(lock), between)
        product = "" if before is None else before.product
        sight = watch.sight(self.belt_sensor.image(number), product)
        if sight is None:
            return False
        place = Entity(f"place/{number}")
        tray = lock[self.plans][place].tray if place in lock[self.plans] else 0
        product = sight.product if sight.known else product
        lock[self.sightings][package] = Sighting(
            tray, sight.belt_from_product, number, number, "belt", product, sight.unfit
        )
        return True

    def _see_tray(
        self, lock: Lock, package: Entity, frame: DepthFrame, before_mm: Depth, near_m: float
    ) -> bool:
        """Look for a package on the tray, so near to where it was; return whether it is there."""
        seen = lock[self.sightings][package]
        plan = lock[self.plans][Entity(f"place/{seen.first_stop}")]
        was = seen.frame_from_package if seen.frame == "tray" else plan.tray_from_product
        pieces = [
            piece
            for piece in (new_pieces(frame, before_mm) if seen.product else [])
            if math.dist(piece.centre_m[:2], was[:2, 3]) < near_m
        ]
        if pieces:
            surface = lock[self.models][product_entity(seen.product)]
            found = register(
                pieces[0].cloud, pieces[0].outline_m, surface, plan.tray_from_product,
                seen_by=frame.acquisition, before_m=metres(before_mm),
            )  # fmt: skip
            lock[self.clouds][package] = pieces[0].cloud
            where, pose = "tray", found.tray_from_product
        else:
            where, pose = "", seen.frame_from_package
        lock[self.sightings][package] = Sighting(
            plan.tray, pose, seen.first_stop, seen.last_stop, where, seen.product
        )
        return bool(pieces)

    def _models(self, lock: Lock) -> dict[str, Surface]:
        return {
            product.name.removeprefix("product/"): surface
            for product, surface in lock[self.models].items()
        }
