"""`enact shard`: run, drain, list."""

import json
import signal

import pytest

from enact_dist.link.store.store import open_store


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


@pytest.fixture
def no_socket_of_right(write_cell, spawn, until, tmp_path, monkeypatch):
    """The file of a cell whose shard `right` shares another folder, while the socket is forced."""
    file = write_cell()
    monkeypatch.setenv("ENACT_CARRIER", "socket")
    for name in ("left", "right"):
        folder = tmp_path / f"shared-{name}"
        folder.mkdir(mode=0o700)
        monkeypatch.setenv("ENACT_SHARED_FOLDER", str(folder))
        until(spawn("shard", "run", name, "--cell", file), "ready: shard")
    monkeypatch.setenv("ENACT_SHARED_FOLDER", str(tmp_path / "shared-left"))
    return file


@pytest.mark.slow
@pytest.mark.carrier("auto")
def test_forced_socket_that_one_shard_has_not_hides_no_other(enact, no_socket_of_right):
    """Named by the file or by either endpoint: that shard stands there with the reason, status 3."""
    file = no_socket_of_right
    listed = enact("shard", "ls", "--cell", file, "--json")
    shards = {shard["name"]: shard for shard in listed.json}

    assert listed.status == 3
    assert (shards["left"]["reachable"], shards["left"]["carrier"]) == (True, "socket")
    assert shards["right"]["reachable"] is False
    assert "that of shard right cannot be used" in shards["right"]["problem"]
    for target in (file, shards["left"]["endpoint"], shards["right"]["endpoint"]):
        result = enact("shard", "ls", "--cell", target)
        left, right = result.out.splitlines()[1:]
        assert result.status == 3
        assert "open" in left
        assert "UNREACHABLE" in right
        assert result.err == f"enact: shard right: {shards['right']['problem']}\n"
        assert enact("lock", "ls", "--cell", target).status == 3


@pytest.mark.slow
@pytest.mark.carrier("auto")
def test_doctor_names_the_shard_whose_forced_socket_cannot_be_had(enact, no_socket_of_right):
    """One finding says why; the other shard is looked at as usual."""
    result = enact("doctor", "--cell", no_socket_of_right, "--json")
    found = {finding["subject"]: finding for finding in result.json}

    assert result.status == 1
    assert "over socket" in found["shard left"]["text"]
    assert found["shard right"]["level"] == "FAIL"
    assert "that of shard right cannot be used" in found["shard right"]["text"]


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
    del told["files"], told["sha256"], told["modes"]
    (tmp_path / "copy" / "backup.json").write_text(json.dumps(told))
    old = enact("shard", "restore", *words, "--from", "copy", "--folder", "second")

    assert (old.status, old.json["backup"]["digests"]) == (0, False)
    assert "copy was made before backups had digests" in old.err
    (tmp_path / "copy" / "backup.json").write_text(json.dumps({**told, "digest": 1}))
    damaged = enact("shard", "restore", *words, "--from", "copy", "--folder", "third")
    assert damaged.status == 1
    assert "backup.json is damaged" in damaged.err
