"""SIMULATED depth sensors: ray casting of the true shapes, then the noise of `noise`.

Rules a change must keep: an image depends on the seed, on what it shows and on how many were taken
of that, so that two sensors of one seed see the same; acquisition poses are off by what a robot is
off.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from actors.geometry.poses import inverse, looking_at, moved, on_tray, small_motion
from actors.geometry.shapes import VGA, Acquisition, DepthFrame
from actors.geometry.surfaces.rendering import depth_where_seen
from actors.palletizing.sight.sensor import PLATE_M
from actors.palletizing.simulation.noise import DARK, Light, sensed
from actors.palletizing.simulation.packages import (
    DEMO_PRODUCTS,
    EYE_M,
    Package,
    on_the_tray,
    package_sequence,
)
from actors.palletizing.simulation.products import box_mesh, product_mesh

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy.typing as npt

    Mesh = tuple[npt.NDArray[np.float64], npt.NDArray[np.int32]]

OVERHEAD_M: Final = EYE_M[2]
"""Height of the overhead sensor above the tray."""

TRAY_M: Final = (0.90, 0.64)
"""Length and width of the tray, along x and y of its frame."""

RIM_M: Final = 0.008
"""Height of its rim."""

FLOOR_M: Final = -0.12
"""Height of the floor, tray frame."""

ORBIT_M: Final = 0.45
"""Distance of the eye-in-hand sensor from the product."""

ROBOT_SPREAD_M: Final = 0.0004
"""Repeatability and hand-eye calibration of the robot, metres per axis."""

ROBOT_SPREAD_RAD: Final = 0.0015
"""The same as rotation per axis: 0.7 mm at the distance of the orbit."""


OVERHEAD_ASKEW_RAD: Final = float(np.deg2rad(8.0))
ASKEW_RAD: Final = float(np.deg2rad(10.0))
"""How far sensors are turned against plate and tray: an edge that runs along a row of pixels is
known to a pixel only, one that crosses ten rows to a tenth."""


class Repeats:
    """Counts how often the same thing was looked at: each image of it has its own noise."""

    def __init__(self) -> None:
        self._last: tuple[int, ...] = ()
        self._times = 0

    def again(self, *what: int) -> tuple[int, ...]:
        """Return what is looked at, and how often it was before if it was."""
        self._times = self._times + 1 if what == self._last else 0
        self._last = what
        return (*what, self._times) if self._times else what


class SimulatedTraySensor:
    """Depth sensor 0.95 m above the tray that sees a given sequence of packages."""

    def __init__(self, packages: Sequence[Package], *, seed: int, light: Light = DARK) -> None:
        self._packages = packages
        self._seed = seed
        self._light = light
        self._stop = Repeats()
        self._last: tuple[int, npt.NDArray[np.float32]] | None = None
        self._acquisition = Acquisition(VGA, looking_down(np.array([0.0, 0.0, OVERHEAD_M])))

    def capture_empty(self) -> DepthFrame:
        """Return an image of the tray with nothing on it."""
        return self._seen(-1, np.random.default_rng([self._seed, *self._stop.again(0)]))

    def capture(self, stop: int) -> DepthFrame:
        """Return an image of the tray with the packages of this tray up to the stop's own."""
        random = np.random.default_rng([self._seed, *self._stop.again(1, stop)])
        return self._seen(stop, random)

    def _seen(self, stop: int, random: np.random.Generator) -> DepthFrame:
        if self._last is None or self._last[0] != stop:
            visible = on_the_tray(self._packages, stop) if stop >= 0 else []
            meshes = [*tray_meshes(), *(mesh for package in visible for mesh in package.meshes())]
            self._last = stop, true_depth(meshes, self._acquisition)
        return DepthFrame(sensed(self._last[1], random, self._light), self._acquisition)


class SimulatedOrbitSensor:
    """Depth sensor in the hand of a robot that orbits a product on a plate.

    Args:
        seed: Seed of the noise and of the robot's inaccuracy.
    """

    def __init__(self, *, seed: int) -> None:
        self._seed = seed
        self._view = Repeats()
        self._last: tuple[npt.NDArray[np.float32], Acquisition] | None = None

    def capture(self, product: str, view: int, views: int) -> DepthFrame:
        """Return the image of one viewpoint; its reported pose differs a little from the truth."""
        again = self._view.again(view, views, *product.encode())[2 + len(product) :]
        random = np.random.default_rng([self._seed, view, *product.encode(), *again])
        if not again or self._last is None:  # the robot stands still while it takes more than one
            mesh = product_mesh(product)
            centre = np.array([0.0, 0.0, mesh[0][:, 2].max() / 2.0])
            reported = looking_at(centre + ORBIT_M * orbit_direction(view, views), centre)
            error = random.standard_normal(6) * np.repeat([ROBOT_SPREAD_RAD, ROBOT_SPREAD_M], 3)
            true = Acquisition(VGA, reported @ small_motion(error))
            plate = shifted(box_mesh((PLATE_M, PLATE_M, 0.02)), [0.0, 0.0, -0.02])
            self._last = true_depth([mesh, plate], true), Acquisition(VGA, reported)
        depth_m, acquisition = self._last
        return DepthFrame(sensed(depth_m, random), acquisition)


