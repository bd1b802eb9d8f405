"""When another path is due, and what is then searched: decisions of path planning, without a cell."""

from dataclasses import replace

import numpy as np
import pytest

from actors.geometry.arms.joint_planning import Plan
from actors.geometry.arms.kinematics import capsules_at
from actors.workcell.planning import CUT_OFF, FORESEEN, PAUSE, Followed, Obstacles, Scene, Waits
from actors.workcell.setup import GOALS_RAD, grid_of
from actors.workcell.simulation.arm import ARM
from actors.workcell.vocabulary import Hull, Joints, Path, Prediction, Task

LEFT, RIGHT = np.array(GOALS_RAD)
AHEAD = (RIGHT - LEFT) / np.linalg.norm(RIGHT - LEFT)
GRID = grid_of(0.05)
TASK = Task(np.array(GOALS_RAD), np.full(2, 0.4), cyclic=True)
SECOND_NS = 10**9
ON_WAY = Path(np.stack([LEFT, RIGHT]), 3, 0, 1, 7, 2.0, "", 1.0)
NO_WAY = replace(ON_WAY, waypoints=np.empty((0, 7)), reason="no path was found")


@pytest.fixture(scope="module")
def obstacles():
    """A cell with nothing in it but who comes."""
    return Obstacles(ARM, GRID, np.empty((0, 15)))


def standing_at(q):
    """The cells of someone who stands where the tool is at a state."""
    foot_m = capsules_at(ARM, q)[0][-1, 3:5]
    pole = np.r_[foot_m, 0.0] + np.linspace(0.0, 1.0, 60)[:, None] * [0.0, 0.0, 2.0]
    voxels = np.unique(np.floor((pole - GRID.origin_m) / GRID.voxel_m), axis=0).astype(np.int16)
    count = len(voxels)
    return Hull(
        voxels, np.zeros(count, np.float32), np.ones(count, bool), np.zeros(count, np.int16),
        {}, (), np.inf, -1,
    )  # fmt: skip


NOBODY = replace(standing_at(LEFT), voxels=np.empty((0, 3), np.int16))


def scene(obstacles, q, *, speed=0.0, hull=NOBODY, soon=None, **known):
    """An arm on its way from left to right, and who is there, or will be soon."""
    now = obstacles.around(hull, [], 0.0)
    about = {
        "joints": Joints(np.tile(q, (2, 1)), np.tile(speed * AHEAD, (2, 1)), np.array([0, 1])),
        "task": TASK,
        "last": ON_WAY,
        "refusal": "",
        "followed": Followed.from_rest(ON_WAY, ARM),
        "captured_ns": SECOND_NS,
        **known,
    }
    if about["last"] is None or not len(about["last"].waypoints):
        about["followed"] = None
    predicted = now if soon is None else obstacles.around(NOBODY, [soon], 1.0)
    return Scene(
        model=ARM, obstacles=obstacles, now=now, soon=predicted, later=predicted,
        ahead_s=1.0, branch_s=0.13, **about,
    )  # fmt: skip


def due(seen, waits=None):
    return seen.due(waits or Waits(), lambda: 1)


def test_a_free_path_is_followed(obstacles):
    """Nobody is there, and what was blocked once is forgotten."""
    assert due(scene(obstacles, LEFT + 0.3 * AHEAD, speed=0.5), Waits(blocked=1)) == (None, Waits())


@pytest.mark.parametrize("last", [None, NO_WAY])
def test_without_a_path_one_is_sought_from_rest_after_a_pause(obstacles, last):
    """A moving arm comes to rest first; a search that found nothing is repeated at the third set."""
    assert due(scene(obstacles, LEFT, speed=0.5, last=last))[0] is None
    waits, found = Waits(pause=PAUSE), []
    for _ in range(PAUSE + 1):
        search, waits = due(scene(obstacles, LEFT, last=last), waits)
        found.append(search is not None)
    assert found == [False] * PAUSE + [True]
    assert search.branch is None
    assert waits.after(Plan(np.empty((0, 7)), "no path was found", 9)).pause == PAUSE
    assert waits.after(Plan(np.stack([LEFT, RIGHT]), "", 9)).pause == waits.pause


def test_a_blocked_path_is_left_at_the_second_set_where_the_arm_will_be(obstacles):
    """Straight on from where it moves; the people are avoided with all that is predicted first."""
    seen = scene(obstacles, LEFT + 0.3 * AHEAD, speed=0.8, hull=standing_at(LEFT + 0.8 * AHEAD))
    search, waits = due(seen)
    assert (search, waits.blocked) == (None, 1)
    search, waits = due(seen, waits)
    assert (search.why, search.goal) == ("someone is in the way", 1)
    assert search.branch.at_rad > search.branch.here_rad + 0.1
    np.testing.assert_allclose(search.branch.heading, AHEAD, atol=1e-9)
    assert search.around == (seen.later, seen.now)


