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
from foxglove_schemas_protobuf.LinePrimitive_pb2 import LinePrimitive
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from foxglove_schemas_protobuf.SceneEntityDeletion_pb2 import SceneEntityDeletion
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from foxglove_schemas_protobuf.TriangleListPrimitive_pb2 import TriangleListPrimitive

from enact_dist.recording.drawing.drawables import (
    ShownCamera,
    ShownCapsules,
    ShownCloud,
    ShownImage,
    ShownJointPath,
    ShownJoints,
    ShownMesh,
    ShownPlain,
    ShownPose,
    ShownTrajectory,
    ShownTransform,
    ShownVoxels,
    drawables_of,
)
from enact_dist.recording.drawing.geometry import (
    encoded_indices,
    encoded_points,
    image_bytes,
    packed_points,
    quaternion,
)
from enact_dist.recording.drawing.solids import voxel_faces
from enact_dist.wire.payload import decode_untyped

if TYPE_CHECKING:
    from collections.abc import Iterator

    from google.protobuf.message import Message
    from numpy.typing import NDArray

    from enact_dist.config.shows import Shows
    from enact_dist.recording.drawing.drawables import Drawable
    from enact_dist.recording.exact import Recorded

ELEMENTS_MAX: Final = 256
"""Longer arrays stand in JSON with dtype and shape only; the exact message has them whole."""
ITEMS_MAX: Final = 1024
"""Longer lists and dicts are cut in JSON, with the number of what is left out."""
SURFACE_COLOUR: Final = (0.75, 0.75, 0.78, 1.0)
VOXEL_COLOUR: Final = (0.95, 0.55, 0.15, 0.9)
CAPSULE_COLOUR: Final = (0.25, 0.5, 0.85, 0.8)
PATH_COLOUR: Final = (0.85, 0.15, 0.5, 1.0)
PATH_WIDTH_PX: Final = 3.0
_SCENES: Final = ("mesh", "voxels", "capsules", "trajectory")
"""Kinds that are entities of a scene: they stay until another one replaces them."""


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
    pictures, unfit = [], []
    for number, (kind, drawable) in enumerate(drawables_of(value, shows).items()):
        message = _message(recorded, shows, drawable) if drawable is not None else None
        if message is None:
            unfit.append(kind)
        else:
            pictures.append(Picture(f"/{kind}" if number else "", message))
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
            yield Picture(suffix, _cloud(stamp_ns, frame, ShownCloud(np.empty((0, 3)), None)))
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


def _message(
    recorded: Recorded, shows: Shows, drawable: Drawable
) -> Message | dict[str, object] | None:
    """Return a drawable as a message; None if no message can hold it."""
    write: Any = _MESSAGES[type(drawable)]
    found: Message | dict[str, object] | None = write(recorded, shows, drawable)
    return found


def _image(recorded: Recorded, shows: Shows, shown: ShownImage) -> Message:
    data, step = image_bytes(shown.pixels)
    image = RawImage(
        frame_id=shows.frame_of(recorded.slot.entity),
        width=shown.pixels.shape[1],
        height=shown.pixels.shape[0],
        encoding=shown.encoding,
        step=step,
        data=data,
    )
    image.timestamp.FromNanoseconds(_stamp_ns(recorded))
    return image


def _point_cloud(recorded: Recorded, shows: Shows, shown: ShownCloud) -> Message:
    return _cloud(_stamp_ns(recorded), shows.frame_of(recorded.slot.entity), shown)


def _cloud(stamp_ns: int, frame: str, shown: ShownCloud) -> Message:
    data, stride, fields = packed_points(*shown)
    cloud = PointCloud(frame_id=frame, point_stride=stride, data=data)
    cloud.timestamp.FromNanoseconds(stamp_ns)
    cloud.pose.orientation.w = 1.0
    for name, offset, is_float in fields:
        number = PackedElementField.FLOAT32 if is_float else PackedElementField.UINT8
        cloud.fields.add(name=name, offset=offset, type=number)
    return cloud


def _mesh(recorded: Recorded, shows: Shows, shown: ShownMesh) -> Message:
    update, entity = _scene(recorded, shows)
    entity.triangles.append(_triangles(*shown, SURFACE_COLOUR))
    return update


def _scene(recorded: Recorded, shows: Shows) -> tuple[SceneUpdate, Any]:
    """Return a scene with one entity, that of the slot; it replaces the one before."""
    update = SceneUpdate()
    entity = update.entities.add(
        frame_id=shows.frame_of(recorded.slot.entity), id=str(recorded.slot)
    )
    entity.timestamp.FromNanoseconds(_stamp_ns(recorded))
    return update, entity


