"""What can be shown of a datum, whatever shows it: images, clouds, meshes, solids, poses, cameras.

`enact_dist.config.shows` lists what is shown as which kind.  `pictures` writes these things as
Foxglove's messages, `enact_dist.view` draws them in a browser.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from enact_dist.recording.drawing.geometry import is_rigid, path_of
from enact_dist.recording.drawing.parts import (
    array_beside,
    arrays_of,
    guess,
    is_image,
    is_points,
    number_of,
    part_at,
    parts_of,
)
from enact_dist.recording.drawing.solids import Capsule, capsules_of

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from numpy.typing import NDArray

    from enact_dist.config.shows import Shows

_CAMERA: Final = ("width_px", "height_px", "fx_px", "fy_px", "cx_px", "cy_px")
_BY_SHAPE: Final = {
    ("u1", 2): "mono8", ("u1", 3): "rgb8", ("u1", 4): "rgba8", ("u2", 2): "16UC1",
    ("f4", 2): "32FC1",
}  # fmt: skip


class ShownImage:
    """An image, or a mask as 0 and 255.

    Args:
        pixels: (H, W), (H, W, 3) or (H, W, 4), of the dtype that the encoding says; of a packed
            mask (H, W / 8) uint8, a bit for each pixel.
        encoding: One of `enact_dist.config.shows.ENCODINGS`.
        packed: Whether it is a packed mask.

    Attributes:
        encoding: As above.
    """

    __slots__ = ("_packed", "_pixels", "encoding")

    def __init__(self, pixels: NDArray[Any], encoding: str, *, packed: bool = False) -> None:
        self._pixels, self.encoding, self._packed = pixels, encoding, packed

    @property
    def shape(self) -> tuple[int, ...]:
        """That of the pixels."""
        rows, columns, *channels = self._pixels.shape
        return (rows, 8 * columns if self._packed else columns, *channels)

    @property
    def pixels(self) -> NDArray[Any]:
        """(H, W), (H, W, 3) or (H, W, 4), of the dtype that the encoding says."""
        return self.every_nth(1)

    def every_nth(self, step: int) -> NDArray[Any]:
        """Return every n-th pixel of every n-th row; of a packed mask no others are unpacked."""
        rows = self._pixels if step == 1 else np.ascontiguousarray(self._pixels[::step])
        if self._packed:  # whole rows come from cold memory faster
            rows = np.unpackbits(rows, axis=1)
            np.negative(rows, out=rows)  # 1 becomes 255
        return rows[:, ::step]

    def covered(self, step: int) -> tuple[int, int, NDArray[np.uint8]]:
        """Return what a mask covers, as `every_nth` pixel: a box, its first row and column.

        The box (h, w) holds 1 and 0; all pixels around it are 0, and none of them is unpacked.
        """
        rows = self._pixels[::step]
        there = [np.flatnonzero(rows.any(axis=axis)) for axis in (1, 0)]
        if not len(there[0]):
            return 0, 0, np.zeros((0, 0), np.uint8)
        (top, bottom), (left, right) = ((int(one[0]), int(one[-1]) + 1) for one in there)
        box = rows[top:bottom, left:right]
        if self._packed:
            box, left = np.unpackbits(box, axis=1), 8 * left
        first = -left % step
        return top, (left + first) // step, (box[:, first::step] != 0).view(np.uint8)


class ShownCloud(NamedTuple):
    """Points.

    Attributes:
        points_m: (N, 3) floats, metres.
        colours: (N, 3) uint8, red, green, blue; None: the cloud has none.
    """

    points_m: NDArray[Any]
    colours: NDArray[Any] | None


class ShownMesh(NamedTuple):
    """A surface.

    Attributes:
        vertices_m: (N, 3) floats, metres.
        triangles: (M, 3) integers, numbers of vertices.
    """

    vertices_m: NDArray[Any]
    triangles: NDArray[Any]


class ShownVoxels(NamedTuple):
    """Occupied voxels.

    Attributes:
        indices: (N, 3) integers in the grid.
        voxel_m: Edge of a voxel, above 0.
        origin_m: (3,) lowest corner of the grid.
    """

    indices: NDArray[Any]
    voxel_m: float
    origin_m: NDArray[Any]


class ShownCapsules(NamedTuple):
    """Capsules, those of finite numbers alone."""

    capsules: tuple[Capsule, ...]


class ShownJoints(NamedTuple):
    """Joints by name.

    Attributes:
        positions: (J,) floats, rad or m.
        speeds: (J,) floats, rad/s or m/s; None: the datum has none.
    """

    names: tuple[str, ...]
    positions: NDArray[Any]
    speeds: NDArray[Any] | None


class ShownPose(NamedTuple):
    """Where a thing is in its frame: (4, 4) rigid, metres."""

    matrix: NDArray[Any]


class ShownTrajectory(NamedTuple):
    """A path through its frame: (N, 3) floats, metres, those places alone that are finite."""

    places_m: NDArray[np.float64]


class ShownJointPath(NamedTuple):
    """A path of an arm's joints: (N, J) floats, rad, those rows alone that are finite."""

    positions_rad: NDArray[np.float64]


