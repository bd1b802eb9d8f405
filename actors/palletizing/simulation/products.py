"""True shapes of the simulated food packages, as dense closed meshes.

Rules a change must keep: product frame, origin at the centre of the base, z up, metres; edges at
most about 7 mm, so that a dent of 15 mm radius is round.
"""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, Final

import numpy as np

if TYPE_CHECKING:
    import numpy.typing as npt

    Vertices = npt.NDArray[np.float64]
    Triangles = npt.NDArray[np.int32]

PRODUCTS: Final = ("milk_carton", "meal_tray", "yoghurt_cup")
"""Names of all simulated products."""


@lru_cache(maxsize=len(PRODUCTS))
def product_mesh(name: str) -> tuple[Vertices, Triangles]:
    """Return the true shape of a product.

    Args:
        name: One of `PRODUCTS`.

    Returns:
        Vertices (N, 3) float64, metres, product frame; triangles (M, 3) int32, outwards.
        Both are shared: copy before changing.

    Raises:
        KeyError: No such product.
    """
    makers = {
        "milk_carton": _milk_carton,
        "meal_tray": _meal_tray,
        "yoghurt_cup": _yoghurt_cup,
    }
    if name not in makers:
        raise KeyError(f"no product {name!r}; there are {', '.join(PRODUCTS)}")
    vertices, triangles = makers[name]()
    vertices.setflags(write=False)
    triangles.setflags(write=False)
    return vertices, triangles


def box_mesh(size_m: tuple[float, float, float]) -> tuple[Vertices, Triangles]:
    """Return a box that stands on z = 0 around the origin; (8, 3) and (12, 3)."""
    corners = np.array([[x, y, z] for z in (0.0, 1.0) for y in (-0.5, 0.5) for x in (-0.5, 0.5)])
    return hull_mesh(corners * size_m)


def _milk_carton() -> tuple[Vertices, Triangles]:
    """A gable-top carton that lies on its side: a block of 150 mm, then a wedge of 50 mm."""
    length, gable, half_width, height = 0.150, 0.050, 0.0475, 0.070
    block = [
        [x, y, z] for x in (0.0, length) for y in (-half_width, half_width) for z in (0.0, height)
    ]
    ridge = [[length + gable, y, height / 2] for y in (-half_width, half_width)]
    corners = np.array(block + ridge) - [(length + gable) / 2, 0.0, 0.0]
    return _subdivided(*hull_mesh(corners), times=5)


def _meal_tray() -> tuple[Vertices, Triangles]:
    """A tapered tray with a rim, closed by a film that its content raises by 4 mm."""
    levels = [(0.0, 0.78), (0.012, 0.82), (0.024, 0.86), (0.036, 0.90), (0.046, 0.93), (0.047, 1.0)]
    dome = [(0.050, 1.0)] + [
        (0.050 + 0.004 * (1.0 - share**2), share * 0.92) for share in np.linspace(1.0, 0.08, 12)
    ]
    return _turned(levels + dome, half_m=(0.080, 0.060), exponent=6.0)


def _yoghurt_cup() -> tuple[Vertices, Triangles]:
    """A round cup, wider at the top, with a lid sunk by 2 mm inside a rim of 4 mm."""
    wall = [(height, 0.76 + 2.0 * height) for height in np.linspace(0.0, 0.096, 13)]
    rim = [(0.098, 1.0), (0.102, 1.0), (0.102, 0.92), (0.100, 0.90)]
    lid = [(0.100, share) for share in np.linspace(0.8, 0.05, 10)]
    return _turned(wall + rim + lid, half_m=(0.0475, 0.0475), exponent=2.0)


def _turned(
    profile: list[tuple[float, float]], *, half_m: tuple[float, float], exponent: float
) -> tuple[Vertices, Triangles]:
    """Return the closed mesh of stacked superellipses.

    Args:
        profile: Height in metres and scale of each ring, from the base to the centre of the top.
        half_m: Half axes at scale 1, metres.
        exponent: 2 is an ellipse, 6 a rectangle with round corners.
    """
    around = 96
    angle = np.linspace(0.0, 2.0 * np.pi, around, endpoint=False)
    cosine, sine = np.cos(angle), np.sin(angle)
    radius = (np.abs(cosine) ** exponent + np.abs(sine) ** exponent) ** (-1.0 / exponent)
    outline = np.stack([half_m[0] * radius * cosine, half_m[1] * radius * sine], axis=1)
    base = [(profile[0][0], share * profile[0][1]) for share in (0.05, 0.3, 0.6)]
    rings = base + profile
    vertices = np.concatenate(
        [np.column_stack([outline * scale, np.full(around, height)]) for height, scale in rings]
        + [[[0.0, 0.0, rings[0][0]], [0.0, 0.0, rings[-1][0]]]]
    )
    here = np.arange(around)
    after = (here + 1) % around
    walls = [
        np.concatenate(
            [
                np.column_stack([low + here, low + after, low + around + after]),
                np.column_stack([low + here, low + around + after, low + around + here]),
            ]
        )
        for low in range(0, (len(rings) - 1) * around, around)
    ]
    bottom, top = len(rings) * around, len(rings) * around + 1
    last = (len(rings) - 1) * around
    caps = [
        np.column_stack([np.full(around, bottom), after, here]),
        np.column_stack([np.full(around, top), last + here, last + after]),
    ]
    return vertices, np.concatenate(walls + caps).astype(np.int32)


def hull_mesh(corners_m: Vertices) -> tuple[Vertices, Triangles]:
    """Return the convex hull of points: the points, and triangles outwards."""
    from scipy.spatial import ConvexHull

    hull = ConvexHull(corners_m)
    triangles = hull.simplices.astype(np.int32)
    a, b, c = (corners_m[triangles[:, i]] for i in range(3))
    inwards = np.einsum("ij,ij->i", np.cross(b - a, c - a), hull.equations[:, :3]) < 0.0
    triangles[inwards] = triangles[inwards][:, ::-1]
    return np.array(corners_m, float), triangles


def _subdivided(
    vertices: Vertices, triangles: Triangles, *, times: int
) -> tuple[Vertices, Triangles]:
    """Return the mesh with every triangle cut into four, again and again."""
    for _ in range(times):
        edges = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
        unique, number = np.unique(edges, axis=0, return_inverse=True)
        middle = (number.reshape(-1, 3) + len(vertices)).astype(np.int32)
        vertices = np.concatenate([vertices, vertices[unique].mean(axis=1)])
        a, b, c = triangles.T
        ab, bc, ca = middle.T
        triangles = np.concatenate(
            [np.column_stack(t) for t in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]
        )
    return vertices, triangles
