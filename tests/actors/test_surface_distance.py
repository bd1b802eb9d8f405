"""How far two shapes are apart, and what the comparators of the actors say of it."""

import numpy as np
import pytest

pytest.importorskip("open3d", exc_type=ImportError)

from hypothesis import given, settings
from hypothesis import strategies as st

from actors.comparators import CloudDistance, SurfaceDistance
from actors.geometry.shapes import PointCloud, Surface
from actors.geometry.surfaces.surface_distance import Mesh, clouds_apart, samples_on, surfaces_apart
from enact_dist.comparing import EQUAL

PATCH = np.array([[0, 1, 2], [1, 3, 2]])


def plate(height_m=0.0, size_m=0.2, cells=1):
    """A level square plate, of `cells` x `cells` squares of two triangles each."""
    axis = np.linspace(0.0, size_m, cells + 1)
    x, y = np.meshgrid(axis, axis)
    vertices = np.stack([x.ravel(), y.ravel(), np.full(x.size, height_m)], 1)
    corner = (np.arange(cells)[:, None] * (cells + 1) + np.arange(cells)).ravel()
    one = np.stack([corner, corner + 1, corner + cells + 1], 1)
    other = np.stack([corner + 1, corner + cells + 2, corner + cells + 1], 1)
    return Surface.free_form(vertices, np.concatenate([one, other]))


def moved(surface, **vertices):
    """The same surface with some vertices put elsewhere, by number."""
    points = surface.vertices_m.copy()
    for number, offset in vertices.items():
        points[int(number[1:])] += offset
    return Surface.free_form(points, surface.triangles)


def test_distance_of_parallel_plates_is_their_distance():
    """Every point of either is as far from the other; the tolerance is inclusive of nothing beyond."""
    found = SurfaceDistance(tolerance_m=0.002)(plate(), plate(0.003))
    assert found.distance == pytest.approx(0.003, abs=1e-6)
    assert (found.crossed, found.unit, found.tolerance) == (True, "m", 0.002)
    assert not SurfaceDistance(tolerance_m=0.004)(plate(), plate(0.003)).crossed


def test_triangulation_does_not_count():
    """One plate of two triangles and one of 800 are the same surface."""
    assert SurfaceDistance(tolerance_m=1e-6)(plate(), plate(cells=20)).crossed is False
    assert SurfaceDistance(tolerance_m=0.0)(plate(), plate()) == EQUAL


def test_part_and_whole_differ_both_ways():
    """Every point of half a plate lies on the whole; the whole lies 100 mm off the half."""
    whole, half = plate(size_m=0.2), plate(size_m=0.1)
    largest = SurfaceDistance(tolerance_m=0.01, share=1.0)
    assert largest(whole, half).distance == pytest.approx(np.hypot(0.1, 0.1), abs=1e-3)
    assert largest(half, whole).distance == largest(whole, half).distance
    assert largest(half, whole).crossed


def test_bulge_is_found_and_named_where_it_is():
    """A vertex that stands out decides the largest distance, and no share of 95 %."""
    flat = plate(cells=20)
    bulged = moved(flat, v220=np.array([0.0, 0.0, 0.02]))
    x, y = flat.vertices_m[220, :2]
    by_share, by_largest = SurfaceDistance(0.002), SurfaceDistance(0.002, share=1.0)
    assert not by_share(flat, bulged).crossed
    found = by_largest(flat, bulged)
    assert found.crossed
    assert found.what.endswith("largest 20.00 mm (right)")
    assert found.where == f"({x:.4f}, {y:.4f}, 0.0200) m"
    assert by_largest(bulged, flat).what.endswith("(left)")


def test_hole_is_seen_from_the_other_side():
    """A missing piece is near the whole, and the whole is not near it."""
    whole = plate(cells=20)
    centre = whole.vertices_m[whole.triangles].mean(1)
    keep = np.abs(centre[:, :2] - 0.1).max(1) > 0.04
    holed = Surface.free_form(whole.vertices_m, whole.triangles[keep])
    found = SurfaceDistance(tolerance_m=0.002)(whole, holed)
    assert found.crossed
    assert found.distance == SurfaceDistance(tolerance_m=0.002)(holed, whole).distance


