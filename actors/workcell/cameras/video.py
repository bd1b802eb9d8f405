"""Images of a camera that OpenCV opens by Video4Linux, or of a video file.

Options of an address: `size=640x480`, `fps=30`, `format=MJPG` (what the camera sends: several
cameras on one USB bus need MJPG).

Rules a change must keep: an image from before its tick is never given, whether or not the driver
stamps its images; what a driver gives is looked at, not believed; after a failure the device is
opened anew, so that a camera that was unplugged comes back.
"""

from __future__ import annotations

import os
import re
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from actors.workcell.cameras.sources import (
    CameraEndedError,
    CameraError,
    check_options,
    check_size,
    number_option,
)
from actors.workcell.vocabulary import PERIOD_NS, PERIOD_S

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from actors.workcell.vocabulary import Calibration

    Image = npt.NDArray[np.uint8]

EARLY_NS: Final = PERIOD_NS // 4
"""An image that was exposed so long before its tick still belongs to it."""
QUEUED_NS: Final = 2_000_000
"""An image that is there sooner was waiting in the driver's queue."""
QUEUE_MOST: Final = 8
"""So many images wait in a driver's queue at most; OpenCV asks for four or fewer."""
DAMAGED_MOST: Final = 3
"""So many images in a row may be damaged on their way."""
CLOCK_OFF_NS: Final = 60_000_000_000
"""A driver's time that is so far from this machine's is none."""


