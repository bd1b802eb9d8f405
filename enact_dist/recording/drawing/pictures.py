"""A datum as messages that Foxglove shows and Rerun converts: images, clouds, meshes, poses, JSON.

`enact_dist.config.shows` lists what is shown as which kind.  Geometry is protobuf: Rerun converts
Foxglove's schemas in that encoding only, and an image in JSON would be a third larger for its
base64.  Stamps inside messages are the capture's, else the commit's.
"""

from __future__ import annotations

import json
import math
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.JointStates_pb2 import JointStates
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from foxglove_schemas_protobuf.SceneEntityDeletion_pb2 import SceneEntityDeletion
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from foxglove_schemas_protobuf.TriangleListPrimitive_pb2 import TriangleListPrimitive

from enact_dist.recording.drawing.geometry import (
    encoded_indices,
    encoded_points,
    image_bytes,
    is_rigid,
    packed_points,
    quaternion,
)
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
from enact_dist.recording.drawing.solids import capsule_of, voxel_faces
from enact_dist.wire.payload import decode_untyped

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from google.protobuf.message import Message
    from numpy.typing import NDArray

    from enact_dist.config.shows import Shows
    from enact_dist.recording.exact import Recorded

ELEMENTS_MAX: Final = 256
"""Longer arrays stand in JSON with dtype and shape only; the exact message has them whole."""
ITEMS_MAX: Final = 1024
"""Longer lists and dicts are cut in JSON, with the number of what is left out."""
SURFACE_COLOUR: Final = (0.75, 0.75, 0.78, 1.0)
VOXEL_COLOUR: Final = (0.95, 0.55, 0.15, 0.9)
CAPSULE_COLOUR: Final = (0.25, 0.5, 0.85, 0.8)
_SCENES: Final = ("mesh", "voxels", "capsules")
"""Kinds that are entities of a scene: they stay until another one replaces them."""
_CAMERA: Final = ("width_px", "height_px", "fx_px", "fy_px", "cx_px", "cy_px")
_BY_SHAPE: Final = {
    ("u1", 2): "mono8", ("u1", 3): "rgb8", ("u1", 4): "rgba8", ("u2", 2): "16UC1",
    ("f4", 2): "32FC1",
}  # fmt: skip


class Picture(NamedTuple):
    """One message to look at.

    Attributes:
        suffix: What its topic has behind the slot's ("" or ``/transform`` and the like).
        message: A message of Foxglove's schemas, or what JSON holds.
    """

    suffix: str
    message: Message | dict[str, object]


class Pictures(NamedTuple):
    """All messages of one version, and the kinds that were wanted and do not fit it."""

    pictures: list[Picture]
    unfit: list[str]


def pictures_of(recorded: Recorded, shows: Shows) -> Pictures:
    """Return what a version looks like.

    Raises:
        ProtocolError: The datum cannot be decoded.
    """
    if recorded.datum is None:
        return Pictures([*_endings(recorded, shows)], [])
    value = decode_untyped(recorded.datum)
    part = part_at(value, shows.of)
    kinds = shows.kinds or (guess(value),)
    pictures, unfit = [], []
    for kind in kinds:
        message = _KINDS[kind](recorded, shows, part)
        if message is None:
            unfit.append(kind)
        else:
            pictures.append(Picture("" if kind == kinds[0] else f"/{kind}", message))
    if not pictures:
        pictures.append(Picture("/json", _json(recorded, value)))
    return Pictures(pictures, unfit)


def _endings(recorded: Recorded, shows: Shows) -> Iterator[Picture]:
    """Yield what takes the pictures of a datum away that is null now, where there is such."""
    stamp_ns = recorded.stamp_ns
    for kind in shows.kinds:
        suffix = "" if kind == shows.kinds[0] else f"/{kind}"
        if kind in _SCENES:
            update = SceneUpdate()
            gone = update.deletions.add(type=SceneEntityDeletion.MATCHING_ID)
            gone.id = str(recorded.slot)
            gone.timestamp.FromNanoseconds(stamp_ns)
            yield Picture(suffix, update)
        elif kind == "point_cloud":
            frame = shows.frame_of(recorded.slot.entity)
            yield Picture(suffix, _cloud(stamp_ns, frame, np.empty((0, 3)), None))
        elif kind == "joints":
            states = JointStates()
            states.timestamp.FromNanoseconds(stamp_ns)
            yield Picture(suffix, states)
        elif kind == "json":
            yield Picture(suffix, _json(recorded, None))
    if not shows.kinds:
        yield Picture("/null", _json(recorded, None))


