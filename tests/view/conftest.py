"""The samples beside these tests, a cell of a robot arm, and a browser."""

import sys
from pathlib import Path

import pytest

from enact_dist import local

sys.path.insert(0, str(Path(__file__).parent))
from view_samples import ARM, POSE, SPEED, moved

BROWSER = Path("/usr/bin/chromium")


@pytest.fixture
def cell():
    with local(worlds=["online", "truth"], actor="writer") as cell:
        online = cell.world("online")
        online.init(ARM, SPEED, 0.5)
        online.init(ARM, POSE, moved(0.0))
        yield cell


@pytest.fixture(scope="session")
def browser():
    """A browser that draws in software."""
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
