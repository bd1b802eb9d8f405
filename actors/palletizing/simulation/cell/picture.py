"""The physical cell as a person would see it, drawn by MuJoCo; needs EGL or another OpenGL.

Rule a change must keep: a `CellPictures` belongs to the thread that made it, as OpenGL wants.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import numpy as np

from actors.palletizing.control.controller import ControllerError
from actors.palletizing.simulation.cell.scene import load_mujoco
from actors.palletizing.simulation.physics import PICTURE_PX

if TYPE_CHECKING:
    import numpy.typing as npt

    from actors.palletizing.simulation.physics import PhysicalCell

MARK_RGBA: Final = (0.85, 0.1, 0.1, 1.0)
"""Colour of the mark over a dent, as physics bodies stay convex."""


class CellPictures:
    """Draws the cell.

    Args:
        cell: The cell.
        width: Of the pictures, px.
        height: Of the pictures, px.

    Raises:
        ControllerError: MuJoCo cannot draw here; the text says why.
    """

    def __init__(self, cell: PhysicalCell, *, width: int = 640, height: int = 480) -> None:
        if not (0 < width <= PICTURE_PX[0] and 0 < height <= PICTURE_PX[1]):
            raise ControllerError(
                f"asked for a picture of {width} x {height} px; at most"
                f" {PICTURE_PX[0]} x {PICTURE_PX[1]}"
            )
        self._cell, self._mujoco = cell, load_mujoco()
        try:
            self._renderer: Any = self._mujoco.Renderer(cell.model, height, width)
        except Exception as error:
            raise ControllerError(
                f"MuJoCo cannot draw the cell here ({type(error).__name__}: {error}); install"
                " libegl1 and libgl1-mesa-dri and set MUJOCO_GL=egl"
            ) from error

    def draw(self) -> npt.NDArray[np.uint8]:
        """Return the cell as it is now, (height, width, 3) uint8, red first; dents are marked."""
        self.look()
        return self.drawn()

    def look(self) -> None:
        """Take what the cell shows now; quick, for a cell that must not stand still for long."""
        self._renderer.update_scene(self._cell.data, "cell")
        for truth in self._cell.truth().packages:
            for dent in truth.dents:
                pose = truth.base_from_product
                self._mark(pose[:3, :3] @ dent.at_m + pose[:3, 3], dent.depth_mm)

    def drawn(self) -> npt.NDArray[np.uint8]:
        """Return the picture of the last look; the cell may go on meanwhile."""
        return np.array(self._renderer.render())

    def close(self) -> None:
        """Free the OpenGL context."""
        self._renderer.close()

    def _mark(self, at_m: npt.NDArray[np.float64], depth_mm: float) -> None:
        scene = self._renderer.scene
        if scene.ngeom >= scene.maxgeom:
            return
        radius_m = 0.004 + 0.0005 * depth_mm
        self._mujoco.mjv_initGeom(
            scene.geoms[scene.ngeom],
            self._mujoco.mjtGeom.mjGEOM_SPHERE,
            np.full(3, radius_m),
            at_m,
            np.eye(3).ravel(),
            np.array(MARK_RGBA, np.float32),
        )
        scene.ngeom += 1
