"""The actor of the hull: one set in, one hull out, with its stamp; cameras and joints that fail."""

from __future__ import annotations

import dataclasses
import math
from functools import lru_cache

import numpy as np
import pytest
from lost_commits import lose_commit
from slots import put_online as put

from actors.geometry.arms.kinematics import capsules_at
from actors.geometry.capsules import distance_between, distance_to_points, fill, outlines
from actors.geometry.hull.silhouettes import packed
from actors.geometry.shapes import Surface
from actors.workcell.reconstruction import (
    AHEAD_NS_MAX,
    NewImages,
    Reconstruction,
    arm_at,
    check_known,
    joints_at,
)
from actors.workcell.simulation.arm import ARM
from actors.workcell.simulation.room import BOXES as ROOM
from actors.workcell.simulation.room import cameras
from actors.workcell.vocabulary import (
    BOXES,
    CALIBRATION,
    GRID,
    HULL,
    JOINTS,
    MODEL,
    RAW_HULL,
    ROBOT,
    SILHOUETTE,
    SURFACE,
    WANTED,
    WORKSPACE,
    Grid,
    Joints,
    Silhouette,
    camera_entity,
    obstacle_entity,
)
from enact_dist import Lock, View, Write, testing
from enact_dist.actor.running.load import make_actor
from enact_dist.errors import ConfigError

pytest.importorskip("cv2", exc_type=ImportError)

PERIOD_NS = 100_000_000
FIRST_NS = 50 * PERIOD_NS
CAMERAS = cameras(scale=0.5)
BODY = np.array([[1.5, -1.0, 0.2, 1.5, -1.0, 1.4, 0.16], [1.5, -0.9, 1.3, 1.2, -0.5, 1.0, 0.06]])
FINE = cameras()
AROUND_ARM = Grid(np.array([-0.3, -1.3, 0.4]), 0.025, (88, 72, 56))
"""Body and arm at 2.5 cm; at 5 cm the arm's hull reaches beyond what the arm explains."""
GRID_OF_5_CM = Grid(np.array([-2.0, -2.0, 0.0]), 0.05, (80, 80, 44))
HOME = np.array([0.0, 0.6, 0, -1.3, 0, 0.9, 0])
ARM_AT_HOME = capsules_at(ARM, HOME)[0]


@lru_cache
def masks(body=True, arm=True, views=tuple(CAMERAS)):
    """Return what the eight cameras see of a body and the arm."""
    seen = [BODY] * body + [ARM_AT_HOME] * arm
    lines = outlines(
        np.concatenate([np.empty((0, 7)), *seen]),
        [(c.camera_matrix, c.distortion, c.camera_from_cell) for c in views],
        sides=32,
    )
    return [packed(mask) for mask in fill(lines, views[0].height, views[0].width)]


def joints_until(stamp_ns, samples=30, turning=0.0):
    """Return joints whose newest sample is of a stamp; the first joint turns."""
    stamps = stamp_ns - np.arange(samples)[::-1] * 10_000_000
    q = np.tile(HOME, (samples, 1))
    q[:, 0] = turning * (stamps - stamps[-1]) / 1e9
    dq = np.zeros((samples, 7))
    dq[:, 0] = turning
    return Joints(q, dq, stamps)


def seen(cell, aspect=HULL):
    """Return the newest datum of the workspace with its stamp."""
    request = View(cell.world("online"), WORKSPACE, aspect)
    with Lock(request) as lock:
        return lock.get(request), lock.stamp_ns(request)


def give(cell, number, bits, stamp_ns, **parts):
    """Write the silhouette of a camera."""
    silhouette = Silhouette(bits, int(np.unpackbits(bits).sum()), **parts)
    put(cell, camera_entity(number), SILHOUETTE, silhouette, stamp_ns)


