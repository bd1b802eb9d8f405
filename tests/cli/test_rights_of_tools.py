"""The tools in a cell with rights: what a name may not see is refused by name, never shown as null."""

import pytest

pytest.importorskip("cryptography", reason="making keys needs the extra 'keys'")

import contextlib
import logging
import threading
from concurrent.futures import ThreadPoolExecutor

from rights_cells import guarded_cell

from enact_dist import Aspect, Entity, Lock, Write, connect
from enact_dist.cli.main import main
from enact_dist.errors import LeaseLostError
from enact_dist.recording.reading import Recording

COUNT = Aspect("count", int)
pytestmark = pytest.mark.carrier("zenoh")

OBSERVING = (["top", "--once"], ["actor", "ls"], ["lock", "ls"], ["lock", "audit"], ["shard", "ls"])
SECRET = (
    ["why", "online", "secret/x/count"],
    ["world", "history", "online", "secret/x/count"],
    ["world", "get", "online", "secret/x/count"],
)


@pytest.fixture(scope="module")
def cell(tmp_path_factory):
    """A running cell with a datum that `reader` may read, and one that it may not."""
    cell = guarded_cell(tmp_path_factory.mktemp("cell"))
    with cell.running():
        with connect(cell.file, actor="ada") as ada:
            for name in ("open/x", "secret/x"):
                write = Write(ada.world("online"), Entity(name), COUNT)
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
    """What the observer may not read is not among it."""
    status, out, _ = run("reader", words)
    assert status == 0
    assert "secret" not in out
    status, _, error = run("blind", words)
    assert status == 1
    assert "blind may not observe the cell" in error


@pytest.mark.parametrize("words", SECRET, ids=" ".join)
def test_what_is_not_readable_is_no_null(run, words):
    """The same command on a readable slot works."""
    status, out, error = run("reader", words)
    assert (status, out) == (1, "")
    assert "reader may not read online:secret/x/count" in error
    assert run("reader", [word.replace("secret", "open") for word in words])[0] == 0


def test_lists_leave_out_what_is_not_readable(run):
    """They count what is left, and a check of the shards needs no right."""
    for name, seen in (("ada", 2), ("reader", 1), ("blind", 0)):
        status, out, _ = run(name, ["world", "tree", "online"])
        assert status == 0
        assert f"({seen} data)" in out
    assert run("blind", ["shard", "check"])[0] == 0


@pytest.mark.parametrize(("name", "writer"), [("ada", "ada"), ("taker", "")])
def test_an_export_needs_no_more_than_the_right_to_read(run, tmp_path, name, writer):
    """Who may not observe the cell gets the data without their causes."""
    path = tmp_path / "all.mcap"
    assert run(name, ["world", "export", "online", "--out", str(path)])[::2] == (0, "")
    versions = [version for commit in Recording(path).commits() for version in commit.versions]
    found = {(one.slot.entity, one.actor) for one in versions}
    assert found == {("open/x", writer), ("secret/x", writer)}


def test_a_recording_has_what_is_readable_and_names_the_rest(cell, tmp_path, monkeypatch):
    """Notices over the network tell of data that the recorder may not read."""
    from enact_dist.recording import Recorder
    from enact_dist.recording.summary import DENIED

    monkeypatch.setenv("ENACT_IDENTITY", "reader")
    with connect(cell.file) as reader, connect(cell.file, actor="ada") as ada:
        writes = [
            Write(ada.world("online"), Entity(name), COUNT) for name in ("open/x", "secret/x")
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


# ---------------------------------------------------------------- acts by hand

BY_HAND = {
    "break": ["lock", "break", "NUMBER", "--shard", "left", "--reason", "camera unplugged"],
    "resolve": ["lock", "resolve", "--force-abort", "NUMBER", "--shard", "left", "--reason", "x"],
    "resolve ": ["lock", "audit", "--acknowledge", "mended", "--shard", "left"],
    "drop": ["world", "drop", "spare"],
}
"""Commands that change a cell, by the right that each needs."""


@contextlib.contextmanager
def held(cell):
    """Fork a world context and yield the number of a lock, which may be broken meanwhile."""
    online = cell.world("online")
    online.fork("spare")
    with contextlib.suppress(LeaseLostError), Lock(Write(online, Entity("x"), COUNT)):
        yield cell.locks()[0].number


@pytest.mark.carrier("auto")
@pytest.mark.parametrize("way", ["zenoh", "socket"])
def test_acts_by_hand_need_their_right_and_leave_a_name(tmp_path, way, monkeypatch, capsys, caplog):
    """A viewer's end with status 1 and change nothing; an operator's are done in its name."""
    cell = guarded_cell(tmp_path, carrier=way)
    caplog.set_level(logging.INFO, "enact")

    def run(name, right, number):
        monkeypatch.setenv("ENACT_IDENTITY", name)
        words = [word.replace("NUMBER", str(number)) for word in BY_HAND[right]]
        with ThreadPoolExecutor() as another:  # this thread holds a lock
            status = another.submit(main, [*words, "--cell", str(cell.file)]).result()
        return status, *capsys.readouterr()

    with cell.running() as shard, connect(cell.file, actor="ada") as ada, held(ada) as number:
        for right in BY_HAND:
            status, out, error = run("reader", right, number)
            assert (status, out) == (1, ""), right
            assert f"enact: reader may not {right.strip()} " in error
        assert len(ada.locks()) == 1
        assert "spare" in ada.worlds()
        assert ada.audit() == ()
        refusals = {(one.identity, one.right): one.count for one in ada.refusals()}
        assert refusals == {("reader", "break"): 1, ("reader", "resolve"): 2, ("reader", "drop"): 1}
        assert shard.host.figures()["permission_denied"] == 4
        for right in ("break", "resolve", "drop"):
            assert f"reader may not {right} " in caplog.text

        done = {right: run("ada", right, number) for right in BY_HAND}
        assert [status for status, *_ in done.values()] == [0, 1, 0, 0]
        assert "is not in doubt" in done["resolve"][2]
        assert "spare" not in ada.worlds()
        (entry,) = ada.audit()
        assert (entry.kind, entry.identity.partition("@")[0]) == ("broken", "ada")
        assert "drops world context 'spare'" in caplog.text
