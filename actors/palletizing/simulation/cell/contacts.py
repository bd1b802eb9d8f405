"""What touches what in the physical cell: who is pressed how hard, what is in the gripper.

Rules a change must keep: all of it is read off the contacts of one cycle; a package is named by
its number, anything else by the name of its geom.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from actors.palletizing.simulation.cell.truth import GripEvent
from actors.palletizing.simulation.physical_packages import patch_area

if TYPE_CHECKING:
    from collections.abc import Callable

    import numpy.typing as npt

    F64 = npt.NDArray[np.float64]

TOUCH_N: Final = 0.5
"""A finger that presses less does not hold."""
SETTLED_CYCLES: Final = 25
"""So long do fingers stand still before they have closed, or a package is out of them."""
STILL_M_S: Final = 0.001


@dataclass(frozen=True, slots=True, eq=False)
class Patch:
    """All contacts of a package with one other body.

    Attributes:
        by: Name of the other geom; "cell" if it has none.
        force_n: Sum of the normal forces.
        area_m2: Of the patch.
        at_m: (3,), its middle weighted by force, base frame.
        inwards: (3,), mean direction of the force on the package, base frame.
    """

    by: str
    force_n: float
    area_m2: float
    at_m: F64
    inwards: F64


class Contacts:
    """The contacts of one cycle.

    Args:
        model: MuJoCo's model of the cell.
        data: Its state.
        package_of: (geoms,) number of the package that a geom is, -1 for all else.
    """

    def __init__(self, model: Any, data: Any, package_of: npt.NDArray[np.intp]) -> None:
        self._model, self._data, self._package_of = model, data, package_of
        contact = data.contact
        addresses = np.array(contact.efc_address)
        self._pairs = np.array(contact.geom).reshape(-1, 2)
        self._forces = np.zeros(len(addresses))
        real = addresses >= 0
        if real.any():
            # With elliptic cones a contact's first number is its normal force.
            self._forces[real] = data.efc_force[addresses[real]]

    def on_packages(self, count: int) -> F64:
        """Return what presses on each package, all patches together, (count,) N."""
        owners = self._package_of[self._pairs] + 1
        total = np.bincount(owners[:, 0], self._forces, count + 1)
        return np.asarray((total + np.bincount(owners[:, 1], self._forces, count + 1))[1:])

    def patches(self, geom: int) -> list[Patch]:
        """Return the patches on a package, given its geom."""
        mine = (self._pairs == geom).any(axis=1) & (self._forces > 0.0)
        others = self._pairs.sum(axis=1) - geom
        contact = self._data.contact
        found = []
        for other in np.unique(others[mine]):
            rows = mine & (others == other)
            force = self._forces[rows]
            # A contact's normal points from its first geom to its second.
            sign = np.where(self._pairs[rows, 1] == geom, 1.0, -1.0)
            points = np.array(contact.pos)[rows]
            normal = (np.array(contact.frame)[rows, :3] * sign[:, None]).T @ force
            normal /= max(float(np.linalg.norm(normal)), 1e-9)
            found.append(
                Patch(
                    by=self._model.geom(int(other)).name or "cell",
                    force_n=float(force.sum()),
                    area_m2=patch_area(points, normal),
                    at_m=points.T @ force / force.sum(),
                    inwards=normal,
                )
            )
        return found

    def between(self, pads: tuple[int, int]) -> int:
        """Return the number of the package that both fingers press, -1 if none."""
        both: set[int] | None = None
        for pad in pads:
            rows = (self._pairs == pad).any(axis=1) & (self._forces > TOUCH_N)
            if not rows.any():
                return -1
            others = self._package_of[self._pairs[rows].sum(axis=1) - pad]
            touched = {int(number) for number in others if number >= 0}
            both = touched if both is None else both & touched
        return min(both) if both else -1


class GripWatch:
    """Notices what is grasped, released, lost and missed.

    Attributes:
        held: Number of the package in the gripper, -1 if none.
        events: What happened, oldest first.
    """

    def __init__(self) -> None:
        self.held = -1
        self.events: list[GripEvent] = []
        self._apart_cycles = self._still_cycles = 0
        self._told = True

    def watch(
        self,
        between: int,
        *,
        closing_cycles: int,
        rate_m_s: float,
        nearest: Callable[[], int],
        now_s: float,
    ) -> None:
        """Take one cycle.

        Args:
            between: Number of the package that both fingers press, -1 if none.
            closing_cycles: Since how many cycles the gripper is to press, 0 if it is not.
            rate_m_s: Speed of a finger.
            nearest: Returns the number of the package nearest to the tool, -1 if none is near.
            now_s: Simulated time.
        """
        if between >= 0:
            self._apart_cycles = 0
            if between != self.held:
                self.held, self._told = between, True
                self.events.append(GripEvent("grasped", between, now_s))
        elif self.held >= 0:
            self._apart_cycles += 1
            if not closing_cycles or self._apart_cycles >= SETTLED_CYCLES:
                kind = "lost" if closing_cycles else "released"
                self.events.append(GripEvent(kind, self.held, now_s))
                self.held = -1
        elif closing_cycles <= 1:
            self._told, self._still_cycles = not closing_cycles, 0
        else:
            still = abs(rate_m_s) < STILL_M_S
            self._still_cycles = self._still_cycles + 1 if still else 0
            if not self._told and self._still_cycles >= SETTLED_CYCLES:
                self._told = True
                self.events.append(GripEvent("missed", nearest(), now_s))
