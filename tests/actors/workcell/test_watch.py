"""Dead, frozen and stuck cameras are named, and others stand in so that the hull only grows."""

import numpy as np
import pytest

from actors.workcell.vocabulary import (
    CALIBRATION,
    CAMERA_STATES,
    SILHOUETTE,
    SYSTEM,
    Calibration,
    Silhouette,
    camera_entity,
)
from actors.workcell.watch import CameraWatch, Seen, StandIn
from enact_dist import Lock, View, Write, testing

PERIOD_NS = 100_000_000
WIDTH, HEIGHT = 36, 20
COUNT = 3


class Cell:
    """Three cameras of which a test decides at each tick what they give."""

    def __init__(self, cell, clock):
        self.cell, self.online, self.clock = cell, cell.world("online"), clock
        self.watch, self.stand_in = CameraWatch(), StandIn()
        for number in range(COUNT):
            camera = Calibration(np.eye(3), np.zeros(5), np.eye(4), WIDTH, HEIGHT)
            self.online.init(camera_entity(number), CALIBRATION, camera)

    @property
    def tick_ns(self):
        return self.clock.wall_ns() // PERIOD_NS * PERIOD_NS

    def give(self, number, *, checksum=None, foreground_px=10, stamp_ns=None):
        """Let a camera give its silhouette of this tick."""
        request = Write(self.online, camera_entity(number), SILHOUETTE)
        stamp_ns = self.tick_ns if stamp_ns is None else stamp_ns
        mask = np.zeros((HEIGHT, (WIDTH + 7) // 8), np.uint8)
        checksum = stamp_ns // PERIOD_NS if checksum is None else checksum
        with Lock(request) as lock:
            lock.put(
                request, Silhouette(mask, foreground_px, image_checksum=checksum), stamp_ns=stamp_ns
            )

    def tick(self, *gives, **options):
        """Let a period begin: the watch looks, then cameras give theirs; return the states."""
        self.clock.advance(0.1)
        testing.run_once(self.watch, self.cell)
        testing.run_once(self.stand_in, self.cell)
        for number in gives:
            self.give(number, **options)
        return self.states()

    def states(self):
        request = View(self.online, SYSTEM, CAMERA_STATES)
        return self.online.view(request)[request]

    def newest(self, number):
        request = View(self.online, camera_entity(number), SILHOUETTE)
        with Lock(request) as lock:
            return lock.get(request), lock.stamp_ns(request)

    def troubles(self):
        return [self.states()[f"camera/{number}"].trouble for number in range(COUNT)]


@pytest.fixture
def cell():
    clock = testing.ManualClock()
    with testing.worlds("online", clock=clock) as opened:
        yield Cell(opened, clock)


def test_sound_cameras_need_nobody(cell):
    """All alive, no trouble, every silhouette its camera's own."""
    for _ in range(5):
        cell.tick(0, 1, 2)
    cell.tick()

    assert cell.troubles() == ["", "", ""]
    assert all(state.alive for state in cell.states().values())
    for number in range(COUNT):
        assert not cell.newest(number)[0].stand_in


def test_dead_camera_is_named_and_another_stands_in(cell):
    """From the second tick on, at once: all foreground, with the stamp of the set."""
    for _ in range(3):
        cell.tick(0, 1, 2)
    died_ns = cell.tick_ns
    cell.tick(0, 1)
    cell.tick(0, 1)

    state = cell.states()["camera/2"]
    stand_in, stamp_ns = cell.newest(2)

    assert cell.troubles() == ["", "", "silent"]
    assert (state.alive, state.last_ns, state.sets_missed) == (False, died_ns, 1)
    assert stamp_ns == cell.tick_ns
    assert stand_in.stand_in
    assert stand_in.foreground_px == WIDTH * HEIGHT
    assert np.unpackbits(stand_in.packed, axis=1)[:, :WIDTH].all()
    assert stand_in.packed.shape == (HEIGHT, 5)


def test_camera_that_comes_back_is_taken_back(cell):
    """Its own silhouette replaces the stand-in; the sets it missed stay counted."""
    cell.tick(0, 1, 2)
    for _ in range(4):
        cell.tick(0, 1)
    cell.tick(0, 1, 2)

    cell.tick(0, 1, 2)

    state = cell.states()["camera/2"]
    assert (state.alive, state.trouble, state.sets_missed) == (True, "", 4)
    assert not cell.newest(2)[0].stand_in


def test_stamps_that_stand_still_are_silence(cell):
    """A camera that goes on giving the image of one moment counts as dead."""
    cell.tick(0, 1, 2)
    still_ns = cell.tick_ns
    for number in range(3):
        cell.tick(0, 1)
        cell.give(2, stamp_ns=still_ns, checksum=number)

    cell.tick(0, 1)

    assert cell.troubles() == ["", "", "silent"]
    assert cell.newest(2)[0].stand_in


def test_camera_whose_clock_was_set_back_is_watched_by_its_new_stamps(cell):
    """Stamps an hour ahead are corrected, then the camera dies: it is silent, not ahead."""
    for number in range(2):
        cell.tick(0, 1)
        cell.give(2, stamp_ns=cell.tick_ns + 3600 * 10**9, checksum=100 + number)
    cell.tick(0, 1, 2)
    assert cell.tick(0, 1, 2)["camera/2"].alive

    cell.tick(0, 1)
    cell.tick(0, 1)

    assert cell.troubles() == ["", "", "silent"]


def test_image_that_repeats_is_stuck(cell):
    """Images equal bit by bit under new stamps: not alive, though silhouettes come."""
    cell.tick(0, 1, 2)
    for _ in range(3):
        cell.tick(0, 1)
        cell.give(2, checksum=77)
    cell.tick(0, 1, 2)
    stuck = cell.states()["camera/2"]

    cell.tick(0, 1, 2)

    assert (stuck.alive, stuck.trouble, stuck.sets_missed) == (False, "stuck", 1)
    assert cell.states()["camera/2"].trouble == ""


def test_a_camera_that_is_calibrated_is_watched_from_then_on(cell):
    """However many there are; a silhouette of one that is not calibrated counts for nothing."""
    cell.give(COUNT)
    assert len(cell.tick(0, 1, 2)) == COUNT
    camera = Calibration(np.eye(3), np.zeros(5), np.eye(4), WIDTH, HEIGHT)
    cell.online.init(camera_entity(COUNT), CALIBRATION, camera)
    assert list(cell.tick()) == [f"camera/{number}" for number in range(COUNT + 1)]


def test_buffers_that_alternate_are_stuck(cell):
    """A driver that gives its old buffers in turn repeats no image at once."""
    cell.tick(0, 1, 2)
    for checksum in (70, 71, 72, 73) * 2:
        cell.tick(0, 1)
        cell.give(2, checksum=checksum)
    cell.tick(0, 1, 2)

    assert cell.troubles() == ["", "", "stuck"]


def test_masks_without_images_are_never_stuck(cell):
    """A checksum of 0 says that there was no image to compare."""
    for _ in range(5):
        cell.tick(0, 1, 2, checksum=0)

    assert cell.tick()["camera/0"].trouble == ""


def test_background_that_no_longer_fits_is_named(cell):
    """More than 30 % foreground; a stand-in, which is all foreground, does not count."""
    cell.tick(0, 1, 2)
    cell.tick(0, 1, foreground_px=WIDTH * HEIGHT // 2)
    cell.tick(0, 1, foreground_px=WIDTH * HEIGHT // 2)

    cell.tick(0, 1, foreground_px=WIDTH * HEIGHT // 2)

    assert cell.troubles() == ["background no longer fits"] * 2 + ["silent"]
    assert cell.states()["camera/0"].alive


def test_nobody_stands_in_for_all(cell):
    """With no camera alive there is no set: the robot stops in silence."""
    cell.tick(0, 1, 2)

    for _ in range(3):
        cell.tick()

    assert cell.troubles() == ["silent"] * 3
    assert not any(cell.newest(number)[0].stand_in for number in range(COUNT))


def test_late_silhouette_is_not_replaced(cell):
    """If the camera's own has come after all, the stand-in does not overwrite it."""
    cell.tick(0, 1, 2)
    cell.tick(0, 1)
    cell.clock.advance(0.1)
    testing.run_once(cell.watch, cell.cell)
    cell.give(2)

    testing.run_once(cell.stand_in, cell.cell)

    assert not cell.newest(2)[0].stand_in


TICK_NS = 50 * PERIOD_NS
ON_TIME = Seen(last_ns=TICK_NS - PERIOD_NS)


@pytest.mark.parametrize(
    ("seen", "trouble", "missed"),
    [
        (ON_TIME, "", 0),
        (ON_TIME._replace(last_ns=TICK_NS - 2 * PERIOD_NS, missed=4), "silent", 5),
        (Seen(), "silent", 0),
        (ON_TIME._replace(alike=1), "", 0),
        (ON_TIME._replace(alike=2), "stuck", 1),
        (ON_TIME._replace(alike=2, last_ns=1), "silent", 1),
        (ON_TIME._replace(foreground=0.31), "background no longer fits", 0),
        (ON_TIME._replace(foreground=0.31, alike=2), "stuck", 1),
    ],
    ids=["sound", "late", "never came", "once alike", "alike", "alike and late", "full",
         "full and alike"],
)  # fmt: skip
def test_state_names_the_worst_trouble(seen, trouble, missed):
    """A camera that gives nothing new misses sets, once it has given any; one that misfits sees."""
    after, state = seen.state(TICK_NS, late_s=0.15, alike_max=1, foreground_max=0.3)
    assert (state.trouble, state.alive) == (trouble, trouble not in {"silent", "stuck"})
    assert after == seen._replace(missed=missed)
    assert (state.last_ns, state.sets_missed) == (seen.last_ns, missed)