# ---------------------------------------------------------------- the kinds


def _stamp_ns(recorded: Recorded) -> int:
    return recorded.captured_ns or recorded.stamp_ns


def _image(recorded: Recorded, shows: Shows, part: object) -> Message | None:
    array = next((array for array, _ in arrays_of(part) if is_image(array)), None)
    if array is None:
        return None
    channels = array.shape[2] if array.ndim == 3 else 2
    kind = array.dtype.kind + str(array.dtype.itemsize)
    encoding = shows.encoding or _BY_SHAPE[kind, channels]
    return _raw_image(recorded, shows, array, encoding)


def _mask(recorded: Recorded, shows: Shows, part: object) -> Message | None:
    for array, beside in arrays_of(part):
        if array.ndim == 2 and array.dtype.kind + str(array.dtype.itemsize) in ("b1", "u1"):
            if array is beside.get("packed"):
                array = np.unpackbits(array, axis=1)  # noqa: PLW2901 - bits for pixels
            pixels = np.where(array != 0, np.uint8(255), np.uint8(0))
            return _raw_image(recorded, shows, pixels, "mono8")
    return None


def _raw_image(recorded: Recorded, shows: Shows, pixels: NDArray[Any], encoding: str) -> Message:
    data, step = image_bytes(pixels)
    image = RawImage(
        frame_id=shows.frame_of(recorded.slot.entity),
        width=pixels.shape[1],
        height=pixels.shape[0],
        encoding=encoding,
        step=step,
        data=data,
    )
    image.timestamp.FromNanoseconds(_stamp_ns(recorded))
    return image


def _point_cloud(recorded: Recorded, shows: Shows, part: object) -> Message | None:
    for array, beside in arrays_of(part):
        if is_points(array):
            frame = shows.frame_of(recorded.slot.entity)
            colours = array_beside(beside, "u", len(array))
            return _cloud(_stamp_ns(recorded), frame, array, colours)
    return None


def _cloud(
    stamp_ns: int, frame: str, points_m: NDArray[Any], colours: NDArray[Any] | None
) -> Message:
    data, stride, fields = packed_points(points_m, colours)
    cloud = PointCloud(frame_id=frame, point_stride=stride, data=data)
    cloud.timestamp.FromNanoseconds(stamp_ns)
    cloud.pose.orientation.w = 1.0
    for name, offset, is_float in fields:
        number = PackedElementField.FLOAT32 if is_float else PackedElementField.UINT8
        cloud.fields.add(name=name, offset=offset, type=number)
    return cloud


def _mesh(recorded: Recorded, shows: Shows, part: object) -> Message | None:
    for array, beside in arrays_of(part):
        triangles = array_beside(beside, "iu") if is_points(array) else None
        if triangles is not None:
            update, entity = _scene(recorded, shows)
            entity.triangles.append(_triangles(array, triangles, SURFACE_COLOUR))
            return update
    return None


def _scene(recorded: Recorded, shows: Shows) -> tuple[SceneUpdate, Any]:
    """Return a scene with one entity, that of the slot; it replaces the one before."""
    update = SceneUpdate()
    entity = update.entities.add(
        frame_id=shows.frame_of(recorded.slot.entity), id=str(recorded.slot)
    )
    entity.timestamp.FromNanoseconds(_stamp_ns(recorded))
    return update, entity


def _voxels(recorded: Recorded, shows: Shows, part: object) -> Message | None:
    for array, beside in arrays_of(part):
        if array.ndim != 2 or array.shape[1] != 3 or array.dtype.kind not in "iu":
            continue
        voxel_m = number_of(beside.get("voxel_m")) or shows.voxel_m
        origin_m = beside.get("origin_m")
        if not isinstance(origin_m, np.ndarray) or origin_m.dtype.kind not in "fiu":
            origin_m = np.array(shows.origin_m)
        if not voxel_m or origin_m.shape != (3,):
            return None
        try:
            corners, triangles = voxel_faces(array)
        except ValueError:
            return None
        update, entity = _scene(recorded, shows)
        if len(triangles):
            vertices_m = origin_m + voxel_m * corners
            entity.triangles.append(_triangles(vertices_m, triangles, VOXEL_COLOUR))
        return update
    return None


