"""Where packages shall stand: the places of a tray, and which place is whose.

Rule a change must keep: places go on counting over trays; stop n of the conveyor brings the
package for place n.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from actors.geometry.poses import on_tray

if TYPE_CHECKING:
    import numpy.typing as npt

TRAY_PLACES: Final = tuple((x, y) for y in (-0.15, 0.15) for x in (-0.315, -0.105, 0.105, 0.315))
"""Centres of the places of one tray, metres, tray frame, in the order they are filled.

Neighbours leave 85 mm between two milk cartons: a gripper of 70 mm fits, and so does a package
that was put down 40 mm beside its place."""


def tray_of(stop: int) -> int:
    """Return the number of the tray that the package of a stop goes onto."""
    return stop // len(TRAY_PLACES)


def planned_pose(stop: int) -> npt.NDArray[np.float64]:
    """Return tray_from_product of the package of a stop: along y, heads towards the middle."""
    x, y = TRAY_PLACES[stop % len(TRAY_PLACES)]
    return on_tray(x, y, np.pi / 2.0 if y < 0.0 else -np.pi / 2.0)
