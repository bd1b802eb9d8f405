"""The database's primary goes, and its standby is promoted: the store goes on in the same epoch."""

import threading
import time

import postgres_nodes
import pytest
from shard_stores import address_of, state, versions

from enact_dist.errors import StoreError
from enact_dist.link.postgres.line import CLOSE_S


@pytest.fixture
def nodes():
    """A pair of the test's own, for it ends otherwise than it began."""
    with postgres_nodes.two_nodes() as nodes:
        yield nodes


def both(nodes):
    hosts = ",".join(f"127.0.0.1:{node.port}" for node in nodes)
    return f"postgresql://{postgres_nodes.USER}@{hosts}/postgres"


def failing_write(store):
    """Begin a write that waits for the standby; return its thread, and where its error will be."""
    failed = []

    def write():
        with pytest.raises(StoreError) as found:
            store.write([state(2)])
        failed.append(found.value)

    writer = threading.Thread(target=write)
    writer.start()
    writer.join(0.3)
    return writer, failed


def test_a_store_goes_on_at_the_promoted_standby(nodes, stores):
    """A commit that was under way is there once; what was acknowledged is there."""
    first, second = nodes
    address = address_of(both(nodes), lease_s=60.0)
    store, recovered, medium = stores.open(address)
    for version in range(1, 20):
        store.write([state(version)])
    first.stop("immediate")
    done = []
    writer = threading.Thread(target=lambda: done.append(store.write([state(20)])))
    writer.start()
    writer.join(0.5)
    assert not done
    second.promote()
    writer.join(30)
    assert done == [None]
    store.write([state(21, body=bytes(70_000))])
    store.close()

    _, again, _ = stores.open(address)
    assert again.epoch == recovered.epoch + 1
    assert versions(again) == {"a": 21}
    assert medium.line.reconnects >= 1


def test_a_server_that_hangs_is_left_for_the_promoted_one(nodes, stores):
    """Its processes stand still, and its host answers for it: no connection breaks."""
    first, second = nodes
    address = address_of(both(nodes), lease_s=60.0)
    store, recovered, medium = stores.open(address)
    store.write([state(1)])
    first.pause()
    try:
        second.promote()
        store.write([state(2)])
        assert medium.line.reconnects >= 1
        store.close()
    finally:
        first.go_on()
        first.stop("immediate")

    _, again, _ = stores.open(address)
    assert again.epoch == recovered.epoch + 1
    assert versions(again) == {"a": 2}


def test_a_store_ends_in_time_without_an_answer_of_its_database(pair, stores):
    """A commit that waits for the standby is not acknowledged, and keeps no daemon from its end."""
    second = pair[1]
    address = address_of(pair[0].url, lease_s=60.0)
    store, _, medium = stores.open(address)
    store.write([state(1)])
    second.pause()
    try:
        writer, failed = failing_write(store)
        asked_s = time.monotonic()
        medium.end_soon()
        writer.join(20)
        store.close()
        took_s = time.monotonic() - asked_s
    finally:
        second.go_on()
    assert "the shard ends" in str(failed[0])
    assert CLOSE_S <= took_s < CLOSE_S + 5
    postgres_nodes.await_sync(pair[0])


def test_a_store_that_ends_waits_for_no_second_connection(pair, stores, monkeypatch):
    """Its connection was lost as it was told to end, and the database's standby is away."""
    first, second = pair
    address = address_of(first.url, lease_s=60.0)
    store, _, medium = stores.open(address)
    store.write([state(1)])
    connect = medium._tenure.connector.connect

    def slowly():
        time.sleep(1.5 * CLOSE_S)  # a host before the one that answers is dead
        return connect()

    monkeypatch.setattr(medium._tenure.connector, "connect", slowly)
    second.pause()
    try:
        writer, failed = failing_write(store)
        medium.line._session.break_off()
        asked_s = time.monotonic()
        medium.end_soon()
        writer.join(20)
        store.close()
        took_s = time.monotonic() - asked_s
    finally:
        second.go_on()
    assert "the shard ends" in str(failed[0])
    assert took_s < 4 * CLOSE_S
    postgres_nodes.await_sync(first)
