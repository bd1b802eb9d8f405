"""Who may write a shard in a database, and how often a batch is written when connections are lost."""

import os
import random
import threading
import time
from contextlib import closing

import psycopg
import pytest
from polling import until
from postgres_nodes import await_sync
from shard_stores import address_of, state, take, versions
from tcp_proxy import TcpProxy

from enact_dist.core.failover.lease import HolderRow
from enact_dist.errors import StoreError
from enact_dist.link.lease import ShardTakenError
from enact_dist.link.postgres.address import FreeShard, ShardHeldError
from enact_dist.link.postgres.opening import open_database
from enact_dist.link.postgres.standby import wait_free
from enact_dist.terms import Durability

LOG = """
CREATE TABLE IF NOT EXISTS written (shard int, batch bigint);
CREATE OR REPLACE FUNCTION note() RETURNS trigger LANGUAGE plpgsql AS
    'BEGIN INSERT INTO written VALUES (new.id, new.batch); RETURN new; END';
CREATE OR REPLACE TRIGGER note AFTER UPDATE OF batch ON enact.shard
    FOR EACH ROW WHEN (old.batch <> new.batch) EXECUTE FUNCTION note();
"""
CUTS = int(os.environ.get("ENACT_STORE_CUTS", "300"))


def through(proxy, url, port):
    """Return the address of a database behind a proxy."""
    return url.replace(f":{port}/", f":{proxy.endpoint.rpartition(':')[2]}/")


def row_of(node, address):
    """Return epoch, batch and holder of a shard."""
    return node.execute(
        "SELECT epoch, batch, holder FROM enact.shard WHERE name = %s", (address.shard,)
    )[0]


def test_a_batch_is_written_once_wherever_the_connection_breaks(server, stores):
    """Cuts after a random number of bytes, before and after the commit: no gap, none twice."""
    rng = random.Random(11)
    with TcpProxy(server.port) as proxy:
        address = address_of(through(proxy, server.url, server.port), lease_s=60.0)
        store, _, medium = stores.open(address)
        server.execute(LOG)
        shard, first = medium._tenure.shard, store.batch
        for version in range(1, CUTS + 1):
            body = bytes(70_000) if version % 10 == 0 else b""
            proxy.cut_after(rng.randrange(1, len(body) + 900))
            durability = rng.choice([Durability.DURABLE, Durability.OS])
            store.write([state(version, body=body, durability=durability), state(version, "b")])
        assert medium.line.reconnects > CUTS // 2
        store.close()

    written = server.execute("SELECT batch FROM written WHERE shard = %s ORDER BY 1", (shard,))
    assert [batch for (batch,) in written] == list(range(first + 1, first + CUTS + 1))
    _, recovered, _ = stores.open(address_of(server.url, address.shard))
    assert versions(recovered) == {"a": CUTS, "b": CUTS}


def test_an_old_daemon_writes_nothing(server, stores):
    """Neither small nor large, and it learns that another one has the shard."""
    address = address_of(server.url)
    for body in (b"", bytes(70_000)):
        old, _, medium = stores.open(address)
        old.write([state(1)])
        medium._renewer.close()
        epoch, _, holder = row_of(server, address)
        found = server.execute("SELECT beat FROM enact.shard WHERE name = %s", (address.shard,))
        beat = found[0][0]
        free = FreeShard(address, HolderRow(epoch, 0, beat, holder))
        new, recovered = open_database(free, unix_s=1)
        with closing(new):
            with pytest.raises(ShardTakenError, match=address.shard):
                old.write([state(2, body=body)])
            with pytest.raises(StoreError, match="failed before"):
                old.write([state(2)])
            new.write([state(3)])
        assert recovered.epoch == epoch + 1
        again, recovered, _ = take(address)
        again.close()
        assert versions(recovered) == {"a": 3}


def test_an_old_daemon_writes_nothing_once_another_has_begun(server, stores):
    """The epoch alone keeps it out, before the new daemon has written its first batch."""
    address = address_of(server.url)
    old, _, medium = stores.open(address)
    old.write([state(1)])
    medium._renewer.close()
    server.execute("UPDATE enact.shard SET epoch = epoch + 1 WHERE name = %s", (address.shard,))
    before = row_of(server, address)

    with pytest.raises(ShardTakenError):
        old.write([state(2, body=bytes(70_000))])

    assert row_of(server, address) == before
    assert (
        server.execute("SELECT 1 FROM enact.body WHERE shard = %s", (medium._tenure.shard,)) == []
    )


