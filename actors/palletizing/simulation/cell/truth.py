"""What is true of the physical cell: where every package is, what has become of it, and why.

Rules a change must keep: everything here follows from the poses and forces of physics, never from
a list of what is to happen; only scores and pictures read it.
"""

# Truth travels between processes: annotations stay real types, without `from __future__`.

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from actors.geometry.poses import inverse, yaw_between, yaw_of
from actors.palletizing.simulation.physical_packages import Dent

TIPPED_RAD: Final = float(np.deg2rad(5.0))
"""A package that leans more has tipped."""
WHERE: Final = ("coming", "belt", "held", "tray", "bin", "beside", "away")
"""Where a package can be: "away" on a tray that was taken away, "beside" where nothing belongs."""


@dataclass(frozen=True, slots=True, eq=False)
class PackageTruth:
    """One package, as it really is.

    Attributes:
        number: From 0, in the order of coming.
        product: Name of the product.
        where: One of `WHERE`.
        base_from_product: (4, 4), metres.
        tray_from_product: (4, 4), metres.
        tilt_rad: Between its z axis and the vertical.
        dents: All it has suffered.
        missed: How often the gripper closed beside it.
        lost: How often it slipped out of the closed gripper.
        friction: Coefficient of friction.
        mass_kg: Its mass.
    """

    number: int
    product: str
    where: str
    base_from_product: npt.NDArray[np.float64]
    tray_from_product: npt.NDArray[np.float64]
    tilt_rad: float
    dents: tuple[Dent, ...]
    missed: int
    lost: int
    friction: float
    mass_kg: float

    @property
    def tipped(self) -> bool:
        """Whether it leans by more than 5°."""
        return self.tilt_rad > TIPPED_RAD

    @property
    def dent_mm(self) -> float:
        """Depth of its deepest dent, 0 if it is sound."""
        return max((dent.depth_mm for dent in self.dents), default=0.0)

    def beside_plan(self, planned: npt.NDArray[np.float64]) -> tuple[float, float]:
        """Return how far it is from where it should be: distance (m) and turn (rad), both ≥ 0.

        Args:
            planned: tray_from_product, (4, 4).
        """
        shift = float(np.linalg.norm(self.tray_from_product[:3, 3] - planned[:3, 3]))
        return shift, abs(yaw_between(yaw_of(planned), yaw_of(self.tray_from_product)))


@dataclass(frozen=True, slots=True)
class GripEvent:
    """What happened in the gripper.

    Attributes:
        kind: "grasped", "released", "lost" (out of the closed gripper) or "missed".
        package: Number of the package; the nearest one for "missed", -1 if none is near.
        at_s: When, simulated time.
    """

    kind: str
    package: int
    at_s: float


@dataclass(frozen=True, slots=True, eq=False)
class CellTruth:
    """The whole cell at one moment.

    Attributes:
        at_s: Simulated time.
        packages: All of them, those to come included.
        events: What happened in the gripper, oldest first.
    """

    at_s: float
    packages: tuple[PackageTruth, ...]
    events: tuple[GripEvent, ...]


@dataclass(frozen=True, slots=True, eq=False)
class ShownPackage:
    """A package as a sensor sees it.

    Attributes:
        number: From 0.
        product: Name of the product.
        base_from_product: (4, 4), metres.
        dents: All it has suffered.
        pick_offset_m: Error with which the belt's sensor is calibrated while it lies there.
    """

    number: int
    product: str
    base_from_product: npt.NDArray[np.float64]
    dents: tuple[Dent, ...]
    pick_offset_m: tuple[float, float]


@dataclass(frozen=True, slots=True, eq=False)
class ShownCell:
    """All that moves in the cell, as a sensor sees it.

    Attributes:
        stamp_ns: When, nanoseconds since 1970.
        q: (7,), joints, rad.
        width_m: Distance between the fingers.
        packages: Those in the cell.
        camera: How its depth sensors have failed: "frozen", "blind", or "" if they work.
    """

    stamp_ns: int
    q: npt.NDArray[np.float64]
    width_m: float
    packages: tuple[ShownPackage, ...]
    camera: str = ""


def place_of(
    lowest_m: float,
    centre_m: npt.NDArray[np.float64],
    areas: dict[str, tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]],
) -> str:
    """Return over which area a package lies; "beside" if over none.

    Args:
        lowest_m: Height of its lowest point, base frame.
        centre_m: (3,), its centre, base frame.
        areas: By name: base_from_area (4, 4), the least and the greatest (x, y) as (2, 2).
    """
    for name, (base_from_area, corners) in areas.items():
        x, y, _ = inverse(base_from_area)[:3, :3] @ centre_m + inverse(base_from_area)[:3, 3]
        inside = (corners[0] <= (x, y)).all() and ((x, y) <= corners[1]).all()
        if inside and lowest_m > base_from_area[2, 3] - 0.01:
            return name
    return "beside"
