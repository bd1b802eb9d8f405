"""Reading RGB-D recordings: what is right comes back exactly, what is wrong is refused by name."""

from __future__ import annotations

import numpy as np
import pytest

from actors.geometry.files import InputFileError
from actors.geometry.poses import small_motion
from actors.geometry.scans.recordings import read_recording

cv2 = pytest.importorskip("cv2", exc_type=ImportError)


def refused(folder):
    """Return the message with which a recording is refused."""
    with pytest.raises(InputFileError) as caught:
        read_recording(folder)
    return str(caught.value)


def test_recording_comes_back_exactly_when_it_is_sound(recording):
    """Depth, pose and camera come back bit for bit, colour as RGB up to JPEG."""
    read = read_recording(recording.write())

    assert len(read.frames) == 6
    assert (read.camera.width_px, read.camera.cx_px, read.camera.fy_px) == (320, 159.5, 280.0)
    for frame, depth_mm, pose in zip(read.frames, recording.depth_mm, recording.poses, strict=True):
        assert np.array_equal(frame.depth.depth_mm, depth_mm)
        assert np.array_equal(frame.world_from_camera, pose)
    difference = np.abs(read.frames[0].colour.astype(int) - recording.colour[0])
    assert np.median(difference) <= 4


def test_flat_recording_is_paired_by_number_when_match_names_folders(flat_recording):
    """`rgbd.match` that names depth/00003.png finds the flat d3.png, with ten views in order."""
    folder = flat_recording.write()
    lines = [f"depth/{n:05d}.png color/{n:05d}.jpg" for n in range(6)]
    (folder / "rgbd.match").write_text("\n".join(lines) + "\n", encoding="utf-8")

    read = read_recording(folder)

    assert [frame.name for frame in read.frames] == [f"d{n}.png" for n in range(6)]


def test_flat_names_are_sorted_by_number_when_there_are_ten_or_more(flat_recording):
    """d10.png comes after d2.png, as the poses do."""
    folder = flat_recording.write()
    for kind, ending in (("c", "jpg"), ("d", "png")):
        (folder / f"{kind}5.{ending}").rename(folder / f"{kind}10.{ending}")

    read = read_recording(folder)

    assert [frame.name for frame in read.frames][-1] == "d10.png"


@pytest.mark.parametrize("scale", [0.1, 5.0, 10.0])
def test_recording_is_refused_when_depth_is_in_another_unit(recording, scale):
    """Centimetres, fifths and tenths of millimetres are told from millimetres by the poses."""
    recording.depth_mm = [(d * scale).round().astype(np.uint16) for d in recording.depth_mm]

    message = refused(recording.write())

    assert "asked for depth in millimetres" in message or "would be" in message


def test_recording_is_accepted_when_poses_and_depth_are_noisy(recording):
    """A centimetre and half a degree of pose error and 3 mm of noise are no wrong unit."""
    random = np.random.default_rng(3)
    recording.poses = [p @ small_motion(random.normal(0, 0.01, 6)) for p in recording.poses]
    recording.depth_mm = [
        np.rint(d + random.normal(0, 3, d.shape)).astype(np.uint16) for d in recording.depth_mm
    ]

    assert len(read_recording(recording.write()).frames) == 6


def test_depth_is_refused_when_it_is_metres_in_whole_numbers(recording):
    """A median of 1 cannot be millimetres."""
    recording.depth_mm = [np.ones_like(depth) for depth in recording.depth_mm]

    assert "would be 0.001 m" in refused(recording.write())


def test_depth_is_refused_when_it_is_metres_as_floating_point(recording):
    """Float metres are refused with the largest value and the remedy."""
    folder = recording.write()
    path = recording.depth_file(2)
    np.save(path.with_suffix(".npy"), recording.depth_mm[2].astype(np.float32) / 1000.0)
    path.unlink()

    message = refused(folder)

    assert "float32" in message
    assert "multiply by 1000" in message


