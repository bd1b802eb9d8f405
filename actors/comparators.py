"""What the data types of `actors.geometry.shapes` are compared by: the distance between shapes.

Named by aspects, ``Aspect("surface", Surface, compare=SurfaceDistance(tolerance_m=0.002))``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from actors.geometry.surfaces.surface_distance import Mesh, clouds_apart, surfaces_apart
from enact_dist import Difference

if TYPE_CHECKING:
    import numpy.typing as npt

    from actors.geometry.shapes import PointCloud
    from actors.geometry.surfaces.surface_distance import Apart


class Triangulated(Protocol):
    """A surface: vertices (N, 3) in metres, and triangles (M, 3) of them."""

    @property
    def vertices_m(self) -> npt.NDArray[np.float32]:
        """Vertices, metres."""

    @property
    def triangles(self) -> npt.NDArray[np.int32]:
        """Vertex numbers."""


@dataclass(frozen=True, slots=True)
class SurfaceDistance:
    """Compare surfaces by where they are, see `actors.geometry.surfaces.surface_distance`.

    The distance is what `share` of either surface stays within of the other one, in metres;
    `share=1.0` is the largest distance of all, which a stray vertex decides.  Triangulation,
    planar patches and colours do not count.

    Args:
        tolerance_m: How far apart two surfaces may be, metres.
        share: Of the area, above 0 to 1.

    Raises:
        ValueError: One of them cannot be kept to.
    """

    tolerance_m: float
    share: float = 0.95

    def __post_init__(self) -> None:
        _check(self.tolerance_m, self.share)

    def __call__(self, left: Triangulated, right: Triangulated, /) -> Difference:
        """Return how far two surfaces are apart."""
        one, other = (Mesh(each.vertices_m, each.triangles) for each in (left, right))
        return _difference(
            surfaces_apart(one, other, share=self.share), self.tolerance_m, self.share
        )


@dataclass(frozen=True, slots=True)
class CloudDistance:
    """Compare clouds as `SurfaceDistance` compares surfaces, point by nearest point.

    Args:
        tolerance_m: How far apart two clouds may be, metres; not below the spacing of points.
        share: Of the points, above 0 to 1.

    Raises:
        ValueError: One of them cannot be kept to.
    """

    tolerance_m: float
    share: float = 0.95

    def __post_init__(self) -> None:
        _check(self.tolerance_m, self.share)

    def __call__(self, left: PointCloud, right: PointCloud, /) -> Difference:
        """Return how far two clouds are apart."""
        apart = clouds_apart(left.points_m, right.points_m, share=self.share)
        return _difference(apart, self.tolerance_m, self.share)


def _check(tolerance_m: Any, share: Any) -> None:
    if not 0.0 <= tolerance_m < math.inf or not 0.0 < share <= 1.0:
        raise ValueError(
            f"tolerance_m={tolerance_m!r}, share={share!r}: asked metres from 0 on, and a share"
            " above 0 to 1"
        )


def _difference(apart: Apart, tolerance_m: float, share: float) -> Difference:
    if not apart.largest_m:
        return Difference(0.0)
    if math.isinf(apart.largest_m):
        where, what = "", "one of them is empty"
    else:
        where = "({:.4f}, {:.4f}, {:.4f}) m".format(*apart.farthest_m)
        side = "left" if apart.of_left else "right"
        what = f"{share:.0%} within {_mm(apart.share_m)}, largest {_mm(apart.largest_m)} ({side})"
    return Difference(apart.share_m, tolerance_m, apart.share_m > tolerance_m, "m", where, what)


def _mm(distance_m: float) -> str:
    return f"{distance_m * 1e3:.2f} mm"
