"""Files ahead and processes that fork, die, or share no memory: no datum is wrong, no file is left.

Each client publishes images and reads each of them back whole, see `ahead_worker.py`.
"""

import signal
from pathlib import Path

import pytest
from polling import until
from test_payloads import namespace

from enact_dist import connect

pytestmark = pytest.mark.slow
WORKER = str(Path(__file__).with_name("ahead_worker.py"))
both = pytest.mark.carrier("socket", "zenoh")


@pytest.fixture
def run(make_process):
    """Start a worker of a cell, perhaps in another namespace."""

    def start(cell, role, before=()):
        return make_process(WORKER, role, f"tcp/127.0.0.1:{cell.ports['s0']}", before=before)

    return start


def figures(cell):
    with connect(cell.file) as joined:
        (shard,) = joined.shards()
        return shard.counters


def none_is_left(cell, root, versions):
    """Wait until only the newest versions have files; then no other byte is counted."""
    until(lambda: figures(cell)["payload_files"] == versions, pause_s=0.05)
    found = figures(cell)
    left = [file for file in root.glob("*/*-*") if not file.name.startswith("uses-")]
    shown = [found[name] for name in ("files_ahead", "files_ahead_bytes", "payload_drafts")]
    assert (shown, len(left)) == ([0, 0, 0], versions)
    assert found["payload_bytes"] == sum(file.stat().st_size for file in left)


def done(process):
    """Let a worker end."""
    process.tell("")
    assert process.finish() == 0, process.story()


@both
def test_parent_and_child_of_a_fork_publish_both(make_cell, run, root):
    """The child has no part in the files of its parent: what either reads is its own."""
    cell = make_cell().start_all()
    worker = run(cell, "forks")

    assert worker.expect("done:") == "0 0"
    assert figures(cell)["files_ahead_used"] > 0
    done(worker)
    none_is_left(cell, root, 2)


@both
def test_files_of_a_parent_that_dies_after_a_fork_are_gone(make_cell, run, root):
    """Its child has inherited its descriptors, and lives on with a session of its own."""
    cell = make_cell().start_all()
    worker = run(cell, "dies_after_a_fork")
    worker.expect("child")
    until(lambda: figures(cell)["files_ahead"] > 0, pause_s=0.05)
    worker.signal(signal.SIGKILL)
    worker.finish()
    none_is_left(cell, root, 1)

    worker.tell("go on")
    worker.expect("child done")
    none_is_left(cell, root, 2)


@both
def test_files_of_a_client_that_is_killed_are_gone(make_cell, run, root):
    """While it rests, and while it fills one."""
    cell = make_cell(ttl_s=1.0).start_all()
    for role, said in (("rests", "rests"), ("uses_one_late", "holds")):
        worker = run(cell, role)
        worker.expect(said)
        until(lambda: figures(cell)["files_ahead"] > 0, pause_s=0.05)
        if said == "holds":
            worker.tell("fill")
            worker.expect("filled")
        worker.signal(signal.SIGKILL)
        worker.finish()
        none_is_left(cell, root, 1)


@both
@pytest.mark.parametrize("when", ["holds", "filled"])
def test_shard_that_is_killed_under_files_ahead_loses_the_lock_and_no_more(
    make_cell, run, root, when
):
    """Before the use of one, and after: the folder is there until the next start sweeps it."""
    cell = make_cell(ttl_s=1.0).start_all()
    worker = run(cell, "uses_one_late")
    worker.expect("holds")
    if when == "filled":
        worker.tell("fill")
        worker.expect("filled")
    cell.kill()
    if when == "holds":
        worker.tell("fill")
        worker.expect("filled")
    cell.start()
    worker.tell("leave")

    assert worker.expect("ended:") in {"LeaseLostError", "CommitUnknownError"}
    assert worker.expect("done:") == "0"
    done(worker)
    none_is_left(cell, root, 1)


@pytest.mark.carrier("auto")
@pytest.mark.parametrize("way", ["elsewhere", "read-only"])
def test_client_that_cannot_fill_files_lets_none_be_made(make_cell, run, root, way):
    """It has no common memory, or may not write there: its data travel, as they would without."""
    cell = make_cell().start_all()
    mounts = [f"mount -t tmpfs tmpfs {root}"]
    if way == "read-only":
        mounts = [f"mount --bind -o ro {root} {root}", f"mount -o remount,bind,ro {root}"]
    with namespace(*mounts) as enter:
        worker = run(cell, "publishes", before=enter)
        assert int(worker.expect("done:")) == (12 if way == "read-only" else 0)
        found = figures(cell)
        done(worker)

    assert (found["files_ahead"], found.get("files_ahead_used", 0)) == (0, 0)
    assert "files_ahead_removed" not in found
