"""All views of a product to one complete surface.

views and poses -> poses refined against each other -> what they leave of the space (`solid`)
                -> large pieces -> planar patches of the views carried over

Rules a change must keep: refined poses stay within what the robot is off (a prior holds them, for
a flat lid alone leaves three freedoms open); the underside on the plate, z = 0, stays open, so
nothing may trust the sign of a distance to the result.

Source: ENACT 4.2 (fusion actor); distances after Curless and Levoy 1996.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from actors.geometry.open3d_arrays import mesh
from actors.geometry.poses import inverse, moved, small_motion
from actors.geometry.shapes import FREE_FORM, Acquisition, Surface
from actors.geometry.surfaces.depth import depth_of_points
from actors.geometry.surfaces.solid import SeenDepth, solid_surface

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy.typing as npt

    Pose = npt.NDArray[np.float64]

VOXEL_M: Final = 0.001
"""Edge of the fusion grid, which rounds edges: at 2 mm the ridge of a carton was 0.5 mm short, and
each look put the carton 0.5 mm beside its place."""

ROUNDS: Final = 4
"""How often each view moves."""

TRIANGLES_MAX: Final = 20_000
"""Flat parts of a finer surface are thinned to that: rendering and registering then take as long
as at 2 mm, edges stay, and trained models move by less than 0.02 mm along the plate."""

POSE_PRIOR_M: Final = 0.001
"""Spread expected of acquisition poses; a motion of 1 mm costs as much as one spread of noise."""

POSE_PRIOR_RAD: Final = 0.003
"""The same for rotations: 1.4 mm at 0.45 m."""

STEEP_COS: Final = 0.7
STEEP_SHARE: Final = 0.05
FLAT_SHARE: Final = 0.15
"""A pose by the plate is off by 0.05 mm where the sensor looks down by more than 45 degrees, by 0.2
mm where the plate's far edge is seen flat: shares of the priors above. Flat views that may move
farther draw walls with them."""

PAIR_REACH_M: Final = 0.006
"""Points of two views that lie farther apart are no pair: twice what pose and noise can do."""

PAIRS_PER_VIEW: Final = 1500
"""Points of a view that seek partners: 1,500 hold six freedoms to 0.05 mm."""

UNKNOWN_BAND_PX: Final = 1
"""Width of the unknown band along an outline; see `_seen`."""

PIECE_SHARE_MIN: Final = 0.03
"""Connected pieces below this share of all triangles are crumbs."""

PATCH_REACH_M: Final = 0.0025
"""A fused vertex nearer to a patch's plane belongs to it: as far as fusion rounds an edge."""

PATCH_FACING_COS: Final = 0.7
"""Its normal lies within 45 degrees: two faces share their rounded edge."""


THE_FOOT_STAYS: Final = 1000.0
"""Weight of moving the open edge on the plate while a mesh is thinned, in that of a face."""


def fuse_views(
    views: Sequence[Surface],
    acquisitions: Sequence[Acquisition],
    *,
    voxel_m: float = VOXEL_M,
    by_plate: bool = False,
) -> Surface:
    """Merge the surfaces of single views into the complete surface of a product.

    Args:
        views: At least one, each in its camera's frame, from `reconstruct_view`.
        acquisitions: Camera and pose of each view; the world is the product frame.
        voxel_m: Edge of the fusion grid in metres, > 0.
        by_plate: Whether the poses are those of `plate.seen_from`.

    Returns:
        Surface in the product frame, outward normals, closed but for its foot on z = 0.

    Raises:
        ValueError: No view, another number of acquisitions, or nothing in them.
    """
    if not views or len(views) != len(acquisitions):
        raise ValueError(
            f"asked for views with a pose each, found {len(views)} views and"
            f" {len(acquisitions)} poses"
        )
    reported = [each.world_from_camera for each in acquisitions]
    poses = refined_poses(views, reported, by_plate=by_plate)
    seen = np.concatenate(
        [
            moved(view.vertices_m[np.unique(view.triangles)], pose)
            for view, pose in zip(views, poses, strict=True)
        ]
    )
    if len(seen) == 0:
        raise ValueError(f"asked for a surface, found {len(views)} views with nothing in them")
    vertices, triangles = _large_pieces(
        *solid_surface(
            [
                _seen(view, Acquisition(each.camera, pose))
                for view, each, pose in zip(views, acquisitions, poses, strict=True)
            ],
            (seen.min(axis=0), seen.max(axis=0)),
            voxel_m=voxel_m,
        )
    )
    if len(triangles) == 0:
        raise ValueError(f"{len(views)} views contradict each other: no surface is left")
    vertices, triangles = _thinned(vertices, triangles)
    planes = _merged_planes(views, poses)
    return Surface(
        vertices_m=vertices.astype(np.float32),
        triangles=triangles.astype(np.int32),
        patch_of_vertex=_patches_of(
            vertices.astype(np.float64), vertex_normals(vertices, triangles), planes
        ),
        patch_planes=planes,
    )


