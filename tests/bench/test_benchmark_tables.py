"""The tables of the benchmarks page are written by one command, or nothing is."""

import json

import pytest
from benchmark_tables import COLUMNS, NONE, main, measured, quoted

PAGE = """# Title
<!-- bench -->
old
<!-- end of bench -->
between
<!-- peers -->
<!-- end of peers -->
after
"""
QUOTED = """
### W1 update: lock 1 item (us per whole operation)

| peer | 1 client p50 | p99 | 4c shared |
|---|---|---|---|
| redis-lua | 204 | 294 | 2,749 |
| ray | 4045 | 13.9ms | 278 |

### What each peer guarantees (so that)

| peer | lease | fencing | rw | multi | cross_host |
|---|---|---|---|---|---|
| ray | yes | no | yes | ordered locks | yes |

### W6 wake-up: store by A

| peer | 64 B p50 | 0.9 MB p50 |
|---|---|---|
| ray | 11.2ms | - |
"""


@pytest.fixture
def files(tmp_path):
    """Return the page, a folder of results and a file to quote."""
    page, results, old = tmp_path / "benchmarks.md", tmp_path / "results", tmp_path / "of_2026.md"
    page.write_text(PAGE)
    old.write_text(QUOTED)
    results.mkdir()
    records = [
        {"peer": "redis-lua", "workload": "meta", "variant": "caps", "caps": {"lease": 1}},
        {"peer": "redis-lua", "workload": "W1_update", "variant": "1c_distinct", "p50_us": 999.0},
        {"peer": "redis-lua", "workload": "W1_update", "variant": "1c_distinct", "p50_us": 210.0,
         "foreign": 0.5, "correct": True},
        {"peer": "redis-lua", "workload": "W5_pipeline", "variant": "8cam_10hz", "p50_us": 27500.0,
         "cpu_infra": 0.38, "missed": 0, "correct": False},
    ]  # fmt: skip
    (results / "redis.jsonl").write_text("\n".join(map(json.dumps, records)))
    return page, results, old


def column(cells, head):
    return cells[[column[0] for column in COLUMNS].index(head)]


def test_last_measurement_counts_with_its_marks(files):
    """A disturbed figure bears ~, a wrong result !; what was not measured is a dash."""
    cells, guarantees = measured(files[1])

    assert guarantees == {"redis-lua": {"lease": 1}}
    assert column(cells["redis-lua"], "update") == "210 µs~"
    assert column(cells["redis-lua"], "pipeline p50") == "27.5 ms!"
    assert column(cells["redis-lua"], "its missed ticks") == "0!"
    assert column(cells["redis-lua"], "store 0.9 MB") == NONE


def test_earlier_figures_are_quoted_with_their_units(files):
    """Bare numbers are microseconds."""
    cells = quoted(files[2])

    assert column(cells["ray"], "update") == "4.04 ms"
    assert cells["ray"][-1] == "yes / no / ordered locks / yes"
    assert cells["redis-lua"][-1] == "- / - / - / -"
    assert column(cells["ray"], "wake-up 64 B") == "11.2 ms"
    assert column(cells["ray"], "wake-up 0.9 MB") == NONE
    assert column(cells["redis-lua"], "4 clients, one slot, per s") == "2,749"


def test_peers_are_written_between_their_markers(files):
    """What was measured comes first; a quoted row never hides a measured one."""
    page, results, old = files

    assert main(["--peers", str(results), "--quote", str(old), "--page", str(page)]) == 0

    text = page.read_text()
    assert "| redis-lua | 210 µs~ |" in text
    assert "| ray (quoted) | 4.04 ms |" in text
    assert "redis-lua (quoted)" not in text
    assert text.startswith("# Title\n<!-- bench -->\nold\n")
    assert text.endswith("<!-- end of peers -->\nafter\n")


def test_earlier_figures_may_stand_alone(files):
    """Until the project itself was measured beside them."""
    page, _, old = files

    assert main(["--quote", str(old), "--page", str(page)]) == 0

    assert "| redis-lua (quoted) | 204 µs |" in page.read_text()


def test_promises_are_told_in_words(files):
    """What nobody told is a dash."""
    page, results, _ = files

    assert main(["--peers", str(results), "--page", str(page)]) == 0

    (line,) = (line for line in page.read_text().splitlines() if "redis-lua" in line)
    assert line.endswith("| yes / - / - / - |")


def test_nothing_is_written_if_anything_is_wrong(files, capsys):
    """Half a table is worse than the old one."""
    page, results, _ = files

    status = main(["none.json", "--peers", str(results), "--page", str(page)])

    assert status == 1
    assert "none.json cannot be read" in capsys.readouterr().err
    assert page.read_text() == PAGE


def test_readme_without_markers_is_refused(files, capsys):
    """The error says which lines it needs."""
    page, results, _ = files
    page.write_text("# Title\n")

    assert main(["--peers", str(results), "--page", str(page)]) == 1
    assert "<!-- peers -->" in capsys.readouterr().err
