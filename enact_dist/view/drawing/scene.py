"""What stands in the scene: the data of one moment as nodes, each in its frame."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from enact_dist.errors import ConfigError
from enact_dist.recording.drawing.drawables import (
    ShownCamera,
    ShownCapsules,
    ShownCloud,
    ShownImage,
    ShownJointPath,
    ShownJoints,
    ShownMesh,
    ShownPose,
    ShownTrajectory,
    ShownTransform,
    ShownVoxels,
    drawables_of,
)
from enact_dist.recording.drawing.solids import outer_voxels
from enact_dist.view.drawing.arms import arm_capsules, arm_path, thinned
from enact_dist.view.drawing.frames import InParent, placed
from enact_dist.view.drawing.nodes import (
    AxesNode,
    CapsulesNode,
    CubesNode,
    FrustumNode,
    LabelNode,
    LineNode,
    Node,
    PointsNode,
    RobotNode,
    SurfaceNode,
)
from enact_dist.view.drawing.pixels import SIDE_PX_MAX, rgb_of, with_mask
from enact_dist.view.drawing.robots import Robot, robot_of
from enact_dist.wire.payload import decode_untyped

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

    from numpy.typing import NDArray

    from enact_dist.config.shows import Shows
    from enact_dist.core.protocol.datum import Slot
    from enact_dist.recording.drawing.drawables import Drawable
    from enact_dist.recording.exact import Recorded

    Colour = tuple[int, int, int]

POINTS_MAX: Final = 100_000
"""Points of a larger cloud are thinned; the page says so."""
TRIANGLES_MAX: Final = 300_000
CUBES_MAX: Final = 1_000
"""More voxels than this are drawn as square points."""
VARIANTS_MAX: Final = 4
"""Nodes of one datum: with masks or models of different versions, in the colours of pages."""
FIELD_RAD: Final = math.radians(50.0)
"""Vertical field of an image whose camera is not known."""
IN_SCENE: Final = frozenset(
    ("image", "mask", "point_cloud", "mesh", "voxels", "capsules", "pose",
     "trajectory", "transform", "calibration", "joints")
)  # fmt: skip
"""Kinds of `enact_dist.config.shows` that the scene shows; the others are values in the tree."""
CLOUD_COLOURS: Final = np.array(((20, 40, 90), (150, 195, 240)), np.float64)
"""Of the lowest and of the highest points of a cloud without colours: one alone shows no shape."""
MESH_COLOUR: Final = (170, 172, 180)
VOXEL_COLOUR: Final = (242, 140, 38)
CAPSULE_COLOUR: Final = (64, 128, 217)
ARM_COLOUR: Final = (225, 120, 20)
PATH_COLOUR: Final = (215, 40, 130)
FRUSTUM_COLOUR: Final = (40, 40, 40)


@dataclass(eq=False, slots=True)
class ShownDatum:
    """One version of a datum and what can be shown of it.

    Attributes:
        recorded: The version.
        value: The datum, decoded without its type; None if it is null.
        shows: What its aspect is shown as.
        drawables: By kind; None: the datum does not fit it.
        made: Nodes and small images made of it, so that several pages share them.
        frame: Where it stands.
    """

    recorded: Recorded
    value: object
    shows: Shows
    drawables: dict[str, Drawable | None]
    made: dict[object, Any] = field(default_factory=dict)
    frame: str = field(init=False)

    def __post_init__(self) -> None:
        self.frame = self.shows.frame_of(self.recorded.slot.entity)


def shown_of(recorded: Recorded, shows: Shows) -> ShownDatum:
    """Return what can be shown of a version.

    Raises:
        ProtocolError: The datum cannot be decoded.
    """
    if recorded.datum is None:
        return ShownDatum(recorded, None, shows, {})
    value = decode_untyped(recorded.datum)
    return ShownDatum(recorded, value, shows, drawables_of(value, shows))


class SceneView(NamedTuple):
    """The scene of a moment.

    Attributes:
        nodes: By a name that stays the same from one moment to the next.
        frames: (4, 4) of each frame that a node stands in, and of those with a transform.
        remarks: What the viewer has to know: thinned clouds, frames without a common parent.
    """

    nodes: dict[str, Node]
    frames: dict[str, NDArray[np.float64]]
    remarks: tuple[str, ...]


def scene_of(
    data: Mapping[Slot, ShownDatum],
    *,
    tints: Mapping[Slot, Colour] | None = None,
    frames_of: Mapping[Slot, ShownDatum] | None = None,
    sides_px: Mapping[str, int] | None = None,
) -> SceneView:
    """Return the scene of the data of one moment.

    Args:
        data: The data that are to be drawn.
        tints: Colours of data in place of their own.
        frames_of: Data whose transforms hold where `data` have none.
        sides_px: Longest side of the image in each frame; `SIDE_PX_MAX` in all others.
    """
    tints, sides_px = tints or {}, sides_px or {}
    nodes: dict[str, Node] = {}
    remarks: list[str] = []
    transforms = dict(_transforms([*(frames_of or {}).values(), *data.values()]))
    for slot, shown in data.items():
        tint = tints.get(slot)
        for kind, drawable in shown.drawables.items():
            made = _made(shown, kind, drawable, tint)
            if isinstance(drawable, ShownJoints | ShownJointPath):
                model = data.get(slot._replace(aspect=shown.shows.model))
                try:
                    made = _arm(shown, drawable, model, tint)
                except ConfigError as error:
                    remarks.append(f"{slot} v{shown.recorded.version}: {error}")
            if made is not None:
                nodes[f"{slot}#{kind}"] = made
            remarks += _thinned(slot, drawable, made)
            if drawable is None:
                remarks.append(f"{slot} v{shown.recorded.version} does not fit the kind {kind}")
    for camera in _cameras(data, tints).values():
        side_px = sides_px.get(camera.frame, SIDE_PX_MAX)
        nodes[f"{camera.parts[0].recorded.slot}#camera"] = _frustum(camera, side_px)
        remarks += camera.remarks
    asked = dict.fromkeys([*(node.frame for node in nodes.values()), *transforms])
    frames = placed(transforms, asked)
    if len(frames.roots) > 1:
        named = ", ".join(frames.roots[:6]) + (", …" if frames.roots[6:] else "")
        remarks.append(f"no transform joins the frames {named}: all stand at the origin")
    if frames.circular:
        remarks.append(f"transforms of {', '.join(frames.circular)} go round in a circle")
    return SceneView(nodes, frames.poses, tuple(remarks))


def _transforms(data: Iterable[ShownDatum]) -> Iterator[tuple[str, InParent]]:
    for shown in data:
        found, entity = shown.drawables.get("transform"), shown.recorded.slot.entity
        if isinstance(found, ShownTransform):
            yield shown.frame, InParent(shown.shows.parent_of(entity), found.matrix)


def _made(
    shown: ShownDatum, kind: str, drawable: Drawable | None, tint: Colour | None
) -> Node | None:
    """Return the node of a drawable, made once; None if it is none, or empty."""
    key = ("node", kind, tint)
    if key not in shown.made:
        shown.made[key] = _node(shown.frame, drawable, tint)
    node: Node | None = shown.made[key]
    return node


def _node(frame: str, drawable: Drawable | None, tint: Colour | None) -> Node | None:
    if isinstance(drawable, ShownCloud):
        return _points(frame, drawable, tint)
    if isinstance(drawable, ShownMesh):
        vertices = np.asarray(drawable.vertices_m, np.float32)
        triangles = drawable.triangles[:TRIANGLES_MAX]
        fits = (triangles >= 0).all(axis=1) & (triangles < len(vertices)).all(axis=1)
        triangles = triangles[fits].astype(np.uint32)
        if not len(triangles) or not np.isfinite(vertices).all():
            return None
        return SurfaceNode(frame, vertices, triangles, tint or MESH_COLOUR)
    if isinstance(drawable, ShownVoxels):
        try:
            indices = outer_voxels(drawable.indices)
        except ValueError:
            return None
        if not len(indices):
            return None
        middles = drawable.origin_m + drawable.voxel_m * (indices + 0.5)
        centres = middles.astype(np.float32)
        colour = tint or VOXEL_COLOUR
        if len(centres) > CUBES_MAX:
            step = _stride(len(centres))
            return PointsNode(frame, centres[::step], colour, drawable.voxel_m, step)
        return CubesNode(frame, centres, drawable.voxel_m, colour)
    if isinstance(drawable, ShownCapsules) and drawable.capsules:
        return CapsulesNode(frame, drawable.capsules, tint or CAPSULE_COLOUR)
    if isinstance(drawable, ShownPose):
        return AxesNode(frame, drawable.matrix, tint)
    if isinstance(drawable, ShownTrajectory):
        return _path(frame, drawable.places_m, tint)
    return None


def _path(frame: str, places_m: NDArray[np.float64], tint: Colour | None) -> LineNode | None:
    if len(places_m) < 2:
        return None
    with np.errstate(over="ignore"):
        kept = thinned(places_m).astype(np.float32)
    return LineNode(frame, kept, tint or PATH_COLOUR) if np.isfinite(kept).all() else None


def _arm(
    shown: ShownDatum,
    joints: ShownJoints | ShownJointPath,
    model: ShownDatum | None,
    tint: Colour | None,
) -> Node | None:
    """Return an arm at the positions of its joints, or its path; None without a model that fits.

    Raises:
        ConfigError: Its file cannot be drawn, or has other joints.
    """
    file = shown.shows.urdf
    described = robot_of(file) if file is not None else model
    if described is None:
        return None
    key = ("arm", type(joints), tint, id(described))
    known = shown.made.get(key)
    if known is None:
        _forget_older(shown.made, "arm")
        node = _arm_node(shown, joints, described, tint)
        known = shown.made[key] = node, described  # referenced, so that its id stays its own
    arm: Node | None = known[0]
    return arm


def _arm_node(
    shown: ShownDatum,
    joints: ShownJoints | ShownJointPath,
    described: Robot | ShownDatum,
    tint: Colour | None,
) -> Node | None:
    if isinstance(described, ShownDatum):
        if isinstance(joints, ShownJointPath):
            places_m = arm_path(described.value, joints.positions_rad)
            return _path(shown.frame, places_m, tint) if places_m is not None else None
        capsules = arm_capsules(described.value, joints.positions)
        return CapsulesNode(shown.frame, capsules, tint or ARM_COLOUR) if capsules else None
    if isinstance(joints, ShownJointPath):
        return None  # `Shows` gives a robot of a file no model, and so no path of joints
    poses = described.poses(joints, named=bool(shown.shows.joints))
    return RobotNode(shown.frame, described.shapes, poses, tint) if len(poses) else None


def _stride(count: int) -> int:
    return -(-count // POINTS_MAX)


def _points(frame: str, cloud: ShownCloud, tint: Colour | None) -> PointsNode | None:
    step = max(1, _stride(len(cloud.points_m)))
    with np.errstate(over="ignore"):
        points = np.asarray(cloud.points_m[::step], np.float32)
    there = np.isfinite(points).all(axis=1)
    if not there.any():
        return None
    points = points[there]
    if tint is not None:
        return PointsNode(frame, points, tint, 0.0, step)
    if cloud.colours is None:
        return PointsNode(frame, points, _by_height(points[:, 2]), 0.0, step)
    colours = np.ascontiguousarray(cloud.colours[::step][there])
    return PointsNode(frame, points, colours, 0.0, step)


def _by_height(heights_m: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Return colours (N, 3) of points by their heights (N,); a few outliers do not count."""
    low, high = np.quantile(heights_m.astype(np.float64), (0.02, 0.98))
    shares = np.clip((heights_m - low) / max(high - low, 1e-9), 0.0, 1.0)[:, None]
    dark, light = CLOUD_COLOURS
    return np.asarray(np.rint(dark + shares * (light - dark)), np.uint8)


