"""Sources of images: what they give, and what cannot work as one line each."""

import contextlib
import threading

import cv2
import numpy as np
import pytest
from polling import until

from actors.workcell.camera import Camera, Capture
from actors.workcell.cameras.sources import (
    CameraEndedError,
    CameraError,
    source_of,
)
from actors.workcell.simulation.room import cameras
from actors.workcell.vocabulary import CALIBRATION, IMAGE, PERIOD_NS, camera_entity
from enact_dist import Lock, View, testing

CALIBRATION_OF = cameras(0.1)[0]  # 64 x 48


def pictures(folder, count=3, size=(48, 64), first=0):
    folder.mkdir(parents=True, exist_ok=True)
    for number in range(first, first + count):
        cv2.imwrite(str(folder / f"{number:06d}.png"), np.full((*size, 3), 10 * number, np.uint8))
    return folder


def opened(address, camera="0"):
    source = source_of(address, camera)
    source.open(CALIBRATION_OF)
    return source


def refusal(address, camera="0"):
    with pytest.raises(CameraError) as caught:
        opened(address, camera)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_folder_plays_its_images_in_order_and_again(tmp_path):
    """One image per tick, by the number of the tick; after the last comes the first."""
    pictures(tmp_path / "3")
    source = opened(f"folder:{tmp_path}/{{camera}}", "3")
    levels = [source.frame(tick * PERIOD_NS)[0, 0, 0] for tick in range(30, 36)]
    assert levels == [0, 10, 20, 0, 10, 20]
    assert source.exposed_ns == 0


def test_folder_with_a_begin_ends(tmp_path):
    """With a begin each image plays once, and then an error says that all were played."""
    pictures(tmp_path)
    source = opened(f"folder:{tmp_path}?begin={50 * PERIOD_NS}")
    assert source.frame(52 * PERIOD_NS)[0, 0, 0] == 20
    with pytest.raises(CameraEndedError, match="all 3 images were played"):
        source.frame(53 * PERIOD_NS)


def test_folders_that_cannot_be_played_are_one_line_each(tmp_path):
    """Absent, empty, a file, another size, a gap, a damaged image: each is named."""
    assert "no such folder" in refusal(f"folder:{tmp_path / 'absent'}")
    (tmp_path / "empty").mkdir()
    assert "found no file that ends in" in refusal(f"folder:{tmp_path / 'empty'}")
    (tmp_path / "file").write_text("x")
    assert "found a file" in refusal(f"folder:{tmp_path / 'file'}")
    other = pictures(tmp_path / "other", size=(24, 32))
    assert "asked for 64 x 48 pixels as calibrated; found 32 x 24" in refusal(f"folder:{other}")
    gap = pictures(tmp_path / "gap", 5)
    (gap / "000002.png").unlink()
    assert "number 2 is missing" in refusal(f"folder:{gap}")
    broken = pictures(tmp_path / "broken")
    (broken / "000000.png").write_bytes(b"no picture")
    assert "none that OpenCV can decode" in refusal(f"folder:{broken}")


def test_frame_that_has_gone_is_named(tmp_path):
    """An image that was deleted after the source was opened is an error with its name."""
    source = opened(f"folder:{pictures(tmp_path)}")
    (tmp_path / "000001.png").unlink()
    with pytest.raises(CameraError, match=r"000001\.png: .*no such file any more"):
        source.frame(1 * PERIOD_NS)


@pytest.mark.parametrize(
    ("address", "said"),
    [
        ("usb:0", "found the kind 'usb'"),
        ("folder:/tmp?begn=1", "found the option 'begn'; known are begin"),
        ("folder:/tmp?begin=soon", "asked for begin=NUMBER; found 'soon'"),
        ("folder:/tmp?begin", "asked for options as name=value"),
        ("v4l2:/dev/video0?size=big", "asked for size=WIDTHxHEIGHT; found 'big'"),
        ("v4l2:/dev/no-such-video", "found no such device or file"),
        ("v4l2:/dev/null", "OpenCV cannot open"),
        ("live:?x=1", "found the option 'x'; known are none"),
        ("playback:/no/such/recording", "found no recording.json"),
    ],
)
def test_addresses_that_lead_nowhere(address, said):
    """A wrong kind, option, device or recording is one line that says what was found."""
    assert said in refusal(address)


def test_simulated_cameras_are_numbered():
    """A name that is no number is refused."""
    assert "asked for a simulated camera" in refusal("live", "left")


@pytest.fixture
def video(tmp_path):
    path = tmp_path / "video.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 10.0, (64, 48))
    assert writer.isOpened()
    for number in range(3):
        writer.write(np.full((48, 64, 3), 40 + 60 * number, np.uint8))
    writer.release()
    return path


def test_video_gives_an_image_per_tick_and_ends(video):
    """Three images of a file come in order; the next frame is the end, by name."""
    source = opened(f"v4l2:{video}?size=64x48&fps=10")
    levels = [int(source.frame(PERIOD_NS)[20, 20, 0]) for _ in range(3)]
    assert levels == pytest.approx([40, 100, 160], abs=6)
    with pytest.raises(CameraEndedError, match="the video ended after 3 images"):
        source.frame(PERIOD_NS)
    source.close()


