"""Background actors: learn on the operator's word, subtract with the image's stamp."""

from __future__ import annotations

import numpy as np
import pytest
from lost_commits import lose_commit
from slots import put_online as put

from actors.geometry.arms.kinematics import capsules_at
from actors.geometry.capsules import fill, outlines
from actors.geometry.hull.silhouettes import unpacked
from actors.workcell.background import (
    RESTED_NS,
    BackgroundLearning,
    BackgroundSubtraction,
    arm_at_rest,
    checksum,
)
from actors.workcell.cameras.sources import source_of
from actors.workcell.simulation.arm import ARM
from actors.workcell.smart_camera import SmartCamera
from actors.workcell.vocabulary import (
    BACKGROUND,
    CALIBRATION,
    EMPTY,
    IMAGE,
    JOINTS,
    MODEL,
    ROBOT,
    SILHOUETTE,
    WORKSPACE,
    Background,
    Calibration,
    Joints,
    camera_entity,
)
from enact_dist import Lock, View, testing

cv2 = pytest.importorskip("cv2", exc_type=ImportError)

CAMERA = camera_entity(2)
PERIOD_NS = 100_000_000
SHAPE = (48, 64, 3)
PERSON = np.s_[10:40, 20:35]
CALIBRATED = Calibration(np.eye(3), np.zeros(5), np.eye(4), SHAPE[1], SHAPE[0])


@pytest.fixture
def random():
    """Noise of the images."""
    return np.random.default_rng(1)


@pytest.fixture
def cell():
    """A cell with one context."""
    with testing.worlds("online") as cell:
        yield cell


def image_of(random, *, person=False, shape=SHAPE):
    """Return an image of a grey cell with noise, and with a person in it."""
    image = np.full(shape, 120.0)
    if person:
        image[PERSON] = (160, 60, 40)
    return np.rint(image + random.normal(0, 2.5, shape)).clip(0, 255).astype(np.uint8)


def seen(cell, entity, aspect):
    """Return a datum and its capture stamp, or None."""
    request = View(cell.world("online"), entity, aspect)
    with Lock(request) as lock:
        return None if lock.is_null(request) else (lock[request], lock.stamp_ns(request))


def actor_of(kind, *args, **options):
    """Return an actor of the one camera."""
    actor = kind(*args, **options)
    actor.only_entity = CAMERA
    return actor


def learn(cell, learning, random, first, count, **options):
    """Let a camera give images with stamps from a period on, each seen by the learning."""
    for number in range(first, first + count):
        put(cell, CAMERA, IMAGE, image_of(random, **options), number * PERIOD_NS)
        testing.run_once(learning, cell)


def test_a_background_is_learned_after_the_word_and_not_before(cell, random):
    """Images from before the word do not count; the background bears the stamp of its last image."""
    learning = actor_of(BackgroundLearning, images=5)
    learn(cell, learning, random, 1, 8, person=True)
    assert seen(cell, CAMERA, BACKGROUND) is None
    put(cell, WORKSPACE, EMPTY, 10 * PERIOD_NS)
    learn(cell, learning, random, 9, 6)
    assert seen(cell, CAMERA, BACKGROUND) is None
    learn(cell, learning, random, 15, 1)
    found, stamp_ns = seen(cell, CAMERA, BACKGROUND)
    assert stamp_ns == found.captured_ns == 15 * PERIOD_NS
    assert found.frames == 5
    assert np.abs(found.mean.astype(int) - 120).max() <= 3
    assert found.spread.min() >= 0


def test_a_background_whose_commit_fails_comes_with_the_next_image(cell, random):
    """It is not learned anew from the first image on."""
    learning = actor_of(BackgroundLearning, images=5)
    put(cell, WORKSPACE, EMPTY, PERIOD_NS)
    learn(cell, learning, random, 2, 4)
    put(cell, CAMERA, IMAGE, image_of(random), 6 * PERIOD_NS)
    lose_commit(learning, cell)
    assert seen(cell, CAMERA, BACKGROUND) is None
    learn(cell, learning, random, 7, 1)
    found, stamp_ns = seen(cell, CAMERA, BACKGROUND)
    assert (found.frames, stamp_ns) == (6, 7 * PERIOD_NS)
    put(cell, WORKSPACE, EMPTY, 8 * PERIOD_NS)
    learn(cell, learning, random, 9, 4)
    assert seen(cell, CAMERA, BACKGROUND)[1] == stamp_ns