def _thinned(slot: Slot, drawable: Drawable | None, node: Node | None) -> Iterator[str]:
    if isinstance(node, PointsNode) and node.one_in > 1:
        yield f"{slot} has more than {POINTS_MAX} points; one in {node.one_in} is shown"
    if isinstance(drawable, ShownMesh) and len(drawable.triangles) > TRIANGLES_MAX:
        yield f"{slot} has {len(drawable.triangles)} triangles; {TRIANGLES_MAX} are shown"
    if isinstance(drawable, ShownTrajectory | ShownJointPath) and isinstance(node, LineNode):
        count, kept = len(drawable[0]), len(node.places_m)
        if kept < count:
            yield f"{slot} has {count} places; a line through {kept} of them is shown"


# ---------------------------------------------------------------- cameras


@dataclass(eq=False, slots=True)
class _Camera:
    """What is known of the camera of a frame."""

    frame: str
    image: ShownDatum | None = None
    masks: list[ShownDatum] = field(default_factory=list)
    calibration: ShownDatum | None = None
    tint: Colour | None = None
    remarks: list[str] = field(default_factory=list)

    @property
    def parts(self) -> list[ShownDatum]:
        """All of them, at least one."""
        every = (self.image, *self.masks, self.calibration)
        return [one for one in every if one is not None]


