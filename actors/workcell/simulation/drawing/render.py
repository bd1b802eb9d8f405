"""The composite renderer: a backdrop, moving shadows, capsules in front by depth, noise.

Moving things are drawn in each image, static things only once: 2 to 3 ms of one processor
per view of 640 x 480.  The same stamp gives the same image.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from actors.geometry.capsules import image_boxes, outlines
from actors.workcell.simulation.drawing.backdrop import LAMP_PX, backdrop_of, lamp, rays_of
from actors.workcell.simulation.human import CAPSULES
from actors.workcell.simulation.room import BOXES, LAMP_M, Box
from actors.workcell.vocabulary import Calibration

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy.typing as npt

    from actors.workcell.simulation.drawing.backdrop import Backdrop

    F32 = npt.NDArray[np.float32]
    F64 = npt.NDArray[np.float64]
    Image = npt.NDArray[np.uint8]

NOISE_LEVELS: Final = 2.5
"""Standard deviation of a pixel's noise."""
_BANK_PX: Final = 64
"""The noise of an image begins anywhere in this many columns and rows of the bank."""

ROBOT_COLOURS: Final = ((0.10, 0.45, 0.95), (0.85, 0.85, 0.85))
"""Blue, green, red, in turns along the arm."""
SKIN: Final = (0.58, 0.70, 0.88)
CLOTHES: Final = (
    ((0.42, 0.20, 0.15), (0.25, 0.48, 0.20)),
    ((0.18, 0.18, 0.20), (0.20, 0.25, 0.70)),
    ((0.30, 0.34, 0.40), (0.62, 0.40, 0.16)),
)
"""Trousers and shirt, by number of the person."""


@dataclass(frozen=True, slots=True, eq=False)
class Rendered:
    """One view before its noise.

    Attributes:
        image: (H, W, 3) uint8, BGR.
        depth_m: (H, W) float32, along the optical axis.
        names: (H, W) int16: 0 is what stands still, then the capsules from 1 on, as they came.
        lamp_m: (L, L) float32, the lamp's image of what moves: depth below the lamp.
        count: Number of capsules drawn.
    """

    image: Image
    depth_m: F32
    names: npt.NDArray[np.int16]
    lamp_m: F32
    count: int = 0


_NO_IMAGE: Final = np.empty((0, 0, 3), np.uint8)
_NO_NAMES: Final = np.empty((0, 0), np.int16)


class Painter:
    """Draws moving capsules over the still pictures of one camera."""

    def __init__(self, calibration: Calibration) -> None:
        self.calibration = calibration
        self._origin, self._rays = rays_of(calibration)
        self._camera = (
            calibration.camera_matrix,
            calibration.distortion,
            calibration.camera_from_cell,
        )
        matrix, pose = lamp()
        downwards = Calibration(matrix, np.zeros(5), pose, LAMP_PX, LAMP_PX)
        self._lamp_rays = rays_of(downwards)[1]
        self._lamp = (matrix, np.zeros(5), pose)
        self._lamp_m = np.array(LAMP_M)

    def paint(
        self, onto: Rendered, backdrop: Backdrop, capsules: F64, colours: F64 | None
    ) -> Rendered:
        """Return a view with more capsules in it, and their shadows; `onto` is used up.

        Args:
            onto: Drawn into, but for its lamp's image.
            backdrop: What stands still in it.
            capsules: (n, 7), cell.
            colours: (n, 3), blue, green, red, 0 to 1; None: the image shows them already, and only
                their depth and their places before the lamp are drawn.
        """
        from actors.workcell.simulation.drawing.kernels import cast_shadows, draw

        if not len(capsules):
            return onto
        height, width = onto.depth_m.shape
        both = np.concatenate([capsules, _on_floor(capsules)])
        around = outlines(both, [self._camera, self._lamp], sides=8)
        spans = image_boxes(around[0], height, width)
        above = image_boxes(around[1, : len(capsules)], LAMP_PX, LAMP_PX)
        shades = np.empty((len(capsules), 3)) if colours is None else colours
        lamp_m, at, rays = onto.lamp_m.copy(), self._lamp_m, self._lamp_rays
        draw(_NO_IMAGE, lamp_m, _NO_NAMES, at, rays, above, capsules, shades, at, 0)
        image, names, first = onto.image, onto.names, onto.count + 1
        landed = spans[spans[:, 2] > 0]
        if colours is None:
            image, names = _NO_IMAGE, _NO_NAMES
        elif len(landed):
            window = (*landed[:, :2].min(0).tolist(), *landed[:, 2:].max(0).tolist())
            still_m, light = backdrop.depth_m, backdrop.light
            cast_shadows(image, onto.depth_m, still_m, light, onto.lamp_m, lamp_m, window)
        windows, depth_m, rays = spans[: len(capsules)], onto.depth_m, self._rays
        draw(image, depth_m, names, self._origin, rays, windows, capsules, shades, at, first)
        return Rendered(onto.image, depth_m, onto.names, lamp_m, onto.count + len(capsules))


