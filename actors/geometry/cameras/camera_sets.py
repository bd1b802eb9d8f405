"""Calibrated cameras as others write them down: which formats there are, read into one form.

===============  =================================================================================
reader           what it reads, in the folder
===============  =================================================================================
cameras.json     ``{"unit": "m", "cameras": [{"name", "K" and "R" and "t", or "P", "distortion",
                 "width", "height"}]}``
COLMAP text      ``cameras.txt`` and ``images.txt``, here, in ``sparse``, ``sparse/0``, ``colmap``;
                 SIMPLE_PINHOLE, PINHOLE, SIMPLE_RADIAL, RADIAL, OPENCV
parameter file   a text file with one line per camera: ``name K(9) R(9) t(3)``, after a count
projections      a text file per camera with a 3 x 4 matrix, here or in ``calib``, ``projections``,
                 ``cameras``
OpenCV           a ``.yml``, ``.yaml`` or ``.xml`` per camera, in the same places: camera_matrix,
                 distortion_coefficients, and R with t, or a projection_matrix
===============  =================================================================================

``x_camera = R X + t``.  The first reader whose files are there reads, and says its name; nothing is
guessed.  Every error is one line that names the file, what was asked and what was found.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from actors.geometry.files import InputFileError
from actors.geometry.poses import inverse

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    import numpy.typing as npt

    Numbers = npt.NDArray[np.float64]

UNITS: Final = {"m": 1.0, "cm": 0.01, "mm": 0.001}
"""Metres of one unit of length."""
PLACES: Final = (".", "calib", "projections", "cameras")
COLMAP_PLACES: Final = (".", "sparse", "sparse/0", "colmap")
ROTATION_TOLERANCE: Final = 1e-2
"""How far from orthonormal R may be as written; files have four digits and more."""
CONDITION_MAX: Final = 1e12
"""The left part of a projection that is worse has no inverse, whatever its scale."""
_REMEDY: Final = "enact demo workcell --help names the formats"
_COLMAP: Final = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fx", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
}


@dataclass(frozen=True, slots=True, eq=False)
class SetCamera:
    """One calibrated camera of a set.

    Attributes:
        name: Its name; that of its picture where it has one.
        camera_matrix: (3, 3) float64, pixels.
        distortion: (5,) float64: k1, k2, p1, p2, k3 of OpenCV.
        camera_from_cell: (4, 4) float64, metres.
        width: Columns; 0 where the file leaves it to the picture.
        height: Rows; 0 likewise.
    """

    name: str
    camera_matrix: Numbers
    distortion: Numbers
    camera_from_cell: Numbers
    width: int = 0
    height: int = 0

    @property
    def centre_m(self) -> Numbers:
        """Where it stands, (3,), metres."""
        return np.asarray(inverse(self.camera_from_cell)[:3, 3])

    @property
    def axis(self) -> Numbers:
        """Unit vector along which it looks, (3,)."""
        return np.asarray(self.camera_from_cell[2, :3])

    def of_size(self, width: int, height: int) -> SetCamera:
        """Return the camera with the size of its picture."""
        return replace(self, width=width, height=height)

    def with_pixel_distortion(self) -> SetCamera:
        """Return the camera with k1, k2, k3 that were meant for radii in pixels."""
        square = self.camera_matrix[0, 0] * self.camera_matrix[1, 1]
        powers = np.array([square, square**2, 1.0, 1.0, square**3])
        return replace(self, distortion=self.distortion * powers)

    def turned_round(self) -> SetCamera:
        """Return the camera with its pose inverted, as if the file gave cell from camera."""
        return replace(self, camera_from_cell=inverse(self.camera_from_cell))

    def flipped(self) -> SetCamera:
        """Return the camera as if its y and z pointed up and back, as in computer graphics."""
        return replace(
            self, camera_from_cell=np.diag((1.0, -1.0, -1.0, 1.0)) @ self.camera_from_cell
        )


@dataclass(frozen=True, slots=True)
class CameraSet:
    """All cameras of a folder.

    Attributes:
        cameras: In the order of the file, at least one.
        reader: Name of the format.
        file: What was read first.
    """

    cameras: tuple[SetCamera, ...]
    reader: str
    file: Path

    def unit_m(self, unit: str) -> float:
        """Return metres of one unit of the calibration: what it says, else what is given."""
        if self.reader != "cameras.json":
            return UNITS[unit]
        return UNITS[json.loads(_text(self.file)).get("unit") or unit]


def read_cameras(folder: Path, *, unit: str = "m") -> CameraSet:
    """Read the calibration of a folder.

    Args:
        folder: The folder.
        unit: Unit of length of a file that does not say its own, one of `UNITS`.

    Raises:
        InputFileError: No format fits, or the file of one is wrong.
    """
    if not folder.is_dir():
        raise InputFileError(
            folder, asked="a folder of pictures with a calibration",
            found="a file" if folder.exists() else "no such folder", remedy="check the path",
        )  # fmt: skip
    for name, reader in _READERS.items():
        found = reader(folder, UNITS[unit])
        if found is not None:
            file, cameras = found
            names = [camera.name for camera in cameras]
            twice = next((one for one in names if names.count(one) > 1), None)
            if twice is not None or not cameras:
                what = f"camera {twice!r} twice" if cameras else "no camera"
                raise _wrong(file, "cameras with names of their own", what)
            return CameraSet(tuple(cameras), name, file)
    raise InputFileError(
        folder,
        asked="a calibration",
        found="none: no cameras.json, no cameras.txt with images.txt, no text file with K, R, t or"
        " 3 x 4 numbers, no .yml or .xml of OpenCV",
        remedy=_REMEDY,
    )


def decomposed(projection: Numbers) -> tuple[Numbers, Numbers, Numbers]:
    """Return K, R, t of a projection (3, 4), K with a positive diagonal and det R = 1.

    Raises:
        ValueError: It is no projection of a pinhole camera with its centre at finite distance.
    """
    matrix = np.asarray(projection, np.float64)
    if (
        matrix.shape != (3, 4)
        or not np.isfinite(matrix).all()
        or np.linalg.cond(matrix[:, :3]) > CONDITION_MAX
    ):
        raise ValueError("asked for a finite 3 x 4 projection whose left part has an inverse")
    left = matrix[:, :3]
    if np.linalg.det(left) < 0.0:
        matrix, left = -matrix, -left
    flip = np.eye(3)[::-1]
    q, r = np.linalg.qr((flip @ left).T)  # RQ by QR: A = (J r' J) (J q')
    k, rotation = flip @ r.T @ flip, flip @ q.T
    signs = np.diag(np.where(np.diag(k) < 0.0, -1.0, 1.0))
    k, rotation = k @ signs, signs @ rotation
    translation = np.linalg.solve(k, matrix[:, 3])
    return k / k[2, 2], rotation, translation


# ---------------------------------------------------------------- readers


def _wrong(file: Path, asked: str, found: str) -> InputFileError:
    return InputFileError(file, asked=asked, found=found, remedy=_REMEDY)


def _text(file: Path) -> str:
    try:
        return file.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise _wrong(file, "a text file", str(error)) from error


def _camera(
    file: Path, name: str, parts: tuple[Any, Any, Any], scale_m: float, distortion: Any = ()
) -> SetCamera:
    """Return a camera of K, R and t as a file gives them.

    Raises:
        InputFileError: They are invalid; the message names the camera.
    """
    try:
        k, rotation, t = (np.asarray(part, np.float64) for part in parts)
        bent = np.asarray(distortion, np.float64).ravel()
    except (TypeError, ValueError) as error:
        raise _wrong(file, f"numbers for camera {name}", str(error)) from error
    found = ""
    if k.shape != (3, 3) or rotation.shape != (3, 3) or t.size != 3:
        found = f"K {k.shape}, R {rotation.shape}, t {t.shape}"
    elif not all(np.isfinite(part).all() for part in (k, rotation, t, bent)):
        found = "numbers that are not finite"
    elif min(k[0, 0], k[1, 1]) <= 0.0 or abs(k[2] - (0.0, 0.0, 1.0)).max() > 1e-6:
        found = f"K {np.round(k, 3).tolist()}"
    elif np.abs(rotation @ rotation.T - np.eye(3)).max() > ROTATION_TOLERANCE:
        found = "R that is no rotation"
    elif np.linalg.det(rotation) < 0.0:
        found = "R that mirrors (det R = -1)"
    elif bent.size > 5 and np.any(bent[5:]):
        found = f"{bent.size} distortion coefficients, more than k1 k2 p1 p2 k3"
    if found:
        asked = f"K with positive focal lengths, a rotation R and t (3,) of camera {name}"
        raise _wrong(file, asked, found)
    u, _, v = np.linalg.svd(rotation)  # the nearest rotation: files round
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = u @ v, scale_m * t.ravel()
    five = np.zeros(5)
    five[: min(5, bent.size)] = bent[:5]
    return SetCamera(name, k, five, pose)


def _json_file(folder: Path, scale_m: float) -> tuple[Path, list[SetCamera]] | None:
    file = folder / "cameras.json"
    if not file.is_file():
        return None
    try:
        content = json.loads(_text(file))
    except ValueError as error:
        raise _wrong(file, "JSON", str(error)) from error
    listed = content.get("cameras") if isinstance(content, dict) else None
    if not isinstance(listed, list) or not all(isinstance(one, dict) for one in listed):
        raise _wrong(file, 'an object with a list "cameras" of objects', type(content).__name__)
    unit = content.get("unit")
    if unit is not None and str(unit) not in UNITS:
        raise _wrong(file, f'"unit" as one of {", ".join(UNITS)}', repr(unit))
    scale_m = scale_m if unit is None else UNITS[unit]
    return file, [_json_camera(file, one, number, scale_m) for number, one in enumerate(listed)]


def _json_camera(file: Path, one: dict[str, Any], number: int, scale_m: float) -> SetCamera:
    name = str(one.get("name", number))
    if "P" in one:
        parts = _decomposed(file, name, one["P"])
    elif missing := [key for key in ("K", "R", "t") if key not in one]:
        raise _wrong(file, f"K, R and t, or P, of camera {name}", f"no {', '.join(missing)}")
    else:
        parts = (one["K"], one["R"], one["t"])
    camera = _camera(file, name, parts, scale_m, one.get("distortion") or ())
    size = (one.get("width", 0), one.get("height", 0))
    if not all(isinstance(edge, int) and edge >= 0 for edge in size):
        raise _wrong(file, f"whole numbers of pixels for camera {name}", repr(size))
    return camera.of_size(*size)


def _decomposed(file: Path, name: str, matrix: Any) -> tuple[Numbers, Numbers, Numbers]:
    try:
        return decomposed(np.asarray(matrix, np.float64))
    except (TypeError, ValueError) as error:
        raise _wrong(file, f"a projection 3 x 4 of camera {name}", str(error)) from error


def _rows(text: str) -> Iterator[list[str]]:
    for line in text.splitlines():
        words = line.split()
        if words and not line.lstrip().startswith("#"):
            yield words


def _colmap(folder: Path, scale_m: float) -> tuple[Path, list[SetCamera]] | None:
    for place in COLMAP_PLACES:
        file, images = folder / place / "cameras.txt", folder / place / "images.txt"
        if file.is_file() and images.is_file():
            return file, [*_colmap_images(images, _colmap_cameras(file), scale_m)]
    return None


def _colmap_cameras(file: Path) -> dict[str, tuple[Numbers, Numbers, int, int]]:
    found = {}
    for words in _rows(_text(file)):
        try:
            number, model, width, height = words[0], words[1], int(words[2]), int(words[3])
            values = [float(word) for word in words[4:]]
        except (IndexError, ValueError) as error:
            asked = "lines CAMERA_ID MODEL WIDTH HEIGHT PARAMS"
            raise _wrong(file, asked, repr(" ".join(words)[:60])) from error
        names = _COLMAP.get(model, ())
        if not names or len(values) != len(names):
            asked = f"a camera of {', '.join(_COLMAP)} with its parameters"
            raise _wrong(file, asked, f"{model} with {len(values)} parameters")
        known = dict(zip(names, values, strict=True))
        fx, fy = known.get("fx", known.get("f", 0.0)), known.get("fy", known.get("f", 0.0))
        # the centre of the first pixel is (0.5, 0.5) there and (0, 0) here
        k = np.array([[fx, 0.0, known["cx"] - 0.5], [0.0, fy, known["cy"] - 0.5], [0.0, 0.0, 1.0]])
        bent = np.array([known.get(key, 0.0) for key in ("k1", "k2", "p1", "p2")] + [0.0])
        found[number] = (k, bent, width, height)
    return found


def _colmap_images(
    file: Path, cameras: dict[str, tuple[Numbers, Numbers, int, int]], scale_m: float
) -> Iterator[SetCamera]:
    lines = [line for line in _text(file).splitlines() if not line.lstrip().startswith("#")]
    while lines and not lines[-1].strip():
        lines.pop()
    for line in lines[::2]:  # the lines between have the points of the image
        words = line.split()
        try:
            w, x, y, z, *t = (float(word) for word in words[1:8])
            k, bent, width, height = cameras[words[8]]
            name = words[9]
        except (IndexError, KeyError, ValueError) as error:
            asked = "lines IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, each with one of points"
            raise _wrong(file, asked, repr(line[:60])) from error
        rotation = _rotation(np.array((w, x, y, z)))
        yield _camera(file, name, (k, rotation, t), scale_m, bent).of_size(width, height)


def _rotation(quaternion: Numbers) -> Numbers:
    """Return the rotation (3, 3) of a quaternion w, x, y, z of any length; zeros of none."""
    length = float(np.linalg.norm(quaternion))
    w, x, y, z = quaternion / length if length > 0.0 else quaternion
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray((np.eye(3) + 2.0 * w * cross + 2.0 * cross @ cross) * (length > 0.0))


def _text_files(folder: Path) -> list[Path]:
    """Return the text files of a folder in which numbers may stand."""
    return sorted(
        file
        for file in folder.glob("*")
        if file.suffix.lower() in (".txt", ".par", ".cam", ".dat") and file.is_file()
    )


def _parameters(folder: Path, scale_m: float) -> tuple[Path, list[SetCamera]] | None:
    for file in (one for place in PLACES for one in _text_files(folder / place)):
        rows = [words for words in _rows(_text(file)) if len(words) > 1]
        if not rows or any(len(words) != 22 for words in rows) or not _numbers(rows[0][1:]):
            continue
        cameras = []
        for words in rows:
            values = _numbers(words[1:])
            if values is None:
                raise _wrong(file, f"21 numbers for camera {words[0]}", " ".join(words[1:])[:60])
            k, rotation = (np.reshape(values[at : at + 9], (3, 3)) for at in (0, 9))
            cameras.append(_camera(file, words[0], (k, rotation, values[18:]), scale_m))
        return file, cameras
    return None


def _numbers(words: list[str]) -> list[float] | None:
    try:
        return [float(word) for word in words]
    except ValueError:
        return None


def _projections(folder: Path, scale_m: float) -> tuple[Path, list[SetCamera]] | None:
    for place in PLACES:
        cameras = []
        files = _text_files(folder / place)
        for file in files:
            text = _text(file)
            words = [word for row in _rows(text) for word in row]
            values = _numbers(words[1:] if words[:1] == ["CONTOUR"] else words)
            if values is None or len(values) != 12:
                continue
            parts = _decomposed(file, file.stem, np.reshape(values, (3, 4)))
            cameras.append(_camera(file, file.stem, parts, scale_m))
        if cameras:
            return folder / place, cameras
    return None


_KEYS: Final = {
    "K": ("camera_matrix", "K", "M", "intrinsics", "Camera_Matrix"),
    "D": ("distortion_coefficients", "dist_coeffs", "distortion", "D", "Distortion_Coefficients"),
    "R": ("R", "rotation", "rotation_matrix", "rvec"),
    "t": ("t", "T", "translation", "tvec", "translation_vector"),
    "P": ("projection_matrix", "P"),
}


def _opencv(folder: Path, scale_m: float) -> tuple[Path, list[SetCamera]] | None:
    for place in PLACES:
        files = sorted(
            one for one in (folder / place).glob("*") if one.suffix in (".yml", ".yaml", ".xml")
        )
        cameras = [_opencv_camera(file, scale_m) for file in files]
        if cameras:
            return folder / place, cameras
    return None


def _opencv_camera(file: Path, scale_m: float) -> SetCamera:
    import cv2

    try:
        storage = cv2.FileStorage(str(file), cv2.FILE_STORAGE_READ)
    except (cv2.error, SystemError) as error:
        raise _wrong(file, "a file of cv2.FileStorage", "another kind of file") from error
    found: dict[str, Numbers] = {}
    size = [0, 0]
    try:
        for key, names in _KEYS.items():
            nodes = (storage.getNode(name) for name in names)
            matrix = next((node.mat() for node in nodes if not node.empty()), None)
            if matrix is not None:
                found[key] = np.asarray(matrix, np.float64)
        for index, names in enumerate((("image_width", "width"), ("image_height", "height"))):
            nodes = (storage.getNode(name) for name in names)
            size[index] = next((int(node.real()) for node in nodes if not node.empty()), 0)
    except cv2.error as error:
        raise _wrong(file, "matrices", error.err) from error
    finally:
        storage.release()
    if "P" in found and not {"K", "R", "t"} <= set(found):
        parts = _decomposed(file, file.stem, found["P"])
    elif missing := {"K", "R", "t"} - set(found):
        asked = "camera_matrix, R and t (or rvec and tvec), or projection_matrix"
        raise _wrong(file, asked, f"no {', '.join(sorted(missing))}")
    else:
        rotation = found["R"]
        if rotation.size == 3:
            rotation = np.asarray(cv2.Rodrigues(rotation.reshape(3, 1))[0], np.float64)
        parts = (found["K"], rotation, found["t"])
    camera = _camera(file, file.stem, parts, scale_m, found.get("D", np.zeros(5)))
    return camera.of_size(size[0], size[1])


_READERS: Final[dict[str, Callable[[Path, float], tuple[Path, list[SetCamera]] | None]]] = {
    "cameras.json": _json_file,
    "COLMAP text": _colmap,
    "parameter file": _parameters,
    "projections": _projections,
    "OpenCV": _opencv,
}
