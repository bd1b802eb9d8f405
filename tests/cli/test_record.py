"""`enact record` and `enact replay`: a running cell into a file and back, ends and errors."""

import dataclasses
import errno
import json
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from enact_dist import Aspect, Entity, Lock, Write, connect
from enact_dist.cli.text import showing
from enact_dist.recording.reading import Recording

COUNT = Aspect("count", int)


@pytest.fixture
def put(cell_file):
    """Set data in the running cell in one commit."""
    with connect(cell_file) as cell:

        def set_them(world, **data):
            context = cell.create_world(world)
            requests = {Write(context, Entity(name), COUNT): n for name, n in data.items()}
            with Lock(*requests) as lock:
                for request, number in requests.items():
                    lock[request] = number

        yield set_them


def test_record_and_replay(enact, cell_file, put, tmp_path):
    """Two shards into a file and from there into a context of another name."""
    put("one", a=1, b=2, c=3, d=4)
    out = tmp_path / "run.mcap"
    done = enact("record", cell_file, "--out", out, "--world", "one", "--seconds", "0.1", "--json")
    assert (done.status, done.json["initial"], done.json["versions"]) == (0, 4, 4)
    assert (done.json["gaps"], done.err) == ({}, "")
    words = ("replay", out, "--into", cell_file, "--world", "one=two", "--speed", "0")
    done = enact(*words, "--json")
    assert (done.status, done.json["versions"], done.json["whole"]) == (0, 4, True)
    found = enact("world", "tree", "two", "--cell", cell_file, "--json").json
    assert [(slot["entity"], slot["version"]) for slot in found] == [
        ("a", 1), ("b", 1), ("c", 1), ("d", 1),
    ]  # fmt: skip
    assert f"{out}: {out.stat().st_size} bytes of cell 'clitest'" in done.err
    assert "sets in cell 'clitest': one as two; aspects count" in done.err
    again = enact(*words)
    assert again.status == 1
    assert "--overwrite" in again.err
    assert "sets in" not in again.err
    again = enact(*words, "--overwrite")
    assert "4 data" in again.out


def test_an_aspect_that_nobody_knows_is_named(enact, cell_file, put, tmp_path):
    """A misspelt name must not look like data that did not change."""
    put("misspelt", a=1)
    words = ("record", cell_file, "--world", "misspelt", "--seconds", "0.1", "--aspect", "count")
    good = enact(*words, "--out", tmp_path / "good.mcap", "--json")
    bad = enact(*words, "--aspect", "coutn", "--out", tmp_path / "bad.mcap")
    assert (good.status, good.json["unknown_aspects"]) == (0, [])
    assert bad.status == 1
    assert "1 versions" in bad.out
    assert "NO ASPECT 'coutn'" in bad.out


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_the_recording_whole(enact, spawn, cell_file, put, tmp_path, until, number):
    """What was committed before it is in the file, which has its end."""
    world = f"signals{number}"
    put(world, a=1)
    out = tmp_path / "run.mcap"
    process = spawn("record", cell_file, "--out", out, "--world", world, "--json")
    while not (out.exists() and out.stat().st_size):
        assert process.poll() is None
    put(world, **dict.fromkeys("abcdefgh", 2))
    process.send_signal(number)
    text = process.stdout.read()
    assert process.wait(60) == 0, text
    summary = json.loads(text)
    done = enact("replay", out, "--into", cell_file, "--world", f"{world}=copy{number}", "--json")
    assert (done.json["whole"], done.json["versions"]) == (True, summary["versions"])
    assert summary["versions"] == 9
    _, commit = Recording(out).commits()
    assert len(commit.versions) == 8
    assert {version.shard for version in commit.versions} == {"left", "right"}


def test_cut_recording_is_said_to_be_cut(enact, cell_file, put, tmp_path):
    """With how much of it is not used."""
    put("cutting", a=1)
    out = tmp_path / "run.mcap"
    enact("record", cell_file, "--out", out, "--world", "cutting", "--seconds", "0.1")
    content = out.read_bytes()
    out.write_bytes(content[: content.index(b"enact.end")])
    done = enact("replay", out, "--into", cell_file, "--world", "cutting=cut")
    assert done.status == 0
    assert "CUT OFF" in done.out


