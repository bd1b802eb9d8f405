"""Claims about reconstruction, fusion and registration, on simulated views with sensor noise."""

import numpy as np
import pytest

o3d = pytest.importorskip("open3d", exc_type=ImportError)

from scipy.ndimage import binary_erosion  # noqa: E402

from actors.geometry.poses import inverse, moved, on_tray, small_motion, yaw_between, yaw_of  # noqa: E402
from actors.geometry.recognition.deviation import inspect_place  # noqa: E402
from actors.geometry.recognition.registration import register  # noqa: E402
from actors.geometry.recognition.segmentation import assigned, new_pieces, product_on_plate  # noqa: E402
from actors.geometry.shapes import FREE_FORM, VGA, Acquisition, PointCloud, Surface  # noqa: E402
from actors.geometry.surfaces.depth import points_grid  # noqa: E402
from actors.geometry.surfaces.depth_reconstruction import reconstruct_view  # noqa: E402
from actors.geometry.surfaces.fusion import fuse_views, refined_poses  # noqa: E402
from actors.geometry.surfaces.rendering import ray_scene, render_depth  # noqa: E402
from actors.palletizing.simulation.products import product_mesh  # noqa: E402
from actors.palletizing.simulation.sensors import SimulatedOrbitSensor  # noqa: E402


def distances_mm(points_m: np.ndarray, product: str) -> np.ndarray:
    scene = ray_scene(*product_mesh(product))
    return 1e3 * scene.compute_distance(o3d.core.Tensor(points_m.astype(np.float32))).numpy()


def views_of(product: str, count: int) -> tuple[list[Surface], list[Acquisition]]:
    sensor = SimulatedOrbitSensor(seed=8)
    frames = [sensor.capture(product, number, count) for number in range(count)]
    surfaces = [reconstruct_view(product_on_plate(f), f.acquisition.camera) for f in frames]
    return surfaces, [frame.acquisition for frame in frames]


def test_view_of_a_carton_consists_of_its_faces():
    """Three faces are found, cover the view, and lie within half a millimetre of the truth."""
    frame = SimulatedOrbitSensor(seed=8).capture("milk_carton", 1, 14)

    view = reconstruct_view(product_on_plate(frame), VGA)

    assert len(view.patch_planes) == 3
    assert np.mean(view.patch_of_vertex != FREE_FORM) > 0.9
    off = (
        np.einsum("ij,ij->i", view.vertices_m, view.patch_planes[view.patch_of_vertex][:, :3])
        + view.patch_planes[view.patch_of_vertex][:, 3]
    )
    assert np.abs(off[view.patch_of_vertex != FREE_FORM]).max() < 1e-5


def test_bent_film_is_no_planar_patch():
    """A film that rises 4 mm over 120 mm stays free form, however noisy the sensor."""
    frame = SimulatedOrbitSensor(seed=8).capture("meal_tray", 13, 14)

    view = reconstruct_view(product_on_plate(frame), VGA)

    assert np.mean(view.patch_of_vertex == FREE_FORM) > 0.8


def test_triangles_do_not_bridge_an_edge():
    """No triangle joins a product's top to what is seen past its edge."""
    depth = np.full(VGA.shape, 0.60, np.float32)
    depth[:, 320:] = 0.64
    grid = grid_of(depth)

    view = reconstruct_view(PointCloud(grid.reshape(-1, 3)), VGA)

    corners = view.vertices_m[view.triangles][..., 2]
    assert (corners.max(axis=1) - corners.min(axis=1)).max() < 0.03


def grid_of(depth_m: np.ndarray) -> np.ndarray:
    return points_grid(depth_m, VGA)


def test_reconstruction_of_nothing_is_an_empty_surface():
    """An empty cloud gives a surface without vertices, not an error."""
    view = reconstruct_view(PointCloud(np.empty((0, 3), np.float32)), VGA)

    assert len(view.vertices_m) == len(view.triangles) == len(view.patch_planes) == 0


def test_refined_poses_fit_better_than_the_robot():
    """Fitting the views to each other takes off a third of their error; the rest is noise."""
    views, acquisitions = views_of("milk_carton", 10)
    reported = [each.world_from_camera for each in acquisitions]

    refined = refined_poses(views, reported)

    def error(poses: list[np.ndarray]) -> float:
        each = [
            distances_mm(moved(v.vertices_m, p), "milk_carton")
            for v, p in zip(views, poses, strict=True)
        ]
        return float(np.sqrt(np.mean(np.concatenate(each) ** 2)))

    assert error(refined) < 0.65 * error(reported)


def test_refined_poses_keep_to_the_prior_where_views_say_nothing():
    """Views of one plane alone leave three freedoms open: those poses stay where they were."""
    grid = grid_of(np.full(VGA.shape, 0.5, np.float32))[100:300:4, 200:400:4]
    rows = np.arange(50 * 50).reshape(50, 50)
    a, b, c = rows[:-1, :-1].ravel(), rows[1:, :-1].ravel(), rows[:-1, 1:].ravel()
    view = Surface.free_form(grid.reshape(-1, 3), np.column_stack([a, b, c]))
    poses = [np.eye(4), small_motion(np.array([0.0, 0.0, 0.0, 0.001, 0.0, 0.0]))]

    refined = refined_poses([view, view], poses)

    np.testing.assert_allclose(refined[1], poses[1], atol=5e-5)


