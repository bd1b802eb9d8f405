"""People in a hull: where they are, where they walk, where their limbs are.

Rules a change must keep: pure functions on arrays, metres and seconds; a person's state is x, y and
their velocities, moved by a random acceleration (constant velocity, Kalman 1960).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy.typing as npt

    F64 = npt.NDArray[np.float64]

PERSON_M3: Final = 0.020
"""Least volume of what can be a person."""
ACCELERATION: Final = 0.4
"""Spectral density of a walker's acceleration, m²/s³: 0.2 m/s more or less in 0.1 s."""
SEEN_M: Final = 0.03
"""Standard deviation of the middle of a body in the tight hull."""
WALK_M_S: Final = 1.6
"""Assumed speed of a person whom no camera sees."""
BLOCK_M: Final = 0.1
"""Edge of the blocks along which distances within a body are measured."""
LIMBS: Final = 5
"""Ends of a body at most: head, hands, feet."""
POINTS: Final = 1500
"""As many of a body's points, or up to twice as many, are enough for its limbs."""
LIMB_M: Final = 0.3
"""Least distance of an end from the middle and from the other ends, within the body."""


@dataclass(frozen=True, slots=True, eq=False)
class Body:
    """A person as a set shows them.

    Attributes:
        points_m: (N, 3), middles of the voxels.
        centre_m: (2,), x and y of the middle.
        top_m: Height of the top.
        volume_m3: Volume.
        radius_m: Horizontal distance from the middle within which 95 % of the volume lies.
    """

    points_m: F64
    centre_m: F64
    top_m: float
    volume_m3: float
    radius_m: float


def body_of(points_m: F64, voxel_m: float) -> Body:
    """Return what voxels show as one person."""
    centre = points_m[:, :2].mean(0)
    off = np.linalg.norm(points_m[:, :2] - centre, axis=1)
    top = float(np.quantile(points_m[:, 2], 0.998)) + voxel_m / 2.0
    volume = len(points_m) * voxel_m**3
    return Body(points_m, centre, top, volume, float(np.quantile(off, 0.95)))


def bodies(
    points_m: F64, component: npt.NDArray[np.integer], voxel_m: float, expected_m: F64
) -> list[Body]:
    """Return the people in a hull.

    A component that holds several of the expected ones, and volume enough for them, is divided
    among them: each voxel belongs to the nearest middle.

    Args:
        points_m: (N, 3), middles of the voxels.
        component: (N,), to which connected component each belongs.
        voxel_m: Edge of a voxel.
        expected_m: (k, 2), where people are expected.
    """
    found = []
    for number in np.unique(component):
        points = points_m[component == number]
        if len(points) * voxel_m**3 < PERSON_M3:
            continue
        flat = points[:, :2]
        held = [
            one for one in expected_m if np.abs(flat - one).max(1).min(initial=np.inf) < BLOCK_M
        ]
        if len(held) < 2 or len(points) * voxel_m**3 < len(held) * PERSON_M3:
            found.append(body_of(points, voxel_m))
            continue
        middles = np.array(held)
        for _ in range(4):
            nearest = np.linalg.norm(flat[:, None] - middles, axis=-1).argmin(1)
            counts = np.bincount(nearest, minlength=len(middles))
            sums = np.stack([np.bincount(nearest, flat[:, k], len(middles)) for k in (0, 1)], 1)
            middles = np.where(counts[:, None], sums / np.maximum(counts, 1)[:, None], middles)
        found += [
            body_of(points[nearest == part], voxel_m)
            for part in range(len(middles))
            if counts[part] * voxel_m**3 >= PERSON_M3 / 2.0
        ]
    return found


def moved_on(state: F64, covariance: F64, seconds: float) -> tuple[F64, F64]:
    """Return where a walker is some time later.

    Args:
        state: (4,): x, y, their velocities.
        covariance: (4, 4) of the state.
        seconds: >= 0.
    """
    move = np.eye(4)
    move[0, 2] = move[1, 3] = seconds
    square, cube = seconds**2 / 2.0, seconds**3 / 3.0
    one = ACCELERATION * np.array([[cube, square], [square, seconds]])
    noise = np.kron(one, np.eye(2))
    return move @ state, move @ covariance @ move.T + noise


