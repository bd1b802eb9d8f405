"""Refinement: each rule takes what it is for, and not the voxels that it must leave."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest

from actors.geometry.capsules import distance_between, distance_to_points
from actors.geometry.hull.overruled import grown
from actors.geometry.hull.refinement import Refinement
from actors.geometry.hull.silhouettes import Subtraction, packed

from .hull_parts import BODY, bits_of, box_row, hull_of, masks_of, ring, small_grid

NOBODY = np.empty((0, 7))
FAR_ARM = np.array([[-0.45, -0.45, 0.2, -0.45, -0.45, 0.6, 0.06]])
NO_ARM = np.array([[9.0, 9.0, 9.0, 9.0, 9.0, 9.5, 0.05]])
PERIOD_S = 0.1


@lru_cache
def hull_with(voxel_m, cameras):
    """Return a hull over the small grid, made once."""
    return hull_of(small_grid(voxel_m), ring(cameras))


class Cell:
    """A refinement of a small cell, fed with exact silhouettes."""

    def __init__(self, voxel_m=0.05, cameras=8, boxes=()):
        self.cameras = ring(cameras)
        self.boxes = [np.array(boxes)] if len(boxes) else []
        self.hull = hull_with(voxel_m, cameras)
        if len(boxes):
            self.hull = hull_of(self.hull.grid, self.cameras, self.boxes)
        self.grid = self.hull.grid
        self.refinement = Refinement(self.hull, self.cameras, self.boxes)

    def step(self, seen, arm=NO_ARM, elapsed_s=PERIOD_S, bits=None):
        """Return what is occupied when cameras see capsules."""
        return self.refinement.step(bits or bits_of(seen, self.cameras), arm, elapsed_s)

    def rows_in(self, capsules):
        """Return the voxels whose centre lies in capsules."""
        rows = np.arange(self.grid.voxels)
        return rows[distance_to_points(capsules, self.grid.centres(rows)) <= 0.0]


@pytest.fixture
def cell():
    """A cell without obstacles that has seen one empty set."""
    made = Cell()
    assert len(made.step(NOBODY).rows) == 0
    return made


def entered(cell, capsules=BODY, arm=NO_ARM):
    """Return the result of a first set after a gap: R4 does not look back over it."""
    return cell.step(capsules, arm, elapsed_s=5.0)


def test_a_body_is_kept_with_its_distance_and_its_parts():
    """Safe holds tight holds the body's core; the nearest voxel is at most as far as the body."""
    cell = Cell(voxel_m=0.025)
    found = entered(cell, np.concatenate([BODY, FAR_ARM]), FAR_ARM)
    body, true_m = set(cell.rows_in(BODY).tolist()), distance_between(BODY, FAR_ARM)
    assert body <= set(found.rows.tolist())
    assert found.tight.any()
    assert not found.tight.all()
    assert set(np.unique(found.component)) == {0}
    assert true_m - 0.25 < found.clearance_m[found.nearest] <= true_m
    assert found.clearance_m[found.nearest] == found.clearance_m.min()


def test_an_empty_cell_has_nothing_near(cell):
    """Nothing is occupied, no voxel is the nearest; what is raw are corners that no camera sees."""
    found = cell.step(NOBODY)
    assert found.nearest == -1
    assert len(found.rows) == len(found.tight) == 0
    assert found.counts["raw"] == found.counts["unseen"] + found.counts["unreachable"]


def test_static_voxels_never_count():
    """R0: foreground in front of a box is no voxel in it; what stands beside it stays whole."""
    box = box_row((0.3, 0.1, 0.2), (0.1, 0.2, 0.2))
    cell = Cell(boxes=[box])
    found = entered(cell)
    inside = np.abs(cell.grid.centres(found.rows) - box[:3]) < box[3:6]
    assert not inside.all(1).any()
    assert found.counts["static"] > 0
    body = cell.rows_in(BODY)
    body = body[~(np.abs(cell.grid.centres(body) - box[:3]) < box[3:6]).all(1)]
    assert set(body.tolist()) <= set(found.rows.tolist())


