"""What a database has of a shard that is not wanted is deleted by one command."""

import json

import pytest
from shard_stores import state, versions

from enact_dist.cli.main import main
from enact_dist.link.lease import ShardTakenError
from enact_dist.link.offline.database import erase_database, shards_in_database
from enact_dist.link.postgres.address import StoreAddress

LEASE_S = 1.0
LARGE = bytes(70_000)
SIZES = "SELECT (SELECT count(*) FROM enact.record), (SELECT count(*) FROM enact.body)"


@pytest.fixture
def cell(server, tmp_path, shard_name, stores):
    """A cell of two shards with data; returns the address of a shard, and the file."""
    name = f"erased{shard_name}"
    file = tmp_path / "cell.toml"
    shards = "".join(
        f'[shards.{shard}]\nlisten = "tcp/127.0.0.1:{port}"\n'
        for shard, port in (("left", 7441), ("right", 7442))
    )
    file.write_text(f'name = "{name}"\nstore = "{server.url}"\nlease_s = {LEASE_S}\n{shards}')

    def address(shard):
        return StoreAddress(server.url, name, shard, LEASE_S)

    for shard in ("left", "right"):
        store, _, _ = stores.open(address(shard))
        store.write([state(7), state(8, "b", body=LARGE)])
        store.close()
    return address, str(file)


def test_a_shard_goes_with_all_that_it_has_and_the_others_stay(cell, server, stores, capsys):
    """Only with `--yes`; before that the command tells what would go."""
    address, file = cell
    ((records, bodies),) = server.execute(SIZES)

    assert main(["shard", "erase", "left", "--cell", file, "--json"]) == 1
    (listed,) = json.loads(capsys.readouterr().out)["shards"]
    assert server.execute(SIZES) == [(records, bodies)]
    assert main(["shard", "erase", "left", "--yes", "--cell", file]) == 0

    assert listed["shard"] == "left"
    assert server.execute(SIZES) == [(records - listed["rows"], bodies - 1)]
    assert shards_in_database(address("")) == ["right"]
    assert versions(stores.open(address("right"))[1]) == {"a": 7, "b": 8}
    assert versions(stores.open(address("left"))[1]) == {}
    assert main(["shard", "erase", "third", "--yes", "--cell", file]) == 1
    assert "has no shard third" in capsys.readouterr().err


def test_a_shard_that_a_daemon_serves_is_not_erased(cell, stores, capsys):
    """Nor is another one with it; once no daemon serves, the whole cell goes."""
    address, file = cell
    store, _, _ = stores.open(address("left"))
    store.write([state(9)])

    assert main(["shard", "erase", "--yes", "--cell", file]) == 1
    assert "left by process" in capsys.readouterr().err
    assert shards_in_database(address("")) == ["left", "right"]

    store.close()
    assert [each.shard for each in erase_database(address(""))] == ["left", "right"]
    assert shards_in_database(address("")) == []


def test_a_daemon_that_stood_still_writes_nothing_into_an_erased_shard(cell, server, stores):
    """It was taken for gone, as it renewed its lease for too long no more."""
    address, _ = cell
    store, _, medium = stores.open(address("left"))
    medium._renewer._stopped.set()
    medium._renewer._thread.join()
    sizes = server.execute(SIZES)

    erase_database(address(""))
    with pytest.raises(ShardTakenError):
        store.write([state(9)])
    assert server.execute(SIZES) < sizes
    assert shards_in_database(address("")) == []
