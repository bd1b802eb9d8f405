"""Rows that are wrong, missing or cut short in a table: refused, with what was found and what to do."""

import contextlib

import psycopg
import pytest
from shard_stores import address_of, state
from store_damage import CHANGED_ROWS

from enact_dist.errors import StoreError
from enact_dist.link.postgres import bodies

ROW = "(SELECT min(id) FROM enact.record WHERE kind = 5 AND shard = {shard})"
RECORDS = {
    **{f"UPDATE enact.record SET {change} WHERE id = {ROW} AND": "row" for change in CHANGED_ROWS},
    "UPDATE enact.record SET body = substr(body, 1, 9) WHERE kind = 5 AND": "checksum is wrong",
    "UPDATE enact.record SET id = id + 1000, key = key || 'x'::bytea WHERE kind = 5 AND": "row",
    "INSERT INTO enact.record SELECT shard, 7777, kind, batch, key, body, crc FROM enact.record"
    f" WHERE id = {ROW} AND": "row",
    "DELETE FROM enact.record WHERE batch > 2 AND": "its newest row is of batch",
    "DELETE FROM enact.record WHERE": "its newest row is of batch 0, not",
}
BODIES = {
    "UPDATE enact.body SET data = substr(data, 2) WHERE": "bytes instead of",
    "UPDATE enact.body SET data = set_byte(data, 3, 99) WHERE": "its checksum is wrong",
    "UPDATE enact.body SET part = 7 WHERE part = 1 AND": "its checksum is wrong",
    "DELETE FROM enact.body WHERE part = 2 AND": "bytes instead of",
    "DELETE FROM enact.body WHERE": "it is missing",
    "UPDATE enact.body SET name = name || 'x' WHERE": "it is missing",
}
SHARDS = {
    "UPDATE enact.shard SET batch = batch - 1 WHERE": "its newest row is of batch",
    "UPDATE enact.shard SET batch = batch + 1 WHERE": "its newest row is of batch",
    "UPDATE enact.shard SET format = 99 WHERE": "have format 99, this program reads 1",
    "DELETE FROM enact.shard WHERE": "has no row in table enact.shard",
}


def written(stores, address):
    """Fill a shard; return its number."""
    store, _, medium = stores.open(address)
    store.write([state(1, "large", body=bytes(bodies.PART_BYTES) + b"other")])
    store.write([state(1)])
    store.write([state(2)])
    shard = medium._tenure.shard
    store.close()
    return shard


@pytest.mark.parametrize(("damage", "found"), [*RECORDS.items(), *BODIES.items(), *SHARDS.items()])
def test_a_damaged_table_is_refused(server, stores, damage, found):
    """With the name of the shard and what to do, and the shard is free for another try."""
    address = address_of(server.url)
    shard = written(stores, address)
    of = "id" if damage in SHARDS else "shard"
    server.execute(f"{damage} {of} = {{shard}}".format(shard=shard))

    try:
        for _ in range(2):
            with pytest.raises(StoreError, match=found) as refused:
                stores.open(address)
            assert address.shard in str(refused.value)
            assert "restore" in str(refused.value) or "start the version" in str(refused.value)
    finally:
        server.execute("DELETE FROM enact.record WHERE shard = %s", (shard,))
        server.execute("DELETE FROM enact.body WHERE shard = %s", (shard,))


@pytest.mark.parametrize("table", ["shard", "record", "body"])
def test_a_table_that_is_gone_is_refused(server, stores, table):
    """It would be a new and empty one."""
    server.execute(f"CREATE DATABASE without_{table}")
    address = address_of(server.url.removesuffix("postgres") + f"without_{table}")
    written(stores, address)
    with contextlib.closing(psycopg.connect(address.url, autocommit=True)) as connection:
        connection.execute(f"DROP TABLE enact.{table}")

    with pytest.raises(StoreError, match="restore") as refused:
        stores.open(address)

    assert address.shard in str(refused.value)
    found = {"shard": "no row in table", "record": "newest row is of batch 0", "body": "is missing"}
    assert found[table] in str(refused.value)
