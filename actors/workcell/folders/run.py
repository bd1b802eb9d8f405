"""Calibrated pictures of anything to a hull: `enact demo workcell --cameras FOLDER`.

Reads cameras and pictures, checks that both belong together, carves, and writes `hull.ply`,
`report.json` and a picture per camera with the outline of its mask and that of the hull.  All files
are written when everything is known, or none.  What is wrong is one line on the error stream and
exit status 1.
"""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from actors.geometry.cameras.camera_sets import read_cameras
from actors.geometry.files import InputFileError, check_output, write_whole
from actors.geometry.hull.space_carving import (
    COARSE,
    Carver,
    found_bounds,
    grid_of,
    in_front,
    nearest_to_axes,
)
from actors.geometry.hull.voxel_surface import surface_of
from actors.geometry.pictures.picture import png_bytes
from actors.geometry.surfaces.surface_files import ply_bytes
from actors.laps import Laps
from actors.workcell.folders.cell import fits, hull_by_actors
from actors.workcell.folders.pictures import read_shots

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    import numpy.typing as npt

    from actors.geometry.cameras.camera_sets import CameraSet
    from actors.geometry.hull.voxels import VoxelBlocks
    from actors.workcell.folders.pictures import Shot, Shots

    Numbers = npt.NDArray[np.float64]
    Rows = npt.NDArray[np.int64]
    Say = Callable[[str], None]

GRID: Final = 160
"""Voxels along the longest edge of the hull's box."""
ACTORS: Final = "BackgroundSubtraction and Reconstruction"
AGREES: Final = 0.6
"""Below this mean IoU of hull and masks, cameras and pictures do not belong together."""
BETTER: Final = 0.15
"""An error names another way to read the calibration if it raises the mean IoU by this."""
SUSPICIOUS: Final = 0.02
"""A camera is named if leaving it out raises the mean IoU of the others by this."""
MASK_COLOUR: Final = (22, 163, 102)
HULL_COLOUR: Final = (226, 61, 40)


@dataclass(frozen=True, slots=True)
class FolderOptions:
    """How a folder is to be read.

    Attributes:
        grid: Voxels along the longest edge.
        unit: Unit of length of a calibration that does not say its own.
        key: Red, green, blue of the backdrop; None: masks and backgrounds are files.
        pixel_distortion: k1, k2, k3 act on radii in pixels.
        frame: Which moment; the first otherwise.
        quiet: Print the report as JSON in place of lines.
    """

    grid: int = GRID
    unit: str = "m"
    key: tuple[int, int, int] | None = None
    pixel_distortion: bool = False
    frame: str = ""
    quiet: bool = False


@dataclass(slots=True)
class FolderReport:
    """What became of a folder.

    Attributes:
        calibration: Name of the format, and the file.
        cameras: Names of the cameras that were used.
        missing: Cameras without a picture.
        masks_from: Source of the masks.
        frame: The moment, of `frames`.
        frames: Number of moments.
        made_by: What made the hull: the cell's actors, or, with very many cameras, carving alone.
        centre_in_front: Share of the cameras that have the centre in front of them.
        low_m: Lowest corner of the box, metres.
        high_m: Highest corner.
        voxel_m: Edge of a voxel.
        voxels: Voxels of the hull.
        volume_l: Their volume, litres.
        iou: Intersection over union of mask and hull's outline, per camera.
        iou_mean: Mean of these.
        suspicious: Camera without which the others agree best, if clearly better.
        suspicious_gain: By how much.
        seconds: Time per step.
    """

    calibration: str
    cameras: list[str]
    missing: list[str]
    masks_from: str
    frame: str
    frames: int
    centre_in_front: float
    made_by: str = "carving, voxel by voxel"
    low_m: list[float] = field(default_factory=list)
    high_m: list[float] = field(default_factory=list)
    voxel_m: float = 0.0
    voxels: int = 0
    volume_l: float = 0.0
    iou: dict[str, float] = field(default_factory=dict)
    iou_mean: float = 0.0
    suspicious: str = ""
    suspicious_gain: float = 0.0
    seconds: dict[str, float] = field(default_factory=dict)

    def as_json(self) -> dict[str, Any]:
        """Return what `report.json` holds."""
        return {name: getattr(self, name) for name in self.__slots__}


def run_folder(
    folder: Path, out: Path, options: FolderOptions | None = None, *, say: Say = print
) -> int:
    """Make the hull of a folder's pictures and report.

    Args:
        folder: Pictures and calibration, as `camera_sets` and `folders.pictures` describe.
        out: Where `hull.ply`, `report.json` and the pictures go; made if missing.
        options: How to read the folder.
        say: Takes the lines of the report.

    Returns:
        Exit status: 0 done, 1 refused, the reason on the error stream and nothing written.
    """
    options = options or FolderOptions()
    try:
        report = _make(folder, out, options, (lambda _: None) if options.quiet else say)
    except (InputFileError, OSError) as error:
        print(f"enact: {' '.join(str(error).split())}", file=sys.stderr)
        return 1
    if options.quiet:
        say(json.dumps(report.as_json(), ensure_ascii=False))
    return 0


