"""The scene of one browser: draws nodes with viser, and sends only what has changed."""

from __future__ import annotations

import itertools
import math
from functools import singledispatchmethod
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from enact_dist.recording.drawing.geometry import quaternion
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
from enact_dist.view.drawing.pixels import SIDES_PX
from enact_dist.view.drawing.shapes import (
    CUBE,
    CYLINDER,
    SPHERE,
    capsule_bodies,
    capsule_ends,
    linear,
    unturned,
)

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray
    from viser import ClientHandle

    from enact_dist.view.drawing.scene import SceneView
    from enact_dist.view.drawing.shapes import Instances, ShapeMesh

JPEG_QUALITY: Final = 75
FRUSTUM_M: Final = 0.06
"""Of a frustum, in sizes of the scene."""
_FROM: Final = np.array((0.75, -0.75, 0.6))
"""From where a page looks, in sizes of the scene."""


class Canvas:
    """What one browser shows in its scene.  Used by one thread.

    Args:
        client: The browser.

    Attributes:
        size_m: Length by which the size of axes, frusta and points is chosen.
    """

    def __init__(self, client: ClientHandle) -> None:
        self._client, self._scene = client, client.scene
        self._drawn: dict[str, tuple[Node, Any, str]] = {}
        self._frames: dict[str, tuple[NDArray[np.float64], Any]] = {}
        self._numbers: dict[str, int] = {}
        self._next = itertools.count()
        self.size_m = 1.0

    def draw(self, scenes: Mapping[str, SceneView]) -> int:
        """Show these scenes and nothing else; return how many nodes were sent.

        Args:
            scenes: By a name of their own; a node that is the same object as before is not sent
                again.
        """
        sent = 0
        wanted = {f"{side}{name}" for side, scene in scenes.items() for name in scene.nodes}
        for name in [name for name in self._drawn if name not in wanted]:
            self._drawn.pop(name)[1].remove()
            self._numbers.pop(name, None)
        for side, scene in scenes.items():
            for frame, pose in scene.frames.items():
                self._place(f"{side}{frame}", pose)
            for name, node in scene.nodes.items():
                known = self._drawn.get(f"{side}{name}")
                if known is None or not _is_same(known[0], node):
                    self._send(f"{side}{name}", f"{side}{node.frame}", node)
                    sent += 1
        self._leave(scenes)
        return sent

    def _leave(self, scenes: Mapping[str, SceneView]) -> None:
        """Remove the frames in which nothing stands any more."""
        wanted = {f"{side}{frame}" for side, scene in scenes.items() for frame in scene.frames}
        for side, scene in scenes.items():
            wanted.update(f"{side}{node.frame}" for node in scene.nodes.values())
        for frame in self._frames.keys() - wanted:
            self._frames.pop(frame)[1].remove()
            self._numbers.pop(f"frame {frame}", None)

    def sides_px(self) -> dict[str, int]:
        """Return how many pixels the longest side of each camera's image needs, by frame.

        A frustum that stands small in the page needs few; a person who looks closer gets more.
        """
        camera = self._client.camera
        scale_px = camera.image_height / (2.0 * math.tan(camera.fov / 2.0))  # at 1 m
        eye_m = np.asarray(camera.position)
        found: dict[str, int] = {}
        for node, _, _ in self._drawn.values():
            if isinstance(node, FrustumNode) and node.frame in self._frames:
                pose, _ = self._frames[node.frame]
                away_m = float(np.linalg.norm(pose[:3, 3] - eye_m)) + 1e-3
                shown_px = FRUSTUM_M * self.size_m * _side_of(node) / away_m * scale_px
                found[node.frame] = next((px for px in SIDES_PX if px >= shown_px), SIDES_PX[-1])
        return found

    def fit(self, low_m: NDArray[np.float64], high_m: NDArray[np.float64]) -> None:
        """Look at everything between two corners (3,); choose the sizes of axes, frusta, points."""
        self.size_m = max(0.05, float(max(high_m - low_m)))
        for _, handle, _ in self._drawn.values():
            handle.remove()
        self._drawn.clear()
        middle_m = (low_m + high_m) / 2.0
        cell_m = 10.0 ** math.floor(math.log10(self.size_m / 2.0))
        self._scene.add_grid(
            "/grid",
            width=2.0 * self.size_m,
            height=2.0 * self.size_m,
            cell_size=cell_m,
            section_size=10.0 * cell_m,
            position=(middle_m[0], middle_m[1], min(0.0, low_m[2])),
        )
        camera = self._client.camera
        camera.position = tuple(middle_m + self.size_m * _FROM)
        camera.look_at = tuple(middle_m)

    def _place(self, frame: str, pose: NDArray[np.float64]) -> None:
        known = self._frames.get(frame)
        if known is not None and (known[0] is pose or known[0].tobytes() == pose.tobytes()):
            return
        turned, place = _pose(pose)
        if known is None:
            handle = self._scene.add_frame(
                self._frame_name(frame), show_axes=False, wxyz=turned, position=place
            )
        else:
            handle = known[1]
            handle.wxyz, handle.position = turned, place
        self._frames[frame] = pose, handle

    def _send(self, name: str, frame: str, node: Node) -> None:
        if frame not in self._frames:
            self._place(frame, np.eye(4))
        before = self._drawn.get(name)
        path = f"{self._frame_name(frame)}/{self._number(name)}"
        if before is not None and before[2] == path and self._moved(before[1], before[0], node):
            self._drawn[name] = node, before[1], path
            return
        if before is not None and (before[2] != path or type(before[0]) is not type(node)):
            before[1].remove()
        self._drawn[name] = node, self._add(node, path), path

    def _frame_name(self, frame: str) -> str:
        return f"/f{self._number(f'frame {frame}')}"

    def _number(self, name: str) -> int:
        """Return the number that stands for a name in the paths of the scene."""
        if name not in self._numbers:
            self._numbers[name] = next(self._next)
        return self._numbers[name]

    # ------------------------------------------------------------ kinds

    def _moved(self, handle: Any, before: Node, node: Node) -> bool:
        """Change what is there, if that is enough; return whether it is."""
        if isinstance(node, FrustumNode) and isinstance(before, FrustumNode):
            same = (before.field_rad, before.aspect, before.colour)
            if same == (node.field_rad, node.aspect, node.colour) and node.image is not None:
                handle.image = node.image
                return True
        if isinstance(node, AxesNode) and isinstance(before, AxesNode):
            handle.wxyz, handle.position = _pose(node.matrix)
            return before.colour == node.colour
        if isinstance(node, PointsNode) and isinstance(before, PointsNode):
            one_colour = isinstance(node.colours, tuple) and isinstance(before.colours, tuple)
            if one_colour and (before.colours, before.size_m) == (node.colours, node.size_m):
                handle.points = node.points_m
                return True
        if isinstance(node, CapsulesNode) and isinstance(before, CapsulesNode):
            same_shapes = len(before.capsules) == len(node.capsules)
        elif isinstance(node, RobotNode) and isinstance(before, RobotNode):
            same_shapes = before.shapes is node.shapes
        else:
            return False
        if same_shapes and before.colour == node.colour:
            handle.move(node)
            return True
        return False

    @singledispatchmethod
    def _add(self, node: Node, path: str) -> Any:
        raise AssertionError(f"no way to draw {node!r} at {path}")

    @_add.register
    def _(self, node: FrustumNode, path: str) -> Any:
        return self._scene.add_camera_frustum(
            path,
            node.field_rad,
            node.aspect,
            scale=FRUSTUM_M * self.size_m,
            thickness=0.003 * self.size_m,
            color=node.colour,
            image=node.image,
            format="jpeg",
            jpeg_quality=JPEG_QUALITY,
            cast_shadow=False,
            receive_shadow=False,
        )

    @_add.register
    def _(self, node: PointsNode, path: str) -> Any:
        return self._scene.add_point_cloud(
            path,
            node.points_m,
            node.colours,
            point_size=node.size_m or 0.004 * self.size_m,
            point_shape="square" if node.size_m else "rounded",
            precision="float32",
        )

    @_add.register
    def _(self, node: SurfaceNode, path: str) -> Any:
        return self._scene.add_mesh_simple(
            path, node.vertices_m, node.triangles, color=node.colour, side="double"
        )

    @_add.register
    def _(self, node: CubesNode, path: str) -> Any:
        return self._instances(path, CUBE, unturned(node.centres_m, node.edge_m), node.colour)

    @_add.register
    def _(self, node: CapsulesNode, path: str) -> Any:
        return _Capsules(
            self._instances(f"{path}e", SPHERE, capsule_ends(node.capsules), node.colour),
            self._instances(f"{path}b", CYLINDER, capsule_bodies(node.capsules), node.colour),
        )

    def _instances(
        self, path: str, mesh: ShapeMesh, instances: Instances, colour: tuple[int, int, int]
    ) -> Any:
        turns, places, sizes = instances
        return self._scene.add_batched_meshes_simple(
            path,
            *mesh,
            turns,
            places,
            batched_scales=sizes,
            batched_colors=linear(colour),
            flat_shading=mesh is CUBE,
            lod="off",
            cast_shadow=False,
        )

    @_add.register
    def _(self, node: RobotNode, path: str) -> Any:
        parts = [
            self._scene.add_mesh_simple(
                f"{path}s{number}",
                shape.vertices_m,
                shape.triangles,
                color=node.colour or shape.colour,
                flat_shading=True,
            )
            for number, shape in enumerate(node.shapes)
        ]
        robot = _Robot(parts)
        robot.move(node)
        return robot

    @_add.register
    def _(self, node: AxesNode, path: str) -> Any:
        turned, place = _pose(node.matrix)
        length_m = 0.05 * self.size_m
        return self._scene.add_frame(
            path,
            axes_length=length_m,
            axes_radius=0.06 * length_m,
            origin_color=node.colour or (236, 236, 0),
            origin_radius=(0.25 if node.colour else 0.1) * length_m,
            wxyz=turned,
            position=place,
        )

    @_add.register
    def _(self, node: LineNode, path: str) -> Any:
        pairs = np.stack((node.places_m[:-1], node.places_m[1:]), axis=1)
        return self._scene.add_line_segments(
            path,
            pairs,
            node.colour,
            thickness=0.003 * self.size_m,
            thickness_units="world",
        )

    @_add.register
    def _(self, node: LabelNode, path: str) -> Any:
        return self._scene.add_label(path, node.text, position=tuple(node.place_m))