def test_part_of_a_recording_by_time(enact, cell_file, put, tmp_path):
    """Seconds count from the begin; a word that is no time is refused."""
    put("timing", a=1)
    out = tmp_path / "run.mcap"
    enact("record", cell_file, "--out", out, "--world", "timing", "--seconds", "0.1")
    words = ("replay", out, "--into", cell_file, "--world", "timing=timed", "--json")
    assert enact(*words, "--from", "60").json["versions"] == 1
    assert enact(*words, "--from", "2001-01-01T00:00:00", "--overwrite").json["versions"] == 1
    with pytest.raises(SystemExit):
        enact(*words, "--from", "yesterday", "--overwrite")


def test_what_it_shows_can_be_said(enact, cell_file, put, tmp_path):
    """On the command line, or in the cell.toml; an unknown kind is a usage error."""
    put("shown", a=1)
    out = tmp_path / "run.mcap"
    words = ("record", cell_file, "--world", "shown", "--seconds", "0.1", "--out", out)
    refused = enact(*words, "--shows", "count=film")
    assert (refused.status, out.exists()) == (2, False)
    assert "point_cloud" in refused.err
    done = enact(*words, "--shows", "count=image")
    assert "unfit count image: 1" in done.out


def test_export_into_a_file_and_a_folder(enact, cell_file, put, tmp_path):
    """A recording that replays, or files of common formats with an index."""
    put("exported", a=1)
    put("exported", a=2, b=3)
    words = ("world", "export", "exported", "--cell", cell_file, "--json", "--out")
    done = enact(*words, tmp_path / "now.mcap")
    assert (done.status, done.json["data"]) == (0, 2)
    done = enact("replay", tmp_path / "now.mcap", "--into", cell_file, "--world", "exported=again")
    assert (done.status, enact("world", "get", "again", "a/count", "--cell", cell_file).out) == (
        0,
        "2\n",
    )
    done = enact(*words, tmp_path / "folder")
    assert json.loads((tmp_path / "folder" / "b" / "count.json").read_text()) == 3
    index = json.loads((tmp_path / "folder" / "index.json").read_text())
    assert [(each["entity"], each["version"], each["files"]) for each in index] == [
        ("a", 2, ["a/count.json"]),
        ("b", 1, ["b/count.json"]),
    ]
    refused = enact(*words, tmp_path / "folder")
    assert (refused.status, "exists" in refused.err) == (2, True)


def test_export_as_of_a_position(enact, cell_file, put, tmp_path):
    """What was committed later is not in it."""
    put("past", a=1)
    position = enact("world", "history", "past", "a/count", "--cell", cell_file, "--json").json
    stamp_ns = position[-1]["stamp_ns"]
    put("past", a=2, b=2)
    words = ("world", "export", "past", "--at", stamp_ns, "--cell", cell_file, "--json")
    assert enact(*words, "--out", tmp_path / "past.mcap").json["data"] == 1


