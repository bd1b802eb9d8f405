"""What a structured-light depth sensor makes of the true depth.

=========  =============================================  ===================================
axial      normal, 1.2 mm + 1.9 mm (z - 0.4 m)^2          Nguyen, Izadi, Lovell 2012
lateral    each pixel looks 0.5 px (std) beside itself    same; makes edges ragged
steps      1 mm                                           the sensor's integer millimetres
dropouts   1 % of all pixels                              independent
=========  =============================================  ===================================
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from actors.geometry.surfaces.depth import millimetres, spread_m

if TYPE_CHECKING:
    import numpy.typing as npt

LATERAL_PX: Final = 0.5
DROPOUT_SHARE: Final = 0.01


@dataclass(frozen=True, slots=True)
class Light:
    """What light does to the sensor: its pattern pales, noise and dropouts grow.

    Attributes:
        noise: Axial noise, in that of the sensor in the dark.
        dropout_share: Share of the pixels that know nothing.
    """

    noise: float = 1.0
    dropout_share: float = DROPOUT_SHARE


DARK: Final = Light()


def sensed(
    depth_m: npt.NDArray[np.float32], random: np.random.Generator, light: Light = DARK
) -> npt.NDArray[np.uint16]:
    """Return what the sensor reports for a true depth image.

    Args:
        depth_m: (H, W) float32, metres, NaN where nothing is hit.
        random: Source of the noise; the same state gives the same image.
        light: Around the sensor.

    Returns:
        (H, W) uint16, millimetres, 0 where unknown.
    """
    height, width = depth_m.shape
    row_shift, column_shift = np.rint(
        random.standard_normal((2, height, width), np.float32) * np.float32(LATERAL_PX)
    ).astype(np.int64)
    row = np.clip(np.arange(height)[:, None] + row_shift, 0, height - 1)
    column = np.clip(np.arange(width)[None, :] + column_shift, 0, width - 1)
    seen = depth_m[row, column]
    noise = random.standard_normal((height, width), np.float32)
    seen = seen + noise * (light.noise * spread_m(seen)).astype(np.float32)
    seen[random.random((height, width), np.float32) < light.dropout_share] = np.nan
    return millimetres(seen)
