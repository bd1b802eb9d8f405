"""Find a known object in one cloud of a cluttered place.

    large planes out -> clusters (DBSCAN) -> per cluster: FPFH features, triples, Kabsch -> ICP
                     -> ranking by how much of the model the cluster explains, and back

Triples, planes and ICP are computed here, in numpy, and not by Open3D: its threads share one
random state and add in the order they finish, so that 25 runs with one seed gave a dozen poses up
to 1.5 mrad apart; these give one.
A cluster is judged both ways, since a small flat patch lies on every model (`explained` is 1)
and a large pile contains every model (`fitness` is 1); the score joins both.

Open3D is loaded on the first call.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from actors.geometry.open3d_arrays import point_cloud
from actors.geometry.open3d_on_use import open3d
from actors.geometry.poses import inverse, moved, small_motion
from actors.geometry.recognition.clutter import (
    clusters_of,
    diagonal_m,
    plane_reach_m,
    spacing,
    thinned,
    without_large_planes,
)

if TYPE_CHECKING:
    import numpy.typing as npt

    Points = npt.NDArray[np.floating[Any]]
    Pose = npt.NDArray[np.float64]

TRIPLES: Final = 20_000
"""Hypotheses per cluster. At 30 % right feature pairs 2.7 % of all triples are right: hundreds."""

ICP_STEPS_MAX: Final = 40

CANDIDATES_MAX: Final = 12
"""Hypotheses per cluster that are compared on all points; the rest is judged on pairs only."""


class NoMatchError(ValueError):
    """The clouds are sound, but nothing in the scene can be compared with the model."""


@dataclass(frozen=True, slots=True)
class ClusterMatch:
    """One cluster of the scene and the best pose of the model in it.

    Attributes:
        cluster: Number of the cluster, 0 is the one with most points.
        points: Points of the cluster after thinning.
        fitness: Share of the model's points with a scene point within the tolerance, 0 … 1; of
            those that stand clear of the planes and, where the camera is known, that it could see.
        explained: Share of the cluster's points with a model point within the tolerance.
        rmse_m: Root mean square distance of the model's points that found a partner.
        centre_m: Centroid of the cluster, scene frame, (3,).
        scene_from_model: Rigid transform model frame -> scene frame, (4, 4).
        score: Harmonic mean of `explained` and of `fitness` less the squared distances; ranks the
            clusters. On a real scene of three packages 0.95 for the right one, 0.74 for the next.
    """

    cluster: int
    points: int
    fitness: float
    explained: float
    rmse_m: float
    centre_m: Pose
    scene_from_model: Pose
    score: float


@dataclass(frozen=True, slots=True)
class ModelMatch:
    """The pose of a model in a scene.

    Attributes:
        ranking: All clusters compared, best first; never empty.
        planes: The large planes taken out of the scene first, largest first: unit normal towards
            the best cluster and offset, normal . x + offset = 0, (P, 4).
        tolerance_m: Distance up to which two points are the same place.
    """

    ranking: tuple[ClusterMatch, ...]
    planes: Pose
    tolerance_m: float

    @property
    def best(self) -> ClusterMatch:
        """The winning cluster."""
        return self.ranking[0]


def find_model(
    model_m: Points,
    scene_m: Points,
    *,
    eye_m: Points | None = None,
    seed: int = 0,
) -> ModelMatch:
    """Find a model in a cluttered scene.

    Both are thinned to a grid of 1/64 of the model's diagonal, or of 1.5 times the spacing of the
    coarser cloud if that is more.

    Args:
        model_m: Points of the object, metres, model frame, (N, 3), finite.
        scene_m: Points of the scene, metres, scene frame, (M, 3), finite.
        eye_m: Where the camera stood, scene frame, (3,), if one took the whole scene: then a
            complete model is not blamed for its far side.
        seed: Seed of the sampling; equal seeds give equal poses.

    Returns:
        The pose of the model in every cluster that could hold it, best first. A bad best is
        returned too: the caller decides from `fitness` what counts as found.

    Raises:
        NoMatchError: The model has too few points, or the scene has no cluster of its size.

    Source: features after Rusu, Blodow, Beetz 2009 (FPFH); use in ENACT 4.2 (perception).
    """
    spacing_m = max(spacing(model_m), spacing(scene_m))
    voxel_m = max(diagonal_m(model_m) / 64.0, 1.5 * spacing_m, 1e-4)
    model = thinned(model_m, voxel_m)
    if len(model) < 50:
        raise NoMatchError(
            f"asked to find a model of {len(model_m)} points; {len(model)} are left on a grid of"
            f" {voxel_m * 1e3:.1f} mm and at least 50 are needed; choose a denser model"
        )
    scene = thinned(scene_m, voxel_m)
    rest, planes = without_large_planes(scene, larger_than_m=diagonal_m(model), voxel_m=voxel_m)
    clusters = clusters_of(rest, gap_m=4.0 * voxel_m, points_min=max(30, len(model) // 20))
    if not clusters:
        raise NoMatchError(
            f"asked to find a model in {len(scene_m)} points; beside {len(planes)} planes there is"
            f" no cluster of at least {max(30, len(model) // 20)} points on a grid of"
            f" {voxel_m * 1e3:.1f} mm; check that model and scene are both in metres"
        )
    random = np.random.default_rng(seed)
    reference = _Described(model, voxel_m, _Sight(eye_m, planes))
    ranking = sorted(
        (_match(reference, cluster, number, random) for number, cluster in enumerate(clusters)),
        key=lambda match: (-match.score, match.cluster),
    )
    winner = clusters[ranking[0].cluster]
    side = np.sign(planes[:, :3] @ winner.mean(0) + planes[:, 3])
    return ModelMatch(tuple(ranking), planes * side[:, None], 2.0 * voxel_m)


def rigid_fit(source_m: Points, target_m: Points) -> Pose:
    """Return the rigid transforms that best carry point sets onto others.

    Args:
        source_m: B sets of K points, (B, K, 3).
        target_m: Their partners, (B, K, 3).

    Returns:
        target_from_source, (B, 4, 4); rotations are proper.

    Source: Kabsch 1976, batched singular value decomposition.
    """
    source_mean, target_mean = source_m.mean(1), target_m.mean(1)
    covariance = np.einsum(
        "bki,bkj->bij", source_m - source_mean[:, None], target_m - target_mean[:, None]
    )
    left, _, right = np.linalg.svd(covariance)
    flip = np.ones((len(covariance), 3))
    flip[:, 2] = np.sign(np.linalg.det(left) * np.linalg.det(right))
    pose = np.zeros((len(covariance), 4, 4))
    pose[:, :3, :3] = np.einsum("bji,bj,bkj->bik", right, flip, left)
    pose[:, :3, 3] = target_mean - np.einsum("bij,bj->bi", pose[:, :3, :3], source_mean)
    pose[:, 3, 3] = 1.0
    return pose


@dataclass(frozen=True, slots=True)
class _Sight:
    """What of a placed model the scene can show: nothing hidden, nothing that went with a plane."""

    eye_m: Points | None
    planes: Pose


class _Described:
    """A thinned cloud with what matching needs of it: features, normals, tree."""

    def __init__(self, points_m: Points, voxel_m: float, sight: _Sight | None = None) -> None:
        from scipy.spatial import cKDTree

        o3d = open3d()
        self.points_m = points_m
        self.voxel_m = voxel_m
        self.sight = sight or _Sight(None, np.empty((0, 4)))
        cloud = point_cloud(points_m)
        near, wide = (
            o3d.geometry.KDTreeSearchParamHybrid(radius, count)
            for radius, count in ((3.0 * voxel_m, 30), (6.0 * voxel_m, 100))
        )
        cloud.estimate_normals(near)
        feature = o3d.pipelines.registration.compute_fpfh_feature(cloud, wide)
        self.normals = np.asarray(cloud.normals).copy()
        self.features = np.asarray(feature.data).T.copy()
        self.tree = cKDTree(points_m)


def _match(
    model: _Described, cluster_m: Points, number: int, random: np.random.Generator
) -> ClusterMatch:
    """Find the model's best pose in one cluster."""
    scene = _Described(cluster_m, model.voxel_m)
    tolerance_m = 2.0 * model.voxel_m
    drawn = _hypotheses(model, scene, random)
    # ICP on a cluster of another shape can run away: the poses it started from stay in the race.
    refined = [_refined(model, scene, pose) for pose in drawn]
    pose = max(refined + drawn, key=lambda drawn: _closeness(model, scene, drawn, tolerance_m))
    fitness, explained, rmse_m = _fits(model, scene, pose, tolerance_m)
    close = fitness * (1.0 - (rmse_m / tolerance_m) ** 2) if fitness > 0.0 else 0.0
    return ClusterMatch(
        cluster=number,
        points=len(cluster_m),
        fitness=fitness,
        explained=explained,
        rmse_m=rmse_m,
        centre_m=cluster_m.mean(0),
        scene_from_model=pose,
        score=2.0 * close * explained / (close + explained) if close > 0.0 else 0.0,
    )


