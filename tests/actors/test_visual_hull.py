"""The visual hull: never smaller than who is seen by all, whatever the order and number of cameras."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from actors.geometry.capsules import distance_to_points
from actors.geometry.hull.silhouettes import packed

from .hull_parts import BODY, bits_of, hull_of, masks_of, ring, small_grid

SEEDS = st.integers(0, 2**32 - 1)
GRID = small_grid()
CAMERAS = ring(8)
HULL = hull_of(GRID, CAMERAS)
ALL = np.arange(GRID.blocks)
SLOW = settings(max_examples=15, deadline=None)


def some_body(random):
    """Return three capsules in the middle of the cell."""
    ends = random.uniform((-0.45, -0.45, 0.2), (0.45, 0.45, 1.1), (3, 2, 3)).reshape(3, 6)
    return np.concatenate([ends, random.uniform(0.05, 0.12, (3, 1))], 1)


def carved(bits, hull=HULL):
    """Return the rows of the hull of a set, as a set."""
    hull.load(bits)
    return set(hull.carve(np.arange(hull.grid.blocks)).tolist())


def test_an_empty_set_leaves_what_no_camera_sees():
    """Without foreground only voxels remain about which no camera has a say."""
    silent = np.ones(GRID.voxels, bool)
    for table in HULL.tables:
        silent &= table.pixel == table.sentinel
    assert carved(bits_of(np.empty((0, 7)), CAMERAS)) == set(np.flatnonzero(silent).tolist())


@given(SEEDS)
@SLOW
def test_blocks_first_changes_nothing(seed):
    """Two levels leave the voxels that looking at each voxel in each camera leaves."""
    random = np.random.default_rng(seed)
    masks = [(random.random(mask.shape) < 0.002) * 255 + mask for mask in masks_of(BODY, CAMERAS)]
    bits = [packed(mask) for mask in masks]
    found = carved(bits)
    rows = np.arange(GRID.voxels)
    kept = np.ones(GRID.voxels, bool)
    for masks, table in zip(HULL._masks, HULL.tables, strict=True):
        kept &= masks.pixels[table.pixel] > 0
    assert found == set(rows[kept].tolist())


@given(SEEDS)
@SLOW
def test_the_hull_is_never_smaller_than_the_body(seed):
    """Every voxel that any point of the body lies in is in the hull."""
    random = np.random.default_rng(seed)
    body = some_body(random)
    points = random.uniform((-0.79, -0.79, 0.01), (0.79, 0.79, 1.59), (40_000, 3))
    inside = points[distance_to_points(body, points) <= 0.0]
    index = np.floor((inside - GRID.origin_m) / GRID.voxel_m).astype(int)
    of_body = set(GRID.rows_of(index).tolist())
    assert len(of_body) > 50
    assert of_body <= carved(bits_of(body, CAMERAS))


@given(SEEDS)
@SLOW
def test_order_number_and_silence_of_cameras(seed):
    """Order does not matter; fewer cameras, and cameras without a silhouette, only add voxels."""
    random = np.random.default_rng(seed)
    bits = bits_of(some_body(random), CAMERAS)
    whole = carved(bits)
    order = random.permutation(8)
    turned = type(HULL)(GRID, [HULL.tables[n] for n in order])
    assert carved([bits[n] for n in order], turned) == whole
    fewer = order[:5]
    part = type(HULL)(GRID, [HULL.tables[n] for n in fewer])
    of_part = carved([bits[n] for n in fewer], part)
    assert whole <= of_part
    assert carved([b if n in fewer else None for n, b in enumerate(bits)]) == of_part
    ones = [b if n in fewer else np.full_like(b, 255) for n, b in enumerate(bits)]
    assert carved(ones) == of_part


def test_a_set_leaves_nothing_of_the_last_one():
    """Masks of one set do not shine through in the next."""
    random = np.random.default_rng(1)
    first, second = (bits_of(some_body(random), CAMERAS) for _ in range(2))
    alone = carved(second, hull_of(GRID, CAMERAS))
    carved(first)
    assert carved(second) == alone


def test_a_finer_grid_lies_within_the_coarse_one_grown_by_a_voxel():
    """Halving the voxel shrinks the hull; each fine voxel has a coarse one within one voxel."""
    fine_grid = small_grid(0.025)
    fine = hull_of(fine_grid, CAMERAS)
    bits = bits_of(BODY, CAMERAS)
    fine_rows = np.array(sorted(carved(bits, fine)))
    coarse_rows = np.array(sorted(carved(bits)))
    coarse = GRID.dense(coarse_rows)
    grown = coarse.copy()
    for axis in range(3):
        grown |= np.roll(grown, 1, axis) | np.roll(grown, -1, axis)
    i, j, k = (fine_grid.indices(fine_rows) // 2).T
    assert grown[i, j, k].all()
    assert len(fine_rows) / 8 < len(coarse_rows)


def test_what_one_camera_alone_says_to_be_free_is_found():
    """What a blind camera takes away is exactly what only it says to be free."""
    bits = bits_of(BODY, CAMERAS)
    whole = carved(bits)
    bits[3] = np.zeros_like(bits[3])
    left = carved(bits)
    near = np.zeros(GRID.block_shape, bool)
    none, one = (set(rows.tolist()) for rows in HULL.carve_leniently(~near))
    assert none == left
    assert whole - left <= one
    assert not one & left
    assert len(whole - left) > 100
    near[8:] = True
    none, some = (set(rows.tolist()) for rows in HULL.carve_leniently(near))
    assert none == left
    assert some == {row for row in one if near.ravel()[row >> 6]} != one


def test_the_tight_set_is_what_has_its_centre_in_every_silhouette():
    """It lies within the hull and comes nearer to the body."""
    bits = bits_of(BODY, CAMERAS)
    HULL.load(bits)
    rows = HULL.carve(ALL)
    tight = HULL.tight(rows)
    distance = distance_to_points(BODY, GRID.centres(rows))
    assert 0 < tight.sum() < len(rows)
    assert tight[distance < -0.02].all()
    assert np.median(distance[tight]) < np.median(distance[~tight])


def test_a_camera_that_dies_makes_the_hull_larger_only():
    """One silhouette less, set by set, until no camera is left: the hull grows, then is all."""
    bits = bits_of(BODY, CAMERAS)
    before = carved(bits)
    for number in range(8):
        bits[number] = None
        now = carved(bits)
        assert before <= now
        before = now
    assert len(before) == GRID.voxels


def test_wrong_silhouettes_are_refused():
    """Another number of silhouettes and one of another size are said in one line."""
    bits = bits_of(BODY, CAMERAS)
    with pytest.raises(ValueError, match="asked for 8 silhouettes, one per camera, found 7"):
        HULL.load(bits[:7])
    with pytest.raises(ValueError, match=r"320 x 240 pixels .* found uint8 of shape"):
        HULL.load([*bits[:7], bits[7][:60]])