@pytest.mark.parametrize(
    ("picture", "words"),
    [
        (np.full((240, 320), 90, np.uint8), "uint8"),
        (np.full((240, 320, 3), 90, np.uint8), "3 channel"),
        (np.zeros((240, 320), np.uint16), "all 0"),
        (np.full((120, 160), 900, np.uint16), "160 x 120"),
    ],
)
def test_depth_is_refused_when_it_is_another_kind_of_image(recording, picture, words):
    """8 bit, colour, empty and small images are no depth images of this camera."""
    folder = recording.write()
    cv2.imwrite(str(recording.depth_file(1)), picture)

    message = refused(folder)

    assert str(recording.depth_file(1)) in message
    assert words in message


@pytest.mark.parametrize("kind", ["colour_file", "depth_file"])
def test_image_is_refused_when_it_does_not_decode(recording, kind):
    """A file that is no image is refused by its name."""
    folder = recording.write()
    path = getattr(recording, kind)(3)
    path.write_bytes(b"no image")

    message = refused(folder)

    assert str(path) in message
    assert "do not decode" in message


def test_recording_is_refused_when_an_image_is_missing(recording):
    """Six colours with five depths are refused with both counts."""
    folder = recording.write()
    recording.depth_file(3).unlink()

    assert "6 colour and 5 depth" in refused(folder)


def test_match_is_refused_when_it_names_a_missing_image(flat_recording):
    """The line of rgbd.match is shown."""
    folder = flat_recording.write()
    (folder / "rgbd.match").write_text("depth/9.png color/9.jpg\n", encoding="utf-8")

    assert "line 1" in refused(folder)


def test_trajectory_is_refused_when_it_is_of_another_length(recording):
    """Five poses for six images are refused with both numbers."""
    folder = recording.write()
    recording.poses.pop()
    recording.write_trajectory()

    message = refused(folder)

    assert "each of the 6 pairs" in message
    assert "5 poses" in message


def test_trajectory_is_refused_when_a_pose_is_not_rigid(recording):
    """A scaled and a mirrored matrix are no poses."""
    folder = recording.write()
    for change in (1.1, -1.0):
        sound = recording.poses[2].copy()
        recording.poses[2][:3, 0] *= change
        recording.write_trajectory()

        message = refused(folder)

        recording.poses[2] = sound
        assert "rigid" in message
        assert "line 11" in message


def test_trajectory_is_refused_when_it_is_inverted(recording):
    """camera_from_world in place of world_from_camera is recognised by the depth images."""
    recording.poses = [np.linalg.inv(pose) for pose in recording.poses]

    assert "camera_from_world" in refused(recording.write())


def test_trajectory_is_refused_when_it_is_in_millimetres(recording):
    """Camera positions hundreds of units apart are no metres."""
    for number, pose in enumerate(recording.poses):
        pose[:3, 3] *= 10_000.0 * (number + 1)

    assert "millimetres" in refused(recording.write())


@pytest.mark.parametrize("content", ["", "1 2 3\n1 0 0 0\n", "0 0 1\n" + "a b c d\n" * 4])
def test_trajectory_is_refused_when_it_is_another_format(recording, content):
    """Empty, cut-off and wordy files are refused by name."""
    folder = recording.write()
    (folder / "trajectory.log").write_text(content, encoding="utf-8")

    assert "trajectory.log" in refused(folder)


def test_intrinsics_are_refused_when_they_are_of_another_size(recording):
    """Intrinsics for 640 x 480 do not fit images of 320 x 240."""
    folder = recording.write()
    recording.write_intrinsics(width=640, height=480)

    message = refused(folder)

    assert "640 x 480" in message
    assert "320 x 240" in message


@pytest.mark.parametrize("content", ['{"intrinsic_matrix": [1, 2]}', "intrinsic_matrix {", "[]"])
def test_intrinsics_are_refused_when_they_are_no_camera(recording, content):
    """Too few numbers, broken JSON and other JSON are refused."""
    folder = recording.write()
    (folder / "camera.json").write_text(content, encoding="utf-8")

    assert "intrinsics" in refused(folder)


def test_directory_is_refused_when_it_holds_nothing(tmp_path):
    """An empty and a missing directory are refused each in its words."""
    assert "0 colour and 0 depth" in refused(tmp_path)
    assert "no such directory" in refused(tmp_path / "absent")