def _on_floor(capsules: F64) -> F64:
    """Return capsules that hold the shadows on the floor of others, (n, 7)."""
    landed = capsules.copy()
    lamp_m = np.array(LAMP_M)
    scale = np.ones(len(capsules))
    for column in (0, 3):
        ends = capsules[:, column : column + 3] - lamp_m
        times = lamp_m[2] / np.maximum(-ends[:, 2] - capsules[:, 6], 0.3)
        landed[:, column : column + 3] = lamp_m + ends * times[:, None]
        scale = np.maximum(scale, times)
    landed[:, 6] *= scale
    return landed


class Noise:
    """Noise of a sensor from a bank of random numbers; each stamp has its own."""

    def __init__(self, height: int, width: int, seed: int) -> None:
        generator = np.random.default_rng(seed)
        shape = (height + _BANK_PX, width + _BANK_PX, 3)
        noise = generator.standard_normal(shape, np.float32) * NOISE_LEVELS
        self._bank = np.rint(noise).astype(np.int8)
        self._height, self._width, self._seed = height, width, seed

    def added(self, image: Image, stamp_ns: int) -> Image:
        """Return an image with the noise of its stamp."""
        import cv2

        mixed = (stamp_ns // 1_000_000 * 2_654_435_761 + self._seed * 40_503) & 0xFFFF_FFFF
        row, column = (mixed >> 8) % _BANK_PX, (mixed >> 20) % _BANK_PX
        tile = self._bank[row : row + self._height, column : column + self._width]
        return np.asarray(cv2.add(image, tile, dtype=cv2.CV_8U))


def robot_colours(count: int) -> F64:
    """Return the colours of an arm of so many capsules, (n, 3)."""
    return np.array([ROBOT_COLOURS[number % 2] for number in range(count)], np.float64)


def person_colours(number: int) -> F64:
    """Return the colours of a person, (17, 3)."""
    trousers, shirt = CLOTHES[number % len(CLOTHES)]
    arm = [shirt, SKIN, SKIN]
    rows = [trousers] * 7 + [shirt] * 2 + [SKIN] * 2 + arm * 2
    assert len(rows) == CAPSULES
    return np.array(rows, np.float64)


class View:
    """One simulated camera: its backdrops and its painter."""

    def __init__(self, calibration: Calibration, seed: int) -> None:
        self.calibration = calibration
        self._painter = Painter(calibration)
        self._noise = Noise(calibration.height, calibration.width, seed)
        self._backdrops: dict[tuple[Box, ...], Backdrop] = {}

    def backdrop(self, boxes: Sequence[Box] = BOXES) -> Backdrop:
        """Return the room with boxes in it; made when first asked for."""
        key = tuple(boxes)
        if key not in self._backdrops:
            self._backdrops[key] = backdrop_of(self.calibration, key)
        return self._backdrops[key]

    def empty(self, boxes: Sequence[Box] = BOXES) -> Rendered:
        """Return the view of the room in which nothing moves, to draw into."""
        backdrop = self.backdrop(boxes)
        return Rendered(
            backdrop.image.copy(),
            backdrop.depth_m.copy(),
            np.zeros(backdrop.depth_m.shape, np.int16),
            np.full((LAMP_PX, LAMP_PX), np.inf, np.float32),
        )

    def render(
        self,
        capsules: F64,
        colours: F64 | None,
        boxes: Sequence[Box] = BOXES,
        *,
        onto: Rendered | None = None,
    ) -> Rendered:
        """Return the view of capsules in the room, without noise.

        Args:
            capsules: (n, 7), cell.
            colours: (n, 3), blue, green, red, 0 to 1; None: see `Painter.paint`.
            boxes: Static boxes in the room.
            onto: A view of the same boxes with other people in it; it is overwritten.
        """
        onto = self.empty(boxes) if onto is None else onto
        return self._painter.paint(onto, self.backdrop(boxes), capsules, colours)

    def exposed(self, image: Image, stamp_ns: int, brightness: float = 1.0) -> Image:
        """Return an image as the sensor gives it: with the light of the moment, and with noise."""
        import cv2

        if brightness != 1.0:
            image = np.asarray(cv2.convertScaleAbs(image, alpha=brightness), np.uint8)
        return self._noise.added(image, stamp_ns)
