"""What the data types of `actors.geometry.shapes` are compared by: the distance between shapes.

Named by aspects, ``Aspect("surface", Surface, compare=SurfaceDistance(tolerance_m=0.002))``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

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
class _Distance:
    """How far apart two shapes may be.

    The distance is what `share` of either shape stays within of the other one, in metres;
    `share=1.0` is the largest distance of all, which a stray vertex decides.

    Args:
        tolerance_m: How far apart they may be, metres.
        share: Of the area or of the points, above 0 to 1.

    Raises:
        ValueError: One of them cannot be kept to.
    """

    tolerance_m: float
    share: float = 0.95

    def __post_init__(self) -> None:
        if not 0.0 <= self.tolerance_m < math.inf or not 0.0 < self.share <= 1.0:
            raise ValueError(
                f"tolerance_m={self.tolerance_m!r}, share={self.share!r}: asked metres from 0 on,"
                " and a share above 0 to 1"
            )

    def _told(self, apart: Apart) -> Difference:
        if not apart.largest_m:
            return Difference(0.0)
        if math.isinf(apart.largest_m):
            where, what = "", "one of them is empty"
        else:
            where = "({:.4f}, {:.4f}, {:.4f}) m".format(*apart.farthest_m)
            side = "left" if apart.of_left else "right"
            share, largest = f"{1e3 * apart.share_m:.2f} mm", f"{1e3 * apart.largest_m:.2f} mm"
            what = f"{self.share:.0%} within {share}, largest {largest} ({side})"
        differs = apart.share_m > self.tolerance_m
        return Difference(apart.share_m, self.tolerance_m, differs, "m", where, what)


@dataclass(frozen=True, slots=True)
class SurfaceDistance(_Distance):
    """Compare surfaces by where they are, see `actors.geometry.surfaces.surface_distance`.

    Triangulation, planar patches and colours do not count.
    """

    def __call__(self, left: Triangulated, right: Triangulated, /) -> Difference:
        """Return how far two surfaces are apart."""
        one, other = (Mesh(each.vertices_m, each.triangles) for each in (left, right))
        return self._told(surfaces_apart(one, other, share=self.share))


@dataclass(frozen=True, slots=True)
class CloudDistance(_Distance):
    """Compare clouds, point by nearest point; the tolerance is not below their spacing."""

    def __call__(self, left: PointCloud, right: PointCloud, /) -> Difference:
        """Return how far two clouds are apart."""
        return self._told(clouds_apart(left.points_m, right.points_m, share=self.share))
