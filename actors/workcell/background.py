"""Background subtraction (ENACT 4.1): what a camera sees that is not the empty cell.

Two actors per camera, in one process with it: one learns the empty cell once the operator has
confirmed that it is empty, the other turns each image into a silhouette.  `SmartCamera` does both
in the update of the camera.
"""

from __future__ import annotations

import zlib
from typing import TYPE_CHECKING, Final

import numpy as np

from actors.geometry.silhouettes import BackgroundStatistics, Subtraction, packed
from actors.workcell.vocabulary import (
    BACKGROUND,
    CAMERAS,
    EMPTY,
    IMAGE,
    SILHOUETTE,
    WORKSPACE,
    Background,
    Silhouette,
)
from enact_dist import Actor, View, World, Write

if TYPE_CHECKING:
    from collections.abc import Callable

    import numpy.typing as npt

    from enact_dist import Lock

IMAGES: Final = 20
"""How many images make a background, unless an actor says otherwise."""
NO_SHADE: Final = np.empty((0, 0), np.uint8)
CHECKED_ROWS: Final = 8
"""Every eighth row goes into the checksum: noise changes each of them."""


class Learning:
    """Learns the empty cell of images with a stamp after the operator's word.

    A new word begins anew.

    Args:
        images: How many images make a background.
        apart_ns: Least time between two of them.

    Raises:
        ValueError: One image has no spread.
    """

    def __init__(self, images: int, apart_ns: int = 0) -> None:
        if images < 2:
            raise ValueError(f"images is {images}; a spread takes 2 or more")
        self._images, self._apart_ns = images, apart_ns
        self._statistics = BackgroundStatistics()
        self._since_ns = 0
        self._newest_ns = 0

    def wants(self, empty_ns: int, learned_ns: int, captured_ns: int) -> bool:
        """Return whether an image is to be learned.

        Args:
            empty_ns: When the operator said that the cell is empty; 0: never.
            learned_ns: Stamp of the newest background; 0: there is none.
            captured_ns: Stamp of the image.
        """
        wanted = 0 < empty_ns < captured_ns and learned_ns <= empty_ns
        return wanted and captured_ns > self._newest_ns + self._apart_ns

    def learned(
        self, image: npt.NDArray[np.uint8], empty_ns: int, captured_ns: int
    ) -> Background | None:
        """Take an image that is wanted; return the background with the last one."""
        if self._since_ns != empty_ns or not self._statistics.fits(image):
            self._since_ns, self._statistics = empty_ns, BackgroundStatistics()
        self._statistics.add(image)
        self._newest_ns = captured_ns
        learned = self._statistics
        if learned.frames < self._images:
            return None
        self._statistics = BackgroundStatistics()
        return Background(learned.mean, learned.spread, learned.frames, captured_ns)


class Segmenting:
    """Finds the silhouettes of the images of one camera.

    Args:
        subtractor: "gaussian", "mog2" or "knn".
        shadows: What looks like a shadow is no foreground.
    """

    def __init__(self, subtractor: str, *, shadows: bool) -> None:
        self._subtractor, self._shadows = subtractor, shadows
        self._made_of: tuple[str, int] | None = None
        self._subtraction: Subtraction | None = None

    def silhouette(
        self,
        image: npt.NDArray[np.uint8],
        which: tuple[str, int],
        background: Callable[[], Background],
    ) -> Silhouette:
        """Return the silhouette of an image.

        Args:
            image: (H, W, 3) uint8.
            which: Tells one background from another: the camera, the stamp of its background.
            background: Returns it; called where `which` is not that of the image before.
        """
        if self._subtraction is None or which != self._made_of:
            found = background()
            self._subtraction = Subtraction(
                found.mean, found.spread, subtractor=self._subtractor, shadows=self._shadows
            )
            self._made_of = which
        mask, shade = self._subtraction.split(image)
        return Silhouette(
            packed=packed(mask),
            foreground_px=int(np.count_nonzero(mask)),
            image_checksum=checksum(image),
            shade=packed(shade) if shade.any() else NO_SHADE,
        )


class BackgroundLearning(Actor):
    """Learn what a camera sees of the empty cell.

    Uses images captured after the operator declared the cell empty, five per second.
    A new declaration starts again; after a restart a newer background is kept.

    Args:
        images: How many images make a background.
    """

    online = World("online")
    image = View(online, CAMERAS, IMAGE)
    empty = View(online, WORKSPACE, EMPTY)
    background = Write(online, CAMERAS, BACKGROUND)
    every_s = 0.2
    in_phase = False

    def __init__(self, images: int = IMAGES) -> None:
        self.images = images
        self._learning = Learning(images)

    def start(self) -> None:
        """Let OpenCV work in the actor's own thread."""
        one_thread()

    def update(self, lock: Lock) -> None:
        """Take one image, if a background is to be learned; write it with the last one."""
        empty_ns, captured_ns = lock.get(self.empty, 0), lock.stamp_ns(self.image)
        if lock.is_null(self.image):
            return
        if self._learning.wants(empty_ns, lock.stamp_ns(self.background), captured_ns):
            found = self._learning.learned(lock[self.image], empty_ns, captured_ns)
            if found is not None:
                lock.put(self.background, found, stamp_ns=captured_ns)


class BackgroundSubtraction(Actor):
    """Find the silhouette of what is not the empty cell in each image.

    Without a background no silhouette is written, and so no set is complete.

    Attributes:
        subtractor: "gaussian", "mog2" or "knn".
        shadows: What looks like a shadow is no foreground.
    """

    online = World("online")
    image = View(online, CAMERAS, IMAGE)
    background = View(online, CAMERAS, BACKGROUND)
    silhouette = Write(online, CAMERAS, SILHOUETTE)
    triggers = (image,)
    shared = (silhouette,)

    subtractor: str = "gaussian"
    shadows: bool = True

    def __init__(self, subtractor: str = "gaussian", *, shadows: bool = True) -> None:
        self.subtractor, self.shadows = subtractor, shadows
        self._segmenting: Segmenting | None = None
        self._made_of: tuple[str, bool] | None = None

    def start(self) -> None:
        """Let OpenCV work in the actor's own thread."""
        one_thread()

    def update(self, lock: Lock) -> None:
        """Write the silhouette with the stamp of its image."""
        if lock.is_null(self.background):
            return
        made_of = self.subtractor, self.shadows
        if self._segmenting is None or self._made_of != made_of:
            self._segmenting = Segmenting(self.subtractor, shadows=self.shadows)
            self._made_of = made_of
        which = lock.entity.name, lock.stamp_ns(self.background)
        lock[self.silhouette] = self._segmenting.silhouette(
            lock[self.image], which, lambda: lock[self.background]
        )


def checksum(image: npt.NDArray[np.uint8]) -> int:
    """Return what tells an image from the next one of the same camera; never 0."""
    return zlib.crc32(np.ascontiguousarray(image[::CHECKED_ROWS]).data) or 1


def one_thread() -> None:
    """Keep OpenCV to one thread: eight cameras share the processors already."""
    import cv2

    cv2.setNumThreads(1)
