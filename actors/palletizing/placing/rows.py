"""Where packages shall stand when a robot pushes them together: rows on trays.

A row begins at the rim where x is greatest and runs against the tray's x axis, and so does the
length of its packages: the fingers, which hold them by their sides, need room between the rows but
none within one.  So the fingers decide where a package stands across its row, and the push where it
stands along it.  The first package of a row touches the rim, each further one the package before
it.  What would tip under a push, since it is taller than it is long, gets rows of its own, in which
neighbours keep a little distance.

Rule a change must keep: places are filled in their order; what has been put down is never between
a package and the place that the robot comes from to push it, nor where its fingers go down.

Sizes are those of the physical cell: a tray of 0.90 x 0.64 m, whose middle is 0.58 m in front of an
arm that reaches from 0.43 to 0.79 m with its hand down.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from actors.geometry.poses import on_tray

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    import numpy.typing as npt

    from actors.geometry.shapes import Surface

    F64 = npt.NDArray[np.float64]

ROWS_Y_M: Final = (-0.120, 0.010, 0.140)
"""Middles of the rows, tray frame, in the order they are filled: the far one first."""
ROW_START_M: Final = -0.448
"""Inner side of the rim that the first package touches, against the tray's x axis."""
ROW_END_M: Final = 0.360
"""Where a row ends, so counted: behind it the closed hand goes down within the rim."""
WIDTH_MAX_M: Final = 0.125
"""No wider may a package be across its row."""
RIM_M: Final = 0.030
"""Height of the tray's rim."""
TRAY_HALF_M: Final = (0.455, 0.325)
"""Half of the tray with its rim."""
APART_M: Final = 0.020
"""Between neighbours that are not pushed: where they are put down is not better known."""
BESIDE_M: Final = 0.005
"""Between packages of two rows."""
FINGER_M: Final = 0.021
"""The same where a finger goes down: its thickness, and what it opens."""
FINGER_HALF_M: Final = 0.030
"""Half of where along the row that may be, from the middle of the package."""


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


def planned_rows(
    products: Sequence[str],
    sizes_m: Mapping[str, F64],
    contacts_m: Mapping[tuple[str, str], float] | None = None,
) -> list[Slot]:
    """Return the place of each package.

    Args:
        products: What comes, in its order.
        sizes_m: Box of each product, (3,), metres, product frame: it is held by the sides along its
            y axis and pushed along its x axis.
        contacts_m: See `contacts_between`; as of boxes when absent.

    Raises:
        ValueError: A product is wider or longer than a row.
    """
    slots: list[Slot] = []
    tray, rows = 0, _Rows(contacts_m or {})
    for product in products:
        length, width, height = (float(each) for each in sizes_m[product])
        if width > WIDTH_MAX_M or length > ROW_END_M - ROW_START_M:
            room = f"{1e3 * (ROW_END_M - ROW_START_M):.0f} x {1e3 * WIDTH_MAX_M:.0f} mm"
            found = f"{1e3 * length:.0f} x {1e3 * width:.0f} mm"
            raise ValueError(f"{product} is {found} large; a row takes {room}")
        pushed = height <= length
        found_at = rows.take(product, length, width, pushed=pushed)
        if found_at is None:
            tray, rows = tray + 1, _Rows(contacts_m or {})
            found_at = rows.take(product, length, width, pushed=pushed)
            assert found_at is not None, "an empty tray takes every product that is not too large"
        push = np.array([1.0, 0.0, 0.0]) if pushed else np.zeros(3)
        slots.append(Slot(tray, on_tray(*found_at, np.pi), push))
    return slots


def contacts_between(surfaces: Mapping[str, Surface]) -> dict[tuple[str, str], float]:
    """Return how far apart along x the origins of two products are when the hulls touch.

    Args:
        surfaces: Trained surface of each product, product frame.

    Returns:
        By the product that stands and the one that is pushed against it, metres; the one that
        stands is "" for the rim, whose inner side is then the origin.
    """
    heights, sides = np.meshgrid(np.arange(0.001, 0.15, 0.002), np.arange(-0.08, 0.08, 0.004))
    extents = {name: _extent(surface, sides, heights) for name, surface in surfaces.items()}
    found = {}
    for pushed, (low, _) in extents.items():
        found["", pushed] = -float(low[heights <= RIM_M].min())
        for standing, (_, high) in extents.items():
            found[standing, pushed] = float(np.nanmax(np.where(high < low, np.nan, high - low)))
    return found


def _extent(surface: Surface, y_m: F64, z_m: F64) -> tuple[F64, F64]:
    """Return the least and greatest x of the hull of a surface at y and z; inf, -inf beside it."""
    from scipy.spatial import ConvexHull

    hull = ConvexHull(surface.vertices_m.astype(np.float64))
    planes = np.unique(hull.equations.round(6), axis=0)
    offset = planes[:, 1, None, None] * y_m + planes[:, 2, None, None] * z_m
    offset = offset + planes[:, 3, None, None]
    steep = np.abs(planes[:, 0]) > 1e-6
    x = -offset[steep] / planes[steep, 0, None, None]
    ahead = planes[steep, 0] > 0.0
    low, high = x[~ahead].max(axis=0), x[ahead].min(axis=0)
    inside = (low <= high) & (offset[~steep] <= 0.0).all(axis=0)
    return np.where(inside, low, np.inf), np.where(inside, high, -np.inf)


@dataclass(frozen=True, slots=True)
class _Taken:
    """A package on a tray: its row, its middle along it (against x), half its size."""

    product: str
    row: int
    x_m: float
    half_length_m: float
    half_width_m: float


class _Rows:
    """What stands on one tray."""

    def __init__(self, contacts_m: Mapping[tuple[str, str], float]) -> None:
        self._contacts_m = contacts_m
        self._taken: list[_Taken] = []
        self._pushed: dict[int, bool] = {}

    def take(
        self, product: str, length_m: float, width_m: float, *, pushed: bool
    ) -> tuple[float, float] | None:
        """Return where the next package stands, x and y in the tray frame; None if none fits."""
        for row, y_m in enumerate(ROWS_Y_M):
            if self._pushed.get(row, pushed) != pushed:
                continue
            half_m = length_m / 2.0
            stands = [each for each in self._taken if each.row == row]
            if stands:
                last = stands[-1]
                apart_m = self._contacts_m.get((last.product, product), last.half_length_m + half_m)
                x_m = last.x_m + apart_m
            else:
                x_m = ROW_START_M + self._contacts_m.get(("", product), half_m)
            if not pushed:
                x_m += APART_M
            new = _Taken(product, row, x_m, half_m, width_m / 2.0)
            if new.x_m + new.half_length_m <= ROW_END_M and self._has_room(new):
                self._pushed[row] = pushed
                self._taken.append(new)
                return -new.x_m, y_m
        return None

    def _has_room(self, new: _Taken) -> bool:
        """Return whether package and fingers go down beside what stands in the other rows."""
        for other in self._taken:
            if other.row == new.row:
                continue
            between_m = abs(ROWS_Y_M[other.row] - ROWS_Y_M[new.row])
            between_m -= other.half_width_m + new.half_width_m
            along_m = abs(other.x_m - new.x_m) - other.half_length_m
            if along_m < new.half_length_m and between_m < BESIDE_M:
                return False
            if along_m < FINGER_HALF_M and between_m < FINGER_M:
                return False
        return True
