"""Pictures of a board by connected cameras: one whenever it lies still in a new place."""

import cv2
import numpy as np
import pytest

from actors.geometry.cameras.charuco import find_board
from actors.workcell.cameras.board_shots import opened_sources, take_shots
from actors.workcell.cameras.sources import CameraError

from . import boards
from .boards import BOARD, CAMERAS, moments

PLACES = moments(4)


class Camera:
    """A source that shows the board at one place after the other, as `way` says."""

    def __init__(self, name, way):
        self._name, self._way, self.asked = name, list(way), 0
        rng, paper = np.random.default_rng(1), boards.texture()
        words, camera_from_cell = CAMERAS[name]
        self._seen = {
            place: boards.picture(BOARD, paper, words, camera_from_cell @ pose, rng)
            for place, pose in PLACES.items()
        }

    def frame(self, stamp_ns):
        place = self._way[min(self.asked, len(self._way) - 1)]
        self.asked += 1
        return cv2.cvtColor(self._seen[place], cv2.COLOR_GRAY2BGR)


def test_a_picture_is_kept_once_per_place_and_only_of_a_board_at_rest(tmp_path):
    """000 twice, 001 in passing, 002 twice and once more, 000 again: two moments are new."""
    way = ("000", "000", "001", "002", "002", "002", "000", "000", "003", "003")
    cameras = {name: Camera(name, way) for name in ("0", "2")}
    (tmp_path / "images" / "0").mkdir(parents=True)
    (tmp_path / "images" / "0" / "006.png").write_bytes(b"of an earlier run")
    told = []

    names = take_shots(tmp_path, cameras, BOARD, 3, tell=told.append, wait=lambda _: None)

    assert names == ["007", "008", "009"]
    assert cameras["0"].asked == 10
    assert "0 of 3 taken; the board is seen by 0, 2" in told[0]
    for name, place in (("007", "000"), ("008", "002"), ("009", "003")):
        for camera in cameras:
            file = tmp_path / "images" / camera / f"{name}.png"
            true = find_board(cameras[camera]._seen[place], BOARD)
            if len(true.numbers):
                assert (
                    cv2.imread(str(file), cv2.IMREAD_GRAYSCALE) == cameras[camera]._seen[place]
                ).all()
            else:
                assert not file.exists()


def test_sources_that_cannot_be_opened_are_one_line(tmp_path):
    """An address without a size, and a device that is not there, are named."""
    with (
        pytest.raises(CameraError, match=r"found none; write v4l2:/dev/video0\?size=640x480"),
        opened_sources(["v4l2:/dev/video0"]),
    ):
        pass
    with (
        pytest.raises(CameraError, match="found no such device or file"),
        opened_sources(["v4l2:/dev/no-such?size=64x48"]),
    ):
        pass
