"""A seeded sequence of food packages on the tray, with the truth about each.

A package is planned for one place of the tray and arrives there with a small error of the robot;
now and then it is dented, bulged, crushed, displaced, absent, or something else lies beside it.

Rules a change must keep: the sequence is a function of the seed; packages never penetrate each
other; the truth stays in here (the demo's score is its only reader).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from actors.geometry.open3d_arrays import tensor
from actors.geometry.poses import inverse, moved, on_tray
from actors.geometry.shapes import Surface
from actors.geometry.surfaces.rendering import ray_scene
from actors.palletizing.placing.pallet import TRAY_PLACES, planned_pose, tray_of
from actors.palletizing.placing.rows import contacts_between, planned_rows
from actors.palletizing.simulation.products import box_mesh, product_mesh

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy.typing as npt

    Pose = npt.NDArray[np.float64]
    Mesh = tuple[npt.NDArray[np.float64], npt.NDArray[np.int32]]

DEMO_PRODUCTS: Final = ("milk_carton", "meal_tray")
"""Products of a sequence unless others are named; they come in turn."""

JITTER_M: Final = 0.003
JITTER_RAD: Final = np.deg2rad(1.5)
"""Largest error of a sound placement."""

ACROSS_M: Final = 0.002
"""How far packages of a row are off across it at most."""

ROOM_M: Final = (0.105, 0.15)
"""Half of the room around a place, x and y: nothing of one package leaves its own."""

DEVIATING_SHARE: Final = 0.5
"""Far more than a real line has, so that a short demonstration shows every kind."""

DENT_SIGMA_M: Final = (0.014, 0.022)
"""Radii of dents and bulges, one sigma, metres."""

KINDS: Final = ("dent", "bulge", "crush", "moved", "missing", "extra")
"""True deviations; dent, bulge and crush are what the verdict calls deformed."""

FACE_DENT: Final = "dent in a face"
"""A dent wherever the sensor sees the package, not drawn by chance; "dent" is one on its top."""

EYE_M: Final = (0.0, 0.0, 0.95)
"""Where the overhead sensor is, tray frame."""

FACING_COS: Final = 0.25
"""A face that is seen flatter than by 14 degrees, with a quarter of its area, counts as hidden."""

FOOT_M: Final = 0.015
"""Dents in faces have their middle above: the tray cuts off what is lower."""

VERDICT_OF_KIND: Final = {
    "ok": "ok",
    "dent": "deformed",
    FACE_DENT: "deformed",
    "bulge": "deformed",
    "crush": "deformed",
    "moved": "moved",
    "missing": "missing",
    "extra": "extra",
}


@dataclass(frozen=True, slots=True)
class Truth:
    """What really is the matter with a package.

    Attributes:
        kind: "ok" or one of `KINDS`.
        amount: Depth of a dent or bulge in mm, loss of height by a crush in %, shift in mm, else 0.
    """

    kind: str
    amount: float

    def __str__(self) -> str:
        unit = {"dent": " mm", FACE_DENT: " mm", "bulge": " mm", "crush": " %", "moved": " mm"}.get(
            self.kind
        )
        return self.kind if unit is None else f"{self.kind} {self.amount:.0f}{unit}"


@dataclass(frozen=True, slots=True, eq=False)
class Package:
    """One simulated package at one place.

    Attributes:
        product: Name of the product.
        planned: tray_from_product as planned, (4, 4).
        placed: tray_from_product as it came to lie, (4, 4).
        truth: What is the matter with it.
        shape: Vertices (N, 3) in the product frame and triangles (M, 3); no vertices if missing.
        extra: A foreign object in the tray frame, like `shape`; no vertices if there is none.
    """

    product: str
    planned: npt.NDArray[np.float64]
    placed: npt.NDArray[np.float64]
    truth: Truth
    shape: Mesh
    extra: Mesh

    def meshes(self) -> list[Mesh]:
        """Return what of it lies on the tray, in the tray frame."""
        vertices, triangles = self.shape
        placed = [(moved(vertices, self.placed), triangles)]
        return [mesh for mesh in (*placed, self.extra) if len(mesh[0])]


def package_sequence(
    count: int, *, seed: int, products: Sequence[str] = DEMO_PRODUCTS
) -> list[Package]:
    """Return the packages of a run, one per stop of the conveyor."""
    sequence: list[Package] = []
    for stop in range(count):
        random = np.random.default_rng([seed, 7, stop])
        truth = _draw_truth(random)
        sequence.append(make_package(stop, products[stop % len(products)], truth, random))
    return sequence


def rows_in_contact(count: int, *, seed: int, products: Sequence[str]) -> list[Package]:
    """Return packages that touch the one before in their row, as after a push.

    Three of five are sound; the others are dented on top by 4 to 10 mm, or missing.
    """
    shapes = {name: Surface.free_form(*product_mesh(name)) for name in products}
    sizes_m = {name: np.ptp(product_mesh(name)[0], axis=0) for name in products}
    contacts_m = contacts_between(shapes)
    sequence: list[Package] = []
    for stop in range(count):
        random = np.random.default_rng([seed, 13, stop])
        first = stop - stop % len(TRAY_PLACES)
        on_it = [products[each % len(products)] for each in range(first, stop + 1)]
        slot = planned_rows(on_it, sizes_m, contacts_m)[-1]
        kind = str(
            random.choice(("ok", "ok", "ok", "dent", "missing"), p=(0.2, 0.2, 0.2, 0.3, 0.1))
        )
        truth = Truth(kind, float(random.uniform(4.0, 10.0)) if kind == "dent" else 0.0)
        at = slot.tray_from_product, slot.tray_from_product
        if slot.push.any():
            across_m = random.uniform(-1.0, 1.0) * ACROSS_M
            at = at[0], on_tray(0.0, across_m, 0.0) @ at[0]
        sequence.append(make_package(stop, on_it[-1], truth, random, at=at))
    return sequence


def on_the_tray(packages: Sequence[Package], stop: int) -> Sequence[Package]:
    """Return what lies on the tray at a stop; an empty tray replaces a full one."""
    return [
        package for n, package in enumerate(packages[: stop + 1]) if tray_of(n) == tray_of(stop)
    ]


def make_package(
    stop: int,
    product: str,
    truth: Truth,
    random: np.random.Generator,
    *,
    at: tuple[Pose, Pose] | None = None,
) -> Package:
    """Return a package with a given truth; where and how exactly is drawn at random.

    Args:
        stop: Number of the stop, gives the place.
        product: Name of the product.
        truth: Kind and amount of the deviation.
        random: Source of all else.
        at: tray_from_product as planned and as placed; the place of the stop when absent.
    """
    planned = planned_pose(stop)
    jitter = random.uniform(-1.0, 1.0, 3) * [JITTER_M, JITTER_M, JITTER_RAD]
    planned, placed = at or (planned, planned @ on_tray(*jitter))
    if truth.kind == "moved":
        placed = _shift(truth.amount / 1000.0, random) @ placed
    vertices, triangles = product_mesh(product)
    nothing = (np.empty((0, 3)), np.empty((0, 3), np.int32))
    shape, extra = (deformed(vertices, truth, random), triangles), nothing
    if truth.kind == FACE_DENT:
        spot, inwards = seen_spot((vertices, triangles), placed, random)
        depth_m, sigma_m = truth.amount / 1e3, random.uniform(*DENT_SIGMA_M)
        bent = pressed(vertices, spot, inwards, depth_m=depth_m, sigma_m=sigma_m)
        shape = bent, triangles
    if truth.kind == "missing":
        shape = nothing
    elif truth.kind == "extra":
        extra = _foreign_object(vertices, planned, placed, random)
    return Package(
        product=product,
        planned=planned,
        placed=placed,
        truth=truth,
        shape=shape,
        extra=extra,
    )


def deformed(
    vertices_m: npt.NDArray[np.float64], truth: Truth, random: np.random.Generator
) -> npt.NDArray[np.float64]:
    """Return the vertices of a product after a dent, a bulge or a crush; else unchanged.

    Args:
        vertices_m: (N, 3), metres, product frame.
        truth: Kind and amount.
        random: Gives where and how wide: a dent has a radius (one sigma) of 14 to 22 mm.
    """
    height = vertices_m[:, 2].max()
    relative = vertices_m[:, 2] / height
    bent = np.array(vertices_m)
    if truth.kind in ("dent", "bulge"):
        half = np.abs(vertices_m[relative > 0.9, :2]).max(axis=0)
        centre = random.uniform(-0.5, 0.5, 2) * half
        sigma = random.uniform(*DENT_SIGMA_M)
        sign = 1.0 if truth.kind == "dent" else -1.0
        at, inwards = np.array([*centre, height]), np.array([0.0, 0.0, -1.0])
        bent = pressed(vertices_m, at, inwards, depth_m=sign * truth.amount / 1e3, sigma_m=sigma)
    elif truth.kind == "crush":
        loss = truth.amount / 100.0
        bent[:, 2] *= 1.0 - loss
        bent[:, :2] *= 1.0 + 0.3 * loss * np.sin(np.pi * relative)[:, None]
    return bent


def seen_spot(
    mesh: Mesh, tray_from_product: npt.NDArray[np.float64], random: np.random.Generator
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return a point of a package that the overhead sensor sees, all of them equally likely.

    Where a dent would not reach, as in the inner side of a rim, whose outer side gives way in its
    place, there is none.

    Args:
        mesh: Vertices in the product frame, triangles.
        tray_from_product: Where it stands, (4, 4).
        random: Chooses.

    Returns:
        The point, (3,), metres, and the unit vector into the package there; product frame.
    """
    vertices, triangles = mesh
    eye = moved(np.array([EYE_M]), inverse(tray_from_product))[0]
    a, b, c = (vertices[triangles[:, corner]] for corner in range(3))
    cross = np.cross(b - a, c - a)
    area = np.linalg.norm(cross, axis=1)
    normals = cross / np.maximum(area, 1e-12)[:, None]
    rays = (a + b + c) / 3.0 - eye
    facing = -np.einsum("ij,ij->i", normals, rays) / np.linalg.norm(rays, axis=1)
    lines = np.concatenate([np.broadcast_to(eye, rays.shape), rays], axis=1)
    hit = ray_scene(vertices, triangles).cast_rays(tensor(lines, np.float32))["t_hit"].numpy()
    seen = (facing > FACING_COS) & ((a + b + c)[:, 2] > 3.0 * FOOT_M)
    seen &= np.abs(hit - 1.0) < 1e-3
    while True:
        chosen = int(random.choice(len(triangles), p=seen * area / (seen * area).sum()))
        spot, inwards = (a + b + c)[chosen] / 3.0, -normals[chosen]
        if _yields(vertices, spot[None], inwards)[0] == 1.0:
            return spot, inwards