ROOM = Calibration(
    np.array([[60.0, 0, 31.5], [0, 60.0, 23.5], [0, 0, 1]]), np.zeros(5),
    np.array([[0, 1.0, 0, 0], [0, 0, -1.0, 0.9], [-1.0, 0, 0, 3.0], [0, 0, 0, 1.0]]),
    SHAPE[1], SHAPE[0],
)  # fmt: skip
"""Three metres before the arm, at the height of its middle."""
LEANS = np.array([[0, turn, 0, 0, 0, 0, 0] for turn in (-1.2, 1.2)]) + np.eye(7)[0] * np.pi / 2


def rest(cell, q, at_ns, dq=0.0):
    """Publish joints of an arm that rests, or turns."""
    stamps = at_ns - 10_000_000 * np.arange(29, -1, -1)
    put(cell, ROBOT, JOINTS, Joints(np.tile(q, (30, 1)), np.full((30, 7), dq), stamps), at_ns)


def shown(random, q):
    """Return an image of the grey cell with the arm, bright; and where it is."""
    arm = capsules_at(ARM, q)[0]
    seen_by = [(ROOM.camera_matrix, ROOM.distortion, ROOM.camera_from_cell)]
    there = fill(outlines(arm, seen_by), *SHAPE[:2])[0] > 0
    image = image_of(random)
    image[there] = 230
    return image, there


def teach(cell, learning, random, first, q, count=4):
    """Say that the cell is empty, and let images with the arm come; return the background."""
    put(cell, WORKSPACE, EMPTY, first * PERIOD_NS)
    for number in range(first + 1, first + 1 + count):
        rest(cell, q, number * PERIOD_NS)
        put(cell, CAMERA, IMAGE, shown(random, q)[0], number * PERIOD_NS)
        testing.run_once(learning, cell)
    return seen(cell, CAMERA, BACKGROUND)[0]


@pytest.fixture
def with_arm(cell):
    """Learning of a camera that sees the arm."""
    put(cell, CAMERA, CALIBRATION, ROOM)
    put(cell, ROBOT, MODEL, ARM)
    return actor_of(BackgroundLearning, images=4, arm_in_view=True)


def test_the_arm_is_no_background_and_what_it_hides_tells_nothing(cell, random, with_arm, caplog):
    """Such pixels are foreground whatever they show, are counted, and are named in the log."""
    found = teach(cell, with_arm, random, 1, LEANS[0])
    _, there = shown(random, LEANS[0])
    hidden = unpacked(found.hidden, SHAPE[1]) > 0

    assert hidden[there].all()
    assert found.hidden_px == hidden.sum() < 0.6 * hidden.size
    assert np.abs(found.mean[~hidden].astype(int) - 120).max() <= 4
    assert f"camera/2: {found.hidden_px} pixels" in caplog.text
    assert "declare the cell empty again" in caplog.text
    subtraction = actor_of(BackgroundSubtraction)
    put(cell, CAMERA, IMAGE, image_of(random), 9 * PERIOD_NS)
    testing.run_once(subtraction, cell)
    mask = unpacked(seen(cell, CAMERA, SILHOUETTE)[0].packed, SHAPE[1]) > 0
    np.testing.assert_array_equal(mask, hidden)


def test_what_the_arm_hid_is_learned_when_it_is_elsewhere(cell, random, with_arm):
    """Said empty again at another pose: only what both poses hide is left."""
    first = unpacked(teach(cell, with_arm, random, 1, LEANS[0]).hidden, SHAPE[1]) > 0

    found = teach(cell, with_arm, random, 20, LEANS[1])

    hidden = unpacked(found.hidden, SHAPE[1]) > 0
    assert found.hidden_px == hidden.sum() > 0
    assert (first & ~hidden).sum() > 50
    assert not (hidden & ~first).any()
    assert np.abs(found.mean[~hidden].astype(int) - 120).max() <= 4


def test_nothing_is_learned_while_the_arm_moves(cell, random, with_arm, caplog):
    """Where it was at the exposure is not known well enough; the log says what is waited for."""
    put(cell, WORKSPACE, EMPTY, PERIOD_NS)
    for number in range(2, 10):
        rest(cell, LEANS[0], number * PERIOD_NS, dq=0.1)
        put(cell, CAMERA, IMAGE, shown(random, LEANS[0])[0], number * PERIOD_NS)
        testing.run_once(with_arm, cell)

    assert seen(cell, CAMERA, BACKGROUND) is None
    assert caplog.text.count("camera/2 is learned once the arm rests") == 1


