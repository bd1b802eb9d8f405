"""A cell, its shard and its view as processes, and pages of the view in a real browser."""

import math
import re
import subprocess
import sys
from io import BytesIO

import numpy as np
from ports import free_port

from enact_dist import connect

WIDE_PX, HIGH_PX = 860, 420
SLOW_MS = 60_000
FIELD_RAD = math.radians(75.0)
"""Vertical field of a page's camera."""
ENACT = [sys.executable, "-m", "enact_dist.cli.main"]
CELL = """
name = "shown"
worlds = ["online"]
data_folder = "data"

[shards.one]
listen = "tcp/127.0.0.1:{port}"
"""


class Served:
    """A cell, its shard and its view as processes, and a session that writes.

    Args:
        folder: Empty, for its files.
        stack: Ends all of them.

    Attributes:
        aspects: Tables of its `cell.toml`.
    """

    aspects = ""

    def __init__(self, folder, stack):
        self.folder, self._stack = folder, stack
        (folder / "cell.toml").write_text(CELL.format(port=free_port()) + self.aspects)
        self.shard = self.start_shard()
        self.cell = stack.enter_context(connect(folder / "cell.toml", actor="writer"))
        self.online = self.cell.world("online")
        self.begin()
        self.view, self.url = self.start_view()

    def begin(self):
        """Write what is there before the view is."""

    def start_shard(self):
        return self._started(["shard", "run", "one", "--cell", "cell.toml"], "ready:")[0]

    def start_view(self, port=0, *options, of="cell.toml"):
        """Start a view and return it with its address."""
        words = ["view", of, "--port", str(port), *options]
        process, line = self._started(words, "http")
        return process, re.search(r"http://\S+", line)[0]

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


class Opened:
    """A page, with everything that it asked for and what went wrong in it."""

    def __init__(self, browser, url, *, wide_px=WIDE_PX, high_px=HIGH_PX):
        self.size_px = wide_px, high_px
        self.page = browser.new_page(viewport={"width": wide_px, "height": high_px})
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

    def downloaded(self, name):
        """Press a button that sends a file; return the file's name and its bytes."""
        with self.page.expect_download() as found:
            self.press(name)
        return found.value.suggested_filename, found.value.path().read_bytes()

    def picture(self, **options):
        """Return what the page shows, (H, W, 3) bytes."""
        import imageio.v3 as imageio

        shot = self.page.screenshot(timeout=SLOW_MS, **options)
        return imageio.imread(BytesIO(shot))[..., :3]

    def middle(self):
        """Return the mean colour in the middle of the canvas, red, green, blue."""
        wide_px, high_px = self.size_px
        clip = {"x": wide_px / 2 - 8, "y": high_px / 2 - 8, "width": 16, "height": 16}
        return self.picture(clip=clip).reshape(-1, 3).mean(axis=0)

    def until_middle(self, is_right):
        """Wait until the middle of the canvas has the right colour."""
        for _ in range(20):
            colour = self.middle()
            if is_right(*colour):
                return
            self.page.wait_for_timeout(250)  # frames come when the browser has drawn them
        raise AssertionError(f"the middle of the canvas is {colour}")

    def pixel_of(self, place_m, low_m, high_m):
        """Return where a place of the cell (3,) is, column and row.

        Args:
            place_m: The place.
            low_m: Lowest corner of all that is drawn.
            high_m: Highest corner of that.
        """
        low_m, high_m = np.array(low_m), np.array(high_m)
        middle_m, away = (low_m + high_m) / 2.0, np.array((0.75, -0.75, 0.6))
        eye_m = middle_m + (high_m - low_m).max() * away
        forward = -away / np.linalg.norm(away)
        right = np.cross(forward, (0.0, 0.0, 1.0))
        right /= np.linalg.norm(right)
        seen_m = np.array((right, np.cross(forward, right), forward)) @ (place_m - eye_m)
        wide_px, high_px = self.size_px
        focal_px = high_px / 2.0 / math.tan(FIELD_RAD / 2.0)
        column, row = focal_px * seen_m[:2] / seen_m[2] + (wide_px / 2.0, high_px / 2.0)
        return round(column), round(row)


def is_blue(red, green, blue):
    return blue > red + 60


def is_orange(red, green, blue):
    return red > blue + 60


def is_empty(red, green, blue):
    return min(red, green, blue) > 200