def pressed(
    vertices_m: npt.NDArray[np.float64],
    at_m: npt.NDArray[np.float64],
    inwards: npt.NDArray[np.float64],
    *,
    depth_m: float,
    sigma_m: float,
) -> npt.NDArray[np.float64]:
    """Return the vertices of a body with a round dent; what lies opposite stays as it is.

    Args:
        vertices_m: (N, 3), metres.
        at_m: (3,), middle of the dent.
        inwards: (3,), unit vector into the body.
        depth_m: How deep; negative for a bulge.
        sigma_m: Radius of the dent, one sigma.
    """
    beside = vertices_m - at_m
    distance2 = (beside**2).sum(axis=1) - (beside @ inwards) ** 2
    depth = depth_m * np.exp(-distance2 / (2.0 * sigma_m**2))
    return np.asarray(
        vertices_m + (depth * _yields(vertices_m, vertices_m, inwards))[:, None] * inwards
    )


def _yields(
    vertices_m: npt.NDArray[np.float64],
    points_m: npt.NDArray[np.float64],
    inwards: npt.NDArray[np.float64],
) -> npt.NDArray[np.float64]:
    """Return what share of a dent each point follows, (N,): 1 outside, 0 on the opposite side."""
    outwards = -(vertices_m @ inwards)
    relative = (-(points_m @ inwards) - outwards.min()) / max(float(np.ptp(outwards)), 1e-9)
    return np.asarray(np.clip((relative - 0.3) / 0.4, 0.0, 1.0))


