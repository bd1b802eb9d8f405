"""`enact world diff` against two real shards: a table for people, JSON and exit status for scripts."""

import itertools
import sys
import threading
import time
from dataclasses import dataclass
from unittest.mock import ANY

import numpy as np
import pytest

from enact_dist import Aspect, Difference, Entity, Lock, Write, connect
from enact_dist.access.reads import slot_of

VOCABULARY = """\
from dataclasses import dataclass

import numpy as np

from enact_dist import Aspect
from enact_dist.comparing import Difference, Tolerance


@dataclass(frozen=True)
class Pose:
    shift_mm: float
    captured_ns: int


POSE = Aspect("pose", Pose, compare=Tolerance(
    fields={"shift_mm": Tolerance(absolute=0.5, unit="mm"), "captured_ns": None}))


def anything(left, right):
    return Difference(0.0)


NUMBER = 5
"""


@dataclass(frozen=True)
class Pose:
    shift_mm: float
    captured_ns: int


POSE, COUNT, IMAGE = Aspect("pose", Pose), Aspect("count", int), Aspect("image", np.ndarray)
NAME = Aspect("name", str)


def put(world, entity, aspect, datum):
    request = Write(world, Entity(entity), aspect)
    with Lock(request) as lock:
        lock[request] = datum
    return lock.position


@pytest.fixture(scope="module")
def cell(cell_file):
    with connect(cell_file, actor="test") as opened:
        training, online = opened.world("training"), opened.world("online")
        for world, shift, stamp in ((training, 0.0, 1), (online, 0.25, 2)):
            put(world, "place/1", POSE, Pose(shift, stamp))
            put(world, "place/2", POSE, Pose(4.0 * shift, stamp))
            put(world, "place/1", COUNT, 7)
        put(training, "place/1", NAME, "milk")
        put(online, "place/2", IMAGE, np.zeros((10, 10)))
        yield opened


@pytest.fixture
def diff(enact, cell, cell_file):
    """Call `enact world diff … --cell FILE`."""
    return lambda *words: enact("world", "diff", *words, "--cell", cell_file)


@pytest.fixture
def with_vocabulary(enact, cell, cell_file, tmp_path, monkeypatch):
    """Call `enact world diff` with a cell.toml that says how `pose` is compared."""
    (tmp_path / "the_vocabulary.py").write_text(VOCABULARY)
    monkeypatch.syspath_prepend(tmp_path)

    def call(target, *words):
        file = tmp_path / "cell.toml"
        file.write_text(f'{cell_file.read_text()}\n[aspects.pose]\ncompare = "{target}"\n')
        return enact("world", "diff", *words, "--trust", "--cell", file)

    return call


def test_table_names_what_differs_and_how(diff):
    """One line for each slot that differs, then what the rest is."""
    done = diff("training", "online")

    lines = [line.split() for line in done.out.splitlines()]
    assert done.status == 4
    assert lines[0] == ["entity", "aspect", "difference", "training", "online"]
    assert lines[1][:5] == ["place/1", "name", "only", "in", "training"]
    assert lines[1][-1] == "-"
    assert lines[2][:4] == ["place/1", "pose", "1", "apart"]
    assert ".captured_ns:" in lines[2]
    assert lines[4][:6] == ["place/2", "pose", "1", "apart", "at", ".shift_mm:"]
    assert done.out.splitlines()[-1] == "2 changed, 1 only in training, 1 only in online, 1 equal"


def test_comparator_of_the_cell_file_decides(with_vocabulary):
    """The aspect that the file names brings its type and its tolerance."""
    done = with_vocabulary(
        "the_vocabulary:POSE", "training", "online", "--aspect", "pose", "--json"
    )

    assert done.status == 4
    assert (done.json["within"], done.json["equal"]) == (1, 0)
    (row,) = done.json["rows"]
    assert (row["entity"], row["where"], row["distance"], row["unit"]) == (
        "place/2",
        ".shift_mm",
        1.0,
        "mm",
    )


def test_comparator_without_a_type_gets_what_is_known(with_vocabulary):
    """A plain function may be named, too."""
    done = with_vocabulary("the_vocabulary:anything", "training", "online", "--aspect", "pose")
    assert (done.status, done.out) == (0, "2 equal\n")