def _voxels(recorded: Recorded, shows: Shows, shown: ShownVoxels) -> Message | None:
    try:
        corners, triangles = voxel_faces(shown.indices)
    except ValueError:
        return None
    update, entity = _scene(recorded, shows)
    if len(triangles):
        vertices_m = shown.origin_m + shown.voxel_m * corners
        entity.triangles.append(_triangles(vertices_m, triangles, VOXEL_COLOUR))
    return update


def _capsules(recorded: Recorded, shows: Shows, shown: ShownCapsules) -> Message:
    update, entity = _scene(recorded, shows)
    for capsule in shown.capsules:
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


def _joints(recorded: Recorded, _: Shows, shown: ShownJoints) -> Message:
    speeds = shown.speeds if shown.speeds is not None else [None] * len(shown.names)
    states = JointStates()
    states.timestamp.FromNanoseconds(_stamp_ns(recorded))
    for name, position, speed in zip(shown.names, shown.positions, speeds, strict=True):
        joint = states.joints.add(name=name, position=float(position))
        if speed is not None:
            joint.velocity = float(speed)
    return states


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


def _pose(recorded: Recorded, shows: Shows, shown: ShownPose) -> Message:
    found = PoseInFrame(frame_id=shows.frame_of(recorded.slot.entity))
    found.timestamp.FromNanoseconds(_stamp_ns(recorded))
    _place(found.pose.position, found.pose.orientation, shown.matrix)
    return found


def _trajectory(recorded: Recorded, shows: Shows, shown: ShownTrajectory) -> Message:
    update, entity = _scene(recorded, shows)
    line = LinePrimitive()
    number = LinePrimitive.DESCRIPTOR.fields_by_name["points"].number
    line.ParseFromString(encoded_points(shown.places_m, number))
    line.type = LinePrimitive.LINE_STRIP
    line.pose.orientation.w = 1.0
    line.thickness, line.scale_invariant = PATH_WIDTH_PX, True
    _paint(line.color, PATH_COLOUR)
    entity.lines.append(line)
    return update


def _transform(recorded: Recorded, shows: Shows, shown: ShownTransform) -> Message | None:
    parent = shows.parent_of(recorded.slot.entity)
    if not parent:
        return None
    child = shows.frame_of(recorded.slot.entity)
    found = FrameTransform(parent_frame_id=parent, child_frame_id=child)
    found.timestamp.FromNanoseconds(_stamp_ns(recorded))
    _place(found.translation, found.rotation, shown.matrix)
    return found


def _place(position: Any, orientation: Any, matrix: NDArray[Any]) -> None:
    position.x, position.y, position.z = matrix[:3, 3].tolist()
    orientation.x, orientation.y, orientation.z, orientation.w = quaternion(matrix[:3, :3])


def _calibration(recorded: Recorded, shows: Shows, shown: ShownCamera) -> Message:
    message = CameraCalibration(
        frame_id=shows.frame_of(recorded.slot.entity),
        width=shown.width_px,
        height=shown.height_px,
    )
    message.timestamp.FromNanoseconds(_stamp_ns(recorded))
    message.K.extend(shown.matrix.ravel().tolist())
    message.R.extend(np.eye(3).ravel().tolist())
    message.P.extend(np.hstack((shown.matrix, np.zeros((3, 1)))).ravel().tolist())
    if len(shown.distortion):
        message.distortion_model = "plumb_bob"
        message.D.extend(shown.distortion)
    return message


# ---------------------------------------------------------------- JSON


def _as_json(recorded: Recorded, _: Shows, shown: ShownPlain) -> dict[str, object]:
    return _json(recorded, shown.value)


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
    if isinstance(value, np.longdouble):  # `tolist` leaves it as it is
        return plain(float(value))
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


_MESSAGES: Final = {
    ShownImage: _image,
    ShownCloud: _point_cloud,
    ShownMesh: _mesh,
    ShownVoxels: _voxels,
    ShownCapsules: _capsules,
    ShownJoints: _joints,
    ShownPose: _pose,
    ShownTrajectory: _trajectory,
    ShownJointPath: lambda *_: None,  # as a line it needs the model of its arm
    ShownTransform: _transform,
    ShownCamera: _calibration,
    ShownPlain: _as_json,
}
