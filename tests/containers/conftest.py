"""An engine, and the images in it, for all tests of containers."""

import functools
import subprocess
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))

from engine import ROOT, NoEngineError, start
from stack import PACKAGES, judged


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
    run = "import pathlib, sys; from actors.palletizing.demo.run import run_demo"
    run += "; sys.exit(run_demo(out=pathlib.Path(sys.argv[1]), packages=int(sys.argv[2])))"
    with subprocess.Popen(
        [sys.executable, "-c", run, str(out), str(PACKAGES)], stdout=subprocess.PIPE, text=True
    ) as process:

        @functools.cache
        def report():
            said, _ = process.communicate()
            assert process.returncode == 0, said
            return judged(out)

        yield report
        process.terminate()
