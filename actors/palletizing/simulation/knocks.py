"""Disturbances from outside, by which physics makes errors that seldom arise by themselves.

=========  =========================================================================================
moved      a sideways push on the package that was put down: it slides until friction stops it
tipped     a hand lifts it by an edge, and lets it fall over
deformed   something presses on its top, harder than its yield force
missing    the gripper opens when it sets out for the tray with the package
=========  =========================================================================================

A knock is named after what it is to lead to; what it leads to is up to physics, and the truth that
a score is of is read off physics as ever.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from actors.palletizing.simulation.cell.arm import CYCLE_S
from actors.palletizing.simulation.cell.scene import centre_of_mass
from actors.palletizing.simulation.physical_packages import STIFFNESS_N_MM
from actors.palletizing.simulation.products import product_mesh

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy.typing as npt

    from actors.palletizing.simulation.physical_packages import PhysicalPackage
    from actors.palletizing.simulation.physics import PhysicalCell

    F64 = npt.NDArray[np.float64]

KNOCKS: Final = ("moved", "tipped", "deformed", "missing")
GRAVITY_M_S2: Final = 9.81
PUSHED_CYCLES: Final = 5
PRESSED_CYCLES: Final = 12
LIFTED_CYCLES: Final = 500
"""How long each lasts at most."""
LIFTED_RAD_S: Final = 1.0
"""How fast a package is lifted by its edge."""
BEYOND_RAD: Final = float(np.deg2rad(4.0))
"""So far beyond its balance it is let fall."""
RANGES: Final = {"moved": (0.012, 0.035), "deformed": (5.0, 12.0), "missing": (0.0, 0.2)}
"""Least and greatest amount; 12 mm and 5 mm lie clear of the limits of what is sound."""
OPEN_S: Final = 0.4
"""So long does the gripper stay open."""


@dataclass(frozen=True, slots=True)
class Knock:
    """One disturbance.

    Attributes:
        kind: One of `KNOCKS`.
        amount: How far it slides (m), how deep the dent is (mm), or how long after the hand sets
            out for the tray the gripper opens (s).
        side: (2,), where on the package, shares of its half sizes; of a push: its direction against
            that of the robot's push, rad, and nothing.
    """

    kind: str
    amount: float
    side: tuple[float, float]


def draw_knocks(count: int, *, kinds: Sequence[str], seed: int) -> dict[int, Knock]:
    """Return the knock of each package of a tray: the kinds equally often, in a random order.

    Args:
        count: Of packages.
        kinds: Of `KNOCKS`; none: no knock.
        seed: Of all else about them.

    Raises:
        ValueError: No such kind.
    """
    for kind in kinds:
        if kind not in KNOCKS:
            raise ValueError(f"no error {kind!r} can be provoked; there are {', '.join(KNOCKS)}")
    if not kinds:
        return {}
    found = {}
    order = np.random.default_rng([seed, 17]).permutation(count)
    for number in range(count):
        kind = kinds[order[number] % len(kinds)]
        random = np.random.default_rng([seed, 17, number])
        low, high = RANGES.get(kind, (0.0, 0.0))
        side = random.uniform(-0.5, 0.5, 2)
        if kind == "moved":  # neither into the neighbour nor through the row before
            side = np.array([random.uniform(0.6, 1.4) * np.pi, 0.0])
        elif kind == "tipped":
            side = np.array([0.0, random.choice([-1.0, 1.0])])
        found[number] = Knock(kind, float(random.uniform(low, high)), (side[0], side[1]))
    return found


def knock_at(cell: PhysicalCell, package: PhysicalPackage, knock: Knock, push: F64) -> None:
    """Let a knock act on a package that stands on the tray.

    Args:
        cell: Goes on for as long as the knock lasts.
        package: Which.
        knock: Not "missing", for which the gripper fails for `OPEN_S`.
        push: (3,), where the robot pushes it, base frame; zeros if it does not.
    """
    half = np.abs(product_mesh(package.product)[0]).max(axis=0)
    weight_n = package.mass_kg * GRAVITY_M_S2
    centre = centre_of_mass(package.product) + package.centre_offset_m
    if knock.kind == "moved":
        along = push if push.any() else np.array([1.0, 0.0, 0.0])
        cosine, sine = np.cos(knock.side[0]), np.sin(knock.side[0])
        way = np.array(
            [along[0] * cosine - along[1] * sine, along[0] * sine + along[1] * cosine, 0]
        )
        speed_m_s = np.sqrt(2.0 * package.friction * GRAVITY_M_S2 * knock.amount)
        lasts_s = PUSHED_CYCLES * CYCLE_S
        force_n = package.mass_kg * speed_m_s / lasts_s + package.friction * weight_n
        for _ in range(PUSHED_CYCLES):
            cell.load(package.number, force_n * way, centre)
            cell.step()
    elif knock.kind == "deformed":
        force_n = package.yield_n("top") + STIFFNESS_N_MM * knock.amount
        at = np.array([knock.side[0] * half[0], knock.side[1] * half[1], half[2]])
        for _ in range(PRESSED_CYCLES):
            cell.load(package.number, np.array([0.0, 0.0, -force_n]), at)
            cell.step()
    elif knock.kind == "tipped":
        at = np.array([0.0, knock.side[1] * half[1], 0.0])
        balance_rad = float(np.arctan2(half[1], centre[2])) + BEYOND_RAD
        tilt_rad = before_rad = 0.0
        for _ in range(LIFTED_CYCLES):
            if tilt_rad - before_rad < LIFTED_RAD_S * CYCLE_S:
                cell.load(package.number, np.array([0.0, 0.0, 0.9 * weight_n]), at)
            cell.step()
            before_rad, tilt_rad = tilt_rad, cell.truth().packages[package.number].tilt_rad
            if tilt_rad > balance_rad:
                return
