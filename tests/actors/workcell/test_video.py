"""Cameras that OpenCV opens: what a driver may do, played by a stand-in for `cv2.VideoCapture`."""

import time

import cv2
import numpy as np
import pytest

from actors.workcell.cameras import video
from actors.workcell.cameras.sources import CameraError, source_of
from actors.workcell.cameras.video import driver_ns
from actors.workcell.simulation.room import cameras

CALIBRATION = cameras(0.1)[0]  # 64 x 48


class Capture:
    """A driver: `queue` waits in its buffers, further images come as time goes on.

    What waits for one finds the clocks of the driver moved on, so no test has to wait.
    """

    def __init__(self):
        self.size, self.rate, self.letters = (64, 48), 30.0, "YUYV"
        self.sizes = {(64, 48), (128, 96)}
        self.opens, self.plugged, self.stamped, self.stands_still = True, True, True, False
        self.queue, self.damaged, self.taken = [], 0, []
        self.settings, self.released, self.opened_as = [], 0, []
        self.now_ms = 0.0
        self.waited_ns = 0

    def time_ns(self):
        return time.time_ns() + self.waited_ns

    def monotonic_ns(self):
        return time.monotonic_ns() + self.waited_ns

    def __call__(self, place, backend=None):
        self.opened_as.append((place, backend))
        return self

    def isOpened(self):
        return self.opens and self.plugged

    def set(self, key, value):
        self.settings.append((key, value))
        if key == cv2.CAP_PROP_FRAME_HEIGHT:
            wanted = (round(self.settings[-2][1]), round(value))
            self.size = wanted if wanted in self.sizes else self.size
        return True

    def get(self, key):
        return {
            cv2.CAP_PROP_FRAME_WIDTH: float(self.size[0]),
            cv2.CAP_PROP_FRAME_HEIGHT: float(self.size[1]),
            cv2.CAP_PROP_FPS: self.rate,
            cv2.CAP_PROP_FOURCC: float(cv2.VideoWriter.fourcc(*self.letters)),
            cv2.CAP_PROP_POS_MSEC: self.now_ms,
        }[key]

    def grab(self):
        if not self.plugged:
            return False
        if self.queue:
            self.level, taken_ns = self.queue.pop(0)
        else:
            self.waited_ns += 5_000_000  # a driver waits for the next image
            self.level, taken_ns = 200, self.monotonic_ns()
        self.now_ms = 1234.5 if self.stands_still else taken_ns / 1e6 if self.stamped else 0.0
        self.taken.append(self.level)
        return True

    def retrieve(self):
        if self.damaged:
            self.damaged -= 1
            return False, None
        return True, np.full((*self.size[::-1], 3), self.level, np.uint8)

    def release(self):
        self.released += 1


@pytest.fixture
def driver(monkeypatch):
    made = Capture()
    monkeypatch.setattr(cv2, "VideoCapture", made)
    monkeypatch.setattr(video, "time", made)
    return made


def opened(options=""):
    """Return an open source; /dev/null stands for a device that is there."""
    source = source_of(f"v4l2:/dev/null{options}", "0")
    source.open(CALIBRATION)
    return source


def level(source, stamp_ns=None):
    return int(source.frame(time.time_ns() if stamp_ns is None else stamp_ns)[0, 0, 0])


def refused(options=""):
    with pytest.raises(CameraError) as caught:
        opened(options)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def ago(*seconds):
    """Return images that were exposed so long ago, darker the older."""
    return [(10 + at, time.monotonic_ns() - round(one * 1e9)) for at, one in enumerate(seconds)]


def test_a_device_is_asked_for_what_the_address_says(driver):
    """Format before size, one buffer, and the rate."""
    driver.letters = "MJPG"
    opened("?size=64x48&fps=30&format=MJPG")

    asked = dict(driver.settings)
    assert driver.opened_as == [("/dev/null", cv2.CAP_V4L2)]
    assert asked[cv2.CAP_PROP_FOURCC] == cv2.VideoWriter.fourcc(*"MJPG")
    assert (asked[cv2.CAP_PROP_FRAME_WIDTH], asked[cv2.CAP_PROP_FRAME_HEIGHT]) == (64, 48)
    assert asked[cv2.CAP_PROP_FPS] == 30
    assert asked[cv2.CAP_PROP_BUFFERSIZE] == 1
    order = [key for key, _ in driver.settings]
    assert order.index(cv2.CAP_PROP_FOURCC) < order.index(cv2.CAP_PROP_FRAME_WIDTH)


