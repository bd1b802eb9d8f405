"""What a standby serves that read ahead is what a fresh read gives, whatever went on meanwhile."""

import threading
from contextlib import closing, contextmanager
from dataclasses import fields, replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from polling import until
from shard_stores import address_of, state, take, versions
from store_model import State
from test_store_ledger import BATCHES, at_work

from enact_dist.core.protocol.records import HistoryForgotten, Persist
from enact_dist.link.postgres import ahead, opening
from enact_dist.link.postgres.address import ShardHeldError
from enact_dist.link.postgres.standby import StandbyWatch, wait_free
from enact_dist.link.store.gathering import Rows
from enact_dist.terms import Durability

GOES_ON = threading.Event()
"""Never set."""


@settings(deadline=None, max_examples=40)
@given(batches=BATCHES, data=st.data())
def test_what_was_read_ahead_makes_no_difference(server, batches, data):
    """Deleted and forgotten rows, labels and causes: after each takeover it is the ledger."""
    address, expected, rows, batch = address_of(server.url), State(), Rows(), 0
    store, _, medium = take(address)
    try:
        for persists, restarts in (*batches, ((), True)):
            for durability, records in persists:
                for record in records:
                    written = at_work(record, expected)
                    expected = expected.after([(durability, [written])])
                    store.write([Persist(1, (written,), durability)])
                    session, shard = medium.line._session, medium._tenure.shard
                    source = ahead.RowReader(session, shard, str(address), GOES_ON)
                    match data.draw(st.sampled_from(("newer", "all", "nothing"))):
                        case "newer":
                            batch = source.read_newer(rows, batch)
                        case "all":
                            batch = source.bring_up(rows)
            if restarts:
                store.close()
                store, recovered, medium = take(address, rows=rows)
                assert not expected.difference(recovered)
                _same_as_fresh(medium, address, rows)
    finally:
        store.close()


def _same_as_fresh(medium, address, rows):
    """Compare all that a store begins with."""
    session, shard = medium.line._session, medium._tenure.shard
    seen = opening.look(session, address)[1]
    late, fresh = (
        opening.read_whole(session, shard, seen.batch, "a test", some) for some in (rows, Rows())
    )
    for one in fields(fresh):
        if one.name == "states":
            for name in ("newest", "history", "blobs", "causes", "prepared"):
                assert getattr(late.states, name) == getattr(fresh.states, name)
        else:
            assert getattr(late, one.name) == getattr(fresh, one.name)


def test_a_standby_reads_ahead_and_follows(server, stores, stopped):
    """On its own connection; what it took over is not read again, but for what changed since."""
    address = address_of(server.url)
    store, _, _ = stores.open(address)
    for number in range(50):
        store.write([state(1, f"e{number}")])

    with stood_by(server, address, stopped) as found:
        version = replace(state(2, "e7").records[0], history=True)
        store.write([Persist(1, (version,), Durability.OS)])
        forgotten = HistoryForgotten(((state(1, "e7").records[0].slot, 1),))
        store.write([Persist(1, (forgotten,), Durability.OS), state(1, "late")])
        store.close()
    assert len(found[0].rows.by_id) > 50

    store, recovered = opening.open_database(found[0], unix_s=1)
    with closing(store):
        assert versions(recovered) == {**{f"e{n}": 1 for n in range(50)}, "e7": 2, "late": 1}
        assert not recovered.history


def test_the_loser_of_a_race_keeps_what_it_has_read(server, stores, stopped, monkeypatch):
    """It stands by again, and reads only what is new; so does one whose takeover failed late."""
    address, watch, read = address_of(server.url), StandbyWatch(), []
    store, _, _ = stores.open(address)
    for number in range(50):
        store.write([state(1, f"e{number}")])
    with stood_by(server, address, stopped, watch) as found:
        store.close()
    other, _, _ = stores.open(address)
    with pytest.raises(ShardHeldError):
        opening.open_database(found[0], unix_s=1)
    check = ahead.check_row
    monkeypatch.setattr(ahead, "check_row", lambda row, name: read.append(row) or check(row, name))

    with stood_by(server, address, stopped, watch) as found:
        other.write([state(1, "late")])
        other.close()
    with monkeypatch.context() as patch:
        patch.setattr(opening, "Store", fails)
        with pytest.raises(RuntimeError):
            opening.open_database(found[0], unix_s=2)
    free = wait_free(address, watch=watch, stopped=stopped, patient=True, note=print)
    store, recovered = opening.open_database(free, unix_s=3)
    with closing(store):
        assert versions(recovered) == {**{f"e{n}": 1 for n in range(50)}, "late": 1}
    assert 0 < len(read) < 10


def fails(*_, **__):
    raise RuntimeError("a takeover fails")


@contextmanager
def stood_by(server, address, stopped, watch=None):
    """Stand by and read ahead; yield a list, which has the free shard after the block."""
    noted, found = threading.Event(), []

    def stand_by():
        arguments = {"patient": True, "note": lambda _: noted.set(), "stopped": stopped}
        found.append(wait_free(address, watch=watch, **arguments))

    standby = threading.Thread(target=stand_by)
    standby.start()
    assert noted.wait(10)
    _await_sweeps(server, address)
    yield found
    standby.join(20)


def test_a_spell_of_slow_looks_is_logged_once_and_counted(caplog):
    """With the time of the first, and at its end with the longest."""
    watch = StandbyWatch()
    with caplog.at_level("WARNING", logger="enact.shard"):
        stale = [watch.is_stale(took_s, 2.0) for took_s in (0.9, 1.2, 3.4, 1.1, 0.1, 0.1, 1.3)]

    assert stale == [False, True, True, True, False, False, True]
    assert watch.figures.slow_looks == 4
    first, over, second = [record.getMessage() for record in caplog.records]
    assert "took 1.2 s, more than half of lease_s (2 s)" in first
    assert "after 3 slow ones of up to 3.4 s" in over
    assert "took 1.3 s" in second


def _await_sweeps(server, address):
    """Wait until a standby has read rows and asks for newer ones."""
    statement = "SELECT 1 FROM pg_stat_activity WHERE query LIKE %s AND application_name = %s"
    values = ("%AND batch >%", ahead.connector_of(address)._rest["application_name"])
    until(lambda: server.execute(statement, values))


def test_rows_that_only_a_lost_primary_had_are_read_again(server, stores):
    """They have the number and batch of others; their checksum tells them apart."""
    address = address_of(server.url)
    store, _, medium = stores.open(address)
    store.write([state(1, "a"), state(1, "b")])
    source = ahead.RowReader(medium.line._session, medium._tenure.shard, str(address), GOES_ON)
    rows = Rows()
    source.bring_up(rows)
    found = list(rows.by_id.values())
    for row in found:
        other = next(one for one in found if one.key.kind is row.key.kind)
        rows.put(row._replace(crc=row.crc ^ 1, batch=row.batch + 7, holds=other.holds))
    for row in found:
        rows.put(row._replace(id=10_000 + row.id))
    store.close()

    store, recovered, _ = take(address, rows=rows)
    with closing(store):
        assert versions(recovered) == {"a": 1, "b": 1}