def test_the_robot_is_no_obstacle_and_who_stands_half_a_metre_off_is():
    """R1 and R3: an arm alone leaves nothing; a body beside it stays whole."""
    cell = Cell(voxel_m=0.025)
    alone = entered(cell, FAR_ARM, FAR_ARM)
    assert len(alone.rows) == 0
    assert alone.counts["robot"] > 20
    assert alone.counts["explained"] > 0
    both = entered(cell, np.concatenate([BODY, FAR_ARM]), FAR_ARM)
    assert set(cell.rows_in(BODY).tolist()) <= set(both.rows.tolist())
    assert both.clearance_m.min() > 0.15


def test_the_robot_explains_only_its_shell(cell):
    """R3: farther than 10 cm nothing is explained, though all cameras see it on the robot."""
    thick = FAR_ARM + np.array([0, 0, 0, 0, 0, 0, 0.16])
    found = entered(cell, thick, FAR_ARM)
    distance = distance_to_points(FAR_ARM, cell.grid.centres(cell.rows_in(thick)))
    beyond = cell.rows_in(thick)[distance > 0.1]
    assert len(beyond) > 20
    assert set(beyond.tolist()) <= set(found.rows.tolist())


def test_what_a_camera_sees_beside_the_robot_is_not_explained(cell):
    """R3: a hand 4 cm beside the arm sticks out of its outline somewhere and stays."""
    hand = np.array([[-0.45, -0.2, 0.4, -0.25, -0.15, 0.5, 0.08]])
    found = entered(cell, np.concatenate([FAR_ARM, hand]), FAR_ARM)
    distance = distance_to_points(hand, cell.grid.centres(found.rows))
    assert (distance < 0.0).sum() > 10


def test_without_the_pose_of_the_robot_all_is_at_distance_zero(cell):
    """Nothing is taken for a robot whose pose is not known."""
    found = entered(cell, FAR_ARM, None)
    assert len(found.rows) > 20
    assert found.counts["robot"] == found.counts["explained"] == 0
    assert found.clearance_m.max() <= 0.0


def test_a_fly_is_too_small_and_a_hand_is_not():
    """R2: less than half a litre goes, two litres stay."""
    cell = Cell(voxel_m=0.025)
    fly = np.array([[0.0, 0.0, 0.8, 0.0, 0.0, 0.8, 0.004]])
    hand = np.array([[0.0, 0.0, 0.8, 0.0, 0.1, 0.8, 0.04]])
    gone, kept = entered(cell, fly), entered(cell, hand)
    assert len(gone.rows) == 0
    assert gone.counts["small"] > 0
    assert set(cell.rows_in(hand).tolist()) <= set(kept.rows.tolist())


def test_nobody_appears_in_the_middle(cell):
    """R4: what was not there and does not come from a side goes; who comes from a side stays."""
    middle = np.array([[0.0, 0.0, 0.6, 0.0, 0.0, 0.8, 0.1]])
    found = cell.step(middle)
    assert len(found.rows) == 0
    assert found.counts["unreachable"] > 0
    cell.step(NOBODY)
    for place in np.arange(0.75, 0.0, -0.2):
        walking = middle + place * np.array([1, 0, 0, 1, 0, 0, 0])
        found = cell.step(walking)
    assert set(cell.rows_in(walking).tolist()) <= set(found.rows.tolist())


@pytest.mark.parametrize("elapsed_s", [1.5, -0.1])
def test_after_a_gap_anything_may_be_anywhere(cell, elapsed_s):
    """R4 holds over less than a second, and only forwards."""
    middle = np.array([[0.0, 0.0, 0.6, 0.0, 0.0, 0.8, 0.1]])
    assert len(cell.step(middle, elapsed_s=elapsed_s).rows) > 0


def test_a_longer_step_reaches_farther(cell):
    """R4: after 0.3 s a person may be 0.9 m from the side."""
    walking = np.array([[0.25, 0.0, 0.6, 0.25, 0.0, 0.8, 0.1]])
    assert len(cell.step(walking, elapsed_s=0.1).rows) == 0
    assert len(Cell().step(NOBODY).rows) == 0
    again = Cell()
    again.step(NOBODY)
    assert len(again.step(walking, elapsed_s=0.3).rows) > 0


