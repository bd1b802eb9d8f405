"""`enact shard`: run, drain, list."""

import json
import signal

import pytest

from enact_dist.link.store import open_store


def test_ls_lists_every_shard(enact, cell_file):
    """Both shards of the cell are open and have an endpoint and an epoch."""
    shards = {
        shard["name"]: shard for shard in enact("shard", "ls", "--cell", cell_file, "--json").json
    }

    assert set(shards) == {"left", "right"}
    assert all(shard["reachable"] and shard["epoch"] > 0 for shard in shards.values())
    assert "left" in enact("shard", "ls", "--cell", cell_file).out


def test_one_endpoint_is_enough_to_find_all_shards(enact, cell_file):
    """The cell can be named by one endpoint instead of its file."""
    endpoint = enact("shard", "ls", "--cell", cell_file, "--json").json[0]["endpoint"]

    assert len(enact("shard", "ls", "--cell", endpoint, "--json").json) == 2


def test_unknown_shard_is_refused_by_name(enact, cell_file):
    """A shard that the file does not have is named before any override is looked at."""
    result = enact("shard", "run", "middle", "--cell", cell_file, "--listen", "tcp/127.0.0.1:1")

    assert result.status == 2
    assert "has no shard 'middle'; it has left, right" in result.err


def test_shard_needs_the_file(enact):
    """An endpoint says nothing about what a shard should be."""
    result = enact("shard", "run", "left", "--cell", "tcp/127.0.0.1:7447")

    assert result.status == 2
    assert "needs the cell.toml" in result.err


@pytest.mark.slow
def test_ls_names_the_shard_that_is_down(enact, write_cell, spawn, until):
    """A shard that does not answer is listed as unreachable, and the status is 3."""
    file = write_cell()
    until(spawn("shard", "run", "left", "--cell", file), "ready: shard")

    result = enact("shard", "ls", "--cell", file)

    assert result.status == 3
    assert "UNREACHABLE" in result.out


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_shard_drains_and_leaves_with_status_0_on_a_signal(write_cell, spawn, until, number):
    """A signal is the ordinary end of a shard."""
    shard = spawn("shard", "run", "left", "--cell", write_cell(), "--folder", "elsewhere")
    ready = until(shard, "ready: shard")[-1]
    shard.send_signal(number)

    assert shard.wait(60) == 0
    assert "elsewhere" in ready


def test_backup_without_digests_is_restored_with_a_warning(enact, write_cell, tmp_path):
    """Whoever has no other one needs it; on standard error, so that JSON stays JSON."""
    open_store(tmp_path / "shard", unix_s=1)[0].close()
    words = ("left", "--cell", str(write_cell()), "--json")
    made = enact("shard", "backup", *words, "--to", "copy", "--folder", "shard")
    assert (made.status, made.json["digests"]) == (0, True)
    whole = enact("shard", "restore", *words, "--from", "copy", "--folder", "first")
    assert (whole.status, whole.err) == (0, "")

    told = json.loads((tmp_path / "copy" / "backup.json").read_text())
    del told["files"], told["sha256"]
    (tmp_path / "copy" / "backup.json").write_text(json.dumps(told))
    old = enact("shard", "restore", *words, "--from", "copy", "--folder", "second")

    assert (old.status, old.json["backup"]["digests"]) == (0, False)
    assert "copy was made before backups had digests" in old.err
    (tmp_path / "copy" / "backup.json").write_text(json.dumps({**told, "digest": 1}))
    damaged = enact("shard", "restore", *words, "--from", "copy", "--folder", "third")
    assert damaged.status == 1
    assert "backup.json is damaged" in damaged.err
