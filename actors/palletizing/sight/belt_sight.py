"""What lies on the belt: which of the trained products, and where it stands.

what is new on the belt -> every trained surface registered to it -> rendered into the sensor
                        -> the one whose image is nearest to what was seen

what stands upright nowhere -> the same surfaces with six freedoms: does one of them lie or lean?

Rules a change must keep: recognised by shape alone, against all trained surfaces; nothing is left
out because it fits none: its misfit says so.  The height of belt and tray is z = 0 of their frames.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from actors.geometry.poses import inverse, on_tray
from actors.geometry.recognition.deviation import LEANS_M, Limits
from actors.geometry.recognition.registration import leaning, register, tilt_of
from actors.geometry.recognition.segmentation import Piece, new_pieces
from actors.geometry.shapes import DepthFrame
from actors.geometry.surfaces.depth import frame_points, median_known, metres
from actors.geometry.surfaces.rendering import render_depth
from actors.palletizing.placing.rows import TRAY_HALF_M
from actors.palletizing.vocabulary import Sighting

if TYPE_CHECKING:
    from collections.abc import Mapping

    import numpy.typing as npt

    from actors.geometry.shapes import Surface
    from enact_dist import Entity

    Pose = npt.NDArray[np.float64]
    Mask = npt.NDArray[np.bool_]

GROUND_M: Final = 0.012
"""What is lower belongs to the belt: seven spreads of the sensor."""

FAR_OFF_M: Final = 0.012
"""A pixel that is farther off, or seen where nothing should be, or not seen, counts as so far."""

WITHIN_RIM_M: Final = np.array(TRAY_HALF_M) - 0.007
"""Half of the tray within its rim: packages stand there."""

ON_BELT_SHARE: Final = 0.2
"""Least share of a thing's pixels that hides the belt: half a package may stand over its edge, and
what stands on the tray hides none of it."""

LIES_RAD: Final = float(np.deg2rad(45.0))
"""What is tilted by more lies; by less, it leans against something."""

MISFIT_MAX_M: Final = 0.003
"""Of a package that is what it is taken for; see `BeltSight.known`."""

HEIGHT_OFF_M: Final = 0.035
"""A product whose height differs by more is not tried: no crush takes so much."""


@dataclass(frozen=True, slots=True, eq=False)
class BeltSight:
    """One thing on the belt.

    Attributes:
        product: The trained product that it resembles most; empty if none is nearly as high.
        belt_from_product: Where that stands, (4, 4) float64, metres.
        misfit_m: Mean distance along the optical axis between what was seen and what the product
            would look like there, over the pixels of either, each at most `FAR_OFF_M`.
        tilt_rad: Between its z axis and the vertical; 0 unless it lies or leans.
    """

    product: str
    belt_from_product: Pose
    misfit_m: float
    tilt_rad: float = 0.0

    @property
    def known(self) -> bool:
        """Whether it is that product, whole and upright; what is not is for the operator."""
        return bool(self.product) and self.misfit_m <= MISFIT_MAX_M and not self.tilt_rad

    def sighting(self, number: int, tray: int, product: str) -> Sighting:
        """Return where a package was seen.

        Args:
            number: Of its arrival.
            tray: That it is for.
            product: What it is, if it is not known now; "" if it never was.
        """
        product = self.product if self.known else product
        pose = self.belt_from_product
        return Sighting(tray, pose, number, number, "belt", product, self.unfit)

    @property
    def unfit(self) -> str:
        """Why no hand takes it, in words; empty if it is known."""
        if self.known:
            return ""
        if not self.tilt_rad:
            return "what is on the belt is no package that stands upright"
        if self.tilt_rad <= LIES_RAD:
            return f"the package leans on the belt by {np.degrees(self.tilt_rad):.0f}°"
        return "the package lies on its side on the belt"


@dataclass(frozen=True, slots=True, eq=False)
class BeltWatch:
    """Looks on the belt for one package.

    Attributes:
        empty: The empty belt.
        models: Trained surface of each product, product frame.
        belt_from_tray: See `seen_on_belt`.
    """

    empty: DepthFrame
    models: Mapping[str, Surface]
    belt_from_tray: Pose | None = None

    @classmethod
    def of(
        cls,
        empty: DepthFrame,
        models: Mapping[Entity, Surface],
        frames: Mapping[str, Pose] | None,
    ) -> BeltWatch:
        """Return the watch of a cell: surfaces by product, and where belt and tray stand."""
        names = {one.name.removeprefix("product/"): surface for one, surface in models.items()}
        between = None if frames is None else inverse(frames["belt"]) @ frames["tray"]
        return cls(empty, names, between)

    def sight(self, frame: DepthFrame, product: str) -> BeltSight | None:
        """Return the sight that is of a package, None if none can be.

        Args:
            frame: The image now.
            product: What the package is; "" if that is not known: then any sight is of it.

        Returns:
            A package that stands, if there is one; otherwise something that does not.  What is
            recognised as another product is another package.
        """
        sights = seen_on_belt(
            frame, self.empty.depth_mm, self.models, belt_from_tray=self.belt_from_tray
        )
        if not product:
            return next(iter(sights), None)
        upright = [sight for sight in sights if sight.known and sight.product == product]
        return next(iter(upright or [sight for sight in sights if not sight.known]), None)


def seen_on_belt(
    frame: DepthFrame,
    empty_mm: npt.NDArray[np.uint16 | np.float32],
    models: Mapping[str, Surface],
    *,
    belt_from_tray: Pose | None = None,
) -> list[BeltSight]:
    """Recognise and pose everything that lies on the belt and is wholly in the image.

    Args:
        frame: The image now; its world is the belt frame, and the sensor looks at the belt.
        empty_mm: (H, W), the image of the empty belt, millimetres.
        models: Trained surface of each product, product frame.
        belt_from_tray: Where the tray is, (4, 4), metres: what is seen over it is no part of what
            stands between it and the belt.  None: the tray is nowhere near.

    Returns:
        A sight for each thing, the one farthest along the belt (greatest x) first; things that
        touch are one. Empty if nothing lies there.
    """
    empty = DepthFrame(np.asarray(empty_mm), frame.acquisition)
    belt = _belt(empty)
    if belt_from_tray is not None:
        frame = _without_tray(frame, empty, belt_from_tray)
    seen_m = median_known(metres(frame.depth_mm), 5)
    sights = [
        _recognised(piece, frame, seen_m, models)
        for piece in new_pieces(frame, empty.depth_mm)
        if belt[piece.mask].mean() > ON_BELT_SHARE and not _cut_off(piece.mask)
    ]
    return sorted(sights, key=lambda sight: -sight.belt_from_product[0, 3])


def _without_tray(frame: DepthFrame, empty: DepthFrame, belt_from_tray: Pose) -> DepthFrame:
    """Return an image with nothing on the tray."""
    points = frame_points(frame) @ inverse(belt_from_tray)[:3, :3].T
    points += inverse(belt_from_tray)[:3, 3]
    with np.errstate(invalid="ignore"):
        over = (np.abs(points[..., :2]) < WITHIN_RIM_M).all(axis=-1)
    depth_mm = np.where(over, empty.depth_mm, frame.depth_mm).astype(frame.depth_mm.dtype)
    return DepthFrame(depth_mm, frame.acquisition)


def _belt(empty: DepthFrame) -> Mask:
    """Return the pixels of the belt: what is level with the middle of the image, and joined to it.

    Other things of the same height, such as the tray beside it, are no part of the belt.
    """
    from scipy.ndimage import label

    filled = DepthFrame(_filled(empty.depth_mm), empty.acquisition)
    with np.errstate(invalid="ignore"):
        level = np.abs(frame_points(filled)[..., 2]) < GROUND_M
    pieces, _ = label(level)
    middle = pieces[tuple(size // 2 for size in pieces.shape)]
    return np.asarray((pieces == middle) & (middle > 0))


def _filled(depth_mm: npt.NDArray[np.uint16 | np.float32]) -> npt.NDArray[np.float32]:
    return np.asarray(np.nan_to_num(1000.0 * median_known(metres(depth_mm), 5)), np.float32)


def _cut_off(mask: Mask) -> bool:
    """Return whether something reaches the border of the image, so that a part of it is missing."""
    return bool(mask[:3].any() or mask[-3:].any() or mask[:, :3].any() or mask[:, -3:].any())


def _recognised(
    piece: Piece, frame: DepthFrame, seen_m: npt.NDArray[np.float32], models: Mapping[str, Surface]
) -> BeltSight:
    expected = on_tray(piece.centre_m[0], piece.centre_m[1], 0.0)
    best = BeltSight("", expected, FAR_OFF_M)
    top_m = float(np.percentile(piece.cloud.points_m[:, 2], 98))
    for product, surface in models.items():
        if abs(float(surface.vertices_m[:, 2].max()) - top_m) > HEIGHT_OFF_M:
            continue
        pose = register(
            piece.cloud, piece.outline_m, surface, expected, seen_by=frame.acquisition
        ).tray_from_product
        rendered_m = render_depth([(surface, pose)], frame.acquisition)
        sight = BeltSight(product, pose, _misfit(seen_m, rendered_m, piece.mask))
        if not best.product or sight.misfit_m < best.misfit_m:
            best = sight
    return best if best.known else _tilted(piece, best, models)


def _tilted(piece: Piece, upright: BeltSight, models: Mapping[str, Surface]) -> BeltSight:
    """Return how something lies or leans that stands nowhere; `upright` if no product does."""
    fits = {
        product: leaning(piece.cloud, surface, upright.belt_from_product)
        for product, surface in models.items()
    }
    product = min(fits, key=lambda each: fits[each].distance_m, default="")
    if not product or fits[product].distance_m > LEANS_M:
        return upright
    pose = fits[product].tray_from_product
    if tilt_of(pose) <= Limits().tipped_rad:
        return upright
    return BeltSight(product, pose, upright.misfit_m, tilt_of(pose))


def _misfit(
    seen_m: npt.NDArray[np.float32], rendered_m: npt.NDArray[np.float32], mask: Mask
) -> float:
    """Return the mean distance of two images over the pixels of either; see `BeltSight`."""
    product = np.isfinite(rendered_m)
    either = (mask & np.isfinite(seen_m)) | product
    off = np.abs(seen_m - rendered_m)[either]
    return float(np.nan_to_num(np.minimum(off, FAR_OFF_M), nan=FAR_OFF_M).mean())
