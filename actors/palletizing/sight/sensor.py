"""What perception needs of a depth sensor; a real one and the simulated one both fit.

A real sensor implements the same two or three methods: the driver's depth image in millimetres,
rectified, with the intrinsic parameters and the calibrated (or, eye in hand, the robot's) pose.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final, Protocol

import numpy as np

from actors.geometry.surfaces.depth import fused
from actors.palletizing.control.controller import open_controller

if TYPE_CHECKING:
    from collections.abc import Callable

    from actors.geometry.shapes import DepthFrame

FRAMES: Final = 8
"""Images that are fused into one: 0.27 s of a sensor that takes 30 a second."""

PLATE_M: Final = 0.36
"""Edge of the square plate that a product is scanned on: so small that a sensor 0.45 m above sees
its edges, by which each view knows better than the robot where it was taken from."""


def steady(capture: Callable[[], DepthFrame], *, frames: int = FRAMES) -> DepthFrame:
    """Return one image of several that are taken one after the other.

    Args:
        capture: Takes one, of a scene that stands still: ``lambda: sensor.capture(stop)``.
        frames: How many.
    """
    return fused([capture() for _ in range(frames)])


class SensorError(RuntimeError):
    """A sensor cannot be believed, or gave nothing; the text names it and says why."""


class Watched:
    """A fixed sensor whose images are fused, and never believed when it has failed.

    No two images of a depth sensor are the same, whatever they show: their noise differs.  So one
    whose images of one look are all the same stands still; a single image is compared with the one
    of the look before.

    Args:
        sensor: The sensor.
        name: What it is called when it fails: "the belt sensor".
        frames: How many images are fused into one.
    """

    def __init__(self, sensor: TraySensor, name: str, frames: int = FRAMES) -> None:
        self._sensor, self._name, self._frames = sensor, name, frames
        self._last: DepthFrame | None = None

    def image(self, stop: int = 0) -> DepthFrame:
        """Return one image of several that are taken now.

        Args:
            stop: See `TraySensor.capture`.

        Raises:
            SensorError: The sensor gave no image, or stands still.
        """
        taken: list[DepthFrame] = []

        def capture() -> DepthFrame:
            taken.append(self._sensor.capture(stop))
            return taken[-1]

        try:
            image = steady(capture, frames=self._frames)
        except Exception as error:  # a driver raises what it likes
            raise SensorError(f"{self._name} gave no image: {error}") from error
        before = [] if self._last is None else [self._last]
        self._last = taken[-1]
        compared = taken if len(taken) > 1 else [*before, *taken]
        images = [frame.depth_mm for frame in compared]
        if len(images) > 1 and all(np.array_equal(one, images[0]) for one in images[1:]):
            raise SensorError(
                f"{self._name} stands still: {len(images)} images in a row are the very same"
            )
        return image


class TraySensor(Protocol):
    """A depth sensor fixed above the tray; the world of its poses is the tray frame."""

    def capture_empty(self) -> DepthFrame:
        """Return an image of the tray with nothing on it."""
        ...

    def capture(self, stop: int) -> DepthFrame:
        """Return an image of the tray while the conveyor stands at a stop.

        Args:
            stop: Number of the stop, from 0; a real sensor has no choice and ignores it.
        """
        ...


class OrbitSensor(Protocol):
    """A depth sensor in the hand of a robot that orbits one product on a plate.

    The world of its poses is the product frame: origin in the middle of the plate, z up, the plate
    square with its edges along x and y.
    """

    def capture(self, product: str, view: int, views: int) -> DepthFrame:
        """Go to a viewpoint and return an image from there.

        Args:
            product: Name of the product on the plate.
            view: Number of the viewpoint, from 0.
            views: How many viewpoints the orbit has.
        """
        ...


def open_sensor(address: str) -> Any:
    """Return the sensor at an address, as `open_controller` does; the caller knows its protocol."""
    return open_controller(address, "sensor")
