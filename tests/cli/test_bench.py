"""`enact bench`: what it prints, what JSON has, how it ends.  No time is judged here."""

import contextlib
import functools
import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from polling import until

from enact_dist.bench import command
from enact_dist.bench.place import Place
from enact_dist.bench.rows import Row
from enact_dist.bench.run import Answer, Run
from enact_dist.cli import bench
from enact_dist.errors import LinkError, ShardUnreachableError

FIELDS = ["name", "variant", "median_us", "p99_us", "n", "ratio", "goal", "met"]
SHORT = ("--seconds", "0.03")


@pytest.fixture
def one_round(monkeypatch):
    """Measure each case once: what a second round adds is shown by the short benches."""
    monkeypatch.setattr(Run, "measure", functools.partialmethod(Run.measure, rounds=1))


def rows_of(result):
    assert result.status == 0, result.err
    assert set(result.json) == {"machine", "answer", "rows"}
    for row in result.json["rows"]:
        assert list(row)[: len(FIELDS)] == FIELDS
        assert set(row) - set(FIELDS) - {"mb_s", "spread_us"} in (
            set(),
            {"value", "unit"},
            {"note"},
            {"value", "unit", "note"},
        )
        assert row["n"] > 0
        assert (row["median_us"] is None) == ("value" in row)
        assert row["median_us"] is None or 0 < row["median_us"] <= row["p99_us"]
        assert row["met"] in {None, True, False}
        assert (row["goal"] is not None) or row["met"] is None
    return {(row["name"], row["variant"]): row for row in result.json["rows"]}


def test_updates_in_the_process_are_told_as_json(enact):
    """Rows of every durability class beside the floor that divides them."""
    result = enact("bench", "update", "--embedded", "--json", *SHORT)

    rows = rows_of(result)
    floor = rows["floor", "zenoh query"]
    for durability in ("volatile", "os", "durable"):
        row = rows["update", f"embedded, {durability}"]
        assert row["ratio"] == pytest.approx(row["median_us"] / floor["median_us"], rel=0.01)
        assert f"embedded, {durability}, paused" in {variant for _, variant in rows}
    judged = rows["update", "embedded, volatile"]
    assert judged["goal"] == "≤ 120 µs"
    assert judged["met"] is (judged["median_us"] <= 120.0)
    assert result.json["machine"]["cores"] > 0
    assert [one["what"] for one in result.json["answer"]] == ["update", "4 slots"]
    (first, _), row = result.json["answer"], rows["update", "embedded, volatile"]
    assert {name: first[name] for name in ("median_us", "spread_us", "ratio")} == {
        name: row[name] for name in ("median_us", "spread_us", "ratio")
    }
    assert (first["floor"], first["floor_us"]) == ("zenoh query", floor["median_us"])


def test_core_is_a_table_for_people(enact):
    """Names of the columns, the goals in words, and how many are missed."""
    result = enact("bench", "core", *SHORT)

    lines = result.out.splitlines()
    assert result.status == 0
    assert "cores, Python" in lines[0]
    assert lines[1].split()[:2] == ["bench", "variant"]
    (line,) = (line for line in lines if "acquire + commit, one slot" in line)
    assert "≤ 50 µs" in line
    assert line.split()[-1] in {"yes", "NO"}
    (line,) = (line for line in lines if "goals," in line)
    assert line.startswith("2 goals, ")


def test_five_figures_stand_before_the_table(capsys):
    """A line each: here, its rounds, the raw floor of the same run, the ratio."""
    row = Row("wakeup", "64 B", 540.0, 900.0, 600, 20.0, spread_us=(500.0, 610.0))

    machine = {"processor": "P", "cores": 2, "python": "3.11", "load": 0.1}
    command._print(machine, [Answer("wake-up", row, "socket echo", 27.0)], [row])

    _, names, first, empty, head, *_ = capsys.readouterr().out.splitlines()
    assert names.split("  ")[0] == "first of all"
    words = [
        "wake-up",
        "540",
        "µs",
        "500",
        "µs",
        "to",
        "610",
        "µs",
        "socket",
        "echo",
        "27.0",
        "µs",
        "20.00",
    ]
    assert first.split() == words
    assert not empty
    assert head.split()[:4] == ["bench", "variant", "median", "rounds"]


@pytest.mark.slow
@pytest.mark.sampled(1, of="file")
@pytest.mark.usefixtures("one_round")
def test_daemons_and_workers_are_started_and_ended(enact, tmp_path, monkeypatch):
    """Benches between processes, over a throw-away cell of two shards; nothing is left behind."""
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", None)
    words = ("multi", "waiters", "wakeup", "--shards", "2", "--carrier", "zenoh", "--json")
    rows = rows_of(enact("bench", *words, *SHORT))

    assert rows["multi", "zenoh, 1 written on each of 2 shards"]["ratio"] > 0
    assert rows["waiters", "8 threads in 2 processes, hand-over"]["n"] > 1
    assert rows["wakeup", "64 B"]["goal"] == "≤ 0.5 ms"
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_running_cell_is_measured(enact, cell_file):
    """`--connect` writes into a world context of its own, over the carrier that is asked for."""
    words = ("update", "--connect", str(cell_file), "--carrier", "zenoh", "--json")
    rows = rows_of(enact("bench", *words, *SHORT))

    assert rows["update", "zenoh, volatile"]["goal"] == "≤ 2.3 x query"
    found = enact("world", "ls", "--cell", str(cell_file), "--json").json
    assert sorted(row["world"] for row in found) == ["online", "training"]


