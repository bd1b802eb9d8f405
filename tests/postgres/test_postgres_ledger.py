"""A store in PostgreSQL holds what the core's ledger says, as one in a folder does."""

import pickle
from contextlib import closing

import pytest
import store_workload
from hypothesis import given, settings
from shard_stores import address_of, state, take
from store_model import State
from test_store_ledger import BATCHES, at_work

from enact_dist.core.protocol.records import Persist
from enact_dist.errors import StoreError


@pytest.fixture(scope="module")
def url(server):
    return server.url


@settings(deadline=None, max_examples=40)
@given(batches=BATCHES)
def test_store_holds_what_the_ledger_says(url, batches):
    """After each restart, whatever records come in whatever batches; no body is left over."""
    expected, address = State(), address_of(url)
    store, _, medium = take(address)
    try:
        for persists, restarts in (*batches, ((), True)):
            batch = []
            for durability, records in persists:
                for record in records:
                    written = at_work(record, expected)
                    batch.append(Persist(1, (written,), durability))
                    expected = expected.after([(durability, [written])])
            store.write(batch)
            store.rest()
            if restarts:
                store.close()
                store, recovered, medium = take(address)
                assert not expected.difference(recovered)
            stored = medium.line._session.connection.execute(
                "SELECT DISTINCT body.name FROM enact.body JOIN enact.shard ON shard = id"
                " WHERE shard.name = %s",
                (address.shard,),
            )
            named = {blob.name for blob in store._states.blobs.values()}
            assert {name for (name,) in stored} == named
    finally:
        store.close()


@pytest.mark.parametrize("seed", [3, 5, 8])
def test_a_shard_at_work_finds_all_it_promised(url, tmp_path, seed):
    """The seeded work of the tests of the folder: its promises hold over three restarts."""
    expected, address, said = State(), address_of(url), tmp_path / "said"
    for start in range(3):
        unix_s = 1_700_000_000 + start
        store, recovered, _ = take(address, unix_s=unix_s)
        with closing(store):
            assert not expected.opened(unix_s * 10**9).difference(recovered)
            driver = store_workload.Driver(
                None, said, seed * 10 + start, unix_s, (store, recovered)
            )
            driver.run(60)
        expected = expected.opened(unix_s * 10**9)
        with said.open("rb") as file:
            for kind, content in iter(lambda: _next(file), None):
                if kind == "begun":
                    expected = expected.after(content)


def _next(file):
    try:
        return pickle.load(file)
    except EOFError:
        return None


def test_large_bodies_come_back_in_one_piece(url, stores):
    """Of several parts and several messages, with a part that is not full."""
    address = address_of(url)
    store, _, _ = stores.open(address)
    body = bytes(range(256)) * ((20 << 20) // 256) + b"end"
    store.write([state(1, "large", body=body), state(1, "small")])
    store.close()

    _, recovered, _ = stores.open(address)

    data = {record.slot.entity: record.datum for record in recovered.slots}
    assert bytes(data["large"].body) == body
    assert bytes(data["small"].body) == (1).to_bytes(8, "little")


def test_a_database_that_is_not_there_is_named(stores, server):
    """Without the password that the address has."""
    url = server.url.replace("postgres@", "postgres:secret@").removesuffix("postgres") + "nowhere"
    with pytest.raises(StoreError, match=r"nowhere.*createdb") as refused:
        stores.open(address_of(url))
    assert "secret" not in str(refused.value)