def test_a_robot_that_is_taken_for_background_hides_who_is_behind_it(cell):
    """Where the robot is drawn a camera says nothing: a missed link frees no one behind it."""
    behind = np.array([[-0.6, -0.6, 0.1, -0.6, -0.6, 0.8, 0.12]])
    bits = bits_of(behind, cell.cameras)
    arm = bits_of(FAR_ARM, cell.cameras)
    missed = [one & ~other for one, other in zip(bits, arm, strict=True)]
    found = cell.step(behind, FAR_ARM, 5.0, missed)
    body = cell.rows_in(behind)
    body = body[distance_to_points(FAR_ARM, cell.grid.centres(body)) > 0.11]
    assert set(body.tolist()) <= set(found.rows.tolist())
    unaware = Cell().step(behind, NO_ARM, 5.0, missed)
    assert not set(body.tolist()) <= set(unaware.rows.tolist())


def blind(bits, cameras, share=1.0):
    """Return silhouettes of which some cameras lack the upper part."""
    result = list(bits)
    for number in cameras:
        part = result[number].copy()
        rows = np.flatnonzero(part.any(1))
        part[: rows[0] + int(share * len(rows)) + 1] = 0
        result[number] = part
    return result


@pytest.mark.parametrize("share", [0.5, 1.0])
def test_one_blind_camera_is_outvoted_where_something_was(cell, share):
    """R5: with one camera blind to half a person or all of them nothing of them is lost."""
    entered(cell)
    found = cell.step(BODY, bits=blind(bits_of(BODY, cell.cameras), [2], share))
    assert set(cell.rows_in(BODY).tolist()) <= set(found.rows.tolist())
    assert found.counts["forgiven"] > 0


def test_a_camera_that_contradicts_nothing_is_believed():
    """R5: four cameras on one side leave much beside a body; a fifth alone denies it, rightly."""
    made, around = Cell(), ring(24)
    made.cameras = [*around[:4], around[7]]
    made.hull = hull_of(made.grid, made.cameras)
    made.refinement = Refinement(made.hull, made.cameras, [])
    bits = bits_of(BODY, made.cameras)
    larger = made.step(BODY, elapsed_s=5.0, bits=[*bits[:4], None])
    found = made.step(BODY, bits=bits)
    alone = made.step(BODY, elapsed_s=5.0, bits=bits)
    assert len(larger.rows) > 1.3 * len(alone.rows)
    assert len(found.rows) < 1.05 * len(alone.rows)
    assert set(made.rows_in(BODY).tolist()) <= set(found.rows.tolist())


def test_who_walks_on_before_a_blind_camera_stays_whole():
    """R5: where a person steps to, nothing was in the set before."""
    made = Cell(voxel_m=0.025)
    way = np.array([1, 0, 0, 1, 0, 0, 0])
    entered(made, BODY - 0.2 * way)
    for place in (-0.1, 0.0, 0.1):
        walking = BODY + place * way
        found = made.step(walking, bits=blind(bits_of(walking, made.cameras), [2]))
        assert set(made.rows_in(walking).tolist()) <= set(found.rows.tolist())


def test_a_limb_that_one_camera_cuts_stays_whole(cell):
    """R5: a stripe of camouflage in one camera does not part an arm from its body."""
    entered(cell)
    masks = masks_of(BODY, cell.cameras)
    rows = np.nonzero(masks[5])[0]
    masks[5][int(rows.mean()) - 4 : int(rows.mean()) + 4] = 0
    found = cell.step(BODY, bits=[packed(mask) for mask in masks])
    assert set(cell.rows_in(BODY).tolist()) <= set(found.rows.tolist())


def test_two_blind_cameras_are_believed_and_so_is_one_of_four():
    """R5: two vetoes count, and among fewer than five cameras one does."""
    cell = Cell()
    entered(cell)
    found = cell.step(BODY, bits=blind(bits_of(BODY, cell.cameras), [2, 3]))
    assert len(found.rows) == 0
    few = Cell(cameras=4)
    entered(few)
    found = few.step(BODY, bits=blind(bits_of(BODY, few.cameras), [2]))
    assert found.counts["forgiven"] == 0
    assert not set(few.rows_in(BODY).tolist()) & set(found.rows.tolist())


