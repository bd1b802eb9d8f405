"""`enact world watch --data` and `--stats`: what changes, how often, and how much of it."""

import json
import signal

import numpy as np
import pytest

from enact_dist import Aspect, Entity, Lock, Write, connect
from enact_dist.cli.main import build_parser
from enact_dist.cli.text.rates import WINDOW_S, Rates, Sample, SlotRates
from enact_dist.core.protocol.datum import Slot

POSE = Aspect("pose_mm", list)
IMAGE = Aspect("picture", np.ndarray)
SLOT = Slot("online", "camera/1", "picture")


@pytest.fixture
def commit(cell_file):
    """Set data in the running cell, each in a commit of its own."""
    with connect(cell_file) as cell:
        world = cell.create_world("watched")

        def write(entity, aspect, *data, stamp_ns=0):
            request = Write(world, Entity(entity), aspect)
            for datum in data:
                with Lock(request) as lock:
                    if datum is None:
                        del lock[request]
                    else:
                        lock.put(request, datum, stamp_ns=stamp_ns)

        yield write


@pytest.fixture
def watch(enact, cell_file):
    return lambda *words: enact("world", "watch", "watched", *words, "--cell", cell_file)


def test_data_of_one_line_stand_behind_their_change(watch, commit):
    """As `ros2 topic echo` shows them, and with the version and the time of the commit."""
    commit("arm", POSE, [1.0, 2.0])

    shown = watch("arm", "--data", "--count", "1")

    assert shown.status == 0
    assert shown.out.rstrip().endswith("watched:arm/pose_mm  v1  [1.0, 2.0]")


def test_large_arrays_are_abbreviated_and_nested_data_indented(watch, commit):
    """An image is its shape and range; what would be a long line is one field a line."""
    commit("camera/1", IMAGE, np.arange(600, dtype=np.uint16).reshape(20, 30))
    commit("tool", Aspect("state", dict), {"gripper": {"open": True}, "by": "x" * 80})
    commit("tcp", Aspect("at", dict), {"gripper": {"open": True}, "mm": [1, [2.5]]})

    picture = watch("camera/*", "--data", "--count", "1").out
    state = watch("tool", "--data", "--count", "1").out.splitlines()
    short = watch("tcp", "--data", "--count", "1").out

    assert "v1  array 20 x 30 uint16, 0 to 599\n" in picture
    assert state[0].endswith("watched:tool/state  v1")
    assert state[1:] == ["    gripper:", "      open: True", f"    by: {'x' * 80}"]
    assert short.endswith("watched:tcp/at  v1  {gripper: {open: True}, mm: [1, [2.5]]}\n")


def test_a_text_of_several_lines_is_indented(watch, commit):
    """Its lines are not taken for changes."""
    commit("note", Aspect("text", str), "one\ntwo")

    assert watch("note", "--data", "--count", "1").out.splitlines()[1:] == ["    one", "    two"]


def test_data_as_json(watch, commit):
    """One object a line, the datum and the capture stamp in it."""
    commit("json", POSE, [3.0], stamp_ns=77)

    change = json.loads(watch("json", "--data", "--json", "--count", "1").out)

    assert (change["datum"], change["captured_ns"], change["version"]) == ([3.0], 77, 1)


def test_a_deleted_datum_is_null(spawn, until, commit, cell_file):
    """It has no datum to fetch."""
    commit("gone", POSE, [1.0])
    process = spawn("world", "watch", "watched", "gone", "--data", "--cell", cell_file)
    until(process, "[1.0]")

    commit("gone", POSE, None)

    assert until(process, "v2")[-1].endswith("watched:gone/pose_mm  v2  NULL\n")


def test_a_version_that_is_gone_is_said_to_be_gone(monkeypatch, watch, commit):
    """Nothing else takes its place."""
    commit("late", POSE, [1.0])
    monkeypatch.setattr("enact_dist.cli.world.watch.found_of", lambda *_: {})

    text = watch("late", "--data", "--count", "1").out
    fact = json.loads(watch("late", "--data", "--count", "1", "--json").out)

    assert "v1  (replaced and no longer retained" in text
    assert (fact["datum"], "no longer retained" in fact["datum_missing"]) == (None, True)


@pytest.mark.parametrize("options", [(), ("--data",)])
def test_the_end_says_how_much_there_was(watch, commit, options):
    """On standard error, so that lines in a pipe stay what they are."""
    commit("end", POSE, [1.0])

    shown = watch("end", "--count", "1", *options)

    assert len(shown.out.splitlines()) == 1
    assert shown.err.startswith("watched ")
    assert shown.err.endswith(": 1 changes of 1 data\n")


def test_a_watch_ends_after_so_many_seconds(watch):
    """With nothing to see, too."""
    shown = watch("nothing/**", "--seconds", "0.01")

    assert (shown.status, shown.out) == (0, "")
    assert shown.err.endswith(": 0 changes\n")


