"""Probes of both daemons of a shard: who is ready, who is alive, and what a standby's page shows."""

import pytest
from polling import until
from postgres_nodes import await_sync
from probed_cell import ProbedCell, value
from replicated_cell import SHARD
from tcp_proxy import TcpProxy

from enact_dist.cli.main import main
from enact_dist.link.log import READY, STANDS_BY

UNAVAILABLE = 503


@pytest.fixture
def cell(server, tmp_path, shard_name):
    cell = ProbedCell(tmp_path, server.url, f"probed{shard_name}")
    yield cell
    cell.end()


def test_a_standby_is_ready_while_it_sees_its_database_and_alive_without(cell, server):
    """A supervisor restarts neither daemon because the database is away."""
    with TcpProxy(server.port) as proxy:
        port = proxy.endpoint.rpartition(":")[2]
        active = cell.start(0)
        cell.becomes(0, "/ready", 200)
        cell.start(1, says=STANDS_BY, store=server.url.replace(str(server.port), port))
        cell.becomes(1, "/ready", 200)
        _, page = cell.ask(1, "/metrics")
        samples = [line for line in page.splitlines() if not line.startswith("#")]
        assert samples[0].startswith("enact_standby{")
        assert samples[0].endswith(f'shard="{SHARD}"}} 1')
        counted = {line.partition("{")[0]: float(line.split()[-1]) for line in samples[1:]}
        names = ("slow_looks", "reloads", "reloads_refused")
        assert counted == {f"enact_{name}_total": 0 for name in names}

        proxy.refuse()
        cell.becomes(1, "/ready", UNAVAILABLE)
        assert cell.ask(1, "/alive") == (200, "yes\n")
        proxy.accept_again()
        cell.becomes(1, "/ready", 200)

        active.kill()
        cell.daemons[1].expect(READY)
        cell.becomes(1, "/ready", 200)
        _, page = cell.ask(1, "/metrics")
        assert f'shard="{SHARD}"}} 1\n' in page.partition("enact_ready{")[2]
        assert f'shard="{SHARD}"}} 0\n' in page.partition("enact_standby{")[2]
        assert f'shard="{SHARD}"}} 1\n' in page.partition("enact_takeovers_total{")[2]


def test_a_page_shows_copies_the_lease_and_a_stall(pair, tmp_path, shard_name, capsys):
    """A standby that confirms nothing stalls the store; the lease runs out, and comes back."""
    first, second = pair
    await_sync(first)
    cell = ProbedCell(tmp_path, first.url, f"shown{shard_name}")
    try:
        cell.start(0)
        cell.shows(0, "enact_store_copies", lambda copies: copies == 1)
        cell.shows(0, "enact_lease_left_s", lambda left_s: 1.0 < left_s <= 2.0)
        assert main(["shard", "ls", "--counters", "--cell", str(cell.file)]) == 0
        assert "store_copies" in capsys.readouterr().out
        second.pause()
        try:
            cell.shows(0, "enact_store_stalled_s", lambda stalled_s: stalled_s > 0.2)
            cell.shows(0, "enact_lease_left_s", lambda left_s: left_s == 0)
        finally:
            second.go_on()
        cell.shows(0, "enact_store_stalled_s", lambda stalled_s: stalled_s == 0)
        cell.shows(0, "enact_lease_left_s", lambda left_s: left_s > 0)
        assert value(cell.ask(0, "/metrics")[1], "enact_takeovers_total") == 0
    finally:
        cell.end()


def test_slow_looks_of_a_standby_are_counted_logged_and_shown(pair, tmp_path, shard_name, capsys):
    """The database stands still for longer than half the lease."""
    await_sync(pair[0])
    cell = ProbedCell(tmp_path, pair[0].url, f"slow{shard_name}")
    try:
        cell.start(0)
        cell.start(1, says=STANDS_BY)
        pair[0].pause()
        try:
            # Half a lease, and the pause between two looks.
            cell.shows(0, "enact_store_stalled_s", lambda stalled_s: stalled_s > 1.5)
        finally:
            pair[0].go_on()
        cell.shows(1, "enact_slow_looks_total", lambda looks: looks > 0)
        assert "more than half of lease_s (2 s)" in cell.log(1).read_text()

        def said():
            main(["doctor", "--cell", str(cell.file)])
            return capsys.readouterr().out

        until(lambda: "slow looks at its database) stands by" in said(), missed=said)
    finally:
        cell.end()
