"""Background subtraction (ENACT 4.1): what a camera sees that is not the empty cell.

Two actors per camera, in one process with it: one learns the empty cell once the operator has
confirmed that it is empty, the other turns each image into a silhouette.  `SmartCamera` does both
in the update of the camera.
"""

from __future__ import annotations

import logging
import zlib
from typing import TYPE_CHECKING, Final

import numpy as np

from actors.geometry.arms.kinematics import capsules_at
from actors.geometry.capsules import fill, outlines
from actors.geometry.hull.silhouettes import BackgroundStatistics, Subtraction, packed, unpacked
from actors.workcell.vocabulary import (
    BACKGROUND,
    CALIBRATION,
    CAMERAS,
    EMPTY,
    IMAGE,
    JOINTS,
    MODEL,
    ROBOT,
    SILHOUETTE,
    WORKSPACE,
    Background,
    Silhouette,
)
from enact_dist import Actor, View, World, Write

if TYPE_CHECKING:
    from collections.abc import Callable

    import numpy.typing as npt

    from actors.workcell.vocabulary import ArmModel, Calibration, Joints
    from enact_dist import Lock

log = logging.getLogger("enact.actor")

IMAGES: Final = 20
"""How many images make a background, unless an actor says otherwise."""
NO_SHADE: Final = np.empty((0, 0), np.uint8)
ARM_GROWN_M: Final = 0.06
"""By how much the outline of the arm is grown: its shadow, and blurred edges."""
RESTING_RAD_S: Final = 1e-3
"""An arm whose joints were slower for 0.3 s is at rest."""
RESTED_NS: Final = 100_000_000
"""So long after its last sample an arm at rest has not moved far."""
CHECKED_ROWS: Final = 8
"""Every eighth row goes into the checksum: noise changes each of them."""