def refined_poses(
    views: Sequence[Surface], poses: Sequence[Pose], *, by_plate: bool = False
) -> list[Pose]:
    """Fit the views to each other, starting from and held by their acquisition poses.

    Each view in turn moves onto the union of all others, point to plane.

    Args:
        views: Surfaces in their camera frames.
        poses: world_from_camera of each, (4, 4), metres.
        by_plate: Whether the poses are those of `plate.seen_from`: far more certain.

    Returns:
        world_from_camera of each view, refined.
    """
    from scipy.spatial import cKDTree

    refined = [np.array(pose) for pose in poses]
    if len(views) < 2:
        return refined
    random = np.random.default_rng(0)
    points, normals = [], []
    for view in views:
        every = vertex_normals(view.vertices_m, view.triangles)
        chosen = random.permutation(len(every))[:PAIRS_PER_VIEW]
        points.append(view.vertices_m[chosen].astype(float))
        normals.append(every[chosen])
    for _ in range(ROUNDS):
        world = [moved(p, pose) for p, pose in zip(points, refined, strict=True)]
        turned = [n @ pose[:3, :3].T for n, pose in zip(normals, refined, strict=True)]
        trees = [cKDTree(each) for each in world]
        for number in range(len(views)):
            targets, target_normals, sources = [], [], []
            for other in range(len(views)):
                if other == number or not len(world[number]) or not len(world[other]):
                    continue
                distance, index = trees[other].query(
                    world[number], distance_upper_bound=PAIR_REACH_M
                )
                hit = np.isfinite(distance)
                agree = np.zeros_like(hit)
                agree[hit] = (
                    np.einsum("ij,ij->i", turned[number][hit], turned[other][index[hit]]) > 0.8
                )
                sources.append(world[number][agree])
                targets.append(world[other][index[agree]])
                target_normals.append(turned[other][index[agree]])
            if any(map(len, sources)):
                drift = refined[number] @ inverse(np.asarray(poses[number]))
                step = _step(
                    np.concatenate(sources),
                    np.concatenate(targets),
                    np.concatenate(target_normals),
                    drift,
                    _certainty(np.asarray(poses[number])) if by_plate else 1.0,
                )
                refined[number] = step @ refined[number]
    return _without_common_drift(refined, poses)


def vertex_normals(
    vertices_m: npt.NDArray[np.floating], triangles: npt.NDArray[np.integer]
) -> npt.NDArray[np.float64]:
    """Return the normals of vertices, weighted by the areas of their triangles.

    Args:
        vertices_m: (N, 3), metres.
        triangles: (M, 3), vertex numbers, counter-clockwise from outside.

    Returns:
        (N, 3) float64, unit length; zero for a vertex of no triangle.
    """
    a, b, c = (vertices_m[triangles[:, corner]].astype(float) for corner in range(3))
    face = np.cross(b - a, c - a)
    normals = np.zeros((len(vertices_m), 3))
    for axis in range(3):
        for corner in range(3):
            normals[:, axis] += np.bincount(
                triangles[:, corner], face[:, axis], minlength=len(vertices_m)
            )
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.asarray(normals / np.where(length > 0.0, length, 1.0))


def _certainty(pose: Pose) -> float:
    """Return what the spread expected of a pose by the plate is, in those of the robot."""
    return STEEP_SHARE if abs(pose[2, 2]) > STEEP_COS else FLAT_SHARE


def _step(sources: Pose, targets: Pose, normals: Pose, drift: Pose, share: float) -> Pose:
    """Solve one Gauss-Newton step, point to plane with a prior; return the motion in the world.

    The rotation turns about the centre of the points: about the origin of the world, or the
    camera, a rotation would be paid for by a translation and the prior would count it twice.
    """
    centre = sources.mean(axis=0)
    arm = sources - centre
    rows = np.hstack([np.cross(arm, normals), normals])
    error = np.einsum("ij,ij->i", targets - sources, normals)
    spread = max(float(np.median(np.abs(error))) * 1.48, 1e-4)
    weight = 1.0 / (1.0 + (error / (2.0 * spread)) ** 2)
    # Pairs of one patch share their error, so that thousands of them are no thousand witnesses.
    weight *= 100.0 / len(error) / spread**2
    prior = np.repeat([POSE_PRIOR_RAD**-2, POSE_PRIOR_M**-2], 3) / share**2
    from scipy.spatial.transform import Rotation

    turned = Rotation.from_matrix(drift[:3, :3]).as_rotvec()
    shifted = drift[:3, :3] @ centre + drift[:3, 3] - centre
    normal_matrix = (rows * weight[:, None]).T @ rows + np.diag(prior)
    right = (rows * weight[:, None]).T @ error - prior * np.concatenate([turned, shifted])
    about_centre = small_motion(np.linalg.solve(normal_matrix, right))
    to_centre, back = np.eye(4), np.eye(4)
    to_centre[:3, 3], back[:3, 3] = -centre, centre
    return np.asarray(back @ about_centre @ to_centre)


