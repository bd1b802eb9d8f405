"""The tools in a cell with rights: what a name may not see is refused by name, never shown as null.

`reader` may read a part and observe, `blind` may do nothing.
"""

import pytest

pytest.importorskip("cryptography", reason="making keys needs the extra 'keys'")

import sys
import threading
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "link"))

import key_cells

from enact_dist import Aspect, Entity, Lock, Write, connect
from enact_dist.cli.main import main

pytestmark = pytest.mark.carrier("zenoh")

RIGHTS = """
[rights]
default = "none"
programs = ["reader", "blind"]
observe = ["reader"]
[[rights.allow]]
who = "reader"
read = "online:open/**"
"""
OBSERVING = (["top", "--once"], ["actor", "ls"], ["lock", "ls"], ["lock", "audit"], ["shard", "ls"])
SECRET = (
    ["why", "online", "secret/x/count"],
    ["world", "history", "online", "secret/x/count"],
    ["world", "get", "online", "secret/x/count"],
)


@pytest.fixture(scope="module")
def cell(tmp_path_factory):
    """A running cell with a datum that `reader` may read, and one that it may not."""
    cell = key_cells.KeyCell(tmp_path_factory.mktemp("cell"), more=RIGHTS)
    with cell.running():
        with connect(cell.file, actor="ada") as ada:
            for name in ("open/x", "secret/x"):
                write = Write(ada.world("online"), Entity(name), Aspect("count", int))
                with Lock(write) as lock:
                    lock[write] = 1
        yield cell


@pytest.fixture
def run(cell, capsys, monkeypatch):
    """Run a command under a name; return status, output and errors."""

    def called(name, words):
        monkeypatch.setenv("ENACT_IDENTITY", name)
        status = main([*words, "--cell", str(cell.file)])
        return status, *capsys.readouterr()

    return called


@pytest.mark.parametrize("words", OBSERVING, ids=" ".join)
def test_who_may_observe_sees_the_cell_and_others_read_why_not(run, words):
    status, out, _ = run("reader", words)
    assert status == 0
    assert "secret" not in out
    status, _, error = run("blind", words)
    assert status == 1
    assert "blind may not observe the cell" in error


@pytest.mark.parametrize("words", SECRET, ids=" ".join)
def test_what_is_not_readable_is_no_null(run, words):
    status, out, error = run("reader", words)
    assert (status, out) == (1, "")
    assert "reader may not read online:secret/x/count" in error
    assert run("reader", [word.replace("secret", "open") for word in words])[0] == 0


def test_lists_leave_out_what_is_not_readable(run):
    for name, seen in (("ada", 2), ("reader", 1), ("blind", 0)):
        status, out, _ = run(name, ["world", "tree", "online"])
        assert status == 0
        assert f"({seen} data)" in out
    assert run("blind", ["shard", "check"])[0] == 0


def test_a_recording_has_what_is_readable_and_names_the_rest(cell, tmp_path, monkeypatch):
    """Notices over the network tell of data that the recorder may not read."""
    from enact_dist.recording import Recorder
    from enact_dist.recording.summary import DENIED

    count = Aspect("count", int)
    monkeypatch.setenv("ENACT_IDENTITY", "reader")
    with connect(cell.file) as reader, connect(cell.file, actor="ada") as ada:
        writes = [
            Write(ada.world("online"), Entity(name), count) for name in ("open/x", "secret/x")
        ]

        def write():
            for some in ([writes[0]], [writes[1]], writes):
                with Lock(*some) as lock:
                    for one in some:
                        lock[one] += 1

        recorder = Recorder(reader, tmp_path / "run.mcap")
        writing = threading.Timer(0.5, write)
        writing.start()
        summary = recorder.run(seconds=2.0)
        writing.join()
    assert (summary.initial, summary.versions) == (1, 3)
    assert summary.gaps == {DENIED: 2}
    assert summary.gap_slots == {"online:secret/x/count": 2}