@pytest.mark.slow
@pytest.mark.sampled(1, of="file")
@pytest.mark.usefixtures("one_round")
def test_payloads_are_fetched_and_published_in_the_process(enact):
    """All sizes, up to 100 MB."""
    rows = rows_of(enact("bench", "fetch", "publish", "--embedded", "--json", *SHORT))

    for key in (("fetch", "embedded, 100 MB"), ("publish", "1 kB"), ("publish", "100 MB")):
        assert rows[key]["ratio"] > 0


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (("updates",), "known: floor, core, update"),
        (("--seconds", "0"), "--seconds"),
        (("--embedded", "--shards", "2"), "not allowed with"),
        (("--carrier", "pigeon"), "pigeon"),
    ],
)
def test_wrong_usage_is_refused(enact, capsys, words, text):
    """Status 2, and what is wrong with the words."""
    with pytest.raises(SystemExit) as left:
        enact("bench", *words)

    assert left.value.code == 2
    assert text in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "status", "text"),
    [
        (("bench", "wakeup", "--embedded"), 1, "wakeup with --embedded: needs several processes"),
        (("bench", "core", "--embedded", "--carrier", "zenoh"), 1, "--carrier zenoh: within one"),
        (("bench", "memory", "--connect", "x"), 1, "memory with --connect: needs daemons of its"),
        (("bench", "multi", "--connect", "no-such-file.toml", *SHORT), 2, "no-such-file.toml"),
    ],
)
def test_bench_that_cannot_run_as_asked_is_refused(enact, words, status, text):
    """A cell that cannot be used is 2, a bench without its processes is 1; each says why."""
    result = enact(*words)

    assert result.status == status
    assert text in result.err


@pytest.mark.parametrize("name", ["multi", "fetch", "pipeline"])
def test_unreachable_cell_is_its_own_status(enact, monkeypatch, name):
    """A cell that does not answer is 3, as everywhere, and no worker is started to find it out."""
    started = []
    monkeypatch.setattr("enact_dist.bench.place.JOIN_S", 0.3)
    monkeypatch.setattr("enact_dist.bench.place.LineProcess", lambda *words: started.append(words))

    result = enact("bench", name, "--connect", "tcp/127.0.0.1:1")

    assert (result.status, started) == (3, [])
    assert "tcp/127.0.0.1:1" in result.err
    assert result.err.count("\n") == 1


def test_workers_join_no_cell_that_this_process_does_not_reach(tmp_path, monkeypatch):
    """Whichever bench starts them, and wherever they seem to be."""
    monkeypatch.setattr("enact_dist.bench.place.JOIN_S", 0.3)
    monkeypatch.setattr("enact_dist.bench.place.LineProcess", None)
    place = Place(tmp_path, target="tcp/127.0.0.1:1", shards=1, carriers=("auto",))

    for started in (place.worker("storer", carrier="auto"), place.far_worker("fetcher")):
        with pytest.raises(ShardUnreachableError), started:
            pass


@pytest.mark.parametrize("words", [("--help",), ("fetch", "--help")])
def test_help_says_of_every_bench_what_it_measures(enact, capsys, words):
    """In the order in which they run, and where they cannot."""
    assert tuple(command.BENCHES) == tuple(bench.BENCHES)
    with pytest.raises(SystemExit) as left:
        enact("bench", *words)

    assert left.value.code == 0
    shown = (
        capsys.readouterr().out.partition("one to three):\n")[2].partition("\n\n")[0].splitlines()
    )
    said = [line.split() for line in shown if line[2] != " "]
    assert [words[0] for words in said] == list(command.BENCHES)
    assert all(len(words) > 4 for words in said)
    text = " ".join(" ".join(shown).split())
    assert text.count("not --embedded") == len(command.BETWEEN_PROCESSES) == 8
    assert text.count("not --connect,") == len(command.OWN_DAEMONS) - 1
    assert "stands still [not --embedded]" in text
    assert max(map(len, shown)) < 100


def test_goal_that_is_missed_is_told_and_is_no_failure(enact, monkeypatch):
    """An honest NO, with status 0."""
    monkeypatch.setattr("enact_dist.bench.cases.decisions.hand_over_us", lambda _seconds_s: [5e3])

    result = enact("bench", "core", "--json", *SHORT)

    row = rows_of(result)["core", "hand-over, 1,000 waiters"]
    assert (row["median_us"], row["met"]) == (5e3, False)


