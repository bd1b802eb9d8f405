"""Cameras calibrated by pictures of a ChArUco board: `enact workcell calibrate FOLDER`.

::

    FOLDER/images/<camera>/<moment>.png      (or .jpg, .ppm, .pgm, .bmp, .tif)

Pictures of one name were taken at one moment, by cameras that stand still, of a board that lay
still.  Out comes the `cameras.json` that `enact demo workcell --cameras FOLDER` reads.  The frame
of all cameras is that of the board at one moment, see `charuco`.  What is wrong is one line.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

import numpy as np

from actors.geometry.cameras.bundle_adjustment import Sight
from actors.geometry.cameras.camera_calibration import (
    UnfitPicturesError,
    calibrated,
    chosen_origin,
    fitted_lens,
)
from actors.geometry.cameras.camera_sets import read_cameras
from actors.geometry.cameras.charuco import find_board, other_markers
from actors.geometry.files import InputFileError, check_output, write_whole
from actors.geometry.poses import inverse, on_tray
from actors.workcell.folders.pictures import ENDINGS

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from pathlib import Path

    import numpy.typing as npt

    from actors.geometry.cameras.bundle_adjustment import Lens
    from actors.geometry.cameras.camera_calibration import Calibrated
    from actors.geometry.cameras.charuco import Board, Seen

    Image = npt.NDArray[np.uint8]
    Progress = Callable[[int, int], None]

FILE: Final = "cameras.json"
TRIED: Final = 6
"""Pictures in which other dictionaries are looked for."""
COVERED_LEAST: Final = 0.4
"""A lens is not known where no corner was: below this share of the picture, that is said."""


@dataclass(frozen=True, slots=True)
class CalibrateOptions:
    """How pictures of a board are to be read.

    Attributes:
        board: The board.
        out: The file that is written.
        origin: Moment whose board gives the frame; empty: one that most cameras saw.
        board_at: Where the board lay then in the cell: x, y, z in metres, turn about z in degrees.
        intrinsics: Folder with a calibration whose lenses are kept; only poses are sought.
        k3: Fit k3, too.
    """

    board: Board
    out: Path
    origin: str = ""
    board_at: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    intrinsics: Path | None = None
    k3: bool = False


@dataclass(slots=True)
class CameraReport:
    """What became of one camera.

    Attributes:
        camera: Its name.
        pictures: How many pictures it has.
        boards: In how many of them the board was found.
        shared: At how many moments another camera of the file saw it, too.
        rms_px: Root mean square error of the corners that were used.
        focal_px: Focal length across.
        covered: Share of the picture within the outermost corners, 0 to 1.
        centre_m: Where it stands, metres; empty if that is not known.
        left_out: Why it is not in the file; empty if it is.
    """

    camera: str
    pictures: int
    boards: int
    shared: int = 0
    rms_px: float | None = None
    focal_px: float | None = None
    covered: float = 0.0
    centre_m: list[float] = field(default_factory=list)
    left_out: str = ""


@dataclass(slots=True)
class CalibrateReport:
    """What became of a folder.

    Attributes:
        board: The board, as `--board` names it.
        origin: The moment whose board gives the frame.
        moments: At how many moments a camera of the file saw the board.
        file: What was written.
        rms_px: Root mean square error of the corners that were used.
        corners: How many were used.
        strays: How many were left out because they were far off all others.
        cameras: One entry for each.
        contradicting: Pictures that were left out because all others contradict them.
        notes: What may be wrong though nothing failed.
    """

    board: str
    origin: str = ""
    moments: int = 0
    file: str = ""
    rms_px: float | None = None
    corners: int = 0
    strays: int = 0
    cameras: list[CameraReport] = field(default_factory=list)
    contradicting: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    @property
    def left_out(self) -> dict[str, str]:
        """Why a camera is not in the file, by its name."""
        return {one.camera: one.left_out for one in self.cameras if one.left_out}


@dataclass(slots=True)
class _Camera:
    """The pictures of one camera."""

    name: str
    files: list[Path]
    width: int = 0
    height: int = 0
    seen: dict[str, Seen] = field(default_factory=dict)
    left_out: str = ""

    def sights(self, board: Board) -> list[Sight]:
        """Return those that show the board."""
        return [
            Sight(self.name, moment, board.corners_m[seen.numbers], seen.pixels)
            for moment, seen in self.seen.items()
            if len(seen.numbers)
        ]


def calibrate(
    folder: Path, options: CalibrateOptions, *, progress: Progress | None = None
) -> CalibrateReport:
    """Calibrate the cameras of a folder and write the file.

    Args:
        folder: Holds ``images/<camera>/<moment>.png``.
        options: How to read it.
        progress: Told how many of how many pictures have been looked at.

    Returns:
        What became of each camera; one that could not be calibrated is not in the file.

    Raises:
        InputFileError: Nothing can be calibrated, or a file is wrong; nothing was written.
    """
    check_output(options.out.parent)
    cameras = _pictures(folder)
    _look(cameras, options.board, progress)
    if not any(one.sights(options.board) for one in cameras):
        raise _no_board(folder, cameras, options.board)
    lenses, fixed = _lenses(cameras, options)
    sights = [sight for one in cameras if one.name in lenses for sight in one.sights(options.board)]
    if not sights:
        worst = cameras[0]
        raise InputFileError(
            folder,
            asked="pictures of the board that determine a lens",
            found=f"none of {len(cameras)} cameras; camera {worst.name}: {worst.left_out}",
            remedy="take more pictures, the board tilted and in all parts of the picture",
        )
    origin = _origin(folder, sights, options.origin)
    x_m, y_m, z_m, turn_deg = options.board_at
    cell_from_board = on_tray(x_m, y_m, math.radians(turn_deg))
    cell_from_board[2, 3] = z_m
    try:
        found = calibrated(
            sights,
            lenses,
            origin=origin,
            cell_from_board=cell_from_board,
            free=[name for name in lenses if name not in fixed],
            k3=options.k3,
        )
    except UnfitPicturesError as error:
        raise InputFileError(
            folder / "images", asked="poses of the board", found=str(error),
            remedy="take them again, or name another moment by --origin",
        ) from error  # fmt: skip
    report = _report(cameras, found, options)
    _write(cameras, found, options, report)
    return report


# ---------------------------------------------------------------- pictures


def _pictures(folder: Path) -> list[_Camera]:
    place = folder / "images"
    asked = "pictures of a board as images/<camera>/<moment>.png"
    if not place.is_dir():
        found = "no folder images" if folder.is_dir() else "no such folder"
        raise InputFileError(folder, asked=asked, found=found, remedy="check the path")
    cameras = []
    for below in sorted(place.iterdir(), key=_in_order):
        if below.is_dir():
            files = [one for one in below.iterdir() if one.suffix.lower() in ENDINGS]
            cameras.append(_Camera(below.name, sorted(files)))
    if not any(one.files for one in cameras):
        found = "no picture" if cameras else "no folder of a camera"
        raise InputFileError(
            place, asked=asked, found=found, remedy=f"pictures end in {', '.join(ENDINGS)}"
        )
    return cameras


def _in_order(path: Path) -> tuple[int, str]:
    """Return by what cameras are sorted: 2 before 10, names after numbers."""
    return (int(path.name), "") if path.name.isdecimal() else (1 << 62, path.name)


def _read(file: Path) -> Image:
    import cv2

    data = np.fromfile(file, np.uint8)
    flags = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
    image = cv2.imdecode(data, flags) if data.size else None
    if image is None:
        raise InputFileError(
            file, asked="a picture", found=f"{data.size} bytes that are none", remedy="replace it"
        )
    return np.asarray(image, np.uint8)


def _look(cameras: list[_Camera], board: Board, progress: Progress | None) -> None:
    """Find the board in all pictures."""
    total, done = sum(len(one.files) for one in cameras), 0
    for one in cameras:
        for file in one.files:
            image = _read(file)
            height, width = image.shape[:2]
            if one.width and (width, height) != (one.width, one.height):
                raise InputFileError(
                    file,
                    asked=f"{one.width} x {one.height} pixels, as the other pictures of camera"
                    f" {one.name}",
                    found=f"{width} x {height}",
                    remedy="give all pictures of a camera in the size in which it will be used",
                )
            one.width, one.height = width, height
            one.seen[file.stem] = find_board(image, board)
            done += 1
            if progress is not None:
                progress(done, total)


def _no_board(folder: Path, cameras: list[_Camera], board: Board) -> InputFileError:
    """Say what the pictures show in place of the board."""
    faults = Counter(seen.fault for one in cameras for seen in one.seen.values() if seen.fault)
    files = [file for one in cameras for file in one.files]
    if faults:
        found = f"another board: {faults.most_common(1)[0][0]}"
    else:
        some = files[:: max(1, len(files) // TRIED)][:TRIED]
        others = [other for file in some if (other := other_markers(_read(file)))]
        found = f"none of its markers in {len(files)} pictures"
        found += f", but {others[0]}" if others else ""
    return InputFileError(
        folder / "images",
        asked=f"pictures of the board {board}",
        found=found,
        remedy="name the board that was printed by --board; a marker needs about 20 pixels, and"
        " white around the board",
    )


# ---------------------------------------------------------------- lenses and poses


def _lenses(
    cameras: list[_Camera], options: CalibrateOptions
) -> tuple[dict[str, Lens], frozenset[str]]:
    """Return the lens of each camera that has one, and the names of those whose lens is kept."""
    from actors.geometry.cameras.bundle_adjustment import Lens

    lenses, known = {}, {}
    if options.intrinsics is not None:
        known = {one.name: one for one in read_cameras(options.intrinsics).cameras}
    for one in cameras:
        sights = one.sights(options.board)
        kept = known.get(one.name)
        if kept is not None and kept.width and (kept.width, kept.height) != (one.width, one.height):
            raise InputFileError(
                options.intrinsics or options.out,
                asked=f"camera {one.name} calibrated for {one.width} x {one.height} pixels",
                found=f"{kept.width} x {kept.height}",
                remedy="calibrate its lens at this size, without --intrinsics",
            )
        if not sights:
            faults = Counter(seen.fault for seen in one.seen.values() if seen.fault)
            why = f" ({faults.most_common(1)[0][0]})" if faults else ""
            one.left_out = f"the board is in none of its {len(one.files)} pictures{why}"
        elif kept is not None:
            lenses[one.name] = Lens(kept.camera_matrix, kept.distortion)
        else:
            try:
                lenses[one.name] = fitted_lens(sights, one.width, one.height, k3=options.k3)
            except UnfitPicturesError as error:
                one.left_out = str(error)
    return lenses, frozenset(known) & frozenset(lenses)


def _origin(folder: Path, sights: list[Sight], wanted: str) -> str:
    if not wanted:
        return chosen_origin(sights)
    moments = sorted({sight.moment for sight in sights})
    if wanted not in moments:
        raise InputFileError(
            folder / "images",
            asked=f"the board at the moment {wanted}, for --origin",
            found=f"it at {', '.join(moments[:4])}{' …' * (len(moments) > 4)}",
            remedy="name the pictures of which the board lay at the origin, without their ending",
        )
    return wanted


# ---------------------------------------------------------------- what comes of it


def _report(
    cameras: list[_Camera], found: Calibrated, options: CalibrateOptions
) -> CalibrateReport:
    board = options.board
    moments: dict[str, set[str]] = {}
    for sight in found.sights:
        moments.setdefault(sight.moment, set()).add(sight.camera)
    report = CalibrateReport(str(board), found.origin, len(moments), str(options.out))
    for one in cameras:
        sights = one.sights(board)
        entry = CameraReport(one.name, len(one.files), len(sights))
        entry.covered = round(_covered(one, sights), 3)
        entry.left_out = one.left_out or found.unlinked.get(one.name, "")
        if one.name in found.rms_px:
            entry.rms_px = round(found.rms_px[one.name], 4)
            entry.focal_px = round(float(found.rig.lenses[one.name].camera_matrix[0, 0]), 2)
            entry.shared = sum(one.name in seen and len(seen) > 1 for seen in moments.values())
            centre_m = inverse(np.asarray(found.rig.cameras[one.name]))[:3, 3]
            entry.centre_m = np.round(centre_m, 4).tolist()
            if entry.covered < COVERED_LEAST and options.intrinsics is None:
                report.notes.append(
                    f"camera {one.name}: the board covered {entry.covered:.0%} of its picture; show"
                    " it nearer to the edges, too"
                )
        report.cameras.append(entry)
    off = np.concatenate([found.rig.errors_px(sight) for sight in found.sights])
    report.rms_px = round(float(np.sqrt((off**2).sum(1).mean())), 4)
    report.corners, report.strays = len(off), found.strays
    report.contradicting = sorted(f"{one.camera}/{one.moment}" for one in found.contradicting)
    last = max(seen.last_marker for one in cameras for seen in one.seen.values())
    if last < board.markers - 1:
        report.notes.append(
            f"markers {last + 1} to {board.markers - 1} were in no picture; does the board have"
            f" {board.rows} rows?"
        )
    return report


def _covered(one: _Camera, sights: list[Sight]) -> float:
    """Return the share of the picture within the outermost corners of all boards."""
    import cv2

    if not sights:
        return 0.0
    pixels = np.concatenate([sight.pixels for sight in sights]).astype(np.float32)
    return float(cv2.contourArea(cv2.convexHull(pixels))) / (one.width * one.height)


def _write(
    cameras: list[_Camera], found: Calibrated, options: CalibrateOptions, report: CalibrateReport
) -> None:
    listed = []
    sizes: Mapping[str, _Camera] = {one.name: one for one in cameras}
    for entry in report.cameras:
        if entry.left_out:
            continue
        lens, pose = found.rig.lenses[entry.camera], found.rig.cameras[entry.camera]
        listed.append(
            {
                "name": entry.camera,
                "K": lens.camera_matrix.tolist(),
                "R": pose[:3, :3].tolist(),
                "t": pose[:3, 3].tolist(),
                "distortion": lens.distortion.tolist(),
                "width": sizes[entry.camera].width,
                "height": sizes[entry.camera].height,
                "rms_px": entry.rms_px,
            }
        )
    content = {
        "unit": "m",
        "made_by": "enact workcell calibrate",
        "board": report.board,
        "origin": report.origin,
        "cameras": listed,
    }
    files = {options.out: (json.dumps(content, indent=1) + "\n").encode()}
    if options.out.is_file():
        files[options.out.with_name(f"{options.out.name}.before")] = options.out.read_bytes()
    write_whole(files)
