"""Claims about the scores: a perfect run meets its goals, and each fault shows in its own score."""

import dataclasses

import numpy as np
import pytest

from actors.geometry.arms.kinematics import capsules_at
from actors.workcell import vocabulary as words
from actors.workcell.scores.evaluation import GOALS, _latencies, along, missed, score
from actors.workcell.scores.trace import ONLINE, Kept
from actors.workcell.scores.truth_of_run import truth_of
from actors.workcell.simulation.arm import ARM
from actors.workcell.simulation.human import Person
from enact_dist.errors import ConfigError

from .runs import GRID, PERIOD_NS, START_NS, Run


def arrived(run: Run, tick: int, *, scale: float = 1.0, speed_m_s: float = 1.0) -> None:
    """Add what the robot made of the command of a tick, 55 ms after the exposure."""
    stamp = START_NS + tick * PERIOD_NS
    done = words.Execution("moving", scale, speed_m_s, stamp, stamp + 55_000_000, 1, 0, 0)
    run.add(words.ROBOT.name, words.EXECUTION, done, tick)


@pytest.fixture(scope="module")
def perfect() -> dict[str, float]:
    """Score a run in which all that is reported is the truth."""
    run = Run("S2", 6.0)
    run.rest()
    for tick in run.ticks:
        run.hull(tick)
        arrived(run, tick)
    return score(run.trace(), every=5)


def test_the_workspace_is_where_the_grid_is() -> None:
    """Also where its middle is not the origin of the cell, and its sides differ."""
    run, limb = Run("S1", 1.0), np.array([[1.0, 3.0, 1.0, 1.2, 3.0, 1.0, 0.1]])
    assert not truth_of(run.trace()).inside(limb)
    run.add(words.WORKSPACE.name, words.GRID, words.Grid(np.zeros(3), 0.1, (20, 40, 20)), 0)
    truth = truth_of(run.trace())
    assert truth.inside(limb)
    assert not truth.inside(limb - [2.0, 0.0, 0.0, 2.0, 0.0, 0.0, 0.0])
    assert truth.over(np.array([[0.2, 0.2], [1.9, 0.2]]), -0.15).tolist() == [True, False]


def test_the_truth_scores_perfectly(perfect: dict[str, float]) -> None:
    """A run that reports the truth loses no voxel, misses no set and breaks no distance."""
    assert perfect["lost_near_voxels"] == perfect["lost_share"] == 0.0
    assert perfect["true_voxels"] > 500
    assert perfect["iou_p50"] == 1.0
    assert perfect["phantom_p99_l"] == 0.0
    assert perfect["sets_missed"] == perfect["sets_incomplete"] == 0.0
    assert abs(perfect["distance_p50_m"]) < 0.05  # half a voxel of 5 cm, and its diagonal
    assert perfect["violations"] == 0.0


def test_latencies_are_from_the_exposure(perfect: dict[str, float]) -> None:
    """Hull after 40 ms and robot after 55 ms, as the run was made."""
    assert perfect["hull_p50_ms"] == pytest.approx(40.0)
    assert perfect["robot_p99_ms"] == pytest.approx(55.0)


def test_a_set_that_never_reached_the_robot_waits_for_the_next_one() -> None:
    """Of every second hull there is no command: the robot goes on with the one before."""
    run = Run("S1", 2.0)
    for tick in run.ticks:
        run.hull(tick)
        if tick % 2:
            arrived(run, tick)
    trace = run.trace()

    found = _latencies(trace, truth_of(trace))

    assert found["robot_p50_ms"] == pytest.approx(105.0)
    assert found["robot_p99_ms"] == pytest.approx(155.0)


def test_lost_voxels_and_missed_sets_are_counted() -> None:
    """One set left out and three voxels taken away show as exactly that."""
    run = Run("S2", 4.0)
    run.rest()
    for tick in run.ticks:
        if tick != 7:
            run.hull(tick, without=3 if tick == 35 else 0)

    found = score(run.trace())

    assert found["sets_missed"] == 1.0
    assert found["lost_share"] * found["true_voxels"] == pytest.approx(3.0)
    assert "sets_missed" in missed(found)
    assert ("lost_share" in missed(found)) == (found["lost_share"] > 0.0002)


