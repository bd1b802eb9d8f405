"""The `Camera` actor: an image of one camera per tick.

A thread of its own captures, as in the paper: a driver that hangs holds up neither the actor's
lock nor its shutdown, and what can be made ready before a tick is ready by then.
"""

from __future__ import annotations

import logging
import queue
import threading
import time
from concurrent.futures import Future
from typing import TYPE_CHECKING, Any, Final, TypeVar

from actors.workcell.cameras.sources import (
    FRAME_S,
    CameraEndedError,
    CameraError,
    source_of,
)
from actors.workcell.vocabulary import CALIBRATION, CAMERAS, IMAGE, PERIOD_NS, PERIOD_S
from enact_dist import Actor, Lock, View, World, Write

if TYPE_CHECKING:
    from collections.abc import Callable

    import numpy as np
    import numpy.typing as npt

    from actors.workcell.cameras.sources import CameraSource
    from actors.workcell.vocabulary import Calibration

    Image = npt.NDArray[np.uint8]

T = TypeVar("T")

log = logging.getLogger("enact.actor")

OPEN_S: Final = 60.0
"""How long a source may take to open; a simulated one draws its room and compiles its loops."""
WAITS: Final = (
    "%s waits for its calibration: the context has none yet; the actor Setup writes it, or"
    " `lock.put` from a program of your own"
)
"""Said once: cameras start before what calibrates them."""
PREPARE_AFTER_NS: Final = 78_000_000
"""So long after a tick its images have become a hull, and the next ones are prepared."""


class Capture:
    """A thread that takes the images of a source.

    Args:
        source: Used by this thread only.
        name: Name of the camera, for messages.
    """

    def __init__(self, source: CameraSource, name: str) -> None:
        self._source, self._name = source, name
        self._asked: queue.SimpleQueue[tuple[Future[Any], Callable[[], Any]] | None] = (
            queue.SimpleQueue()
        )
        self._hangs: Future[Any] | None = None
        self._opened: Calibration | None = None
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"capture-{name}", daemon=True)
        self._thread.start()

    def image(self, calibration: Calibration, stamp_ns: int) -> tuple[Image, int]:
        """Return the image of a tick, see `frame`, of a source that is open for a calibration.

        It is opened anew for another calibration, and after an error.

        Raises:
            CameraError: It cannot be opened, or no image came, or one of them not in time.
        """
        if self._opened is None or not _same(self._opened, calibration):
            self.open(calibration)
            self._opened = calibration
        try:
            return self.frame(stamp_ns)
        except CameraError as error:
            if not isinstance(error, CameraEndedError):
                self._opened = None
            raise

    def open(self, calibration: Calibration) -> None:
        """Open the source for a calibration.

        Raises:
            CameraError: It cannot be opened, or not in time.
        """
        self._result(self._ask(lambda: self._source.open(calibration)), OPEN_S)

    def frame(self, stamp_ns: int, wait_s: float | None = None) -> tuple[Image, int]:
        """Return the image of a tick, and when it was exposed, ns since 1970.

        Args:
            stamp_ns: The tick.
            wait_s: How long to wait; None: as long as the source may take.

        Raises:
            CameraError: No image came, or none in time.
        """

        def take() -> tuple[Image, int]:
            image = self._source.frame(stamp_ns)
            return image, self._source.exposed_ns or stamp_ns

        if wait_s is None:
            wait_s = getattr(self._source, "frame_s", FRAME_S)
        return self._result(self._ask(take), wait_s)

    def prepare(self, stamp_ns: int) -> None:
        """Let a source that can get ready for a tick to come do so; its `frame` waits for it.

        It begins when the stages that work on this tick's images are about to be done: on few
        processors it would hold them up.
        """
        prepare: Callable[[int], None] | None = getattr(self._source, "prepare", None)
        if prepare is None:
            return

        def later() -> None:
            begin_ns = stamp_ns - PERIOD_NS + PREPARE_AFTER_NS
            self._closing.wait(min(max(0.0, (begin_ns - time.time_ns()) / 1e9), PERIOD_S))
            prepare(stamp_ns)

        self._ask(later)

    def close(self) -> None:
        """Close the source and end the thread; a driver that hangs is left to itself."""
        self._closing.set()
        self._ask(self._source.close)
        self._asked.put(None)
        self._thread.join(timeout=1.0)

    def _ask(self, call: Callable[[], T]) -> Future[T]:
        future: Future[T] = Future()
        self._asked.put((future, call))
        return future

    def _result(self, future: Future[T], wait_s: float) -> T:
        if self._hangs is not None and not self._hangs.done():
            future.cancel()
            raise CameraError(f"{self._name}: its source still hangs; no image was taken")
        self._hangs = None
        try:
            return future.result(wait_s)
        except TimeoutError:
            self._hangs = future
            raise CameraError(
                f"{self._name}: asked its source for an image; found no answer within {wait_s:g} s;"
                " the device or its driver hangs"
            ) from None

    def _run(self) -> None:
        while (asked := self._asked.get()) is not None:
            future, call = asked
            if not future.set_running_or_notify_cancel():
                continue
            try:
                future.set_result(call())
            except BaseException as error:  # noqa: BLE001 - it goes to who asked
                future.set_exception(error)


