"""Where a known product stands on the tray: x, y and yaw, from a cloud and its trained surface.

expected pose and six turns -> ICP (point to plane, Tukey) -> outline onto outline, seen from above
-> of the turns that explain the cloud equally well the one nearest to the expected

Rules a change must keep: the result has three freedoms. Six let a dent pass as a tilt: measured,
crushes of 10 % were found in 1 of 10 cases with six and in 10 of 10 with three.
The outline decides x, y and yaw, since damage on top leaves it alone: distances to the surface
drew a carton crushed by 20 % out of its place by 7 to 11 mm, outlines by 1.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from actors.geometry.fusion import vertex_normals
from actors.geometry.open3d_arrays import point_cloud, tensor
from actors.geometry.open3d_on_use import open3d
from actors.geometry.poses import inverse, moved, on_tray, yaw_between, yaw_of
from actors.geometry.rendering import ray_scene

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy.typing as npt

    from actors.geometry.shapes import PointCloud, Surface

    Pose = npt.NDArray[np.float64]

TURNS: Final = 6
"""Yaw seeds beside the expected one, 60 degrees apart: ICP finds home from 30."""

POINTS_MAX: Final = 1000
"""Points that take part; more change the pose by less than 0.1 mm."""

INLIER_M: Final = 0.004
"""Scale of the robust losses: twice the sensor's spread at the tray."""

EQUAL_COST_M: Final = 0.0001
"""Turns whose mean distance differs by less are equally good."""


OUTLINE_CELL_M: Final = 0.001
"""Grid of the outline's distances; interpolation makes it finer than the sensor's 1.5 mm pixels."""

OUTLINE_MARGIN_M: Final = 0.05
"""How far around the product the distances reach; farther points count like the border."""

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
    cloud: PointCloud, outline_m: npt.NDArray[np.floating], surface: Surface, expected: Pose
) -> Registration:
    """Find where on the tray a product stands.

    Args:
        cloud: Its points, tray frame, metres; at least one.
        outline_m: (K, 2), the points along its outline, tray frame, metres.
        surface: Its trained surface, product frame.
        expected: tray_from_product as planned, (4, 4).

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
    return min(
        (each for each in finals if each.distance_m < best_m + EQUAL_COST_M),
        key=lambda each: abs(yaw_between(yaw_of(expected), yaw_of(each.tray_from_product))),
    )


class OutlineField:
    """Distances to the outline of a surface as seen from above, on a grid.

    Args:
        surface: Product frame.
        scene: Of the surface, from `ray_scene`.
    """

    def __init__(self, surface: Surface, scene: Any) -> None:
        from scipy.ndimage import binary_closing, distance_transform_edt

        self._low = surface.vertices_m[:, :2].min(axis=0) - OUTLINE_MARGIN_M
        high = surface.vertices_m[:, :2].max(axis=0) + OUTLINE_MARGIN_M
        columns, rows = np.ceil((high - self._low) / OUTLINE_CELL_M).astype(int)
        x = self._low[0] + OUTLINE_CELL_M * np.arange(columns)
        y = self._low[1] + OUTLINE_CELL_M * np.arange(rows)
        rays = np.zeros((rows, columns, 6), np.float32)
        rays[..., 0], rays[..., 1] = np.meshgrid(x, y)
        rays[..., 2], rays[..., 5] = surface.vertices_m[:, 2].max() + 0.1, -1.0
        hit = np.isfinite(scene.cast_rays(tensor(rays))["t_hit"].numpy())
        inside = binary_closing(hit, iterations=2) | hit
        outwards = distance_transform_edt(~inside) + distance_transform_edt(inside) - 0.5
        self._distance_m = OUTLINE_CELL_M * outwards

    def fitted(self, outline_m: npt.NDArray[np.floating], start: Pose) -> Pose:
        """Return the upright pose near `start` that puts points onto the outline, robustly.

        Args:
            outline_m: (K, 2), tray frame, metres.
            start: tray_from_product to start from; its z and tilt are ignored.
        """
        from scipy.ndimage import map_coordinates
        from scipy.optimize import least_squares

        centre = outline_m.mean(axis=0)

        def pose_of(freedoms: Pose) -> Pose:
            # Turning about the middle of the points keeps the freedoms independent.
            turn = on_tray(0.0, 0.0, freedoms[2])
            turn[:2, 3] = centre + freedoms[:2] - turn[:2, :2] @ centre
            return np.asarray(turn @ start)

        def distances(freedoms: Pose) -> Pose:
            pose = inverse(pose_of(freedoms))
            local = outline_m @ pose[:2, :2].T + pose[:2, 3]
            cell = (local - self._low) / OUTLINE_CELL_M
            return np.asarray(
                map_coordinates(self._distance_m, cell.T[::-1], order=1, mode="nearest")
            )

        solved = least_squares(
            distances,
            np.zeros(3),
            loss="arctan",
            f_scale=0.004,
            diff_step=1e-3,
            x_scale=[0.01, 0.01, 0.1],
            max_nfev=30,
            xtol=1e-4,
            ftol=1e-4,
        )
        pose = pose_of(solved.x)
        return on_tray(pose[0, 3], pose[1, 3], yaw_of(pose))


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
    registration = open3d().pipelines.registration
    found = registration.registration_icp(
        source,
        target,
        0.03,
        inverse(seed),
        registration.TransformationEstimationPointToPlane(registration.TukeyLoss(k=INLIER_M * 2.0)),
        registration.ICPConvergenceCriteria(max_iteration=15),
    )
    pose = inverse(np.asarray(found.transformation))
    return on_tray(pose[0, 3], pose[1, 3], yaw_of(pose))


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
        clipped = np.minimum(_distances(scene, points_m, lowered), 3.0 * INLIER_M)
        means.append(float(clipped.mean()))
    return min(means)


def _distances(scene: Any, points_m: Pose, pose: Pose) -> Pose:
    local = tensor(moved(points_m, inverse(pose)), np.float32)
    # One thread: a thousand points take 1 ms, and waking others cost 4 on a busy machine.
    found = scene.compute_distance(local, nthreads=1)
    return np.asarray(found.numpy(), np.float64)
