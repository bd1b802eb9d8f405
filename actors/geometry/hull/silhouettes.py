"""Silhouettes: which pixels of an image differ from the empty cell, shadows aside.

An image is smoothed, compared with the mean of the empty cell, rid of shadows and of single pixels.
A shadow is darker than the background by a bounded factor and of the same colour.  So is a person
in grey before a grey wall: `Subtraction.split` keeps what looks like shadow apart from background,
and `visual_hull.VisualHull.shaded` finds which of it is shadow.  Where more of an image looks like
shadow than any shadow covers, the light has changed, and all of it stays foreground.

Rules a change must keep: masks are (H, W) uint8, 0 or 255; what is in doubt is foreground; the
background never changes while something is looked for, so that who stands still does not fade.
OpenCV and integers only: about 1.1 ms of one core per image of 640 x 480, 0.4 of it for shadows.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable

    import numpy.typing as npt

    Image = npt.NDArray[np.uint8]
    Mask = npt.NDArray[np.uint8]

SUBTRACTORS: Final = ("gaussian", "mog2", "knn")
"""Ways to tell foreground from background: one Gaussian per pixel, or a model of OpenCV."""
BOX_PX: Final = 3
"""Edge of the box filter that images and background go through."""
LEVELS_MIN: Final = 6
"""A pixel that differs by at most this is background, however little it varied."""
SPREADS: Final = 6
"""A pixel that differs by at most so many standard deviations is background."""
EDGE_FACTOR: Final = 2
"""Smoothing blurs an edge by a pixel.  There a pixel counts only if it differs by so many times
what a smoothed one may, before smoothing: about five standard deviations of its noise."""
SHADOW_DARKEST: Final = 0.45
"""A shadow leaves at least this share of the light."""
SHADOW_LIGHTEST: Final = 0.98
"""A shadow takes at least the rest of the light."""
SHADOW_COLOUR_LEVELS: Final = 6
"""A shadow changes the colour by at most so many levels."""
SHADOW_SHARE_MAX: Final = 0.3
"""If more of an image looks like shadow, the light has changed."""
DARK_LEVELS: Final = 16
"""On a background darker than this, shadows have no colour to be known by."""
CHROMA_SCALE: Final = 64
LEARNING_SEED: Final = 1
LEARNING_IMAGES: Final = 30
LEARNING_RATE_LEAST: Final = 1e-9
"""In place of 0, which OpenCV's KNN takes for "at once": a person at rest fades in 0.5 s then."""
NEIGHBOURS: Final = np.ones((3, 3), np.uint8)


def smoothed(image: Image) -> Image:
    """Return an image after the box filter that comes before every comparison."""
    import cv2

    return np.asarray(cv2.blur(image, (BOX_PX, BOX_PX)), np.uint8)


class BackgroundStatistics:
    """Mean and spread of images of the empty cell, image by image."""

    def __init__(self) -> None:
        self.frames = 0
        self._sum = np.empty(0)
        self._squares = np.empty(0)
        self._count: npt.NDArray[np.float64] = np.empty((0, 0))

    def fits(self, image: Image) -> bool:
        """Return whether an image is of the size of those until now."""
        return not self.frames or image.shape == self._sum.shape

    def add(self, image: Image, hidden: Mask | None = None) -> None:
        """Take one more image.

        Args:
            image: (H, W, 3) uint8.
            hidden: (H, W), not 0 where something stands before the background; None: nowhere.

        Raises:
            ValueError: Not a colour image, or of another size than the first.
        """
        import cv2

        if self.frames:
            check_image(image, self._sum.shape)
        else:
            check_image(image, (*image.shape[:2], 3))
        values = smoothed(image).astype(np.float64)
        if hidden is not None:  # smoothing carries it one pixel further
            hidden = np.asarray(cv2.dilate(hidden, NEIGHBOURS), np.uint8)
            values[hidden > 0] = 0.0
        free = np.ones(values.shape[:2])
        if hidden is not None:
            free[hidden > 0] = 0.0
        if self.frames:
            self._sum += values
            self._squares += values**2
            self._count += free
        else:
            self._sum, self._squares, self._count = values, values**2, free
        self.frames += 1

    @property
    def unknown(self) -> Mask:
        """(H, W) uint8, 255 where less than half of the images show the background, else 0."""
        return np.where(2.0 * self._count < self.frames, 255, 0).astype(np.uint8)

    @property
    def _counted(self) -> npt.NDArray[np.float64]:
        return np.maximum(self._count, 1.0)[..., None]

    @property
    def mean(self) -> Image:
        """(H, W, 3) uint8, levels."""
        return np.rint(self._sum / self._counted).astype(np.uint8)

    @property
    def spread(self) -> Image:
        """(H, W, 3) uint8, standard deviation, levels, rounded up."""
        variance = self._squares / self._counted - (self._sum / self._counted) ** 2
        return np.ceil(np.sqrt(np.maximum(variance, 0.0))).clip(0, 255).astype(np.uint8)