def _capsules(recorded: Recorded, shows: Shows, part: object) -> Message | None:
    for array, _ in arrays_of(part):
        if array.ndim != 2 or array.shape[1] != 7 or array.dtype.kind != "f":
            continue
        update, entity = _scene(recorded, shows)
        for row in array[np.isfinite(array).all(axis=1)]:
            capsule = capsule_of(row)
            wide_m = 2.0 * capsule.radius_m
            solids = [(entity.spheres.add(), end_m, wide_m) for end_m in capsule.ends_m]
            if capsule.length_m > 0.0:
                cylinder = entity.cylinders.add(bottom_scale=1.0, top_scale=1.0)
                solids.append((cylinder, capsule.pose[:3, 3], capsule.length_m))
            for solid, middle_m, high_m in solids:
                matrix = capsule.pose.copy()
                matrix[:3, 3] = middle_m
                _place(solid.pose.position, solid.pose.orientation, matrix)
                solid.size.x, solid.size.y, solid.size.z = wide_m, wide_m, high_m
                _paint(solid.color, CAPSULE_COLOUR)
        return update
    return None


def _joints(recorded: Recorded, shows: Shows, part: object) -> Message | None:
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
        newest = np.atleast_2d(array)[-1]
        speeds = np.atleast_2d(alike[0])[-1] if alike else [None] * len(newest)
        states = JointStates()
        states.timestamp.FromNanoseconds(_stamp_ns(recorded))
        for name, position, speed in zip(names, newest, speeds, strict=True):
            joint = states.joints.add(name=name, position=float(position))
            if speed is not None:
                joint.velocity = float(speed)
        return states
    return None


def _paint(colour: Any, rgba: tuple[float, float, float, float]) -> None:
    colour.r, colour.g, colour.b, colour.a = rgba


def _triangles(
    vertices_m: NDArray[Any], triangles: NDArray[Any], rgba: tuple[float, float, float, float]
) -> TriangleListPrimitive:
    fields = TriangleListPrimitive.DESCRIPTOR.fields_by_name
    points = encoded_points(vertices_m, fields["points"].number)
    indices = encoded_indices(triangles, fields["indices"].number)
    primitive = TriangleListPrimitive()
    primitive.ParseFromString(points + indices)
    primitive.pose.orientation.w = 1.0
    _paint(primitive.color, rgba)
    return primitive


def _pose(recorded: Recorded, shows: Shows, part: object) -> Message | None:
    matrix = next((array for array, _ in arrays_of(part) if is_rigid(array)), None)
    if matrix is None:
        return None
    found = PoseInFrame(frame_id=shows.frame_of(recorded.slot.entity))
    found.timestamp.FromNanoseconds(_stamp_ns(recorded))
    _place(found.pose.position, found.pose.orientation, matrix)
    return found


def _transform(recorded: Recorded, shows: Shows, part: object) -> Message | None:
    matrix = next((array for array, _ in arrays_of(part) if is_rigid(array)), None)
    parent = shows.parent_of(recorded.slot.entity)
    if matrix is None or not parent:
        return None
    child = shows.frame_of(recorded.slot.entity)
    found = FrameTransform(parent_frame_id=parent, child_frame_id=child)
    found.timestamp.FromNanoseconds(_stamp_ns(recorded))
    matrix = np.linalg.inv(matrix) if shows.inverse else matrix
    _place(found.translation, found.rotation, matrix)
    return found


def _place(position: Any, orientation: Any, matrix: NDArray[Any]) -> None:
    position.x, position.y, position.z = matrix[:3, 3].tolist()
    orientation.x, orientation.y, orientation.z, orientation.w = quaternion(matrix[:3, :3])


