"""`enact view` in a real browser: what is drawn where, in which colour, of which moment.

A shard, the view and the browser are processes of their own.
"""

import contextlib
import re
import threading

import numpy as np
import pytest
from browsed import HIGH_PX, WIDE_PX, Opened, Served, is_blue, is_empty, is_orange

from enact_dist import Aspect, Entity, Lock, Read, Write
from enact_dist.recording import Recorder

BODY = Aspect("body", np.ndarray)
SPEED = Aspect("speed", float)
BALL, GAUGE = Entity("ball"), Entity("gauge/left")

pytestmark = pytest.mark.timing


def ball_at(x_m):
    """Return a sphere with a radius of 0.5 m as a capsule without length."""
    return np.array([[x_m, 0.0, 0.0, x_m, 0.0, 0.0, 0.5]])


class ServedBall(Served):
    """A ball that moves, and a gauge."""

    aspects = '[aspects.body]\nshows = "capsules"\nframe = "cell"\n'

    def begin(self):
        self.body, self.speed = Write(self.online, BALL, BODY), Write(self.online, GAUGE, SPEED)
        self.online.init(GAUGE, SPEED, 1.25)
        self.moves = 0
        for x_m in (3.0, 0.0):  # version 1 is beside the middle of the picture, version 2 in it
            self.move(x_m)

    def move(self, x_m):
        speed = Read(self.online, GAUGE, SPEED)
        with Lock(self.body, speed) as lock:
            assert lock[speed] == 1.25
            lock[self.body] = ball_at(x_m)
        self.moves += 1


_BUFFER = """() => [...document.querySelectorAll("canvas")]
  .map(one => [one.width, one.height]).sort((one, other) => other[0] - one[0])[0]"""


@pytest.fixture(scope="module")
def shown(tmp_path_factory):
    with contextlib.ExitStack() as stack:
        yield ServedBall(tmp_path_factory.mktemp("shown"), stack)


@pytest.fixture
def page(browser, shown, request):
    """A new page that has shown everything, of the cell or, if asked for, of a recording of it."""
    url, run = shown.url, shown.folder / "run.mcap"
    if getattr(request, "param", "") == "recording":
        Recorder(shown.cell, run).run(threading.Event(), seconds=0.1)
        _, url = shown.start_view(of=run.name)
    found = Opened(browser, url)
    yield found
    found.page.close()
    host = url.removeprefix("http://")
    assert {re.sub(r"^(blob:)?(\w+://)?([^/]+).*", r"\3", url) for url in found.requests} == {host}
    assert found.errors == []


def test_page_shows_the_cell_and_its_past(page, shown):
    """The ball is in the middle now, beside it one commit earlier, and orange where it differs."""
    page.text("shown · online", "gauge/ (1)", "ball/body")
    page.until_middle(is_blue)

    page.tab("time")
    page.press("previous")
    page.text("before the newest")
    page.until_middle(is_empty)
    page.press("mark this moment")
    page.page.get_by_label("live", exact=True).click()
    page.until_middle(is_blue)
    page.choose("compare with", "the marked moment")
    page.text("1 differ", "ball/body changed")
    page.until_middle(is_orange)


@pytest.mark.parametrize("page", ["cell", "recording"], indirect=True)
def test_a_datum_has_values_causes_and_a_label_that_keeps_them(page, shown, request):
    """`why` is a tree whose steps can be looked at; only the button keeps versions, in a cell."""
    is_cell = "recording" not in request.node.name
    page.press("gauge/ (1)")
    page.text("left/speed", "1.25" if is_cell else "v1")
    page.press("..")
    page.text("ball/body")
    page.choose("datum", "ball/body")
    page.tab("datum")
    page.text("online:ball/body", "v2")
    page.press("why")
    page.text("online:ball/body v2", "online:gauge/left/speed v1")
    page.choose("step", "2. online:gauge/left/speed v1")
    page.text("online:gauge/left/speed", "1.25")
    assert shown.cell.pinned() == {}
    assert page.page.get_by_role("button", name="keep under this label").count() == is_cell
    if not is_cell:
        return
    page.page.locator("input:visible").last.fill("incident-7")
    page.press("keep under this label")
    page.text("versions are kept under incident-7")
    assert {str(one.slot) for one in shown.cell.pinned()["incident-7"]} == {
        "online:ball/body",
        "online:gauge/left/speed",
    }
    shown.cell.unpin("incident-7")


def test_a_page_of_half_the_resolution_draws_the_same_places(shown, browser):
    """Whichever address was opened: a quarter of the pixels, and the ball where it must be."""
    view, url = shown.start_view(0, "--resolution", "0.5")
    page = Opened(browser, url.removesuffix("?fixedDpr=0.5"))
    assert page.page.url == url != page.requests[0]
    page.until_middle(is_blue)
    assert page.page.evaluate(_BUFFER) == [WIDE_PX // 2, HIGH_PX // 2]
    picture, left = page.picture(), np.array((-1.0, -1.0, 0.0)) / np.sqrt(2.0)
    for away_m, is_ball in ((0.0, True), (0.5, True), (0.6, False)):  # it seems 0.55 m to the eye
        column, row = page.pixel_of(away_m * left, (-0.5,) * 3, (0.5,) * 3)
        assert is_blue(*picture[row, column].astype(int)) == is_ball, away_m
    assert page.errors == []
    page.page.close()
    view.kill()


def test_two_pages_show_two_moments_and_outlive_their_shard(page, shown, browser):
    """One looks back while the other follows; a killed shard is named until it is back."""
    other = Opened(browser, shown.url)
    page.tab("time")
    page.press("previous")
    page.text("before the newest")
    other.tab("time")
    other.text("now,")

    shown.shard.kill()
    shown.shard.wait(60)
    other.tab("cell")
    other.text("AWAY")
    shown.shard = shown.start_shard()
    shown.move(3.0)
    shown.move(0.0)
    other.text("open")
    other.tab("world")
    other.text("v4")
    other.until_middle(is_blue)
    other.page.close()
    page.text("before the newest")


def test_a_page_goes_on_when_its_view_has_been_killed_and_started_again(shown, browser):
    """Without a person who loads it anew, it shows the present; of before, nothing stays."""
    page = Opened(browser, shown.url)
    page.text("ball/body", f"v{shown.moves}")
    loaded = len(page.requests)
    shown.view.kill()
    shown.view.wait(60)
    shown.move(0.0)
    shown.view, url = shown.start_view(shown.url.rpartition(":")[2])
    assert url == shown.url
    page.text("ball/body", f"v{shown.moves}")
    page.until_middle(is_blue)
    shown.move(3.0)
    page.text(f"v{shown.moves}")
    page.until_middle(is_empty)
    assert {url.partition(":")[0] for url in page.requests[loaded:]} == {"ws"}
    page.page.close()
