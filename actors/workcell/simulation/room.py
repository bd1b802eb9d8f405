"""The simulated room: its boxes, its lamp, eight cameras; lengths in metres.

Frame of the cell: origin on the floor under the arm's base, z up.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from actors.geometry.poses import inverse, looking_at
from actors.workcell.vocabulary import CAMERA_COUNT, Calibration

if TYPE_CHECKING:
    import numpy.typing as npt

    from actors.workcell.scenarios import Scenario

HALF_M: Final = 3.6
"""The room reaches from minus this to this along x and y."""
HEIGHT_M: Final = 4.0
LAMP_M: Final = (0.5, 0.3, 3.5)

FOCAL_PX: Final = 440.0
"""72 degrees across 640 columns."""
TARGET_M: Final = (0.0, 0.0, 0.7)
"""All cameras look at this point."""


@dataclass(frozen=True, slots=True)
class Box:
    """A box whose sides are parallel to those of the cell.

    Attributes:
        name: What it is.
        centre_m: x, y, z.
        half_m: Half of its edges.
        colour: Blue, green, red, 0 to 1.
    """

    name: str
    centre_m: tuple[float, float, float]
    half_m: tuple[float, float, float]
    colour: tuple[float, float, float] = (0.5, 0.52, 0.55)

    def row(self) -> npt.NDArray[np.float64]:
        """Return it as a row of the aspect `boxes`: centre (3), half sizes (3), rotation (9)."""
        return np.concatenate([self.centre_m, self.half_m, np.eye(3).ravel()])


BOXES: Final = (
    Box("pedestal", (0.0, 0.0, 0.375), (0.25, 0.25, 0.375), (0.42, 0.40, 0.38)),
    Box("table", (0.95, 0.0, 0.375), (0.35, 0.6, 0.375), (0.47, 0.56, 0.62)),
    Box("cabinet", (-0.9, 1.1, 0.6), (0.3, 0.25, 0.6), (0.56, 0.52, 0.48)),
    Box("conveyor", (-0.5, -1.3, 0.45), (0.5, 0.2, 0.45), (0.40, 0.44, 0.42)),
)
"""The obstacles of the cell, except in scenarios with a walk-in cabinet."""


def _walk_in() -> tuple[Box, ...]:
    """Return a cabinet of 1.4 x 0.9 m and 2 m height, open to the side of minus x.

    Both cameras on that side look across its opening: further in than 0.7 m none sees anything.
    """
    west, east, south, north, top, wall = -1.95, -0.55, 1.05, 1.95, 2.0, 0.04
    x, y, up = (west + east) / 2.0, (south + north) / 2.0, top / 2.0
    deep, wide = (east - west) / 2.0, (north - south) / 2.0
    colour = (0.56, 0.52, 0.48)
    return (
        Box("cabinet-north", (x, north, up), (deep, wall / 2.0, up), colour),
        Box("cabinet-south", (x, south, up), (deep, wall / 2.0, up), colour),
        Box("cabinet-east", (east, y, up), (wall / 2.0, wide, up), colour),
        Box("cabinet-top", (x, y, top), (deep, wide, wall / 2.0), colour),
    )


WALK_IN: Final = (*(box for box in BOXES if box.name != "cabinet"), *_walk_in())
"""The obstacles of the cell in a scenario in which a person hides."""


def boxes_of(scenario: Scenario) -> tuple[Box, ...]:
    """Return the obstacles that the cell knows from the start."""
    return WALK_IN if scenario.walk_in else BOXES


THING_COLOUR: Final = (0.35, 0.55, 0.72)
"""Cardboard: of what a scenario leaves in the cell."""


def cameras(
    scale: float = 1.0, distortion: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0)
) -> tuple[Calibration, ...]:
    """Return the eight cameras: four in the corners at 2.7 m, four between them at 2.2 m.

    Args:
        scale: Of the image: 1 is 640 x 480 pixels, 0.25 is 160 x 120.
        distortion: k1, k2, p1, p2, k3, of all cameras.
    """
    width, height = round(640 * scale), round(480 * scale)
    matrix = np.array(
        [
            [FOCAL_PX * scale, 0.0, (width - 1) / 2.0],
            [0.0, FOCAL_PX * scale, (height - 1) / 2.0],
            [0.0, 0.0, 1.0],
        ]
    )
    found = []
    for number in range(CAMERA_COUNT):
        turn = math.radians(45.0 + 90.0 * number) if number < 4 else math.radians(90.0 * number)
        far, up = (2.6 * math.sqrt(2.0), 2.7) if number < 4 else (2.9, 2.2)
        eye = np.array([far * math.cos(turn), far * math.sin(turn), up])
        pose = inverse(looking_at(eye, np.array(TARGET_M)))
        found.append(Calibration(matrix, np.array(distortion), pose, width, height))
    return tuple(found)