class VideoSource:
    """A camera that OpenCV opens, or a video file.

    The images of a device are stamped by its driver where that gives the time since the start of
    the machine; else when they arrive.  Images from before a tick are dropped, so that the driver's
    queue makes nothing late.

    Args:
        place: Device such as `/dev/video0` or, the same after it was plugged in anew,
            `/dev/v4l/by-id/…`; or a file.
        options: `size` as `640x480`, `fps`, `format` as four letters.
    """

    def __init__(self, place: str, options: dict[str, str]) -> None:
        self._place, self._where = place, f"v4l2:{place}"
        check_options(self._where, options, "size", "fps", "format")
        size = re.fullmatch(r"(\d+)x(\d+)", options.get("size", "0x0"))
        if size is None:
            raise CameraError(
                f"{self._where}: asked for size=WIDTHxHEIGHT; found {options['size']!r}"
            )
        self._size = int(size[1]), int(size[2])
        self._fps = number_option(self._where, options, "fps")
        self._format = options.get("format", "")
        if self._format and len(self._format) != 4:
            raise CameraError(
                f"{self._where}: asked for four letters as format, such as MJPG or YUYV; found"
                f" {self._format!r}"
            )
        self._is_device = not Path(place).is_file()
        self._device: Any = None  # a cv2.VideoCapture: OpenCV loads on use
        self._calibration: Calibration | None = None
        self._exposed_ns, self._driver_ms, self._count = 0, 0.0, 0

    @property
    def exposed_ns(self) -> int:
        """When the last image was exposed, as far as its driver says; 0 of a file."""
        return self._exposed_ns

    def open(self, calibration: Calibration) -> None:
        """Open the device, unless it is open in that size.

        Raises:
            CameraError: There is none, OpenCV cannot open it, or it gives other images.
        """
        import cv2

        before, self._calibration = self._calibration, calibration
        if self._device is not None:
            if before is None or not self._is_device or _size(before) == _size(calibration):
                return
            self.close()
        asked = "asked for a camera or a video file"
        if not Path(self._place).exists():
            raise CameraError(
                f"{self._where}: {asked}; found no such device or file; `v4l2-ctl --list-devices`"
                " lists cameras, /dev/v4l/by-id has names that stay"
            )
        if not os.access(self._place, os.R_OK | (os.W_OK if self._is_device else 0)):
            raise CameraError(
                f"{self._where}: {asked}; found one that this user may not read; a device belongs"
                " to the group video: usermod -aG video USER, and log in again"
            )
        self._device = cv2.VideoCapture(
            self._place, cv2.CAP_V4L2 if self._is_device else cv2.CAP_ANY
        )
        try:
            if not self._device.isOpened():
                raise CameraError(
                    f"{self._where}: {asked}; found one that OpenCV cannot open; does another"
                    " program use it (fuser -v), or does it give no images (the second node of a"
                    " camera does not)?"
                )
            if self._is_device:
                self._set(calibration)
        except CameraError:
            self.close()
            raise

    def _set(self, calibration: Calibration) -> None:
        """Ask the driver for size, rate and format, and look at what it will give.

        Raises:
            CameraError: That is something else.
        """
        import cv2

        device, wanted = self._device, self._size if self._size[0] else _size(calibration)
        if self._format:
            device.set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*self._format))
        device.set(cv2.CAP_PROP_FRAME_WIDTH, wanted[0])
        device.set(cv2.CAP_PROP_FRAME_HEIGHT, wanted[1])
        if self._fps:
            device.set(cv2.CAP_PROP_FPS, self._fps)
        device.set(cv2.CAP_PROP_BUFFERSIZE, 1)
        known = f"v4l2-ctl -d {self._place} --list-formats-ext lists what it can"
        given = (
            round(device.get(cv2.CAP_PROP_FRAME_WIDTH)),
            round(device.get(cv2.CAP_PROP_FRAME_HEIGHT)),
        )
        if given != wanted:
            raise CameraError(
                f"{self._where}: asked for {wanted[0]} x {wanted[1]} pixels; the driver gives"
                f" {given[0]} x {given[1]}; {known}"
            )
        sent = _letters(device.get(cv2.CAP_PROP_FOURCC))
        if self._format and sent and sent != self._format:
            raise CameraError(
                f"{self._where}: asked for the format {self._format}; the driver gives {sent};"
                f" {known}"
            )
        fps = float(device.get(cv2.CAP_PROP_FPS))
        if 0.0 < fps < 0.99 / PERIOD_S:
            raise CameraError(
                f"{self._where}: asked for {1.0 / PERIOD_S:.0f} images per second or more; the"
                f" driver gives {fps:g}; try format=MJPG or a smaller size; {known}"
            )

    def frame(self, stamp_ns: int) -> Image:
        """Return the first image of the device from a tick on, or the next of the file.

        Raises:
            CameraEndedError: The file is over.
            CameraError: The device gives no image, damaged ones, or one of another size.
        """
        assert self._device is not None, "open first"
        assert self._calibration is not None
        for _ in range(DAMAGED_MOST):
            if self._is_device:
                self._grab_of(stamp_ns)
            elif not self._device.grab():
                raise CameraEndedError(f"{self._where}: the video ended after {self._count} images")
            self._count += 1
            whole, image = self._device.retrieve()
            if whole and image is not None:
                return check_size(self._where, image, self._calibration)
        self.close()
        raise CameraError(
            f"{self._where}: asked for an image; found {DAMAGED_MOST} in a row that are damaged;"
            " is the cable too long, are too many cameras on one bus?"
        )

    def _grab_of(self, stamp_ns: int) -> None:
        """Grab the first image of a tick.

        Raises:
            CameraError: The device gives none; it is closed, to be opened anew.
        """
        import cv2

        queued = 0
        while True:
            begun_ns = time.monotonic_ns()
            if not self._device.grab():
                self.close()
                raise CameraError(
                    f"{self._where}: asked for an image; the device gave none; was it unplugged, or"
                    " do too many cameras share one USB bus (format=MJPG)?"
                )
            took_ns = time.monotonic_ns() - begun_ns
            driver_ms = float(self._device.get(cv2.CAP_PROP_POS_MSEC))
            exposed_ns = driver_ns(driver_ms) if driver_ms != self._driver_ms else 0
            self._driver_ms = driver_ms
            if exposed_ns:
                if exposed_ns >= stamp_ns - EARLY_NS:
                    self._exposed_ns = exposed_ns
                    return
                continue
            # Without a driver's time, what had to be waited for is new, and nothing else.
            queued += 1
            if took_ns >= QUEUED_NS or queued > QUEUE_MOST:
                self._exposed_ns = time.time_ns()
                return

    def close(self) -> None:
        """Release the device."""
        if self._device is not None:
            self._device.release()
            self._device = None


def driver_ns(driver_ms: float) -> int:
    """Return the time of a driver, which counts from the start of the machine, as ns since 1970.

    What is no such time (0, or further than `CLOCK_OFF_NS` from now) gives 0.
    """
    since_start_ns, exposed_ns = time.monotonic_ns(), round(driver_ms * 1e6)
    if exposed_ns <= 0 or abs(since_start_ns - exposed_ns) > CLOCK_OFF_NS:
        return 0
    return time.time_ns() - (since_start_ns - exposed_ns)


def _size(calibration: Calibration) -> tuple[int, int]:
    return calibration.width, calibration.height


def _letters(number: float) -> str:
    """Return the four letters of a format; nothing of a driver that does not say."""
    code = int(number)
    letters = "".join(chr(code >> shift & 255) for shift in (0, 8, 16, 24)) if code > 0 else ""
    return letters if letters.isprintable() else ""
