"""What physics did to a package, in the words of the verdicts; only scores read it."""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, Final

import numpy as np

from actors.geometry.shapes import Surface
from actors.palletizing.placing.rows import ROW_START_M, contacts_between
from actors.palletizing.simulation.products import PRODUCTS, product_mesh

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy.typing as npt

    from actors.palletizing.placing.rows import Slot
    from actors.palletizing.simulation.cell.truth import PackageTruth

    F64 = npt.NDArray[np.float64]

KINDS: Final = ("ok", "moved", "tipped", "deformed", "missing")
MOVED_MM: Final = 10.0
TURNED_DEG: Final = 5.0
DENTED_MM: Final = 4.0
"""A sound package is off, turned and dented by less."""
SOUND_MM: Final = 1.5
"""A place with a deeper dent is not sound, though physics counts dents from 4 mm as deformed and
perception has to find those from 3 mm: scores count such a dent apart."""
DENTED: Final = "dented"
"""What such a place is called."""
WORSE: Final = {"ok": 0, "belt": 1, "held": 1, "moved": 1, "bin": 2}
"""How bad a state is; all others are worse."""
ROW_M: Final = 0.05
"""Packages are of one row when their middles are no farther apart across it."""


def truth_of(truth: PackageTruth, planned: F64) -> str:
    """Return what is the matter with a package, given its place (tray_from_product)."""
    shift_m, turn_rad = truth.beside_plan(planned)
    if truth.where != "tray":
        return "missing"
    if truth.tipped:
        return "tipped"
    if 1e3 * shift_m > MOVED_MM or np.degrees(turn_rad) > TURNED_DEG:
        return "moved"
    return "deformed" if top_dent_mm(truth) >= DENTED_MM else "ok"


def seen_as(truth: PackageTruth, planned: F64) -> str:
    """Return the same as `truth_of`, and `DENTED` for a dent between sound and deformed."""
    kind = truth_of(truth, planned)
    return DENTED if kind == "ok" and top_dent_mm(truth) >= SOUND_MM else kind


def state_of(truth: PackageTruth, planned: F64) -> str:
    """Return the worst that is the matter with a package; where it is while it is not on the tray.

    A dent that stays when a package is moved was there before.
    """
    kind = truth_of(truth, planned) if truth.where == "tray" else truth.where
    if kind not in {"moved", truth.where}:
        return kind
    return "deformed" if top_dent_mm(truth) >= DENTED_MM else kind


def badness(state: str) -> int:
    """Return how bad a state is, 0 if all is well."""
    return WORSE.get(state, 3)


def in_words(truth: PackageTruth, planned: F64) -> str:
    """Return what physics made of a package, in numbers."""
    words = [truth.where]
    if truth.where == "tray":
        shift_m, turn_rad = truth.beside_plan(planned)
        words = [f"{1e3 * shift_m:.1f} mm", f"{np.degrees(turn_rad):.1f}°"]
        if truth.tipped:
            words.append(f"leans {np.degrees(truth.tilt_rad):.0f}°")
        if truth.dent_mm > 0.0:
            words.append(f"dent {truth.dent_mm:.1f} mm")
    counts = (("missed", truth.missed), ("lost", truth.lost))
    return ", ".join([*words, *(f"{word} {count}x" for word, count in counts if count)])


def top_dent_mm(truth: PackageTruth) -> float:
    """Return the depth of the deepest dent that a sensor above can see, 0 if there is none."""
    return max((dent.depth_mm for dent in truth.dents if dent.face == "top"), default=0.0)


def gap_m(number: int, slots: Sequence[Slot], truth: Sequence[PackageTruth]) -> float:
    """Return the gap between a package and what it was pushed against: its neighbour or the rim."""
    y, own = slots[number].tray_from_product[1, 3], truth[number]
    standing, at = "", ROW_START_M
    for slot, other in zip(slots[:number], truth, strict=False):
        if abs(slot.tray_from_product[1, 3] - y) < ROW_M and other.where == "tray":
            x = -float(other.tray_from_product[0, 3])
            standing, at = (other.product, x) if x > at else (standing, at)
    return -float(own.tray_from_product[0, 3]) - at - _contacts()[standing, own.product]


@lru_cache(maxsize=1)
def _contacts() -> dict[tuple[str, str], float]:
    """Return how far apart the true shapes are when they touch, by standing and pushed product."""
    shapes = {name: Surface.free_form(*product_mesh(name)) for name in PRODUCTS}
    return contacts_between(shapes)
