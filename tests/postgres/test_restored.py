"""After a restore of the database, one command begins new epochs."""

import json
import time

import pytest
from shard_stores import state, versions

from enact_dist.cli.main import main
from enact_dist.core.failover.lease import HolderRow
from enact_dist.link.lease import ShardTakenError
from enact_dist.link.postgres.address import FreeShard, ShardHeldError, StoreAddress
from enact_dist.link.postgres.opening import open_database
from enact_dist.link.postgres.restored import raise_epochs

LEASE_S = 1.0


@pytest.fixture
def cell(server, tmp_path, shard_name):
    """A cell of two shards that a database has, and of one that it lacks."""
    name = f"restored{shard_name}"
    shards = "".join(
        f'[shards.{shard}]\nlisten = "tcp/127.0.0.1:{7441 + i}"\n'
        for i, shard in enumerate(("left", "right", "third"))
    )
    file = tmp_path / "cell.toml"
    file.write_text(f'name = "{name}"\nstore = "{server.url}"\nlease_s = {LEASE_S}\n{shards}')
    return lambda shard: StoreAddress(server.url, name, shard, LEASE_S), str(file)


def rows_of(server, address):
    """Return epoch, batch, beat and holder of each shard of a cell."""
    found = server.execute(
        "SELECT name, epoch, batch, beat, holder FROM enact.shard WHERE cell = %s", (address.cell,)
    )
    return {name: HolderRow(*rest) for name, *rest in found}


def test_every_epoch_rises_above_the_clock_and_every_shard_is_free(cell, server, stores, capsys):
    """A daemon that died with the old database is not waited for at the next start."""
    address, file = cell
    for shard, epoch in (("left", 5), ("right", 1 << 40)):
        store, _, _ = stores.open(address(shard), unix_s=epoch)
        store.write([state(7)])
        store.close()
    server.execute("UPDATE enact.shard SET holder = 'gone 17' WHERE cell = %s", (address("").cell,))
    before = rows_of(server, address("left"))

    assert main(["shard", "restored", "--cell", file, "--json"]) == 0

    said = json.loads(capsys.readouterr().out)
    after = rows_of(server, address("left"))
    assert abs(after["left"].epoch - time.time()) < 60
    assert after["right"].epoch == (1 << 40) + 1
    assert said["not_in_database"] == ["third"]
    assert [shard["holder"] for shard in said["shards"]] == ["gone 17", "gone 17"]
    for shard, row in after.items():
        assert row.beat > before[shard].beat
        assert not row.holder
        assert row.batch == before[shard].batch
    _, recovered, _ = stores.open(address("left"))
    assert recovered.epoch == after["left"].epoch + 1
    assert versions(recovered) == {"a": 7}


def test_a_daemon_that_serves_is_in_the_way_until_it_is_fenced(cell, server, stores, capsys):
    """It remembers what the restore took back; with `--fence` it writes nothing more."""
    address, file = cell
    stores.open(address("right"))[0].close()
    store, _, _ = stores.open(address("left"))
    store.write([state(1)])
    untouched = rows_of(server, address("right"))["right"]

    assert main(["shard", "restored", "--cell", file]) == 1
    said = capsys.readouterr().err
    assert "left by process" in said
    assert "--fence" in said
    assert rows_of(server, address("right"))["right"] == untouched

    assert main(["shard", "restored", "left", "--fence", "--cell", file]) == 0
    assert "the shards may start" in capsys.readouterr().out
    assert rows_of(server, address("right"))["right"] == untouched
    with pytest.raises(ShardTakenError):
        store.write([state(2)])


def test_what_is_not_there_is_named(cell, stores, capsys, tmp_path):
    """A shard that the backup lacks, and a cell without a database."""
    address, file = cell
    stores.open(address("left"))[0].close()
    assert main(["shard", "restored", "third", "--cell", file]) == 1
    assert "has no shard third" in capsys.readouterr().err

    other = tmp_path / "other.toml"
    other.write_text('name = "c"\n[shards.left]\nlisten = "tcp/127.0.0.1:7447"\n')
    assert main(["shard", "restored", "--cell", str(other)]) == 2
    assert "names no database" in capsys.readouterr().err


def test_a_standby_that_saw_the_shard_before_takes_nothing(cell, server, stores):
    """Its look is out of date."""
    address, _ = cell
    stores.open(address("left"))[0].close()
    seen = rows_of(server, address("left"))["left"]
    (raised,) = raise_epochs(server.url, address("").cell, ["left"], lease_s=LEASE_S, unix_s=1)
    assert abs(raised.epoch - time.time()) < 60, "the clock of the database counts, too"
    with pytest.raises(ShardHeldError):
        open_database(FreeShard(address("left"), seen), unix_s=1)
