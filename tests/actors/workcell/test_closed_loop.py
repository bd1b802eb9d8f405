"""The cell in simulated time: the same seed gives the same run, and the robots beside it are fair."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from actors.workcell import vocabulary as words
from actors.workcell.scenarios import Pause, Walk, scenario_of
from actors.workcell.scores.closed_loop import LATENCY_S, ClosedLoop, Sight
from actors.workcell.scores.evaluation import samples_of, scores_of
from actors.workcell.scores.true_hull import capsules_in
from actors.workcell.scores.truth_of_run import share_of, truth_of
from actors.workcell.simulation.drawing.backdrop import backdrop_of
from actors.workcell.simulation.room import BOXES, Box, cameras

pytest.importorskip("cv2", exc_type=ImportError)
pytest.importorskip("ompl", exc_type=ImportError)


def kept_by(scenario, sight):
    """Return the mean share of the nominal speed."""
    trace = ClosedLoop(scenario, sight=sight, voxel_m=0.05).run()
    return float(share_of(trace, truth_of(trace)).mean())


def played(scenario):
    """Play with cameras and score."""
    trace = ClosedLoop(scenario, voxel_m=0.05).run()
    return scores_of([samples_of(trace)]), trace


def test_the_oracle_is_slower_near_a_person_and_the_zone_rests():
    """Both run freely while no person is there."""
    empty = scenario_of("S1", 1, 2.0)
    near = dataclasses.replace(
        scenario_of("S2", 1, 2.0),
        walks=(Walk(((1.7, 0.1), (1.6, 0.0)), begin_s=0.0, pauses=(Pause(1, 5.0),)),),
    )
    kept = {
        (sight, one.name): kept_by(one, sight)
        for sight in (Sight.ORACLE, Sight.ZONE)
        for one in (empty, near)
    }

    assert kept[Sight.ORACLE, "S1"] == kept[Sight.ZONE, "S1"] > 0.0
    assert 0.0 < kept[Sight.ORACLE, "S2"] < kept[Sight.ORACLE, "S1"]
    assert kept[Sight.ZONE, "S2"] == 0.0


def test_the_robot_obeys_what_the_cameras_see_after_the_latency():
    """Hull, speed and path of each tick bear its stamp; a run again is the same, bit by bit."""
    scenario = scenario_of("S2", 1, 2.2)  # the person comes in after 1.8 s
    (found, trace), (again, other) = (played(scenario) for _ in range(2))
    both = scores_of([samples_of(trace), samples_of(other)])
    assert both["true_voxels"] == 2.0 * found["true_voxels"]
    assert both["distance_max_m"] == found["distance_max_m"]
    hulls = trace.of(words.WORKSPACE.name, words.HULL)
    speeds = trace.of(words.ROBOT.name, words.SPEED)
    done = trace.of(words.ROBOT.name, words.EXECUTION)
    assert [one.stamp_ns for one in hulls] == [one.datum.captured_ns for one in speeds]
    assert len(hulls) == 22
    assert len(hulls[0].datum.voxels) == 0 < len(hulls[-1].datum.voxels)
    ages_s = {(one.datum.received_ns - one.datum.captured_ns) / 1e9 for one in done}
    assert ages_s == {LATENCY_S}
    assert found["lost_near_voxels"] == found["violations"] == 0.0
    found.pop("replan_p99_ms", None)
    again.pop("replan_p99_ms", None)
    assert found == again
    assert np.array_equal(trace.joints().q, other.joints().q)


def test_a_dead_camera_gives_no_mask_and_the_cell_goes_on():
    """The sets after the kill name seven cameras, or none at all for one tick."""
    scenario = scenario_of("S7", 1, 1.0)
    trace = ClosedLoop(scenario, voxel_m=0.05).run()
    named = [len(one.datum.cameras) for one in trace.of(words.WORKSPACE.name, words.HULL)]
    assert named[0] == 8
    assert 5 <= min(named) < 8


def test_who_vanishes_behind_the_cabinet_between_two_sets_is_in_the_second_one():
    """The hull was empty for that period, so the robot was allowed its full speed."""
    hiding = dataclasses.replace(scenario_of("S4", 7, 12.0), seconds=2.8)
    trace = ClosedLoop(hiding).run()
    truth = truth_of(trace)
    hulls = {
        round(truth.at_s(kept.stamp_ns), 1): kept.datum
        for kept in trace.of(words.WORKSPACE.name, words.HULL)
    }
    assert hulls[2.4].tight.any()
    assert not hulls[2.5].tight.any()
    assert all(len(hulls[second].voxels) for second in (2.4, 2.5, 2.6))


def test_a_box_is_filled_by_capsules_within_it():
    """At least 27 balls, and none of them reaches out of the box."""
    box = Box("thing", (1.0, 0.0, 0.15), (0.15, 0.15, 0.15))
    balls = capsules_in(box)
    assert (np.abs(balls[:, :3] - box.centre_m) + balls[:, 6:] <= 0.15 + 1e-9).all()
    assert len(balls) >= 27


def test_what_is_put_into_the_room_changes_only_itself_and_its_shadow():
    """The walls keep their texture, or a box that is left would be everywhere."""
    camera = cameras(scale=0.25)[2]
    thing = Box("thing", (1.5, -1.05, 0.15), (0.15, 0.15, 0.15))
    one, other = (backdrop_of(camera, boxes).image for boxes in (BOXES, (*BOXES, thing)))
    assert 0.0 < (one != other).any(-1).mean() < 0.03
