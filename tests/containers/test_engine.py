"""The engine of the tests: nothing of it outlives the process that started it."""

import os
import select
import subprocess
import sys
from pathlib import Path

import pytest
from engine import CGROUPS, sweep

pytestmark = pytest.mark.containers

OTHER = """
import sys
from engine import start
engine = start()
print(engine.folder, engine.daemon(), flush=True)
sys.stdin.read()
"""


def test_an_engine_dies_with_its_tests_and_leaves_nothing(engine):
    """Even when they are killed: the next start removes the folder."""
    tests = subprocess.Popen(
        [sys.executable, "-c", OTHER],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    line = tests.stdout.readline().split()
    assert line, "no second engine"
    folder, daemon = Path(line[0]), os.pidfd_open(int(line[1]))
    tests.kill()
    tests.communicate(timeout=120)
    ended, _, _ = select.select([daemon], [], [], 120.0)
    os.close(daemon)
    assert ended, "the engine lives on"
    sweep()

    assert not folder.exists()
    assert [*CGROUPS.glob(f"{folder.name}"), *CGROUPS.glob(f"*/{folder.name}")] == []
    assert engine.folder.exists(), "an engine in use is not swept away"


def test_an_engine_is_on_no_network_of_this_host(engine):
    """Its interfaces and firewall rules are its own."""
    found = engine.inside("ip", "-brief", "link").stdout.split()

    assert [word for word in found if word.startswith("eth")] == []
    assert "lo" in found
