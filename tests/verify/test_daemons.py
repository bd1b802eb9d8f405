"""The processes of a throw-away cell do what its file says."""

import pytest

from enact_dist.verify.daemons import CellProcesses, LineProcess


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
