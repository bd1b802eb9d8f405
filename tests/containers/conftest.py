"""An engine, and the images in it, for all tests of containers."""

import subprocess
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))

from engine import ROOT, NoEngineError, start


@pytest.fixture(scope="session")
def engine():
    """A private engine with the compose plugin, and without any image."""
    try:
        started = start()
    except NoEngineError as error:
        pytest.skip(f"no container engine: {error}")
    yield started
    started.end()


@pytest.fixture(scope="session")
def images(engine):
    """What `deploy/images --local-base` said when it built both images in the engine."""
    fetched = build("--fetch", engine)
    if fetched.returncode:
        pytest.skip(f"nothing to build images from: {fetched.stderr.strip()}")
    done = build("--local-base", engine)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def build(option, engine):
    """Call `deploy/images` for an engine."""
    return subprocess.run(
        [sys.executable, "deploy/images", option],
        env=engine.environment,
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
