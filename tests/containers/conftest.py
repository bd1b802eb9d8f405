"""An engine, and the images in it, for all tests of containers."""

import functools
import subprocess
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))

from engine import ROOT, NoEngineError, start
from stack import PACKAGES, judged, list_cell


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


@pytest.fixture(scope="session")
def alone(tmp_path_factory):
    """The palletizing cell on this machine, without containers; its report once it is done."""
    out = tmp_path_factory.mktemp("alone")
    command = [sys.executable, list_cell.__file__, str(out), str(PACKAGES)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:

        @functools.cache
        def report():
            said, _ = process.communicate()
            assert process.returncode == 0, said
            return judged(out)

        yield report
        process.terminate()
