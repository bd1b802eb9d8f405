"""Where packages shall stand when a robot pushes them together: rows on trays.

A row runs along the tray's x axis.  Its first package touches the rim, each further one the package
before it.  What would tip under a push, since it is taller than it is deep, gets a row of its own,
in which neighbours keep a little distance.

Rule a change must keep: places are filled in their order; what has been put down is never between
a package and the place that the robot comes from to push it.

Sizes are those of the physical cell: a tray of 0.90 x 0.64 m, whose middle is 0.58 m in front of an
arm that reaches from 0.42 to 0.79 m with its hand down.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from actors.geometry.poses import on_tray

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    import numpy.typing as npt

    F64 = npt.NDArray[np.float64]

ROWS_Y_M: Final = (-0.075, 0.140)
"""Middles of the rows, tray frame, in the order they are filled: the far one first."""
ROW_DEPTH_M: Final = 0.21
"""No longer may a package be across its row."""
ROW_START_M: Final = -0.448
"""Inner side of the rim that the first package touches."""
ROW_END_M: Final = 0.300
"""Where a row ends: behind it the closed hand needs 0.14 m to go down within the rim."""
TOUCHING_M: Final = 0.0005
"""Between neighbours of a row, as planned: what a push leaves."""
APART_M: Final = 0.012
"""Between neighbours that are not pushed: the spread of where they are put down."""
STEADY: Final = 1.0
"""What is taller than this share of its depth along the push would tip."""


@dataclass(frozen=True, slots=True, eq=False)
class Slot:
    """Where one package shall stand.

    Attributes:
        tray: Number of the tray.
        tray_from_product: Where on it, (4, 4) float64, metres.
        push: (3,) float64, level unit vector, tray frame, in which it is pushed into contact; zeros
            if it is not pushed.
    """

    tray: int
    tray_from_product: F64
    push: F64


def planned_rows(products: Sequence[str], sizes_m: Mapping[str, F64]) -> list[Slot]:
    """Return the place of each package.

    Args:
        products: What comes, in its order.
        sizes_m: Box of each product, (3,), metres, product frame: it is pushed along its y axis.

    Raises:
        ValueError: A product is longer than a row is deep, or wider than a row is long.
    """
    slots: list[Slot] = []
    tray, rows = 0, _Rows()
    for product in products:
        size = np.asarray(sizes_m[product], np.float64)
        pushed = bool(size[2] <= STEADY * size[1])
        across, along = (size[0], size[1]) if pushed else (size[1], size[0])
        if across > ROW_DEPTH_M or along > ROW_END_M - ROW_START_M:
            room = f"{1e3 * ROW_DEPTH_M:.0f} x {1e3 * (ROW_END_M - ROW_START_M):.0f} mm"
            found = f"{1e3 * across:.0f} x {1e3 * along:.0f} mm"
            raise ValueError(f"{product} takes {found} of a row; a row has {room}")
        if not rows.takes(along, pushed=pushed):
            tray, rows = tray + 1, _Rows()
        x, y = rows.take(along, pushed=pushed)
        yaw = -np.pi / 2.0 if pushed else 0.0
        push = np.array([-1.0, 0.0, 0.0]) if pushed else np.zeros(3)
        slots.append(Slot(tray, on_tray(x, y, yaw), push))
    return slots


class _Rows:
    """How far the rows of one tray are filled."""

    def __init__(self) -> None:
        self._free = list(ROWS_Y_M)
        self._end: dict[bool, float] = {}
        self._row: dict[bool, float] = {}

    def takes(self, along_m: float, *, pushed: bool) -> bool:
        """Return whether another package fits."""
        return bool(self._free) or self._fits(along_m, pushed=pushed)

    def take(self, along_m: float, *, pushed: bool) -> tuple[float, float]:
        """Return the middle of the next package, x and y in the tray frame."""
        if not self._fits(along_m, pushed=pushed):
            self._row[pushed], self._end[pushed] = self._free.pop(0), ROW_START_M
        apart_m = TOUCHING_M if pushed else APART_M
        x = self._end[pushed] + apart_m + along_m / 2.0
        self._end[pushed] = x + along_m / 2.0
        return x, self._row[pushed]

    def _fits(self, along_m: float, *, pushed: bool) -> bool:
        apart_m = TOUCHING_M if pushed else APART_M
        return pushed in self._end and self._end[pushed] + apart_m + along_m <= ROW_END_M