@pytest.mark.parametrize("later_ms", [-150, 350])
def test_nothing_is_learned_where_the_arm_is_not_known_at_the_exposure(
    cell, random, with_arm, later_ms
):
    """An arm that rests since the exposure, or rested before it, may have moved at it."""
    put(cell, WORKSPACE, EMPTY, PERIOD_NS)
    for number in range(2, 10):
        rest(cell, LEANS[0], number * PERIOD_NS + later_ms * 1_000_000)
        put(cell, CAMERA, IMAGE, shown(random, LEANS[0])[0], number * PERIOD_NS)
        testing.run_once(with_arm, cell)

    assert seen(cell, CAMERA, BACKGROUND) is None


@pytest.mark.parametrize(
    ("late_ns", "dq", "is_known"),
    [(0, 0.0, True), (RESTED_NS, 0.0, True), (RESTED_NS + 1, 0.0, False), (0, 0.01, False)],
)
def test_an_arm_that_rested_at_the_exposure_is_where_it_was(random, late_ns, dq, is_known):
    """Its outline covers it with a margin; without camera, model or joints it is nowhere."""
    newest_ns = 10 * PERIOD_NS
    stamps = newest_ns - 10_000_000 * np.arange(29, -1, -1)
    joints = Joints(np.tile(LEANS[0], (30, 1)), np.full((30, 7), dq), stamps)
    known = [ROOM, ARM, joints]
    found = arm_at_rest(*known, newest_ns + late_ns, SHAPE[:2])
    assert (found is not None) == is_known
    if found is not None:
        _, there = shown(random, LEANS[0])
        assert (found[there] > 0).all()
        assert (found > 0).sum() > there.sum()
    for missing in range(3):
        partly = [None if number == missing else one for number, one in enumerate(known)]
        assert arm_at_rest(*partly, newest_ns, SHAPE[:2]) is None


def test_the_same_image_twice_is_one_image(cell, random):
    """A tick without a new image teaches nothing."""
    learning = actor_of(BackgroundLearning, images=3)
    put(cell, WORKSPACE, EMPTY, 1)
    put(cell, CAMERA, IMAGE, image_of(random), PERIOD_NS)
    for _ in range(5):
        testing.run_once(learning, cell)
    assert seen(cell, CAMERA, BACKGROUND) is None


def test_after_a_restart_a_background_is_kept_until_the_next_word(cell, random):
    """Learning goes on where it was needed only; a new word learns anew."""
    put(cell, WORKSPACE, EMPTY, 1)
    learn(cell, actor_of(BackgroundLearning, images=3), random, 1, 3)
    _, first_ns = seen(cell, CAMERA, BACKGROUND)
    again = actor_of(BackgroundLearning, images=3)
    learn(cell, again, random, 4, 5, person=True)
    assert seen(cell, CAMERA, BACKGROUND)[1] == first_ns
    put(cell, WORKSPACE, EMPTY, 20 * PERIOD_NS)
    learn(cell, again, random, 21, 3)
    assert seen(cell, CAMERA, BACKGROUND)[1] == 23 * PERIOD_NS


def test_images_of_another_size_begin_anew(cell, random):
    """A camera that was set to another resolution while it learned mixes no sizes."""
    learning = actor_of(BackgroundLearning, images=3)
    put(cell, WORKSPACE, EMPTY, 1)
    learn(cell, learning, random, 1, 2)
    learn(cell, learning, random, 3, 3, shape=(24, 32, 3))
    assert seen(cell, CAMERA, BACKGROUND)[0].mean.shape == (24, 32, 3)


def test_one_image_teaches_no_spread():
    """Fewer than two images are refused when the actor is made."""
    with pytest.raises(ValueError, match="images is 1; a spread takes 2 or more"):
        BackgroundLearning(images=1)


@pytest.mark.parametrize("subtractor", ["gaussian", "mog2", "knn"])
def test_a_silhouette_bears_the_stamp_of_its_image(cell, random, subtractor):
    """Person in, silhouette out: packed, counted, with the checksum of the image."""
    put(cell, WORKSPACE, EMPTY, 1)
    learn(cell, actor_of(BackgroundLearning, images=10), random, 1, 10)
    subtraction = actor_of(BackgroundSubtraction, subtractor=subtractor)
    image = image_of(random, person=True)
    put(cell, CAMERA, IMAGE, image, 11 * PERIOD_NS)
    assert testing.run_once(subtraction, cell) == 1
    found, stamp_ns = seen(cell, CAMERA, SILHOUETTE)
    mask = unpacked(found.packed, 64) > 0
    assert stamp_ns == 11 * PERIOD_NS
    assert mask[PERSON].mean() > 0.97
    assert found.foreground_px == mask.sum() < 1.3 * 30 * 15
    assert found.image_checksum == checksum(image) != 0
    assert not found.stand_in


