"""A cell of two real shard daemons on loopback, and `enact` called in the test's own process."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from ports import free_port

from enact_dist.cli.main import main

ENACT = (sys.executable, "-m", "enact_dist.cli.main")
SURROUNDINGS = {"PYTHONUNBUFFERED": "1", "PYTHONPATH": str(Path(__file__).parents[2])}


def new_cell(folder, more=""):
    left, right = free_port(), free_port()
    file = folder / "cell.toml"
    file.write_text(
        f"""\
name = "clitest"
worlds = ["online", "training"]
session_ttl_s = 1.0
data_folder = "data"

[shards.left]
listen = "tcp/127.0.0.1:{left}"

[shards.right]
listen = "tcp/127.0.0.1:{right}"
{more}""",
        encoding="utf-8",
    )
    return file


def start(*words, **options):
    """Start `enact` as a process of its own, its output readable line by line."""
    options = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True} | options
    env = os.environ | SURROUNDINGS | options.pop("env", {})
    return subprocess.Popen([*ENACT, *map(str, words)], env=env, **options)


def read_until(process, mark):
    """Return the lines of a process up to one that contains `mark`."""
    seen = []
    for line in process.stdout:
        seen.append(line)
        if mark in line:
            return seen
    raise AssertionError(f"ended with {process.wait()} before {mark!r}: {''.join(seen)}")


def end(process):
    process.send_signal(signal.SIGTERM)
    process.wait(60)
    process.stdout.close()


@pytest.fixture(autouse=True)
def _no_cell_from_outside(monkeypatch, tmp_path):
    monkeypatch.delenv("ENACT_CELL", raising=False)
    monkeypatch.chdir(tmp_path)


@pytest.fixture(scope="module")
def cell_file(tmp_path_factory):
    """The file of a running cell of two shards."""
    file = new_cell(tmp_path_factory.mktemp("cell"))
    shards = [start("shard", "run", name, "--cell", file) for name in ("left", "right")]
    for shard in shards:
        read_until(shard, "ready: shard")
    yield file
    for shard in shards:
        end(shard)


@pytest.fixture
def write_cell(tmp_path):
    """Write the file of a cell that does not run yet; `more` is appended."""
    return lambda more="": new_cell(tmp_path, more)


@pytest.fixture
def spawn():
    """Start `enact` as a process that is ended with the test."""
    started = []

    def begin(*words, **options):
        started.append(start(*words, **options))
        return started[-1]

    yield begin
    for process in started:
        if process.poll() is None:
            process.kill()
        process.wait(60)
        if process.stdout:
            process.stdout.close()


@pytest.fixture
def until():
    """Read the lines of a process up to one that contains a mark."""
    return read_until


@pytest.fixture
def enact(capsys):
    """Call `enact`; returns status, standard output, error output and parsed JSON."""

    def call(*words):
        capsys.readouterr()
        status = main(list(map(str, words)))
        out, err = capsys.readouterr()
        return SimpleNamespace(
            status=status,
            out=out,
            err=err,
            json=json.loads(out) if "--json" in words and out else None,
        )

    return call