def give_all(cell, stamp_ns, bits=None, without=(), **parts):
    """Write the silhouettes of all cameras but some."""
    for number, one in enumerate(bits or masks()):
        if number not in without:
            give(cell, number, one, stamp_ns, **parts)


@pytest.fixture
def cell():
    """The simulated room at 5 cm, its arm at home."""
    with testing.worlds("online") as cell:
        for number, calibration in enumerate(CAMERAS):
            put(cell, camera_entity(number), CALIBRATION, calibration)
        for number, box in enumerate(ROOM):
            put(cell, obstacle_entity(number), BOXES, box.row()[None])
        put(cell, WORKSPACE, GRID, GRID_OF_5_CM)
        put(cell, ROBOT, MODEL, ARM)
        put(cell, ROBOT, JOINTS, joints_until(FIRST_NS + 5 * PERIOD_NS, samples=200))
        yield cell


def body_voxels(grid=GRID_OF_5_CM):
    """Return the voxels, (i, j, k), whose centre lies in the body."""
    index = np.stack(np.meshgrid(*[np.arange(n) for n in grid.shape], indexing="ij"), -1)
    index = index.reshape(-1, 3)
    centres = grid.origin_m + (index + 0.5) * grid.voxel_m
    return {tuple(row) for row in index[distance_to_points(BODY, centres) <= 0.0].tolist()}


def voxels_of(hull):
    """Return the voxels of a hull as a set."""
    return {tuple(row) for row in hull.voxels.tolist()}


@pytest.fixture
def fine_cell(cell):
    """The same at full resolution, around the arm."""
    for number, calibration in enumerate(FINE):
        put(cell, camera_entity(number), CALIBRATION, calibration)
    put(cell, WORKSPACE, GRID, AROUND_ARM)
    return cell


def test_a_set_becomes_a_hull_with_its_stamp(fine_cell):
    """The body is in it, the robot is not, all cameras are named, the distance is on the safe side."""
    cell = fine_cell
    give_all(cell, FIRST_NS, masks(views=FINE))
    assert testing.run_once(Reconstruction(), cell) == 1
    hull, stamp_ns = seen(cell)
    assert stamp_ns == FIRST_NS
    assert hull.cameras == tuple(f"camera/{number}" for number in range(8))
    assert body_voxels(AROUND_ARM) <= voxels_of(hull)
    true_m = distance_between(BODY, ARM_AT_HOME)
    assert true_m - 0.12 < hull.nearest_m <= true_m
    assert hull.clearance_m[hull.nearest_voxel] == np.float32(hull.nearest_m)
    assert hull.tight.any()
    assert hull.voxels.dtype == hull.component.dtype == np.int16
    assert hull.counts["raw"] > len(hull.voxels)
    assert hull.counts["robot"] > 0


def test_an_empty_cell_is_infinitely_far(fine_cell):
    """The robot alone leaves nothing near it."""
    give_all(fine_cell, FIRST_NS, masks(body=False, views=FINE))
    testing.run_once(Reconstruction(), fine_cell)
    hull, _ = seen(fine_cell)
    assert hull.nearest_m == math.inf
    assert hull.nearest_voxel == -1
    assert len(hull.voxels) == 0


def test_each_complete_set_runs_once_and_in_order(cell):
    """Sets follow each other; the second looks back on the first."""
    actor = Reconstruction()
    for number in range(3):
        give_all(cell, FIRST_NS + number * PERIOD_NS)
        assert testing.run_once(actor, cell) == 1
        assert seen(cell)[1] == FIRST_NS + number * PERIOD_NS
    assert testing.run_once(actor, cell) == 0


def test_sets_that_came_meanwhile_are_passed_over_for_the_newest(cell):
    """An update that was held up does not make the next ones late, too."""
    actor = Reconstruction()
    give_all(cell, FIRST_NS)
    testing.run_once(actor, cell)
    for number in range(1, 5):
        give_all(cell, FIRST_NS + number * PERIOD_NS)

    assert testing.run_once(actor, cell) == 1
    assert seen(cell)[1] == FIRST_NS + 4 * PERIOD_NS