def _draw_truth(random: np.random.Generator) -> Truth:
    if random.random() >= DEVIATING_SHARE:
        return Truth("ok", 0.0)
    kind = KINDS[int(random.integers(len(KINDS)))]
    ranges = {
        "dent": (5.0, 20.0),
        "bulge": (5.0, 15.0),
        "crush": (10.0, 25.0),
        "moved": (20.0, 40.0),
    }
    low, high = ranges.get(kind, (0.0, 0.0))
    return Truth(kind, float(random.uniform(low, high)))


def _shift(length_m: float, random: np.random.Generator) -> npt.NDArray[np.float64]:
    """A shift in the tray plane, mostly along y: neighbours in x are 85 mm away at most."""
    angle = random.uniform(0.0, 2.0 * np.pi)
    return on_tray(length_m * np.cos(angle), length_m * np.sin(angle), 0.0)


def _foreign_object(
    vertices_m: npt.NDArray[np.float64],
    planned: npt.NDArray[np.float64],
    placed: npt.NDArray[np.float64],
    random: np.random.Generator,
) -> Mesh:
    """A block of 40 x 30 x 30 mm that lies 10 to 14 mm beside the package, in the place's room."""
    half = vertices_m[:, :2].max(axis=0)
    while True:
        along, side = int(random.integers(2)), random.choice([-1.0, 1.0])
        offset = random.uniform(-0.3, 0.3, 2) * half
        offset[along] = side * (half[along] + 0.015 + random.uniform(0.010, 0.014))
        size = (0.030, 0.040, 0.030) if along == 0 else (0.040, 0.030, 0.030)
        vertices, triangles = box_mesh(size)
        beside = on_tray(offset[0], offset[1], random.uniform(-0.15, 0.15))
        lying = moved(vertices, placed @ beside)
        if (np.abs(lying[:, :2] - planned[:2, 3]) < ROOM_M).all():
            return lying, triangles