def test_rate_size_and_bandwidth(spawn, until, commit, cell_file):
    """What is there at the begin is no change; what comes is counted until the end."""
    zeros = np.zeros(1000, dtype=np.uint8)
    commit("fast", IMAGE, zeros)
    words = ("world", "watch", "watched", "fast", "--stats", "--every", "0.05", "--json")
    process = spawn(*words, "--cell", cell_file)
    until(process, '"changes": 0')

    commit("fast", IMAGE, *[zeros] * 20)
    until(process, '"changes": 20')
    process.send_signal(signal.SIGINT)
    told = json.loads(process.stdout.read().splitlines()[-1])

    assert process.wait(60) == 0
    (row,) = told["data"]
    assert (told["end"], row["changes"], row["missed"], row["size_bytes"]) == (True, 20, 0, 1000.0)
    assert row["bandwidth_bytes_s"] == pytest.approx(row["rate_hz"] * 1000.0)
    assert row["period_min_s"] <= 1.0 / row["rate_hz"] <= row["period_max_s"]


def test_rates_as_a_table(spawn, until, commit, cell_file):
    """One row a datum; the last table is of the whole run."""
    commit("table", POSE, [0.0])
    words = ("world", "watch", "watched", "table", "--stats", "--every", "0.05", "--count", "3")
    process = spawn(*words, "--cell", cell_file)
    until(process, "table/pose_mm")

    commit("table", POSE, [1.0], [2.0], [3.0])
    text = process.stdout.read()

    assert process.wait(60) == 0
    head, columns, row = text.strip().splitlines()[-3:]
    assert head.endswith(": 3 changes of 1 data")
    assert columns.split()[:3] == ["datum", "rate", "period"]
    assert row.split()[0] == "table/pose_mm"
    assert row.split()[2] == "Hz"


def test_data_and_stats_are_two_things(capsys):
    """Lines of data between tables could be read by nobody."""
    with pytest.raises(SystemExit):
        build_parser().parse_args(["world", "watch", "online", "--data", "--stats"])

    assert "not allowed with argument" in capsys.readouterr().err


# ---------------------------------------------------------------- the arithmetic


def at(second, size=100, **more):
    return Sample(int(second * 1e9), more.pop("missed", 0), size, **more)


def test_a_rate_is_that_of_the_commits():
    """However late the watch hears of them, all at once here."""
    rates = Rates()
    for tenth in range(11):
        rates.add(SLOT, at(100 + tenth / 10, 1000 + tenth), 7.0)

    tally = rates.recent(7.0)[SLOT]

    assert tally.rate_hz == pytest.approx(10.0)
    assert (tally.size_bytes, tally.bandwidth_bytes_s) == (1005.0, pytest.approx(10050.0))
    assert (tally.period_min_s, tally.period_max_s) == pytest.approx((0.1, 0.1))
    assert tally.period_std_s == pytest.approx(0.0, abs=1e-6)
    assert tally.delay_s is None


def test_versions_that_were_not_seen_count_into_the_rate_and_not_into_the_period():
    """A watch that misses every other version does not halve the rate."""
    rates = Rates()
    for number in range(5):
        rates.add(SLOT, at(number / 5, missed=1 if number else 0), number / 5)

    tally = rates.whole()[SLOT]

    assert (tally.changes, tally.missed) == (5, 4)
    assert tally.rate_hz == pytest.approx(10.0)
    assert (tally.period_max_s, tally.period_std_s) == (0.0, None)


def test_what_has_stopped_leaves_the_window_and_stays_in_the_whole():
    """The present figures go to none, those of the run do not."""
    rates = Rates()
    rates.there([SLOT])
    rates.add(SLOT, at(1.0, captured_ns=int(0.9e9)), 1.0)
    rates.add(SLOT, at(2.0, captured_ns=int(1.7e9)), 2.0)

    recent = rates.recent(2.1 + WINDOW_S)[SLOT]
    whole = rates.whole()[SLOT]

    assert (recent.changes, recent.rate_hz, recent.size_bytes) == (0, None, 0.0)
    assert (whole.changes, whole.rate_hz) == (2, pytest.approx(1.0))
    assert whole.delay_s == pytest.approx(0.2)


def test_one_change_has_no_rate():
    """Neither in hertz nor in bytes: a rate needs two."""
    rates = Rates()
    rates.add(SLOT, at(1.0), 1.0)

    assert rates.whole()[SLOT].rate_hz is None
    assert rates.whole()[SLOT].bandwidth_bytes_s is None


def test_changes_that_are_never_asked_for_do_not_pile_up():
    """Only those of the window stay; all of them are counted."""
    rates = SlotRates()
    for second in range(1000):
        rates.add(Sample(second * 10**9, 0, 0), float(second))
    assert len(rates._recent) == WINDOW_S + 1
    assert rates.whole.changes == 1000