def test_a_late_set_is_passed_over_while_hulls_come(cell, monkeypatch):
    """It would only make the next ones late, too; after a gap a late hull is better than none."""
    now_ns = [FIRST_NS + 10_000_000_000]
    monkeypatch.setattr("actors.workcell.reconstruction.time.time_ns", lambda: now_ns[0])
    actor = Reconstruction()
    actor.late_s = 0.3
    written = []
    for number, waited_s in enumerate((0.0, 0.1, 0.6)):
        now_ns[0] += round(waited_s * 1e9)
        give_all(cell, FIRST_NS + number * PERIOD_NS)
        testing.run_once(actor, cell)
        written.append((seen(cell)[1] - FIRST_NS) // PERIOD_NS)
    assert written == [0, 0, 2]


def test_a_set_whose_hull_was_not_written_gives_the_same_hull_again(cell):
    """Its images are not taken for those of the set before, which would veto nothing."""
    actor = Reconstruction()
    give_all(cell, FIRST_NS, image_checksum=7)
    testing.run_once(actor, cell)
    second_ns = FIRST_NS + PERIOD_NS
    give_all(cell, second_ns, image_checksum=8)
    lose_commit(actor, cell)
    assert seen(cell)[1] == FIRST_NS
    testing.run_once(actor, cell)
    hull, stamp_ns = seen(cell)
    assert (stamp_ns, len(hull.cameras)) == (second_ns, 8)


def test_a_late_set_is_taken_if_the_hull_before_it_was_not_written(cell, monkeypatch):
    """Hulls come as long as their commits stand."""
    late_ns = FIRST_NS + 10_000_000_000
    monkeypatch.setattr("actors.workcell.reconstruction.time.time_ns", lambda: late_ns)
    actor = Reconstruction()
    actor.late_s = 0.3
    give_all(cell, FIRST_NS)
    lose_commit(actor, cell)
    give_all(cell, FIRST_NS + PERIOD_NS)
    testing.run_once(actor, cell)
    assert seen(cell)[1] == FIRST_NS + PERIOD_NS


def test_a_hull_of_too_many_voxels_keeps_the_nearest(cell, monkeypatch):
    """Cameras in the dark fill the grid; the distance is that of all, the rest is counted."""
    monkeypatch.setattr("actors.workcell.reconstruction.VOXELS_MAX", 500)
    dark = [np.full_like(bits, 255) for bits in masks()]
    give_all(cell, FIRST_NS, dark)
    testing.run_once(Reconstruction(), cell)
    hull, _ = seen(cell)
    assert len(hull.voxels) == len(hull.tight) == len(hull.component) == 500
    assert hull.counts["distant"] > 100_000
    assert hull.clearance_m.max() < 0.15
    assert hull.nearest_m == hull.clearance_m.min() < 0.05


def test_a_stand_in_and_a_stuck_image_veto_nothing_and_are_not_named(cell):
    """A camera that stands in, or gives the image of the last set again, only adds voxels."""
    whole = Reconstruction()
    give_all(cell, FIRST_NS, image_checksum=7)
    testing.run_once(whole, cell)
    before = voxels_of(seen(cell)[0])
    second = FIRST_NS + PERIOD_NS
    for number, bits in enumerate(masks()):
        if number == 3:
            give(cell, 3, np.full_like(bits, 255), second, stand_in=True)
        else:
            give(cell, number, bits, second, image_checksum=7 if number == 5 else 8)
    testing.run_once(whole, cell)
    hull, _ = seen(cell)
    assert hull.cameras == tuple(f"camera/{n}" for n in range(8) if n not in (3, 5))
    assert before <= voxels_of(hull)


def test_a_camera_whose_buffers_alternate_vetoes_nothing(cell):
    """The image of the set before the last one is stuck, too."""
    actor = Reconstruction()
    for number, checksum in enumerate((7, 8, 7)):
        for camera, bits in enumerate(masks()):
            mine = checksum if camera == 5 else 10 + number
            give(cell, camera, bits, FIRST_NS + number * PERIOD_NS, image_checksum=mine)
        testing.run_once(actor, cell)
    assert seen(cell)[0].cameras == tuple(f"camera/{n}" for n in range(8) if n != 5)


def test_pictures_without_noise_may_be_equal(cell):
    """With `stuck` off, equal images count."""
    actor = Reconstruction(stuck=False)
    for number in range(2):
        give_all(cell, FIRST_NS + number * PERIOD_NS, image_checksum=7)
        testing.run_once(actor, cell)
    assert len(seen(cell)[0].cameras) == 8


def test_a_set_without_a_camera_runs_with_a_larger_hull():
    """What does not come stands in for itself after a while, and is not named."""
    clock = testing.ManualClock()
    with testing.worlds("online", clock=clock) as made:
        for number, calibration in enumerate(CAMERAS):
            put(made, camera_entity(number), CALIBRATION, calibration)
        put(made, WORKSPACE, GRID, GRID_OF_5_CM)
        actor = Reconstruction(robot=False)
        give_all(made, FIRST_NS, masks(arm=False))
        testing.run_once(actor, made)
        before = voxels_of(seen(made)[0])
        give_all(made, FIRST_NS + PERIOD_NS, masks(arm=False), without=(6,))
        assert testing.run_once(actor, made) == 0
        clock.advance(0.2)
        assert testing.run_once(actor, made) == 1
        hull, stamp_ns = seen(made)
    assert stamp_ns == FIRST_NS + PERIOD_NS
    assert "camera/6" not in hull.cameras
    assert len(hull.cameras) == 7
    assert before <= voxels_of(hull)


@pytest.mark.parametrize("newest_ns", [None, FIRST_NS - AHEAD_NS_MAX - 1, FIRST_NS + 10**9])
def test_without_joints_of_the_exposure_everything_is_at_distance_zero(cell, newest_ns):
    """No joints, stale ones, and ones from later on: nothing is taken for the robot."""
    request = Write(cell.world("online"), ROBOT, JOINTS)
    with Lock(request) as lock:
        if newest_ns is None:
            del lock[request]
        else:
            lock[request] = joints_until(newest_ns)
    give_all(cell, FIRST_NS, masks(body=False))
    testing.run_once(Reconstruction(), cell)
    hull, _ = seen(cell)
    assert hull.nearest_m <= 0.0
    assert len(hull.voxels) > 100
    assert hull.counts["robot"] == 0


def test_joints_are_interpolated_and_carried_on_for_a_while():
    """Between samples by time, after the newest by its speed, up to 0.1 s; before the oldest not."""
    joints = joints_until(FIRST_NS, turning=0.5)
    for late_s in (-0.105, 0.0, 0.08):
        stamp_ns = FIRST_NS + round(late_s * 1e9)
        assert joints_at(joints, stamp_ns)[0] == pytest.approx(0.5 * late_s, abs=1e-9)
    assert joints_at(joints, FIRST_NS + AHEAD_NS_MAX + 1) is None
    assert joints_at(joints, FIRST_NS - 300_000_000) is None
    none = Joints(np.empty((0, 7)), np.empty((0, 7)), np.empty(0, np.int64))
    assert joints_at(none, FIRST_NS) is None


def exposed_apart(cell, actor):
    """Give a set whose cameras look up to 33 ms apart at a body that walks; return the updates."""
    late_ms = [0, 33, 5, 28, 12, 20, 31, 8]
    for number, ms in enumerate(late_ms):
        walked = np.array([1.6 * ms / 1e3, 0.0, 0.0])
        there = BODY + np.r_[walked, walked, 0.0]
        lines = outlines(
            np.concatenate([there, ARM_AT_HOME]),
            [(FINE[number].camera_matrix, FINE[number].distortion, FINE[number].camera_from_cell)],
            sides=32,
        )
        bits = packed(fill(lines, FINE[number].height, FINE[number].width)[0])
        give(cell, number, bits, FIRST_NS + ms * 1_000_000)
    return testing.run_once(actor, cell)


def test_cameras_without_a_common_trigger_make_one_set(fine_cell):
    """Their set has the stamp of its oldest image, and holds whoever was there at that moment."""
    options = {"cameras": 8, "within_s": 0.035}
    actor = make_actor(Reconstruction, options)

    assert exposed_apart(fine_cell, actor) == 1

    hull, stamp_ns = seen(fine_cell)
    assert stamp_ns == FIRST_NS
    assert len(hull.cameras) == 8
    assert body_voxels(AROUND_ARM) <= voxels_of(hull)
    true_m = distance_between(BODY, ARM_AT_HOME)
    assert 0.1 < hull.nearest_m <= true_m - 1.6 * 0.035


def test_an_empty_cell_of_cameras_without_a_trigger_is_infinitely_far(fine_cell):
    """The robot's own outlines do not grow."""
    give_all(fine_cell, FIRST_NS, masks(body=False, views=FINE))
    testing.run_once(Reconstruction.of_options({"within_s": 0.035})(), fine_cell)
    assert seen(fine_cell)[0].nearest_m == math.inf


def test_a_cell_of_four_cameras(cell):
    """The number is an option; the masks of other cameras are no part of its sets."""
    actor = make_actor(Reconstruction, {"cameras": 4, "late_s": 0.3})
    for number, bits in enumerate(masks()[:4]):
        give(cell, number, bits, FIRST_NS)

    assert testing.run_once(actor, cell) == 1
    hull, _ = seen(cell)
    assert hull.cameras == tuple(f"camera/{number}" for number in range(4))
    assert actor.late_s == 0.3
    assert body_voxels() <= voxels_of(hull)


@pytest.mark.parametrize(
    ("options", "words"),
    [({"cameras": 1}, "two or more"), ({"within_s": 0.05}, "within_s is 0.05; with half")],
)
def test_what_cannot_be_a_set_is_refused(options, words):
    """One camera alone, and images that could belong to two sets."""
    with pytest.raises(ConfigError, match=words):
        make_actor(Reconstruction, options)


def test_the_raw_hull_is_written_while_somebody_looks(cell):
    """Before refinement it holds the robot, too."""
    actor = Reconstruction()
    give_all(cell, FIRST_NS)
    testing.run_once(actor, cell)
    assert seen(cell, RAW_HULL)[0] is None
    put(cell, WORKSPACE, WANTED, 1)
    give_all(cell, FIRST_NS + PERIOD_NS)
    testing.run_once(actor, cell)
    raw, stamp_ns = seen(cell, RAW_HULL)
    assert stamp_ns == FIRST_NS + PERIOD_NS
    assert len(raw) == seen(cell)[0].counts["raw"] > len(seen(cell)[0].voxels)


def test_a_moved_camera_is_looked_through_anew(cell):
    """Tables follow the calibration: with another pose the same masks give another hull."""
    actor = Reconstruction()
    give_all(cell, FIRST_NS)
    testing.run_once(actor, cell)
    before = voxels_of(seen(cell)[0])
    moved = CAMERAS[0].camera_from_cell.copy()
    moved[0, 3] += 0.3
    put(
        cell, camera_entity(0), CALIBRATION, dataclasses.replace(CAMERAS[0], camera_from_cell=moved)
    )
    give_all(cell, FIRST_NS + PERIOD_NS)
    testing.run_once(actor, cell)
    assert voxels_of(seen(cell)[0]) != before


def test_what_is_wrong_is_one_line(cell):
    """Another size, a missing and a mirrored calibration, a surface without boxes: each by name."""
    small = [bits[:120, :20] for bits in masks()]
    mirrored = CAMERAS[4].camera_from_cell.copy()
    mirrored[0] *= -1
    bare = Surface.free_form(np.zeros((3, 3)), np.array([[0, 1, 2]]))

    def refused(stamp_ns, words, bits=None):
        give_all(cell, stamp_ns, bits)
        with pytest.raises(ValueError, match=words) as error:
            testing.run_once(Reconstruction(), cell)
        assert "\n" not in str(error.value)

    refused(FIRST_NS, "silhouette 0: asked for 320 x 240 pixels as in the calibration", small)
    put(cell, obstacle_entity(9), SURFACE, bare)
    refused(FIRST_NS + PERIOD_NS, "obstacle/9: a surface without boxes")
    put(cell, obstacle_entity(9), BOXES, ROOM[0].row()[None])
    wrong = dataclasses.replace(CAMERAS[4], camera_from_cell=mirrored)
    put(cell, camera_entity(4), CALIBRATION, wrong)
    refused(FIRST_NS + 2 * PERIOD_NS, "calibration of camera/4: .* a pose that mirrors")
    request = Write(cell.world("online"), camera_entity(4), CALIBRATION)
    with Lock(request) as lock:
        del lock[request]
    refused(FIRST_NS + 3 * PERIOD_NS, "calibration of camera/4 is null")


def image(checksum, *, stand_in=False):
    return Silhouette(np.zeros((4, 1), np.uint8), 0, stand_in, checksum)


def test_an_image_of_the_last_four_of_its_own_camera_is_not_new():
    """Two cameras may see the same; 0 is no checksum; the fifth one back counts again."""
    images = NewImages()
    newest = [1, 2, 1, 3, 4, 5, 2, 0, 0]
    new = [list(images.of({"a": image(one), "b": image(number + 1)}))
           for number, one in enumerate(newest)]  # fmt: skip
    assert ["a" in names for names in new] == [True, True, False, *[True] * 6]
    assert all("b" in names for names in new)


def test_what_is_no_image_is_no_new_image():
    """Nothing came, or another one stands in; repeated images count where they are allowed."""
    images = NewImages()
    assert images.of({"a": None, "b": image(7, stand_in=True), "c": image(7)}).keys() == {"c"}
    assert images.of({"b": image(7), "c": image(7)}).keys() == {"b"}
    assert images.of({"c": image(7)}, or_repeated=True).keys() == {"c"}


def test_an_arm_of_which_something_is_not_known_is_nowhere():
    """Neither without its model nor without joints of the exposure."""
    joints = joints_until(FIRST_NS)
    np.testing.assert_allclose(arm_at(ARM, joints, FIRST_NS), ARM_AT_HOME)
    assert arm_at(None, joints, FIRST_NS) is None
    assert arm_at(ARM, None, FIRST_NS) is None
    assert arm_at(ARM, joints, FIRST_NS + AHEAD_NS_MAX + 1) is None


@pytest.mark.parametrize(
    ("cameras", "surfaces", "has_grid", "why"),
    [
        ({"camera/0"}, (), True, "calibration of camera/1 is null"),
        ({"camera/0", "camera/1"}, (), False, "workspace/grid is null"),
        ({"camera/0", "camera/1"}, (0, 2), True, "obstacle/2: a surface without boxes"),
    ],
)
def test_a_cell_of_which_too_little_is_known_is_refused(cameras, surfaces, has_grid, why):
    """One line names what has to be written first."""
    boxes = {obstacle_entity(0), obstacle_entity(1)}
    every = ["camera/0", "camera/1"]
    with pytest.raises(ValueError, match=why):
        check_known(every, cameras, boxes, map(obstacle_entity, surfaces), has_grid=has_grid)
    check_known(every, every, boxes, [obstacle_entity(1)], has_grid=True)