def test_fused_surface_is_accurate_to_half_a_millimetre(trained):
    """What the overhead sensor will see of a trained carton is right within 0.8 mm."""
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    pose[2, 3] = 0.95
    acquisition = Acquisition(VGA, pose)
    true = Surface.free_form(*product_mesh("milk_carton"))

    seen = render_depth([(trained("milk_carton"), np.eye(4))], acquisition)
    wanted = render_depth([(true, np.eye(4))], acquisition)

    error_mm = 1e3 * np.abs(seen - wanted)[np.isfinite(seen) & np.isfinite(wanted)]
    assert np.percentile(error_mm, 90) < 0.8
    assert np.isfinite(seen)[np.isfinite(wanted)].mean() > 0.99


def test_fused_surface_knows_its_faces(trained):
    """The planar patches of the views are carried over: a carton's surface is mostly faces."""
    surface = trained("milk_carton")

    assert len(surface.patch_planes) >= 4
    assert np.mean(surface.patch_of_vertex != FREE_FORM) > 0.7


def test_fusion_refuses_views_without_poses():
    """Nothing to fuse, or a pose missing, is an error that says how many there were."""
    with pytest.raises(ValueError, match="0 views and 0 poses"):
        fuse_views([], [])


@pytest.mark.parametrize("product", ["milk_carton", "meal_tray"])
def test_registration_finds_a_shifted_product(trained, product):
    """A product 40 mm and 25 degrees off its place is found within 3 mm and 2 degrees."""
    true = on_tray(0.08, -0.12, 0.5)
    cloud, outline = seen_from_above(product, true)

    found = register(cloud, outline, trained(product), on_tray(0.05, -0.09, 0.1)).tray_from_product

    assert np.hypot(*(found[:2, 3] - true[:2, 3])) < 0.003
    assert abs(yaw_between(yaw_of(found), 0.5)) < np.deg2rad(2.0)


def test_registration_of_a_symmetric_product_takes_the_nearer_turn(trained):
    """A tray that looks the same after half a turn is not taken for a turned one."""
    cloud, outline = seen_from_above("meal_tray", on_tray(0.0, 0.1, 0.02))

    found = register(cloud, outline, trained("meal_tray"), on_tray(0.0, 0.1, 0.0)).tray_from_product

    assert abs(yaw_of(found)) < np.deg2rad(5.0)


def test_registration_is_upright(trained):
    """Height and tilt are the tray's: the result turns about z only and stays on it."""
    cloud, outline = seen_from_above("milk_carton", on_tray(0.0, 0.0, 0.3))

    found = register(cloud, outline, trained("milk_carton"), np.eye(4)).tray_from_product

    np.testing.assert_allclose(found[2], [0.0, 0.0, 1.0, 0.0], atol=1e-12)


def seen_from_above(product: str, pose: np.ndarray) -> tuple[PointCloud, np.ndarray]:
    """Points and outline of a true product as an overhead sensor has them, tray frame."""
    above = np.diag([1.0, -1.0, -1.0, 1.0])
    above[2, 3] = 0.95
    true = Surface.free_form(*product_mesh(product))
    depth = render_depth([(true, pose)], Acquisition(VGA, above))
    known = np.isfinite(depth)
    depth += np.random.default_rng(4).normal(0.0, 0.0017, depth.shape).astype(np.float32)
    points = moved(grid_of(depth).reshape(-1, 3), above).reshape(*depth.shape, 3)
    outline = points[known & ~binary_erosion(known)][:, :2]
    return PointCloud(points[known].astype(np.float32)), outline


def test_pieces_are_matched_once_and_within_reach():
    """Of two pieces near one known package only the nearer is it; one far off is new."""
    known = [np.array([0.0, 0.0]), np.array([0.2, 0.0])]
    found = [np.array([0.02, 0.0]), np.array([0.005, 0.0]), np.array([0.5, 0.5])]

    assert assigned(found, known) == [None, 0, None]
    assert assigned(found, []) == [None, None, None]


def test_empty_tray_has_no_pieces(tray):
    """Two images of an empty tray differ by noise only."""
    frame = tray.capture_empty()

    assert new_pieces(frame, np.roll(frame.depth_mm, 1, axis=1)) == []


def test_inspection_says_missing_where_nothing_came(tray, trained):
    """An empty place is reported with the height that is not there."""
    frame = tray.capture_empty()

    found = inspect_place(frame, frame.depth_mm, trained("milk_carton"), on_tray(0.1, 0.1, 0.0))

    assert found.verdict == "missing"
    # The 95th percentile of the sensor's own noise is 2.8 mm.
    assert found.deviation_mm == pytest.approx(70.0, abs=4.0)


def test_inverse_pose_is_used_consistently(trained):
    """Moving the surface or the camera the other way gives the same image."""
    surface, shift = trained("meal_tray"), on_tray(0.05, 0.02, 0.4)
    above = np.diag([1.0, -1.0, -1.0, 1.0])
    above[2, 3] = 0.95

    one = render_depth([(surface, shift)], Acquisition(VGA, above))
    other = render_depth([(surface, np.eye(4))], Acquisition(VGA, inverse(shift) @ above))

    np.testing.assert_allclose(one, other, atol=1e-5)
