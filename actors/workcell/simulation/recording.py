"""Recordings of the simulated cameras: made once per scenario and seed, played at the true rate.

    DIR/recording.json           description
    DIR/truth.npz                bodies (frames, people, 17, 7), NaN while absent; joints
                                 (frames, 7) if the arm is shown, else (0, 7); boxes (n, 9),
                                 centre, half sizes and colour of each obstacle, room by room
    DIR/camera_<i>/still.png     the empty room, exactly
    DIR/camera_<i>/windows.npy   (frames, 4), the part that differs from it: first column, first
                                 row, last column + 1, last row + 1; zeros: nothing differs
    DIR/camera_<i>/000042.jpg    that part of frame 42, without noise

A recording appears under its name when it is whole.  One that shows people or things elsewhere than
the scenario has them now was made by another version of it, and is never played: its images would
disagree with the truth of the run.
"""

from __future__ import annotations

import contextlib
import dataclasses
import fcntl
import json
import math
import os
import shutil
import tempfile
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from actors.geometry.arms.kinematics import capsules_at
from actors.workcell.cameras.sources import CameraError
from actors.workcell.simulation.arm import ARM
from actors.workcell.simulation.drawing.render import View
from actors.workcell.simulation.human import CAPSULES
from actors.workcell.simulation.room import cameras
from actors.workcell.simulation.stage import Stage
from actors.workcell.vocabulary import PERIOD_NS, PERIOD_S

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    import numpy.typing as npt

    from actors.workcell.scenarios import Scenario
    from actors.workcell.simulation.stage import Scene
    from actors.workcell.vocabulary import Calibration

    F64 = npt.NDArray[np.float64]
    Image = npt.NDArray[np.uint8]
    Motion = Callable[[float], F64]
    Draw = Callable[[Scene], Image]

FORMAT: Final = 2
"""Number of the format; a recording of another one is made again."""
QUALITY: Final = 95
RENDERERS: Final = ("composite", "mujoco")


@dataclass(frozen=True, slots=True)
class RecordingInfo:
    """What a recording is of.

    Attributes:
        scenario: Name of the scenario.
        seed: Its seed.
        seconds: How long it lasts.
        renderer: One of `RENDERERS`.
        robot: The images show the arm, as it moved then.
        width: Columns of the images.
        height: Rows of the images.
        cameras: How many there are.
        frames: How many images each has.
        format: `FORMAT` of the program that made it.
    """

    scenario: str
    seed: int
    seconds: float
    renderer: str
    robot: bool
    width: int
    height: int
    cameras: int
    frames: int
    format: int = FORMAT


def cache_folder() -> Path:
    """Return where recordings are kept for the next run: below `XDG_CACHE_HOME` or `~/.cache`."""
    root = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(root) / "enact-dist" / "workcell"


