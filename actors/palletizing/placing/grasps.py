"""Where a robot with two parallel fingers holds a product, from its trained surface.

sample the surface -> centre of mass of what it encloses -> the narrowest pair of opposite sides
that the fingers meet over it -> point, axis, width, force

Rule a change must keep: only the trained surface and the mass decide; a product that the fingers
touch along a line, a rim or a round wall, is pressed less than one that they hold by flat faces.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from actors.geometry.surfaces.surface_distance import Mesh, samples_on
from actors.palletizing.placing.finger_room import FLAT_M2, LINE_N, Grasp, Gripper

if TYPE_CHECKING:
    import numpy.typing as npt

    from actors.geometry.shapes import Surface

    F64 = npt.NDArray[np.float64]

TURNS: Final = 60
"""Directions of the fingers that are tried, over half a turn."""
SAMPLES: Final = 40_000
NARROWEST_SHARE: Final = 1.02
"""Of directions that are less wide the one nearest to the product's y axis is taken."""
LEAST_HEIGHT_M: Final = 0.040
"""Of the tool above the product's base: the fingers end 20 mm lower, over whatever it stands on."""
PUSH_HEIGHT_M: Final = 0.030
FACE_N: Final = 40.0
"""Of the fingers on flat faces; see `finger_room.LINE_N`."""
FLAT_RAD: Final = float(np.deg2rad(10.0))
THICKNESS_M: Final = 0.002
"""What is at most so far inside of the outermost points is touched by a finger."""


def grasp_of(surface: Surface, *, mass_kg: float) -> Grasp:
    """Return how a product is grasped.

    Args:
        surface: Trained, closed, product frame.
        mass_kg: Of the product.
    """
    half_across_m = Gripper().half_across_m
    centre = centre_of(surface)
    points, normals, area_m2 = _sampled(surface)
    found: list[tuple[float, float, F64]] = []
    for angle in np.pi * np.arange(TURNS) / TURNS:
        axis = np.array([-np.sin(angle), np.cos(angle), 0.0])
        low, high = _sides(points, centre, axis, half_across_m)
        found.append((high - low, (high + low) / 2.0, axis))
    narrowest = min(width for width, _, _ in found)
    width_m, middle, axis = max(
        (each for each in found if each[0] <= NARROWEST_SHARE * narrowest),
        key=lambda each: abs(each[2][1]),
    )
    across = np.cross(axis, [0.0, 0.0, 1.0])
    point = middle * axis + float(across @ centre) * across
    point[2] = max(LEAST_HEIGHT_M, centre[2])
    near = np.abs((points - centre) @ across) <= half_across_m
    beyond = (points @ axis - middle) * np.sign(normals @ axis)
    flat = np.abs(normals @ axis) > np.cos(FLAT_RAD)
    touched = near & flat & (beyond > width_m / 2.0 - THICKNESS_M)
    is_face = touched.sum() * area_m2 / 2.0 > FLAT_M2
    return Grasp(
        point=point,
        axis=axis,
        width_m=float(width_m),
        force_n=FACE_N if is_face else LINE_N,
        push_height_m=PUSH_HEIGHT_M,
        mass_kg=mass_kg,
    )


def size_of(surface: Surface) -> F64:
    """Return the box of a product, (3,), metres, about the z axis of its frame and its base."""
    low, high = np.percentile(surface.vertices_m, (0.2, 99.8), axis=0)
    return np.array([high[0] - low[0], high[1] - low[1], high[2]], np.float64)


def centre_of(surface: Surface) -> F64:
    """Return the centre of what a closed surface encloses, (3,), metres."""
    corners = surface.vertices_m.astype(np.float64)
    a, b, c = (corners[surface.triangles[:, i]] for i in range(3))
    volumes = np.einsum("ij,ij->i", a, np.cross(b, c)) / 6.0
    return np.asarray(volumes @ (a + b + c) / 4.0 / volumes.sum())


def _sampled(surface: Surface) -> tuple[F64, F64, float]:
    """Return points evenly over the surface, their outward normals, and the area of each."""
    points, chosen = samples_on(Mesh(surface.vertices_m, surface.triangles), SAMPLES)
    a, b, c = surface.vertices_m.astype(np.float64)[surface.triangles].transpose(1, 0, 2)
    normals = np.cross(b - a, c - a)
    doubled = np.linalg.norm(normals, axis=1)
    return points, normals[chosen] / doubled[chosen, None], float(doubled.sum() / 2.0 / SAMPLES)


def _sides(points: F64, centre: F64, axis: F64, half_m: float) -> tuple[float, float]:
    """Return where fingers over the centre meet the product, along their way."""
    across = np.cross(axis, [0.0, 0.0, 1.0])
    met = points[np.abs((points - centre) @ across) <= half_m] @ axis
    low, high = np.percentile(met, (0.2, 99.8))
    return float(low), float(high)