def corrected(state: F64, covariance: F64, centre_m: F64) -> tuple[F64, F64]:
    """Return the state of a walker whose middle was seen, (2,)."""
    gain = covariance[:, :2] @ np.linalg.inv(covariance[:2, :2] + SEEN_M**2 * np.eye(2))
    state = state + gain @ (centre_m - state[:2])
    covariance = covariance - gain @ covariance[:2]
    return state, (covariance + covariance.T) / 2.0


def associated(expected_m: F64, gates_m: F64, seen_m: F64) -> list[tuple[int, int]]:
    """Return which expected person is which seen one: the pairs with the least sum of distances.

    Args:
        expected_m: (k, 2).
        gates_m: (k,), greatest distance at which an expected one can be a seen one.
        seen_m: (m, 2).
    """
    from scipy.optimize import linear_sum_assignment

    if not len(expected_m) or not len(seen_m):
        return []
    off = np.linalg.norm(expected_m[:, None] - seen_m[None], axis=-1)
    cost = np.where(off <= gates_m[:, None], off, 1e6)
    rows, columns = linear_sum_assignment(cost)
    pairs = zip(rows.tolist(), columns.tolist(), strict=True)
    return [(row, column) for row, column in pairs if cost[row, column] < 1e6]


def limbs(points_m: F64) -> npt.NDArray[np.float32]:
    """Return capsules of trunk and limbs, (n, 7): end, end, radius; the trunk first.

    Ends of limbs are what is farthest from the middle and from each other along the body; every
    part of the body belongs to the nearest of them, again along the body.
    """
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import dijkstra

    if not len(points_m):
        return np.empty((0, 7), np.float32)
    points_m = points_m[:: max(1, len(points_m) // POINTS)]
    index = np.floor(points_m / BLOCK_M).astype(np.int64)
    index -= index.min(0)
    shape = tuple((index.max(0) + 1).tolist())
    cells, which = np.unique(np.ravel_multi_index(tuple(index.T), shape), return_inverse=True)
    blocks = np.stack(np.unravel_index(cells, shape), 1)
    near = np.ones((len(blocks), len(blocks)), bool)
    for along in blocks.astype(np.int16).T:
        near &= np.abs(along[:, None] - along) <= 1
    one, other = np.nonzero(near)
    lengths = np.linalg.norm(blocks[one] - blocks[other], axis=1) * BLOCK_M
    graph = csr_array((lengths, (one, other)), shape=(len(blocks), len(blocks)))
    middle = index.mean(0)
    ends = [int(np.linalg.norm(blocks - middle, axis=1).argmin())]
    distances = [dijkstra(graph, indices=ends[0])]
    while len(ends) <= LIMBS:
        nearest = np.min(distances, axis=0)
        nearest[~np.isfinite(nearest)] = -1.0
        farthest = int(nearest.argmax())
        if nearest[farthest] < LIMB_M:
            break
        ends.append(farthest)
        distances.append(dijkstra(graph, indices=farthest))
    part = np.argmin(distances, axis=0)[which]
    return np.stack([_capsule(points_m[part == k]) for k in range(len(ends))]).astype(np.float32)


def _capsule(points_m: F64) -> F64:
    """Return a capsule along the longest extension of points, (7,)."""
    middle = points_m.mean(0)
    off = points_m - middle
    axis = np.linalg.eigh(off.T @ off)[1][:, -1]
    along = off @ axis
    across = np.sqrt(2.0 * np.mean((off * off).sum(1) - along**2))
    low, high = np.quantile(along, [0.02, 0.98])
    radius = max(float(across), BLOCK_M / 4.0)
    low, high = (low + radius, high - radius) if high - low > 2.0 * radius else (0.0, 0.0)
    return np.asarray(np.r_[middle + low * axis, middle + high * axis, radius])


def predicted(
    state: F64, covariance: F64, at_s: Sequence[float], radius_m: float
) -> tuple[F64, F64]:
    """Return where a walker will be: centres (K, 2) and radii (K,), metres.

    The radius is that of the body and one standard deviation of where it will be.
    """
    centres, radii = [], []
    for seconds in at_s:
        there, spread = moved_on(state, covariance, seconds)
        centres.append(there[:2])
        radii.append(radius_m + float(np.sqrt(np.linalg.eigvalsh(spread[:2, :2])[-1])))
    return np.array(centres), np.array(radii)
