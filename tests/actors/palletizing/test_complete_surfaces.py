"""Claims about the complete surface of a product: closed, true, and nothing left out."""

import numpy as np
import pytest

o3d = pytest.importorskip("open3d", exc_type=ImportError)

from actors.geometry.fusion import fuse_views, vertex_normals  # noqa: E402
from actors.geometry.poses import looking_at  # noqa: E402
from actors.geometry.rendering import directions, ray_scene  # noqa: E402
from actors.geometry.shapes import VGA, Acquisition, Surface  # noqa: E402
from actors.geometry.solid import SeenDepth, solid_surface  # noqa: E402
from actors.palletizing.simulation.products import PRODUCTS, product_mesh  # noqa: E402


def points_on(vertices_m: np.ndarray, triangles: np.ndarray, count: int = 20_000) -> np.ndarray:
    """Points spread evenly over a mesh, (N, 3), always the same ones."""
    random = np.random.default_rng(3)
    a, b, c = (np.asarray(vertices_m, float)[triangles[:, corner]] for corner in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    chosen = random.choice(len(area), count, p=area / area.sum())
    one, other = random.random((2, count, 1))
    folded = one + other > 1.0
    one, other = np.where(folded, 1.0 - one, one), np.where(folded, 1.0 - other, other)
    return np.asarray(a[chosen] + one * (b - a)[chosen] + other * (c - a)[chosen])


def distances_mm(points_m: np.ndarray, vertices_m: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    scene = ray_scene(vertices_m, triangles)
    return 1e3 * scene.compute_distance(o3d.core.Tensor(points_m.astype(np.float32))).numpy()


@pytest.mark.parametrize("product", PRODUCTS)
def test_fused_surface_is_true_to_the_product(trained, product):
    """It lies within 1 mm (root mean square) and 2 mm (95 %) of the true shape, walls included."""
    surface = trained(product)

    off_mm = distances_mm(points_on(surface.vertices_m, surface.triangles), *product_mesh(product))

    assert np.sqrt(np.mean(off_mm**2)) < 1.0
    assert np.percentile(off_mm, 95) < 2.0


@pytest.mark.parametrize("product", PRODUCTS)
def test_fused_surface_leaves_nothing_out(trained, product):
    """97 % of the true surface but its bottom has fused surface within 3 mm."""
    surface = trained(product)
    true = points_on(*product_mesh(product))
    true = true[true[:, 2] > 1e-4]

    off_mm = distances_mm(true, surface.vertices_m, surface.triangles)

    assert np.mean(off_mm < 3.0) > 0.97


@pytest.mark.parametrize("product", PRODUCTS)
def test_fused_surface_is_open_only_where_it_stands(trained, product):
    """Every edge that belongs to one triangle only lies on the plate."""
    surface = trained(product)
    edges = np.sort(surface.triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    unique, uses = np.unique(edges, axis=0, return_counts=True)

    assert uses.max() == 2
    assert np.abs(surface.vertices_m[unique[uses == 1]][..., 2]).max() < 1e-6


def test_fused_surface_faces_outwards(trained):
    """Triangles are counter-clockwise from outside: the top looks up."""
    surface = trained("milk_carton")
    top = surface.vertices_m[:, 2] > 0.068

    assert vertex_normals(surface.vertices_m, surface.triangles)[top, 2].mean() > 0.7


def test_pixels_and_grid_points_meet_without_a_shift():
    """A slope seen by one view without noise comes out where it is: half a pixel were 0.3 mm."""
    pose = looking_at(np.array([0.0, 0.0, 0.45]), np.zeros(3))
    normal = np.array([-0.5, -0.5, 1.0]) / np.sqrt(1.5)
    rays = directions(VGA) @ pose[:3, :3].T
    depth = normal @ (np.array([0.0, 0.0, 0.05]) - pose[:3, 3]) / (rays @ normal)
    view = SeenDepth(depth.astype(np.float32), np.zeros(VGA.shape, bool), Acquisition(VGA, pose))

    vertices, _ = solid_surface(
        [view], (np.array([-0.03, -0.03, 0.0]), np.array([0.03, 0.03, 0.1])), voxel_m=0.002
    )

    inner = vertices[(np.abs(vertices[:, :2]) < 0.025).all(axis=1) & (vertices[:, 2] > 0.02)]
    off_mm = 1e3 * (inner - [0.0, 0.0, 0.05]) @ normal
    assert len(inner) > 400
    assert abs(off_mm.mean()) < 0.1


def test_fusion_refuses_views_of_nothing():
    """Views without a point have no surface, and the error says how many there were."""
    empty = Surface.free_form(np.empty((0, 3)), np.empty((0, 3)))
    seen_by = Acquisition(VGA, np.eye(4))

    with pytest.raises(ValueError, match="2 views with nothing in them"):
        fuse_views([empty, empty], [seen_by, seen_by])


def test_grid_beyond_its_limit_is_refused():
    """Bounds that would fill the memory are an error that names the grid."""
    far = np.array([5.0, 5.0, 5.0])

    with pytest.raises(ValueError, match="use a coarser grid"):
        solid_surface([], (-far, far), voxel_m=0.002)