def test_what_the_driver_gives_instead_is_told_before_the_first_image(driver):
    """Another size, format or rate is refused, and the device released each time."""
    assert "asked for 96 x 72 pixels; the driver gives 64 x 48; v4l2-ctl" in refused("?size=96x72")
    assert "asked for the format MJPG; the driver gives YUYV" in refused("?format=MJPG")
    driver.rate = 5.0
    assert "10 images per second or more; the driver gives 5; try format=MJPG" in refused()
    driver.opens = False
    assert "OpenCV cannot open; does another program use it" in refused()
    assert "asked for four letters as format" in refused("?format=JPG1x")
    assert driver.released == 4


def test_images_of_another_size_than_the_driver_said_are_refused(driver):
    """The size is compared with the calibration again at each frame."""
    source = opened()
    driver.size = (32, 24)

    with pytest.raises(CameraError, match="asked for 64 x 48 pixels as calibrated; found 32 x 24"):
        level(source)


def test_a_new_calibration_opens_the_device_in_its_size(driver):
    """The same calibration keeps it open."""
    source = opened()
    source.open(CALIBRATION)
    assert driver.released == 0

    source.open(cameras(0.2)[0])

    assert (driver.released, driver.size) == (1, (128, 96))
    assert source.frame(time.time_ns()).shape == (96, 128, 3)


def test_images_from_before_the_tick_are_dropped(driver):
    """Of a queue of four only the one of the tick is given, with the driver's time."""
    source, tick_ns = opened(), time.time_ns()
    driver.queue = ago(0.4, 0.3, 0.2, 0.01)

    assert level(source, tick_ns) == 13
    assert source.exposed_ns == pytest.approx(tick_ns - 10_000_000, abs=20_000_000)
    assert driver.taken == [10, 11, 12, 13]


def test_images_without_a_time_of_the_driver_are_not_those_of_its_queue(driver):
    """The queue is dropped, and the image is stamped when it comes."""
    driver.stamped = False
    source, tick_ns = opened(), time.time_ns()
    driver.queue = ago(0.4, 0.3, 0.2, 0.1)

    assert level(source, tick_ns) == 200
    assert source.exposed_ns >= tick_ns
    assert driver.taken == [10, 11, 12, 13, 200]


def test_a_driver_whose_time_stands_still_has_none(driver):
    """A time that does not move on is not believed, so the queue is dropped."""
    driver.stands_still = True
    source = opened()
    tick_ns = time.time_ns()

    for _ in range(3):
        driver.queue = ago(0.2)
        assert level(source, tick_ns) == 200
    assert source.exposed_ns >= tick_ns


def test_a_queue_that_never_ends_holds_nobody_up(driver):
    """A driver that gives each image at once is taken at its word after some of them."""
    driver.stamped = False
    source = opened()
    driver.queue = ago(*[0.0] * 50)

    assert level(source) < 200
    assert len(driver.taken) < 12


def test_a_camera_that_was_unplugged_comes_back(driver):
    """The device is released, refused while it is away, and gives images when it is back."""
    source = opened()
    driver.plugged = False
    with pytest.raises(CameraError, match="the device gave none; was it unplugged"):
        level(source)
    assert driver.released == 1
    with pytest.raises(CameraError, match="OpenCV cannot open"):
        source.open(CALIBRATION)

    driver.plugged = True
    source.open(CALIBRATION)

    assert level(source) == 200
    assert len(driver.opened_as) == 3


def test_a_damaged_image_is_replaced_by_the_next_one(driver):
    """Two in a row are passed over; the third is an error."""
    source = opened()
    driver.damaged = 2
    assert level(source) == 200

    driver.damaged = 3
    with pytest.raises(CameraError, match="3 in a row that are damaged"):
        level(source)


def test_time_of_a_driver_becomes_time_since_1970():
    """A monotonic time is converted; zero and a time since 1970 count as none."""
    half_a_second_ago_ms = time.monotonic_ns() / 1e6 - 500.0
    assert time.time_ns() - driver_ns(half_a_second_ago_ms) == pytest.approx(5e8, rel=0.2)
    assert driver_ns(0.0) == 0
    assert driver_ns(time.time_ns() / 1e6) == 0


def test_a_device_of_another_user_is_named(driver, monkeypatch):
    """A device that may not be read is an error that names the group."""
    monkeypatch.setattr("os.access", lambda *_: False)

    assert "this user may not read; a device belongs to the group video" in refused()
