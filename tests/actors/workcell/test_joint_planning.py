"""Planned paths touch nothing, looked at finer than they were planned; bad ends are named."""

import numpy as np
import pytest

from actors.geometry.arms.clearance import ArmSpheres, CellGrid, Clearance, GrownGrid
from actors.geometry.arms.joint_paths import JointPath
from actors.geometry.arms.joint_planning import plan, shortened
from actors.geometry.arms.kinematics import capsules_at
from actors.geometry.capsules import capsule_distances, distance_to_points
from actors.workcell.simulation.arm import ARM

LEFT = np.array([-1.0, 0.9, 0.0, -1.1, 0.0, 1.1, 0.0])
RIGHT = np.array([0.9, 0.9, 0.0, -1.1, 0.0, 1.1, 0.0])
ORIGIN_M, SHAPE = np.array([-2.0, -2.0, 0.0]), (80, 80, 44)
SPHERES = ArmSpheres(ARM)


def box(centre, half):
    return np.r_[centre, half, np.eye(3).ravel()]


TABLE = box([0.95, 0.0, 0.375], [0.35, 0.6, 0.375])


def grid_with(boxes=(), points_m=()):
    grid = CellGrid(ORIGIN_M, 0.05, SHAPE)
    grid.mark_boxes(np.array(boxes).reshape(-1, 15))
    if len(points_m):
        grid.mark_indices(np.floor((points_m - ORIGIN_M) / 0.05).astype(int))
    return grid


def reaching_arm():
    """Return points, 2 cm apart, of a person beside the table whose arm reaches over it."""
    body = np.array([1.2, -0.75, 0.0]) + np.linspace(0, 1, 80)[:, None] * [0.0, 0.0, 1.7]
    hand = np.array([1.2, -0.75, 1.4]) + np.linspace(0, 1, 60)[:, None] * [-0.58, 0.6, -0.3]
    return np.concatenate([body, hand])


@pytest.fixture(scope="module")
def reached():
    """Clearances in a cell with a table and someone who reaches over it: free, passable."""
    table, person = grid_with([TABLE]), grid_with(points_m=reaching_arm())
    return [
        Clearance(
            SPHERES,
            ARM,
            [GrownGrid(SPHERES, table, 0.0), GrownGrid(SPHERES, person, margin)],
            slack_m=slack,
        ).free
        for margin, slack in ((0.05, 0.0), (0.0, 0.02))
    ]


def planned(free, seed=1, limit_s=30.0):
    return plan(LEFT, RIGHT, *free, q_max_rad=ARM.q_max, seed=seed, limit_s=limit_s)


def test_spheres_hold_the_capsules():
    """Every point of every capsule's surface lies within a sphere of the arm."""
    draw = np.random.default_rng(0)
    for q in draw.uniform(-1.0, 1.0, (5, 7)) * ARM.q_max:
        centres = SPHERES.centres(q)[0]
        for capsule in capsules_at(ARM, q)[0]:
            share = draw.uniform(0.0, 1.0, (200, 1))
            around = draw.normal(size=(200, 3))
            around *= capsule[6] / np.linalg.norm(around, axis=1, keepdims=True)
            axis = capsule[:3] * (1 - share) + capsule[3:6] * share
            along = (capsule[3:6] - capsule[:3]) / np.linalg.norm(capsule[3:6] - capsule[:3])
            across = around - (around @ along)[:, None] * along
            across *= capsule[6] / np.linalg.norm(across, axis=1, keepdims=True)
            off = np.linalg.norm((axis + across)[:, None] - centres, axis=-1) - SPHERES.radius_m
            assert off.min(1).max() <= 1e-9


@pytest.mark.parametrize("margin_m", [0.0, 0.05])
def test_free_states_keep_the_margin(margin_m):
    """No state that counts as free is nearer to an occupied cell, the floor or itself."""
    draw = np.random.default_rng(1)
    points = draw.uniform([-1, -1, 0.4], [1, 1, 2.0], (12, 3))
    grid = grid_with(points_m=points)
    clearance = Clearance(SPHERES, ARM, [GrownGrid(SPHERES, grid, margin_m)])
    states = draw.uniform(-1.0, 1.0, (2000, 7)) * ARM.q_max
    corners = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1]), -1).reshape(-1, 3)
    cells = np.argwhere(grid.occupied)
    occupied = ORIGIN_M + (cells[:, None] + corners).reshape(-1, 3) * 0.05

    free = clearance.free(states)

    assert 20 < free.sum() < 1900
    for capsules in capsules_at(ARM, states[free]):
        assert distance_to_points(capsules[1:], occupied).min() >= margin_m
        assert capsules[1:, [2, 5]].min() - capsules[1:, 6].max() > -0.05
        between = capsule_distances(capsules, capsules)
        assert min(between[0, 2:].min(), between[1, 3:].min()) > 0.0