def test_an_arm_that_is_too_fast_near_a_person_is_a_violation() -> None:
    """The same arm at rest beside the same person is none."""
    violations = []
    for dq in (1.0, 0.0):
        run = Run("S3", 8.0)  # a person reaches over the table
        run.rest(dq)
        violations.append(score(run.trace())["violations"])

    assert violations[0] > 50
    assert violations[1] == 0.0


def test_a_robot_without_commands_counts_as_at_rest() -> None:
    """Commands come for a second, twice of each set, and then none for another one."""
    run = Run("S1", 2.0)
    run.rest()
    for tick in run.ticks:
        run.hull(tick)
        if tick < 10:
            arrived(run, tick)
            arrived(run, tick)

    assert 0.5 <= score(run.trace(), every=30)["speed_kept"] < 0.65


def test_productivity_is_set_beside_an_oracle_and_a_zone() -> None:
    """The zone does less than the oracle."""
    run = Run("S2", 6.0)
    run.rest()
    for tick in run.ticks:
        run.hull(tick)
        arrived(run, tick, scale=0.5, speed_m_s=0.5)

    found = score(run.trace(), every=30)

    assert found["speed_kept"] == pytest.approx(0.5)
    oracle, zone = (0.5 / found[f"productivity_{name}"] for name in ("oracle", "zone"))
    assert 0.1 < zone < oracle < 0.6  # the same arm, which starts from rest, and stops at goals


def test_tracks_are_compared_with_the_nearest_person() -> None:
    """A track 3 cm beside the truth scores 3 cm, with the true velocity and prediction."""
    run = Run("S3", 5.0)
    run.rest()
    person = Person(run.scenario.walks[0])
    for tick in run.ticks:
        run.hull(tick)
        centre = person.centre_at(tick / 10)
        if centre is None:
            continue
        track = track_at(centre + np.array([0.03, 0.0]), velocity_of(person, tick))
        run.add("human/0", words.TRACK, track, tick)
        run.add("human/0", words.PREDICTION, predicted(person, tick), tick)

    found = score(run.trace(), every=60)

    assert found["track_position_p50_m"] == pytest.approx(0.03, abs=1e-6)
    assert found["track_velocity_p50_m_s"] < 1e-6
    assert found["track_ahead_p50_m"] < 1e-6
    assert found["untracked_share"] == 0.0


def track_at(at_m: np.ndarray, velocity_m_s: np.ndarray, *, hidden: bool = False) -> words.Track:
    """Return the track of a person."""
    return words.Track(
        position_m=np.array([*at_m, 1.75]),
        velocity_m_s=velocity_m_s,
        covariance=np.eye(6),
        height_m=1.75,
        volume_m3=0.07,
        first_ns=START_NS,
        hidden=hidden,
    )


def predicted(person: Person, tick: int, off_m: float = 0.0) -> words.Prediction:
    """Return where a person will be in 0.4 s and 0.6 s, so much beside the truth at 0.5 s."""
    ahead = person.centre_at(tick / 10 + 0.5)
    step = np.zeros(2) if ahead is None else ahead + np.array([off_m, 0.0])
    centre = step + np.array([[-0.1, 0.0], [0.1, 0.0]])
    return words.Prediction(np.array([0.4, 0.6]), centre, np.full(2, 0.3))


