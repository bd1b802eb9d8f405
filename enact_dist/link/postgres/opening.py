"""Takes a shard in a database over, and reads it.

First the fence, in a short transaction: the new epoch, confirmed by the standby, and with it all
that stands before it in the database's log.  So whatever is read afterwards cannot be lost by a
failover, and no other process writes it.  The lease is renewed while rows are read.
"""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING

from psycopg.types.numeric import Int8

from enact_dist.core.failover.lease import HolderRow
from enact_dist.errors import StoreError
from enact_dist.link.folder.folder import refuse
from enact_dist.link.lease import HostLease
from enact_dist.link.postgres.address import ShardHeldError
from enact_dist.link.postgres.ahead import RowReader, streamed
from enact_dist.link.postgres.bodies import ReadBodies
from enact_dist.link.postgres.connection import CONFIRMED, connector_of, myself
from enact_dist.link.postgres.line import HeldRow, Renewer
from enact_dist.link.postgres.medium import PostgresMedium, database_errors
from enact_dist.link.postgres.tables import BODIES, FENCE, make_tables, state_of_shard
from enact_dist.link.store.recovery import gather, put_together, read_blobs
from enact_dist.link.store.store import Store

if TYPE_CHECKING:
    from enact_dist.core.protocol.records import Recovered
    from enact_dist.link.postgres.address import FreeShard, StoreAddress
    from enact_dist.link.postgres.connection import DatabaseSession
    from enact_dist.link.store.recovery import Contents


def look(session: DatabaseSession, address: StoreAddress) -> tuple[int, HolderRow]:
    """Return a shard's row and who holds it; make the row and the tables if they are missing.

    Raises:
        StoreError: The tables are of another format.
        psycopg.Error: As the database reports it.
    """
    make_tables(session, address.cell, address.shard)
    return _row(session, address)


def _row(session: DatabaseSession, address: StoreAddress, more: str = "") -> tuple[int, HolderRow]:
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
    address, seen = free.address, free.seen
    name = str(address)
    with database_errors(name):
        session = (connector := connector_of(address)).connect()
        try:
            lease = HostLease(address.lease_s)
            sent_s = lease.now_s()
            shard, epoch, batch = _fence(session, address, unix_s, seen)
            lease.confirmed(sent_s)
            medium = _medium(session, HeldRow(connector, shard, epoch, lease, name))
        except BaseException:
            session.close()
            raise
        try:
            contents = _read(session, shard, free)
            if contents.batch != batch:
                refuse(
                    name, f"is damaged: its newest row is of batch {contents.batch}, not {batch}"
                )
            contents.recovered.epoch = epoch
            store = Store(medium, contents, wall_ns=unix_s * 1_000_000_000)
        except BaseException:
            medium.close()
            raise
    return store, contents.recovered


def _medium(session: DatabaseSession, tenure: HeldRow) -> PostgresMedium:
    return PostgresMedium(tenure, session, Renewer(tenure))


def _fence(
    session: DatabaseSession, address: StoreAddress, unix_s: int, seen: HolderRow
) -> tuple[int, int, int]:
    """Begin a new epoch; return the shard's row, the epoch, and the number of the newest batch."""
    session.commit_as(CONFIRMED)
    with session.connection.transaction():
        shard, now = _row(session, address, " FOR UPDATE")
        if (now.epoch, now.beat) != (seen.epoch, seen.beat):
            raise ShardHeldError(
                f"{address} is served by process {now.holder or 'unknown'} in epoch {now.epoch}",
                path=str(address),
            )
        epoch = max(now.epoch + 1, unix_s)
        session.row(FENCE, (Int8(epoch), myself(), shard))
    session.check()
    return shard, epoch, now.batch


def _read(session: DatabaseSession, shard: int, free: FreeShard) -> Contents:
    """Read and check all rows and bodies of a shard, but for rows that were read ahead."""
    name, rows = str(free.address), dict(free.rows)
    RowReader(session, shard, name, threading.Event()).bring_up(rows)
    contents = gather((rows[number] for number in sorted(rows)), name)
    bodies = ReadBodies(name, streamed(session, BODIES, (shard,)))
    read_blobs(contents, bodies, power_cut=False)
    put_together(contents, name)
    return contents
