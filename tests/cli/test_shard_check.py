"""`enact shard check`: alive, ready, and what a supervisor may conclude from the status."""

import signal

import pytest

from enact_dist.core.protocol.messages import PlacementMap, ShardEntry
from enact_dist.core.shard.state import ShardSettings
from enact_dist.link.daemon.daemon import start_shard
from enact_dist.link.daemon.settings import DaemonSettings


@pytest.fixture
def shard(write_cell):
    """One shard daemon in this process: (its endpoint, the daemon)."""
    file = write_cell()
    endpoint = file.read_text().split('listen = "')[1].split('"')[0]
    placement = PlacementMap(1, (ShardEntry("left", (endpoint,)),), ())
    running = start_shard(DaemonSettings("c", ShardSettings("left", placement), (endpoint,)))
    yield endpoint, running
    running.stop(drain_s=0.0)


def test_shards_that_grant_locks_are_ready(enact, cell_file):
    """Without a name each shard of the cell is asked; `--json` says how each is."""
    result = enact("shard", "check", "--cell", cell_file, "--json")

    assert result.status == 0
    assert {each["name"]: each["state"] for each in result.json} == {
        "left": "open",
        "right": "open",
    }
    assert all(each["alive"] and each["ready"] and each["epoch"] for each in result.json)


def test_one_shard_is_asked_by_name_or_at_its_endpoint(enact, cell_file, shard):
    """A health check of one container asks for one shard and needs no file for it."""
    by_name = enact("shard", "check", "right", "--cell", cell_file)
    at_endpoint = enact("shard", "check", "--cell", shard[0])

    assert (by_name.status, at_endpoint.status) == (0, 0)
    assert by_name.out.startswith("right: ready (open), epoch ")
    assert at_endpoint.out.startswith("left: ready (open), epoch ")


def test_a_shard_that_ends_is_alive_and_not_ready(enact, shard):
    """No supervisor may kill it for that, and nobody should send it work."""
    endpoint, running = shard
    running.host.drain()

    ready = enact("shard", "check", "--cell", endpoint)
    alive = enact("shard", "check", "--cell", endpoint, "--alive")
    listed = enact("shard", "ls", "--cell", endpoint).out

    assert (ready.status, alive.status) == (1, 0)
    assert "left: alive, not ready (drains)" in ready.out
    assert "drains" in listed


def test_a_check_leaves_no_session_behind(enact, shard):
    """It is called every few seconds, for years."""
    endpoint, running = shard
    assert enact("shard", "check", "--cell", endpoint).status == 0

    assert not running.host._shard.state.sessions.by_id


def test_nobody_there_is_status_3(enact, write_cell):
    """Of a whole cell, each shard that does not answer is named."""
    file = write_cell()

    result = enact("shard", "check", "--cell", file, "--timeout", "0.3", "--alive")
    at_endpoint = enact("shard", "check", "--cell", "tcp/127.0.0.1:9", "--timeout", "0.3")

    assert (result.status, at_endpoint.status) == (3, 3)
    assert "left: unreachable" in result.out
    assert "right: unreachable" in result.out
    assert "enact shard run" in at_endpoint.err


@pytest.mark.slow
def test_a_hung_shard_is_not_alive_and_does_not_hide_the_other(enact, write_cell, spawn, until):
    """Its port is still open and its kernel answers; its dispatcher does not.

    Whoever looks at the whole cell waits for it as long as was said, and no longer.
    """
    file = write_cell()
    shards = [spawn("shard", "run", name, "--cell", file) for name in ("left", "right")]
    for shard in shards:
        until(shard, "ready: shard")
    shards[0].send_signal(signal.SIGSTOP)

    result = enact("shard", "check", "--cell", file, "--json", "--timeout", "5")
    look = enact("world", "ls", "--cell", file, "--timeout", "5")
    shards[0].send_signal(signal.SIGCONT)
    again = enact("shard", "check", "left", "--cell", file)

    assert result.status == 3
    assert {each["name"]: each["alive"] for each in result.json} == {"left": False, "right": True}
    assert look.status == 3
    assert "shard left" in look.err
    assert "did not answer for 5.0 s" in look.err
    assert again.status == 0


def test_a_shard_the_file_does_not_have_is_a_usage_error(enact, cell_file):
    """A misspelt name must not look like a shard that is down."""
    result = enact("shard", "check", "lef", "--cell", cell_file)

    assert result.status == 2
    assert "has no shard 'lef'" in result.err


def test_checks_load_no_tables_and_no_arrays():
    """What is called every 5 s loads Zenoh and the wire, and nothing for people or arrays."""
    import subprocess
    import sys

    code = (
        "import sys; from enact_dist.cli.main import main;"
        "main(['shard', 'check', '--cell', 'tcp/127.0.0.1:9', '--timeout', '0.1']);"
        "print(sorted({'rich', 'numpy', 'open3d', 'enact_dist.access.lock', 'enact_dist.core.shard.shard'}"
        " & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"