def test_the_prediction_that_was_published_is_scored() -> None:
    """A perfect track with a prediction that is off by a metre."""
    run = Run("S2", 4.0)
    run.rest()
    person = Person(run.scenario.walks[0])
    for tick in run.ticks:
        run.hull(tick)
        centre = person.centre_at(tick / 10)
        if centre is not None:
            run.add("human/0", words.TRACK, track_at(centre, velocity_of(person, tick)), tick)
            run.add("human/0", words.PREDICTION, predicted(person, tick, 1.0), tick)

    assert score(run.trace(), every=60)["track_ahead_p50_m"] == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize(
    ("tracks", "state", "share"),
    [
        ((), "run", 1.0),
        ((), "fault", None),
        (("near",), "run", 0.5),
        (("near", "near"), "run", 0.5),
        (("near", "hidden"), "run", 0.0),
        (("far", "hidden"), "run", 0.5),
    ],
)
def test_a_person_without_a_track_of_their_own_counts(tracks, state, share) -> None:
    """Two people: whom does each track belong to?  Nobody counts while the cell sees nothing."""
    run = Run("S11", 4.5)
    run.rest()
    run.add(words.SYSTEM.name, words.SAFETY, words.Safety(state, "", START_NS), 0)
    inside = {tick: [one.centre_at(tick / 10) for one in run.people] for tick in run.ticks}
    both = [
        tick
        for tick, places in inside.items()
        if all(at is not None and np.abs(at).max() < 1.7 for at in places)
    ]
    for tick in both:
        run.hull(tick)
        first, second = inside[tick]
        for number, kind in enumerate(tracks):
            at_m = second + np.array([0.0, 1.0]) if kind == "hidden" else first
            at_m = at_m + np.array([0.0, 0.7]) if kind == "far" else at_m
            track = track_at(at_m, np.zeros(3), hidden=kind == "hidden")
            run.add(f"human/{number}", words.TRACK, track, tick)

    assert both
    assert score(run.trace(), every=60).get("untracked_share") == share


def velocity_of(person: Person, tick: int) -> np.ndarray:
    """Return the velocity of a person at a tick, (3,)."""
    before, after = person.centre_at(tick / 10 - 0.05), person.centre_at(tick / 10 + 0.05)
    step = np.zeros(2) if before is None or after is None else after - before
    return np.array([*step / 0.1, 0.0])


def test_a_path_through_the_hull_is_named() -> None:
    """Of two paths, the one whose hull holds the arm counts as touching."""
    run = Run("S1", 1.0)
    run.rest()
    for tick in run.ticks:
        run.hull(tick)
    index = np.floor((capsules_at(ARM, run.q)[0, 3:4, :3] - GRID.origin_m) / GRID.voxel_m)
    hull = run.versions[ONLINE, words.WORKSPACE.name, "hull"][6].datum
    inside = dataclasses.replace(hull, voxels=index.astype(np.int16))
    run.versions[ONLINE, words.WORKSPACE.name, "hull"][6] = Kept(
        START_NS + 6 * PERIOD_NS, START_NS + 6 * PERIOD_NS, inside
    )
    for tick in (1, 6):
        path = words.Path(np.stack([run.q, run.q]), tick, 0, 1, START_NS, 0.0, took_ms=40.0)
        run.add(words.ROBOT.name, words.PATH, path, tick)

    found = score(run.trace(), every=100)

    assert found["paths"] == 2.0
    assert found["paths_touching"] == 1.0
    assert found["replan_p99_ms"] == 40.0


def test_states_along_a_path_are_close_and_keep_its_corners() -> None:
    """No joint moves more than the step, and each corner is a state."""
    corner = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 0.5]])
    states = along(corner, step_rad=0.1)
    assert np.abs(np.diff(states, axis=0)).max() <= 0.1 + 1e-12
    assert all((states == row).all(1).any() for row in corner)


def test_a_recording_without_truth_is_refused() -> None:
    """The error names the datum that is missing."""
    run = Run("S1", 1.0)
    del run.versions["truth", "scenario", "playing"]
    with pytest.raises(ConfigError, match="no truth scenario/playing"):
        score(run.trace())


def test_every_goal_says_what_it_is_of() -> None:
    """Each goal has a text, tells met from missed, and prints its bound."""
    assert all(goal.what for goal in GOALS.values())
    assert GOALS["sets_missed"].met(0.0)
    assert not GOALS["sets_missed"].met(1.0)
    assert str(GOALS["robot_p99_ms"]) == "≤ 100"
