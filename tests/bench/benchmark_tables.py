"""Write the performance tables of `enact_dist/docs/benchmarks.md` from what was measured: one command, nothing by hand.

    for n in 1 2 3; do enact bench --json > run$n.json; done
    python tests/bench/benchmark_tables.py run1.json run2.json run3.json --peers results --quote old.md

The runs go between the page's `bench` markers, the peers between its `peers` markers.  RESULTS is
the folder of the harness (`peer_enact.py` says how to fill it): one `.jsonl` file per peer.  Peers
that were not measured anew are taken from a Markdown file of the same tables, and marked so.
"""

import argparse
import json
import re
import sys
from pathlib import Path

from enact_dist.bench.rows import shown_us
from enact_dist.bench.tables import table
from enact_dist.errors import MisuseError

PAGE = Path(__file__).parents[2] / "enact_dist" / "docs" / "benchmarks.md"
COLUMNS = (
    # Head, workload, variant, field; title and head of the same column in quoted tables.
    ("update", "W1_update", "1c_distinct", "p50_us", "W1", "1 client p50"),
    ("4 clients, one slot, per s", "W1_update", "4c_shared", "ops_s", "W1", "4c shared"),
    ("4 slots", "W2_multi", "1c_distinct", "p50_us", "W2", "1 client p50"),
    ("fetch 0.9 MB, anew", "W3_fetch_fresh", "0.9MB", "p50_us", "W3", "0.9MB fresh"),
    ("fetch 100 MB, anew", "W3_fetch_fresh", "100MB", "p50_us", "W3", "100MB fresh"),
    ("store 0.9 MB", "W4_store", "0.9MB", "p50_us", "W4", "0.9MB"),
    ("store 100 MB", "W4_store", "100MB", "p50_us", "W4", "100MB"),
    ("pipeline p50", "W5_pipeline", "8cam_10hz", "p50_us", "W5", "e2e p50"),
    ("its CPUs", "W5_pipeline", "8cam_10hz", "cpu_infra", "W5", "infra CPUs"),
    ("its missed ticks", "W5_pipeline", "8cam_10hz", "missed", "W5", "missed of 100"),
    ("wake-up 64 B", "W6_wakeup", "64B", "p50_us", "W6", "64 B p50"),
    ("wake-up 0.9 MB", "W6_wakeup", "0.9MB", "p50_us", "W6", "0.9 MB p50"),
)
GUARANTEES = ("lease", "fencing", "multi", "cross_host")
NONE = "-"


def measured(folder):
    """Return {peer: cells} and {peer: guarantees} of a harness's folder; the last line counts.

    A cell that the harness found disturbed or wrong bears its mark.
    """
    rows, guarantees = {}, {}
    for path in sorted(folder.glob("*.jsonl")):
        for line in path.read_text().splitlines():
            record = json.loads(line)
            peer, workload = record["peer"], record["workload"]
            if workload == "meta":
                guarantees[peer] = record["caps"]
            rows.setdefault(peer, {})[workload, record["variant"]] = record
    if not rows:
        raise MisuseError(f"{folder} has no results (*.jsonl) of a harness")
    cells = {
        peer: [_measured_cell(found.get((w, v)), field) for _, w, v, field, *_ in COLUMNS]
        for peer, found in rows.items()
    }
    return cells, guarantees


def _measured_cell(record, field):
    value = record.get(field) if record else None
    if value is None:
        return NONE
    mark = ("!" if record.get("correct") is False else "") + (
        "~" if record.get("foreign", 0) > 0.35 else ""
    )
    if field.endswith("_us"):
        return shown_us(value) + mark
    return (f"{value:,.0f}" if field == "ops_s" else f"{value:g}") + mark


def quoted(path):
    """Return {peer: cells} of the tables in a Markdown file."""
    tables, title, head = {}, "", []
    for line in path.read_text().splitlines():
        if line.startswith("### "):
            title, head = line[4:], []
        elif line.startswith("| ") and not head:
            head = [cell.strip() for cell in line.strip("| ").split(" | ")]
        elif line.startswith("| "):
            peer, *cells = (cell.strip() for cell in line.strip("| ").split(" | "))
            tables.setdefault((title, peer), dict(zip(head[1:], cells, strict=True)))
    peers = dict.fromkeys(peer for title, peer in tables if title.startswith("W1 "))
    (promises,) = {title for title, _ in tables if title.startswith("What each peer")} or {""}
    return {
        peer: [
            *(_quoted_cell(tables, peer, column) for column in COLUMNS),
            _promises(tables.get((promises, peer), {})),
        ]
        for peer in peers
    }


def _quoted_cell(tables, peer, column):
    *_, field, workload, head = column
    for (title, name), cells in tables.items():
        if name == peer and title.startswith(f"{workload} ") and head in cells:
            cell = cells[head]
            if field.endswith("_us") and re.fullmatch(r"[\d.]+", cell):
                return shown_us(float(cell))
            return re.sub(r"(?<=\d)(ms|s)$", r" \1", cell)
    return NONE


def _promises(found):
    said = (found.get(name, NONE) for name in GUARANTEES)
    return " / ".join({0: "no", 1: "yes"}.get(promise, str(promise)) for promise in said)


def peers_table(folder, old):
    """Return the Markdown of all peers: those measured first, then those quoted."""
    cells, promises = measured(folder) if folder is not None else ({}, {})
    head = ["system", *(column[0] for column in COLUMNS), "lease / fencing / several / other hosts"]
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    rows = [(peer, [*row, _promises(promises.get(peer, {}))]) for peer, row in cells.items()]
    if old is not None:
        rows += [
            (f"{peer} (quoted)", row) for peer, row in quoted(old).items() if peer not in cells
        ]
    lines += [f"| {name} | " + " | ".join(row) + " |" for name, row in rows]
    if old is not None:
        lines += ["", f"Quoted: {old.stem.replace('_', ' ')}, the same kind of machine."]
    return "\n".join(lines) + "\n"


def put(text, name, content):
    """Return `text` with `content` between the markers of that name.

    Raises:
        MisuseError: The markers are not there, once each.
    """
    begin, end = f"<!-- {name} -->", f"<!-- end of {name} -->"
    if (text.count(begin), text.count(end)) != (1, 1) or text.index(begin) > text.index(end):
        raise MisuseError(f"the page needs the lines {begin} and {end}, once each")
    before, rest = text.split(begin)
    return f"{before}{begin}\n{content}{end}{rest.split(end)[1]}"


def main(words):
    """Write the tables; everything is read before anything is written."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("runs", nargs="*", type=Path, help="what `enact bench --json` printed")
    parser.add_argument("--peers", type=Path, metavar="RESULTS", help="folder of the harness")
    parser.add_argument("--quote", type=Path, metavar="FILE", help="Markdown of earlier figures")
    parser.add_argument("--page", type=Path, default=PAGE)
    given = parser.parse_args(words)
    peers = given.peers is not None or given.quote is not None
    if not given.runs and not peers:
        parser.error("nothing to write: name runs, --peers, --quote or several of them")
    try:
        text = given.page.read_text()
        if given.runs:
            text = put(text, "bench", table(given.runs))
        if peers:
            text = put(text, "peers", peers_table(given.peers, given.quote))
    except (MisuseError, OSError) as error:
        print(f"benchmark_tables: {error}", file=sys.stderr)
        return 1
    given.page.write_text(text)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