@pytest.mark.parametrize(
    ("target", "said"),
    [
        ("the_vocabulary:NUMBER", "is 5, neither an Aspect nor a comparator"),
        ("the_vocabulary:NOTHING", "no attribute 'NOTHING'"),
        ("no_such_module:POSE", "No module named 'no_such_module'"),
        ("numpy:array_equal", ""),
    ],
)
def test_what_cannot_compare_is_a_usage_error(with_vocabulary, target, said):
    """The line of the file is quoted, with what was found."""
    done = with_vocabulary(target, "training", "online", "--aspect", "count")
    assert done.status == 0, "an aspect that is not compared is not loaded"
    if said:
        done = with_vocabulary(target, "training", "online")
        assert (done.status, said in done.err) == (2, True)
        assert f"[aspects.pose] compare = '{target}'" in done.err


def test_tolerance_of_the_command_line_holds_for_its_aspect(diff, with_vocabulary):
    """It wins over the file's; without a name it holds where there is none."""
    pose = ("training", "online", "--aspect", "pose", "--json")
    assert diff(*pose, "--tolerance", "pose=1").json["within"] == 2
    assert diff(*pose, "--tolerance", "0.9").status == 4
    assert diff(*pose, "--tolerance", "1").status == 0
    named = with_vocabulary("the_vocabulary:POSE", *pose, "--tolerance", "pose=1")
    unnamed = with_vocabulary("the_vocabulary:POSE", *pose, "--tolerance", "1")
    assert (named.status, unnamed.status) == (0, 4)
    unread = with_vocabulary("no_such_module:POSE", *pose, "--tolerance", "pose=1")
    assert unread.status == 0, "what the command line says need not be loaded"
    assert diff(*pose, "--tolerance", "cuont=1").status == 2


def test_tolerance_may_be_a_share(diff, cell):
    """Percent of the larger number."""
    for world, value in (("training", 100.0), ("online", 101.0)):
        put(cell.world(world), "scale", Aspect("weight_kg", float), value)
    asked = ("training", "online", "scale")
    assert diff(*asked, "--tolerance", "1%").status == 0
    assert diff(*asked, "--tolerance", "0.5%").status == 4
    with pytest.raises(SystemExit):
        diff(*asked, "--tolerance", "much")


def test_one_context_at_two_times(diff, cell):
    """A position, as other verbs print it, names a time."""
    online = cell.world("online")
    before = put(online, "clock", COUNT, 1)
    put(online, "clock", COUNT, 5)
    asked = ("online", "online", "clock", "--json")

    done = diff(*asked, "--at1", f"{before.stamp_ns}@{before.shard}")

    assert [(row["left"]["version"], row["right"]["version"]) for row in done.json["rows"]] == [
        (1, 2)
    ]
    assert diff(*asked).json["same"] == 1


def test_many_slots_of_one_side_are_counted(diff, cell):
    """`--all` lists them; what has changed is always listed."""
    for number in range(15):
        put(cell.world("online"), f"view/{number}", COUNT, 1)
    few = diff("training", "online", "view/*").out.splitlines()
    assert few == ["only in online: count 15  (--all lists them)", "15 only in online, 0 equal"]
    assert len(diff("training", "online", "view/*", "--all").out.splitlines()) == 17


def test_equal_contexts_exit_with_0_and_unknown_ones_with_1(diff):
    """A script can tell equal, different and failed apart."""
    assert diff("online", "online").status == 0
    failed = diff("online", "no_such_world")
    assert (failed.status, "no world context 'no_such_world'" in failed.err) == (1, True)


@pytest.fixture
def writer(cell):
    """Eight slots of both contexts, on both shards, that one lock after another sets alike."""
    requests = [
        Write(cell.world(name), Entity(f"sum/{number}"), COUNT)
        for name in ("training", "online")
        for number in range(4)
    ]
    assert len({cell._session.shard_of(slot_of(one)) for one in requests}) == 2
    begun, stop = threading.Event(), threading.Event()

    def write():
        for value in itertools.count():
            with Lock(*requests) as lock:
                for one in requests:
                    lock[one] = value
            begun.set()
            if stop.is_set():
                return

    thread = threading.Thread(target=write)
    thread.start()
    assert begun.wait(60.0)
    yield
    stop.set()
    thread.join()


