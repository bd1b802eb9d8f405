"""Deviation detection: compares what stands at a place with what should."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from actors.geometry.open3d_on_use import open3d
from actors.geometry.recognition.deviation import Limits, inspect_place
from actors.geometry.recognition.segmentation import nearest
from actors.palletizing.vocabulary import (
    DEVIATIONS,
    OBSERVATION,
    PACKAGES,
    PLACES,
    PLAN,
    PRODUCTS,
    REGION,
    SIGHTING,
    STANDING,
    SURFACE,
    SYSTEM,
    Deviation,
    Standing,
    product_entity,
)
from enact_dist import Actor, View, ViewEach, World, Write

if TYPE_CHECKING:
    from collections.abc import Mapping

    from actors.geometry.recognition.deviation import Finding
    from actors.palletizing.vocabulary import Observation, Sighting
    from enact_dist import Lock


class DeviationDetection(Actor):
    """Flag every place where something is missing, extra, moved or deformed (ENACT 4.2).

    The place is the entity in both world contexts: in training with its expected content, in
    online with what was seen there.

    Args:
        moved_m: Largest shift of a sound package.
        deformed_m2: Least area of a deformation; see `Limits` for what the numbers come from.
        turned_deg: Largest turn of a sound package.
    """

    training, online = World("training"), World("online")
    plan = View(training, PLACES, PLAN)
    models = ViewEach(training, PRODUCTS, SURFACE)
    sightings = ViewEach(online, PACKAGES, SIGHTING)
    observed = View(online, PLACES, OBSERVATION)
    flags = Write(online, SYSTEM, DEVIATIONS)
    region = Write(online, PLACES, REGION)
    standing = Write(online, PLACES, STANDING)
    triggers = (observed,)

    def __init__(
        self,
        moved_m: float = Limits().moved_m,
        deformed_m2: float = Limits().deformed_m2,
        turned_deg: float = math.degrees(Limits().turned_rad),
    ) -> None:
        self.limits = Limits(
            moved_m=moved_m, deformed_m2=deformed_m2, turned_rad=math.radians(turned_deg)
        )

    def start(self) -> None:
        """Load Open3D before the first package comes: it takes a second or two."""
        open3d()

    def update(self, lock: Lock) -> None:
        """Judge one place."""
        plan, observed = lock[self.plan], lock[self.observed]
        model = lock[self.models][product_entity(plan.product)]
        sightings = {package.name: seen for package, seen in lock[self.sightings].items()}
        beside = [
            seen.frame_from_package
            for name, seen in sightings.items()
            if (seen.frame, seen.tray) == ("tray", plan.tray) and name not in observed.packages
        ]
        found = inspect_place(
            observed.frame, observed.before_mm, model, plan.tray_from_product,
            limits=self.limits, others=beside,
        )  # fmt: skip
        flag = flag_of(found, plan.product, observed, sightings)
        lock[self.region] = found.region
        lock[self.standing] = Standing(plan.product, found.verdict, found.shift_mm, found.turn_deg)
        others: dict[str, Deviation] = lock.get(self.flags, {})
        lock[self.flags] = {**others, lock.entity.name: flag}


def flag_of(
    found: Finding, product: str, observed: Observation, sightings: Mapping[str, Sighting]
) -> Deviation:
    """Return the flag of a place: of the new packages the nearest one is meant."""
    new = [name for name in observed.packages if name in sightings]
    poses = [sightings[name].frame_from_package for name in new]
    chosen = nearest(found.tray_from_product[:2, 3], [pose[:2, 3] for pose in poses])
    return Deviation(
        package="" if chosen is None or found.verdict == "missing" else new[chosen],
        product=product,
        verdict=found.verdict,
        deviation_mm=found.deviation_mm,
        area_mm2=found.area_mm2,
        shift_mm=found.shift_mm,
        turn_deg=found.turn_deg,
        captured_ns=observed.captured_ns,
        tray_from_product=found.tray_from_product,
    )