def test_nothing_is_near_an_empty_surface():
    """A surface without triangles is nowhere; two of them do not differ."""
    empty = Surface.free_form(np.zeros((0, 3)), np.zeros((0, 3), int))
    assert SurfaceDistance(1.0)(plate(), empty).crossed
    assert SurfaceDistance(1.0)(empty, plate()).what == "one of them is empty"
    assert SurfaceDistance(0.0)(empty, empty) == EQUAL


def test_samples_lie_on_the_surface_and_are_spread_by_area():
    """A large triangle gets as many more samples as it is larger; each call gives the same ones."""
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [3, 0, 0], [0, 3, 1.0]])
    mesh = Mesh(vertices, np.array([[0, 1, 2], [0, 3, 4]]))
    points, triangle = samples_on(mesh, 9000)
    on_first = (points[:, 2] == 0.0) & (points[:, :2].sum(1) <= 1.0 + 1e-9)
    np.testing.assert_array_equal(triangle, np.where(on_first, 0, 1))
    ratio = 3.0 * np.sqrt(10.0)  # of the two areas
    assert on_first.sum() == pytest.approx(9000 / (1.0 + ratio), rel=0.02)
    rest = points[~on_first]
    np.testing.assert_allclose(rest[:, 2], rest[:, 1] / 3.0, atol=1e-12)
    assert (rest[:, 0] / 3.0 + rest[:, 1] / 3.0 <= 1.0 + 1e-9).all()
    np.testing.assert_array_equal(points, samples_on(mesh, 9000)[0])


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 1000), st.floats(0.5, 1.0))
def test_distances_are_the_same_either_way_round(seed, share):
    """Whatever the shapes, and whichever of them is called left."""
    random = np.random.default_rng(seed)
    one, other = (Mesh(random.normal(size=(4, 3)), PATCH) for _ in range(2))
    there, back = surfaces_apart(one, other, share=share), surfaces_apart(other, one, share=share)
    assert (there.share_m, there.largest_m) == (back.share_m, back.largest_m)
    assert 0.0 < there.share_m <= there.largest_m
    assert surfaces_apart(one, one, share=share).largest_m == 0.0


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 1000), st.floats(0.5, 1.0))
def test_clouds_are_as_far_apart_as_their_nearest_points(seed, share):
    """Against the table of all distances."""
    random = np.random.default_rng(seed)
    left, right = random.normal(size=(20, 3)), random.normal(size=(30, 3))
    table = np.linalg.norm(left[:, None] - right[None], axis=2)
    ways = table.min(1), table.min(0)
    found = clouds_apart(left, right, share=share)
    assert found.largest_m == pytest.approx(max(way.max() for way in ways))
    wanted = max(np.quantile(way, share, method="higher") for way in ways)
    assert found.share_m == pytest.approx(wanted)
    assert clouds_apart(right, left, share=share).share_m == found.share_m


def test_cloud_comparator_counts_points():
    """One stray point of a hundred stays below a share of 95 %."""
    points = np.random.default_rng(1).random((100, 3)).astype(np.float32)
    stray = points.copy()
    stray[3] += 5.0
    assert not CloudDistance(0.3)(PointCloud(points), PointCloud(stray)).crossed
    assert CloudDistance(0.3, share=1.0)(PointCloud(points), PointCloud(stray)).crossed
    assert CloudDistance(0.0)(PointCloud(points), PointCloud(points.copy())) == EQUAL


@pytest.mark.parametrize("wrong", [(-0.1, 0.95), (float("nan"), 0.95), (0.1, 0.0), (0.1, 1.5)])
@pytest.mark.parametrize("kind", [SurfaceDistance, CloudDistance])
def test_what_cannot_be_kept_to_is_refused(kind, wrong):
    """Tolerances are metres from 0 on, shares lie above 0."""
    with pytest.raises(ValueError, match="tolerance_m"):
        kind(*wrong)
