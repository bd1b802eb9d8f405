"""A datum as messages that Foxglove shows and Rerun converts: images, clouds, meshes, poses, JSON.

What is a picture of what stands in `enact_dist.config_shows`.  Geometry is protobuf: Rerun converts
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
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from foxglove_schemas_protobuf.SceneEntityDeletion_pb2 import SceneEntityDeletion
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from foxglove_schemas_protobuf.TriangleListPrimitive_pb2 import TriangleListPrimitive

from enact_dist.recording.geometry import (
    encoded_indices,
    encoded_points,
    image_bytes,
    is_rigid,
    packed_points,
    quaternion,
)
from enact_dist.wire.payload import decode_untyped

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from google.protobuf.message import Message
    from numpy.typing import NDArray

    from enact_dist.config_shows import Shows
    from enact_dist.recording.exact import Recorded

ELEMENTS_MAX: Final = 256
"""Longer arrays stand in JSON with dtype and shape only; the exact message has them whole."""
ITEMS_MAX: Final = 1024
"""Longer lists and dicts are cut in JSON, with the number of what is left out."""
SURFACE_COLOUR: Final = (0.75, 0.75, 0.78, 1.0)
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


class _Part(NamedTuple):
    """A part of a datum and the fields that stand beside it."""

    value: object
    beside: Mapping[str, object]


def pictures_of(recorded: Recorded, shows: Shows) -> Pictures:
    """Return what a version looks like.

    Raises:
        ProtocolError: The datum cannot be decoded.
    """
    if recorded.datum is None:
        return Pictures([*_endings(recorded, shows)], [])
    value = decode_untyped(recorded.datum)
    part = _at(value, shows.of)
    kinds = shows.kinds or (_guess(value),)
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
        if kind == "mesh":
            update = SceneUpdate()
            gone = update.deletions.add(type=SceneEntityDeletion.MATCHING_ID)
            gone.id = str(recorded.slot)
            gone.timestamp.FromNanoseconds(stamp_ns)
            yield Picture(suffix, update)
        elif kind == "point_cloud":
            frame = shows.frame_of(recorded.slot.entity)
            yield Picture(suffix, _cloud(stamp_ns, frame, np.empty((0, 3)), None))
        elif kind == "json":
            yield Picture(suffix, _json(recorded, None))
    if not shows.kinds:
        yield Picture("/null", _json(recorded, None))


# ---------------------------------------------------------------- parts


def _at(value: object, path: str) -> object:
    for name in path.split(".") if path else ():
        value = value.get(name) if isinstance(value, dict) else None
    return value


def _parts(value: object, beside: Mapping[str, object]) -> Iterator[_Part]:
    """Yield a value and all that it consists of, in the order of its fields."""
    yield _Part(value, beside)
    if isinstance(value, dict):
        for each in value.values():
            yield from _parts(each, value)
    elif isinstance(value, list | tuple):
        for each in value:
            yield from _parts(each, beside)


def _arrays(value: object) -> Iterator[tuple[NDArray[Any], Mapping[str, object]]]:
    for part in _parts(value, {}):
        if isinstance(part.value, np.ndarray):
            yield part.value, part.beside


def _guess(value: object) -> str:
    if isinstance(value, np.ndarray):
        if _is_image(value) and value.ndim == 3:
            return "image"
        return "pose" if is_rigid(value) else "json"
    if isinstance(value, dict) and "__type__" in value:
        if "vertices_m" in value and "triangles" in value:
            return "mesh"
        if "points_m" in value:
            return "point_cloud"
    return "json"


def _is_image(array: NDArray[Any]) -> bool:
    if array.ndim == 3:
        return array.dtype == np.uint8 and array.shape[2] in (3, 4) and array.size > 0
    kind = array.dtype.kind + str(array.dtype.itemsize)
    return array.ndim == 2 and kind in ("u1", "u2", "f4") and array.size > 0


def _is_points(array: NDArray[Any]) -> bool:
    return array.ndim == 2 and array.shape[1] == 3 and array.dtype.kind == "f"


def _beside(
    beside: Mapping[str, object], kinds: str, length: int | None = None
) -> NDArray[Any] | None:
    """Return the first array (N, 3) of those kinds of dtype among fields."""
    for value in beside.values():
        if (
            isinstance(value, np.ndarray)
            and value.ndim == 2
            and value.shape[1] == 3
            and value.dtype.kind in kinds
            and (length is None or (len(value) == length and value.dtype == np.uint8))
        ):
            return value
    return None


# ---------------------------------------------------------------- the kinds


def _stamp_ns(recorded: Recorded) -> int:
    return recorded.captured_ns or recorded.stamp_ns


def _image(recorded: Recorded, shows: Shows, part: object) -> Message | None:
    array = next((array for array, _ in _arrays(part) if _is_image(array)), None)
    if array is None:
        return None
    channels = array.shape[2] if array.ndim == 3 else 2
    kind = array.dtype.kind + str(array.dtype.itemsize)
    encoding = shows.encoding or _BY_SHAPE[kind, channels]
    return _raw_image(recorded, shows, array, encoding)


def _mask(recorded: Recorded, shows: Shows, part: object) -> Message | None:
    for array, _ in _arrays(part):
        if array.ndim == 2 and array.dtype.kind + str(array.dtype.itemsize) in ("b1", "u1"):
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
    for array, beside in _arrays(part):
        if _is_points(array):
            frame = shows.frame_of(recorded.slot.entity)
            colours = _beside(beside, "u", len(array))
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
    for array, beside in _arrays(part):
        triangles = _beside(beside, "iu") if _is_points(array) else None
        if triangles is not None:
            update = SceneUpdate()
            entity = update.entities.add(
                frame_id=shows.frame_of(recorded.slot.entity), id=str(recorded.slot)
            )
            entity.timestamp.FromNanoseconds(_stamp_ns(recorded))
            entity.triangles.append(_triangles(array, triangles))
            return update
    return None


def _triangles(vertices_m: NDArray[Any], triangles: NDArray[Any]) -> TriangleListPrimitive:
    fields = TriangleListPrimitive.DESCRIPTOR.fields_by_name
    points = encoded_points(vertices_m, fields["points"].number)
    indices = encoded_indices(triangles, fields["indices"].number)
    primitive = TriangleListPrimitive()
    primitive.ParseFromString(points + indices)
    primitive.pose.orientation.w = 1.0
    colour = primitive.color
    colour.r, colour.g, colour.b, colour.a = SURFACE_COLOUR
    return primitive


def _pose(recorded: Recorded, shows: Shows, part: object) -> Message | None:
    matrix = next((array for array, _ in _arrays(part) if is_rigid(array)), None)
    if matrix is None:
        return None
    found = PoseInFrame(frame_id=shows.frame_of(recorded.slot.entity))
    found.timestamp.FromNanoseconds(_stamp_ns(recorded))
    _place(found.pose.position, found.pose.orientation, matrix)
    return found


def _transform(recorded: Recorded, shows: Shows, part: object) -> Message | None:
    matrix = next((array for array, _ in _arrays(part) if is_rigid(array)), None)
    parent = shows.parent_of(recorded.slot.entity)
    if matrix is None or not parent:
        return None
    child = shows.frame_of(recorded.slot.entity)
    found = FrameTransform(parent_frame_id=parent, child_frame_id=child)
    found.timestamp.FromNanoseconds(_stamp_ns(recorded))
    _place(found.translation, found.rotation, matrix)
    return found


def _place(position: Any, orientation: Any, matrix: NDArray[Any]) -> None:
    position.x, position.y, position.z = matrix[:3, 3].tolist()
    orientation.x, orientation.y, orientation.z, orientation.w = quaternion(matrix[:3, :3])


def _calibration(recorded: Recorded, shows: Shows, part: object) -> Message | None:
    for found in _parts(part, {}):
        camera = found.value
        if isinstance(camera, dict) and all(name in camera for name in _CAMERA):
            width, height, fx, fy, cx, cy = (float(camera[name]) for name in _CAMERA)
            message = CameraCalibration(
                frame_id=shows.frame_of(recorded.slot.entity), width=int(width), height=int(height)
            )
            message.timestamp.FromNanoseconds(_stamp_ns(recorded))
            message.K.extend((fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0))
            message.R.extend((1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0))
            message.P.extend((fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0))
            return message
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
    """Return a JSON message as it stands in the file."""
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
    "pose": _pose,
    "transform": _transform,
    "calibration": _calibration,
    "json": _as_json,
}
