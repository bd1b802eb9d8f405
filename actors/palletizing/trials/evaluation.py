"""Train products and judge simulated packages, without any world context.

    python -m actors.palletizing.trials.evaluation --packages 200 --seed 1

prints the blob areas of sound packages that `Limits.deformed_m2` is calibrated on; `--graded` adds
series of equal deviations.  `perception_scores` scores what this judges.

What was measured is in `enact_dist/docs/palletizing.md`, "Perception, scored alone".

Cannot be seen from above: dents in a face that is seen flatter than by 14 degrees, what lies in the
shadow of a taller package, and damage within 4 pixels (6 mm) of an outline.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections import Counter
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from actors.geometry.recognition.deviation import Finding, Limits, inspect_place
from actors.geometry.recognition.plate import seen_from
from actors.geometry.recognition.segmentation import product_on_plate
from actors.geometry.surfaces.depth_reconstruction import reconstruct_view
from actors.geometry.surfaces.fusion import fuse_views
from actors.palletizing.placing.pallet import tray_of
from actors.palletizing.sight.sensor import PLATE_M, steady
from actors.palletizing.simulation.noise import DARK, Light
from actors.palletizing.simulation.packages import (
    VERDICT_OF_KIND,
    Package,
    Truth,
    make_package,
)
from actors.palletizing.simulation.sensors import SimulatedOrbitSensor, SimulatedTraySensor

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from actors.geometry.shapes import Surface
    from actors.palletizing.sight.sensor import OrbitSensor


@dataclass(frozen=True, slots=True, eq=False)
class Case:
    """One simulated package and what was found."""

    package: Package
    finding: Finding
    check_s: float

    @property
    def correct(self) -> bool:
        """Whether the verdict agrees with the truth."""
        return self.finding.verdict == VERDICT_OF_KIND[self.package.truth.kind]

    @property
    def pose_error_mm(self) -> float:
        """Distance of the registered from the true position, millimetres."""
        found, true = self.finding.tray_from_product, self.package.placed
        return 1000.0 * float(np.hypot(*(found[:2, 3] - true[:2, 3])))


def train(product: str, sensor: OrbitSensor, *, views: int = 14, frames: int = 1) -> Surface:
    """Return the complete surface of a product from an orbit around it.

    Args:
        product: Name of the product on the plate.
        sensor: Eye-in-hand depth sensor.
        views: How many viewpoints the orbit has.
        frames: How many images are fused at each.
    """
    seen = [
        steady(partial(sensor.capture, product, number, views), frames=frames)
        for number in range(views)
    ]
    surfaces = [reconstruct_view(product_on_plate(f), f.acquisition.camera) for f in seen]
    return fuse_views(surfaces, [seen_from(frame, PLATE_M) for frame in seen], by_plate=True)


def judge(
    packages: Sequence[Package],
    models: Mapping[str, Surface],
    *,
    seed: int,
    limits: Limits | None = None,
    frames: int = 1,
    light: Light = DARK,
) -> list[Case]:
    """Inspect a sequence of packages, one per stop, and keep what was found.

    Args:
        packages: The sequence.
        models: Trained surface of each product.
        seed: Seed of the sensor's noise.
        limits: Of the inspection; the calibrated ones when absent.
        frames: How many images are fused at each stop.
        light: Around the sensor.
    """
    sensor = SimulatedTraySensor(packages, seed=seed, light=light)
    empty_mm = steady(sensor.capture_empty, frames=frames).depth_mm
    cases, before_mm = [], empty_mm
    for stop, package in enumerate(packages):
        if stop == 0 or tray_of(stop) != tray_of(stop - 1):
            before_mm = empty_mm
        frame = steady(partial(sensor.capture, stop), frames=frames)
        start = time.perf_counter()
        finding = inspect_place(
            frame, before_mm, models[package.product], package.planned, limits=limits
        )
        cases.append(Case(package, finding, time.perf_counter() - start))
        before_mm = frame.depth_mm
    return cases


def graded(
    kind: str, amount: float, count: int, *, seed: int, products: Sequence[str]
) -> list[Package]:
    """Return packages that all have one kind and amount of deviation."""
    return [
        make_package(
            stop,
            products[stop % len(products)],
            Truth(kind, amount),
            np.random.default_rng([seed, 11, stop]),
        )
        for stop in range(count)
    ]


def main(argv: Sequence[str] | None = None) -> int:
    """Train, judge sound packages, print the areas of their blobs; return 0."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--packages", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--products", default="milk_carton,meal_tray,yoghurt_cup")
    parser.add_argument("--graded", action="store_true", help="also dents of 2 to 20 mm and others")
    options = parser.parse_args(argv)
    products = options.products.split(",")
    start = time.perf_counter()
    models = {name: train(name, SimulatedOrbitSensor(seed=options.seed)) for name in products}
    print(f"training: {(time.perf_counter() - start) / len(products):.1f} s per product")
    sound = graded("ok", 0.0, options.packages, seed=options.seed, products=products)
    tight = judge(sound, models, seed=options.seed, limits=Limits(deformed_m2=1e-9))
    areas = sorted(case.finding.area_mm2 for case in tight if case.finding.verdict == "deformed")
    print(f"blobs of {len(sound)} sound packages, mm2: {[round(area) for area in areas[-10:]]}")
    if options.graded:
        for kind, amounts in {
            "dent": (2, 3, 4, 5, 8, 12, 20),
            "bulge": (3, 5, 8),
            "crush": (5, 10, 20),
            "moved": (8, 12, 20, 40),
        }.items():
            for amount in amounts:
                packages = graded(kind, amount, 24, seed=options.seed, products=products)
                found = Counter(
                    case.finding.verdict for case in judge(packages, models, seed=options.seed)
                )
                print(f"{kind} {amount}: {dict(found)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
