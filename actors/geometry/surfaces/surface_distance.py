"""How far two surfaces, or two clouds, are apart: distances to the nearest point, both ways.

samples spread evenly over each surface, and its vertices -> distance to the nearest point of the
other -> the distance that a share of the samples stays within, and the largest of all

Both directions count, and the larger one is the result: from a part to the whole everything is
near, from the whole to the part it is not.  What the surfaces are made of (triangles, patches,
density) does not matter, only where they are.

Sources: Cignoni, Rocchini, Scopigno 1998, "Metro: measuring error on simplified surfaces" (even
samples of one surface, nearest points of the other, the symmetric maximum); Dubuisson and Jain
1994, "A modified Hausdorff distance for object matching" (a rank in place of the maximum, which one
stray point decides).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from actors.geometry.open3d_arrays import tensor
from actors.geometry.surfaces.rendering import ray_scene

if TYPE_CHECKING:
    import numpy.typing as npt

    Points = npt.NDArray[np.float64]

SAMPLES: Final = 20_000
"""Points spread over each surface: one every 2 mm on a milk carton."""


@dataclass(frozen=True, slots=True)
class Apart:
    """How far two shapes are apart.

    Attributes:
        share_m: What the asked share of the samples stays within, the worse of both directions;
            all of them, and the vertices, where that is 1.
        largest_m: The largest distance of any sample or vertex, in either direction.
        farthest_m: Where that is, (x, y, z), metres.
        of_left: Whether that point belongs to the left shape.
    """

    share_m: float
    largest_m: float
    farthest_m: tuple[float, float, float]
    of_left: bool


NOTHING_NEAR: Final = Apart(np.inf, np.inf, (np.nan, np.nan, np.nan), of_left=True)
SAME: Final = Apart(0.0, 0.0, (np.nan, np.nan, np.nan), of_left=True)


@dataclass(frozen=True, slots=True, eq=False)
class Mesh:
    """A surface as triangles.

    Attributes:
        vertices_m: (N, 3), metres.
        triangles: (M, 3), vertex numbers.
    """

    vertices_m: npt.NDArray[np.floating[Any]]
    triangles: npt.NDArray[np.integer[Any]]


def surfaces_apart(left: Mesh, right: Mesh, *, share: float) -> Apart:
    """Return how far two surfaces in one frame are apart.

    Args:
        left: One surface; without triangles it is nowhere.
        right: The other one.
        share: Of the samples, above 0 to 1.
    """
    if _equal(left.vertices_m, right.vertices_m) and _equal(left.triangles, right.triangles):
        return SAME
    empty = len(left.triangles) == 0, len(right.triangles) == 0
    if any(empty):
        return SAME if all(empty) else NOTHING_NEAR
    one_way = _towards(left, right, share)
    other_way = _towards(right, left, share)
    return _worse(one_way, other_way)


def clouds_apart(
    left_m: npt.NDArray[np.floating[Any]], right_m: npt.NDArray[np.floating[Any]], *, share: float
) -> Apart:
    """Return how far two clouds in one frame are apart, from each point to the nearest one.

    Clouds of one surface are apart by up to half the spacing of their points.

    Args:
        left_m: (N, 3), metres.
        right_m: (M, 3), metres.
        share: Of the points, above 0 to 1.
    """
    from scipy.spatial import cKDTree

    if _equal(left_m, right_m):
        return SAME
    if not len(left_m) or not len(right_m):
        return NOTHING_NEAR
    to_right, _ = cKDTree(right_m).query(left_m)
    to_left, _ = cKDTree(left_m).query(right_m)
    one_way = _summary(to_right, to_right, left_m, share)
    other_way = _summary(to_left, to_left, right_m, share)
    return _worse(one_way, other_way)


def _equal(left: npt.NDArray[Any], right: npt.NDArray[Any]) -> bool:
    return left.shape == right.shape and bool(np.array_equal(left, right))


def _towards(here: Mesh, there: Mesh, share: float) -> tuple[float, float, Points]:
    """Return share, largest distance and farthest point from one surface to another."""
    samples, _ = samples_on(here)
    corners = np.asarray(here.vertices_m, float)[np.unique(here.triangles)]
    points = np.concatenate([samples, corners])
    scene = ray_scene(there.vertices_m, there.triangles)
    distance = scene.compute_distance(tensor(points, np.float32)).numpy().astype(float)
    return _summary(distance[: len(samples)], distance, points, share)


def _summary(
    samples_m: npt.NDArray[Any], all_m: npt.NDArray[Any], points: npt.NDArray[Any], share: float
) -> tuple[float, float, Points]:
    farthest = int(np.argmax(all_m))
    within_m = np.quantile(samples_m, share, method="higher") if share < 1.0 else all_m[farthest]
    return float(within_m), float(all_m[farthest]), np.asarray(points[farthest], float)


def _worse(one_way: tuple[float, float, Points], other_way: tuple[float, float, Points]) -> Apart:
    of_left = one_way[1] >= other_way[1]
    _, largest_m, farthest = one_way if of_left else other_way
    x, y, z = (float(each) for each in farthest)
    return Apart(max(one_way[0], other_way[0]), largest_m, (x, y, z), of_left)


def samples_on(mesh: Mesh, count: int = SAMPLES) -> tuple[Points, npt.NDArray[np.int64]]:
    """Return points spread over a surface by area, (`count`, 3), the same at each call.

    Also the number of the triangle that each lies in.
    """
    corners = np.asarray(mesh.vertices_m, float)[mesh.triangles]
    one, other = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = np.linalg.norm(np.cross(one, other), axis=1)
    random = np.random.default_rng(0)
    reached = np.cumsum(area)
    # Even steps through the area with one common offset: fewer clumps than independent draws.
    steps = (np.arange(count) + random.random()) * (reached[-1] / count)
    chosen = np.minimum(np.searchsorted(reached, steps, side="right"), len(area) - 1)
    along, across = random.random((2, count))
    folded = along + across > 1.0
    along, across = np.where(folded, 1.0 - along, along), np.where(folded, 1.0 - across, across)
    points: Points = (
        corners[chosen, 0] + along[:, None] * one[chosen] + across[:, None] * other[chosen]
    )
    return points, chosen
