"""What a reported commit survives: the shard killed at random moments, over and over."""

import os
import random
import re
import shutil
import threading

import pytest

from enact_dist import Aspect, Durability, Entity, View, connect

pytestmark = pytest.mark.slow
KEPT = Aspect("kept", int, Durability.DURABLE)
SWIFT = Aspect("swift", int, Durability.OS)
counter = Entity("counter")
ROUNDS = int(os.environ.get("ENACT_KILL_ROUNDS", "8"))


def last_acknowledged(process):
    """Return the last number that a worker said was acknowledged, so far."""
    found = [0]
    while not process.lines.empty():
        line = process.lines.get()
        if line is not None and line.startswith("acknowledged"):
            found.append(int(line.split()[1]))
    return max(found)


def test_acknowledged_commits_survive_kill_at_random_moments(make_cell):
    """Round after round every acknowledged durable and os commit is there, none is half visible."""
    cell = make_cell().start_all()
    pairs, swift = cell.worker("commit_pairs"), cell.worker("commit_swift")
    pairs.expect("started")
    swift.expect("started")
    draw = random.Random(20)
    pause = threading.Event()
    known_pair = known_swift = 0
    for _ in range(ROUNDS):
        known_pair = max(known_pair, int(pairs.expect("acknowledged")))
        pause.wait(draw.uniform(0.0, 0.05))
        cell.kill()
        known_pair = max(known_pair, last_acknowledged(pairs))
        known_swift = max(known_swift, last_acknowledged(swift))
        cell.start()
        with connect(cell.file) as joined:
            online = joined.world("online")
            one, two = View(online, counter, KEPT), View(online, counter, SWIFT)
            three = View(online, Entity("swift"), SWIFT)
            snapshot = online.view(one, two, three)
        assert snapshot.get(one, 0) == snapshot.get(two, 0), "half a commit is visible"
        assert snapshot.get(one, 0) >= known_pair
        assert snapshot.get(three, 0) >= known_swift
    assert known_pair >= ROUNDS, "each round one more was acknowledged"


def test_durable_commit_is_on_disk_before_its_answer(make_cell):
    """strace: between a durable commit's arrival and its answer there is an fdatasync."""
    strace = shutil.which("strace")
    if strace is None:
        pytest.skip("strace is not installed (apt-get install strace)")
    cell = make_cell()
    daemon = cell.start()
    trace = cell.folder / "trace"
    tracer = subprocess_strace(strace, daemon.popen.pid, trace)
    with connect(cell.file) as joined:
        online = joined.world("online")
        before = syncs(trace)
        for number in range(5):
            entity = Entity(f"durable/{number}")
            online.init(entity, KEPT, number)
        after = syncs(trace)
        for number in range(5):
            online.init(Entity(f"swift/{number}"), SWIFT, number)
        swift = syncs(trace)
    tracer.terminate()
    tracer.communicate()
    assert after - before >= 5
    # The first swift commit registers its aspect, which is durable; the commits are not synced.
    assert swift - after <= 2


def subprocess_strace(strace, pid, trace):
    import subprocess

    tracer = subprocess.Popen(
        [strace, "-f", "-e", "trace=fdatasync,fsync", "-o", str(trace), "-p", str(pid)],
        stderr=subprocess.PIPE,
        text=True,
    )
    line = tracer.stderr.readline()
    assert "attached" in line, line
    return tracer


def syncs(trace):
    text = trace.read_text() if trace.exists() else ""
    return len(re.findall(r"(?:fdatasync|fsync)\(", text))
