"""The packages of the physical cell: what is random about each, and how its shape is damaged.

Physics knows no plastic deformation; a constitutive rule stands for it.  A patch of contact that
presses with more than the yield force of the face leaves a dent:

==========  =======================================================================================
force       what all contacts between the package and one other body press with, at its peak;
            smoothed over two cycles, since a solver's single spike deforms nothing
area        a patch wider than a dent spreads the force: only a dent's share of it counts
depth       (force - yield) / 5 N per mm
shape       round, 15 mm (one sigma), along the contact's normal; see `packages.pressed`
==========  =======================================================================================

Rules a change must keep: a package is a function of seed and number; whatever presses counts, be
it finger, neighbour, rim or floor.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

import numpy as np

from actors.palletizing.simulation.packages import DEMO_PRODUCTS, pressed
from actors.palletizing.simulation.products import product_mesh

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy.typing as npt

    F64 = npt.NDArray[np.float64]
    Mesh = tuple[F64, npt.NDArray[np.int32]]

STIFFNESS_N_MM: Final = 5.0
"""Force beyond the yield force that a millimetre of dent takes."""
DENT_SIGMA_M: Final = 0.015
DENT_AREA_M2: Final = float(np.pi * DENT_SIGMA_M**2)
SMOOTHING: Final = 0.5
"""Share of the newest cycle in the force that counts."""
DEEPEST_MM: Final = 30.0
"""Beyond that a package is torn, not dented; its shape stays a shape."""


@dataclass(frozen=True, slots=True)
class Material:
    """What a product is made of, as physics needs it.

    Attributes:
        mass_kg: Nominal.
        yield_top_n: Force at which the top face gets a dent.
        yield_side_n: The same of all other faces.
        colour: "red green blue alpha", for pictures.
    """

    mass_kg: float
    yield_top_n: float
    yield_side_n: float
    colour: str


MATERIALS: Final = {
    "milk_carton": Material(0.50, 40.0, 40.0, ".93 .93 .88 1"),
    "meal_tray": Material(0.35, 25.0, 60.0, ".80 .55 .35 1"),
    "yoghurt_cup": Material(0.45, 25.0, 35.0, ".65 .78 .90 1"),
}
"""By product: cartons, trays under a film with a stiff rim, cups under a foil."""


@dataclass(frozen=True, slots=True)
class Spread:
    """How far packages differ; all of it seeded.

    Attributes:
        mass_share: Largest deviation from the nominal mass, of it.
        friction: Least and greatest coefficient of friction.
        yield_share: Largest deviation from the nominal yield force, of it.
        contact_s: Least and greatest time constant of contacts: how soft a package is.
        centre_m: Largest offset of the centre of mass, along x and y.
        pick_m: Standard deviation, along x and y, of the error with which the belt's sensor is
            calibrated to the robot when a package is looked at: how far beside it is grasped.
        belt_m: Standard deviation of where across the belt a package comes.
        belt_rad: Standard deviation of how it is turned.
    """

    mass_share: float = 0.3
    friction: tuple[float, float] = (0.2, 0.6)
    yield_share: float = 0.2
    contact_s: tuple[float, float] = (0.005, 0.015)
    centre_m: float = 0.005
    pick_m: float = 0.002
    belt_m: float = 0.006
    belt_rad: float = 0.05


@dataclass(frozen=True, slots=True)
class Dent:
    """A dent in a package.

    Attributes:
        face: "top", "bottom", "front" (x), "back", "left" (y) or "right".
        at_m: Where, product frame.
        inwards: Unit vector into the package, product frame.
        force_n: Peak of the force that made it.
        depth_mm: How deep it is.
        by: What pressed: "left" and "right" are fingers.
    """

    face: str
    at_m: tuple[float, float, float]
    inwards: tuple[float, float, float]
    force_n: float
    depth_mm: float
    by: str


@dataclass(frozen=True, slots=True)
class PhysicalPackage:
    """What is true of one package before anything happens to it.

    Attributes:
        number: From 0, in the order of coming.
        product: Name of the product.
        mass_kg: Its mass.
        friction: Coefficient of friction of all its contacts.
        yield_share: Its yield forces, of the nominal ones.
        contact_s: Time constant of its contacts.
        centre_offset_m: Centre of mass beside the middle of its body, product frame.
        pick_offset_m: Error along x and y with which the belt's sensor sees it, base frame.
        belt_y_m: Where across the belt it comes.
        belt_yaw_rad: How it is turned there.
    """

    number: int
    product: str
    mass_kg: float
    friction: float
    yield_share: float
    contact_s: float
    centre_offset_m: tuple[float, float, float]
    pick_offset_m: tuple[float, float]
    belt_y_m: float
    belt_yaw_rad: float

    @property
    def colour(self) -> str:
        """Of its product, "red green blue alpha"."""
        return MATERIALS[self.product].colour

    def yield_n(self, face: str) -> float:
        """Return the force at which a face gets a dent."""
        material = MATERIALS[self.product]
        nominal = material.yield_top_n if face == "top" else material.yield_side_n
        return self.yield_share * nominal


def draw_packages(
    count: int,
    *,
    seed: int,
    products: Sequence[str] = DEMO_PRODUCTS,
    spread: Spread | None = None,
) -> list[PhysicalPackage]:
    """Return the packages of a run.

    Args:
        count: How many.
        seed: Seed of everything random about them.
        products: Products that come in turn.
        spread: How far they differ; the defaults when absent.

    Raises:
        ValueError: No package, or a product that does not exist.
    """
    spread = spread or Spread()
    if count < 1:
        raise ValueError(f"asked for {count} packages; at least 1")
    for name in products:
        if name not in MATERIALS:
            raise ValueError(f"no product {name!r}; there are {', '.join(MATERIALS)}")
    return [
        _drawn(number, products[number % len(products)], spread, seed) for number in range(count)
    ]


def _drawn(number: int, product: str, spread: Spread, seed: int) -> PhysicalPackage:
    random = np.random.default_rng([seed, 11, number])
    mass, yielding, x, y = random.uniform(-1.0, 1.0, 4)
    pick = random.standard_normal(2) * spread.pick_m
    across, turn = random.standard_normal(2) * [spread.belt_m, spread.belt_rad]
    return PhysicalPackage(
        number=number,
        product=product,
        mass_kg=MATERIALS[product].mass_kg * (1.0 + spread.mass_share * mass),
        friction=float(random.uniform(*spread.friction)),
        yield_share=1.0 + spread.yield_share * yielding,
        contact_s=float(random.uniform(*spread.contact_s)),
        centre_offset_m=(x * spread.centre_m, y * spread.centre_m, 0.0),
        pick_offset_m=(float(pick[0]), float(pick[1])),
        belt_y_m=float(across),
        belt_yaw_rad=float(turn),
    )


def face_of(inwards: F64) -> str:
    """Return the name of the face that a vector into the package goes through, product frame."""
    axis = int(np.argmax(np.abs(inwards)))
    names = (("front", "back"), ("left", "right"), ("top", "bottom"))[axis]
    return names[0] if inwards[axis] < 0.0 else names[1]


def patch_area(points_m: F64, normal: F64) -> float:
    """Return the area of the patch whose corners are points of contact, m².

    Args:
        points_m: (N, 3); fewer than three span nothing.
        normal: (3,), unit vector across it.
    """
    if len(points_m) < 3:
        return 0.0
    # Seen along the axis that the normal is nearest to; the patch is larger than what is seen.
    axis = int(np.argmax(np.abs(normal)))
    seen = points_m[:, [each for each in range(3) if each != axis]]
    x, y = (seen - seen.sum(axis=0) / len(seen)).T
    order = np.argsort(np.arctan2(y, x))
    x, y = x[order], y[order]
    twice = x[:-1] @ y[1:] - y[:-1] @ x[1:] + x[-1] * y[0] - y[-1] * x[0]
    return float(0.5 * abs(twice / normal[axis]))


@dataclass(slots=True, eq=False)
class Damage:
    """The dents of one package, and how hard it is pressed at present.

    Attributes:
        package: Whose they are.
        dents: Deepest value of each so far.
    """

    package: PhysicalPackage
    dents: list[Dent] = field(default_factory=list)
    _smooth_n: dict[str, float] = field(default_factory=dict)

    def calm(self) -> None:
        """Nothing presses any more."""
        self._smooth_n.clear()

    def press(self, by: str, force_n: float, area_m2: float, at_m: F64, inwards: F64) -> None:
        """Take the contacts with one other body in one cycle.

        Args:
            by: Name of the other body.
            force_n: Sum of the normal forces.
            area_m2: Of the patch.
            at_m: (3,), its middle weighted by force, product frame.
            inwards: (3,), mean direction of the force, product frame.
        """
        counts = force_n * min(1.0, DENT_AREA_M2 / max(area_m2, 1e-9))
        last = self._smooth_n.get(by, 0.0)
        smooth = self._smooth_n[by] = last + SMOOTHING * (counts - last)
        face = face_of(inwards)
        depth = (smooth - self.package.yield_n(face)) / STIFFNESS_N_MM
        if depth <= 0.0:
            return
        dent = Dent(
            face=face,
            at_m=(float(at_m[0]), float(at_m[1]), float(at_m[2])),
            inwards=(float(inwards[0]), float(inwards[1]), float(inwards[2])),
            force_n=float(smooth),
            depth_mm=float(min(depth, DEEPEST_MM)),
            by=by,
        )
        for number, old in enumerate(self.dents):
            if old.face == face and np.linalg.norm(np.subtract(old.at_m, at_m)) < DENT_SIGMA_M:
                if dent.depth_mm > old.depth_mm:
                    self.dents[number] = dent
                return
        self.dents.append(dent)


def dented_mesh(product: str, dents: Sequence[Dent]) -> Mesh:
    """Return the shape of a damaged package.

    Returns:
        Vertices (N, 3), metres, product frame, and triangles (M, 3); shared if there is no dent.
    """
    vertices, triangles = product_mesh(product)
    for dent in dents:
        vertices = pressed(
            vertices,
            np.array(dent.at_m),
            np.array(dent.inwards),
            depth_m=dent.depth_mm / 1e3,
            sigma_m=DENT_SIGMA_M,
        )
    return vertices, triangles