def _cameras(data: Mapping[Slot, ShownDatum], tints: Mapping[Slot, Colour]) -> dict[str, _Camera]:
    cameras: dict[str, _Camera] = {}
    for slot, shown in data.items():
        for kind, drawable in shown.drawables.items():
            if not isinstance(drawable, ShownImage | ShownCamera):
                continue
            camera = cameras.setdefault(shown.frame, _Camera(shown.frame))
            camera.tint = tints.get(slot, camera.tint)
            if kind == "image" and camera.image is not None:
                first = camera.image.recorded.slot
                camera.remarks.append(f"{slot} is behind {first}: hide that to see this image")
            elif kind == "image":
                camera.image = shown
            elif kind == "mask":
                camera.masks.append(shown)
            else:
                camera.calibration = shown
    return cameras


def _frustum(camera: _Camera, side_px: int) -> FrustumNode:
    first, *others = camera.parts
    key = ("frustum", camera.tint, side_px, *map(id, others))
    known = first.made.get(key)
    if known is None:
        _forget_older(first.made, "frustum")
        # The parts stay referenced with the node, so that their ids stay theirs.
        known = first.made[key] = _new_frustum(camera, side_px), others
    node: FrustumNode = known[0]
    return node


def _forget_older(made: dict[object, Any], what: str) -> None:
    """Keep the newest few nodes of a kind; threads of other pages may do the same."""
    older = [each for each in list(made) if isinstance(each, tuple) and each[0] == what]
    for each in older[: 1 - VARIANTS_MAX]:
        made.pop(each, None)


