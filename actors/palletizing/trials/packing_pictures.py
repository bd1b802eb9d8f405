"""Pictures of provoked errors: before, with the error, and after what was done about it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from actors.geometry.pictures.picture import png_bytes
from actors.palletizing.control.controller import ControllerError
from actors.palletizing.simulation.cell.picture import CellPictures

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    import numpy.typing as npt

    from actors.palletizing.simulation.knocks import Knock
    from actors.palletizing.simulation.physics import PhysicalCell


class Strips:
    """Writes a strip of three pictures for the first package of each kind of knock.

    Where MuJoCo cannot draw, `undrawn.txt` says why.

    Args:
        folder: Of the files, `KIND_SEED_PACKAGE.png`.
        seed: Of the tray.
        knocks: What happens to each package.
    """

    def __init__(self, folder: Path, seed: int, knocks: Mapping[int, Knock]) -> None:
        self._folder, self._seed = folder, seed
        self._kinds = {number: knock.kind for number, knock in knocks.items()}
        self._taken: dict[int, list[npt.NDArray[np.uint8]]] = {}
        self._pictures: CellPictures | None = None

    def of(self, cell: PhysicalCell) -> None:
        """Take pictures of a cell from now on."""
        try:
            self._pictures = CellPictures(cell, width=480, height=360)
        except ControllerError as error:
            (self._folder / "undrawn.txt").write_text(f"{error}\n")

    def take(self, number: int, moment: str) -> None:
        """Take one picture: "before", "error" or "after"; with the last one write the strip."""
        if self._pictures is None or number not in self._kinds:
            return
        taken = self._taken.setdefault(number, [])
        if moment != "before" and not taken:
            return
        taken.append(self._pictures.draw())
        if moment != "after":
            return
        kind = self._kinds.pop(number)
        strip = png_bytes(np.concatenate(taken, axis=1))
        (self._folder / f"{kind}_{self._seed}_{number}.png").write_bytes(strip)
        same = [each for each, its in self._kinds.items() if its == kind]
        for each in same:
            del self._kinds[each]
