"""A standby takes a shard over from a daemon that was killed, ended or stopped; clients count on."""

import os
import signal
import time
from contextlib import ExitStack

import pytest
from polling import until
from postgres_nodes import await_sync
from replicated_cell import SHARD, Counting, ReplicatedCell
from tcp_proxy import TcpProxy

from enact_dist.cli.main import main
from enact_dist.link.log import READY, STANDS_BY

pytestmark = pytest.mark.slow
CLIENTS = 2
BUSY_S = 6.0
"""Without other load it takes less than 3 s; here the machine does other things, too."""


@pytest.fixture
def cell(pair, tmp_path):
    """A cell in the pair's database, whose daemons end with the test."""
    await_sync(pair[0])
    name = f"cell{os.getpid()}-{time.monotonic_ns()}"
    cell = ReplicatedCell(tmp_path, pair[0].url, os.environ, name=name)
    try:
        yield cell
    finally:
        cell.end()


@pytest.fixture
def clients(cell):
    """Starts counting clients; they end and are checked by `end`."""
    with ExitStack() as started:

        def start():
            found = [Counting(cell.file, number) for number in range(CLIENTS)]
            for client in found:
                started.callback(client._ends.set)
                client.await_after(0.0)
            return found

        yield start


def test_a_standby_takes_over_from_a_killed_daemon(cell, clients):
    """All that was acknowledged is there, and each update counts once; twice, back and forth."""
    active = cell.start(0)
    standby = cell.start(1, says=STANDS_BY)
    counting = clients()
    for place in (0, 1):
        killed_s = active.kill()
        standby.expect(READY)
        served_s = time.monotonic() - killed_s
        first_s = max(client.await_after(killed_s + 1.0) + 1.0 for client in counting)
        print(f"kill -9: serves after {served_s:.2f} s, next update after {first_s:.2f} s")
        assert first_s < BUSY_S
        active, standby = standby, cell.start(place, says=STANDS_BY)
    for client in counting:
        client.end()


def test_a_standby_follows_at_once_on_a_clean_end(cell, clients):
    """SIGTERM frees the shard; no client sees an error."""
    active = cell.start(0)
    standby = cell.start(1, says=STANDS_BY)
    counting = clients()
    active.signal(signal.SIGTERM)
    ended_s = active.wait_ended()
    standby.expect(READY)
    served_s = time.monotonic() - ended_s
    next_s = max(client.await_after(ended_s) for client in counting)
    print(f"SIGTERM: serves {served_s:.2f} s after its end, next update after {next_s:.2f} s")
    assert active.status == 0
    assert served_s < 1.5
    for client in counting:
        client.end()
        assert not client.errors


def test_a_daemon_that_was_stopped_for_long_ends_by_itself(cell, clients):
    """It wakes up, finds that another one serves, answers nothing and leaves with status 1."""
    active = cell.start(0)
    standby = cell.start(1, says=STANDS_BY)
    counting = clients()
    active.signal(signal.SIGSTOP)
    standby.expect(READY)
    for client in counting:
        client.await_after(time.monotonic())
    active.signal(signal.SIGCONT)
    assert active.wait_status(10) == 1
    assert "has another holder" in cell.log(0).read_text()
    for client in counting:
        client.end()


def test_a_daemon_without_its_database_falls_silent_and_goes_on(cell, pair, clients):
    """In the same epoch, once the database confirms again; no standby can take over meanwhile."""
    first, second = pair
    active = cell.start(0)
    standby = cell.start(1, says=STANDS_BY)
    counting = clients()
    second.pause()
    try:
        paused_s = time.monotonic()
        time.sleep(4.0)  # longer than the lease and the wait of a standby
        latest_s = max(client.done_s[-1] for client in counting)
    finally:
        second.go_on()
    assert latest_s - paused_s < 0.5
    back_s = time.monotonic()
    next_s = max(client.await_after(back_s) for client in counting)
    print(f"database silent for 4 s: next update {next_s:.2f} s after it is back")
    await_sync(first)
    assert "answers wait" in cell.log(0).read_text()
    assert "is renewed" in cell.log(0).read_text()
    for client in counting:
        client.end()
    assert active.status is None
    assert standby.status is None


def test_a_takeover_waits_for_the_databases_standby(cell, pair, clients):
    """Its new epoch counts once that has confirmed it: nothing is answered before."""
    active = cell.start(0)
    standby = cell.start(1, says=STANDS_BY)
    counting = clients()
    pair[1].pause()
    try:
        active.kill()
        await_line(cell, 1, "is being taken over")
        before, held_s = [len(client.done_s) for client in counting], time.monotonic()
        time.sleep(2.5)  # longer than the lease of the new epoch
        after = [len(client.done_s) for client in counting]
    finally:
        pair[1].go_on()
    standby.expect(READY)
    for client in counting:
        client.await_after(held_s)
    assert before == after, "an update was acknowledged that stood on one host"
    for client in counting:
        client.end()
    assert standby.status is None
    await_sync(pair[0])


def await_line(cell, place, text):
    until(lambda: text in cell.log(place).read_text(), missed=cell.log(place).read_text)


def test_a_daemon_that_is_cut_off_from_its_database_is_replaced(cell, pair, clients):
    """It falls silent before the standby serves, and ends when it reaches the database again."""
    first, _ = pair
    with TcpProxy(first.port) as proxy:
        port = proxy.endpoint.rpartition(":")[2]
        active = cell.start(0, store=cell.url.replace(f":{first.port}/", f":{port}/"))
        standby = cell.start(1, says=STANDS_BY)
        counting = clients()
        proxy.refuse()
        cut_s = time.monotonic()
        standby.expect(READY)
        served_s = time.monotonic() - cut_s
        for client in counting:
            client.await_after(cut_s + served_s)
        proxy.accept_again()
        assert active.wait_status(15) == 1
    assert "answers wait" in cell.log(0).read_text()
    for client in counting:
        client.end()


def test_commands_say_what_the_database_knows(cell, pair, capsys, monkeypatch):
    """Who serves and who stands by, how many copies there are, and why a shard is silent."""
    cell.start(0)
    cell.start(1, says=STANDS_BY)
    words = ["--cell", str(cell.file)]
    assert main(["doctor", *words]) in {0, 1}
    said = capsys.readouterr().out
    assert "second confirms each commit" in said
    assert f"store of {SHARD}" in said
    assert "stands by" in said
    assert main(["shard", "ls", *words]) == 0
    assert "as its database says" in capsys.readouterr().err
    cell.end()

    assert main(["shard", "check", *words]) == 3
    assert "as its database says" in capsys.readouterr().out


def test_a_takeover_that_the_database_does_not_confirm_ends_when_it_is_told_to(cell, pair):
    """The database's standby is away: the takeover waits, and says so."""
    active = cell.start(0)
    standby = cell.start(1, says=STANDS_BY)
    pair[1].pause()
    try:
        active.kill()
        await_line(cell, 1, "is being taken over")
        standby.signal(signal.SIGTERM)
        assert standby.wait_status(10) == 0
    finally:
        pair[1].go_on()
    await_sync(pair[0])