def _side_of(node: FrustumNode) -> float:
    """Return the longer side of a frustum's image in its scale: viser keeps the volume as it is."""
    y = math.tan(node.field_rad / 2.0)
    x = y * node.aspect
    return 2.0 * max(x, y) / math.cbrt(x * y / 3.0)


def _is_same(before: Node, node: Node) -> bool:
    """Whether what is drawn looks like a node: labels are made anew for each picture."""
    if not isinstance(before, LabelNode) or not isinstance(node, LabelNode):
        return before is node
    same = (before.frame, before.text) == (node.frame, node.text)
    return same and np.array_equal(before.place_m, node.place_m)


class _Capsules:
    """The spheres and the cylinders of capsules: they move without being sent again."""

    def __init__(self, ends: Any, bodies: Any) -> None:
        self._ends, self._bodies = ends, bodies

    def move(self, node: CapsulesNode) -> None:
        for handle, instances in (
            (self._ends, capsule_ends(node.capsules)),
            (self._bodies, capsule_bodies(node.capsules)),
        ):
            handle.batched_wxyzs, handle.batched_positions, handle.batched_scales = instances

    def remove(self) -> None:
        self._ends.remove()
        self._bodies.remove()


class _Robot:
    """The shapes of a robot: they move without being sent again."""

    def __init__(self, parts: list[Any]) -> None:
        self._parts = parts

    def move(self, node: RobotNode) -> None:
        for part, pose in zip(self._parts, node.poses, strict=True):
            part.wxyz, part.position = _pose(pose)

    def remove(self) -> None:
        for part in self._parts:
            part.remove()


def _pose(
    matrix: NDArray[Any],
) -> tuple[tuple[float, float, float, float], tuple[float, float, float]]:
    """Return w x y z and the place of a rigid (4, 4)."""
    x, y, z, w = quaternion(matrix[:3, :3])
    east, north, up = map(float, matrix[:3, 3])
    return (w, x, y, z), (east, north, up)
