"""Pictures of a folder for calibrated cameras: which file is whose, and what of it is foreground.

::

    images/<camera>/<frame>.png      masks/<camera>/<frame>.png      background/<camera>.png
    images/<camera>.png              masks/<camera>.png              background/<camera>/*.png
    <camera>.png                     (a flat list: one shot per camera)

Masks come from `masks`, non-zero is foreground (in a JPEG: half of white or more); else from the
difference to `background`; else from a key colour.  Every error is one line.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from actors.geometry.files import InputFileError
from actors.geometry.hull.silhouettes import BackgroundStatistics, Subtraction

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    import numpy.typing as npt

    from actors.geometry.cameras.camera_sets import SetCamera

    Image = npt.NDArray[np.uint8]
    Mask = npt.NDArray[np.bool_]

ENDINGS: Final = (".png", ".jpg", ".jpeg", ".ppm", ".pgm", ".bmp", ".tif", ".tiff")
COLOURS: Final = {
    "black": (0, 0, 0), "white": (255, 255, 255), "green": (0, 177, 64), "blue": (0, 71, 187),
    "red": (200, 30, 30),
}  # fmt: skip
"""Key colours by name, red green blue."""
JPEG: Final = (".jpg", ".jpeg")
JPEG_LEAST: Final = 128
"""Least value of foreground in a JPEG mask: its compression leaves grey dots beside edges."""
KEY_DISTANCE: Final = 48.0
"""A pixel that is this far from the key colour, in levels of Lab, is foreground."""
FOREGROUND_MOST: Final = 0.98
"""A mask that covers more of its picture was made of the wrong background."""


@dataclass(frozen=True, slots=True, eq=False)
class Shot:
    """What one camera saw.

    Attributes:
        camera: The camera, with the size of its picture.
        mask: (H, W), true is foreground.
        image: (H, W, 3) uint8 BGR; None where the folder has only masks.
        file: Where it comes from.
        background: Mean and spread of the empty scene, (H, W, 3) uint8 each, if the mask was made
            by them.
    """

    camera: SetCamera
    mask: Mask
    image: Image | None
    file: Path
    background: tuple[Image, Image] | None = None


@dataclass(frozen=True, slots=True)
class Shots:
    """The pictures of one moment.

    Attributes:
        shots: One per camera that has a picture.
        missing: Names of the cameras that have none.
        frame: Which moment; empty where there is but one.
        frames: How many moments the folder has.
        masks_from: "masks", "background" or "key colour".
    """

    shots: tuple[Shot, ...]
    missing: tuple[str, ...]
    frame: str
    frames: int
    masks_from: str


def colour_of(text: str) -> tuple[int, int, int]:
    """Read a colour, a name of `COLOURS`, ``#rrggbb`` or ``R,G,B``: red, green, blue.

    Raises:
        ValueError: It is invalid.
    """
    if text in COLOURS:
        return COLOURS[text]
    digits = text.removeprefix("#")
    if len(digits) == 6 and all(digit in "0123456789abcdefABCDEF" for digit in digits):
        return int(digits[:2], 16), int(digits[2:4], 16), int(digits[4:], 16)
    parts = [int(part) for part in text.split(",") if part.isdecimal() and int(part) < 256]
    if len(parts) == text.count(",") + 1 == 3:
        return parts[0], parts[1], parts[2]
    raise ValueError(f"asked for a colour, {', '.join(COLOURS)}, #rrggbb or R,G,B; found {text!r}")


def read_shots(
    folder: Path,
    cameras: Sequence[SetCamera],
    *,
    key: tuple[int, int, int] | None = None,
    frame: str = "",
) -> Shots:
    """Read the pictures of one moment.

    Args:
        folder: The folder.
        cameras: Its cameras.
        key: Red, green, blue of the backdrop, if masks are to come from it.
        frame: Which moment, by the name of its files; the first that all cameras have otherwise.

    Raises:
        InputFileError: A picture is missing, cannot be read, has another size than the calibration
            says, or has no foreground.
    """
    masks = {one.name: _files_of(folder / "masks", one.name) for one in cameras}
    images = {one.name: _files_of(folder / "images", one.name) for one in cameras}
    if not any(masks.values()) and not any(images.values()):
        images = {one.name: _files_of(folder, one.name) for one in cameras}
    chosen = masks if any(masks.values()) and key is None else images
    frames = _frames(folder, chosen, frame)
    moment = frame or (frames[0] if frames else "")
    found, missing = [], []
    source = "masks" if chosen is masks else "key colour" if key is not None else "background"
    for camera in cameras:
        file = _at(chosen[camera.name], moment)
        if file is None:
            missing.append(camera.name)
            continue
        picture = _at(images[camera.name], moment)
        found.append(_shot(folder, camera, file, (source, picture, key)))
    if len(found) < 2:
        raise InputFileError(
            folder,
            asked="pictures of two cameras or more",
            found=f"{len(found)}; none of {', '.join(missing[:4])}{' …' * (len(missing) > 4)}",
            remedy="name them images/<camera>/<frame>.png, masks/<camera>/<frame>.png or"
            " <camera>.png, after the cameras of the calibration",
        )
    return Shots(tuple(found), tuple(missing), moment, len(frames), source)


def _files_of(folder: Path, name: str) -> dict[str, Path]:
    """Return the pictures of a camera by their frame; of one without frames by an empty name."""
    below = folder / name
    if below.is_dir():
        return {
            file.stem: file for file in sorted(below.iterdir()) if file.suffix.lower() in ENDINGS
        }
    if below.is_file() and below.suffix.lower() in ENDINGS:
        return {"": below}
    for ending in ENDINGS:
        for stem in dict.fromkeys((name, name.rpartition(".")[0] or name)):
            for file in (folder / f"{stem}{ending}", folder / f"{stem}{ending.upper()}"):
                if file.is_file():
                    return {"": file}
    return {}


def _frames(folder: Path, files: dict[str, dict[str, Path]], wanted: str) -> list[str]:
    """Return the moments that all cameras with pictures have, or those of most of them."""
    counts: dict[str, int] = {}
    for of_camera in files.values():
        for name in of_camera:
            if name:
                counts[name] = counts.get(name, 0) + 1
    if wanted and wanted not in counts:
        known = ", ".join(sorted(counts)[:4]) or "none"
        raise InputFileError(
            folder, asked=f"frame {wanted}", found=f"frames {known} …", remedy="check --frame"
        )
    most = max(counts.values(), default=0)
    return sorted(name for name, count in counts.items() if count == most)


def _at(files: dict[str, Path], frame: str) -> Path | None:
    return files.get(frame, files.get(""))


def _shot(
    folder: Path,
    camera: SetCamera,
    file: Path,
    how: tuple[str, Path | None, tuple[int, int, int] | None],
) -> Shot:
    source, picture, key = how
    background = None
    if source == "masks":
        least = JPEG_LEAST if file.suffix.lower() in JPEG else 1
        mask = np.asarray(_read(file, camera, colour=False) >= least)
        image = None if picture is None else _read(picture, camera, colour=True)
    else:
        image = _read(file, camera, colour=True)
        if key is not None:
            mask = _of_key(image, key)
        else:
            background = _background(folder, camera, image)
            mask = Subtraction(*background)(image) > 0
    share = float(mask.mean())
    if not 0.0 < share < FOREGROUND_MOST:
        raise InputFileError(
            file,
            asked=f"foreground on a part of the picture of camera {camera.name}",
            found=f"{share:.0%} of it ({source})",
            remedy="give masks/, the right background/, or --key COLOUR",
        )
    sized = camera.of_size(mask.shape[1], mask.shape[0])
    return Shot(sized, mask, image, file, background)


def _read(file: Path, camera: SetCamera, *, colour: bool) -> Image:
    import cv2

    flag = cv2.IMREAD_COLOR if colour else cv2.IMREAD_UNCHANGED
    data = np.fromfile(file, np.uint8)
    found = cv2.imdecode(data, flag | cv2.IMREAD_IGNORE_ORIENTATION) if data.size else None
    if found is None:
        raise InputFileError(
            file,
            asked="a picture",
            found=f"{data.size} bytes of another kind",
            remedy="replace it",
        )
    image = np.asarray(found, np.uint8) if found.dtype == np.uint8 else _eight_bit(found)
    if not colour and image.ndim == 3:
        seen_through = image.shape[2] == 4 and image[..., 3].min() < 255
        image = image[..., 3] if seen_through else image[..., :3].max(2)
    size = (camera.width or image.shape[1], camera.height or image.shape[0])
    if (image.shape[1], image.shape[0]) != size:
        raise InputFileError(
            file,
            asked=f"{size[0]} x {size[1]} pixels, as camera {camera.name} is calibrated for",
            found=f"{image.shape[1]} x {image.shape[0]}",
            remedy="give the pictures in their original size, or calibrate for this one",
        )
    return image


def _eight_bit(image: npt.NDArray[np.generic]) -> Image:
    """Return a mask of more than eight bits as an eight-bit one with the same zeros."""
    return np.where(np.asarray(image) != 0, np.uint8(255), np.uint8(0))


def _of_key(image: Image, key: tuple[int, int, int]) -> Mask:
    """Return the largest thing that is not of the key colour, its holes filled."""
    import cv2

    lab = np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2LAB), np.float32)
    swatch = np.array([[key[::-1]]], np.uint8)
    wanted = np.asarray(cv2.cvtColor(swatch, cv2.COLOR_BGR2LAB), np.float32)[0, 0]
    differs = np.linalg.norm(lab - wanted, axis=2) > KEY_DISTANCE
    count, labels, facts, _ = cv2.connectedComponentsWithStats(differs.astype(np.uint8))
    if count < 2:
        return np.zeros(differs.shape, bool)
    largest = np.asarray(labels == 1 + int(np.argmax(facts[1:, cv2.CC_STAT_AREA])))
    outlines, _ = cv2.findContours(
        largest.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE
    )
    filled = np.zeros(largest.shape, np.uint8)
    cv2.drawContours(filled, outlines, -1, 1, cv2.FILLED)
    return filled > 0


def _background(folder: Path, camera: SetCamera, image: Image) -> tuple[Image, Image]:
    """Return mean and spread of a camera's pictures of the empty scene."""
    place = folder / "background"
    files = [*_files_of(place, camera.name).values()]
    if not files:
        raise InputFileError(
            place / f"{camera.name}.png",
            asked=f"a mask or a background of camera {camera.name}",
            found="neither",
            remedy="give masks/<camera>/<frame>.png, background/<camera>.png or --key COLOUR",
        )
    statistics = BackgroundStatistics()
    sized = camera.of_size(image.shape[1], image.shape[0])
    for file in files:
        statistics.add(_read(file, sized, colour=True))
    return statistics.mean, statistics.spread
