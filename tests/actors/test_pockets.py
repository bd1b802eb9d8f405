"""Pockets: who goes where no camera sees stays there until they come out."""

from __future__ import annotations

import numpy as np
import pytest

from actors.geometry.hull.pockets import Pockets

from .hull_parts import small_grid

GRID = small_grid(0.05)


def rows_of(low, high):
    """Return the rows of a box of voxels."""
    index = np.stack(np.meshgrid(*[np.arange(a, b) for a, b in zip(low, high, strict=True)]), -1)
    return GRID.rows_of(index.reshape(-1, 3))


HIDDEN = rows_of((16, 16, 4), (24, 24, 10))
BESIDE = rows_of((24, 16, 4), (31, 24, 12))
ELSEWHERE = rows_of((0, 0, 0), (4, 4, 20))


def pockets_of(rows):
    """Return the pockets of a grid in which no camera sees these rows."""
    unseen = np.zeros(GRID.voxels, bool)
    unseen[rows] = True
    return Pockets(GRID, unseen)


def note(pockets, visible, unseen=()):
    """Note one component with visible voxels, and unseen ones; return what `note` returns."""
    unseen = np.array(unseen, np.int64)
    rows = np.concatenate([visible, unseen]).astype(np.int64)
    seen = np.arange(len(rows)) < len(visible)
    return pockets.note(rows, np.ones(len(rows), np.int64), seen)


NOTHING = np.empty(0, np.int64)


def test_who_goes_in_holds_the_pocket_and_who_comes_out_frees_it():
    """Touched, vanished: held for as long as it takes; out again with the same volume: free."""
    pockets = pockets_of(HIDDEN)
    assert pockets.count == 1
    note(pockets, BESIDE, HIDDEN)
    assert not pockets.held.any()
    for _ in range(50):
        note(pockets, NOTHING)
        assert pockets.held.all()
    assert pockets.held_voxels(HIDDEN).all()
    assert not pockets.held_voxels(BESIDE).any()
    assert pockets.held_blocks.any()
    note(pockets, BESIDE, HIDDEN)
    assert pockets.held.all()
    note(pockets, BESIDE)
    assert not pockets.held.any()
    assert not pockets.held_blocks.any()


def test_a_pocket_that_is_held_from_now_on_is_named_once():
    """The set in which the last visible part vanishes has to hold it already."""
    pockets = pockets_of(HIDDEN)
    assert not note(pockets, BESIDE, HIDDEN)
    assert note(pockets, NOTHING)
    assert not note(pockets, NOTHING)


def test_who_only_walks_past_leaves_it_free():
    """A person that touches a pocket and walks on is beside it in the next set."""
    pockets = pockets_of(HIDDEN)
    note(pockets, BESIDE, HIDDEN)
    note(pockets, BESIDE)
    note(pockets, NOTHING)
    assert not pockets.held.any()


def test_who_stands_elsewhere_does_not_free_it():
    """Another person far from the pocket says nothing about who is in it."""
    pockets = pockets_of(HIDDEN)
    note(pockets, BESIDE, HIDDEN)
    note(pockets, ELSEWHERE)
    assert pockets.held.all()


def test_a_pocket_too_small_for_a_person_is_none():
    """Where only a hand fits nobody hides."""
    pockets = pockets_of(HIDDEN[:100])
    assert pockets.count == 0
    note(pockets, BESIDE, HIDDEN[:100])
    note(pockets, NOTHING)
    assert not pockets.held_voxels(HIDDEN).any()


def test_a_pocket_at_the_side_is_always_held():
    """From outside anybody may walk into it unseen."""
    side = rows_of((0, 12, 4), (8, 20, 10))
    pockets = pockets_of(side)
    assert pockets.held.all()
    note(pockets, NOTHING)
    assert pockets.held_voxels(side).all()


@pytest.mark.parametrize("larger", [False, True])
def test_when_other_cameras_look_what_was_held_stays_held(larger):
    """A pocket of other cameras that shares voxels with a held one is held."""
    pockets = pockets_of(HIDDEN)
    note(pockets, BESIDE, HIDDEN)
    note(pockets, NOTHING)
    unseen = np.zeros(GRID.voxels, bool)
    unseen[np.concatenate([HIDDEN, BESIDE]) if larger else HIDDEN] = True
    after = Pockets(GRID, unseen, pockets)
    assert after.held.all()
    note(after, rows_of((28, 16, 20), (31, 20, 23)))
    assert after.held.all()


def test_who_stands_in_the_opening_can_reach_the_near_part():
    """What is unseen and near counts at once; so does nothing of a pocket that nobody touches."""
    pockets = pockets_of(HIDDEN)
    blocks = np.zeros(GRID.block_shape, bool)
    blocks.ravel()[BESIDE >> 6] = True
    near = np.zeros(GRID.block_shape, bool)
    near[5:] = True  # i from 20 on: one of two blocks
    rows = np.concatenate([HIDDEN, BESIDE])
    touched = blocks.copy()
    touched[5] |= blocks[6]

    entered = pockets.entered(rows, touched, near)

    i = GRID.indices(rows)[:, 0]
    assert set(rows[entered]) == set(HIDDEN) & set(rows[i >= 20])
    assert entered.any()
    assert not pockets.entered(rows, np.zeros_like(blocks), near).any()
