"""A small place that can be seen exactly, and recordings of it on disk."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest

from actors.geometry.poses import looking_at

WIDTH, HEIGHT, FOCAL = 320, 240, 280.0
BOX_LOW, BOX_HIGH = np.array([-0.15, -0.10, 0.0]), np.array([0.15, 0.10, 0.15])
BALL_CENTRE, BALL_RADIUS = np.array([0.0, 0.25, 0.10]), 0.10


def distance_to_place(points):
    """Return the distance of points (N, 3) to the nearest surface of the place, metres."""
    middle, half = (BOX_LOW + BOX_HIGH) / 2.0, (BOX_HIGH - BOX_LOW) / 2.0
    outside = np.abs(points - middle) - half
    box = np.linalg.norm(np.maximum(outside, 0.0), axis=1) + np.minimum(outside.max(1), 0.0)
    ball = np.linalg.norm(points - BALL_CENTRE, axis=1) - BALL_RADIUS
    return np.minimum(np.abs(np.minimum(box, ball)), np.abs(points[:, 2]))


def seen(pose):
    """Return depth (H, W) in metres and colour (H, W, 3) of the place, by exact intersection."""
    v, u = np.mgrid[0:HEIGHT, 0:WIDTH].reshape(2, -1)
    local = np.stack([(u - 159.5) / FOCAL, (v - 119.5) / FOCAL, np.ones(u.size)], 1)
    rays, eye = local @ pose[:3, :3].T, pose[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        floor = np.where(rays[:, 2] < 0.0, -eye[2] / rays[:, 2], np.inf)
        one, other = (BOX_LOW - eye) / rays, (BOX_HIGH - eye) / rays
    enter, leave = np.minimum(one, other).max(1), np.maximum(one, other).min(1)
    box = np.where((enter < leave) & (enter > 0.0), enter, np.inf)
    a, b = (rays**2).sum(1), rays @ (eye - BALL_CENTRE)
    root = b**2 - a * ((eye - BALL_CENTRE) @ (eye - BALL_CENTRE) - BALL_RADIUS**2)
    ball = np.where(root > 0.0, (-b - np.sqrt(np.maximum(root, 0.0))) / a, np.inf)
    depth = np.minimum(np.minimum(floor, box), ball)
    colour = np.where((floor <= depth)[:, None], (90, 120, 160), (200, 60, 40))
    return depth.reshape(HEIGHT, WIDTH), colour.reshape(HEIGHT, WIDTH, 3).astype(np.uint8)


@lru_cache
def view(step):
    """Return pose, depth in millimetres and colour of the n-th view, 10 degrees on from the last."""
    angle = np.radians(-90.0 + 10.0 * step)
    eye = np.array([0.75 * np.cos(angle), 0.75 * np.sin(angle), 0.6])
    pose = looking_at(eye, np.array([0.0, 0.05, 0.08]))
    depth, colour = seen(pose)
    return pose, np.rint(np.minimum(depth, 4.0) * 1000.0).astype(np.uint16), colour


@dataclass
class RecordingOnDisk:
    """Writes a recording of the place; tests change its parts before or after."""

    folder: Path
    flat: bool = False
    views: int = 6
    depth_mm: list = field(default_factory=list)
    colour: list = field(default_factory=list)
    poses: list = field(default_factory=list)

    def __post_init__(self):
        for step in range(self.views):
            pose, depth_mm, colour = view(step)
            self.poses.append(pose.copy())
            self.depth_mm.append(depth_mm.copy())
            self.colour.append(colour.copy())

    def colour_file(self, number):
        """Return where the colour image of a view lies."""
        return self.folder / (f"c{number}.jpg" if self.flat else f"color/{number:05d}.jpg")

    def depth_file(self, number):
        """Return where the depth image of a view lies."""
        return self.folder / (f"d{number}.png" if self.flat else f"depth/{number:05d}.png")

    def write(self):
        """Write all files; return the folder."""
        import cv2

        for number in range(self.views):
            for path in (self.colour_file(number), self.depth_file(number)):
                path.parent.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(self.colour_file(number)), self.colour[number][:, :, ::-1])
            cv2.imwrite(str(self.depth_file(number)), self.depth_mm[number])
        self.write_intrinsics()
        self.write_trajectory()
        return self.folder

    def write_intrinsics(self, width=WIDTH, height=HEIGHT, focal=FOCAL):
        """Write the camera, column by column as Open3D does."""
        matrix = [focal, 0.0, 0.0, 0.0, focal, 0.0, 159.5, 119.5, 1.0]
        content = {"width": width, "height": height, "intrinsic_matrix": matrix}
        (self.folder / "camera.json").write_text(json.dumps(content), encoding="utf-8")

    def write_trajectory(self):
        """Write the poses in Redwood's format."""
        lines = []
        for number, pose in enumerate(self.poses):
            lines.append(f"{number} {number} {number + 1}")
            lines += [" ".join(repr(float(value)) for value in row) for row in pose]
        (self.folder / "trajectory.log").write_text("\n".join(lines) + "\n", encoding="utf-8")


@pytest.fixture
def recording(tmp_path):
    """A recording of six views with folders, not yet written."""
    return RecordingOnDisk(tmp_path / "recording")


@pytest.fixture
def flat_recording(tmp_path):
    """A recording of six views without folders, not yet written."""
    return RecordingOnDisk(tmp_path / "recording", flat=True)


@pytest.fixture
def place_distance():
    """The exact distance to the surfaces of the recorded place."""
    return distance_to_place
