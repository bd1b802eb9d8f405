"""What a page of a real browser downloads: files that other programs read, of the moment shown."""

import contextlib
from dataclasses import dataclass
from io import BytesIO

import numpy as np
import pytest
from browsed import Opened, Served

from enact_dist import Aspect, Entity, Lock, Write
from enact_dist.recording.exact import decode_recorded
from enact_dist.wire.payload import decode_untyped

pytestmark = pytest.mark.timing


@dataclass(frozen=True, eq=False)
class Scan:
    points_m: np.ndarray
    colours: np.ndarray


IMAGE, SCAN = Aspect("image", np.ndarray), Aspect("scan", Scan)
EYE, PIECE = Entity("eye"), Entity("piece")


def image_at(number):
    """Return an image in which every pixel is different, (48, 64, 3)."""
    rows, columns = np.mgrid[:48, :64]
    return np.stack((rows, columns, np.full_like(rows, number)), axis=2).astype(np.uint8)


def scan_at(number):
    places = np.random.default_rng(number).normal(0.0, 0.1, (60, 3)).astype(np.float32)
    return Scan(places, np.full((60, 3), (10, 100, 50 * number), np.uint8))


class ServedEye(Served):
    aspects = '[aspects.image]\nshows = "image"\n[aspects.scan]\nshows = "point_cloud"\n'

    def begin(self):
        image, scan = Write(self.online, EYE, IMAGE), Write(self.online, PIECE, SCAN)
        for number in (1, 2):
            with Lock(image, scan) as lock:
                lock[image], lock[scan] = image_at(number), scan_at(number)


@pytest.fixture
def page(tmp_path, browser):
    with contextlib.ExitStack() as stack:
        opened = Opened(browser, ServedEye(tmp_path, stack).url)
        yield opened
        opened.page.close()
        assert opened.errors == []


def choose(page, datum):
    page.tab("world")
    page.choose("datum", datum)
    page.tab("datum")
    page.text(f"online:{datum}")


def same_scan(found, number):
    """Whether a scan as another library reads it is the one of a number."""
    scan = scan_at(number)
    same = np.array_equal(found.vertices, scan.points_m)
    return same and np.array_equal(np.asarray(found.colors)[:, :3], scan.colours)


def test_files_have_the_data_of_the_moment(page):
    """The present, and one commit earlier; imageio, trimesh and mcap read them."""
    imageio, trimesh = pytest.importorskip("imageio.v3"), pytest.importorskip("trimesh")
    page.text("eye/image", "piece/scan")
    for number in (2, 1):
        choose(page, "eye/image")
        name, content = page.downloaded("PNG")
        assert name == f"eye_image_v{number}.png"
        assert np.array_equal(imageio.imread(BytesIO(content)), image_at(number))
        choose(page, "piece/scan")
        name, content = page.downloaded("PLY")
        assert name == f"piece_scan_v{number}.ply"
        assert same_scan(trimesh.load(BytesIO(content), file_type="ply"), number)
        name, content = page.downloaded("MCAP")
        assert name.startswith("online_")
        assert name.endswith(".mcap")
        check_world(content, number)
        page.tab("time")
        page.press("previous")
        page.text("before the newest")


def check_world(content, number):
    """Check an MCAP file: every datum of the moment exactly, and the image for other programs."""
    reader = pytest.importorskip("mcap.reader").make_reader(BytesIO(content), validate_crcs=True)
    messages = [(channel.topic, each.data) for _, channel, each in reader.iter_messages()]
    exact = [decode_recorded(data) for topic, data in messages if topic.startswith("/enact/")]
    found = {str(one.slot): (one.version, decode_untyped(one.datum)) for one in exact}
    assert found.keys() == {"online:eye/image", "online:piece/scan"}
    assert {version for version, _ in found.values()} == {number}
    assert np.array_equal(found["online:eye/image"][1], image_at(number))
    scan = found["online:piece/scan"][1]
    assert np.array_equal(scan["points_m"], scan_at(number).points_m)
    topics = {topic for topic, _ in messages}
    assert {"/online/eye/image", "/online/piece/scan"} <= topics


def test_a_datum_that_is_no_such_file_is_named_instead(page):
    """A scan is no image, and without a chosen datum there is no file; the page says so."""
    page.tab("datum")
    page.press("PNG")
    page.text("no datum is chosen")
    choose(page, "piece/scan")
    page.press("PNG")
    page.text("online:piece/scan is shown as point_cloud, so it has no image")
