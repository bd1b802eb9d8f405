"""What the sensor above the tray makes of places that touch each other.

picture -> which places have changed -> the picture as it would be without the package of each ->
`inspect_place`, as for a package that has just come

Rules a change must keep: depth is the only evidence; a place is judged against what stands around
it now, not against what stood there before, since a push moves the neighbours too.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np

from actors.geometry.recognition.deviation import Limits, inspect_place
from actors.palletizing.sight.tray_changes import changed, tray_alone, where_seen, without

if TYPE_CHECKING:
    from collections.abc import Mapping

    import numpy.typing as npt

    from actors.geometry.shapes import DepthFrame, Surface

    F64 = npt.NDArray[np.float64]
    Places = Mapping[int, tuple[str, F64]]

LIMITS: Final = replace(Limits(), turned_rad=float(np.deg2rad(5.0)))
"""In a row a package is turned by its neighbours: by more than this it does not touch them."""


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """What was found at one place.

    Attributes:
        verdict: See `actors.geometry.recognition.deviation.VERDICTS`.
        pose: tray_from_product, (4, 4); None if nothing was found there.
        shift_mm: Distance from the planned position.
        turn_deg: Turn against the planned pose.
        deviation_mm: By how much it deviates.
    """

    verdict: str
    pose: F64 | None
    shift_mm: float
    turn_deg: float
    deviation_mm: float


class TrayWatch:
    """Judges the places of one tray, picture by picture.

    Args:
        empty: The empty tray.
        models: Trained surface of each product.
    """

    def __init__(self, empty: DepthFrame, models: Mapping[str, Surface]) -> None:
        self._empty, self._models = empty, models
        self._last: DepthFrame | None = None
        self.seen: dict[int, Seen] = {}
        self.frame = empty

    def forget(self) -> None:
        """Something was changed by hand: the next picture judges every place."""
        self._last = None

    def judged(self, frame: DepthFrame, places: Places, *, newest: int) -> dict[int, Seen]:
        """Return what stands at the newest place and at all others that have changed.

        Args:
            frame: The tray now.
            places: Product and tray_from_product as planned of every place that is in use.
            newest: Number of the place that something was done to.
        """
        self.frame = tray_alone(frame, self._empty)
        judged = self._changed(places) | {newest}
        self._last = self.frame
        found: dict[int, Seen] = {}
        # The newest first, beside which the others are judged; then again what does not stand as
        # it should, beside where the others are now.
        for place in sorted(judged, key=lambda each: (each != newest, each)):
            found[place] = self.seen[place] = self._inspected(place, places)
        if len(judged) > 1:
            for place in [each for each in judged if found[each].verdict != "ok"]:
                found[place] = self.seen[place] = self._inspected(place, places)
        return found

    def _inspected(self, place: int, places: Places) -> Seen:
        product, planned = places[place]
        others = self._others(place, places)
        before_mm = without(self.frame, self._empty.depth_mm, others)
        found = inspect_place(
            self.frame, before_mm, self._models[product], planned,
            limits=LIMITS, others=[pose for _, pose in others],
        )  # fmt: skip
        return Seen(
            verdict=found.verdict,
            pose=None if found.verdict == "missing" else found.tray_from_product,
            shift_mm=found.shift_mm,
            turn_deg=found.turn_deg,
            deviation_mm=found.deviation_mm,
        )

    def _others(self, place: int, places: Places) -> list[tuple[Surface, F64]]:
        """Return what stands at the other places: where it was found, or as planned by now."""
        others = []
        for number, seen in self.seen.items():
            if number != place and number in places and seen.pose is not None:
                product, planned = places[number]
                surface = self._models[product]
                pose = where_seen(self.frame, surface, [seen.pose, planned])
                others.append((surface, seen.pose if pose is None else pose))
        return others

    def _changed(self, places: Places) -> set[int]:
        """Return the places whose pixels differ from those of the picture before."""
        if self._last is None:
            return set(places) & set(self.seen)
        standing = {
            number: (
                self._models[places[number][0]],
                places[number][1] if seen.pose is None else seen.pose,
            )
            for number, seen in self.seen.items()
            if number in places
        }
        return set(changed(self.frame, self._last, standing))