def _make(folder: Path, out: Path, options: FolderOptions, say: Say) -> FolderReport:
    clock = Laps()
    check_output(out)
    cameras = read_cameras(folder, unit=options.unit)
    every = [
        one.with_pixel_distortion() if options.pixel_distortion else one for one in cameras.cameras
    ]
    shots = read_shots(folder, every, key=options.key, frame=options.frame)
    report = _begun(cameras, shots)
    for line in _first_lines(report):
        say(line)
    clock.lap("read")
    carver = Carver([shot.camera for shot in shots.shots], [shot.mask for shot in shots.shots])
    box = _bounds(folder, cameras, carver, options.unit)
    clock.lap("bounds")
    grid, rows = _judged(folder, cameras, carver, box, _carved(folder, carver, box, options.grid))
    clock.lap("carved")
    if fits(shots.shots, grid):
        found = hull_by_actors(shots.shots, grid)
        rows, report.made_by = (found, ACTORS) if len(found) else (rows, report.made_by)
        clock.lap("actors")
    _measure(report, carver, grid, rows)
    _suspect(report, carver, box)
    clock.lap("measured")
    contents = _files(out, shots.shots, carver, grid, rows)
    clock.lap("drawn")
    report.seconds = clock.seconds
    contents[out / "report.json"] = json.dumps(report.as_json(), indent=1).encode()
    write_whole(contents)
    for line in _last_lines(report, out):
        say(line)
    return report


def _begun(cameras: CameraSet, shots: Shots) -> FolderReport:
    used = [shot.camera for shot in shots.shots]
    return FolderReport(
        calibration=f"{cameras.reader} ({cameras.file.name})",
        cameras=[camera.name for camera in used],
        missing=list(shots.missing),
        masks_from=shots.masks_from,
        frame=shots.frame,
        frames=max(1, shots.frames),
        centre_in_front=in_front(used, nearest_to_axes(used)),
    )


def _first_lines(report: FolderReport) -> list[str]:
    frame = f", frame {report.frame} of {report.frames}" if report.frame else ""
    lines = [
        f"calibration  {report.calibration}: {len(report.cameras) + len(report.missing)} cameras",
        f"pictures     of {len(report.cameras)} cameras, foreground by {report.masks_from}{frame}",
    ]
    if report.missing:
        lines.append(f"missing      no picture of {', '.join(report.missing)}")
    lines.append(f"middle       lies ahead of {report.centre_in_front:.0%} of the cameras")
    return lines


def _last_lines(report: FolderReport, out: Path) -> list[str]:
    worst = min(report.iou, key=report.iou.__getitem__)
    size_m = " x ".join(
        f"{high - low:.3g}" for low, high in zip(report.low_m, report.high_m, strict=True)
    )
    lines = [
        f"box          {size_m} m, voxels of {1e3 * report.voxel_m:.3g} mm",
        f"hull         {report.voxels:,} voxels, {report.volume_l:.4g} l, by {report.made_by}",
        f"agreement    IoU {report.iou_mean:.3f}, least {report.iou[worst]:.3f} (camera {worst})",
    ]
    if report.suspicious:
        lines.append(
            f"suspicious   without camera {report.suspicious} the others agree better by"
            f" {report.suspicious_gain:.3f}; check its calibration and its mask"
        )
    return [*lines, f"written      {out}/hull.ply, report.json and a picture per camera"]


# ---------------------------------------------------------------- the box and the hull


def _bounds(
    folder: Path, cameras: CameraSet, carver: Carver, unit: str
) -> tuple[Numbers, Numbers] | None:
    """Return the box of `bounds.json`, in its calibration's unit, or a detected one."""
    file = folder / "bounds.json"
    if not file.is_file():
        return found_bounds(carver)
    asked = '{"low": [x, y, z], "high": [x, y, z]}, low below high'
    try:
        content = json.loads(file.read_text(encoding="utf-8-sig"))
        low, high = (np.asarray(content[key], np.float64) for key in ("low", "high"))
        grid_of(low, high, COARSE)
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise InputFileError(
            file, asked=asked, found=f"{type(error).__name__}: {error}", remedy="correct the file"
        ) from error
    scale_m = cameras.unit_m(unit)
    return scale_m * low, scale_m * high


def _carved(
    folder: Path, carver: Carver, box: tuple[Numbers, Numbers] | None, count: int
) -> tuple[VoxelBlocks, Rows] | None:
    if box is None:
        return None
    try:
        grid = grid_of(*box, count)
    except ValueError as error:
        raise InputFileError(
            folder, asked="a box for the hull", found=str(error), remedy="give bounds.json"
        ) from error
    rows = carver.carve(grid).tight_rows
    return (grid, rows) if len(rows) else None


