"""Where the fingers go down beside a package, and what stands in their way.

PURE.  Seen from above, a finger is a box beside the package, half the opening away from its middle.
What lies under that box and is high is in the way: another package, or the rim of the tray.  Over
what is low the hand grasps higher, as long as the fingers still hold enough of the package.

Rule a change must keep: the grasp that a request begins with is that of all its stages, since a
package is put down as it was taken.
"""

# The wire reads these annotations: they stay real types, without `from __future__`.

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import numpy.typing as npt

from actors.geometry.poses import inverse
from actors.geometry.poses import on_tray as pose_on_tray
from actors.palletizing.placing.rows import RIM_M, TRAY_HALF_M

F64 = npt.NDArray[np.float64]
Beside = tuple[tuple[str, F64, F64], ...]
"""Entity, where it stands, and the box of each other package, see `grounding.Job`."""

REGRASP_OPEN_M: Final = 0.014
"""So much wider than the package the hand opens where others stand, see skeletons/regrasp.toml."""
PLAYS: Final = 3.0
"""So many times its play is the hand wider open than a package on the belt, if it can be."""
ROOM_M: Final = 0.002
"""Between a finger and what stands beside the package, at least."""
OVER_M: Final = 0.003
"""Between the fingers' tips and what they go over."""
HELD_LEAST_M: Final = 0.012
"""Of its height a package is between the fingers at least."""
FLAT_M2: Final = 0.0007
"""A flat contact has at least this area: what the dent of a finger would take."""
LINE_N: Final = 25.0
"""Of fingers on less: a rim, a round wall, the edge of a face, which would give way."""
RIM_THICK_M: Final = 0.007
"""Thickness of the tray's rim, with what it is off."""


@dataclass(frozen=True, slots=True, eq=False)
class Grasp:
    """Where and how a product is held (product/*).

    Attributes:
        point: (3,) float64, metres, product frame: the middle between the fingers.
        axis: (3,) float64, unit vector, level, product frame: from one finger to the other.
        width_m: Between the fingers that hold it.
        force_n: Of the fingers.
        push_height_m: Above the product's base, where a push does not tip it.
        mass_kg: Of the product.
    """

    point: npt.NDArray[np.float64]
    axis: npt.NDArray[np.float64]
    width_m: float
    force_n: float
    push_height_m: float
    mass_kg: float


@dataclass(frozen=True, slots=True)
class Gripper:
    """What a parallel gripper can do; by default a stroke of 70 mm from 65 mm on.

    Attributes:
        least_m: Between the closed fingers.
        most_m: Between the open fingers.
        play_m: So much wider than a package it opens at least.
        force_n_max: Of the fingers.
        payload_kg: Greatest mass of what it holds.
        mass_kg: Its own, which the arm carries as well.
        half_m: Half the hand along the fingers' way when it is closed.
        half_across_m: Half the fingers across it.
        tips_m: So far do the fingers reach beyond the tool.
    """

    least_m: float = 0.065
    most_m: float = 0.135
    play_m: float = 0.010
    force_n_max: float = 60.0
    payload_kg: float = 2.0
    mass_kg: float = 1.0
    half_m: float = 0.0445
    half_across_m: float = 0.012
    tips_m: float = 0.020


def open_m(grasp: Grasp, gripper: Gripper, *, on_belt: bool) -> float:
    """Return how wide the hand is open when it goes down to a package, metres."""
    more_m = PLAYS * gripper.play_m if on_belt else REGRASP_OPEN_M
    return min(gripper.most_m, grasp.width_m + more_m)


def rim_beside(base_from_tray: F64) -> Beside:
    """Return the four sides of the tray's rim, as what stands beside a package."""
    length, width = 2.0 * np.array(TRAY_HALF_M)
    at_x, at_y = np.array(TRAY_HALF_M) - 0.5 * RIM_THICK_M
    along = np.array([length, RIM_THICK_M, RIM_M])
    across = np.array([RIM_THICK_M, width, RIM_M])
    sides = [(0.0, s * at_y, along) for s in (-1, 1)] + [(s * at_x, 0.0, across) for s in (-1, 1)]
    return tuple(
        ("the rim of the tray", base_from_tray @ pose_on_tray(x, y, 0.0), size)
        for x, y, size in sides
    )


def on_tray(base_from_tray: F64, base_from_product: F64) -> bool:
    """Return whether the middle of a package is within the rim of the tray."""
    at = (inverse(base_from_tray) @ base_from_product)[:2, 3]
    return bool((np.abs(at) < TRAY_HALF_M).all())


def over_low(
    grasp: Grasp,
    size_m: F64,
    base_from_grasp: F64,
    beside: Beside,
    gripper: Gripper,
    opened_m: float,
) -> Grasp:
    """Return a grasp whose fingers end over what is low beside the package, if that can be.

    Fingers that hold less of a flat face press less.

    Args:
        grasp: As trained.
        size_m: (3,), box of the product.
        base_from_grasp: (4, 4), the middle between the fingers, y their way, z up.
        beside: What stands around, see `grounding.Job`.
        gripper: What holds it.
        opened_m: Between the fingers as they go down.
    """
    floor_m = float(base_from_grasp[2, 3] - grasp.point[2])
    tops_m = [top_m for _, top_m in _under(base_from_grasp, beside, gripper, opened_m)]
    point_m = max(tops_m, default=-np.inf) - floor_m + OVER_M + gripper.tips_m
    most_m = float(size_m[2]) - HELD_LEAST_M + gripper.tips_m
    if not grasp.point[2] < point_m <= most_m:
        return grasp
    held_m2 = 2.0 * gripper.half_across_m * (float(size_m[2]) - point_m + gripper.tips_m)
    force_n = grasp.force_n if held_m2 > FLAT_M2 else min(grasp.force_n, LINE_N)
    return replace(grasp, point=np.array([*grasp.point[:2], point_m]), force_n=force_n)


def in_the_way(
    base_from_grasp: F64, beside: Beside, gripper: Gripper, opened_m: float
) -> str | None:
    """Return what a finger would come down on, None if there is room."""
    tips_m = float(base_from_grasp[2, 3]) - gripper.tips_m
    for entity, top_m in _under(base_from_grasp, beside, gripper, opened_m):
        if top_m + ROOM_M > tips_m:
            return entity
    return None


def _under(
    base_from_grasp: F64, beside: Beside, gripper: Gripper, opened_m: float
) -> Iterator[tuple[str, float]]:
    """Yield what lies under a finger, and where it ends above, base frame."""
    thick_m = gripper.half_m - 0.5 * gripper.least_m
    half = np.array([gripper.half_across_m, 0.5 * thick_m]) + ROOM_M
    for side in (-1.0, 1.0):
        base_from_finger = base_from_grasp.copy()
        base_from_finger[:3, 3] += side * 0.5 * (opened_m + thick_m) * base_from_grasp[:3, 1]
        for entity, base_from_product, size_m in beside:
            if _overlap(base_from_finger, half, base_from_product, 0.5 * size_m[:2]):
                yield entity, float(base_from_product[2, 3] + size_m[2])


def _overlap(first: F64, first_half: F64, second: F64, second_half: F64) -> bool:
    """Return whether two upright boxes overlap seen from above: no level axis parts them."""
    apart = second[:2, 3] - first[:2, 3]
    for axis in (*first[:2, :2].T, *second[:2, :2].T):
        reach = np.abs(axis @ first[:2, :2]) @ first_half
        if abs(axis @ apart) >= reach + np.abs(axis @ second[:2, :2]) @ second_half:
            return False
    return True
