"""Background subtraction (ENACT 4.1): what a camera sees that is not the empty cell.

Two actors per camera, in one process with it: one learns the empty cell once the operator has
confirmed that it is empty, the other turns each image into a silhouette.
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
    import numpy.typing as npt

    from enact_dist import Lock

CHECKED_ROWS: Final = 8
"""Every eighth row goes into the checksum: noise changes each of them."""


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

    def __init__(self, images: int = 20) -> None:
        if images < 2:
            raise ValueError(f"images is {images}; a spread takes 2 or more")
        self.images = images
        self._statistics = BackgroundStatistics()
        self._since_ns = 0
        self._newest_ns = 0

    def start(self) -> None:
        """Let OpenCV work in the actor's own thread."""
        one_thread()

    def update(self, lock: Lock) -> None:
        """Take one image, if a background is to be learned; write it with the last one."""
        empty_ns, captured_ns = lock.get(self.empty, 0), lock.stamp_ns(self.image)
        if not empty_ns or lock.stamp_ns(self.background) > empty_ns or lock.is_null(self.image):
            return
        if captured_ns <= max(empty_ns, self._newest_ns):
            return
        image = lock[self.image]
        if self._since_ns != empty_ns or not self._statistics.fits(image):
            self._since_ns, self._statistics = empty_ns, BackgroundStatistics()
        self._statistics.add(image)
        self._newest_ns = captured_ns
        learned = self._statistics
        if learned.frames < self.images:
            return
        found = Background(learned.mean, learned.spread, learned.frames, captured_ns)
        lock.put(self.background, found, stamp_ns=captured_ns)
        self._statistics = BackgroundStatistics()


class BackgroundSubtraction(Actor):
    """Find the silhouette of what is not the empty cell in each image.

    Without a background no silhouette is written, and so no set is complete.

    Attributes:
        subtractor: "gaussian", "mog2" or "knn".
        shadows: Shadows count as background.
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
        self._made_of: tuple[str, int, str, bool] | None = None
        self._subtraction: Subtraction | None = None

    def start(self) -> None:
        """Let OpenCV work in the actor's own thread."""
        one_thread()

    def update(self, lock: Lock) -> None:
        """Write the silhouette with the stamp of its image."""
        if lock.is_null(self.background) or lock.is_null(self.image):
            return
        wanted = (
            lock.entity.name,
            lock.stamp_ns(self.background),
            self.subtractor,
            self.shadows,
        )
        if self._subtraction is None or wanted != self._made_of:
            background = lock[self.background]
            self._subtraction = Subtraction(
                background.mean,
                background.spread,
                subtractor=self.subtractor,
                shadows=self.shadows,
            )
            self._made_of = wanted
        image = lock[self.image]
        mask = self._subtraction(image)
        lock[self.silhouette] = Silhouette(
            packed=packed(mask),
            foreground_px=int(np.count_nonzero(mask)),
            image_checksum=checksum(image),
        )


def checksum(image: npt.NDArray[np.uint8]) -> int:
    """Return what tells an image from the next one of the same camera; never 0."""
    return zlib.crc32(np.ascontiguousarray(image[::CHECKED_ROWS]).data) or 1


def one_thread() -> None:
    """Keep OpenCV to one thread: eight cameras share the processors already."""
    import cv2

    cv2.setNumThreads(1)
