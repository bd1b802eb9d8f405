"""`enact view` in a real browser: what is drawn where, in which colour, of which moment.

A shard, the view and the browser are processes of their own.
"""

import contextlib
import re
import subprocess
import sys
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from ports import free_port

from enact_dist import Aspect, Entity, Lock, Read, Write, connect

BROWSER = Path("/usr/bin/chromium")
WIDE_PX, HIGH_PX = 860, 420
SLOW_MS = 60_000
ENACT = [sys.executable, "-m", "enact_dist.cli.main"]

BODY = Aspect("body", np.ndarray)
SPEED = Aspect("speed", float)
BALL, GAUGE = Entity("ball"), Entity("gauge/left")
CELL = """
name = "shown"
worlds = ["online"]
data_folder = "data"

[shards.one]
listen = "tcp/127.0.0.1:{port}"

[aspects.body]
shows = "capsules"
frame = "cell"
"""

pytestmark = pytest.mark.timing


def ball_at(x_m):
    """Return a sphere with a radius of 0.5 m as a capsule without length."""
    return np.array([[x_m, 0.0, 0.0, x_m, 0.0, 0.0, 0.5]])


class Served:
    """The cell, its shard and its view as processes, and a session that writes."""

    def __init__(self, folder, stack):
        self.folder, self._stack = folder, stack
        (folder / "cell.toml").write_text(CELL.format(port=free_port()))
        self.shard = self.start_shard()
        self.cell = stack.enter_context(connect(folder / "cell.toml", actor="writer"))
        online = self.cell.world("online")
        self.body, self.speed = Write(online, BALL, BODY), Write(online, GAUGE, SPEED)
        online.init(GAUGE, SPEED, 1.25)
        for x_m in (3.0, 0.0):  # version 1 is beside the middle of the picture, version 2 in it
            self.move(x_m)
        _, line = self._started(["view", "cell.toml", "--port", "0"], "http")
        self.url = re.search(r"http://\S+", line)[0]

    def start_shard(self):
        return self._started(["shard", "run", "one", "--cell", "cell.toml"], "ready:")[0]

    def _started(self, words, mark):
        """Start `enact` and return the process and its line with a mark."""
        process = subprocess.Popen(
            [*ENACT, *words], cwd=self.folder, stdout=subprocess.PIPE, text=True
        )
        self._stack.callback(process.stdout.close)
        self._stack.callback(process.wait, 60)
        self._stack.callback(process.kill)
        for line in process.stdout:
            if mark in line:
                return process, line
        raise AssertionError(f"enact {words[0]} ended with {process.wait(60)}")

    def move(self, x_m):
        speed = Read(self.speed.world, GAUGE, SPEED)
        with Lock(self.body, speed) as lock:
            assert lock[speed] == 1.25
            lock[self.body] = ball_at(x_m)


@pytest.fixture(scope="module")
def shown(tmp_path_factory):
    with contextlib.ExitStack() as stack:
        yield Served(tmp_path_factory.mktemp("shown"), stack)


@pytest.fixture(scope="module")
def browser():
    playwright = pytest.importorskip("playwright.sync_api")
    pytest.importorskip("viser")
    if not BROWSER.exists():
        pytest.skip(f"there is no browser at {BROWSER}: apt-get install chromium")
    with playwright.sync_playwright() as driver:
        options = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox"]
        found = driver.chromium.launch(
            executable_path=str(BROWSER), args=[*options, "--disable-dev-shm-usage"]
        )
        yield found
        found.close()


class Opened:
    """A page, with everything that it asked for and what went wrong in it."""

    def __init__(self, browser, url):
        self.page = browser.new_page(viewport={"width": WIDE_PX, "height": HIGH_PX})
        self.page.set_default_timeout(SLOW_MS)
        self.requests, self.errors = [], []
        self.page.on("request", lambda request: self.requests.append(request.url))
        self.page.on("websocket", lambda socket: self.requests.append(socket.url))
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.on(
            "console", lambda one: self.errors.append(one.text) if one.type == "error" else None
        )
        self.page.goto(url)
        self.text("updates/s")

    def text(self, *wanted):
        """Wait until the page has these texts."""
        try:
            self.page.wait_for_function(
                "wanted => wanted.every(one => document.body.innerText.includes(one))",
                arg=list(wanted),
            )
        except Exception as error:
            raise AssertionError(f"no {wanted} in {self.page.inner_text('body')}") from error

    def tab(self, name):
        self.page.get_by_role("tab", name=name, exact=True).click()

    def choose(self, label, option):
        self.page.get_by_label(label, exact=True).locator("visible=true").click()
        self.page.get_by_role("option", name=option, exact=True).click()

    def press(self, name):
        self.page.get_by_role("button", name=name, exact=True).locator("visible=true").click()

    def middle(self):
        """Return the mean colour in the middle of the canvas, red, green, blue."""
        import imageio.v3 as imageio

        clip = {"x": WIDE_PX / 2 - 8, "y": HIGH_PX / 2 - 8, "width": 16, "height": 16}
        picture = imageio.imread(BytesIO(self.page.screenshot(clip=clip, timeout=SLOW_MS)))
        return picture[..., :3].reshape(-1, 3).mean(axis=0)

    def until_middle(self, is_right):
        """Wait until the middle of the canvas has the right colour."""
        for _ in range(20):
            colour = self.middle()
            if is_right(*colour):
                return
            self.page.wait_for_timeout(250)  # frames come when the browser has drawn them
        raise AssertionError(f"the middle of the canvas is {colour}")


def is_blue(red, green, blue):
    return blue > red + 60


def is_orange(red, green, blue):
    return red > blue + 60


def is_empty(red, green, blue):
    return min(red, green, blue) > 200


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
