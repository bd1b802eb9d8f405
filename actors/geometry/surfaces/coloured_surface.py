"""A triangle mesh with a colour at each vertex, as a datum and as an argument.

Annotations stay real types here (no `from __future__ import annotations`): the wire reads them.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt


@dataclass(frozen=True, slots=True, eq=False)
class ColouredSurface:
    """A surface made of coloured views.

    Attributes:
        vertices_m: (N, 3) float32, metres, world frame.
        normals: (N, 3) float32, unit, outward.
        colours: (N, 3) uint8, RGB.
        triangles: (K, 3) int32, counter-clockwise seen from outside.
    """

    vertices_m: npt.NDArray[np.float32]
    normals: npt.NDArray[np.float32]
    colours: npt.NDArray[np.uint8]
    triangles: npt.NDArray[np.int32]