def test_sixty_states_at_once_are_each_of_them_alone(reached):
    """A batch answers what single questions answer."""
    states = np.linspace(LEFT, RIGHT, 60)

    free = reached[0](states)

    assert free.tolist() == [bool(reached[0](state)[0]) for state in states]
    assert free[[0, -1]].all()
    assert not free.all()


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_planned_path_touches_nothing(reached, seed):
    """Every 2 mrad, the arm is off the exact points and the table, within its limits."""
    found = planned(reached, seed)
    assert found.reason == ""
    path = JointPath(found.waypoints)

    states = path.states(0.0, path.length_rad, 0.002)

    np.testing.assert_array_equal(found.waypoints[[0, -1]], [LEFT, RIGHT])
    assert (np.abs(states) <= ARM.q_max).all()
    edges = np.linspace(-1.0, 1.0, 25)
    top = np.stack(np.meshgrid(edges, edges, [1.0]), -1).reshape(-1, 3)
    table = TABLE[:3] + top * TABLE[3:6]
    for capsules in capsules_at(ARM, states[::5]):
        assert distance_to_points(capsules[1:], reaching_arm()).min() > 0.0
        assert distance_to_points(capsules[1:], table).min() > 0.0


def test_seed_repeats_the_path(reached):
    """The same seed gives the same waypoints, another one others."""
    one, again, other = planned(reached, 5), planned(reached, 5), planned(reached, 6)

    np.testing.assert_array_equal(one.waypoints, again.waypoints)
    assert one.questions == again.questions
    assert not np.array_equal(one.waypoints, other.waypoints)


def test_straight_line_is_taken_where_it_is_free():
    """With nothing in the way, the path has no waypoint between its ends."""
    free = Clearance(SPHERES, ARM, [GrownGrid(SPHERES, grid_with(), 0.05)]).free

    found = planned((free, free))

    np.testing.assert_array_equal(found.waypoints, [LEFT, RIGHT])


def test_blocked_ends_are_named(reached):
    """A goal or a start inside something is said at once, as is a seed that OMPL does not take."""
    free, passable = reached
    inside = np.linspace(LEFT, RIGHT, 60)[~free(np.linspace(LEFT, RIGHT, 60))][0]
    options = {"q_max_rad": ARM.q_max, "seed": 1, "limit_s": 1.0}

    to, at = (plan(*ends, free, passable, **options) for ends in ((LEFT, inside), (inside, LEFT)))

    assert (len(to.waypoints), to.reason) == (0, "the goal is where something is in the way")
    assert (len(at.waypoints), at.reason) == (0, "the arm is where something is in the way")
    with pytest.raises(ValueError, match="seed is 0"):
        plan(LEFT, RIGHT, free, passable, **{**options, "seed": 0})


def test_search_without_a_way_ends():
    """A wall all around: within the time there is no path, and the reason says so."""

    def free(q):
        return np.abs(np.atleast_2d(q)[:, 0] - 0.1) > 0.2

    found = planned((free, free), limit_s=0.2)

    assert (len(found.waypoints), found.reason) == (0, "no path was found")
    assert found.questions > 2


def test_shortcuts_shorten():
    """A detour through free space becomes the straight line; ends stay."""
    detour = np.array([[0.0, 0.0], [0.0, 2.0], [1.0, 3.0], [2.0, 2.0], [2.0, 0.0]])

    straight = shortened(detour, lambda q: np.ones(len(q), bool), seed=1, limit_s=10.0)
    around = shortened(
        detour, lambda q: np.linalg.norm(q - [1.0, 0.0], axis=1) > 0.9, seed=1, limit_s=10.0
    )

    np.testing.assert_allclose(straight, [[0.0, 0.0], [2.0, 0.0]])
    length = np.linalg.norm(np.diff(around, axis=0), axis=1).sum()
    assert np.pi * 0.9 < length < 4.2
    np.testing.assert_array_equal(around[[0, -1]], detour[[0, -1]])


def test_box_and_cylinder_mark_what_they_touch():
    """Cells whose centre lies inside are marked, those a cell and more away are not."""
    turn = np.array([[0.8, -0.6, 0.0], [0.6, 0.8, 0.0], [0.0, 0.0, 1.0]])
    turned = np.r_[[0.5, -0.5, 0.5], [0.4, 0.1, 0.5], turn.ravel()]
    grid, pillar = grid_with([turned]), grid_with()
    pillar.mark_cylinders(np.array([[1.0, 1.0]]), np.array([0.3]), 1.0)
    centres = ORIGIN_M + (np.stack(np.mgrid[:80, :80, :44], -1) + 0.5) * 0.05

    inside = np.abs((centres - turned[:3]) @ turn) - turned[3:6]
    off = np.linalg.norm(np.maximum(inside, 0.0), axis=-1)
    round_m = np.linalg.norm(centres[..., :2] - 1.0, axis=-1)

    assert grid.occupied[off == 0.0].all()
    assert not grid.occupied[off > 0.05 * 3**0.5].any()
    assert pillar.occupied[(round_m <= 0.3) & (centres[..., 2] < 1.0)].all()
    assert not pillar.occupied[(round_m > 0.36) | (centres[..., 2] > 1.05)].any()
