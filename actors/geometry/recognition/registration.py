"""Where a known product stands on the tray: x, y and yaw, from a cloud and its trained surface.

expected pose and six turns -> ICP (point to plane, Tukey) -> outline onto outline, seen from above
-> of the turns that explain the cloud equally well the one nearest to the expected

What does not stand, `leaning` finds with six freedoms.

Rules a change must keep: the result of `register` has three freedoms. Six let a dent pass as a
tilt: measured, crushes of 10 % were found in 1 of 10 cases with six and in 10 of 10 with three.
The outline decides x, y and yaw, since damage on top leaves it alone: distances to the surface
drew a carton crushed by 20 % out of its place by 7 to 11 mm, outlines by 1.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from actors.geometry.open3d_arrays import point_cloud, tensor
from actors.geometry.open3d_on_use import open3d
from actors.geometry.poses import inverse, moved, on_tray, turned, yaw_between, yaw_of
from actors.geometry.recognition.outlines import OutlineField, unbiased
from actors.geometry.surfaces.fusion import vertex_normals
from actors.geometry.surfaces.rendering import ray_scene

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy.typing as npt

    from actors.geometry.shapes import Acquisition, PointCloud, Surface

    Pose = npt.NDArray[np.float64]

TURNS: Final = 6
"""Yaw seeds beside the expected one, 60 degrees apart: ICP finds home from 30."""

POINTS_MAX: Final = 1000
"""Points that take part; more change the pose by less than 0.1 mm."""

SEED_POINTS: Final = 250
"""Points that tell which of many seeds is worth more."""

INLIER_M: Final = 0.004
"""Scale of the robust losses: twice the sensor's spread at the tray."""

EQUAL_COST_M: Final = 0.0001
"""Turns whose mean distance differs by less are equally good."""


STANDING: Final = ((0.0, 0.0),)
LYING: Final = tuple(
    (quarters[0] * np.pi / 2.0, quarters[1] * np.pi / 2.0)
    for quarters in ((1, 0), (-1, 0), (0, 1), (0, -1), (2, 0))
)
"""Roll and pitch of a product on its foot; on its sides and its head."""

HEIGHTS_M: Final = (0.0, -0.005, -0.01, -0.015, -0.02)
"""Heights tried when turns are compared: a crushed package is lower, but turned no differently."""


@dataclass(frozen=True, slots=True, eq=False)
class Registration:
    """Where a surface was found.

    Attributes:
        tray_from_product: (4, 4) float64, upright on the tray.
        distance_m: Mean distance of the cloud to the surface, each at most 3 x `INLIER_M`.
    """

    tray_from_product: Pose
    distance_m: float


def register(
    cloud: PointCloud,
    outline_m: npt.NDArray[np.floating],
    surface: Surface,
    expected: Pose,
    *,
    seen_by: Acquisition | None = None,
    before_m: npt.NDArray[np.float32] | None = None,
) -> Registration:
    """Find where on the tray a product stands.

    Args:
        cloud: Its points, tray frame, metres; at least one.
        outline_m: (K, 2), the points along its outline, tray frame, metres.
        surface: Its trained surface, product frame.
        expected: tray_from_product as planned, (4, 4).
        seen_by: The camera that saw the outline, and its pose in the tray frame; takes out what
            outlines are off in its images, see `outlines.unbiased`.
        before_m: (H, W), its image without the product, metres; a neighbour hides part of an
            outline. A bare tray when absent.

    Returns:
        The pose, and how well the cloud lies on the surface there.
    """
    random = np.random.default_rng(0)
    chosen = random.permutation(len(cloud))[:POINTS_MAX]
    points = cloud.points_m[chosen].astype(float)
    scene = ray_scene(surface.vertices_m, surface.triangles)
    normals = vertex_normals(surface.vertices_m, surface.triangles)
    source, target = point_cloud(points), point_cloud(surface.vertices_m, normals)
    seeds = _seeds(surface, points.mean(axis=0), expected)
    rough = [upright_icp(source, target, seed) for seed in seeds] + seeds
    field = OutlineField(surface, scene)
    fitted = distinct([field.fitted(outline_m, pose) for pose in rough])
    finals = [Registration(pose, mean_distance(scene, points, pose)) for pose in fitted]
    best_m = min(each.distance_m for each in finals)
    found = min(
        (each for each in finals if each.distance_m < best_m + EQUAL_COST_M),
        key=lambda each: abs(yaw_between(yaw_of(expected), yaw_of(each.tray_from_product))),
    )
    if seen_by is None:
        return found
    pose = unbiased(field, outline_m, surface, found.tray_from_product, seen_by, before_m)
    return Registration(pose, found.distance_m)


def _seeds(surface: Surface, centre_m: Pose, expected: Pose) -> list[Pose]:
    """Return the expected pose, and six turns of the surface above the middle of the points."""
    high = surface.vertices_m[surface.vertices_m[:, 2] > 0.5 * surface.vertices_m[:, 2].max()]
    middle = (high[:, :2].min(axis=0) + high[:, :2].max(axis=0)) / 2.0
    seeds = [expected]
    for turn in range(TURNS):
        yaw = yaw_of(expected) + 2.0 * np.pi * turn / TURNS
        shift = centre_m[:2] - on_tray(0.0, 0.0, yaw)[:2, :2] @ middle
        seeds.append(on_tray(shift[0], shift[1], yaw))
    return seeds