def test_who_was_overlooked_in_one_set_is_there_again_in_the_next(cell):
    """R4 looks back for longer than a set: one false word of two cameras makes nobody vanish."""
    entered(cell)
    lost = cell.step(BODY, bits=blind(bits_of(BODY, cell.cameras), [2, 3]))
    found = cell.step(BODY)
    assert len(lost.rows) == 0
    assert set(cell.rows_in(BODY).tolist()) <= set(found.rows.tolist())


def test_who_is_seen_in_the_middle_set_after_set_is_believed(cell):
    """R4: what has the volume of a person in three sets in a row is no trick of the light."""
    counts = [len(cell.step(BODY).rows) for _ in range(5)]
    found = cell.step(BODY)
    assert counts[:2] == [0, 0]
    assert all(counts[2:])
    assert set(cell.rows_in(BODY).tolist()) <= set(found.rows.tolist())


def test_the_robot_alone_is_never_taken_for_somebody_who_appeared(cell):
    """R4: the arm moves in the middle of the cell, set after set, and nothing is occupied."""
    arm = np.array([[0.0, 0.0, 0.1, 0.0, 0.0, 0.9, 0.12], [0.0, 0.0, 0.9, 0.4, 0.0, 0.7, 0.09]])
    for _ in range(6):
        assert len(cell.step(arm, arm).rows) == 0


def test_who_stands_where_only_a_dead_camera_saw_stays_there():
    """A camera dies that alone saw a place: who was there stays there until a camera looks again."""
    cell = Cell()
    hull = hull_of(cell.grid, cell.cameras)
    place = np.abs(cell.grid.centres(np.arange(cell.grid.voxels)) - (0.0, 0.1, 0.55))
    inner = np.flatnonzero((place < (0.45, 0.35, 0.55)).all(1))
    for table in hull.tables[1:]:
        table.pixel[inner] = table.sentinel
        table.cell[np.unique(inner >> 6)] = table.pool_sentinel
    cell.refinement = Refinement(hull, cell.cameras, [])
    body, bits = set(cell.rows_in(BODY).tolist()), bits_of(BODY, cell.cameras)
    cell.step(BODY, elapsed_s=5.0)

    for _ in range(5):
        assert body <= set(cell.step(BODY, bits=[None, *bits[1:]]).rows.tolist())

    assert len(cell.step(NOBODY).rows) == 0


def test_who_walks_on_leaves_no_trail(cell):
    """R5: what was occupied and is free for one camera only does not stay behind a person."""
    for step in range(6):
        walking = BODY + 0.1 * step * np.array([1, 0, 0, 1, 0, 0, 0])
        found = cell.step(walking, elapsed_s=5.0 if step == 0 else 0.1)
    fresh = entered(Cell(), walking)
    assert len(found.rows) < 1.2 * len(fresh.rows)


def test_the_order_of_cameras_does_not_matter():
    """Two sets through cameras in another order give the same voxels and counts."""
    one, other = Cell(), Cell()
    order = np.array([5, 2, 7, 0, 1, 4, 3, 6])
    other.cameras = [other.cameras[n] for n in order]
    other.hull = hull_of(other.grid, other.cameras)
    other.refinement = Refinement(other.hull, other.cameras, [])
    seen = np.concatenate([BODY, FAR_ARM])
    for elapsed_s in (5.0, 0.1):
        a, b = (made.step(seen, FAR_ARM, elapsed_s) for made in (one, other))
        assert set(a.rows.tolist()) == set(b.rows.tolist())
        assert a.counts == b.counts


def test_a_dead_camera_only_adds_voxels(cell):
    """Without one, two, three silhouettes the safe set grows, and takes nothing back."""
    other = Cell()
    other.step(NOBODY)
    before = set(entered(cell).rows.tolist())
    bits = bits_of(BODY, cell.cameras)
    for dead in (1, 2, 3):
        now = set(
            other.step(BODY, elapsed_s=5.0, bits=[*bits[:-dead], *[None] * dead]).rows.tolist()
        )
        assert before <= now
        before = now


