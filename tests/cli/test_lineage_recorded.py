"""`enact why` and `enact impact` of a recording: the trees of the cell, and no cell."""

import threading
from pathlib import Path

import pytest

from enact_dist import Aspect, Entities, Entity, Lock, Read, ViewEach, Write, connect
from enact_dist.recording import Recorder
from enact_dist.recording.file import RecordingFile
from enact_dist.recording.reading import Recording

COUNT, SUM = Aspect("count", int), Aspect("sum", int)
FORMAT_1 = Path(__file__).parents[1] / "e2e" / "stored_before" / "recording.mcap"


def written(cell):
    """Views 0 to 3 make a model in another world context, and that two verdicts."""
    training, online = cell.world("training"), cell.world("online")
    for number in range(4):
        view = Write(training, Entity(f"view/{number}"), COUNT)
        with Lock(view) as lock:
            lock.put(view, number, stamp_ns=1)
    views, model = (
        ViewEach(training, Entities("view/*"), COUNT),
        Write(training, Entity("milk"), SUM),
    )
    with Lock(views, model) as lock:
        lock[model] = sum(lock[views].values())
    read, verdict = Read(training, model.entity, SUM), Write(online, Entity("system"), SUM)
    for _ in range(2):
        with Lock(read, verdict) as lock:
            lock[verdict] = lock[read] + lock.get(verdict, 0)


@pytest.fixture(scope="module")
def run(cell_file, tmp_path_factory):
    """A recording of all of it; the cell still runs."""
    path = tmp_path_factory.mktemp("recorded") / "run.mcap"
    with connect(cell_file, actor="tester") as cell:
        stop, begun = threading.Event(), threading.Event()
        recorder = Recorder(cell, path, chunk_s=0.01)
        options = {"tell": lambda _: begun.set()}
        thread = threading.Thread(target=recorder.run, args=(stop,), kwargs=options)
        thread.start()
        try:
            assert begun.wait(60)
            written(cell)
        finally:
            stop.set()
            thread.join(60)
    return path


def ageless(tree):
    """Return a tree without ages: a cell counts them to now, a recording to its end."""
    return {**tree, "age_s": 0.0, "children": [ageless(child) for child in tree["children"]]}


def places(lines):
    """Return what the lines of a tree name, with their indents."""
    return [line.partition(" ago")[0].rpartition("  ")[0] for line in lines]


@pytest.mark.parametrize(
    "words",
    [
        ("why", "online", "system/sum"),
        ("why", "online", "system/sum@1", "--depth", "1"),
        ("why", "online", "system/sum", "--all"),
        ("impact", "training", "view/3/count"),
        ("impact", "training", "view/3/count@1", "--depth", "2"),
    ],
)
def test_trees_are_those_of_the_cell(enact, run, cell_file, words):
    """Over two world contexts and two shards, as text and as JSON."""
    asked = (*words, "--cell", cell_file)
    found = enact(*words, "--recording", run)
    assert (found.status, found.err) == (0, "")
    assert places(found.out.splitlines()) == places(enact(*asked).out.splitlines())
    tree = enact(*words, "--recording", run, "--json").json
    assert ageless(tree) == ageless(enact(*asked, "--json").json)
    assert tree["children"]


def test_ages_count_to_the_end_of_the_recording(enact, run):
    """So the same question has the same answer, whenever it is asked."""
    newest = enact("why", "online", "system/sum", "--recording", run, "--json").json
    assert newest["age_s"] == 0.0
    assert newest["children"][0]["age_s"] > 0.0


@pytest.mark.parametrize(
    ("words", "status", "text"),
    [
        (("why", "onlin", "system/sum"), 1,
         "no world context 'onlin'; did you mean 'online'? (it has online, training)"),
        (("why", "online", "sytem/sum"), 1,
         "has no version of online:sytem/sum; did you mean 'system/sum'?; enact view"),
        (("impact", "training", "view/3/cuont"), 1, "did you mean 'view/3/count'?"),
        (("impact", "online", "system/sum@9"), 1,
         "version 9 of online:system/sum; of the 2 that it has the oldest is 1, the newest 2"),
        (("why", "online", "system/sum", "--pin", "x"), 2, "--pin keeps versions in a cell"),
        (("why", "online", "system/sum", "--cell", "tcp/robot:7447"), 2, "--cell and --recording"),
        (("why", "online", "system/sum", "--depth", "300"), 1, "depth is 300"),
    ],
)  # fmt: skip
def test_what_is_not_there_is_refused(enact, run, words, status, text):
    """The error names what was asked, what there is, and what may have been meant."""
    done = enact(*words, "--recording", run)
    assert (done.status, text in done.err) == (status, True), done.err


def test_a_file_that_is_no_recording_is_named(enact, tmp_path):
    """One that is missing, one that is no MCAP file, and one of format 1, with the writer."""
    text = tmp_path / "notes.mcap"
    text.write_text("not a recording")
    ask = ("why", "online", "system/sum", "--recording")
    assert enact(*ask, tmp_path / "none.mcap").err.endswith(
        "none.mcap: No such file or directory\n"
    )
    assert enact(*ask, text).err.endswith("notes.mcap is no MCAP file\n")
    (commit, *_) = Recording(FORMAT_1).commits()
    world, entity, aspect = commit.versions[0].slot
    for way in ("why", "impact"):
        done = enact(way, world, f"{entity}/{aspect}", "--recording", FORMAT_1)
        assert "is a recording of format 1, which names no causes" in done.err
        assert "its cause is not known, " in done.err
        assert done.status == 1


def copied(run, path):
    """Write the commits of a recording into another file; return that one, open."""
    file = RecordingFile(path, {}, aspects=lambda _: None, shows=None)
    for commit in Recording(run).commits():
        file.add_commit(commit.versions, commit.log_ns)
    file.end_chunk()
    return file


def test_what_the_file_lacks_is_said_beside_the_tree(enact, run, tmp_path):
    """Versions that were not recorded, and what follows the last whole chunk."""
    cut, gaps = tmp_path / "cut.mcap", tmp_path / "gaps.mcap"
    copied(run, cut).abandon()
    with cut.open("ab") as stream:
        stream.write(b"\x06" + (1 << 20).to_bytes(8, "little") + b"begun")
    copied(run, gaps).close({"missing": "7"})
    for path, lacking in (
        (cut, f"{cut} was cut off: 14 bytes after its last whole chunk were not used"),
        (gaps, f"7 versions were missing when {gaps} was recorded"),
    ):
        done = enact("impact", "training", "view/0/count", "--recording", path, "--json")
        assert (done.status, done.err) == (0, f"enact: {lacking}\n")
        assert done.json["children"]
