"""Bundle adjustment and what links cameras, on exact corners: no picture is drawn here."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from actors.geometry.cameras.bundle_adjustment import Lens, Rig, Sight, adjusted, projected
from actors.geometry.cameras.camera_calibration import (
    UnfitPicturesError,
    calibrated,
    chosen_origin,
    fitted_lens,
)

from .boards import BOARD, CAMERAS, SIZE, lens, moments, pose

MOMENTS = moments(16)
RIG = Rig(
    {name: Lens(*lens(*words)) for name, (words, _) in CAMERAS.items()},
    {name: camera_from_cell for name, (_, camera_from_cell) in CAMERAS.items()},
    MOMENTS,
)


def sights(noise_px=0.05, *, seen=lambda *_: True, seed=2):
    """Return what the cameras see, as far as it lies in their pictures."""
    rng = np.random.default_rng(seed)
    found = []
    for camera in RIG.cameras:
        for moment in RIG.boards:
            pixels = projected(
                BOARD.corners_m, RIG.cameras[camera] @ RIG.boards[moment], RIG.lenses[camera]
            )
            inside = ((pixels > 0) & (pixels < np.array(SIZE) - 1)).all(1)
            if inside.sum() >= 8 and seen(camera, moment):
                pixels = pixels + rng.normal(0.0, noise_px, pixels.shape)
                found.append(Sight(camera, moment, BOARD.corners_m[inside], pixels[inside]))
    return found


def solved(found, *, origin="000", free=("0", "1", "2")):
    """Return what `calibrated` makes of sights, each lens fitted before."""
    lenses = {
        name: fitted_lens([one for one in found if one.camera == name], *SIZE)
        for name in sorted({one.camera for one in found})
    }
    return calibrated(found, lenses, origin=origin, cell_from_board=np.eye(4), free=free)


def off_m(result, name):
    """Return how far a camera is from where it stands, metres."""
    centres = [np.linalg.inv(one.cameras[name])[:3, 3] for one in (result.rig, RIG)]
    return float(np.linalg.norm(np.subtract(*centres)))


def test_exact_corners_give_the_exact_rig():
    """From a rig that is off by centimetres and degrees, lenses too."""
    rng = np.random.default_rng(5)

    def shaken(poses):
        return {
            name: one @ pose(rng.normal(0, 1.0, 3), rng.normal(0, 0.01, 3))
            for name, one in poses.items()
        }

    begun = Rig(
        {name: Lens(one.camera_matrix * ((1.03,), (1.03,), (1.0,)), np.zeros(5))
         for name, one in RIG.lenses.items()},
        shaken(RIG.cameras),
        {**shaken(RIG.boards), "000": RIG.boards["000"]},
    )  # fmt: skip

    found = adjusted(begun, sights(0.0), origin="000", free=list(RIG.lenses))

    for name in RIG.cameras:
        assert found.cameras[name] == pytest.approx(RIG.cameras[name], abs=1e-5)
        assert found.lenses[name].camera_matrix == pytest.approx(
            RIG.lenses[name].camera_matrix, abs=1e-2
        )
        assert found.lenses[name].distortion == pytest.approx(RIG.lenses[name].distortion, abs=1e-4)


def test_cameras_are_found_within_what_the_noise_allows():
    """With 0.05 px of noise: 1 mm, 0.1 degrees, half a per cent of focal length."""
    result = solved(sights())

    assert result.unlinked == {}
    assert result.contradicting == []
    for name, true in RIG.cameras.items():
        turn, _ = cv2.Rodrigues((result.rig.cameras[name] @ np.linalg.inv(true))[:3, :3])
        assert off_m(result, name) < 0.001
        assert np.degrees(np.linalg.norm(turn)) < 0.1
        assert result.rms_px[name] == pytest.approx(0.07, abs=0.015)
        wrong = result.rig.lenses[name].camera_matrix - RIG.lenses[name].camera_matrix
        assert np.abs(wrong[[0, 1], [0, 1]]).max() < 0.005 * 520.0


@pytest.mark.parametrize("seed", range(3))
def test_single_corners_that_are_far_off_do_not_decide(seed):
    """One in twenty is off by half a pixel, as in real pictures; all others are exact."""
    rng, found = np.random.default_rng(seed), []
    exact, moved = solved(sights()), 0
    for one in sights():
        off = rng.random(len(one.pixels)) < 0.05
        moved += int(off.sum())
        found.append(replace(one, pixels=one.pixels + off[:, None] * rng.choice([-0.6, 0.6], 2)))

    result = solved(found)

    assert 0.9 * moved < result.strays < 1.1 * moved
    assert exact.strays < 0.01 * sum(len(one.pixels) for one in exact.sights)
    for name in RIG.cameras:
        between = result.rig.cameras[name] @ np.linalg.inv(exact.rig.cameras[name])
        assert np.degrees(np.linalg.norm(cv2.Rodrigues(between[:3, :3])[0])) < 0.02
        assert result.rms_px[name] < 0.09


def test_lenses_that_are_not_free_stay():
    """Only the lens of camera 0 changes."""
    found = sights()

    result = calibrated(
        found, RIG.lenses, origin="000", cell_from_board=np.eye(4), free=["0"], k3=True
    )

    for name, one in RIG.lenses.items():
        same = (result.rig.lenses[name].numbers() == one.numbers()).all()
        assert same == (name != "0")


def test_cameras_that_never_share_a_moment_hang_together_by_a_third():
    """0 and 2 see the board together with 1 only."""
    found = sights(
        seen=lambda camera, moment: camera == "1" or (camera == "0") == (int(moment) < 8)
    )

    result = solved(found)

    assert result.unlinked == {}
    assert max(off_m(result, name) for name in RIG.cameras) < 0.003


def test_a_camera_that_saw_the_board_alone_is_left_out():
    """The other two are solved, and the message says which pictures to take."""
    found = [
        Sight(one.camera, one.moment + "x" * (one.camera == "2"), one.points_m, one.pixels)
        for one in sights()
    ]

    result = solved(found)

    assert set(result.rig.cameras) == {"0", "1"}
    assert list(result.unlinked) == ["2"]
    assert "only alone; take pictures that show it to this camera" in result.unlinked["2"]


@pytest.mark.parametrize("wrong", ["000", "004"])
def test_a_picture_of_another_moment_is_left_out(wrong):
    """Its name says that it was taken with others; the board had been moved."""
    found = sights()
    of_one = {one.moment: one for one in found if one.camera == "1"}
    source = next(moment for moment in reversed(of_one) if moment != wrong)
    found = [
        Sight("1", wrong, of_one[source].points_m, of_one[source].pixels)
        if (one.camera, one.moment) == ("1", wrong)
        else one
        for one in found
    ]
    assert wrong in of_one

    result = solved(found)

    assert [(one.camera, one.moment) for one in result.contradicting] == [("1", wrong)]
    assert max(off_m(result, name) for name in RIG.cameras) < 0.001


def test_a_camera_whose_pictures_all_belong_to_other_moments_is_left_out():
    """Its clock was off by one picture."""
    names = sorted(MOMENTS)
    found = [
        one
        if one.camera != "2"
        else Sight("2", names[(names.index(one.moment) + 1) % 16], one.points_m, one.pixels)
        for one in sights()
    ]

    result = solved(found)

    assert {"0", "1"} <= set(result.rig.cameras)
    assert "2" not in result.rig.cameras or result.rms_px["2"] < 1.0
    assert max(off_m(result, name) for name in "01") < 0.002


def test_the_origin_is_the_first_moment_that_most_cameras_saw():
    """Earlier moments of fewer cameras do not count."""
    found = sights(seen=lambda camera, moment: moment != "000" or camera == "1")

    counts = {moment: sum(one.moment == moment for one in found) for moment in MOMENTS}
    most = max(counts.values())
    assert chosen_origin(found) == min(m for m, count in counts.items() if count == most)


def test_pictures_that_say_too_little_of_a_lens_are_refused():
    """Three pictures are too few, and six equal ones too much alike."""
    found = [one for one in sights() if one.camera == "0"]
    with pytest.raises(UnfitPicturesError, match="3 pictures that show the board; 4 are needed"):
        fitted_lens(found[:3], *SIZE)
    with pytest.raises(UnfitPicturesError, match="too much alike: tilt the board"):
        fitted_lens([found[0]] * 6, *SIZE)
