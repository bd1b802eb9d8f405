"""What perception needs of a depth sensor; a real one and the simulated one both fit.

A real sensor implements the same two methods: the driver's depth image in millimetres, rectified,
with the intrinsic parameters and the calibrated (or, eye in hand, the robot's) camera pose.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from collections.abc import Iterator

    from actors.geometry.shapes import DepthFrame


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

    The world of its poses is the product frame: origin on the plate, z up.
    """

    def orbit(self, product: str) -> Iterator[DepthFrame]:
        """Yield one image per viewpoint; the poses are as good as the robot is.

        Args:
            product: Name of the product on the plate.
        """
        ...
