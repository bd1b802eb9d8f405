"""Takes a shard in a database over, and reads it.

First the fence, in a short transaction: the new epoch, confirmed by the standby, and with it all
that stands before it in the database's log.  So whatever is read afterwards cannot be lost by a
failover, and no other process writes it.  The lease is renewed while rows are read.
"""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING, NamedTuple

from psycopg.types.numeric import Int8

from enact_dist.core.failover.lease import HolderRow
from enact_dist.errors import StoreError
from enact_dist.link.folder.folder import refuse
from enact_dist.link.lease import HostLease
from enact_dist.link.postgres.address import ShardHeldError
from enact_dist.link.postgres.ahead import RowReader, streamed
from enact_dist.link.postgres.bodies import ReadBodies
from enact_dist.link.postgres.connection import CONFIRMED, broken_off, connector_of, myself
from enact_dist.link.postgres.line import HeldRow, Renewer
from enact_dist.link.postgres.medium import PostgresMedium, database_errors
from enact_dist.link.postgres.tables import BODIES, FENCE, ROWS, make_tables, state_of_shard
from enact_dist.link.store.database import DatabaseRow
from enact_dist.link.store.gathering import Rows
from enact_dist.link.store.recovery import put_together, read_blobs
from enact_dist.link.store.store import Store

if TYPE_CHECKING:
    from collections.abc import Iterator

    from enact_dist.core.protocol.records import Recovered
    from enact_dist.link.postgres.address import FreeShard, StoreAddress
    from enact_dist.link.postgres.connection import DatabaseSession
    from enact_dist.link.store.gathering import Contents


def look(session: DatabaseSession, address: StoreAddress) -> tuple[int, HolderRow]:
    """Return a shard's row and who holds it; make the row and the tables if they are missing.

    Raises:
        StoreError: The tables are of another format.
        psycopg.Error: As the database reports it.
    """
    make_tables(session, address.cell, address.shard)
    return row_of_shard(session, address)


def row_of_shard(
    session: DatabaseSession, address: StoreAddress, more: str = ""
) -> tuple[int, HolderRow]:
    """Return the id of a shard's row, and the row."""
    statement, values = state_of_shard(address.cell, address.shard)
    found = session.row(statement + more, values)
    if found is None:
        raise StoreError(f"{address} has gone from the database", path=str(address))
    shard, _, epoch, batch, beat, holder = found
    return shard, HolderRow(epoch, batch, beat, holder)


def open_database(free: FreeShard, *, unix_s: int) -> tuple[Store, Recovered]:
    """Take a shard over, in a new epoch, and read and check it (see `link.store.recovery`).

    Args:
        free: The shard, and its row when it was found free.
        unix_s: The wall clock, seconds since 1970; the epoch is this or one more than the last.

    Returns:
        The store and its content.

    Raises:
        ShardHeldError: Another process was first, or its holder lives.
        StoreError: The database cannot be used, or what it holds is damaged.
    """
    name = str(free.address)
    with database_errors(name):
        held = take_over(free, unix_s=unix_s)
        try:
            with broken_off(lambda: held.session, free.stopped):
                contents = read_whole(held.session, held.shard, held.batch, name, free.rows)
            contents.recovered.epoch = held.epoch
            store = Store(held.medium, contents, wall_ns=unix_s * 1_000_000_000)
        except BaseException:
            held.medium.close()
            raise
    return store, contents.recovered


def read_whole(
    session: DatabaseSession,
    shard: int,
    batch: int,
    name: str,
    ahead: Rows | None = None,
) -> Contents:
    """Read and check a shard with its bodies, but for the rows that were read ahead.

    Raises:
        As `read_rows`.
    """
    contents = read_rows(session, shard, batch, name, ahead)
    bodies = ReadBodies(name, streamed(session, BODIES, (shard,)))
    read_blobs(contents, bodies, power_cut=False)
    put_together(contents, name)
    return contents


class HeldShard(NamedTuple):
    """A shard that this process has taken over.

    Attributes:
        medium: Renews the lease; `close` frees the shard.
        session: The connection of the medium, for reading until its first commit.
        shard: Its row.
        batch: Number of the newest batch.
    """

    medium: PostgresMedium
    session: DatabaseSession
    shard: int
    epoch: int
    batch: int


def take_over(free: FreeShard, *, unix_s: int) -> HeldShard:
    """Begin a new epoch of a shard, and renew its lease from now on.

    Raises:
        ShardHeldError: Another process was first, or its holder lives.
        psycopg.Error: As the database reports it.
    """
    address, seen = free.address, free.seen
    session = (connector := connector_of(address)).connect()
    try:
        lease = HostLease(address.lease_s)
        sent_s = lease.now_s()
        with broken_off(lambda: session, free.stopped):
            shard, epoch, batch = _fence(session, address, unix_s, seen)
        lease.confirmed(sent_s)
        tenure = HeldRow(connector, shard, epoch, lease, str(address))
        return HeldShard(_medium(session, tenure), session, shard, epoch, batch)
    except BaseException:
        session.close()
        raise


def _medium(session: DatabaseSession, tenure: HeldRow) -> PostgresMedium:
    return PostgresMedium(tenure, session, Renewer(tenure))


def _fence(
    session: DatabaseSession, address: StoreAddress, unix_s: int, seen: HolderRow
) -> tuple[int, int, int]:
    """Begin a new epoch; return the shard's row, the epoch, and the number of the newest batch."""
    session.commit_as(CONFIRMED)
    with session.connection.transaction():
        shard, now = row_of_shard(session, address, " FOR UPDATE")
        if (now.epoch, now.beat) != (seen.epoch, seen.beat):
            raise ShardHeldError(
                f"{address} is served by process {now.holder or 'unknown'} in epoch {now.epoch}",
                path=str(address),
            )
        epoch = max(now.epoch + 1, unix_s)
        session.row(FENCE, (Int8(epoch), myself(), shard))
    session.check()
    return shard, epoch, now.batch


class StreamedRows:
    """Gives the rows of a shard, a few at a time."""

    def __init__(self, session: DatabaseSession, shard: int) -> None:
        self._session, self._shard = session, shard

    def rows(self) -> Iterator[DatabaseRow]:
        """Yield all rows, oldest identity first."""
        yield from map(DatabaseRow._make, streamed(self._session, ROWS, (self._shard,)))


def read_rows(
    session: DatabaseSession,
    shard: int,
    batch: int,
    name: str,
    ahead: Rows | None = None,
) -> Contents:
    """Read and check all rows of a shard, but for those that were read ahead.

    Args:
        session: A connection.
        shard: Number of the shard.
        batch: Number of its newest batch.
        name: Its place, for people.
        ahead: Rows that are there already.

    Raises:
        StoreError: They are damaged.
        psycopg.Error: As the database reports it.
    """
    rows = ahead or Rows()
    newest = RowReader(session, shard, name, threading.Event()).bring_up(rows)
    if newest != batch:
        refuse(name, f"is damaged: its newest row is of batch {newest}, not {batch}")
    contents = rows.contents(name)
    contents.batch = batch  # a row of a later one may have gone with a lost primary
    return contents
