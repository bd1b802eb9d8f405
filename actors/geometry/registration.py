"""Where a known product stands on the tray: x, y and yaw, from a cloud and its trained surface.

expected pose and six turns -> ICP (point to plane, Tukey) -> the best -> x, y, yaw alone refined

Rules a change must keep: the result has three freedoms. Six let a dent pass as a tilt: measured,
crushes of 10 % were found in 1 of 10 cases with six and in 10 of 10 with three.
Of equally good turns the one nearest to the expected yaw wins, so that a product that looks the
same from two sides, or is round, is not taken for a turned one.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from actors.geometry.fusion import vertex_normals
from actors.geometry.open3d_on_use import open3d
from actors.geometry.poses import inverse, moved, on_tray, yaw_between, yaw_of
from actors.geometry.rendering import ray_scene

if TYPE_CHECKING:
    import numpy.typing as npt

    from actors.geometry.shapes import PointCloud, Surface

    Pose = npt.NDArray[np.float64]

TURNS: Final = 6
"""Yaw seeds beside the expected one, 60 degrees apart: ICP finds home from 30."""

POINTS_MAX: Final = 1200
"""Points that take part; more change the pose by less than 0.1 mm."""

INLIER_M: Final = 0.004
"""Scale of the robust losses: twice the sensor's spread at the tray."""

EQUAL_COST_M: Final = 0.0001
"""Turns whose mean distance differs by less are equally good."""


@dataclass(frozen=True, slots=True, eq=False)
class Registration:
    """Where a surface was found.

    Attributes:
        tray_from_product: (4, 4) float64, upright on the tray.
        distance_m: Mean distance of the cloud to the surface, each at most 3 x `INLIER_M`.
    """

    tray_from_product: Pose
    distance_m: float


def register(cloud: PointCloud, surface: Surface, expected: Pose) -> Registration:
    """Find where on the tray a product stands.

    Args:
        cloud: Its points, tray frame, metres; at least one.
        surface: Its trained surface, product frame.
        expected: tray_from_product as planned, (4, 4).

    Returns:
        The pose, and how well the cloud lies on the surface there.
    """
    random = np.random.default_rng(0)
    chosen = random.permutation(len(cloud))[:POINTS_MAX]
    points = cloud.points_m[chosen].astype(float)
    scene = ray_scene(surface.vertices_m, surface.triangles)
    offset = _visible_centre(surface)
    seeds = [expected]
    centre = points.mean(axis=0)
    for turn in range(TURNS):
        upright = on_tray(0.0, 0.0, yaw_of(expected) + 2.0 * np.pi * turn / TURNS)
        shift = centre[:2] - (upright[:2, :2] @ offset)
        seeds.append(on_tray(shift[0], shift[1], yaw_of(upright)))
    rough = [upright_icp(points, surface, seed) for seed in seeds]
    rough += seeds[:2]
    costs = [mean_distance(scene, points, pose) for pose in rough]
    best = min(costs)
    finals = [
        refine_upright(scene, points, pose)
        for pose, cost in zip(rough, costs, strict=True)
        if cost < best + 2.0 * EQUAL_COST_M
    ]
    finals.sort(key=lambda each: each.distance_m)
    equal = [each for each in finals if each.distance_m < finals[0].distance_m + EQUAL_COST_M]
    return min(
        equal,
        key=lambda each: abs(yaw_between(yaw_of(expected), yaw_of(each.tray_from_product))),
    )


def upright_icp(points_m: Pose, surface: Surface, seed: Pose) -> Pose:
    """Return the upright part of what ICP makes of a seed pose.

    Args:
        points_m: (N, 3) float64, tray frame.
        surface: Target, product frame.
        seed: tray_from_product to start from.
    """
    o3d = open3d()

    registration = o3d.pipelines.registration
    found = registration.registration_icp(
        _open3d_cloud(points_m, None),
        _open3d_cloud(surface.vertices_m, vertex_normals(surface.vertices_m, surface.triangles)),
        0.03,
        inverse(seed),
        registration.TransformationEstimationPointToPlane(registration.TukeyLoss(k=INLIER_M * 2.0)),
        registration.ICPConvergenceCriteria(max_iteration=15),
    )
    pose = inverse(np.asarray(found.transformation))
    return on_tray(pose[0, 3], pose[1, 3], yaw_of(pose))


def refine_upright(scene: Any, points_m: Pose, start: Pose) -> Registration:
    """Refine x, y and yaw so that the points lie on a surface, robustly.

    Args:
        scene: Of the surface in the product frame, from `ray_scene`.
        points_m: (N, 3) float64, tray frame.
        start: tray_from_product to start from; its z and tilt are ignored.
    """
    from scipy.optimize import least_squares

    centre = points_m.mean(axis=0)

    def pose_of(freedoms: Pose) -> Pose:
        # Turning about the middle of the points keeps the freedoms independent.
        turn = on_tray(0.0, 0.0, freedoms[2])
        turn[:2, 3] = centre[:2] + freedoms[:2] - turn[:2, :2] @ centre[:2]
        return np.asarray(turn @ start)

    def distances(freedoms: Pose) -> Pose:
        pose = pose_of(freedoms)
        pose[2, 3] += freedoms[3]
        return _distances(scene, points_m, pose)

    solved = least_squares(
        distances,
        np.zeros(4),
        loss="cauchy",
        f_scale=INLIER_M / 2.0,
        x_scale=[0.01, 0.01, 0.1, 0.01],
        diff_step=1e-2,
        max_nfev=20,
    )
    pose = pose_of(solved.x)
    return Registration(pose, float(np.minimum(distances(solved.x), 3.0 * INLIER_M).mean()))


def mean_distance(scene: Any, points_m: Pose, pose: Pose) -> float:
    """Return the mean distance of points to a placed surface, each clipped at 3 x `INLIER_M`."""
    return float(np.minimum(_distances(scene, points_m, pose), 3.0 * INLIER_M).mean())


def _distances(scene: Any, points_m: Pose, pose: Pose) -> Pose:
    o3d = open3d()

    local = moved(points_m, inverse(pose)).astype(np.float32)
    return np.asarray(scene.compute_distance(o3d.core.Tensor(local)).numpy(), np.float64)


def _visible_centre(surface: Surface) -> Pose:
    """Return x and y of the middle of what a sensor above sees of a surface, (2,), metres."""
    high = surface.vertices_m[surface.vertices_m[:, 2] > 0.5 * surface.vertices_m[:, 2].max()]
    return np.asarray((high[:, :2].min(axis=0) + high[:, :2].max(axis=0)) / 2.0, np.float64)


def _open3d_cloud(points_m: npt.NDArray[np.floating], normals: Pose | None) -> Any:
    o3d = open3d()

    # Open3D converts float32 one by one, half a second for 300,000 points: hence float64.
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points_m.astype(np.float64)))
    if normals is not None:
        cloud.normals = o3d.utility.Vector3dVector(normals)
    return cloud
