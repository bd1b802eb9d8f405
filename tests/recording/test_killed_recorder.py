"""A recorder that is killed at any moment leaves a recording that is good up to its last chunk."""

import os
import random
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import pytest
from mcap.exceptions import McapError
from mcap.records import Channel, Message
from mcap.stream_reader import StreamReader
from polling import until
from ports import free_endpoint

from enact_dist import Aspect, Entity, Lock, Write, connect
from enact_dist.recording.reading import Recording

HERE = Path(__file__).parent
ENVIRONMENT = {"PYTHONPATH": str(HERE.parents[1]), "PYTHONUNBUFFERED": "1"}
ROUNDS = 8


@pytest.fixture
def started():
    """Start a process, which is killed with the test; it may be told to be ready by a line."""
    processes = []

    def start(*words, ready):
        process = subprocess.Popen(
            [sys.executable, *map(str, words)],
            env=os.environ | ENVIRONMENT,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        processes.append(process)
        for line in process.stdout if ready else ():
            if ready in line:
                break
        return process

    yield start
    for process in processes:
        process.kill()
        process.wait()
        process.stdout.close()


@pytest.fixture
def endpoint(tmp_path, started):
    """One shard that commits are made at all the time."""
    address = free_endpoint()
    file = tmp_path / "cell.toml"
    file.write_text(f'name = "killed"\n[shards.only]\nlisten = "{address}"\n')
    started("-m", "enact_dist.cli.main", "shard", "run", "only", "--cell", file, ready="ready")
    started(HERE / "loaded_cell.py", address, 0.01, ready="committing")
    return address


def has_begun(recorder, path):
    """Whether a recorder has written its first commits, or has ended."""
    return recorder.poll() is not None or (path.exists() and path.stat().st_size > 5_000)


@pytest.mark.slow
def test_killed_recorder_leaves_whole_commits_without_a_hole(endpoint, started, tmp_path):
    """Commits are whole, follow each other, and end at most a chunk before the kill."""
    seeds = random.Random(7)
    held = []
    for turn in range(5 * ROUNDS):
        if turn >= ROUNDS and sum(held) > 50:
            break
        path = tmp_path / f"{turn}.mcap"
        recorder = started(
            "-m", "enact_dist.cli.main", "record", endpoint, "--out", path, "--world", "online",
            ready="",
        )  # fmt: skip
        until(partial(has_begun, recorder, path))
        assert recorder.poll() is None, recorder.stdout.read()
        time.sleep(seeds.uniform(0.0, 1.3))  # at any moment of a chunk
        recorder.send_signal(signal.SIGKILL)
        killed_ns = time.time_ns()
        recorder.wait()

        recording = Recording(path)
        commits = list(recording.commits())
        numbered = [commit for commit in commits if commit.number]
        assert not recording.whole
        assert [commit.number for commit in numbered] == list(range(1, len(numbered) + 1))
        for commit in numbered:
            assert [v.slot.entity for v in commit.versions] == ["left", "right"]
            left, right = commit.versions
            assert bytes(left.datum.body) == bytes(right.datum.body)
        if not commits:
            continue  # killed in its first chunk
        versions = [commit.versions[0].version for commit in commits]
        assert versions == list(range(versions[0], versions[0] + len(versions)))
        assert killed_ns - commits[-1].log_ns < 30e9  # 1.3 s of a process that has its turns
        assert _publicly_readable(path) == 2 * len(commits)
        held.append(len(numbered))
    assert sum(held) > 50, "under load"  # however few each, and in however many rounds


@pytest.mark.slow
def test_recording_goes_on_when_a_shard_comes_back(started, tmp_path):
    """Killed and started again, its durable data have no hole in the recording."""
    address = free_endpoint()
    file = tmp_path / "cell.toml"
    file.write_text(
        'name = "back"\nworlds = ["online"]\ndata_folder = "data"\nsession_ttl_s = 1.0\n'
        f'[shards.only]\nlisten = "{address}"\n'
    )
    run = ("-m", "enact_dist.cli.main", "shard", "run", "only", "--cell", file)
    shard = started(*run, ready="ready")
    path = tmp_path / "run.mcap"
    count = Aspect("count", int, retention=100)
    with connect(file) as cell:
        request = Write(cell.world("online"), Entity("piece"), count)
        recorder = started("-m", "enact_dist.cli.main", "record", file, "--out", path, ready="")
        while not path.exists():
            assert recorder.poll() is None, recorder.stdout.read()
        for number in range(40):
            if number == 20:
                shard.kill()
                shard.wait()
                started(*run, ready="ready")
            with Lock(request, wait_s=30.0) as lock:
                lock[request] = number
        recorder.send_signal(signal.SIGTERM)
        text = recorder.stdout.read()
        assert recorder.wait(180) == 0, text
    found = [v.version for c in Recording(path).commits() for v in c.versions]
    assert found == list(range(found[0], 41)), text


def _publicly_readable(path):
    """Count the exact messages that the public library reads before it meets the cut."""
    count, exact = 0, set()
    try:
        with path.open("rb") as stream:
            for record in StreamReader(stream, validate_crcs=True).records:
                if isinstance(record, Channel) and "exact" in record.metadata:
                    exact.add(record.id)
                count += isinstance(record, Message) and record.channel_id in exact
    except (McapError, ValueError, RuntimeError, OSError, *_library_errors()):
        return count
    raise AssertionError("a killed recorder's file has no end")


def _library_errors():
    import struct

    import zstandard

    return struct.error, zstandard.ZstdError
