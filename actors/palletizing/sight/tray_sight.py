"""What one picture of the tray shows: the package it is about, and the neighbours that have moved.

PURE: pictures and what is known in, what was seen out; `handling_perception` looks.

Rule a change must keep: a package is judged beside what stands around it now, see `tray_changes`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final

from actors.geometry.recognition.registration import register
from actors.geometry.recognition.segmentation import new_pieces
from actors.geometry.surfaces.depth import metres
from actors.palletizing.handling.stages import GONE
from actors.palletizing.sight.tray_changes import changed, without
from actors.palletizing.vocabulary import Observation, Sighting, place_entity, product_entity

if TYPE_CHECKING:
    from collections.abc import Mapping

    import numpy as np
    import numpy.typing as npt

    from actors.geometry.shapes import DepthFrame, PointCloud, Surface
    from actors.palletizing.vocabulary import Plan
    from enact_dist import Entity

    Depth = npt.NDArray[Any]

GONE_M: Final = 0.15
"""What is farther from where a package stood is something else, when it shall be gone."""


@dataclass(frozen=True, slots=True, eq=False)
class Tray:
    """What is known of a tray.

    Attributes:
        number: Of the tray.
        empty: Its picture when it was empty.
        models: Trained surface of each product.
        plans: By place.
        sightings: By package, those elsewhere included.
    """

    number: int
    empty: DepthFrame
    models: Mapping[Entity, Surface]
    plans: Mapping[Entity, Plan]
    sightings: Mapping[Entity, Sighting]

    def standing(self) -> dict[Entity, tuple[Surface, npt.NDArray[np.float64]]]:
        """Return what stands on it: surface and tray_from_product, (4, 4), metres, by package."""
        return {
            package: (self.models[product_entity(seen.product)], seen.frame_from_package)
            for package, seen in self.sightings.items()
            if (seen.frame, seen.tray) == ("tray", self.number)
        }

    def without(self, package: Entity, frame: DepthFrame) -> Depth:
        """Return a picture as it would be without a package, (H, W) float32, millimetres."""
        others = [each for other, each in self.standing().items() if other != package]
        return without(frame, self.empty.depth_mm, others)

    def seen(
        self, package: Entity, frame: DepthFrame, near_m: float
    ) -> tuple[Sighting, PointCloud | None]:
        """Return where a package is, and its points in the tray frame; None if it is not there.

        Args:
            package: Which; it was seen before.
            frame: The tray now.
            near_m: So near to where it was, or shall be, it is looked for.
        """
        before = self.sightings[package]
        plan, before_mm = self.plans[place_entity(before.first_stop)], self.without(package, frame)
        was = before.frame_from_package if before.frame == "tray" else plan.tray_from_product
        pieces = [
            piece
            for piece in (new_pieces(frame, before_mm) if before.product else [])
            if math.dist(piece.centre_m[:2], was[:2, 3]) < near_m
        ]
        seen = replace(before, tray=plan.tray, frame="", unfit="")
        if not pieces:
            return seen, None
        found = register(
            pieces[0].cloud, pieces[0].outline_m, self.models[product_entity(before.product)],
            plan.tray_from_product, seen_by=frame.acquisition, before_m=metres(before_mm),
        )  # fmt: skip
        pose = found.tray_from_product
        return replace(seen, frame="tray", frame_from_package=pose), pieces[0].cloud


@dataclass(frozen=True, slots=True, eq=False)
class TraySight:
    """What a picture shows anew.

    Attributes:
        sightings: By package: the one that it is about first, then the neighbours that have moved.
        clouds: Points of those that are there, tray frame, metres.
        observations: By place, of those that are to be judged.
    """

    sightings: dict[Entity, Sighting]
    clouds: dict[Entity, PointCloud]
    observations: dict[Entity, Observation]


def tray_sight(
    frame: DepthFrame,
    last: DepthFrame | None,
    tray: Tray,
    package: Entity,
    *,
    kind: str,
    captured_ns: int,
) -> TraySight:
    """Return what a picture shows of a package and of what has moved since the last one.

    Args:
        frame: The tray now, with nothing beside it (`tray_alone`).
        last: The picture before; None: there is none.
        tray: What is known of it.
        package: What the picture is about.
        kind: Of the request; after one of `GONE` the place of the package is not judged.
        captured_ns: When it was taken, nanoseconds since 1970.
    """
    moved = [] if last is None else changed(frame, last, tray.standing())
    seen: dict[Entity, Sighting] = {}
    clouds: dict[Entity, PointCloud] = {}
    for each in dict.fromkeys((package, *moved)):  # the newest first: others are seen beside it
        near_m = GONE_M if each == package and kind in GONE else math.inf
        seen[each], cloud = tray.seen(each, frame, near_m)
        if cloud is not None:
            clouds[each] = cloud
        tray = replace(tray, sightings={**tray.sightings, each: seen[each]})
    observations = {  # where all of them stand is known now
        place_entity(one.first_stop): Observation(
            frame, tray.without(each, frame), (each.name,) if each in clouds else (), captured_ns
        )
        for each, one in seen.items()
        if each != package or kind not in GONE
    }
    return TraySight(seen, clouds, observations)