class Learning:
    """Learns the empty cell of images with a stamp after the operator's word.

    A new word begins anew.  A background that was not written, since its commit failed, comes again
    with the next image.

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
        if not wanted and self._statistics.frames:
            self._statistics = BackgroundStatistics()
        return wanted and captured_ns > self._newest_ns + self._apart_ns

    def learned(
        self,
        image: npt.NDArray[np.uint8],
        empty_ns: int,
        captured_ns: int,
        hidden: npt.NDArray[np.uint8] | None = None,
        before: Background | None = None,
    ) -> Background | None:
        """Take an image that is wanted; return the background if it is learned.

        Args:
            image: (H, W, 3) uint8.
            empty_ns: When the operator said that the cell is empty.
            captured_ns: Stamp of the image.
            hidden: (H, W), not 0 where the arm stands before the background; None: nowhere.
            before: The last background: what the arm hides now keeps what was learned there.
        """
        if self._since_ns != empty_ns or not self._statistics.fits(image):
            self._since_ns, self._statistics = empty_ns, BackgroundStatistics()
        self._statistics.add(image, hidden)
        self._newest_ns = captured_ns
        learned = self._statistics
        if learned.frames < self._images:
            return None
        found = Background(learned.mean, learned.spread, learned.frames, captured_ns)
        return _completed(found, learned.unknown, before)


def _completed(
    found: Background, unknown: npt.NDArray[np.uint8], before: Background | None
) -> Background:
    """Return a background that has what was learned before where the arm hides it now."""
    if not unknown.any():
        return found
    mean, spread = found.mean.copy(), found.spread.copy()
    if before is not None and before.mean.shape == mean.shape:
        kept = unknown > 0
        if before.hidden.size:
            kept &= unpacked(before.hidden, mean.shape[1]) == 0
        mean[kept], spread[kept] = before.mean[kept], before.spread[kept]
        unknown = np.where(kept, 0, unknown).astype(np.uint8)
    count = int(np.count_nonzero(unknown))
    hidden = packed(unknown) if count else NO_SHADE
    return Background(mean, spread, found.frames, found.captured_ns, hidden, count)


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
        self._hidden: npt.NDArray[np.bool_] | None = None

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
            width = found.mean.shape[1]
            self._hidden = unpacked(found.hidden, width) > 0 if found.hidden_px else None
        mask, shade = self._subtraction.split(image)
        if self._hidden is not None:
            mask[self._hidden], shade[self._hidden] = 255, 0
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

    With `arm_in_view`, images count while the arm rests, and pixels on its outline, grown by
    6 cm, are left out.  They keep what was learned before, at another pose of the arm; those that
    were never free of it are no background: the camera says *free* of nothing there.

    Args:
        images: How many images make a background.
        arm_in_view: The images show the arm.  Those of a simulated empty cell do not.
    """

    online = World("online")
    image = View(online, CAMERAS, IMAGE)
    empty = View(online, WORKSPACE, EMPTY)
    calibration = View(online, CAMERAS, CALIBRATION)
    model = View(online, ROBOT, MODEL)
    joints = View(online, ROBOT, JOINTS)
    background = Write(online, CAMERAS, BACKGROUND)
    every_s = 0.2
    in_phase = False

    def __init__(self, images: int = IMAGES, *, arm_in_view: bool = False) -> None:
        self.images, self.arm_in_view = images, arm_in_view
        self._learning = Learning(images)
        self._waited_for_ns = 0

    def start(self) -> None:
        """Let OpenCV work in the actor's own thread."""
        one_thread()

    def update(self, lock: Lock) -> None:
        """Take one image, if a background is to be learned; write it with the last one."""
        empty_ns, captured_ns = lock.get(self.empty, 0), lock.stamp_ns(self.image)
        learned_ns, camera = lock.stamp_ns(self.background), lock.entity.name
        if lock.is_null(self.image) or not self._learning.wants(empty_ns, learned_ns, captured_ns):
            return
        image, hidden = lock[self.image], None
        if self.arm_in_view:
            known = lock.get(self.calibration), lock.get(self.model), lock.get(self.joints)
            hidden = arm_at_rest(*known, captured_ns, image.shape[:2])
            if hidden is None:
                if self._waited_for_ns != empty_ns:
                    log.warning("%s is learned once the arm rests and its joints are known", camera)
                self._waited_for_ns = empty_ns
                return
        before = lock.get(self.background)
        found = self._learning.learned(image, empty_ns, captured_ns, hidden, before)
        if found is not None:
            lock.put(self.background, found, stamp_ns=captured_ns)
            warn_of_hidden(camera, found)


def warn_of_hidden(camera: str, found: Background) -> None:
    """Log what the arm has hidden in all images of a background."""
    if found.hidden_px:
        log.warning(
            "%s: %d pixels (%.1f %%) were never free of the arm and count as occupied; move"
            " the arm away from there, and declare the cell empty again",
            camera,
            found.hidden_px,
            100.0 * found.hidden_px / found.mean[..., 0].size,
        )


def arm_at_rest(
    camera: Calibration | None,
    model: ArmModel | None,
    joints: Joints | None,
    captured_ns: int,
    shape: tuple[int, int],
) -> npt.NDArray[np.uint8] | None:
    """Return where the arm is in an image, (H, W), grown; None if it moves or is not known.

    Args:
        camera: That took the image.
        model: The arm.
        joints: Its newest samples.
        captured_ns: Exposure of the image, nanoseconds since 1970.
        shape: Height and width of the image, pixels.
    """
    if camera is None or model is None or joints is None:
        return None
    first_ns, last_ns = int(joints.stamp_ns[0]), int(joints.stamp_ns[-1])
    is_known = first_ns <= captured_ns <= last_ns + RESTED_NS
    if not is_known or np.abs(joints.dq).max() > RESTING_RAD_S:
        return None
    arm = capsules_at(model, joints.q[-1])[0].copy()
    arm[:, 6] += ARM_GROWN_M
    seen_by = [(camera.camera_matrix, camera.distortion, camera.camera_from_cell)]
    return np.asarray(fill(outlines(arm, seen_by), *shape)[0])


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