def test_a_renewal_notices_another_holder(server, stores):
    """An idle daemon that was overtaken ends, too."""
    address = address_of(server.url)
    _, _, medium = stores.open(address)
    failed = threading.Event()
    found = []
    medium.on_failure(lambda failure: (found.append(failure), failed.set()))

    server.execute("UPDATE enact.shard SET epoch = epoch + 1 WHERE name = %s", (address.shard,))

    assert failed.wait(5)
    assert isinstance(found[0], ShardTakenError)


def test_of_many_at_once_one_takes_the_shard(server, stores):
    """All have seen it free; the others learn who was first."""
    address = address_of(server.url)
    stores.open(address)[0].close()
    for _ in range(10):
        free = wait_free(address, stopped=threading.Event(), patient=False, note=print)
        won, lost = [], []

        def race(free=free, won=won, lost=lost):
            try:
                won.append(open_database(free, unix_s=1)[0])
            except ShardHeldError as error:
                lost.append(error)

        threads = [threading.Thread(target=race) for _ in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        won[0].close()
        assert (len(won), len(lost)) == (1, 3)


def test_a_living_holder_is_not_disturbed(server, stores):
    """A second start says who serves the shard and how to stand by."""
    address = address_of(server.url)
    store, _, _ = stores.open(address)
    with pytest.raises(ShardHeldError, match="--standby"):
        take(address)
    store.write([state(1)])


def test_a_shard_without_a_sign_is_free_after_the_lease(server, stores):
    """Not before the lease and the drift of two clocks are over."""
    address = address_of(server.url, lease_s=1.0)
    old, _, medium = stores.open(address)
    old.write([state(1)])
    medium._renewer.close()
    sent_s = medium.lease.lease.until_ns / 1e9 - medium.lease.usable_s

    _, recovered, _ = stores.open(address, patient=True)

    assert medium.lease.left_s < 0
    assert 1.0 < time.monotonic() - sent_s < 5.0
    assert versions(recovered) == {"a": 1}


@pytest.mark.parametrize("body", [b"", bytes(200_000)], ids=["small", "large"])
def test_the_own_batch_that_ended_late_is_not_taken_for_anothers(pair, stores, body):
    """Its connection is lost while it waits for the standby: the next try finds it there."""
    first, second = pair
    with TcpProxy(first.port) as proxy:
        address = address_of(through(proxy, first.url, first.port), lease_s=60.0)
        store, _, medium = stores.open(address)
        store.write([state(1)])
        medium._renewer.close()
        second.pause()
        try:
            writer = threading.Thread(target=store.write, args=([state(2, body=body)],))
            writer.start()
            await_waiting(first)
            proxy.cut()
            await_locked(first)
        finally:
            second.go_on()
        writer.join(30)
        assert not writer.is_alive()
        store.write([state(3)])
    await_sync(first)
    store.close()
    _, recovered, _ = stores.open(address_of(first.url, address.shard), patient=True)
    assert versions(recovered) == {"a": 3}


@pytest.mark.parametrize("how", ["pg_cancel_backend", "pg_terminate_backend"])
def test_a_commit_that_the_standby_has_not_got_is_not_believed(pair, stores, how):
    """PostgreSQL reports a cancelled wait as success, with a warning; a lost connection gives no answer."""
    first, second = pair
    address = address_of(first.url, lease_s=60.0)
    store, _, medium = stores.open(address)
    store.write([state(1)])
    medium._renewer.close()
    done = []

    def write():
        try:
            store.write([state(2)])
            done.append("acknowledged")
        except StoreError as error:
            done.append(str(error))

    second.pause()
    try:
        writer = threading.Thread(target=write)
        writer.start()
        (pid,) = await_waiting(first)
        first.execute(f"SELECT {how}(%s)", (pid,))
        if how == "pg_cancel_backend":
            writer.join(10)
            assert "may stand on one of its hosts only" in done[0]
            return
        # There it is, but on one host: that is no reason to acknowledge it.
        writer.join(1.5)
        assert not done
        assert row_of(first, address)[1] == store.batch
    finally:
        second.go_on()
    writer.join(30)
    assert done == ["acknowledged"]
    await_sync(first)


def await_waiting(node):
    """Return the processes whose commits wait for the standby, once there are any."""
    return _await(node, "wait_event = 'SyncRep'")


def await_locked(node):
    """Return the processes that wait for another's row, once there are any."""
    return _await(node, "wait_event_type = 'Lock'")


def _await(node, condition):
    asked = f"SELECT pid FROM pg_stat_activity WHERE {condition}"
    with psycopg.connect(node.url, autocommit=True) as connection:
        return until(lambda: [pid for (pid,) in connection.execute(asked)])