def _judged(
    folder: Path,
    cameras: CameraSet,
    carver: Carver,
    box: tuple[Numbers, Numbers] | None,
    found: tuple[VoxelBlocks, Rows] | None,
) -> tuple[VoxelBlocks, Rows]:
    """Return what was found if hull and masks agree; else name a way of reading that does better.

    Raises:
        InputFileError: They do not.
    """
    mean = 0.0
    if found is not None:
        mean = float(np.mean(carver.agreement(*found)))
        if mean >= AGREES:
            return found
    mirrored = Carver(carver.cameras, [mask[:, ::-1] for mask in carver.masks])
    others = {
        "with all poses inverted (cell from camera)": _mean_iou(
            Carver([one.turned_round() for one in carver.cameras], carver.masks), None
        ),
        "with y up and z back (computer graphics)": _mean_iou(
            Carver([one.flipped() for one in carver.cameras], carver.masks), None
        ),
        "with the pictures mirrored left to right": _mean_iou(mirrored, box),
    }
    best = max(others, key=others.__getitem__)
    what = "an empty hull" if found is None else f"a mean IoU of {mean:.2f}"
    hint = f"; {best} it is {others[best]:.2f}" if others[best] > mean + BETTER else ""
    raise InputFileError(
        cameras.file,
        asked=f"cameras whose hull agrees with the masks of {folder} (mean IoU {AGREES} or more)",
        found=f"{what}{hint}",
        remedy="x_camera = R X + t, x to the right, y down, z ahead; check poses, unit, names and"
        " masks",
    )


def _mean_iou(carver: Carver, box: tuple[Numbers, Numbers] | None) -> float:
    """Return the mean IoU of a coarse hull and the masks."""
    box = box or found_bounds(carver)
    if box is None:
        return 0.0
    grid = grid_of(*box, COARSE)
    rows = carver.carve(grid).tight_rows
    return float(np.mean(carver.agreement(grid, rows))) if len(rows) else 0.0


# ---------------------------------------------------------------- what comes of it


def _measure(report: FolderReport, carver: Carver, grid: VoxelBlocks, rows: Rows) -> None:
    iou = carver.agreement(grid, rows)
    report.low_m = grid.origin_m.tolist()
    report.high_m = (grid.origin_m + grid.voxel_m * np.array(grid.shape)).tolist()
    report.voxel_m, report.voxels = grid.voxel_m, len(rows)
    report.volume_l = len(rows) * grid.voxel_m**3 * 1e3
    report.iou = {
        camera.name: round(value, 4) for camera, value in zip(carver.cameras, iou, strict=True)
    }
    report.iou_mean = round(float(np.mean(iou)), 4)


def _suspect(report: FolderReport, carver: Carver, box: tuple[Numbers, Numbers] | None) -> None:
    """Name the camera whose removal raises the agreement of the others most."""
    if len(carver.cameras) < 4 or box is None:
        return
    grid = grid_of(*box, COARSE)
    carved = carver.carve(grid)
    before = carver.agreement(grid, carved.tight_rows)
    alone = np.bincount(carved.denied_by, minlength=len(carver.cameras))
    gains = {}
    for number in np.argsort(alone)[::-1][:3]:
        after = carver.agreement(grid, carved.tight_without(int(number)))
        kept = [index for index in range(len(before)) if index != number]
        gains[int(number)] = float(np.mean([after[one] - before[one] for one in kept]))
    worst = max(gains, key=gains.__getitem__)
    if gains[worst] >= SUSPICIOUS:
        report.suspicious = carver.cameras[worst].name
        report.suspicious_gain = round(gains[worst], 4)


def _files(
    out: Path,
    shots: Sequence[Shot],
    carver: Carver,
    grid: VoxelBlocks,
    rows: Rows,
) -> dict[Path, bytes]:
    vertices, triangles = surface_of(grid, rows)
    contents = {out / "hull.ply": ply_bytes(vertices, triangles)}
    for number, shot in enumerate(shots):
        picture = _outlined(shot, carver.outline(number, grid, rows))
        name = shot.camera.name.replace("/", "_")
        contents[out / f"camera_{name}.png"] = png_bytes(picture)
    return contents


def _outlined(shot: Shot, hull: npt.NDArray[np.bool_]) -> npt.NDArray[np.uint8]:
    """Return a picture with the outline of its mask (green) and that of the hull (red), RGB."""
    import cv2

    if shot.image is not None:
        picture = np.ascontiguousarray(shot.image[..., ::-1])
    else:
        grey = np.where(shot.mask, 205, 90).astype(np.uint8)
        picture = np.repeat(grey[..., None], 3, axis=2)
    thick = max(1, shot.mask.shape[1] // 640)
    for mask, colour in ((shot.mask, MASK_COLOUR), (hull, HULL_COLOUR)):
        lines, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(picture, lines, -1, colour, thick)
    return picture
