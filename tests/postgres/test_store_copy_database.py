"""A shard moves between folder and database with everything it has, or not at all."""

import json
import os
import pickle
import sqlite3
from contextlib import closing
from dataclasses import replace

import pytest
import store_workload
from replicated_cell import SHARD, ReplicatedCell
from shard_stores import CELL, address_of, state, take, versions
from store_model import State

from enact_dist import Aspect, Entity, Lock, Retention, Write, connect, local
from enact_dist.cli.main import main
from enact_dist.errors import StoreError
from enact_dist.link.lease import ShardTakenError
from enact_dist.link.offline import store_copy
from enact_dist.link.offline.database import erase_database
from enact_dist.link.offline.store_copy import export_store, import_store
from enact_dist.link.postgres.address import StoreAddress
from enact_dist.link.postgres.bodies import PART_BYTES
from enact_dist.link.store.store import open_store

UNIX_S = 1_700_000_000
LARGE = bytes(range(256)) * (2 * PART_BYTES // 256) + b"end"


class Steady(store_workload.Driver):
    """A shard whose clock does not leap by a day; each of its runs begins at the same time."""

    def much_later(self):
        self.later()


def work(opened, expected, said, seed, unix_s):
    """Let a shard work on an opened store; return what it holds then."""
    store, recovered = opened
    with closing(store):
        expected = expected.opened(unix_s * 10**9)
        assert not expected.difference(recovered)
        said.unlink(missing_ok=True)
        Steady(None, said, seed, unix_s, (store, recovered)).run(80)
    with said.open("rb") as file:
        while True:
            try:
                kind, content = pickle.load(file)
            except EOFError:
                return expected
            if kind == "begun":
                expected = expected.after(content)


def folder_rows(folder):
    with closing(sqlite3.connect(folder / "store.db")) as connection:
        return connection.execute("SELECT * FROM record ORDER BY id").fetchall()


def table_rows(server, address):
    return server.execute(
        "SELECT record.id, kind, record.batch, key, body, crc FROM enact.record JOIN enact.shard"
        " ON shard = shard.id WHERE name = %s ORDER BY record.id",
        (address.shard,),
    )


def newest_epoch(server, address):
    ((epoch,),) = server.execute("SELECT epoch FROM enact.shard WHERE name = %s", (address.shard,))
    return epoch


@pytest.mark.parametrize("seed", [4, 9])
def test_a_shard_goes_on_in_the_other_medium_with_all_it_has(server, tmp_path, seed):
    """Data, history, labels, sessions, outcomes, promises and audit, there and back again."""
    first, second, said = tmp_path / "first", tmp_path / "second", tmp_path / "said"
    address = address_of(server.url)
    expected = work(open_store(first, unix_s=UNIX_S), State(), said, seed, UNIX_S)

    copied = import_store(first, address, unix_s=UNIX_S)

    assert table_rows(server, address) == folder_rows(first)
    assert copied.rows == len(folder_rows(first))
    assert copied.bodies
    store, recovered, _ = take(address, unix_s=UNIX_S)
    assert recovered.epoch > copied.epoch > UNIX_S
    expected = work((store, recovered), expected, said, seed + 1, UNIX_S)

    before = newest_epoch(server, address)
    there = {row[1:] for row in table_rows(server, address) if row[1]}
    copied = export_store(address, second, unix_s=UNIX_S)

    assert there <= {row[1:] for row in folder_rows(second)}
    store, recovered = open_store(second, unix_s=UNIX_S)
    assert recovered.epoch > copied.epoch > before
    expected = work((store, recovered), expected, said, seed + 2, UNIX_S)
    assert not expected.difference(reopened(second))


def reopened(folder):
    store, recovered = open_store(folder, unix_s=UNIX_S)
    store.close()
    return recovered


def test_bodies_of_the_other_medium_are_removed_with_their_rows(server, tmp_path):
    """Names of a database, in a folder: also those that a killed shard has left."""
    address, folder = address_of(server.url), tmp_path / "left"
    with closing(take(address)[0]) as store:
        store.write([state(1, "large", body=LARGE), state(1, "other", body=LARGE)])
    export_store(address, folder, unix_s=1)
    names = {path.name for path in (folder / "blobs").iterdir()}
    assert len(names) == 2

    store, recovered = open_store(folder, unix_s=1)
    assert {bytes(record.datum.body) for record in recovered.slots} == {LARGE}
    store.write([state(2, "large")])
    store.rest()
    store.close()
    (left,) = {path.name for path in (folder / "blobs").iterdir()}
    assert left in names
    (folder / "blobs" / left).with_name("abc-9").write_bytes(b"x")
    open_store(folder, unix_s=1)[0].close()
    assert {path.name for path in (folder / "blobs").iterdir()} == {left}


def test_a_served_shard_is_not_copied(server, stores, tmp_path):
    """Neither from a folder in use, nor from or into a database that a daemon uses."""
    address, folder = address_of(server.url, lease_s=0.5), tmp_path / "left"
    with closing(open_store(folder, unix_s=1)[0]), pytest.raises(StoreError, match="in use by"):
        import_store(folder, address, unix_s=1)

    stores.open(address)
    with pytest.raises(StoreError, match="served by process"):
        export_store(address, tmp_path / "out", unix_s=1)
    with pytest.raises(StoreError, match="has data already: epoch"):
        import_store(folder, address, unix_s=1)
    assert not (tmp_path / "out").exists()


def test_a_shard_that_is_taken_during_its_copy_is_not_copied(server, tmp_path, monkeypatch):
    """As after the process was frozen for longer than its lease."""
    address, folder = address_of(server.url), tmp_path / "left"
    take(address)[0].close()

    def freezes(folder):
        server.execute("UPDATE enact.shard SET epoch = epoch + 1 WHERE name = %s", (address.shard,))

    monkeypatch.setattr(store_copy, "sync_all", freezes)
    with pytest.raises(ShardTakenError):
        export_store(address, folder, unix_s=1)
    assert not list(tmp_path.iterdir())


def test_only_empty_places_are_filled(server, tmp_path):
    """What is there is never written over; what is not there is named."""
    address, folder = address_of(server.url), tmp_path / "left"
    with closing(open_store(folder, unix_s=1)[0]) as store:
        store.write([state(1)])
    with pytest.raises(StoreError, match="no data"):
        export_store(address, tmp_path / "out", unix_s=1)
    with pytest.raises(StoreError, match="holds no data of a shard"):
        import_store(tmp_path, address, unix_s=1)
    import_store(folder, address, unix_s=1)
    with pytest.raises(StoreError, match="has data already"):
        import_store(folder, address, unix_s=1)
    erase_database(address, [address.shard])
    assert not table_rows(server, address)
    import_store(folder, address, unix_s=1)
    with pytest.raises(StoreError, match="holds data of a shard"):
        export_store(address, folder, unix_s=1)
    with pytest.raises(StoreError, match="is not empty"):
        export_store(address, tmp_path, unix_s=1)


@pytest.mark.parametrize(
    ("damage", "found"),
    [
        ("UPDATE enact.record SET body = body || 'x'::bytea WHERE kind = 5", "checksum"),
        ("UPDATE enact.body SET data = set_byte(data, 3, 99) WHERE part = 1", "damaged"),
        ("UPDATE enact.body SET name = '../abc' WHERE true", "name"),
        ("DELETE FROM enact.body WHERE part = 2", "missing or damaged"),
    ],
)
def test_damage_is_not_copied_to_a_folder(server, tmp_path, damage, found):
    """Nor does a name lead out of the folder."""
    address, folder = address_of(server.url), tmp_path / "left"
    with closing(take(address)[0]) as store:
        store.write([state(1, "large", body=LARGE)])
    server.execute(
        f"{damage} AND shard = (SELECT id FROM enact.shard WHERE name = '{address.shard}')"
    )
    with pytest.raises(StoreError, match=found):
        export_store(address, folder, unix_s=1)
    assert not list(tmp_path.iterdir())


def test_damage_is_not_copied_to_a_database(server, tmp_path):
    """An older version of a body is damaged, which a start does not look at."""
    address, folder = address_of(server.url), tmp_path / "left"
    with closing(open_store(folder, unix_s=1)[0]) as store:
        store.write([state(1, "large", body=LARGE)])
        newer = state(2, "large")
        record = replace(newer.records[0], history=True)
        store.write([replace(newer, records=(record,))])
    (body,) = (folder / "blobs").iterdir()
    with body.open("r+b") as file:
        file.seek(PART_BYTES + 7)
        file.write(b"\xff\xfe")
    open_store(folder, unix_s=1)[0].close()
    with pytest.raises(StoreError, match="damaged"):
        import_store(folder, address, unix_s=1)
    assert not table_rows(server, address)


def test_a_daemon_serves_what_was_copied(server, tmp_path, shard_name):
    """Clients find history and labels, and go on with the next version."""
    entity, told = Entity("box"), []
    aspect = Aspect("pose", list, retention=Retention(versions=5))
    with local(tmp_path / "folder", worlds=("online",)) as cell:
        world = cell.world("online")
        for number in range(3):
            with Lock(write := Write(world, entity, aspect)) as lock:
                lock[write] = [number]
        before = world.history(entity, aspect)
        cell.pin("kept", before[:1])
        epoch = cell.shards()[0].epoch
    served = ReplicatedCell(tmp_path, server.url, os.environ, name=f"copied{shard_name}")
    place = StoreAddress(server.url, f"copied{shard_name}", SHARD)

    import_store(tmp_path / "folder", place, unix_s=1, tell=lambda *facts: told.append(facts))

    assert told[0][0] == "rows copied"
    assert {what for what, _, _ in told} >= {"rows compared"}
    try:
        served.start(0)
        with connect(served.file, timeout_s=20.0) as cell:
            world = cell.world("online")
            after = world.history(entity, aspect)
            assert [(v.version, v.position.stamp_ns) for v in after] == [
                (v.version, v.position.stamp_ns) for v in before
            ]
            assert [v.version for v in cell.pinned()["kept"]] == [before[0].version]
            assert cell.shards()[0].epoch > epoch
            with Lock(write := Write(world, entity, aspect)) as lock:
                assert lock[write] == [2]
                lock[write] = [3]
            assert world.history(entity, aspect)[-1].version == before[-1].version + 1
    finally:
        served.end()


def test_the_commands_say_what_they_did(server, tmp_path, capsys, shard_name):
    """With numbers, the two places, and from which one to start; `--json` for programs."""
    name = f"copied{shard_name}"
    data, file = tmp_path / "data", tmp_path / "cell.toml"
    file.write_text(
        f'name = "{name}"\ndata_folder = "{data}"\n[shards.left]\nlisten = "tcp/127.0.0.1:7447"\n'
    )
    with closing(open_store(data / "left", unix_s=1)[0]) as store:
        store.write([state(1), state(1, "large", body=LARGE)])
    words = ["left", str(data / "left"), "--cell", str(file)]
    assert main(["shard", "import-store", *words]) == 2
    assert "names no database" in capsys.readouterr().err
    secret = server.url.replace("postgres@", "postgres:secret@")
    assert main(["shard", "import-store", *words, "--store", secret]) == 1
    said = capsys.readouterr().err
    assert "every user of this host can see the password" in said
    assert "secret" not in said

    assert main(["shard", "import-store", *words, "--store", server.url, "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert (said["entities"], said["states"], said["bodies"]) == (2, 2, 1)
    assert said["size"] == len(LARGE)

    words[1] = str(tmp_path / "out")
    assert main(["shard", "export-store", *words, "--store", server.url]) == 0
    said = capsys.readouterr().out
    assert "2 entities with 2 versions" in said
    assert f"in {tmp_path / 'out'}, compared" in said
    assert "from one of the two only" in said
    assert versions(reopened(tmp_path / "out")) == {"a": 1, "large": 1}
    assert CELL not in said