def test_contexts_are_seen_at_one_moment_over_both_shards(cell, writer):
    """What one lock writes to both contexts, on both shards, never differs in between."""
    training, online = cell.world("training"), cell.world("online")
    diffs = [training.diff(online, "sum/*", COUNT) for _ in range(40)]
    assert [(len(diff), diff.equal) for diff in diffs] == [(0, 4)] * 40


def test_comparing_holds_no_lock_where_there_is_no_cut(cell, cell_file, writer, monkeypatch):
    """Locks that stand in for a cut are given back before the first datum is compared."""
    monkeypatch.setattr("enact_dist.core.client.lock.ROUNDS_MAX", 0)
    held = []

    def looked_at(left, right):
        held.extend(one for one in cell.locks() if one.actor == "watcher")
        return Difference(0.0)

    put(cell.world("training"), "sum/text", NAME, "a")
    put(cell.world("online"), "sum/text", NAME, "b")
    with connect(cell_file, actor="watcher") as other:
        one, two = other.world("training"), other.world("online")
        own = Aspect("name", str, compare=looked_at)
        diffs, ends_s = [], time.monotonic() + 60.0
        while len(diffs) < 20 or not other.statistics().get("views_locked", 0):
            assert time.monotonic() < ends_s, "the writer never came in between"
            diffs.append(one.diff(two, "sum/*", COUNT, own))
    assert {(len(diff), diff.equal) for diff in diffs} == {(0, 5)}
    assert held == []


STRANGE = """
from pathlib import Path
Path({mark!r}).touch()
def compare(left, right):
    raise AssertionError
"""


@pytest.fixture
def strangers(enact, cell, cell_file, tmp_path, monkeypatch):
    """Call `enact world diff` in a stranger's folder, whose cell.toml names a module of its own."""
    monkeypatch.setattr("sys.path", list(sys.path))
    mark = tmp_path / "it ran"
    folder = tmp_path / "theirs"
    for name in ("strange_comparator", "strange_package/comparator"):
        file = folder / f"{name}.py"
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(STRANGE.format(mark=str(mark)))
    monkeypatch.chdir(folder)

    def call(compare, *words, actor=""):
        for name in [one for one in sys.modules if one.startswith("strange_")]:
            del sys.modules[name]
        mark.unlink(missing_ok=True)
        more = f'\n[aspects.pose]\ncompare = "{compare}"\n'
        more += f'[actors.one]\nclass = "{actor}:Actor"\n' if actor else ""
        (folder / "cell.toml").write_text(cell_file.read_text() + more)
        return enact("world", "diff", "online", "online", "--aspect", "pose", *words), mark.exists()

    return call


def test_comparator_in_a_strangers_folder_does_not_run(strangers):
    """To look at a cell runs nothing but what its actors are made of, unless that is asked for."""
    done, ran = strangers("strange_comparator:compare")
    assert (done.status, ran) == (2, False)
    assert "[aspects.pose] compare = 'strange_comparator:compare'" in done.err
    assert "--trust" in done.err
    for other in ("strange_comparator2", "other.strange_comparator"):
        assert strangers("strange_comparator:compare", actor=other)[1] is False

    assert strangers("strange_comparator:compare", "--tolerance", "pose=1")[1] is False
    assert strangers("strange_comparator:compare", "--trust") == (ANY, True)


def test_comparator_beside_an_actor_runs(strangers):
    """In the actor's module or package, which the cell's program is anyway."""
    assert strangers("strange_comparator:compare", actor="strange_comparator")[1]
    assert strangers("strange_package.comparator:compare", actor="strange_package.camera")[1]


def test_file_of_the_working_folder_hides_no_installed_module(strangers, tmp_path):
    """The folder comes last on the path: its `numpy.py` is not the one that is imported."""
    (tmp_path / "theirs" / "mcap.py").write_text("raise SystemExit('hidden')")
    strangers("strange_comparator:compare", "--trust")

    assert sys.path[-1] == str(tmp_path / "theirs")
    assert sys.path[0] != str(tmp_path / "theirs")