def test_without_a_background_there_is_no_silhouette(cell, random):
    """An image alone makes nothing."""
    put(cell, CAMERA, IMAGE, image_of(random), PERIOD_NS)
    testing.run_once(actor_of(BackgroundSubtraction), cell)
    assert seen(cell, CAMERA, SILHOUETTE) is None


def test_a_new_background_and_other_parameters_count_from_the_next_image(cell, random):
    """What the subtraction was made of is compared at each image."""
    subtraction = actor_of(BackgroundSubtraction)
    mean = np.full(SHAPE, 120, np.uint8)
    put(cell, CAMERA, BACKGROUND, Background(mean, np.ones_like(mean), 20, 1), 1)
    put(cell, CAMERA, IMAGE, image_of(random, person=True), PERIOD_NS)
    testing.run_once(subtraction, cell)
    assert seen(cell, CAMERA, SILHOUETTE)[0].foreground_px > 300
    learned = image_of(random, person=True)
    put(cell, CAMERA, BACKGROUND, Background(learned, np.ones_like(mean) * 4, 20, 2), 2)
    put(cell, CAMERA, IMAGE, image_of(random, person=True), 2 * PERIOD_NS)
    testing.run_once(subtraction, cell)
    assert seen(cell, CAMERA, SILHOUETTE)[0].foreground_px < 200
    subtraction.subtractor = "median"
    put(cell, CAMERA, IMAGE, image_of(random), 3 * PERIOD_NS)
    with pytest.raises(ValueError, match="gaussian, mog2, knn, found 'median'"):
        testing.run_once(subtraction, cell)


def test_an_image_of_another_size_than_the_background_is_one_line(cell, random):
    """The error names both sizes."""
    mean = np.full(SHAPE, 120, np.uint8)
    put(cell, CAMERA, BACKGROUND, Background(mean, np.ones_like(mean), 20, 1), 1)
    put(cell, CAMERA, IMAGE, image_of(random, shape=(24, 32, 3)), PERIOD_NS)
    with pytest.raises(ValueError, match=r"64 x 48 pixels .* found uint8 of shape") as refused:
        testing.run_once(actor_of(BackgroundSubtraction), cell)
    assert "\n" not in str(refused.value)


def test_checksums_differ_by_noise_and_are_never_zero(random):
    """Two images of the same scene differ; 0 is kept for stand-ins."""
    assert checksum(image_of(random)) != checksum(image_of(random))
    assert checksum(np.zeros((0, 8, 3), np.uint8)) == 1


def test_a_smart_camera_gives_what_camera_learning_and_subtraction_give(random, tmp_path):
    """Image and silhouette of a tick bear its stamp; no more than five images per second count."""
    clock = testing.ManualClock()
    begin_ns = clock.wall_ns()
    for number in range(9):
        image = image_of(random, person=number >= 7)
        cv2.imwrite(str(tmp_path / f"{number:03d}.png"), image)
    source = source_of(f"folder:{tmp_path}?begin={begin_ns}", "2")
    smart = actor_of(SmartCamera, images=3)
    smart.make_source = lambda: source
    with testing.worlds("online", clock=clock) as cell:
        put(cell, CAMERA, CALIBRATION, CALIBRATED)
        for number in range(9):
            if number == 1:
                put(cell, WORKSPACE, EMPTY, clock.wall_ns() - 1)
            assert testing.run_once(smart, cell) == 1
            assert (seen(cell, CAMERA, BACKGROUND) is None) == (number < 5)  # 1, 3 and 5
            assert (seen(cell, CAMERA, SILHOUETTE) is None) == (number < 6)
            clock.advance(0.1)
        stamp_ns = begin_ns + 8 * PERIOD_NS
        background, learned_ns = seen(cell, CAMERA, BACKGROUND)
        assert (background.frames, learned_ns) == (3, begin_ns + 5 * PERIOD_NS)
        np.testing.assert_array_equal(seen(cell, CAMERA, IMAGE)[0], image)
        found, found_ns = seen(cell, CAMERA, SILHOUETTE)
        assert found_ns == seen(cell, CAMERA, IMAGE)[1] == stamp_ns
        subtraction = actor_of(BackgroundSubtraction)
        testing.run_once(subtraction, cell)
        alone, alone_ns = seen(cell, CAMERA, SILHOUETTE)
        assert alone_ns == stamp_ns
        assert (alone.foreground_px, alone.image_checksum) == (
            found.foreground_px,
            found.image_checksum,
        )
        np.testing.assert_array_equal(alone.packed, found.packed)
        assert unpacked(found.packed, 64)[PERSON].mean() > 0.97 * 255