def test_video_of_another_size(video):
    """A file whose images are not of the calibrated size is refused at its first frame."""
    source = source_of(f"v4l2:{video}", "0")
    source.open(cameras(0.2)[0])
    with pytest.raises(CameraError, match="asked for 128 x 96 pixels"):
        source.frame(PERIOD_NS)


class Device:
    """A source whose images the test releases."""

    exposed_ns = 0

    def __init__(self):
        self.free = threading.Event()
        self.opened, self.closed = 0, threading.Event()
        self.fails = None

    def open(self, calibration):
        self.opened += 1

    def frame(self, stamp_ns):
        assert self.free.wait(20.0)
        if self.fails is not None:
            raise self.fails
        return np.zeros((48, 64, 3), np.uint8)

    def close(self):
        self.closed.set()


def test_driver_that_hangs_is_named_and_comes_back():
    """A frame times out, also the next one; once the driver answers, images come again."""
    device = Device()
    capture = Capture(device, "camera/2")
    with pytest.raises(CameraError, match=r"camera/2: .*no answer within 0\.05 s"):
        capture.frame(PERIOD_NS, 0.05)
    with pytest.raises(CameraError, match="camera/2: its source still hangs"):
        capture.frame(2 * PERIOD_NS, 0.05)
    device.free.set()

    def taken():
        with contextlib.suppress(CameraError):
            return capture.frame(3 * PERIOD_NS, 5.0)

    image, exposed_ns = until(taken)
    assert (image.shape, exposed_ns) == ((48, 64, 3), 3 * PERIOD_NS)
    capture.close()
    assert device.closed.is_set()


def camera_of(source):
    camera = Camera()
    camera.only_entity = camera_entity(0)
    camera.make_source = lambda: source
    return camera


def test_camera_that_waits_for_its_calibration_says_so_once(caplog):
    """It is no error: in a healthy start the actor that calibrates it comes later."""
    device = Device()
    device.free.set()
    with testing.worlds("online") as cell, caplog.at_level("INFO", "enact.actor"):
        online, camera = cell.world("online"), camera_of(device)
        for _ in range(3):
            testing.run_once(camera, cell)
        waiting = [one.getMessage() for one in caplog.records]
        online.init(camera_entity(0), CALIBRATION, CALIBRATION_OF)
        testing.run_once(camera, cell)
        seen = View(online, camera_entity(0), IMAGE)
        with Lock(seen) as lock:
            assert lock[seen].shape == (48, 64, 3)
    assert len(waiting) == 1
    assert waiting[0].startswith("camera/0 waits for its calibration: the context has none yet")
    assert [one.levelname for one in caplog.records] == ["INFO"]


def test_camera_publishes_the_image_of_its_tick():
    """An image without a time of exposure bears the stamp of its tick."""
    device = Device()
    device.free.set()
    with testing.worlds("online") as cell:
        online = cell.world("online")
        online.init(camera_entity(0), CALIBRATION, CALIBRATION_OF)
        testing.run_once(camera_of(device), cell)
        seen = View(online, camera_entity(0), IMAGE)
        with Lock(seen) as lock:
            assert lock[seen].shape == (48, 64, 3)
            assert lock.stamp_ns(seen) == 1_000 * 1_000_000_000
        assert device.closed.is_set()


def test_camera_stamps_an_image_with_its_exposure():
    """A time of exposure that the source gives is the stamp of the datum."""
    device = Device()
    device.free.set()
    device.exposed_ns = 999_990_000_000
    with testing.worlds("online") as cell:
        online = cell.world("online")
        online.init(camera_entity(0), CALIBRATION, CALIBRATION_OF)
        testing.run_once(camera_of(device), cell)
        seen = View(online, camera_entity(0), IMAGE)
        with Lock(seen) as lock:
            assert lock.stamp_ns(seen) == 999_990_000_000


def test_camera_that_fails_writes_nothing_and_opens_its_source_again():
    """No image is written after an error, and the next run opens the source a second time."""
    device = Device()
    device.free.set()
    with testing.worlds("online") as cell:
        online = cell.world("online")
        online.init(camera_entity(0), CALIBRATION, CALIBRATION_OF)
        camera, seen = camera_of(device), View(online, camera_entity(0), IMAGE)
        camera.start()
        stop, camera.stop = camera.stop, lambda: None  # it goes on from run to run
        camera.start = camera.stop
        device.fails = CameraError("camera/0: the device gave none")
        with pytest.raises(CameraError, match="the device gave none"):
            testing.run_once(camera, cell)
        assert online.view(seen).get(seen) is None
        device.fails = None
        testing.run_once(camera, cell)
        assert device.opened == 2
        device.fails = CameraEndedError("camera/0: ended")
        with pytest.raises(CameraEndedError):
            testing.run_once(camera, cell)
        assert device.opened == 2
        stop()