class ShownTransform(NamedTuple):
    """Where a frame is in its parent: (4, 4) rigid, metres."""

    matrix: NDArray[Any]


class ShownCamera(NamedTuple):
    """A pinhole camera.

    Attributes:
        width_px: Columns of its image.
        height_px: Rows of its image.
        matrix: (3, 3) floats, pixels.
        distortion: Coefficients as OpenCV orders them; empty if it has none.
    """

    width_px: int
    height_px: int
    matrix: NDArray[np.float64]
    distortion: list[float]


class ShownPlain(NamedTuple):
    """Anything else: numbers, texts, lists and dicts."""

    value: object


Drawable = (
    ShownImage
    | ShownCloud
    | ShownMesh
    | ShownVoxels
    | ShownCapsules
    | ShownJoints
    | ShownPose
    | ShownTrajectory
    | ShownJointPath
    | ShownTransform
    | ShownCamera
    | ShownPlain
)


def drawables_of(value: object, shows: Shows) -> dict[str, Drawable | None]:
    """Return what is shown of a datum that was decoded without its type, by kind.

    Args:
        value: The datum.
        shows: What its aspect is shown as.

    Returns:
        One entry for each kind that is wanted, or the guessed one; None: the datum does not fit it.
    """
    part = part_at(value, shows.of)
    kinds = shows.kinds or (guess(value),)
    return {kind: _KINDS[kind](part, shows) for kind in kinds}


def _image(part: object, shows: Shows) -> ShownImage | None:
    array = next((array for array, _ in arrays_of(part) if is_image(array)), None)
    if array is None:
        return None
    channels = array.shape[2] if array.ndim == 3 else 2
    kind = array.dtype.kind + str(array.dtype.itemsize)
    return ShownImage(array, shows.encoding or _BY_SHAPE[kind, channels])


def _mask(part: object, _: Shows) -> ShownImage | None:
    for array, beside in arrays_of(part):
        if array.ndim == 2 and array.dtype.kind + str(array.dtype.itemsize) in ("b1", "u1"):
            if array is beside.get("packed") and array.dtype == np.uint8:
                return ShownImage(array, "mono8", packed=True)
            covers = (array != 0).view(np.uint8)
            return ShownImage(np.negative(covers, out=covers), "mono8")  # 1 becomes 255
    return None


def _named_first(part: object, name: str) -> list[tuple[NDArray[Any], Mapping[str, object]]]:
    """Return the arrays of a part with the fields beside each, those of a field's name first."""
    return sorted(arrays_of(part), key=lambda found: found[0] is not found[1].get(name))


def _point_cloud(part: object, _: Shows) -> ShownCloud | None:
    for array, beside in _named_first(part, "points_m"):
        if is_points(array):
            return ShownCloud(array, array_beside(beside, "u", len(array)))
    return None


def _mesh(part: object, _: Shows) -> ShownMesh | None:
    for array, beside in _named_first(part, "vertices_m"):
        named = {name: beside[name] for name in ("triangles",) if name in beside}
        triangles = array_beside({**named, **beside}, "iu") if is_points(array) else None
        if triangles is not None:
            return ShownMesh(array, triangles)
    return None


