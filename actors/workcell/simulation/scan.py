"""A simulated depth sensor that is carried around the empty cell, for `ShapeReconstruction`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, cast

import numpy as np

from actors.geometry.poses import inverse, looking_at, moved
from actors.geometry.shapes import VGA, Acquisition, Camera, DepthFrame
from actors.geometry.surfaces.rendering import cast as cast_rays
from actors.geometry.surfaces.rendering import directions, ray_scene
from actors.palletizing.simulation.noise import sensed
from actors.palletizing.simulation.products import box_mesh
from actors.workcell.simulation.room import BOXES, HALF_M

if TYPE_CHECKING:
    from collections.abc import Sequence
    from typing import Any

    import numpy.typing as npt

    from actors.workcell.simulation.room import Box

VIEWS: Final = 36
FAR_M: Final = 2.3
"""How far from a thing's middle the sensor stands."""


def scan_of_room(
    seed: int, *, boxes: Sequence[Box] = BOXES, views: int = VIEWS, camera: Camera = VGA
) -> list[DepthFrame]:
    """Return depth images of the empty cell, from around each thing at two heights."""
    vertices, triangles = _room(boxes)
    found = []
    for number in range(views):
        box = boxes[number % len(boxes)]
        turn = 2.0 * np.pi * (number // len(boxes) + 0.5) / max(1, views // len(boxes))
        up_m = (0.9, 1.9)[number // len(boxes) % 2] + box.half_m[2]
        middle = np.array(box.centre_m)
        eye = middle + np.array((FAR_M * np.cos(turn), FAR_M * np.sin(turn), 0.0))
        eye[:2] = eye[:2].clip(-HALF_M + 0.2, HALF_M - 0.2)
        eye[2] = up_m
        pose = looking_at(eye, middle)
        scene: Any = ray_scene(moved(vertices, inverse(pose)), triangles)
        depth_m = cast_rays(scene, directions(camera))
        random = np.random.default_rng([seed, number])
        found.append(DepthFrame(sensed(depth_m, random), Acquisition(camera, pose)))
    return found


def _room(boxes: Sequence[Box]) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.int32]]:
    """Return floor and boxes as one mesh."""
    parts = [(box_mesh((2.0 * HALF_M, 2.0 * HALF_M, 0.01)), np.array((0.0, 0.0, -0.01)))]
    for box in boxes:
        size = cast("tuple[float, float, float]", tuple(2.0 * half for half in box.half_m))
        foot = np.array((*box.centre_m[:2], box.centre_m[2] - box.half_m[2]))
        parts.append((box_mesh(size), foot))
    first = np.cumsum([0] + [len(mesh[0]) for mesh, _ in parts])
    vertices = np.concatenate([mesh[0] + offset for mesh, offset in parts])
    triangles = [mesh[1] + start for (mesh, _), start in zip(parts, first, strict=False)]
    return vertices, np.concatenate(triangles)