def _without_common_drift(refined: Sequence[Pose], poses: Sequence[Pose]) -> list[Pose]:
    """Take out what all views moved together: no pair of views can know it, their poses do.

    Views from above count most: what flat ones know of the plate's edges is off by ten times more.
    """
    from scipy.spatial.transform import Rotation

    drifts = [after @ inverse(before) for after, before in zip(refined, poses, strict=True)]
    weights = [max(float(abs(pose[2, 2])), 0.1) ** 4 for pose in poses]
    turn = Rotation.from_matrix([drift[:3, :3] for drift in drifts]).mean(weights)
    shift = np.average([drift[:3, 3] for drift in drifts], axis=0, weights=weights)
    common = np.eye(4)
    common[:3, :3], common[:3, 3] = turn.as_matrix(), shift
    return [inverse(common) @ pose for pose in refined]


def _seen(view: Surface, acquisition: Acquisition) -> SeenDepth:
    """Return what a view shows, and the pixels that surely look past the product.

    Without these what lies beyond an edge is unknown to every view, and the surface grows a
    fringe there. A band along the outline stays unknown: there the sensor confuses object and
    background. So do holes in the view, and what it sees of the plate's neighbourhood is decided
    by `solid_surface`.
    """
    from scipy.ndimage import binary_closing, binary_dilation

    depth_m = depth_of_points(view.vertices_m, acquisition.camera)
    known = np.isfinite(depth_m)
    near = binary_dilation(binary_closing(known, iterations=3), iterations=UNKNOWN_BAND_PX)
    return SeenDepth(depth_m, ~near, acquisition)


def _large_pieces(
    vertices: npt.NDArray[np.float32], triangles: npt.NDArray[np.int64]
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.int64]]:
    """Return the connected pieces of a mesh that matter: noise makes crumbs."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    if len(triangles) == 0:
        return vertices, triangles
    ends = triangles[:, [0, 1]], triangles[:, [1, 2]]
    start, end = np.concatenate(ends).T
    graph = coo_matrix((np.ones(len(start), bool), (start, end)), shape=(len(vertices),) * 2)
    piece = connected_components(graph, directed=False)[1][triangles[:, 0]]
    triangles = triangles[np.bincount(piece)[piece] > PIECE_SHARE_MIN * len(triangles)]
    used, renumbered = np.unique(triangles, return_inverse=True)
    return vertices[used], renumbered.reshape(-1, 3)


def _thinned(
    vertices: npt.NDArray[np.float32], triangles: npt.NDArray[np.int64]
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.int64]]:
    """Return a mesh of at most `TRIANGLES_MAX` triangles; what is open stays where it is."""
    if len(triangles) <= TRIANGLES_MAX:
        return vertices, triangles
    whole = mesh(vertices, triangles)
    thin = whole.simplify_quadric_decimation(TRIANGLES_MAX, boundary_weight=THE_FOOT_STAYS)
    return np.asarray(thin.vertices, np.float32), np.asarray(thin.triangles, np.int64)


def _merged_planes(views: Sequence[Surface], poses: Sequence[Pose]) -> Pose:
    """Return the planes of all views in the product frame, one for those that agree, (P, 4)."""
    found: list[tuple[int, Pose]] = []
    for view, pose in zip(views, poses, strict=True):
        for number, plane in enumerate(view.patch_planes):
            normal = pose[:3, :3] @ plane[:3]
            size = int((view.patch_of_vertex == number).sum())
            found.append((size, np.array([*normal, plane[3] - normal @ pose[:3, 3]])))
    merged: list[list[tuple[int, Pose]]] = []
    for size, plane in sorted(found, key=lambda each: -each[0]):
        for group in merged:
            first = group[0][1]
            if first[:3] @ plane[:3] > 0.99 and abs(first[3] - plane[3]) < 0.004:
                group.append((size, plane))
                break
        else:
            merged.append([(size, plane)])
    planes = []
    for group in merged:
        mean = np.average(
            [plane for _, plane in group], axis=0, weights=[size for size, _ in group]
        )
        if len(group) >= 2 or len(views) == 1:
            planes.append(mean / np.linalg.norm(mean[:3]))
    return np.array(planes).reshape(-1, 4)


def _patches_of(vertices_m: Pose, normals: Pose, planes: Pose) -> npt.NDArray[np.int32]:
    """Return each vertex's patch, (N,) int32: the nearest plane in reach that faces its way."""
    if len(planes) == 0:
        return np.full(len(vertices_m), FREE_FORM, np.int32)
    distance = np.abs(vertices_m @ planes[:, :3].T + planes[:, 3])
    distance[normals @ planes[:, :3].T < PATCH_FACING_COS] = np.inf
    nearest = distance.argmin(axis=1)
    near = distance[np.arange(len(nearest)), nearest] < PATCH_REACH_M
    return np.where(near, nearest, FREE_FORM).astype(np.int32)
