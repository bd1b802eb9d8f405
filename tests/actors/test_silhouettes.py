"""Silhouettes: what is new is found, shadows are not, and what is in doubt is foreground."""

from __future__ import annotations

import numpy as np
import pytest

from actors.geometry.hull.silhouettes import (
    SUBTRACTORS,
    BackgroundStatistics,
    Subtraction,
    packed,
    unpacked,
)

pytest.importorskip("cv2", exc_type=ImportError)

HEIGHT, WIDTH = 120, 160
PERSON = np.s_[30:90, 60:90]
SHADOW = np.s_[70:100, 95:140]


@pytest.fixture(scope="module")
def random():
    """One source of noise for all images."""
    return np.random.default_rng(5)


@pytest.fixture(scope="module")
def cell(random):
    """The empty cell without noise: a textured floor, one half of it coloured."""
    texture = random.integers(0, 12, (HEIGHT, WIDTH, 1)) + np.array([125, 130, 135])
    texture[:, WIDTH // 2 :] += [-50, 0, 40]
    return texture.astype(np.float64)


def taken(image, random):
    """Return an image as a camera with noise of 2.5 levels takes it."""
    return np.rint(image + random.normal(0.0, 2.5, image.shape)).clip(0, 255).astype(np.uint8)


@pytest.fixture(scope="module")
def background(cell, random):
    """What 20 images of the empty cell teach."""
    statistics = BackgroundStatistics()
    for _ in range(20):
        statistics.add(taken(cell, random))
    return statistics


def changed(cell, where, colour):
    """Return the cell with something of one colour in it."""
    image = cell.copy()
    image[where] = colour
    return image


def share(mask, where):
    """Return which share of a region is foreground."""
    return float((mask[where] > 0).mean())


def around(where, px):
    """Return a mask that is true farther than some pixels from a region."""
    rows, columns = where
    far = np.ones((HEIGHT, WIDTH), bool)
    far[rows.start - px : rows.stop + px, columns.start - px : columns.stop + px] = False
    return far


def test_mean_and_spread_are_those_of_the_smoothed_images(background, cell):
    """The mean follows the texture, the spread is that of noise after a box of nine pixels."""
    inner = np.s_[5:-5, 5:75]
    assert np.abs(background.mean[inner].astype(float) - cell[inner]).mean() < 4.0
    assert background.frames == 20
    assert 1 <= np.median(background.spread) <= 2


@pytest.mark.parametrize("subtractor", SUBTRACTORS)
def test_a_person_is_found_whole_and_nothing_else(subtractor, background, cell, random):
    """Each subtractor finds the person's pixels and none that lie 3 px beside them."""
    subtraction = Subtraction(background.mean, background.spread, subtractor=subtractor)
    mask = subtraction(taken(changed(cell, PERSON, (150, 60, 40)), random))
    assert share(mask, PERSON) > 0.99
    assert not mask[around(PERSON, 3)].any()
    assert set(np.unique(mask)) == {0, 255}
    assert not subtraction(taken(cell, random)).any()


def test_edges_lie_where_they_are(background, cell, random):
    """Smoothing widens nothing: of the ring of pixels around the person at most a tenth is taken."""
    mask = Subtraction(background.mean, background.spread)(
        taken(changed(cell, PERSON, (150, 60, 40)), random)
    )
    wider = np.zeros((HEIGHT, WIDTH), bool)
    wider[29:91, 59:91] = True
    wider[PERSON] = False
    assert (mask[wider] > 0).mean() < 0.1


@pytest.mark.parametrize("light", [0.55, 0.75, 0.9])
def test_a_shadow_is_no_foreground(light, background, cell, random):
    """A shadow beside the person goes, over either colour of the floor; without the test it stays."""
    image = changed(cell, PERSON, (150, 60, 40))
    image[SHADOW] *= light
    taken_image = taken(image, random)
    with_test = Subtraction(background.mean, background.spread)(taken_image)
    without = Subtraction(background.mean, background.spread, shadows=False)(taken_image)
    assert share(with_test, SHADOW) < 0.02
    assert share(without, SHADOW) > 0.9
    assert share(with_test, PERSON) > 0.99


@pytest.mark.parametrize("light", [0.5, 0.75, 0.9])
def test_what_looks_like_a_shadow_is_no_background(light, background, cell, random):
    """`split` names it: it may be a person in grey.  The rest of the image is neither."""
    image = cell.copy()
    image[SHADOW] *= light
    mask, shade = Subtraction(background.mean, background.spread).split(taken(image, random))
    assert share(shade | mask, SHADOW) > 0.98
    assert not (shade & mask).any()
    assert not shade[around(SHADOW, 3)].any()


@pytest.mark.parametrize("factor", [0.25, 1.2])
def test_what_is_too_dark_or_lighter_is_no_shadow(factor, background, cell, random):
    """A black thing of the floor's hue, and one lighter than the floor, are foreground.

    The edge of the black one, half floor after smoothing, looks like a shadow: one pixel.
    """
    image = cell.copy()
    image[PERSON] *= factor
    mask = Subtraction(background.mean, background.spread)(taken(image, random))
    assert share(mask, np.s_[31:89, 61:89]) > 0.99


def test_a_shirt_of_nearly_the_colour_of_the_background_is_found(background, cell, random):
    """Sixteen levels of difference in one channel suffice."""
    image = cell.copy()
    image[PERSON] = cell[PERSON].mean((0, 1)) + np.array([16, 0, 0])
    mask = Subtraction(background.mean, background.spread)(taken(image, random))
    assert share(mask, PERSON) > 0.95


def test_when_the_light_drops_all_is_foreground(background, cell, random):
    """30 % less light everywhere is no shadow: the mask says that the background fits no more."""
    mask = Subtraction(background.mean, background.spread)(taken(cell * 0.7, random))
    assert share(mask, np.s_[:]) > 0.95


def test_who_stands_still_does_not_fade(background, cell, random):
    """After 300 images of a person at rest the mask is as it was."""
    for subtractor in SUBTRACTORS:
        subtraction = Subtraction(background.mean, background.spread, subtractor=subtractor)
        image = taken(changed(cell, PERSON, (150, 60, 40)), random)
        first = subtraction(image)
        for _ in range(300 if subtractor == "gaussian" else 60):
            last = subtraction(image)
        assert np.array_equal(first, last)


@pytest.mark.parametrize("width", [160, 641])
def test_bits_give_the_mask_back(width, random):
    """A mask packed and unpacked is the same, whether or not its width is a multiple of eight."""
    mask = (random.random((7, width)) < 0.3).astype(np.uint8) * 255
    bits = packed(mask)
    assert bits.shape == (7, (width + 7) // 8)
    assert np.array_equal(unpacked(bits, width), mask)


def test_bad_images_are_refused_by_what_is_wrong(background):
    """Another size, another dtype and an unknown subtractor are named, each in one line."""
    subtraction = Subtraction(background.mean, background.spread)
    with pytest.raises(ValueError, match=r"160 x 120 pixels .* found uint8 of shape \(60, 80, 3\)"):
        subtraction(np.zeros((60, 80, 3), np.uint8))
    with pytest.raises(ValueError, match=r"found float64 of shape"):
        subtraction(np.zeros((HEIGHT, WIDTH, 3)))
    with pytest.raises(ValueError, match=r"gaussian, mog2, knn, found 'median'"):
        Subtraction(background.mean, background.spread, subtractor="median")
    with pytest.raises(ValueError, match="spread of the background"):
        Subtraction(background.mean, background.spread[:60])
    with pytest.raises(ValueError, match="image: asked for 160 x 120"):
        background.add(np.zeros((60, 80, 3), np.uint8))
