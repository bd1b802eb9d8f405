"""Where a camera's images come from: a device, a folder, or a source registered by a simulator.

An address says which: ``KIND:PLACE?name=value&name=value``.

======================================  ========================================================
address                                 images
======================================  ========================================================
`v4l2:/dev/video0?size=640x480&fps=30`  of a camera that `cv2.VideoCapture` opens, or of a video
                                        file, one image per tick; see `video`
`folder:/data/images/{camera}`          files, in the order of their names, one per tick;
                                        `?begin=STAMP_NS` plays them once from that tick on, else
                                        they repeat, all cameras in step
`live`, `playback:…`,                   of the simulated cell, see `simulation.sources`
`playback+robot:…`
======================================  ========================================================

``{camera}`` is replaced by what follows ``camera/`` in the name of the entity.

Rules a change must keep: what cannot work is one `CameraError`, found by `open` where it can be;
a source never gives an old image for a new one.
"""

from __future__ import annotations

import importlib
import re
from pathlib import Path
from typing import TYPE_CHECKING, Final, Protocol, cast
from urllib.parse import parse_qsl

import numpy as np

from actors.workcell.vocabulary import PERIOD_NS

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    import numpy.typing as npt

    from actors.workcell.vocabulary import Calibration

    Image = npt.NDArray[np.uint8]

ENDINGS: Final = (".png", ".jpg", ".jpeg", ".ppm", ".pgm")
"""Files of a folder that are images."""
FRAME_S: Final = 1.0
"""A source that gives no image for so long hangs, unless it says by `frame_s` that it may."""
_VIDEO: Final = "actors.workcell.cameras.video"
_SIMULATED: Final = "actors.workcell.simulation.sources"


class CameraError(RuntimeError):
    """A camera gives no image; the message is one line: what, asked for, found, what to do."""


class CameraEndedError(CameraError):
    """What a source plays has ended."""


class CameraSource(Protocol):
    """What the `Camera` actor needs of a camera.

    Its methods are called by one thread at a time.
    """

    def open(self, calibration: Calibration) -> None:
        """Get ready to give images that fit a calibration; also called for a new one.

        Raises:
            CameraError: It cannot.
        """
        ...

    def frame(self, stamp_ns: int) -> Image:
        """Return the image of a tick, (H, W, 3) uint8, BGR; may wait for the exposure.

        Raises:
            CameraError: No image is available.
        """
        ...

    @property
    def exposed_ns(self) -> int:
        """When the last image was exposed, ns since 1970; 0: at its tick."""
        ...

    def close(self) -> None:
        """Give back the device."""
        ...


def source_of(address: str, camera: str) -> CameraSource:
    """Return the source at an address.

    Args:
        address: See the table of this module.
        camera: Name of the camera: what follows ``camera/`` in that of its entity.

    Raises:
        CameraError: The kind of source is unknown, or its options are wrong.
    """
    kind, _, rest = address.partition(":")
    place, _, query = rest.partition("?")
    try:
        options = dict(parse_qsl(query, strict_parsing=True)) if query else {}
    except ValueError as error:
        raise CameraError(
            f"{address}: asked for options as name=value&name=value; found {query!r} ({error})"
        ) from None
    place = place.replace("{camera}", camera)
    video_source = importlib.import_module(_VIDEO).VideoSource
    kinds: Mapping[str, Callable[[str, dict[str, str]], CameraSource]] = {
        "v4l2": video_source,
        "folder": FolderSource,
    }
    if kind in kinds:
        return kinds[kind](place, options)
    if kind in {"live", "playback", "playback+robot"}:
        simulated = importlib.import_module(_SIMULATED)
        source: CameraSource = simulated.simulated_source(kind, place, options, camera)
        return source
    raise CameraError(
        f"{address}: asked for a source of images; found the kind {kind!r}; write v4l2:, folder:,"
        " live, playback: or playback+robot:"
    )