def orbit_direction(view: int, views: int) -> npt.NDArray[np.float64]:
    """Return the unit vector from the product to a viewpoint: rings at 12 to 60 degrees, the top.

    The lower ring rises and falls between 12 and 30 degrees: flat views see under rims and down to
    the plate, steeper ones see the upper edges.

    Args:
        view: Number of the viewpoint; the last one is the top.
        views: How many there are, at least 3.
    """
    low = round((views - 1) * 0.6)
    if view == views - 1:
        turn, rise = 0.0, np.deg2rad(89.0)
    elif view < low:
        turn, rise = 2.0 * np.pi * view / low, np.deg2rad(30.0 if view % 2 else 12.0)
    else:
        turn, rise = 2.0 * np.pi * (view - low + 0.5) / (views - 1 - low), np.deg2rad(60.0)
    turn += ASKEW_RAD
    return np.array([np.cos(turn) * np.cos(rise), np.sin(turn) * np.cos(rise), np.sin(rise)])


def looking_down(eye_m: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return world_from_camera of a sensor that looks down, a little askew; see `ASKEW_RAD`.

    Args:
        eye_m: (3,), metres.
    """
    straight = looking_at(eye_m, eye_m * [1.0, 1.0, 0.0])
    return straight @ on_tray(0.0, 0.0, OVERHEAD_ASKEW_RAD)


def orbit_sensor(seed: str = "1") -> SimulatedOrbitSensor:
    """Return the simulated eye-in-hand sensor; for `open_sensor`."""
    return SimulatedOrbitSensor(seed=int(seed))


def tray_sensor(packages: str = "16", seed: str = "1", products: str = "") -> SimulatedTraySensor:
    """Return the simulated overhead sensor of a seeded sequence of packages; for `open_sensor`."""
    names = products.split() or DEMO_PRODUCTS
    return SimulatedTraySensor(
        package_sequence(int(packages), seed=int(seed), products=names), seed=int(seed)
    )


def true_depth(meshes: Sequence[Mesh], acquisition: Acquisition) -> npt.NDArray[np.float32]:
    """Return the depth image of meshes without noise, (H, W) float32, metres, NaN: nothing hit."""
    depth_m = np.full(acquisition.camera.shape, np.nan, np.float32)
    pixels, depth_m[pixels] = drawn(meshes, acquisition)
    return depth_m


def drawn(
    meshes: Sequence[Mesh], acquisition: Acquisition
) -> tuple[tuple[slice, slice], npt.NDArray[np.float32]]:
    """Return rows and columns in which meshes are seen, and their depth there; as `true_depth`."""
    vertices = np.concatenate([mesh[0] for mesh in meshes])
    first = np.cumsum([0] + [len(mesh[0]) for mesh in meshes])
    triangles = np.concatenate(
        [mesh[1] + start for mesh, start in zip(meshes, first, strict=False)]
    )
    in_camera = moved(vertices, inverse(acquisition.world_from_camera))
    return depth_where_seen(in_camera, triangles, acquisition.camera)


def tray_meshes(rim_m: float = RIM_M) -> list[Mesh]:
    """Return a sheet of metal with a rim, and the floor below it, in the tray frame.

    Args:
        rim_m: Height of the rim above the sheet.
    """
    length, width = TRAY_M
    sheet = shifted(box_mesh((length, width, 0.002)), [0.0, 0.0, -0.002])
    floor = shifted(box_mesh((3.0, 3.0, 0.01)), [0.0, 0.0, FLOOR_M - 0.01])
    high = rim_m + 0.002
    long_side, short_side = box_mesh((length, 0.004, high)), box_mesh((0.004, width, high))
    rim = [shifted(long_side, [0.0, y, -0.002]) for y in (-width / 2.0, width / 2.0)]
    rim += [shifted(short_side, [x, 0.0, -0.002]) for x in (-length / 2.0, length / 2.0)]
    return [sheet, floor, *rim]


def shifted(mesh: Mesh, offset_m: Sequence[float]) -> Mesh:
    """Return a mesh somewhere else."""
    return mesh[0] + np.asarray(offset_m), mesh[1]
