"""Images as a browser shows them: small, red green blue, with masks over them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from enact_dist.recording.drawing.drawables import ShownImage

SIDES_PX: Final = (160, 320, 640)
"""Longest sides of images in the scene: the first that is no smaller than what a page shows."""
SIDE_PX_MAX: Final = 320
"""Longest side of an image of which it is not known how large a page shows it."""
HALF_MASK_COLOUR: Final = np.array((127, 25, 15), np.uint8)
"""What is added to half of the colour of a covered pixel."""


def rgb_of(shown: ShownImage, side_px_max: int = SIDE_PX_MAX) -> NDArray[np.uint8]:
    """Return an image as (H, W, 3) uint8, red green blue.

    Args:
        shown: The image; numbers that are no bytes go from black (smallest) to white (largest).
        side_px_max: Longest side; every n-th pixel of a larger image is taken.
    """
    pixels = _at_most(shown, side_px_max)
    if pixels.ndim == 3:
        red, blue = (2, 0) if shown.encoding.startswith("bgr") else (0, 2)
        found = np.empty((*pixels.shape[:2], 3), np.uint8)
        for place, channel in enumerate((red, 1, blue)):  # faster than pixel by pixel
            found[:, :, place] = pixels[:, :, channel]
        return found
    if pixels.dtype != np.uint8:
        pixels = _as_bytes(pixels)
    return np.repeat(pixels[:, :, None], 3, axis=2)


def _at_most(shown: ShownImage, side_px_max: int) -> NDArray[Any]:
    return shown.every_nth(_step(shown, side_px_max))


def _step(shown: ShownImage, side_px_max: int) -> int:
    return max(1, -(-max(shown.shape[:2]) // side_px_max))


def _as_bytes(pixels: NDArray[Any]) -> NDArray[np.uint8]:
    """Return numbers as bytes; what is not finite, and 0 (no measurement), is black."""
    values = np.asarray(pixels, np.float32)
    there = np.isfinite(values) & (values != 0.0)
    found = np.zeros(values.shape, np.uint8)
    if there.any():
        low, high = float(values[there].min()), float(values[there].max())
        span = high - low or 1.0
        found[there] = (30.0 + 225.0 * (values[there] - low) / span).astype(np.uint8)
    return found


def with_mask(image: NDArray[np.uint8], mask: ShownImage) -> NDArray[np.uint8]:
    """Return an image with what a mask covers in red; a mask of another shape is left out."""
    step = _step(mask, max(image.shape[:2]))
    if tuple(-(-side // step) for side in mask.shape[:2]) != image.shape[:2]:
        return image
    found = image.copy()
    top, left, covers = mask.covered(step)  # a small part: what lies around it is not touched
    covered = np.repeat(covers, 3, axis=1)
    rows = found.reshape(len(found), -1)[top : top + len(covered)]
    boxed = rows[:, 3 * left : 3 * left + covered.shape[1]]
    boxed >>= covered
    boxed += covered * np.tile(HALF_MASK_COLOUR, covers.shape[1])
    return found