class Camera(Actor):
    """Publishes what one camera sees, ten times per second, all cameras at the same ticks.

    Without a calibration it waits, and says so once.
    A camera that fails writes nothing: its error is reported, the tick stays without its image,
    and at the next tick its source is opened again.

    Attributes:
        source: Address of its images, see `sources`.
    """

    online = World("online")
    calibration = View(online, CAMERAS, CALIBRATION)
    image = Write(online, CAMERAS, IMAGE)
    every_s = PERIOD_S

    def __init__(self, source: str = "v4l2:/dev/video{camera}") -> None:
        self.source = source
        self._capture: Capture | None = None
        self._waits = False

    def start(self) -> None:
        """Look at the address, before anything is locked.

        Raises:
            CameraError: It is no address of a source.
        """
        self._capture = Capture(self.make_source(), self.only_entity_name())

    def only_entity_name(self) -> str:
        """Return the name of the camera's entity, `camera/3`."""
        assert self.only_entity is not None, "an actor of one camera: set only_entity"
        return self.only_entity.name

    def make_source(self) -> CameraSource:
        """Return the source at the actor's address."""
        return source_of(self.source, self.only_entity_name().partition("/")[2])

    def look(self, lock: Lock) -> None:
        """See what the source needs beside the tick; a real one needs nothing."""

    def update(self, lock: Lock) -> None:
        """Publish the image of the tick.

        Raises:
            CameraError: No image is available.
        """
        assert self._capture is not None
        calibration = lock.get(self.calibration)
        if calibration is None:
            if not self._waits:
                log.info(WAITS, self.only_entity_name())
            self._waits = True
            return
        self._waits = False
        self.look(lock)
        image, exposed_ns = self._capture.image(calibration, lock.tick_ns)
        lock.put(self.image, image, stamp_ns=exposed_ns)
        self.taken(lock, image, exposed_ns)
        self._capture.prepare(lock.tick_ns + PERIOD_NS)

    def taken(self, lock: Lock, image: Image, exposed_ns: int) -> None:
        """Do with an image what belongs to its update; a camera that only publishes does nothing.

        Args:
            lock: Of the update.
            image: (H, W, 3) uint8, BGR; it has been put.
            exposed_ns: Its stamp.
        """

    def stop(self) -> None:
        """Close the source."""
        if self._capture is not None:
            self._capture.close()


def _same(one: Calibration, other: Calibration) -> bool:
    """Say whether two calibrations are equal."""
    return one is other or (
        (one.width, one.height) == (other.width, other.height)
        and bool((one.camera_matrix == other.camera_matrix).all())
        and bool((one.distortion == other.distortion).all())
        and bool((one.camera_from_cell == other.camera_from_cell).all())
    )