def _hypotheses(model: _Described, scene: _Described, random: np.random.Generator) -> list[Pose]:
    """Draw poses from triples of points with alike features, the few best on all points first."""
    from scipy.spatial import cKDTree

    _, near = cKDTree(scene.features).query(model.features, k=3)
    model_index, scene_index = np.repeat(np.arange(len(near)), 3), near.ravel()
    triples = random.integers(0, len(model_index), size=(TRIPLES, 3))
    source = model.points_m[model_index[triples]]
    target = scene.points_m[scene_index[triples]]
    edges_source = np.linalg.norm(source - np.roll(source, 1, axis=1), axis=2)
    edges_target = np.linalg.norm(target - np.roll(target, 1, axis=1), axis=2)
    wide = edges_source.min(1) > 0.15 * diagonal_m(model.points_m)
    alike = np.abs(edges_source - edges_target).max(1) < 3.0 * model.voxel_m
    keep = wide & alike
    poses = np.concatenate([_upright(model, scene), rigid_fit(source[keep], target[keep])])
    sample = model.points_m[random.permutation(len(model.points_m))[:60]]
    placed = np.einsum("bij,kj->bki", poses[:, :3, :3], sample) + poses[:, None, :3, 3]
    distance_m, _ = scene.tree.query(placed, distance_upper_bound=4.0 * model.voxel_m)
    shares = np.isfinite(distance_m).mean(1)
    best = np.argsort(-shares, kind="stable")[:CANDIDATES_MAX]
    scores = [_closeness(model, scene, poses[i], 3.0 * model.voxel_m) for i in best]
    return [poses[best[i]] for i in np.argsort(-np.array(scores), kind="stable")[:3]]