def _voxels(part: object, shows: Shows) -> ShownVoxels | None:
    for array, beside in arrays_of(part):
        if array.ndim != 2 or array.shape[1] != 3 or array.dtype.kind not in "iu":
            continue
        voxel_m = number_of(beside.get("voxel_m")) or shows.voxel_m
        origin_m = beside.get("origin_m")
        if not isinstance(origin_m, np.ndarray) or origin_m.dtype.kind not in "fiu":
            origin_m = np.array(shows.origin_m)
        if not voxel_m or origin_m.shape != (3,) or not np.isfinite(origin_m).all():
            return None
        return ShownVoxels(array, voxel_m, origin_m)
    return None


def _capsules(part: object, _: Shows) -> ShownCapsules | None:
    for array, _beside in arrays_of(part):
        if array.ndim == 2 and array.shape[1] == 7 and array.dtype.kind == "f":
            return ShownCapsules(capsules_of(array[np.isfinite(array).all(axis=1)]))
    return None


def _joints(part: object, shows: Shows) -> ShownJoints | None:
    for array, beside in arrays_of(part):
        if array.dtype.kind != "f" or array.ndim not in (1, 2) or not array.size:
            continue
        names = shows.joints or tuple(f"joint_{at + 1}" for at in range(array.shape[-1]))
        if len(names) != array.shape[-1]:
            return None
        alike = [
            other
            for other in beside.values()
            if isinstance(other, np.ndarray)
            and other is not array
            and (other.shape, other.dtype.kind) == (array.shape, "f")
        ]
        speeds = np.atleast_2d(alike[0])[-1] if alike else None
        return ShownJoints(names, np.atleast_2d(array)[-1], speeds)
    return None


def _rigid(part: object) -> NDArray[Any] | None:
    return next((array for array, _ in arrays_of(part) if is_rigid(array)), None)


def _pose(part: object, _: Shows) -> ShownPose | None:
    matrix = _rigid(part)
    return ShownPose(matrix) if matrix is not None else None


def _trajectory(part: object, shows: Shows) -> ShownTrajectory | ShownJointPath | None:
    if shows.model:
        found = (array for array, _ in arrays_of(part) if array.ndim == 2)
        rows = next((array for array in found if array.dtype.kind == "f"), None)
        if rows is None:
            return None
        return ShownJointPath(rows[np.isfinite(rows).all(axis=1)].astype(np.float64))
    for array, _beside in _named_first(part, "points_m"):
        places_m = path_of(array)
        if places_m is not None:
            return ShownTrajectory(places_m[np.isfinite(places_m).all(axis=1)])
    return None


def _transform(part: object, shows: Shows) -> ShownTransform | None:
    matrix = _rigid(part)
    if matrix is None:
        return None
    return ShownTransform(np.linalg.inv(matrix.astype(np.float64)) if shows.inverse else matrix)


def _calibration(part: object, _: Shows) -> ShownCamera | None:
    cameras = (_pinhole(found.value) for found in parts_of(part, {}))
    return next((camera for camera in cameras if camera is not None), None)


def _pinhole(value: object) -> ShownCamera | None:
    if not isinstance(value, dict):
        return None
    if all(name in value for name in _CAMERA):
        width, height, fx, fy, cx, cy = (number_of(value[name]) for name in _CAMERA)
        pinhole = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
        return ShownCamera(int(width), int(height), pinhole, [])
    matrix, distortion = value.get("camera_matrix"), value.get("distortion")
    width, height = number_of(value.get("width")), number_of(value.get("height"))
    if isinstance(matrix, np.ndarray) and matrix.shape == (3, 3) and matrix.dtype.kind == "f":
        coefficients: list[float] = []
        if isinstance(distortion, np.ndarray) and distortion.dtype.kind == "f":
            coefficients = distortion.ravel().tolist()
        return ShownCamera(int(width), int(height), matrix.astype(np.float64), coefficients)
    return None


def _plain(part: object, _: Shows) -> ShownPlain:
    return ShownPlain(part)


_KINDS: Final[dict[str, Callable[[object, Shows], Drawable | None]]] = {
    "image": _image,
    "mask": _mask,
    "point_cloud": _point_cloud,
    "mesh": _mesh,
    "voxels": _voxels,
    "capsules": _capsules,
    "joints": _joints,
    "pose": _pose,
    "trajectory": _trajectory,
    "transform": _transform,
    "calibration": _calibration,
    "json": _plain,
}