def check_options(where: str, options: Mapping[str, str], *known: str) -> None:
    """Refuse options that a source does not know.

    Raises:
        CameraError: There is one.
    """
    if unknown := sorted(set(options) - set(known)):
        raise CameraError(
            f"{where}: found the option {unknown[0]!r}; known are {', '.join(known) or 'none'}"
        )


def check_size(where: str, image: object, calibration: Calibration) -> Image:
    """Return an image that fits a calibration.

    Raises:
        CameraError: It is no image, or has another size.
    """
    if not isinstance(image, np.ndarray) or image.dtype != np.uint8 or image.ndim != 3:
        raise CameraError(f"{where}: asked for an image; found none that OpenCV can decode")
    height, width = image.shape[:2]
    if (height, width) != (calibration.height, calibration.width):
        raise CameraError(
            f"{where}: asked for {calibration.width} x {calibration.height} pixels as calibrated;"
            f" found {width} x {height}; calibrate the camera at this size, or change its size"
        )
    return cast("Image", image)


class FolderSource:
    """Images of a folder, one per tick.

    Args:
        place: The folder.
        options: `begin`: stamp of the tick of the first image.
    """

    def __init__(self, place: str, options: dict[str, str]) -> None:
        check_options(f"folder:{place}", options, "begin")
        self._folder, self._files = Path(place), list[Path]()
        self._begin_ns = number_option(f"folder:{place}", options, "begin")
        self._calibration: Calibration | None = None

    @property
    def exposed_ns(self) -> int:
        """0: an image counts as exposed at its tick."""
        return 0

    def open(self, calibration: Calibration) -> None:
        """List the folder and look at its first image.

        Raises:
            CameraError: It is missing or empty, a number is missing, or the size is another.
        """
        asked = "asked for a folder of images"
        if not self._folder.is_dir():
            found = "a file" if self._folder.exists() else "no such folder"
            raise CameraError(f"{self._folder}: {asked}; found {found}; check the path")
        self._files = sorted(
            path for path in self._folder.iterdir() if path.suffix.lower() in ENDINGS
        )
        if not self._files:
            raise CameraError(
                f"{self._folder}: {asked}; found no file that ends in {', '.join(ENDINGS)}"
            )
        self._check_numbers()
        self._calibration = calibration
        self._read(self._files[0])

    def frame(self, stamp_ns: int) -> Image:
        """Return the image of a tick.

        Raises:
            CameraEndedError: All have been played.
            CameraError: A file has gone, or cannot be decoded, or is of another size.
        """
        if self._begin_ns:
            number = round((stamp_ns - self._begin_ns) / PERIOD_NS)
            if number >= len(self._files):
                raise CameraEndedError(f"{self._folder}: all {len(self._files)} images were played")
            return self._read(self._files[max(number, 0)])
        return self._read(self._files[stamp_ns // PERIOD_NS % len(self._files)])

    def close(self) -> None:
        """Nothing is open."""

    def _read(self, path: Path) -> Image:
        import cv2

        assert self._calibration is not None, "open first"
        if not path.exists():
            raise CameraError(f"{path}: asked for an image; found no such file any more")
        return check_size(str(path), cv2.imread(str(path), cv2.IMREAD_COLOR), self._calibration)

    def _check_numbers(self) -> None:
        """Refuse a folder of numbered images in which one is missing."""
        numbers = [int(found[-1]) if (found := re.findall(r"\d+", path.stem)) else -1
                   for path in self._files]  # fmt: skip
        if -1 in numbers or len(set(numbers)) < len(numbers):
            return
        step = min(np.diff(sorted(numbers)), default=1)
        for path, before, number in zip(self._files[1:], numbers, numbers[1:], strict=False):
            if number - before not in {step, 0} and number > before:
                raise CameraError(
                    f"{self._folder}: asked for images without a gap; found {path.name} after"
                    f" number {before}; number {before + step} is missing"
                )


def number_option(where: str, options: Mapping[str, str], name: str) -> int:
    """Return a whole number of the options, 0 without one."""
    text = options.get(name, "0")
    if not text.isdecimal():
        raise CameraError(f"{where}: asked for {name}=NUMBER; found {text!r}")
    return int(text)
