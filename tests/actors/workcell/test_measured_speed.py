"""People count as fast as their tracks say, and as 1.6 m/s as soon as anything is not theirs."""

import math
import time

import numpy as np
import pytest

from actors.geometry.separation import Separation
from actors.workcell.measured_speed import MeasuredSpeedControl, people_m_s
from actors.workcell.motion import ROBOT_S
from actors.workcell.simulation.arm import ARM, HOME_RAD
from actors.workcell.speed import SpeedControl
from actors.workcell.vocabulary import (
    CAMERA_STATES,
    GRID,
    HULL,
    JOINTS,
    MODEL,
    PATH,
    ROBOT,
    SPEED,
    SYSTEM,
    TRACK,
    WORKSPACE,
    Grid,
    Hull,
    Joints,
    Path,
    Track,
    human_entity,
)
from enact_dist import Lock, View, Write, testing

NOW_NS = 10**18
SECOND_NS = 10**9
SPACE = Grid(np.array([-2.0, -2.0, 0.0]), 0.025, (160, 160, 88))


def column(x, y, half_m=0.2):
    """Return the voxels of an upright body."""
    low = np.floor((np.array([x, y]) - half_m + 2.0) / 0.025).astype(int)
    side = round(2 * half_m / 0.025)
    return np.stack(np.meshgrid(*(np.arange(k, k + side) for k in low), [0, 40, 68]), -1).reshape(
        -1, 3
    )


def hull_of(*parts, nearest_m=1.0):
    voxels = np.concatenate([np.empty((0, 3), int), *parts])
    component = np.concatenate(
        [np.empty(0, int), *(np.full(len(part), k) for k, part in enumerate(parts))]
    )
    count = len(voxels)
    return Hull(
        voxels.astype(np.int16), np.ones(count, np.float32), np.ones(count, bool),
        component.astype(np.int16), {}, (), nearest_m, 0 if count else -1,
    )  # fmt: skip


def track_of(x, y, velocity=(0.3, 0.0), sigma=0.1, age_s=3.0, seen_ago_s=0.1, **changes):
    covariance = np.diag([1e-3] * 3 + [sigma**2, sigma**2, 0.0])
    values = {"hidden": False, "seen_ns": NOW_NS - round(seen_ago_s * 1e9), **changes}
    return Track(
        np.array([x, y, 1.7]), np.array([*velocity, 0.0]), covariance, 1.7, 0.07,
        NOW_NS - round(age_s * 1e9), **values,
    )  # fmt: skip


HERE = column(1.0, 0.0)


@pytest.mark.parametrize(
    ("tracks", "expected_m_s"),
    [
        ([track_of(1.0, 0.0, (0.6, 0.0))], 0.8),
        ([track_of(1.0, 0.0, (0.1, 0.0))], 0.5),
        ([track_of(1.0, 0.0, (0.0, -2.0))], 2.2),
        ([track_of(1.0, 0.0, (0.6, 0.0)), track_of(-1.5, 0.0, (1.0, 0.0))], 0.8),
        ([track_of(1.1, 0.0, (0.6, 0.0)), track_of(0.9, 0.0, (0.0, 0.7))], 0.9),
    ],
    ids=["walks", "stands", "runs", "another elsewhere", "two together"],
)
def test_people_are_as_fast_as_their_tracks_and_two_deviations(tracks, expected_m_s):
    """At least 0.5 m/s; of several people the fastest counts, of those who are there."""
    found, why = people_m_s(hull_of(HERE), SPACE, tracks, NOW_NS, 1.6)

    assert found == pytest.approx(expected_m_s)
    assert why == f"people at {expected_m_s:.2f} m/s, measured"