def _upright(model: _Described, scene: _Described) -> Pose:
    """Return the one guess that needs no features: centroid upon centroid, (1, 4, 4)."""
    pose = np.eye(4)
    pose[:3, 3] = scene.points_m.mean(0) - model.points_m.mean(0)
    return pose[None]


def _refined(model: _Described, scene: _Described, pose: Pose) -> Pose:
    """Sharpen a pose by ICP, point to plane, from coarse to fine."""
    for reach, points_max in ((5.0, 600), (2.0, 2000)):
        source = model.points_m[:: max(1, len(model.points_m) // points_max)]
        for _ in range(ICP_STEPS_MAX):
            step = _icp_step(moved(source, pose), scene, reach * scene.voxel_m)
            pose = step @ pose
            if np.abs(step - np.eye(4)).max() < 1e-6:
                break
    return pose


def _icp_step(placed_m: Points, scene: _Described, reach_m: float) -> Pose:
    """Return the small motion that brings placed points nearest to the planes of the scene.

    Source: Chen and Medioni 1991, linearised.
    """
    distance_m, index = scene.tree.query(placed_m, distance_upper_bound=reach_m)
    near = np.isfinite(distance_m)
    if near.sum() < 10:
        return np.eye(4)
    points, normals = placed_m[near], scene.normals[index[near]]
    rows = np.concatenate([np.cross(points, normals), normals], axis=1)
    behind = np.einsum("ki,ki->k", scene.points_m[index[near]] - points, normals)
    # A grain of damping: on a single flat face three of the six freedoms are open.
    damping = 1e-6 * np.trace(rows.T @ rows) * np.eye(6)
    return small_motion(np.linalg.solve(rows.T @ rows + damping, rows.T @ behind))


def _fits(
    model: _Described, scene: _Described, pose: Pose, tolerance_m: float
) -> tuple[float, float, float]:
    """Return `fitness`, `explained` and `rmse_m` of a pose: see `ClusterMatch`."""
    placed = moved(model.points_m, pose)
    out, _ = scene.tree.query(placed)
    back, _ = model.tree.query(moved(scene.points_m, inverse(pose)))
    out = out[_showing(model, placed)]
    near = out[out <= tolerance_m]
    rmse_m = float(np.sqrt(np.mean(near**2))) if len(near) else float("inf")
    # A pose that hides nearly all of the model is judged as if a fifth of it showed.
    return len(near) / max(len(out), len(placed) // 5), float(np.mean(back <= tolerance_m)), rmse_m


def _showing(model: _Described, placed_m: Points) -> npt.NDArray[np.bool_]:
    """Say which points of the placed model the scene could show, (N,).

    Source: Katz, Tal, Basri 2007 (hidden point removal).
    """
    planes, eye_m = model.sight.planes, model.sight.eye_m
    above = np.abs(placed_m @ planes[:, :3].T + planes[:, 3]) > plane_reach_m(model.voxel_m)
    showing = above.all(axis=1)
    if eye_m is not None:
        radius_m = 100.0 * diagonal_m(placed_m)
        _, index = point_cloud(placed_m).hidden_point_removal(
            np.asarray(eye_m, np.float64), radius_m
        )
        showing &= np.isin(np.arange(len(placed_m)), index)
    return np.asarray(showing)


def _closeness(model: _Described, scene: _Described, pose: Pose, tolerance_m: float) -> float:
    """Return how near the model lies to the scene, 0 … 1.

    The share of near points alone is the same for a carton and the carton turned by a side: both
    have all points within tolerance, so squared distances decide.
    """
    distance_m, _ = scene.tree.query(moved(model.points_m, pose))
    return float(np.mean(np.maximum(0.0, 1.0 - (distance_m / tolerance_m) ** 2)))