def test_no_other_path_is_sought_behind_someone_who_is_reached_first(obstacles):
    """There is none to be found: the plan says so, and the arm stops."""
    seen = scene(
        obstacles, LEFT + 0.3 * AHEAD, speed=1.2, hull=standing_at(LEFT + 0.45 * AHEAD),
    )  # fmt: skip
    search, _ = due(replace(seen, branch_s=0.5), Waits(blocked=1))
    assert search.around == ()
    found = search.found(seen, seed=1, limit_s=1.0)
    assert (len(found.waypoints), found.reason) == (0, CUT_OFF)


def test_a_person_who_will_be_there_is_a_wish(obstacles):
    """It is tried every third set, with predictions alone; without a way the path stays."""
    at_s = np.linspace(0.1, 1.0, 10)
    there_m = capsules_at(ARM, LEFT + 0.6 * AHEAD)[0][-1, 3:5]
    soon = Prediction(at_s, np.tile(there_m, (10, 1)), np.full(10, 0.15))
    seen, waits, searches = scene(obstacles, LEFT + 0.3 * AHEAD, speed=0.8, soon=soon), Waits(), []
    for _ in range(5):
        search, waits = due(seen, waits)
        searches.append(search)
    assert [search is not None for search in searches] == [False, True, False, False, True]
    assert (searches[1].why, searches[1].around) == (FORESEEN, (seen.later,))
    no_way = Plan(np.empty((0, 7)), "no path was found", 9)
    assert not searches[1].is_news(no_way, ON_WAY)
    in_the_way = replace(searches[1], why="someone is in the way")
    assert in_the_way.is_news(no_way, ON_WAY)
    assert not in_the_way.is_news(no_way, NO_WAY), "it was said before"


@pytest.mark.parametrize(
    ("known", "q", "why"),
    [
        ({"refusal": "path 3 is refused"}, LEFT + 0.3 * AHEAD, "path 3 is refused"),
        ({"task": replace(TASK, goals=np.stack([LEFT, RIGHT + 0.1]))}, LEFT + 0.3 * AHEAD,
         "the task has changed"),
        ({}, LEFT - 0.3, "the arm is off its path"),
    ],
)  # fmt: skip
def test_an_arm_at_rest_is_led_on_from_where_it_is(obstacles, known, q, why):
    """The reason is published; the path begins at the arm."""
    search, _ = due(scene(obstacles, q, **known))
    assert (search.why, search.goal, search.branch) == (why, 1, None)
    np.testing.assert_array_equal(search.start, q)


def test_an_arm_that_refuses_a_path_goes_on_along_the_one_before(obstacles):
    """It leaves that one, not the one that it never took."""
    before = Followed.from_rest(ON_WAY, ARM).speeds
    turned = Followed.from_rest(replace(ON_WAY, waypoints=np.stack([RIGHT, LEFT])), ARM).speeds
    followed = Followed(ON_WAY.identity, turned, before)
    known = {"followed": followed, "refusal": "path 3 is refused"}
    search, _ = due(scene(obstacles, LEFT + 0.3 * AHEAD, speed=0.5, **known))
    assert search.branch.speeds is before
    assert followed.along(is_refused=False) is turned


@pytest.mark.parametrize(
    ("task", "after_s", "to"),
    [
        (TASK, 0.3, None),
        (TASK, 0.4, 0),
        (replace(TASK, cyclic=False), 9.0, None),
        (Task(RIGHT[None], np.zeros(1), cyclic=True), 9.0, None),
    ],
    ids=["it dwells", "it goes on", "the last goal", "one goal"],
)
def test_a_goal_is_left_after_the_dwell_if_another_one_follows(obstacles, task, after_s, to):
    """The time counts from the set that first showed the arm there."""
    last = replace(ON_WAY, to_goal=len(task.goals) - 1)
    arrived = scene(obstacles, RIGHT, task=task, last=last)
    _, waits = due(arrived)
    later = replace(arrived, captured_ns=SECOND_NS + round(after_s * 1e9))
    search, waits = due(later, waits)
    assert (None if search is None else search.goal) == to
    assert search is None or search.from_goal == last.to_goal
    assert waits.there_since_ns in {0, SECOND_NS}
