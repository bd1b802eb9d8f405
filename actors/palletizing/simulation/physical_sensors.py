"""SIMULATED depth sensors that see what physics did: ray casting of the cell's present poses.

One looks down at the tray, one at the end of the belt.  Packages are drawn with their dents, arm
and gripper where they are: a sensor that shall see all of the tray has the arm moved aside first.

Rules a change must keep: an image depends on the seed, the simulated time, how many were taken at
that time, and on what it shows; the sensor of the tray is that of the list-driven simulator, so
that perception knows no difference.
"""

from __future__ import annotations

from functools import lru_cache, partial
from typing import TYPE_CHECKING, ClassVar, Final

import numpy as np

from actors.geometry.arms.kinematics import link_poses
from actors.geometry.poses import along_z, inverse, moved
from actors.geometry.shapes import VGA, Acquisition, DepthFrame
from actors.palletizing.control.controller import ControllerError
from actors.palletizing.simulation.cell.scene import (
    ARM,
    BELT_AHEAD_M,
    BELT_HALF_M,
    BIN_HALF_M,
    BIN_WALL_M,
    HAND_HALF_M,
    PAD_CENTRE_M,
    PAD_HALF_M,
    CellLayout,
)
from actors.palletizing.simulation.noise import sensed
from actors.palletizing.simulation.physical_packages import dented_mesh
from actors.palletizing.simulation.products import box_mesh, hull_mesh
from actors.palletizing.simulation.sensors import (
    OVERHEAD_M,
    Repeats,
    drawn,
    looking_down,
    shifted,
    tray_meshes,
    true_depth,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    import numpy.typing as npt

    from actors.palletizing.simulation.cell.truth import ShownCell, ShownPackage

    F64 = npt.NDArray[np.float64]
    Mesh = tuple[F64, npt.NDArray[np.int32]]
    Drawn = tuple[tuple[slice, slice], npt.NDArray[np.float32]]

BELT_OVERHEAD_M: Final = 0.80
"""Height of the belt's sensor above the belt."""
BELT_LOOKS_AT_M: Final = -0.10
"""Where it looks, along the belt from the light barrier: at the middle of what has arrived."""


class _FixedSensor:
    """A depth sensor at a fixed place over the physical cell.

    Args:
        shown: Returns what moves in the cell, as it is now.
        seed: Seed of the noise.
        layout: Where things stand.

    Attributes:
        over: The area of the layout whose frame is the world of its poses.
        eye_m: Where in that frame it looks down from.
        noise: Added to the seed: sensors of one seed differ in their noise.
    """

    over: ClassVar[str]
    eye_m: ClassVar[tuple[float, float, float]]
    noise: ClassVar[int] = 0

    def __init__(
        self, shown: Callable[[], ShownCell], *, seed: int, layout: CellLayout | None = None
    ) -> None:
        self._shown, self._layout = shown, layout or CellLayout()
        self._world_from_base = inverse(self._layout.frames()[self.over])
        self._true = Acquisition(VGA, looking_down(np.array(self.eye_m)))
        self._seed = seed + self.noise
        self._moment = Repeats()
        self._frozen: tuple[int, DepthFrame] | None = None
        self._still_m: npt.NDArray[np.float32] | None = None
        self._drawn: dict[bytes, Drawn] = {}

    def capture_empty(self) -> DepthFrame:
        """Return an image with nothing but what stands still."""
        random = np.random.default_rng([self._seed, 0])
        return DepthFrame(sensed(self._still_depth(), random), self._true)

    def capture(self, stop: int) -> DepthFrame:
        """Return an image of what is there now.

        Args:
            stop: Ignored, as by a real sensor.

        Raises:
            ControllerError: The sensor was ordered to fail.
        """
        shown = self._shown()
        if shown.camera == "blind":
            raise ControllerError("the sensor gives no image")
        if shown.camera == "frozen" and self._frozen and self._frozen[0] == shown.stamp_ns:
            return self._frozen[1]
        random = np.random.default_rng([self._seed, 1, *self._moment.again(shown.stamp_ns)])
        frame = DepthFrame(sensed(self._depth(shown), random), self._reported(shown))
        self._frozen = shown.stamp_ns, frame
        return frame

    def true_depth(self) -> npt.NDArray[np.float32]:
        """Return the present image without noise, (H, W) float32, metres, NaN where nothing is."""
        return self._depth(self._shown())

    @property
    def acquisition(self) -> Acquisition:
        """From where it really looks."""
        return self._true

    def _still_depth(self) -> npt.NDArray[np.float32]:
        if self._still_m is None:
            meshes = _in(self._world_from_base, still_meshes(self._layout))
            self._still_m = true_depth(meshes, self._true)
        return self._still_m

    def _depth(self, shown: ShownCell) -> npt.NDArray[np.float32]:
        """Return the image without noise; only what has moved by a hair is drawn again."""
        parts: dict[bytes, Callable[[], list[Mesh]]] = {
            _fingerprint(shown.q, shown.width_m): partial(arm_meshes, shown)
        }
        for package in shown.packages:
            what = package.number, package.product, package.dents
            name = _fingerprint(package.base_from_product, what=what)
            parts[name] = partial(package_meshes, package)
        self._drawn = {
            name: self._drawn.get(name) or self._draw(meshes()) for name, meshes in parts.items()
        }
        depth_m = self._still_depth().copy()
        for pixels, part_m in self._drawn.values():
            depth_m[pixels] = np.fmin(depth_m[pixels], part_m)
        return depth_m

    def _draw(self, meshes: list[Mesh]) -> Drawn:
        return drawn(_in(self._world_from_base, meshes), self._true)

    def _reported(self, shown: ShownCell) -> Acquisition:
        return self._true


class PhysicalTraySensor(_FixedSensor):
    """Depth sensor 0.95 m above the tray of the physical cell; a `TraySensor`."""

    over = "tray"
    eye_m = (0.0, 0.0, OVERHEAD_M)


class PhysicalBeltSensor(_FixedSensor):
    """Depth sensor 0.80 m above the end of the belt; a `TraySensor` in the frame of the belt.

    Its calibration to the robot is off by a little, and differently for each package that lies in
    the light barrier: so the robot grasps beside where it means to, as it does in a plant.
    """

    over = "belt"
    eye_m = (BELT_LOOKS_AT_M, 0.0, BELT_OVERHEAD_M)
    noise = 1_000_003

    def _reported(self, shown: ShownCell) -> Acquisition:
        package = self._arrived(shown)
        if package is None:
            return self._true
        world_from_camera = np.array(self._true.world_from_camera)
        offset = np.array([*package.pick_offset_m, 0.0])
        world_from_camera[:3, 3] += self._world_from_base[:3, :3] @ offset
        return Acquisition(self._true.camera, world_from_camera)

    def _arrived(self, shown: ShownCell) -> ShownPackage | None:
        """Return the package nearest to where arrived ones lie, if there is one."""
        distances = {}
        for package in shown.packages:
            x, y, _ = (self._world_from_base @ package.base_from_product)[:3, 3]
            distances[package.number] = float(np.hypot(x - BELT_LOOKS_AT_M, y))
        nearest = min(shown.packages, key=lambda package: distances[package.number], default=None)
        near = nearest is not None and distances[nearest.number] < BELT_HALF_M[1] + 0.1
        return nearest if near else None


def _fingerprint(*values: npt.ArrayLike, what: object = None) -> bytes:
    """Return what tells two moments apart in which values differ by 10 micrometres or more."""
    whole = np.concatenate([np.ravel(value) for value in values])
    return np.rint(whole * 1e5).astype(np.int64).tobytes() + repr(what).encode()


def still_meshes(layout: CellLayout) -> list[Mesh]:
    """Return what stands still: tray, floor, belt and reject bin, in the base frame."""
    length, across, thick = (2.0 * half for half in BELT_HALF_M)
    middle = BELT_AHEAD_M - BELT_HALF_M[0]
    belt = shifted(box_mesh((length, across, thick)), [middle, 0.0, -thick])
    x, y = BIN_HALF_M
    rejects = [shifted(box_mesh((2.0 * x, 2.0 * y, 0.02)), [0.0, 0.0, -0.02])]
    long_side, short_side = (
        box_mesh((2.0 * x, 0.008, BIN_WALL_M)),
        box_mesh((0.008, 2.0 * y, BIN_WALL_M)),
    )
    rejects += [shifted(long_side, [0.0, side * y, 0.0]) for side in (-1.0, 1.0)]
    rejects += [shifted(short_side, [side * x, 0.0, 0.0]) for side in (-1.0, 1.0)]
    return [
        *_in(layout.base_from_tray, tray_meshes(layout.rim_m)),
        *_in(layout.base_from_belt, [belt]),
        *_in(layout.base_from_bin, rejects),
    ]


def package_meshes(package: ShownPackage) -> list[Mesh]:
    """Return a package as it is, dents included, in the base frame."""
    return _in(package.base_from_product, [dented_mesh(package.product, package.dents)])


def arm_meshes(shown: ShownCell) -> list[Mesh]:
    """Return arm and gripper where they are, in the base frame."""
    frames = np.concatenate([ARM.base[None], link_poses(ARM, shown.q)[0]])
    meshes = []
    for first, _, second, _, radius in ARM.capsules:
        start, end = frames[int(first), :3, 3], frames[int(second), :3, 3]
        length = float(np.linalg.norm(end - start))
        if length < 1e-9:
            continue  # the tool: the hand is drawn as what it is
        if second == len(ARM.dh):
            length -= HAND_HALF_M[2]
        pose = np.array(frames[int(second)])
        # The link ends in the frame's origin, along the axis of the frame before.
        pose[:3, :3] = along_z((end - start) / np.linalg.norm(end - start))
        pose[:3, 3] = start
        meshes += _in(pose, [_capsule(round(length, 9), float(radius))])
    hand = box_mesh((2 * HAND_HALF_M[0], 2 * HAND_HALF_M[1], 2 * HAND_HALF_M[2]))
    pads = []
    for side in (-1.0, 1.0):
        pad = box_mesh((2 * PAD_HALF_M[0], 2 * PAD_HALF_M[1], 2 * PAD_HALF_M[2]))
        beside = side * (shown.width_m / 2.0 + PAD_HALF_M[1])
        pads.append(shifted(pad, [0.0, beside, PAD_CENTRE_M - PAD_HALF_M[2]]))
    return [*meshes, *_in(frames[-1], [hand, *pads])]


@lru_cache(maxsize=16)
def _capsule(length_m: float, radius_m: float) -> Mesh:
    """Return a capsule along z from the origin, within a hundredth of its radius."""
    around = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
    rise = np.linspace(0.0, np.pi / 2.0, 6)[:, None]
    ring = np.stack(
        [np.cos(rise) * np.cos(around), np.cos(rise) * np.sin(around), np.sin(rise) + 0 * around],
        axis=-1,
    )
    cap = np.unique(ring.reshape(-1, 3).round(9), axis=0) * radius_m
    far = cap + np.array([0.0, 0.0, length_m])
    return hull_mesh(np.concatenate([far, cap * [1.0, 1.0, -1.0]]))


def _in(b_from_a: F64, meshes: list[Mesh]) -> list[Mesh]:
    return [(moved(vertices, b_from_a), triangles) for vertices, triangles in meshes]