def test_missing_library_is_named_with_its_extra(cell_file, tmp_path):
    """Who has not installed it is told what to install."""
    code = (
        "import importlib.util as util, sys\n"
        "find = util.find_spec\n"
        "util.find_spec = lambda name, *more: None if name == 'mcap' else find(name, *more)\n"
        "from enact_dist.cli.main import main\n"
        "sys.exit(main(sys.argv[1:]))"
    )
    words = ("record", cell_file, "--out", tmp_path / "run.mcap")
    done = subprocess.run(
        [sys.executable, "-c", code, *map(str, words)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 2, done.stderr
    assert "mcap" in done.stderr
    assert "pip install -e '.[record]' in the clone" in done.stderr


def test_progress_is_shown_on_a_terminal_only(enact, cell_file, put, tmp_path, monkeypatch):
    """One line, written over again and again, and taken away at the end."""
    put("progress", a=1)
    words = ("record", cell_file, "--world", "progress", "--seconds", "0.3", "--out")
    assert enact(*words, tmp_path / "one.mcap").err == ""
    monkeypatch.setattr("sys.stderr.isatty", lambda: True)
    shown = enact(*words, tmp_path / "two.mcap").err
    assert "1 versions" in shown
    assert shown.count("\n") == 0
    assert shown.endswith("\r\033[K")


def test_file_that_is_there_is_kept(enact, cell_file, tmp_path):
    """A recording never takes the place of another one."""
    out = tmp_path / "run.mcap"
    out.write_text("precious")
    done = enact("record", cell_file, "--out", out, "--seconds", "0.1")
    assert (done.status, out.read_text()) == (2, "precious")


def test_export_that_is_refused_leaves_no_folder(enact, cell_file, put, tmp_path):
    """So that asking again, as of another moment, is not refused because of it."""
    put("refused", a=1)
    words = ("world", "export", "refused", "--cell", cell_file, "--out", tmp_path / "folder")
    done = enact(*words, "--at", "9000000000000000000@left")
    assert done.status == 1
    assert enact(*words).status == 0


def test_export_that_fails_halfway_leaves_no_folder(enact, cell_file, put, tmp_path, monkeypatch):
    """A full disk, say: what is there of it would look like the whole."""
    put("halfway", a=1, b=2)
    save, saved = showing.save, []

    def full(value, path):
        if saved:
            raise OSError(errno.ENOSPC, "No space left on device")
        saved.append(path)
        save(value, path)

    words = ("world", "export", "halfway", "--cell", cell_file, "--out", tmp_path / "out" / "now")
    with monkeypatch.context() as patched:
        patched.setattr(showing, "save", full)
        assert enact(*words).status == 1
    assert Path(saved[0]).parent.parent == tmp_path / "out" / "now"
    assert list((tmp_path / "out").iterdir()) == []
    assert enact(*words).status == 0


def test_record_refuses_a_pattern_that_is_none(enact, cell_file, tmp_path, capsys):
    """As a usage error."""
    with pytest.raises(SystemExit) as end:
        enact("record", cell_file, "--out", tmp_path / "run.mcap", "--entities", "[")
    assert end.value.code == 2
    assert "'[' is no pattern of entities" in capsys.readouterr().err


def test_a_replay_of_what_is_chosen(enact, cell_file, put, tmp_path):
    """By the names that choose what is recorded; a context that is called otherwise, too."""
    put("chosen", a=1, b=2)
    put("left_out", a=3)
    out = tmp_path / "run.mcap"
    worlds = ("--world", "chosen", "--world", "left_out")
    enact("record", cell_file, "--out", out, *worlds, "--seconds", "0.1")
    words = ("replay", out, "--into", cell_file, "--world", "left_out=left", "--world")

    done = enact(*words, "chosen", "--entities", "b", "--overwrite", "--json")
    nothing = enact(*words, "chosen=other", "--entities", "c")

    assert (done.status, done.json["versions"], done.json["other_writers"]) == (0, 1, {})
    assert nothing.status == 1
    assert "no recorded data match the options" in nothing.err
    assert "'left'" in enact("world", "tree", "left", "--cell", cell_file).err  # nothing came to it


MODULE = """\
from enact_dist import Actor, Aspect, Entity, World, Write


class Writer(Actor):
    count = Write(World("both"), Entity("a"), Aspect("count", int))
    every_s = 3600.0

    def update(self, lock):
        pass
"""


def test_an_actor_that_writes_the_same_is_named(enact, spawn, until, cell_file, put, tmp_path):
    """On standard error before anything is set, and in the summary."""
    (tmp_path / "writers.py").write_text(MODULE)
    put("both", a=1)
    out = tmp_path / "run.mcap"
    enact("record", cell_file, "--out", out, "--world", "both", "--seconds", "0.1")
    actor = spawn("actor", "run", "writers:Writer", "--cell", cell_file, "--name", "scale")
    until(actor, "ready: actor scale")
    while "both:a/count" not in enact("actor", "ls", "--cell", cell_file, "--json").out:
        assert actor.poll() is None

    done = enact("replay", out, "--into", cell_file, "--overwrite")

    assert done.status == 0
    assert f"enact: actor scale (process {actor.pid} on " in done.err
    assert "also writes both:a/count" in done.err
    assert f"  both:a/count: actor scale (process {actor.pid} on " in done.out


@pytest.mark.parametrize(
    ("entity", "aspect"),
    [("../escaped", "count"), ("/tmp/escaped", "count"), ("x" * 201, "count"), ("a", "../count")],
)
def test_export_makes_no_path_of_a_name_that_is_none(
    enact, cell_file, put, tmp_path, monkeypatch, entity, aspect
):
    """Whatever a shard, or what answers in its place, says: nothing is written outside."""
    from enact_dist.recording import exporting

    put("online", bench=1)
    told = exporting.world_as_of

    def lying(world, at_ns):
        for version in told(world, at_ns):
            slot = version.slot._replace(entity=entity, aspect=aspect)
            yield dataclasses.replace(version, slot=slot)

    monkeypatch.setattr(exporting, "world_as_of", lying)
    before = set(tmp_path.rglob("*"))
    done = enact("world", "export", "online", "--out", tmp_path / "out", "--cell", cell_file)

    assert done.status == 1
    assert "not a valid file name" in done.err
    assert set(tmp_path.rglob("*")) == before
    assert not (tmp_path.parent / "escaped").exists()