class Subtraction:
    """Finds the foreground of images of one camera.

    Args:
        mean: (H, W, 3) uint8, the empty cell after `smoothed`.
        spread: (H, W, 3) uint8, its standard deviation, levels.
        subtractor: One of `SUBTRACTORS`.
        shadows: Shadows count as background.

    Raises:
        ValueError: An unknown subtractor, or arrays that are no background.
    """

    def __init__(
        self, mean: Image, spread: Image, *, subtractor: str = "gaussian", shadows: bool = True
    ) -> None:
        if subtractor not in SUBTRACTORS:
            raise ValueError(
                f"subtractor: asked for one of {', '.join(SUBTRACTORS)}, found {subtractor!r}"
            )
        check_image(mean, (*mean.shape[:2], 3), name="mean of the background")
        check_image(spread, mean.shape, name="spread of the background")
        self._shape = mean.shape
        self._differs = (
            _beyond(mean, _limits(spread))
            if subtractor == "gaussian"
            else _learned(subtractor, mean, spread)
        )
        self._shaded = _shadow_test(mean) if shadows else None
        self._clearly = _beyond(mean, EDGE_FACTOR * _limits(spread))

    def __call__(self, image: Image) -> Mask:
        """Return the foreground of an image, as `split` does."""
        return self.split(image)[0]

    def split(self, image: Image) -> tuple[Mask, Mask]:
        """Return the foreground of an image, and what looks like a shadow in it.

        Args:
            image: (H, W, 3) uint8, as captured.

        Returns:
            (H, W) uint8 each, 255 where foreground, and where shadow; no pixel is both.

        Raises:
            ValueError: An image of another size than the background.
        """
        import cv2

        check_image(image, self._shape)
        smooth = smoothed(image)
        mask = self._differs(smooth)
        shade = np.zeros_like(mask)
        if self._shaded is not None:
            shaded = np.asarray(cv2.bitwise_and(self._shaded(smooth), mask), np.uint8)
            if 0 < cv2.countNonZero(shaded) <= SHADOW_SHARE_MAX * shaded.size:
                mask = np.asarray(cv2.bitwise_xor(mask, shaded), np.uint8)
                shade = _majority(shaded)
        closed = cv2.morphologyEx(_majority(mask), cv2.MORPH_CLOSE, NEIGHBOURS)
        clear = cv2.bitwise_and(closed, self._clearly(image))
        found = np.asarray(cv2.bitwise_or(cv2.erode(closed, NEIGHBOURS), clear), np.uint8)
        return found, np.asarray(cv2.subtract(shade, found), np.uint8)


def check_image(image: object, shape: tuple[int, ...], *, name: str = "image") -> None:
    """Raise `ValueError` unless this is an image of a shape (height, width, 3)."""
    if not isinstance(image, np.ndarray) or image.shape != shape or image.dtype != np.uint8:
        asked = f"{shape[1]} x {shape[0]} pixels with 3 channels of uint8"
        found = (
            f"{image.dtype} of shape {image.shape}"
            if isinstance(image, np.ndarray)
            else type(image).__name__
        )
        raise ValueError(f"{name}: asked for {asked}, found {found}")


def packed(mask: Mask) -> Mask:
    """Return a mask (H, W) as bits along the rows, (H, W / 8 rounded up) uint8."""
    return np.packbits(mask, axis=1)