def kept_recording(
    root: Path,
    scenario: Scenario,
    *,
    renderer: str = "composite",
    calibrations: Sequence[Calibration] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Return the recording of a scenario in a folder of recordings; make it if it is not there.

    Args:
        root: The folder; `cache_folder()` is one.
        scenario: What is recorded, with its seed and length.
        renderer: One of `RENDERERS`.
        calibrations: Of the cameras; by default those of the room.
        progress: Told how many of how many views are done.

    Raises:
        CameraError: The renderer cannot work here.
        OSError: The folder cannot be written.
    """
    chosen = tuple(cameras() if calibrations is None else calibrations)
    wanted = _info(scenario, renderer, chosen, robot=False)
    name = (
        f"{scenario.name}-seed{scenario.seed}-{scenario.seconds:g}s-{renderer}"
        f"-{wanted.width}x{wanted.height}x{len(chosen)}"
    )
    folder = root / name
    with _alone_in(root):
        try:
            if read_info(folder) == wanted:
                check_truth(folder, Stage(scenario))
                return folder
        except CameraError:
            pass  # none exists, or an older version made it: make it again
        return record(folder, scenario, renderer=renderer, calibrations=chosen, progress=progress)


@contextlib.contextmanager
def _alone_in(root: Path) -> Iterator[None]:
    """Let one program at a time add to a folder of recordings: others may be playing its result."""
    root.mkdir(parents=True, exist_ok=True)
    with (root / ".lock").open("w") as file:
        with contextlib.suppress(OSError):  # a file system without locks
            fcntl.flock(file, fcntl.LOCK_EX)
        yield


def record(
    folder: Path,
    scenario: Scenario,
    *,
    renderer: str = "composite",
    calibrations: Sequence[Calibration] | None = None,
    motion: Motion | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Record a scenario; a recording that lies at `folder` is replaced, anything else stays.

    Args:
        folder: Where; its parents are made.
        scenario: What.
        renderer: "composite", or "mujoco" where it can draw (EGL).
        calibrations: Of the cameras; by default those of the room.
        motion: Joints of the arm (7,) over the time of the scenario; None: the arm is not shown.
        progress: Told how many of how many views are done.

    Raises:
        CameraError: The renderer cannot work here, or something else lies at the folder.
        OSError: The folder cannot be written.
    """
    empty = not folder.exists() or (folder.is_dir() and not any(folder.iterdir()))
    if not empty and not (folder / "recording.json").is_file():
        raise CameraError(
            f"{folder}: asked for a new folder, an empty one, or a recording to replace; found"
            " something else; name another folder"
        )
    chosen = tuple(cameras() if calibrations is None else calibrations)
    info = _info(scenario, renderer, chosen, robot=motion is not None)
    stage = Stage(scenario)
    folder.parent.mkdir(parents=True, exist_ok=True)
    begun = Path(tempfile.mkdtemp(prefix=f".{folder.name}-", dir=folder.parent))
    done = 0

    def tell() -> None:
        nonlocal done
        done += 1
        if progress is not None:
            progress(done, info.cameras * info.frames)

    try:
        draws = _draws(renderer, chosen, stage)
        workers = min(os.cpu_count() or 1, len(chosen)) if renderer == "composite" else 1
        with ThreadPoolExecutor(workers) as pool:
            jobs = [
                pool.submit(_record_camera, begun, number, draw, stage, info, motion, tell)
                for number, draw in enumerate(draws)
            ]
            for job in jobs:
                job.result()
        truth = _truth(stage, info, motion)
        np.savez(
            begun / "truth.npz",
            bodies=truth["bodies"],
            joints=truth["joints"],
            boxes=truth["boxes"],
        )
        text = json.dumps(dataclasses.asdict(info), indent=2)
        (begun / "recording.json").write_text(text + "\n", encoding="utf-8")
        if folder.exists():
            shutil.rmtree(folder)
        begun.rename(folder)
    finally:
        shutil.rmtree(begun, ignore_errors=True)
    return folder


def read_info(folder: Path) -> RecordingInfo:
    """Return what a recording is of.

    Raises:
        CameraError: There is no recording, or one of another format, or a camera's is missing.
    """
    path = folder / "recording.json"
    asked = "asked for a recording of the simulated cameras"
    if not path.is_file():
        raise CameraError(f"{folder}: {asked}; found no recording.json; record it first")
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        info = RecordingInfo(**content)
    except (ValueError, TypeError) as error:
        raise CameraError(f"{path}: {asked}; found something else ({error})") from None
    if info.format != FORMAT:
        raise CameraError(
            f"{path}: {asked} in format {FORMAT}; found format {info.format}; record it again"
        )
    for number in range(info.cameras):
        for name in ("still.png", "windows.npy"):
            if not (folder / f"camera_{number}" / name).is_file():
                raise CameraError(
                    f"{folder}: {asked}; found no camera_{number}/{name}; record it again"
                )
    return info


def check_truth(folder: Path, stage: Stage) -> None:
    """Refuse a recording that shows something else than its scenario does now.

    Raises:
        CameraError: People or things were elsewhere when it was made, or its truth is unreadable.
    """
    info = read_info(folder)
    now = _truth(stage, info, None)
    asked = f"asked for a recording of {info.scenario}, seed {info.seed}, as it is now"
    try:
        with np.load(folder / "truth.npz") as then:
            same = {name: np.array_equal(then[name], now[name], equal_nan=True)
                    for name in ("bodies", "boxes")}  # fmt: skip
    except (OSError, ValueError, KeyError) as error:
        raise CameraError(
            f"{folder}: {asked}; found no readable truth.npz ({error}); record it again"
        ) from None
    for name, what in (("bodies", "people walk differently"), ("boxes", "other things stand")):
        if not same[name]:
            raise CameraError(f"{folder}: {asked}; found one in which {what}; record it again")


class Tape:
    """The recording of one camera, to be played.

    Args:
        folder: The recording.
        number: Number of the camera.
        calibration: The images must have its size.

    Attributes:
        info: What it is of.

    Raises:
        CameraError: There is no such recording, or a file of it is missing, or the size is another.
    """

    def __init__(self, folder: Path, number: int, calibration: Calibration) -> None:
        import cv2

        self.info = info = read_info(folder)
        self._folder = folder / f"camera_{number}"
        if number >= info.cameras:
            raise CameraError(f"{folder}: asked for camera {number}; found {info.cameras} cameras")
        if (info.width, info.height) != (calibration.width, calibration.height):
            raise CameraError(
                f"{folder}: asked for {calibration.width} x {calibration.height} pixels as"
                f" calibrated; found a recording of {info.width} x {info.height}"
            )
        still = cv2.imread(str(self._folder / "still.png"), cv2.IMREAD_COLOR)
        windows = self._folder / "windows.npy"
        if still is None or not windows.is_file():
            raise CameraError(
                f"{self._folder}: asked for still.png and windows.npy; found"
                f" {'no still.png' if still is None else 'no windows.npy'}; record it again"
            )
        self._still: Image = np.asarray(still, np.uint8)
        self._windows = np.load(windows)
        for frame in np.flatnonzero(self._windows[:, 2]):
            if not self._path(int(frame)).is_file():
                raise CameraError(
                    f"{self._path(int(frame))}: asked for an image of the recording; found no such"
                    " file; record it again"
                )

    def play(self, image: Image, frame: int | None) -> None:
        """Write a frame into an image; None or a frame past the last is the empty room.

        Raises:
            CameraError: The file of the frame cannot be decoded.
        """
        import cv2

        np.copyto(image, self._still)
        if frame is None or not 0 <= frame < len(self._windows) or not self._windows[frame, 2]:
            return
        left, top, right, bottom = self._windows[frame].tolist()
        part = cv2.imread(str(self._path(frame)), cv2.IMREAD_COLOR)
        if part is None or part.shape != (bottom - top, right - left, 3):
            raise CameraError(
                f"{self._path(frame)}: asked for {right - left} x {bottom - top} pixels; found"
                f" {'nothing to decode' if part is None else part.shape}; record it again"
            )
        image[top:bottom, left:right] = part

    def _path(self, frame: int) -> Path:
        return self._folder / f"{frame:06d}.jpg"


def _info(
    scenario: Scenario, renderer: str, calibrations: Sequence[Calibration], *, robot: bool
) -> RecordingInfo:
    if renderer not in RENDERERS:
        raise CameraError(f"renderer {renderer!r}: there are {', '.join(RENDERERS)}")
    return RecordingInfo(
        scenario=scenario.name,
        seed=scenario.seed,
        seconds=scenario.seconds,
        renderer=renderer,
        robot=robot,
        width=calibrations[0].width,
        height=calibrations[0].height,
        cameras=len(calibrations),
        frames=math.ceil(scenario.seconds / PERIOD_S),
    )


def _draws(renderer: str, calibrations: Sequence[Calibration], stage: Stage) -> list[Draw]:
    """Return a function per camera that draws a scene."""
    if renderer == "mujoco":
        from actors.workcell.simulation.drawing.mujoco_views import mujoco_draws

        return mujoco_draws(calibrations, stage)

    def composite(calibration: Calibration) -> Draw:
        view = View(calibration, seed=0)
        return lambda scene: view.render(scene.capsules, scene.colours, scene.boxes).image

    return [composite(calibration) for calibration in calibrations]


def _scene(stage: Stage, frame: int, motion: Motion | None) -> Scene:
    at_s = frame * PERIOD_NS / 1e9
    arm = None if motion is None else capsules_at(ARM, motion(at_s))[0]
    return stage.scene_at(at_s, arm)


def _record_camera(
    folder: Path,
    number: int,
    draw: Draw,
    stage: Stage,
    info: RecordingInfo,
    motion: Motion | None,
    tell: Callable[[], None],
) -> None:
    """Write all frames of one camera."""
    import cv2

    own = folder / f"camera_{number}"
    own.mkdir()
    still = draw(dataclasses.replace(stage.scene_at(-1.0), boxes=stage.boxes))
    _write(own / "still.png", still)
    windows = np.zeros((info.frames, 4), np.int32)
    for frame in range(info.frames):
        image = draw(_scene(stage, frame, motion))
        differs = cv2.absdiff(image, still)
        rows, columns = np.flatnonzero(differs.any((1, 2))), np.flatnonzero(differs.any((0, 2)))
        if len(rows):
            left, top, right, bottom = columns[0], rows[0], columns[-1] + 1, rows[-1] + 1
            windows[frame] = left, top, right, bottom
            _write(own / f"{frame:06d}.jpg", image[top:bottom, left:right])
        tell()
    np.save(own / "windows.npy", windows)


def _write(path: Path, image: Image) -> None:
    """Write an image.

    Raises:
        OSError: It could not be written.
    """
    import cv2

    how = [cv2.IMWRITE_JPEG_QUALITY, QUALITY] if path.suffix == ".jpg" else []
    if not cv2.imwrite(str(path), image, how):
        raise OSError(f"{path}: could not be written; is the disk full?")


def _truth(
    stage: Stage, info: RecordingInfo, motion: Motion | None
) -> dict[str, npt.NDArray[np.float64]]:
    """Return what `truth.npz` holds."""
    times = [frame * PERIOD_NS / 1e9 for frame in range(info.frames)]
    bodies = np.full((info.frames, len(stage.people), CAPSULES, 7), np.nan)
    for frame, at_s in enumerate(times):
        for number, capsules in stage.bodies_at(at_s).items():
            bodies[frame, number] = capsules
    joints = np.empty((0, 7)) if motion is None else np.array([motion(t) for t in times])
    boxes = [(*box.centre_m, *box.half_m, *box.colour) for room in stage.rooms for box in room]
    return {"bodies": bodies, "joints": joints, "boxes": np.array(boxes, np.float64)}