def leaning(cloud: PointCloud, surface: Surface, upright: Pose) -> Registration:
    """Find how a product lies that does not stand: six freedoms.

    Starts from the upright pose and from the product on its foot, then on its sides and its head,
    turned by multiples of 45 degrees.  To be asked only where an upright product does not explain
    the cloud.

    Args:
        cloud: Its points, tray frame, metres; at least one.
        surface: Its trained surface, product frame.
        upright: tray_from_product as `register` found it.

    Returns:
        The pose; its distance is to the surface as posed, not lowered, and more the farther its
        lowest point is from the tray: a lifted product looks like one that lies on its side.
    """
    random = np.random.default_rng(0)
    points = cloud.points_m[random.permutation(len(cloud))[:POINTS_MAX]].astype(float)
    scene = ray_scene(surface.vertices_m, surface.triangles)
    normals = vertex_normals(surface.vertices_m, surface.triangles)
    rough = point_cloud(points[:SEED_POINTS]), point_cloud(surface.vertices_m[::6], normals[::6])
    fine = point_cloud(points), point_cloud(surface.vertices_m, normals)
    middle = points.mean(axis=0)

    def fitted(pose: Pose, clouds: tuple[Any, Any], rounds: int) -> Registration:
        free = _free_icp(*clouds, pose, rounds)
        lowest_m = abs(float((surface.vertices_m @ free[2, :3]).min() + free[2, 3]))
        hovers_m = 0.1 * max(0.0, lowest_m - 0.005)
        return Registration(free, _clipped(scene, points, free) + hovers_m)

    found: list[Registration] = []
    for seeds in (
        [upright, *_resting(surface, middle, STANDING)],
        _resting(surface, middle, LYING),
    ):
        found += [fitted(seed, rough, 15) for seed in seeds]
        found.sort(key=lambda each: each.distance_m)
        found = [fitted(each.tray_from_product, fine, 40) for each in found[:3]]
        if min(each.distance_m for each in found) < INLIER_M / 2.0:
            break
    return min(found, key=lambda each: each.distance_m)


def tilt_of(pose: Pose) -> float:
    """Return the angle between a pose's z axis and the vertical, radians, 0 … pi."""
    return float(np.arctan2(np.hypot(pose[0, 2], pose[1, 2]), pose[2, 2]))


def _resting(surface: Surface, middle_m: Pose, rests: Sequence[tuple[float, float]]) -> list[Pose]:
    """Return a product at rest on some of its sides, in eight turns, on the tray.

    Args:
        surface: Product frame.
        middle_m: (2,) or more, what its middle is over.
        rests: Roll and pitch of each side.
    """
    centre = (surface.vertices_m.min(axis=0) + surface.vertices_m.max(axis=0)) / 2.0
    poses = []
    for roll, pitch in rests:
        for turn in range(8):
            pose = np.eye(4)
            pose[:3, :3] = turned(roll, pitch, turn * np.pi / 4.0)
            pose[:2, 3] = middle_m[:2] - (pose[:3, :3] @ centre)[:2]
            pose[2, 3] = -float((surface.vertices_m @ pose[2, :3]).min())
            poses.append(pose)
    return poses


def distinct(poses: Sequence[Pose]) -> list[Pose]:
    """Return the poses without those that lie within 3 mm and 3 degrees of an earlier one."""
    kept: list[Pose] = []
    for pose in poses:
        if not any(
            np.hypot(*(pose[:2, 3] - other[:2, 3])) < 0.003
            and abs(yaw_between(yaw_of(pose), yaw_of(other))) < np.deg2rad(3.0)
            for other in kept
        ):
            kept.append(pose)
    return kept


def upright_icp(source: Any, target: Any, seed: Pose) -> Pose:
    """Return the upright part of what ICP makes of a seed pose.

    Args:
        source: Open3D cloud, tray frame.
        target: Open3D cloud of the surface with normals, product frame.
        seed: tray_from_product to start from.
    """
    pose = _free_icp(source, target, seed, 15)
    return on_tray(pose[0, 3], pose[1, 3], yaw_of(pose))


def _free_icp(source: Any, target: Any, seed: Pose, rounds: int) -> Pose:
    """Return what ICP with six freedoms makes of a seed pose; arguments as of `upright_icp`."""
    registration = open3d().pipelines.registration
    found = registration.registration_icp(
        source,
        target,
        0.03,
        inverse(seed),
        registration.TransformationEstimationPointToPlane(registration.TukeyLoss(k=INLIER_M * 2.0)),
        registration.ICPConvergenceCriteria(max_iteration=rounds),
    )
    return inverse(np.asarray(found.transformation))


def mean_distance(scene: Any, points_m: Pose, pose: Pose) -> float:
    """Return the mean distance of points to a placed surface, at the best of `HEIGHTS_M`.

    Args:
        scene: Of the surface in the product frame, from `ray_scene`.
        points_m: (N, 3) float64, tray frame.
        pose: tray_from_product.

    Returns:
        Metres; each distance is clipped at 3 x `INLIER_M`.
    """
    means = []
    for height_m in HEIGHTS_M:
        lowered = pose.copy()
        lowered[2, 3] += height_m
        means.append(_clipped(scene, points_m, lowered))
    return min(means)


def _clipped(scene: Any, points_m: Pose, pose: Pose) -> float:
    """Return the mean distance of points to a placed surface, each clipped at 3 x `INLIER_M`."""
    return float(np.minimum(_distances(scene, points_m, pose), 3.0 * INLIER_M).mean())


def _distances(scene: Any, points_m: Pose, pose: Pose) -> Pose:
    local = tensor(moved(points_m, inverse(pose)), np.float32)
    # One thread: a thousand points take 1 ms, and waking others cost 4 on a busy machine.
    found = scene.compute_distance(local, nthreads=1)
    return np.asarray(found.numpy(), np.float64)