def unpacked(bits: Mask, width: int) -> Mask:
    """Return the mask of `packed`, (H, width) uint8, 0 or 255."""
    return np.negative(np.unpackbits(bits, axis=1, count=width))


def _majority(mask: Mask) -> Mask:
    """Return what at least five of nine pixels say: of two levels, that is their median."""
    import cv2

    _, of_most = cv2.threshold(cv2.blur(mask, (3, 3)), 127, 255, cv2.THRESH_BINARY)
    return np.asarray(of_most, np.uint8)


def _worst(difference: Image) -> Mask:
    """Return the largest of three channels, (H, W)."""
    import cv2

    blue, green, red = cv2.split(difference)
    return np.asarray(cv2.max(cv2.max(blue, green), red), np.uint8)


def _limits(spread: Image) -> npt.NDArray[np.uint16]:
    """Return by how many levels a smoothed channel may differ from its mean."""
    return np.maximum(SPREADS * spread.astype(np.uint16), LEVELS_MIN).astype(np.uint16)


def _beyond(mean: Image, limits: npt.NDArray[np.uint16]) -> Callable[[Image], Mask]:
    """Return the test of each channel against its own mean and limit."""
    import cv2

    limits_u8 = limits.clip(0, 255).astype(np.uint8)

    def differs(image: Image) -> Mask:
        beyond = cv2.subtract(cv2.absdiff(image, mean), limits_u8)
        _, mask = cv2.threshold(_worst(np.asarray(beyond)), 0, 255, cv2.THRESH_BINARY)
        return np.asarray(mask, np.uint8)

    return differs


def _learned(subtractor: str, mean: Image, spread: Image) -> Callable[[Image], Mask]:
    """Return a model of OpenCV that has learned images with this mean and spread."""
    import cv2

    history = LEARNING_IMAGES
    model: cv2.BackgroundSubtractorMOG2 | cv2.BackgroundSubtractorKNN
    if subtractor == "mog2":
        mixture = cv2.createBackgroundSubtractorMOG2(history, float(SPREADS**2), False)
        mixture.setVarMin(1.0)
        model = mixture
    else:
        model = cv2.createBackgroundSubtractorKNN(history, 3.0 * LEVELS_MIN**2, False)
    random = np.random.default_rng(LEARNING_SEED)
    for _ in range(LEARNING_IMAGES):
        noise = random.standard_normal(mean.shape, np.float32) * spread
        model.apply(np.rint(mean + noise).clip(0, 255).astype(np.uint8), learningRate=-1)

    def differs(image: Image) -> Mask:
        return np.asarray(model.apply(image, learningRate=LEARNING_RATE_LEAST), np.uint8)

    return differs


def _shadow_test(mean: Image) -> Callable[[Image], Mask]:
    """Return the test whether a pixel is a darker shade of its background.

    The colour of the background as a share of its grey, times the grey of the pixel, is what a
    shadow of that depth would look like.
    """
    import cv2

    grey = np.asarray(cv2.cvtColor(mean, cv2.COLOR_BGR2GRAY), np.float64)
    chroma = np.rint(mean / np.maximum(grey, 1.0)[..., None] * CHROMA_SCALE)
    chroma_u8 = chroma.clip(0, 255).astype(np.uint8)
    coloured = grey >= DARK_LEVELS
    darkest = np.where(coloured, np.ceil(grey * SHADOW_DARKEST), 255).astype(np.uint8)
    lightest = np.where(coloured, np.floor(grey * SHADOW_LIGHTEST), 0).astype(np.uint8)

    def shaded(image: Image) -> Mask:
        light = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        darker = cv2.inRange(light, darkest, lightest)
        expected = cv2.multiply(
            cv2.cvtColor(light, cv2.COLOR_GRAY2BGR), chroma_u8, scale=1.0 / CHROMA_SCALE
        )
        residual = _worst(np.asarray(cv2.absdiff(image, expected)))
        _, alike = cv2.threshold(residual, SHADOW_COLOUR_LEVELS, 255, cv2.THRESH_BINARY_INV)
        return np.asarray(cv2.bitwise_and(darker, alike), np.uint8)

    return shaded
