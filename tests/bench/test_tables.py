"""Several runs side by side as Markdown: every row with a goal, nothing guessed."""

import json

import pytest

from enact_dist.bench.tables import table
from enact_dist.errors import MisuseError

MACHINE = {"processor": "some", "cores": 2, "system": "Linux", "python": "3.11", "zenoh": "1",
           "load": 0.1, "date": "2026-01-02"}  # fmt: skip


def row(name="update", variant="one", median_us=100.0, **more):
    return {
        "name": name, "variant": variant, "median_us": median_us, "p99_us": 200.0, "n": 3000,
        "ratio": 1.5, "goal": "≤ 120 µs", "met": True, **more,
    }  # fmt: skip


@pytest.fixture
def written(tmp_path):
    """Return a function that writes runs of these rows and returns their files."""

    def write(*runs):
        paths = []
        for number, rows in enumerate(runs):
            paths.append(tmp_path / f"run{number}.json")
            paths[-1].write_text(json.dumps({"machine": MACHINE, "rows": rows}))
        return paths

    return write


def test_row_with_a_goal_stands_beside_itself_in_each_run(written):
    """Median, 99th percentile, n and ratio of each run, and whether the goal was kept in all."""
    text = table(written([row()], [row(median_us=110.0)], [row(median_us=130.0, met=False)]))

    assert text.splitlines()[0].startswith("some, 2 cores, Linux, Python 3.11, Zenoh 1; 2026-01-02")
    assert (
        "| update: one | ≤ 120 µs | 100 µs (p99 200 µs, n 3,000, 1.50 x) | 110 µs (p99 200 µs, n 3,000, 1.50 x)"
        " | 130 µs (p99 200 µs, n 3,000, 1.50 x) | 2 of 3 |"
    ) in text


@pytest.mark.parametrize(
    ("mets", "said"),
    [
        ((True, True, True), "yes"),
        ((False, False, False), "**no**"),
        ((None, None, None), "not told"),
        ((True, None, False), "1 of 2"),
        ((True, True, None), "yes (2 of 3 runs)"),
    ],
)
def test_goal_is_met_only_if_every_run_says_so(written, mets, said):
    """What a run cannot tell is not counted for either side."""
    text = table(written(*([row(met=met)] for met in mets)))

    assert f"| {said} |" in text


def test_row_that_a_run_lacks_is_an_empty_cell(written):
    """A bench that one run left out does not shift the others."""
    text = table(written([row(), row("memory", "slot")], [row()]))

    assert (
        "| memory: slot | ≤ 120 µs | 100 µs (p99 200 µs, n 3,000, 1.50 x) |  | yes (1 of 2 runs) |"
        in text
    )


def test_missed_row_tells_its_reasons_below(written):
    """Why is part of the table; a note of a row that kept its goal is not."""
    missed = row("pipeline", "missed ticks", None, p99_us=None, ratio=None, value=3, unit="ticks",
                 goal="0", met=False, note="3: late | mostly")  # fmt: skip

    text = table(written([missed, row(note="fine")]))

    assert "| pipeline: missed ticks | 0 | 3 ticks (n 3,000) | **no** |" in text
    assert "- pipeline: missed ticks: 3: late | mostly" in text
    assert "fine" not in text


def test_floors_have_a_table_of_their_own(written):
    """What figures are divided by is shown, without a goal; with its speed where it has one."""
    bare = {"goal": None, "met": None, "ratio": None}
    floors = [row("floor", "zenoh query", **bare), row("floor", "write 10 MB", mb_s=1862.4, **bare)]

    text = table(written([*floors, row(beside="1.93 x 1 kB")]))

    assert "| zenoh query | 100 µs (p99 200 µs, n 3,000) |" in text
    assert "| write 10 MB | 100 µs (p99 200 µs, n 3,000, 1,862 MB/s) |" in text
    assert "| 100 µs (p99 200 µs, n 3,000, 1.50 x, 1.93 x 1 kB) |" in text
    assert "floor: zenoh query" not in text


def test_row_without_a_goal_stands_in_a_second_table(written):
    """What has nothing to keep to is shown, too, once, and is not judged."""
    free = row("waiters", "8 threads", goal=None, met=None)

    text = table(written([row(), free], [row()]))

    judged, others = text.split("| without a goal | run 1 | run 2 |")
    assert "waiters" not in judged
    assert "| waiters: 8 threads | 100 µs (p99 200 µs, n 3,000, 1.50 x) |  |" in others
    assert "update: one" not in others


@pytest.mark.parametrize("content", ["", "[]", '{"rows": []}', '{"machine": {}, "rows": [{}]}'])
def test_file_of_something_else_is_refused(tmp_path, content):
    """The error names the file and the command that makes a right one."""
    path = tmp_path / "odd.json"
    path.write_text(content)

    with pytest.raises(MisuseError, match=r"odd.json .*enact bench --json > odd.json"):
        table([path])


def test_file_that_is_not_there_is_refused(tmp_path):
    """By name."""
    with pytest.raises(MisuseError, match=r"none\.json cannot be read: No such file"):
        table([tmp_path / "none.json"])
