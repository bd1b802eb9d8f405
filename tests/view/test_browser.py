"""`enact view` in a real browser: what is drawn where, in which colour, of which moment.

A shard, the view and the browser are processes of their own.
"""

import contextlib
import re

import numpy as np
import pytest
from browsed import Opened, Served, is_blue, is_empty, is_orange

from enact_dist import Aspect, Entity, Lock, Read, Write

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


@pytest.fixture(scope="module")
def shown(tmp_path_factory):
    with contextlib.ExitStack() as stack:
        yield ServedBall(tmp_path_factory.mktemp("shown"), stack)


@pytest.fixture
def page(browser, shown):
    """A new page that has shown everything."""
    found = Opened(browser, shown.url)
    yield found
    found.page.close()
    host = shown.url.removeprefix("http://")
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


def test_a_datum_has_values_causes_and_a_label_that_keeps_them(page, shown):
    """`why` is a tree whose steps can be looked at; only the button keeps versions."""
    page.press("gauge/ (1)")
    page.text("gauge/left/speed".removeprefix("gauge/"), "1.25")
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
    page.page.locator("input:visible").last.fill("incident-7")
    page.press("keep under this label")
    page.text("versions are kept under incident-7")
    assert {str(one.slot) for one in shown.cell.pinned()["incident-7"]} == {
        "online:ball/body",
        "online:gauge/left/speed",
    }


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
