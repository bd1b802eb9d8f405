"""Read a recording of a real RGB-D camera: colour, depth, intrinsics, poses.

    recording/                              or, flat
      color/00000.jpg …                       c0.jpg c1.jpg …
      depth/00000.png …  16 bit, millimetres  d0.png d1.png …
      camera_primesense.json                  the same
      trajectory.log                          the same
      rgbd.match  (optional: pairs "depth/00000.png color/00000.jpg")

Everything is read and judged before anything is handed on: who gets a `Recording` need not
check again.  Three rules a change must keep: every refusal names the file; pairs come in the
order of the poses; depth stays uint16 millimetres, 0 for "no measurement", as the sensor gave it.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from actors.geometry.files import InputFileError, existing_file
from actors.geometry.scans.agreement import check_agreement
from actors.geometry.scans.calibration import read_intrinsics, read_trajectory
from actors.geometry.shapes import Acquisition, DepthFrame, RecordedFrame

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    import numpy.typing as npt

    from actors.geometry.shapes import Camera

    Image = npt.NDArray[Any]

COLOUR_FOLDERS: Final = ("color", "colour", "rgb", "image")
COLOUR_ENDINGS: Final = (".jpg", ".jpeg", ".png")
DEPTH_ENDINGS: Final = (".png", ".tif", ".tiff", ".npy", ".exr")
"""Only PNG can be right; the others are listed to be refused with a reason."""

DEPTH_MM_NEAREST: Final = 100
"""No RGB-D camera measures nearer: a median below this is metres, decimetres or inches."""

DEPTH_MM_FARTHEST: Final = 20_000
"""No RGB-D camera measures as far: a median above this is tenths of millimetres or finer."""

FRAMES_MAX: Final = 3_000
"""1.5 MB each in memory at 640 x 480: a longer recording is to be thinned, not to fill 5 GB."""


@dataclass(frozen=True, slots=True)
class Recording:
    """A checked recording.

    Attributes:
        frames: At least one, all of one camera.
        camera: Its intrinsics.
        recorded: How many frames the directory holds; more than `frames` if it was thinned.
    """

    frames: tuple[RecordedFrame, ...]
    camera: Camera
    recorded: int


def read_recording(directory: Path, *, views_max: int | None = None) -> Recording:
    """Read and check a recording.

    Args:
        directory: Laid out as the module describes.
        views_max: Frames to keep of a longer recording, evenly spread; None keeps all.

    Returns:
        The frames with their poses, in the order of the trajectory.

    Raises:
        InputFileError: Anything missing, unreadable, in wrong units or not fitting together.
    """
    if not directory.is_dir():
        raise InputFileError(
            directory,
            asked="a directory with an RGB-D recording",
            found="a file" if directory.exists() else "no such directory",
            remedy="name the directory that holds the colour and depth images",
        )
    pairs = paired_images(directory)
    poses = read_trajectory(directory / "trajectory.log")
    if len(poses) != len(pairs):
        raise InputFileError(
            directory / "trajectory.log",
            asked=f"one pose for each of the {len(pairs)} pairs of images",
            found=f"{len(poses)} poses",
            remedy="images and trajectory are of different recordings, or frames are missing",
        )
    camera = read_intrinsics(_intrinsics_file(directory))
    kept = range(len(pairs))
    if views_max is not None and views_max < len(pairs):
        kept = np.unique(np.linspace(0, len(pairs) - 1, views_max).round().astype(int)).tolist()
    if len(kept) > FRAMES_MAX:
        raise InputFileError(
            directory,
            asked=f"at most {FRAMES_MAX} frames",
            found=f"{len(kept)} frames",
            remedy="keep every second or tenth, in images and trajectory alike",
        )
    frames = tuple(
        RecordedFrame(
            depth_file.name,
            DepthFrame(read_depth(depth_file, camera), Acquisition(camera, pose)),
            read_colour(colour_file, camera),
        )
        for (colour_file, depth_file), pose in ((pairs[i], poses[i]) for i in kept)
    )
    check_agreement(directory, frames)
    return Recording(frames, camera, len(pairs))


def paired_images(directory: Path) -> list[tuple[Path, Path]]:
    """Return the (colour, depth) files that belong together, in order.

    Raises:
        InputFileError: No images, one kind without the other, or a pair in `rgbd.match` without its
            files.
    """
    colours, depths = _images(directory)
    if not depths or not colours:
        raise InputFileError(
            directory,
            asked="colour images (color/*.jpg or c0.jpg …) and depth images (depth/*.png or"
            " d0.png …)",
            found=f"{len(colours)} colour and {len(depths)} depth images",
            remedy="see the layout in the help of this command",
        )
    match = directory / "rgbd.match"
    if match.exists():
        pairs = _matched(match, colours, depths)
    elif len(colours) != len(depths):
        raise InputFileError(
            directory,
            asked="as many colour as depth images",
            found=f"{len(colours)} colour and {len(depths)} depth images",
            remedy="remove the odd ones or pair them in a file rgbd.match",
        )
    else:
        pairs = list(zip(colours, depths, strict=True))
    return pairs


def read_depth(path: Path, camera: Camera) -> Image:
    """Read one depth image, uint16 millimetres, (H, W).

    Raises:
        InputFileError: Unreadable, of another type, size or unit, or without a measurement.
    """
    asked = "a depth image: PNG, one channel, 16 bit, millimetres"
    depth = _decoded(path, asked, colour=False)
    largest = float(np.nanmax(depth)) if depth.size else 0.0
    if depth.ndim != 2 or depth.dtype != np.uint16:
        channels = 1 if depth.ndim == 2 else depth.shape[2]
        floats = depth.dtype.kind == "f"
        raise InputFileError(
            path,
            asked=asked,
            found=f"{channels} channel(s) of {depth.dtype} with values up to {largest:.4g}",
            remedy="metres as floating point: multiply by 1000 and save as 16 bit PNG"
            if floats
            else "export the raw depth, not a picture of it",
        )
    _check_size(path, depth, camera)
    measured = depth[depth > 0]
    if measured.size == 0:
        raise InputFileError(
            path, asked=asked, found="no measurement, all 0", remedy="record the frame again"
        )
    median = float(np.median(measured))
    if not DEPTH_MM_NEAREST <= median <= DEPTH_MM_FARTHEST:
        raise InputFileError(
            path,
            asked=asked,
            found=f"a median of {median:.0f}, which would be {median / 1000.0:.3g} m",
            remedy="the values are in another unit: convert them to millimetres",
        )
    return depth


def read_colour(path: Path, camera: Camera) -> Image:
    """Read one colour image as RGB, uint8, (H, W, 3).

    Raises:
        InputFileError: Unreadable or of another size.
    """
    colour = _decoded(path, "a colour image (JPEG or PNG)", colour=True)
    _check_size(path, colour, camera)
    return np.ascontiguousarray(colour[:, :, ::-1])


def _images(directory: Path) -> tuple[list[Path], list[Path]]:
    """Return all colour and all depth files, each sorted by its number."""
    folder = next((directory / f for f in COLOUR_FOLDERS if (directory / f).is_dir()), None)
    if folder is not None:
        return _sorted(folder, "*", COLOUR_ENDINGS), _sorted(
            directory / "depth", "*", DEPTH_ENDINGS
        )
    return (
        _sorted(directory, "c[0-9]*", COLOUR_ENDINGS),
        _sorted(directory, "d[0-9]*", DEPTH_ENDINGS),
    )


def _sorted(folder: Path, pattern: str, endings: Sequence[str]) -> list[Path]:
    """Return the files with one of these endings, by number and then by name."""
    if not folder.is_dir():
        return []
    files = [p for p in folder.glob(pattern) if p.suffix.lower() in endings and p.is_file()]
    return sorted(files, key=lambda path: (_number(path.stem), path.name))


def _number(stem: str) -> int:
    """Return the last number in a file name, or -1."""
    numbers = re.findall(r"\d+", stem)
    return int(numbers[-1]) if numbers else -1


def _matched(
    match: Path, colours: Sequence[Path], depths: Sequence[Path]
) -> list[tuple[Path, Path]]:
    """Return the pairs `rgbd.match` names.

    The file often travels without its folders: `depth/00003.png` is then the flat `d3.png`.
    """
    pairs = []
    existing_file(match, asked="pairs of depth and colour images")
    flat = {_number(p.stem): p for p in depths}, {_number(p.stem): p for p in colours}
    for line, text in enumerate(match.read_text(encoding="utf-8").splitlines(), 1):
        names = text.split()
        if not names:
            continue
        found: list[Path] = []
        for name, numbered in zip(names, flat, strict=False):
            listed = match.parent / name
            stand_in = numbered.get(_number(listed.stem))
            if listed.is_file():
                found.append(listed)
            elif stand_in is not None and stand_in.parent == match.parent:
                found.append(stand_in)
        if len(names) != 2 or len(found) != 2:
            raise InputFileError(
                match,
                asked="in each line a depth image and its colour image",
                found=f"line {line}, {text!r}, but {len(found)} of these exist",
                remedy="add the missing image or remove the line and its pose",
            )
        pairs.append((found[1], found[0]))
    return pairs


def _intrinsics_file(directory: Path) -> Path:
    """Return the one JSON file of the recording that holds a camera matrix."""
    candidates = [
        path
        for path in sorted(directory.glob("*.json"))
        if "intrinsic_matrix" in path.read_text(encoding="utf-8", errors="replace")
    ]
    if len(candidates) != 1:
        raise InputFileError(
            directory,
            asked="one JSON file with the intrinsics of the camera (intrinsic_matrix)",
            found=", ".join(path.name for path in candidates) or "none",
            remedy="keep one, for example camera_intrinsics.json",
        )
    return candidates[0]


def _decoded(path: Path, asked: str, *, colour: bool) -> Image:
    """Return the pixels of an image file; colour as BGR, depth as it is stored."""
    import cv2

    existing_file(path, asked=asked)
    if path.suffix.lower() == ".npy":
        try:
            return np.load(path, allow_pickle=False)  # type: ignore[no-any-return]
        except ValueError as error:
            raise InputFileError(
                path, asked=asked, found=f"no array ({error})", remedy="export it again"
            ) from error
    raw = np.frombuffer(path.read_bytes(), np.uint8)
    image = None
    if path.suffix.lower() != ".exr":  # OpenCV refuses EXR unless an environment variable is set
        image = cv2.imdecode(raw, cv2.IMREAD_COLOR if colour else cv2.IMREAD_UNCHANGED)
    if image is None:
        raise InputFileError(
            path,
            asked=asked,
            found=f"{raw.size} bytes that do not decode",
            remedy="the file is damaged or of another kind: copy or export it again",
        )
    return np.asarray(image)


def _check_size(path: Path, image: Image, camera: Camera) -> None:
    """Refuse an image that is not of the size of the camera."""
    height, width = image.shape[:2]
    if (width, height) != (camera.width_px, camera.height_px):
        raise InputFileError(
            path,
            asked=f"{camera.width_px} x {camera.height_px} pixels, as the intrinsics say",
            found=f"{width} x {height} pixels",
            remedy="register colour to depth at one size, or use the intrinsics of this size",
        )
