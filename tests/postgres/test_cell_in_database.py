"""Entities move, and aspects go, in the database of a stopped cell: as between folders, or not."""

import json
import shutil
from contextlib import closing

import pytest
from rebalance_cells import StoppedCell, placement
from shard_stores import take
from test_rebalance import THREE, TWO, bases, stored

from enact_dist.cli.main import main
from enact_dist.core.protocol.placement import shard_of
from enact_dist.errors import StoreError
from enact_dist.link.offline import database as module
from enact_dist.link.offline.database import forget_database, rebalance_database
from enact_dist.link.offline.forgetting import forget
from enact_dist.link.offline.store_copy import export_store, import_store
from enact_dist.link.postgres.address import StoreAddress

UNIX_S = 1_900_000_000


class DatabaseCell:
    """The shards of a stopped cell, copied to a database."""

    def __init__(self, url, name, cell):
        self.cell, self.folder = cell, cell.folder
        self.address = StoreAddress(url, name, "", 0.5)
        for shard, folder in cell.folders.items():
            import_store(folder, self.place(shard), unix_s=UNIX_S)

    def place(self, shard):
        return StoreAddress(self.address.url, self.address.cell, shard, 0.5)

    def back(self, where, folder):
        """Return a cell of folders with what is in the database now."""
        cell = StoppedCell(folder, where)
        for shard, path in cell.folders.items():
            export_store(self.place(shard), path, unix_s=UNIX_S)
        return cell


@pytest.fixture
def filled(server, tmp_path, shard_name):
    cell = StoppedCell(tmp_path / "origin", TWO)
    cell.fill(4, rounds=12)
    return DatabaseCell(server.url, f"whole{shard_name}", cell)


def rows_of(server, cell):
    """Return all that the database has of a cell, but which epoch and who held it."""
    return server.execute(
        "SELECT name, r.id, kind, r.batch, key, body FROM enact.record r JOIN enact.shard s"
        " ON shard = s.id WHERE cell = %s ORDER BY name, r.id",
        (cell.address.cell,),
    )


def test_entities_move_in_one_transaction_and_back(filled, tmp_path, monkeypatch):
    """With data, history, labels and version floors; a shard that leaves is emptied."""
    waited = []
    monkeypatch.setattr(module, "wait_for_leases", lambda *_: waited.append(1) or 0.0)
    slots, labels, _ = stored(filled.cell)
    started = bases(filled.cell)

    moved = rebalance_database(filled.address, THREE, new=["third"], unix_s=UNIX_S).moves

    assert {move.target for move in moved} == {"third"}
    assert waited
    there = filled.back(THREE, tmp_path / "three")
    found, kept, places = stored(there)
    assert (found, kept, bases(there)) == (slots, labels, started)
    assert places == {entity: {shard_of(entity, THREE)} for entity in places}
    assert not rebalance_database(filled.address, THREE, unix_s=UNIX_S).moves

    moved = rebalance_database(filled.address, TWO, unix_s=UNIX_S).moves
    assert {move.source for move in moved} == {"third"}
    assert stored(filled.back(TWO, tmp_path / "two"))[:2] == (slots, labels)


def test_epochs_rise_above_all_of_before(filled, server, monkeypatch):
    """So fencing numbers of an entity grow on its new shard, too."""
    monkeypatch.setattr(module, "wait_for_leases", lambda *_: 0.0)
    server.execute(
        "UPDATE enact.shard SET epoch = %s WHERE cell = %s AND name = 'left'",
        (UNIX_S + 77, filled.address.cell),
    )
    rebalance_database(filled.address, THREE, new=["third"], unix_s=UNIX_S)
    for shard in ("left", "right", "third"):
        store, recovered, _ = take(filled.place(shard))
        store.close()
        assert recovered.epoch > UNIX_S + 77


class Failing:
    """Ends a run at an act."""

    def __init__(self, at):
        self.at = at

    def act(self, name):
        if name.startswith(self.at):
            raise KeyboardInterrupt

    def moved(self, entities, size):
        pass

    def found(self, found):
        pass


@pytest.mark.parametrize("at", ["open right", "raise", "copy", "forget", "commit"])
def test_a_run_that_is_cut_off_has_changed_nothing(filled, server, monkeypatch, at):
    """Wherever it ends; the shards start as before."""
    monkeypatch.setattr(module, "wait_for_leases", lambda *_: 0.0)
    before = rows_of(server, filled)
    with pytest.raises(KeyboardInterrupt):
        rebalance_database(
            filled.address, THREE, new=["third"], unix_s=UNIX_S, progress=Failing(at)
        )
    assert rows_of(server, filled) == before
    rebalance_database(filled.address, THREE, new=["third"], unix_s=UNIX_S, dry_run=True)
    assert rows_of(server, filled) == before
    take(filled.place("left"))[0].close()


def test_what_stands_in_the_way_is_named(filled):
    """A daemon, and a shard that is not there."""
    with pytest.raises(StoreError, match=r"no data of third.*--new third"):
        rebalance_database(filled.address, THREE, unix_s=UNIX_S)
    with (
        closing(take(filled.place("left"))[0]),
        pytest.raises(StoreError, match=r"daemons serve left by process .*: stop all"),
    ):
        forget_database(filled.address, ["pose"], now_ns=UNIX_S * 10**9)


def test_an_aspect_is_forgotten_as_in_folders(filled, server, tmp_path):
    """All of its data, in all shards together; what is left is the same."""
    copy = StoppedCell(shutil.copytree(filled.folder, tmp_path / "copy"), TWO)
    before = rows_of(server, filled)
    with pytest.raises(KeyboardInterrupt):
        forget_database(
            filled.address, ["pose"], now_ns=UNIX_S * 10**9, progress=Failing("forget on right")
        )
    assert rows_of(server, filled) == before

    found = forget_database(filled.address, ["pose"], now_ns=UNIX_S * 10**9)

    expected = forget(copy.folders, ["pose"], now_ns=UNIX_S * 10**9)
    assert found.going == expected.going
    there = filled.back(TWO, tmp_path / "there")
    assert stored(there) == stored(copy)
    assert not [slot for slot, _ in stored(there)[0] if slot.aspect == "pose"]


def test_the_commands_work_on_the_database_of_the_cell(filled, tmp_path, capsys, server):
    """`--dry-run` lists the changes; without it the command makes them."""
    file = tmp_path / "cell.toml"
    names = [entry.name for entry in placement("left", "right").shards]
    shards = "".join(f'[shards.{n}]\nlisten = "tcp/127.0.0.1:{7440 + len(n)}"\n' for n in names)
    file.write_text(
        f'name = "{filled.address.cell}"\nstore = "{server.url}"\nlease_s = 1.0\n{shards}'
    )
    assert main(["shard", "rebalance", "--cell", str(file)]) == 0
    assert "every entity is where it belongs" in capsys.readouterr().out
    before = rows_of(server, filled)
    assert main(["shard", "forget", "note", "--cell", str(file)]) == 1
    assert "to let it go: enact shard forget note --yes" in capsys.readouterr().err
    assert rows_of(server, filled) == before

    assert main(["shard", "forget", "note", "--yes", "--json", "--cell", str(file)]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["done"]
    assert {each["aspect"] for each in said["going"]} == {"note"}
    assert len(rows_of(server, filled)) < len(before)
