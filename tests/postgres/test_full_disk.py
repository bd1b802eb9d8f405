"""A disk of the database is full: nothing acknowledged is lost, the operator learns it, it goes on."""

import time

import psycopg
import pytest
import small_disk
from polling import until
from probed_cell import ProbedCell
from replicated_cell import Counting

from enact_dist.cli.main import main
from enact_dist.link.log import STANDS_BY

SLOT = "counter/0/count"
pytestmark = [pytest.mark.slow, pytest.mark.sampled(1)]


@pytest.fixture
def full():
    """Give a server and its small disk, by what is on that."""
    if missing := small_disk.why_missing():
        pytest.skip(missing)
    return small_disk.small_server


def use_up(node):
    """Begin one file of the log after the other, until the server stops for want of room."""
    end_s = time.monotonic() + 60
    try:
        while time.monotonic() < end_s:
            node.execute("SELECT pg_switch_wal()")
    except psycopg.OperationalError:
        return
    raise AssertionError("the disk was never full")


@pytest.mark.parametrize("holds", ["wal", "tables"])
def test_a_full_disk_loses_nothing_and_is_named(full, holds, tmp_path, shard_name, capsys):
    """Of the log: the server stops and is started again; of the tables: it refuses to write."""
    with full(holds) as (node, disk):
        cell = ProbedCell(tmp_path, node.url, f"full{shard_name}")
        counting = []
        try:
            active = cell.start(0)
            standby = cell.start(1, says=STANDS_BY)
            counting = [Counting(cell.file, number) for number in range(2)]
            for client in counting:
                client.await_after(0.0)
            disk.fill()
            if holds == "wal":
                use_up(node)
            cell.shows(0, "enact_store_stalled_s", lambda stalled_s: stalled_s > 1.0)
            said = "cannot be reached" if holds == "wal" else "No space left on device"
            assert said in cell.log(0).read_text()
            until(lambda: "commits and new clients wait" in cell.log(0).read_text())
            if holds == "wal":
                assert main(["doctor", "--cell", str(cell.file)]) == 1
                assert "FAIL  store:" in capsys.readouterr().out
                until(lambda: "PANIC" in node.log(), missed=node.log)
            else:  # what needs no writing goes on
                assert main(["world", "get", "online", SLOT, "--cell", str(cell.file)]) == 0
            disk.make_room()
            if holds == "wal":
                until(lambda: not (node.data / "postmaster.pid").exists())
                node.start()
            room_s = time.monotonic()
            for client in counting:
                client.await_after(room_s, 60.0)
            cell.shows(0, "enact_store_stalled_s", lambda stalled_s: stalled_s == 0)
            assert standby.status is None
            assert holds == "wal" or active.status is None
        finally:
            for client in counting:
                client.end()
            cell.end()
