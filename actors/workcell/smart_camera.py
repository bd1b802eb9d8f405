"""The `SmartCamera` actor: image, background and silhouette of a camera in one update.

It does what `Camera`, `BackgroundLearning` and `BackgroundSubtraction` do, under one lock in place
of five in two periods.  Where the processors of eight cameras are few, that is what a set of masks
waits for.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from actors.workcell.background import IMAGES, Learning, Segmenting, one_thread
from actors.workcell.camera import Camera
from actors.workcell.vocabulary import BACKGROUND, CAMERAS, EMPTY, SILHOUETTE, WORKSPACE
from enact_dist import View, Write

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from enact_dist import Lock


LEARNED_APART_NS: Final = 150_000_000
"""Least time between two images that are learned: learning takes longer than a silhouette does."""


class SmartCamera(Camera):
    """Publishes what one camera sees, and what of it is not the empty cell.

    Image and silhouette of a tick are committed together.  Without a background there is no
    silhouette; it is learned once the operator has confirmed that the cell is empty.

    Args:
        source: Address of its images, see `sources`.
        subtractor: "gaussian", "mog2" or "knn".
        shadows: What looks like a shadow is no foreground.
        images: How many images make a background.
    """

    empty = View(Camera.online, WORKSPACE, EMPTY)
    background = Write(Camera.online, CAMERAS, BACKGROUND)
    silhouette = Write(Camera.online, CAMERAS, SILHOUETTE)
    shared = (silhouette,)

    def __init__(
        self,
        source: str = "v4l2:/dev/video{camera}",
        subtractor: str = "gaussian",
        *,
        shadows: bool = True,
        images: int = IMAGES,
    ) -> None:
        super().__init__(source)
        self._segmenting = Segmenting(subtractor, shadows=shadows)
        self._learning = Learning(images, LEARNED_APART_NS)

    def start(self) -> None:
        """Look at the address, and let OpenCV work in the actor's own thread."""
        super().start()
        one_thread()

    def taken(self, lock: Lock, image: npt.NDArray[np.uint8], exposed_ns: int) -> None:
        """Write the silhouette of an image with its stamp; learn from it what is empty."""
        empty_ns, learned_ns = lock.get(self.empty, 0), lock.stamp_ns(self.background)
        if not lock.is_null(self.background):
            which = self.only_entity_name(), learned_ns
            found = self._segmenting.silhouette(image, which, lambda: lock[self.background])
            lock.put(self.silhouette, found, stamp_ns=exposed_ns)
        if self._learning.wants(empty_ns, learned_ns, exposed_ns):
            learned = self._learning.learned(image, empty_ns, exposed_ns)
            if learned is not None:
                lock.put(self.background, learned, stamp_ns=exposed_ns)
