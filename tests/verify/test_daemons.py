"""The processes of a throw-away cell do what its file says."""

import contextlib
import socket

import pytest

from enact_dist.config.read import load_config
from enact_dist.errors import LinkError
from enact_dist.verify.chaos.network.hosts import Loopback
from enact_dist.verify.chaos.watcher import Watcher
from enact_dist.verify.checker import LockOutcome
from enact_dist.verify.daemons import CellProcesses, LineProcess, last_said


@pytest.mark.parametrize("way", ["zenoh", "auto"])
def test_cell_of_a_run_does_as_its_file_says(tmp_path, monkeypatch, way):
    """A figure is over the carrier that it is named after, whatever the user's shell says."""
    shared = tmp_path / "shared"
    monkeypatch.setenv("ENACT_SHARED_FOLDER", str(shared))
    monkeypatch.setenv("ENACT_CARRIER", "socket" if way == "zenoh" else "zenoh")
    monkeypatch.setenv("ENACT_DATA_FOLDER", str(tmp_path / "elsewhere"))
    with CellProcesses(tmp_path, ("s0",), pins={}, ttl_s=1.0, carrier=way) as cell:
        cell.start_shard("s0")

        assert bool(list(shared.glob("*/socket"))) == (way == "auto")
        assert (tmp_path / "data" / "s0").is_dir()


def test_shard_whose_log_is_json_is_waited_for_as_any_other(tmp_path):
    """Whoever runs real daemons need not know what their log looks like."""
    with CellProcesses(tmp_path, ("s0",), pins={}, ttl_s=1.0) as cell:
        words = ("shard", "run", "s0", "--cell", str(cell.file), "--log", "json")
        daemon = LineProcess("enact_dist.cli.main", words, tmp_path / "log")
        try:
            assert daemon.expect("ready:").startswith("shard s0 of cell verify at tcp/127.0.0.1:")
        finally:
            daemon.end()


@contextlib.contextmanager
def cell_of_a_run(folder):
    with CellProcesses(folder, ("s0",), pins={}, ttl_s=1.0) as cell:
        (shard,) = load_config(cell.file).placement_map().shards
        yield shard.endpoints[0]


@contextlib.contextmanager
def hosts_of_a_run(_folder):
    hosts = Loopback(("s0",), why="none is wanted")
    yield hosts.endpoint("s0")
    hosts.close()


@pytest.mark.parametrize("made", [cell_of_a_run, hosts_of_a_run])
def test_port_of_a_shard_is_kept_for_it(tmp_path, made):
    """Before it listens, and while it is killed and started again, nobody else gets its port."""
    with made(tmp_path) as endpoint:
        port = int(endpoint.rpartition(":")[2])
        with socket.socket() as other, pytest.raises(OSError, match="in use"):
            other.bind(("127.0.0.1", port))

    with socket.socket() as other:
        other.bind(("127.0.0.1", port))


def test_last_look_of_a_run_is_taken_again_where_its_lock_was_lost(tmp_path):
    """A machine that lets the watcher wait for longer than a lease shows no fault of the cell."""

    class Look:
        told = iter((LockOutcome.NOT, LockOutcome.UNKNOWN, LockOutcome.COMMITTED))

        def take_all(self):
            return next(self.told)

    class Cell:
        _client = None

    watcher = Watcher(Cell(), tmp_path, ttl_s=1.0, ahead_ns=0)
    watcher._final = Look()

    assert watcher.final() == LockOutcome.COMMITTED.value


def test_process_that_fails_is_told_by_what_was_wrong(tmp_path):
    """One line of its traceback; the rest is with the error, for whoever shows tracebacks."""
    process = LineProcess("timeit", ("raise ValueError('no figure')",), tmp_path / "log")
    try:
        with pytest.raises(LinkError) as found:
            process.expect("ready:")
    finally:
        process.end()

    assert str(found.value).endswith("its log ends with: ValueError: no figure")
    assert "Traceback" in found.value.__notes__[0]


def test_last_thing_said_is_a_line():
    """With a traceback or without, whatever came before it."""
    traceback = "begun\nTraceback (most recent call last):\n  File x\n    y()\n"
    assert last_said(traceback + "enact_dist.errors.LinkError: gone") == "LinkError: gone"
    assert last_said("one\ntwo\n\n") == "two"
    assert last_said("") == ""
