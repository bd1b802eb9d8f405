"""Perception: controls the vision system, offline around a product and online above the tray."""

from __future__ import annotations

import time
from functools import partial
from typing import TYPE_CHECKING

from actors.geometry.recognition.plate import seen_from
from actors.geometry.recognition.segmentation import (
    assigned,
    footprint_pose,
    new_pieces,
    product_on_plate,
)
from actors.palletizing.sight.sensor import PLATE_M, open_sensor, steady
from actors.palletizing.vocabulary import (
    CLOUD,
    CONVEYOR,
    EMPTY,
    OBSERVATION,
    PACKAGES,
    PLACES,
    PLAN,
    PRODUCTS,
    SCAN,
    SIGHTING,
    STOP,
    TRAY,
    VIEWPOINT,
    VIEWS,
    Observation,
    Sighting,
    Viewpoint,
    place_entity,
    view_entity,
)
from enact_dist import Actor, Entity, View, ViewEach, World, Write, WriteEach

if TYPE_CHECKING:
    from actors.geometry.shapes import DepthFrame
    from actors.palletizing.sight.sensor import OrbitSensor, TraySensor
    from enact_dist import Lock


class TrainingPerception(Actor):
    """Orbit each product and keep what every viewpoint sees (ENACT 4.2, offline).

    One view per update.  The data show what remains to do: after a crash the orbit
    continues with the first missing view.

    Args:
        sensor: Address of the eye-in-hand sensor (`OrbitSensor`), see `open_sensor`.
        tray_sensor: Address of the overhead sensor (`TraySensor`), for the empty tray.
        plate_m: Edge of the square plate that products stand on, metres, by which the pose of a
            view is known better than by the robot; 0 if the plate's edges cannot be seen.
        frames: How many images are fused at each viewpoint.
    """

    training = World("training")
    scans = ViewEach(training, PRODUCTS, SCAN)
    clouds = WriteEach(training, VIEWS, CLOUD)
    viewpoints = WriteEach(training, VIEWS, VIEWPOINT)
    empty = Write(training, TRAY, EMPTY)
    every_s = 0.1

    def __init__(
        self, sensor: str, tray_sensor: str, plate_m: float = PLATE_M, frames: int = 4
    ) -> None:
        self.plate_m, self.frames = plate_m, frames
        self.sensor: OrbitSensor = open_sensor(sensor)
        self.tray_sensor: TraySensor = open_sensor(tray_sensor)

    def update(self, lock: Lock) -> None:
        """Take the next missing image, if one is missing."""
        if lock.is_null(self.empty):
            lock[self.empty] = self.tray_sensor.capture_empty()
            return
        done = lock[self.viewpoints].keys()
        for product, wanted in lock[self.scans].items():
            name = product.name.removeprefix("product/")
            for number in range(wanted):
                view = view_entity(name, number)
                if view not in done:
                    capture = partial(self.sensor.capture, name, number, wanted)
                    frame, now_ns = steady(capture, frames=self.frames), time.time_ns()
                    taken = seen_from(frame, self.plate_m) if self.plate_m else frame.acquisition
                    cloud, viewpoint = product_on_plate(frame), Viewpoint(taken, now_ns)
                    lock[self.clouds].put(view, cloud, stamp_ns=now_ns)
                    lock[self.viewpoints].put(view, viewpoint, stamp_ns=now_ns)
                    return


class OnlinePerception(Actor):
    """See what a stop of the conveyor has brought onto the tray (ENACT 4.2, online).

    Every piece on the tray is matched to the package entity that was seen there before; where
    there is none, a new one is made.  The patterns stay locked, so that two perceptions
    of one package make one entity.

    Args:
        sensor: Address of the overhead sensor (`TraySensor`), see `open_sensor`.
    """

    training, online = World("training"), World("online")
    stop_number = View(online, CONVEYOR, STOP)
    plans = ViewEach(training, PLACES, PLAN)
    empty = View(training, TRAY, EMPTY)
    observations = WriteEach(online, PLACES, OBSERVATION)
    clouds = WriteEach(online, PACKAGES, CLOUD)
    sightings = WriteEach(online, PACKAGES, SIGHTING)
    triggers = (stop_number,)

    def __init__(self, sensor: str) -> None:
        self.sensor: TraySensor = open_sensor(sensor)

    def update(self, lock: Lock) -> None:
        """Capture the tray, update the packages on it, and note what is new."""
        stop, plans = lock[self.stop_number], lock[self.plans]
        frame, captured_ns = self.sensor.capture(stop), time.time_ns()
        tray = plans[place_entity(stop)].tray
        new = self._update_packages(lock, frame, stop, tray)
        last, full = place_entity(stop - 1) if stop else None, tray - 1
        if last is None or plans[last].tray == full:
            before = lock[self.empty]
        else:
            before = lock[self.observations][last].frame
        seen = Observation(frame, before.depth_mm, tuple(new), captured_ns)
        lock[self.observations].put(place_entity(stop), seen, stamp_ns=captured_ns)

    def _update_packages(self, lock: Lock, frame: DepthFrame, stop: int, tray: int) -> list[str]:
        """Match all pieces on the tray to package entities; return the names of this stop's."""
        pieces = new_pieces(frame, lock[self.empty].depth_mm)
        known = {e: seen for e, seen in lock[self.sightings].items() if seen.tray == tray}
        matches = assigned(
            [piece.centre_m[:2] for piece in pieces],
            [seen.frame_from_package[:2, 3] for seen in known.values()],
        )
        new = []
        for piece, match in zip(pieces, matches, strict=True):
            package = Entity.fresh("package") if match is None else list(known)[match]
            first = stop if match is None else known[package].first_stop
            pose = footprint_pose(piece.cloud)
            lock[self.sightings][package] = Sighting(tray, pose, first, stop)
            if first == stop:
                lock[self.clouds][package] = piece.cloud
                new.append(package.name)
        return new