def _new_frustum(camera: _Camera, side_px: int) -> FrustumNode:
    image = None
    pictures = [(camera.image, "image")] + [(mask, "mask") for mask in camera.masks]
    for shown, kind in pictures:
        drawable = shown.drawables[kind] if shown is not None else None
        if isinstance(drawable, ShownImage) and all(drawable.shape):
            image = rgb_of(drawable, side_px) if image is None else with_mask(image, drawable)
    pinhole = camera.calibration and camera.calibration.drawables["calibration"]
    if isinstance(pinhole, ShownCamera) and pinhole.matrix[1, 1] > 0 and pinhole.height_px > 0:
        field_rad = 2.0 * math.atan(pinhole.height_px / (2.0 * pinhole.matrix[1, 1]))
        aspect = pinhole.width_px / pinhole.height_px
    else:
        shape = image.shape if image is not None else (3, 4)
        field_rad, aspect = FIELD_RAD, shape[1] / shape[0]
    colour = camera.tint or FRUSTUM_COLOUR
    return FrustumNode(camera.frame, field_rad, aspect or 1.0, image, colour)


# ---------------------------------------------------------------- extent, labels


def extent_of(scene: SceneView) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """Return the lowest and the highest corner (3,) of a scene, metres; None if it is empty."""
    corners = []
    for node in scene.nodes.values():
        places = _places(node)
        pose = scene.frames.get(node.frame, np.eye(4))
        corners.append(places @ pose[:3, :3].T + pose[:3, 3])
    if not corners:
        return None
    every = np.concatenate(corners)
    return every.min(axis=0), every.max(axis=0)


def _places(node: Node) -> NDArray[np.float64]:
    """Return corners (N, 3) of what a node covers, in its frame."""
    if isinstance(node, CapsulesNode):
        corners = [
            capsule.ends_m + sign * capsule.radius_m
            for capsule in node.capsules
            for sign in (-1.0, 1.0)
        ]
        found = np.concatenate(corners)
    elif isinstance(node, PointsNode):
        found = np.asarray(node.points_m, np.float64)
    elif isinstance(node, SurfaceNode):
        found = np.asarray(node.vertices_m, np.float64)
    elif isinstance(node, RobotNode):
        moved = [
            shape.corners_m @ pose[:3, :3].T + pose[:3, 3]
            for shape, pose in zip(node.shapes, node.poses, strict=True)
        ]
        found = np.concatenate(moved)
    elif isinstance(node, LineNode):
        found = np.asarray(node.places_m, np.float64)
    elif isinstance(node, CubesNode):
        found = np.asarray(node.centres_m, np.float64)
    elif isinstance(node, AxesNode):
        return np.asarray(node.matrix[None, :3, 3], np.float64)
    else:
        return np.zeros((1, 3))
    return np.stack((found.min(axis=0), found.max(axis=0)))


def labels_of(scene: SceneView, texts: Mapping[str, str]) -> dict[str, LabelNode]:
    """Return a label for each entity that has a text and a node: at the middle of its first node.

    Args:
        scene: Where the entities are.
        texts: By entity.
    """
    found: dict[str, LabelNode] = {}
    for name, node in scene.nodes.items():
        entity = name.partition(":")[2].partition("#")[0].rpartition("/")[0]
        if entity in texts and f"label {entity}" not in found:
            middle = _places(node).mean(axis=0)
            found[f"label {entity}"] = LabelNode(node.frame, texts[entity], middle)
    return found