def test_two_bodies_are_two_components_the_larger_one_first(cell):
    """Bodies that stand apart are numbered by volume."""
    small = np.array([[-0.55, -0.55, 0.2, -0.55, -0.55, 0.4, 0.05]])
    found = entered(cell, np.concatenate([BODY, small]))
    assert set(np.unique(found.component)) == {0, 1}
    counts = np.bincount(found.component)
    assert counts[0] > counts[1]
    of_small = found.rows[found.component == 1]
    assert set(cell.rows_in(small).tolist()) <= set(of_small.tolist())


def test_growing_blocks_is_a_cube_that_ends_at_the_sides():
    """One block grows to 27, in a corner to 8; 0 grows nothing."""
    blocks = np.zeros((6, 5, 4), bool)
    blocks[2, 2, 2] = True
    assert grown(blocks, 1).sum() == 27
    assert grown(blocks, 0).sum() == 1
    corner = np.zeros((6, 5, 4), bool)
    corner[0, 0, 0] = True
    assert grown(corner, 1).sum() == 8


def shaded_step(made, dark, shaded, elapsed_s=5.0):
    """Return what is occupied where some capsules are foreground, and others look like shadow."""
    bits, shades = bits_of(dark, made.cameras), bits_of(shaded, made.cameras)
    return made.refinement.step(
        bits, NO_ARM, elapsed_s, [shade & ~one for one, shade in zip(bits, shades, strict=True)]
    )


ON_FLOOR = np.array(
    [[x, -0.1, 0.0, x + 0.05, 0.5, 0.0, 0.01] for x in np.arange(-0.55, -0.2, 0.012)]
)
"""A patch of the floor, 0.6 m long and 0.35 m wide: where a shadow lies."""


@pytest.mark.parametrize("level", [70, 100, 140])
def test_a_person_in_grey_before_a_grey_wall_stays(level):
    """Evenly darker than an even background of 150 in all images, and yet no voxel is lost."""
    pytest.importorskip("cv2", exc_type=ImportError)
    made = Cell()
    empty = np.full((*masks_of(BODY, made.cameras[:1])[0].shape, 3), 150, np.uint8)
    subtraction = Subtraction(empty, np.ones_like(empty))
    images = [empty.copy() for _ in made.cameras]
    for image, mask in zip(images, masks_of(BODY, made.cameras), strict=True):
        image[mask > 0] = level
    bits, shades = zip(*map(subtraction.split, images), strict=True)
    found = made.refinement.step(
        [packed(mask) for mask in bits], NO_ARM, 5.0, [packed(mask) for mask in shades]
    )
    assert not np.any(bits)
    assert set(made.rows_in(BODY).tolist()) <= set(found.rows.tolist())


def test_a_shadow_on_the_floor_is_no_obstacle(cell):
    """Neither on the floor nor in the pyramid over it; as foreground it would be one."""
    found = shaded_step(cell, NOBODY, ON_FLOOR)
    assert found.counts["shadow"] > 100
    assert len(found.rows) == 0
    assert len(shaded_step(Cell(), ON_FLOOR, NOBODY).rows) > 100


def test_a_shadow_on_a_table_is_no_obstacle():
    """What lies on a box lies on a known surface, too."""
    table = box_row((-0.4, 0.2, 0.2), (0.35, 0.5, 0.2))
    made = Cell(boxes=[table])
    made.step(NOBODY)
    shadow = ON_FLOOR.copy()
    shadow[:, [2, 5]] = 0.4
    found = shaded_step(made, NOBODY, shadow)
    assert found.counts["shadow"] > 50
    assert len(found.rows) == 0


def test_a_person_beside_a_shadow_is_as_without_it(cell):
    """The shadow of a person makes their hull hardly larger, and none of them goes."""
    alone = entered(Cell())
    found = shaded_step(cell, BODY, ON_FLOOR)
    assert set(alone.rows.tolist()) <= set(found.rows.tolist())
    assert len(found.rows) < 1.1 * len(alone.rows)


def test_a_person_in_grey_beside_their_shadow_stays(cell):
    """Cameras that see them before their own shadow take them for it; the others do not."""
    found = shaded_step(cell, NOBODY, np.concatenate([BODY, ON_FLOOR]))
    assert set(cell.rows_in(BODY).tolist()) <= set(found.rows.tolist())