def test_bench_that_breaks_costs_no_row_of_the_others(enact, monkeypatch):
    """Minutes of figures are not lost to the last bench; the status tells that one failed."""

    def broken(_run):
        raise LinkError("the worker has gone")

    monkeypatch.setitem(command.BENCHES, "multi", broken)

    result = enact("bench", "core", "multi", "--json", *SHORT)

    assert result.status == 1
    rows = {(row["name"], row["variant"]): row for row in result.json["rows"]}
    assert rows["core", "acquire + commit, one slot"]["n"] > 0
    failed = rows["multi", "failed"]
    assert (failed["goal"], failed["met"], failed["note"]) == ("runs", False, "the worker has gone")


def test_runs_side_by_side_measure_nothing(enact, tmp_path):
    """`--table` reads what `--json` wrote."""
    result = enact("bench", "core", "--json", *SHORT)
    path = tmp_path / "run1.json"
    path.write_text(json.dumps(result.json))

    shown = enact("bench", "--table", str(path), str(path))

    assert shown.status == 0
    (line,) = (line for line in shown.out.splitlines() if "acquire + commit, one slot" in line)
    assert line.startswith("| core: acquire + commit, one slot | ≤ 50 µs |")


@pytest.mark.slow
def test_bench_that_is_told_to_leave_removes_its_files(tmp_path):
    """Nothing stays on the disk, nor in shared memory, where it would count for good."""
    running = subprocess.Popen(
        [sys.executable, "-m", "enact_dist.cli.main", "bench", "core", "--seconds", "300"],
        env={**os.environ, "TMPDIR": str(tmp_path)},
    )
    try:
        until(lambda: list(tmp_path.glob("enact-bench-*")))
        running.terminate()

        assert running.wait(120) == 1
        assert list(tmp_path.glob("enact-bench-*")) == []
    finally:
        running.kill()
        running.wait()


@pytest.mark.slow
def test_interrupted_bench_says_so_in_one_line(tmp_path):
    """Ctrl-C reaches all its processes, too; a second one, while they end, changes nothing."""
    running = subprocess.Popen(
        [sys.executable, "-m", "enact_dist.cli.main", "bench", "floor", "--seconds", "300"],
        env={**os.environ, "TMPDIR": str(tmp_path)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    try:
        until(lambda: list(tmp_path.glob("enact-bench-*/*socket_echo.log")))
        os.killpg(running.pid, signal.SIGINT)
        until(lambda: not list(tmp_path.glob("enact-bench-*")))
        with contextlib.suppress(ProcessLookupError):
            os.killpg(running.pid, signal.SIGINT)

        assert running.communicate(timeout=120) == (
            "",
            "enact: the bench was interrupted; no figures are printed\n",
        )
        assert running.returncode == 130
    finally:
        running.kill()
        running.wait()


def processes_of(folder, word):
    """Return the processes that have a word and, in another, a folder on their command lines."""
    found = []
    for process in Path("/proc").glob("[0-9]*/cmdline"):
        with contextlib.suppress(OSError):
            words = process.read_bytes().split(b"\0")
            if word in words and any(str(folder).encode() in one for one in words):
                found.append(int(process.parent.name))
    return found


@pytest.mark.slow
def test_daemons_of_a_killed_bench_end(tmp_path):
    """Nobody else would ever stop them: what they share would be used until the next boot."""
    running = subprocess.Popen(
        [sys.executable, "-m", "enact_dist.cli.main", "bench", "waiters", "--seconds", "3"],
        env={**os.environ, "TMPDIR": str(tmp_path)},
    )
    try:
        # There is a worker once its shard serves.
        until(lambda: processes_of(tmp_path, b"enact_dist.bench.worker"), pause_s=0.05)
        assert processes_of(tmp_path, b"shard")
    finally:
        running.kill()
        running.wait()

    try:
        until(lambda: not processes_of(tmp_path, b"shard"), pause_s=0.05)
    finally:
        for pid in processes_of(tmp_path, b"shard"):
            os.kill(pid, signal.SIGKILL)


@pytest.mark.slow
@pytest.mark.sampled(1, of="file")
def test_faults_and_memory_are_rows(enact):
    """A stopped reader, a slot's memory, and deaths; each with its goal."""
    rows = rows_of(enact("bench", "stopped", "memory", "recovery", "--json", *SHORT))

    assert {key: row["goal"] for key, row in rows.items() if key[0] != "floor"} == {
        ("stopped", "update beside a stopped reader of 50 MB"): "adds p99 < 50 ms, max < 150 ms",
        ("memory", "shard, one slot that holds a number"): "≤ 2 kB",
        ("memory", "shard, growth with commits"): "none (≤ 16 bytes)",
        ("recovery", "shard restarted, all clients alive"): "p99 ≤ 0.5 s",
        ("recovery", "holder killed, seen over a network"): "p99 ≤ 2.1 s",
        ("recovery", "holder killed on the shard's host"): "p99 ≤ 0.1 s",
    }
    assert 0 < rows["memory", "shard, one slot that holds a number"]["value"] < 10_000