def _calibration(recorded: Recorded, shows: Shows, part: object) -> Message | None:
    for found in parts_of(part, {}):
        camera = _pinhole(found.value)
        if camera is not None:
            width, height, matrix, distortion = camera
            message = CameraCalibration(
                frame_id=shows.frame_of(recorded.slot.entity), width=width, height=height
            )
            message.timestamp.FromNanoseconds(_stamp_ns(recorded))
            message.K.extend(matrix.ravel().tolist())
            message.R.extend(np.eye(3).ravel().tolist())
            message.P.extend(np.hstack((matrix, np.zeros((3, 1)))).ravel().tolist())
            if len(distortion):
                message.distortion_model = "plumb_bob"
                message.D.extend(distortion)
            return message
    return None


def _pinhole(value: object) -> tuple[int, int, NDArray[np.float64], list[float]] | None:
    """Return width, height, camera matrix and distortion of a camera; None if it is none."""
    if not isinstance(value, dict):
        return None
    if all(name in value for name in _CAMERA):
        width, height, fx, fy, cx, cy = (number_of(value[name]) for name in _CAMERA)
        return int(width), int(height), np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]]), []
    matrix, distortion = value.get("camera_matrix"), value.get("distortion")
    width, height = number_of(value.get("width")), number_of(value.get("height"))
    if isinstance(matrix, np.ndarray) and matrix.shape == (3, 3) and matrix.dtype.kind == "f":
        coefficients: list[float] = []
        if isinstance(distortion, np.ndarray) and distortion.dtype.kind == "f":
            coefficients = distortion.ravel().tolist()
        return int(width), int(height), matrix.astype(np.float64), coefficients
    return None


# ---------------------------------------------------------------- JSON


def _as_json(recorded: Recorded, _: Shows, part: object) -> dict[str, object]:
    return _json(recorded, part)


def _json(recorded: Recorded, value: object) -> dict[str, object]:
    return {
        "value": plain(value),
        "null": recorded.null_reason,
        "version": recorded.version,
        "stamp_ns": recorded.stamp_ns,
        "shard": recorded.shard,
        "actor": recorded.actor,
    }


def plain(value: object) -> object:
    """Return a datum's value as JSON can carry it; long arrays as dtype and shape."""
    if isinstance(value, dict):
        items = list(value.items())
        found = {str(key): plain(each) for key, each in items[:ITEMS_MAX]}
        return found if len(items) <= ITEMS_MAX else found | {"…": len(items) - ITEMS_MAX}
    if isinstance(value, list | tuple):
        listed = [plain(each) for each in value[:ITEMS_MAX]]
        return listed if len(value) <= ITEMS_MAX else [*listed, f"… {len(value) - ITEMS_MAX} more"]
    if isinstance(value, np.ndarray):
        if value.size <= ELEMENTS_MAX and value.dtype.kind in "biufU":
            return plain(value.tolist())
        return {"dtype": str(value.dtype), "shape": list(value.shape)}
    if isinstance(value, bytes):
        return {"bytes": len(value), "hex": value[:64].hex()}
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    return value


def json_bytes(message: dict[str, object]) -> bytes:
    """Return a JSON message in its stored form."""
    return json.dumps(message, ensure_ascii=False, allow_nan=False).encode()


def json_schema(example: object) -> dict[str, object]:
    """Return the JSON schema of values like `example`, so that a plot offers their fields."""
    if isinstance(example, dict):
        properties = {key: json_schema(each) for key, each in example.items()}
        return {"type": "object", "properties": properties}
    if isinstance(example, list):
        return {"type": "array", "items": json_schema(example[0]) if example else {}}
    for kind, name in ((bool, "boolean"), (int, "integer"), (float, "number"), (str, "string")):
        if isinstance(example, kind):
            return {"type": name}
    return {}


_KINDS: Final[
    dict[str, Callable[[Recorded, Shows, object], Message | dict[str, object] | None]]
] = {
    "image": _image,
    "mask": _mask,
    "point_cloud": _point_cloud,
    "mesh": _mesh,
    "voxels": _voxels,
    "capsules": _capsules,
    "joints": _joints,
    "pose": _pose,
    "transform": _transform,
    "calibration": _calibration,
    "json": _as_json,
}
