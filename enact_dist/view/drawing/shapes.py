"""Meshes of unit cubes, spheres and cylinders, and where they stand to make capsules."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from enact_dist.recording.drawing.geometry import quaternion

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from enact_dist.recording.drawing.solids import Capsule

SIDES: Final = 16
"""Of a cylinder, and around a sphere."""


class ShapeMesh(NamedTuple):
    """A mesh of size 1 around the origin: vertices (N, 3), triangles (M, 3)."""

    vertices: NDArray[np.float32]
    triangles: NDArray[np.uint32]


class Instances(NamedTuple):
    """Where copies of a mesh stand: (N, 4) w x y z, (N, 3) metres, (N, 3) sizes in metres."""

    turns: NDArray[np.float32]
    places_m: NDArray[np.float32]
    sizes_m: NDArray[np.float32]


def _rings(rings: Sequence[tuple[float, float]]) -> ShapeMesh:
    """Return the surface through rings (radius, height) from bottom to top."""
    angles = np.arange(SIDES) * (2.0 * np.pi / SIDES)
    vertices = [
        (radius * np.cos(angle), radius * np.sin(angle), height)
        for radius, height in rings
        for angle in angles
    ]
    triangles = []
    for row in range(len(rings) - 1):
        for side in range(SIDES):
            low, beside = row * SIDES + side, row * SIDES + (side + 1) % SIDES
            triangles += [(low, beside, low + SIDES), (beside, beside + SIDES, low + SIDES)]
    return ShapeMesh(np.array(vertices, np.float32), np.array(triangles, np.uint32))


_TILTS: Final = np.linspace(-np.pi / 2.0, np.pi / 2.0, 9)
SPHERE: Final = _rings([(0.5 * float(np.cos(t)), 0.5 * float(np.sin(t))) for t in _TILTS])
CYLINDER: Final = _rings([(0.5, -0.5), (0.5, 0.5)])
"""Without its ends, which the spheres of a capsule cover."""
CUBE: Final = ShapeMesh(
    np.array(
        [(x, y, z) for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)], np.float32
    ),
    np.array(
        [(0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1),
         (2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3)], np.uint32
    ),
)  # fmt: skip


def linear(colour: tuple[int, int, int]) -> tuple[int, int, int]:
    """Return an sRGB colour in linear numbers, as which viser 1.1 takes those of batched meshes."""
    red, green, blue = (round(255.0 * (each / 255.0) ** 2.2) for each in colour)
    return red, green, blue


def unturned(places_m: NDArray[np.float32], size_m: float) -> Instances:
    """Return copies of one size at places (N, 3)."""
    turns = np.tile(np.array((1.0, 0.0, 0.0, 0.0), np.float32), (len(places_m), 1))
    return Instances(turns, places_m, np.full((len(places_m), 3), size_m, np.float32))


def capsule_ends(capsules: Sequence[Capsule]) -> Instances:
    """Return the spheres of capsules, two each."""
    places = np.concatenate([capsule.ends_m for capsule in capsules]).astype(np.float32)
    sizes = np.repeat([2.0 * capsule.radius_m for capsule in capsules], 2)
    return unturned(places, 1.0)._replace(
        sizes_m=np.repeat(sizes[:, None], 3, axis=1).astype(np.float32)
    )


def capsule_bodies(capsules: Sequence[Capsule]) -> Instances:
    """Return the cylinders of capsules, one each; that of a sphere has no length."""
    turns = []
    for capsule in capsules:
        x, y, z, w = quaternion(capsule.pose[:3, :3])
        turns.append((w, x, y, z))
    places = [capsule.pose[:3, 3] for capsule in capsules]
    sizes = [(2.0 * each.radius_m, 2.0 * each.radius_m, each.length_m) for each in capsules]
    return Instances(*(np.array(each, np.float32) for each in (turns, places, sizes)))
