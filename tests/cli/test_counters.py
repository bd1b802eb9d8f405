"""Counters: each that a shard or a connection can report is explained in one table."""

import ast
from pathlib import Path

import enact_dist
from enact_dist.core.protocol.messages import ListSessions, PlacementMap, ShardEntry
from enact_dist.core.shard.state import ShardSettings
from enact_dist.errors import LinkError
from enact_dist.link.daemon.counters import OF_A_CONNECTION, OF_A_SHARD, described
from enact_dist.link.memory.payload_client import SharedPayloads
from enact_dist.link.memory.payload_handler import PayloadHandler
from enact_dist.link.opening import open_host

OF_CLIENTS = (
    "client/locks.py",
    "client/kept.py",
    "client/fetch.py",
    "memory/payload_client.py",
    "client/catalogue.py",
    "client/session.py",
    "client/transfer.py",
)
CALLS = {"count", "_count"}
TABLES = {"counters", "_counters"}


def counted(paths):
    """Return the texts with which something is counted in these files."""
    names = set()
    for path in paths:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Call) and node.args:
                called = getattr(node.func, "attr", getattr(node.func, "id", ""))
                first = node.args[0]
                if called in CALLS and isinstance(first, ast.Constant):
                    names.add(first.value)
            elif isinstance(node, ast.AugAssign) and isinstance(node.target, ast.Subscript):
                table = getattr(node.target.value, "attr", getattr(node.target.value, "id", ""))
                if table in TABLES and isinstance(node.target.slice, ast.Constant):
                    names.add(node.target.slice.value)
            elif isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Subscript):
                table, key = node.targets[0].value, node.targets[0].slice
                named = getattr(table, "attr", "").lstrip("_") == "counters"
                if named and isinstance(key, ast.Constant):
                    names.add(key.value)
    return {name for name in names if isinstance(name, str)}


def test_every_counter_of_a_shard_is_explained_and_no_other():
    """The table has what the code counts, what is there now, and nothing that is gone."""
    root = Path(enact_dist.__file__).parent
    of_clients = {root / "link" / name for name in OF_CLIENTS}
    link = [path for path in (root / "link").rglob("*.py") if path not in of_clients]
    now = set(PayloadHandler(None, 1).figures()) | {
        "alarms",
        "audit_left_out",
        "catalogue_left_out",
        "draining",
        "lease_left_s",
        "namesakes",
        "retained_bytes",
        "retained_dropped",
        "store_copies",
        "store_stalled_s",
    }

    found = counted([*(root / "core").rglob("*.py"), *link]) | now

    assert found == set(OF_A_SHARD)


def test_every_counter_of_a_connection_is_explained_and_no_other():
    """As for shards."""
    link = Path(enact_dist.__file__).parent / "link"

    assert counted([link / name for name in OF_CLIENTS]) == set(OF_A_CONNECTION)


def test_counters_of_a_running_shard_are_in_the_table():
    """What a shard answers has no name that only its code knows."""
    answers = []
    placement = PlacementMap(1, (ShardEntry("s0", ("tcp/h:1",)),), ())
    host = open_host(ShardSettings("s0", placement), None)
    host.submit(ListSessions(), answers.append)
    host.close()

    assert {counter.name for counter in answers[0].counters} <= set(OF_A_SHARD)
    assert {"payload_files", "payload_bytes_max"} <= {each.name for each in answers[0].counters}


def test_table_is_shown_in_its_order_without_what_is_zero():
    """A counter of a newer release is shown last, by its name."""
    rows = list(described({"newer": 2, "disk_stalls": 1, "commits": 7, "fenced": 0}))

    assert [row[:2] for row in rows] == [("commits", 7), ("disk_stalls", 1), ("newer", 2)]
    assert "another disk" in rows[1][3]


def test_ls_shows_counters_with_what_they_mean(enact, cell_file):
    """`--counters` prints one line for each that is not 0."""
    with enact_dist.connect(str(cell_file)) as cell:
        counted_here = enact_dist.Aspect("counted", int)
        cell.world("online").init(enact_dist.Entity("counted"), counted_here, 1)

    out = enact("shard", "ls", "--counters", "--cell", cell_file).out

    assert "what to do" in out.splitlines()[0]
    assert OF_A_SHARD["commits"].meaning in out
    assert {line.split()[1] for line in out.splitlines()[1:]} <= set(OF_A_SHARD)


def test_ls_shows_the_counters_of_its_own_connection(enact, cell_file, monkeypatch):
    """Here: of a process in a container that does not share the folder of either shard."""

    def refused(*_):
        raise LinkError("no such folder")

    made = SharedPayloads.__init__
    defaults = made.__kwdefaults__ | {"open_folder": refused}
    monkeypatch.setattr(made, "__kwdefaults__", defaults)

    out = enact("shard", "ls", "--counters", "--cell", cell_file).out

    (row,) = (line for line in out.splitlines() if line.startswith("(this command)"))
    assert row.split()[2:4] == ["payload_folders_elsewhere", "2"]
    assert OF_A_CONNECTION["payload_folders_elsewhere"].meaning in row


def test_every_counter_of_a_connection_stands_in_its_table():
    """A new counter needs a line there."""
    rows = [
        f"| `{name}` | {figure.meaning} | {figure.remedy or '-'} |"
        for name, figure in OF_A_CONNECTION.items()
    ]
    page = Path(enact_dist.__file__).parent / "docs" / "operations.md"

    assert "\n".join(rows) + "\n\n" in page.read_text("utf-8")