@pytest.mark.parametrize(
    ("tracks", "parts"),
    [
        ([], [HERE]),
        ([track_of(1.0, 0.0)], [HERE, column(-1.0, 0.0)]),
        ([track_of(1.0, 0.0, hidden=True)], [HERE]),
        ([track_of(1.0, 0.0, age_s=0.5)], [HERE]),
        ([track_of(1.0, 0.0, seen_ago_s=0.4)], [HERE]),
        ([track_of(1.0, 0.0, seen_ago_s=-0.1)], [HERE]),
        ([track_of(1.6, 0.0)], [HERE]),
        ([track_of(1.0, 0.0)], [np.concatenate([HERE, column(1.0, 1.2)])]),
        ([track_of(0.9, 0.0), track_of(1.1, 0.0, hidden=True)], [HERE]),
        ([track_of(0.9, 0.0), track_of(1.1, 0.0, age_s=0.5)], [HERE]),
    ],
    ids=[
        "none",
        "a second",
        "hidden",
        "young",
        "old",
        "ahead",
        "beside",
        "beyond reach",
        "another hidden",
        "another young",
    ],
)
def test_what_has_no_settled_track_is_as_fast_as_people_in_general(tracks, parts):
    """The reason says where it is."""
    found, why = people_m_s(hull_of(*parts), SPACE, tracks, NOW_NS, 1.6)

    assert found == 1.6
    assert why.startswith("1.6 m/s assumed: what is at (")


def test_track_is_moved_on_to_the_exposure():
    """A track is a set older than the hull: somebody who runs is not beside their component."""
    runner = track_of(0.7, 0.0, (3.0, 0.0))

    assert people_m_s(hull_of(HERE), SPACE, [runner], NOW_NS, 1.6)[0] > 3.0


def test_nobody_is_assumed_in_an_empty_cell():
    """There is nothing to say."""
    assert people_m_s(hull_of(), SPACE, [], NOW_NS, 1.6) == (1.6, "")


@pytest.mark.parametrize("actor", [SpeedControl, MeasuredSpeedControl])
def test_speed_says_what_it_rests_on(actor):
    """The measured speed is an option: the plain actor goes by 1.6 m/s and reads no track."""
    with testing.worlds("online") as cell:
        online, now_ns = cell.world("online"), time.time_ns()

        def put(entity, aspect, value, stamp_ns):
            request = Write(online, entity, aspect)
            with Lock(request) as lock:
                lock.put(request, value, stamp_ns=stamp_ns)

        online.init(ROBOT, MODEL, ARM)
        online.init(WORKSPACE, GRID, SPACE)
        put(SYSTEM, CAMERA_STATES, {}, now_ns)
        stamps = now_ns - 10_000_000 * np.arange(29, -1, -1)
        put(ROBOT, JOINTS, Joints(np.tile(HOME_RAD, (30, 1)), np.zeros((30, 7)), stamps), now_ns)
        away = np.array(HOME_RAD) + np.eye(7)[0]
        put(ROBOT, PATH, Path(np.stack([HOME_RAD, away]), 1, 0, 1, 0, 0.0), now_ns)
        slow = track_of(1.0, 0.0, (0.0, 0.0), seen_ns=now_ns)
        slow = Track(slow.position_m, slow.velocity_m_s, slow.covariance, 1.7, 0.07,
                     now_ns - 3 * SECOND_NS, hidden=False, seen_ns=now_ns)  # fmt: skip
        put(human_entity(0), TRACK, slow, now_ns)
        put(WORKSPACE, HULL, hull_of(HERE, nearest_m=0.8), now_ns)
        running = actor()
        running.now_ns = lambda: now_ns + 50_000_000
        testing.run_once(running, cell)
        request = View(online, ROBOT, SPEED)
        speed = online.view(request)[request]

    measured = actor is MeasuredSpeedControl
    assert speed.human_m_s == (0.5 if measured else 1.6)
    assert ("people at 0.50 m/s, measured" in speed.reason) == measured
    expected = Separation(0.25 + ROBOT_S, human_m_s=speed.human_m_s).speed_max_m_s(0.8)
    assert speed.limit_m_s == pytest.approx(expected)
    assert not math.isinf(speed.limit_m_s)
