"""Begins new epochs after the database went back to an earlier moment.

A restored database names holders of the past, and epochs that clients have seen pass.  One
transaction gives every shard an epoch above the wall clock, a new beat and no holder: a daemon that
has lived through the restore writes nothing more, and the next start need not wait for a lease.
"""

from __future__ import annotations

import time
from collections.abc import Collection
from contextlib import closing
from typing import Final, NamedTuple

from enact_dist.config.types import without_password
from enact_dist.core.failover.lease import HolderRow, Standby
from enact_dist.errors import StoreError
from enact_dist.link.postgres.connection import CONFIRMED, Connector, DatabaseSession, myself
from enact_dist.link.postgres.medium import database_errors
from enact_dist.link.postgres.standby import LOOK_S
from enact_dist.link.postgres.tables import CLOCK, MISSING, RAISE, SHARDS

_REMEDY: Final = (
    "stop all daemons of the cell first, since they remember what the restore took back; nothing"
    " was changed (--fence: take the shards from them, and they end)"
)


class RaisedEpoch(NamedTuple):
    """What became of one shard.

    Attributes:
        before: Its epoch in the restored database.
        epoch: Its epoch now.
        batch: Number of its newest batch, which the restore brought back.
        holder: Host and process that the restored row named; empty: none.
    """

    shard: str
    before: int
    epoch: int
    batch: int
    holder: str


def raise_epochs(
    url: str,
    cell: str,
    shards: Collection[str],
    *,
    lease_s: float,
    unix_s: int,
    fence: bool = False,
) -> list[RaisedEpoch]:
    """Give shards of a cell new epochs, and free them; all or none.

    Args:
        url: The database.
        cell: Name of the cell.
        shards: Their names; empty: all that the database has of this cell.
        lease_s: The lease of their daemons.
        unix_s: The wall clock of this host, seconds since 1970; that of the database counts, too.
        fence: Whether to take shards from daemons that serve them.

    Raises:
        StoreError: The database cannot be used, has no such shard, or a daemon serves one.
    """
    name = without_password(url)
    with (
        database_errors(name),
        closing(Connector(url, f"enact shard restored on {myself()}").connect()) as session,
    ):
        if (session.row(MISSING) or (None,))[0]:
            raise StoreError(
                f"{name} has no shards (no schema enact): restore it first (pg_restore), or"
                " correct `store` in cell.toml",
                path=name,
            )
        if fence:
            seen = rows_of_cell(session, cell, shards, name)
        else:
            seen = idle_rows(session, cell, shards, name, lease_s, remedy=_REMEDY)
        session.commit_as(CONFIRMED)
        with session.connection.transaction():
            found = rows_of_cell(session, cell, seen, name, " FOR UPDATE")
            if not fence:
                refuse_served(
                    [shard for shard, row in found.items() if row[1] != seen[shard][1]],
                    found,
                    name,
                    _REMEDY,
                )
            there_s = (session.row(CLOCK) or (0,))[0]
            raised = []
            for shard, (row_id, row) in found.items():
                epoch = max(row.epoch + 1, unix_s, there_s)
                session.row(RAISE, (epoch, row_id))
                raised.append(RaisedEpoch(shard, row.epoch, epoch, row.batch, row.holder))
        session.check()
    return raised


def idle_rows(
    session: DatabaseSession,
    cell: str,
    shards: Collection[str],
    name: str,
    lease_s: float,
    *,
    remedy: str,
) -> dict[str, tuple[int, HolderRow]]:
    """Look at rows until each is known to be free; return them.

    Raises:
        StoreError: A row changes, so a daemon writes it.
    """
    watches: dict[str, Standby] = {}
    while True:
        found = rows_of_cell(session, cell, shards, name)
        now_ns = time.monotonic_ns()
        free = [
            watches.setdefault(shard, Standby(round(lease_s * 1e9))).is_free(row, now_ns)
            for shard, (_, row) in found.items()
        ]
        refuse_served([shard for shard in found if watches[shard].alive], found, name, remedy)
        if all(free):
            return found
        time.sleep(LOOK_S)


def refuse_served(
    alive: Collection[str], found: dict[str, tuple[int, HolderRow]], name: str, remedy: str
) -> None:
    """Refuse shards whose rows change.

    Raises:
        StoreError: There are some.
    """
    if alive:
        served = ", ".join(
            f"{shard} by process {found[shard][1].holder or 'unknown'}" for shard in alive
        )
        raise StoreError(f"{name}: daemons serve {served}: {remedy}", path=name)


def rows_of_cell(
    session: DatabaseSession, cell: str, shards: Collection[str], name: str, more: str = ""
) -> dict[str, tuple[int, HolderRow]]:
    """Return id and row of each shard.

    Raises:
        StoreError: The database has no such shard.
    """
    cursor = session.connection.execute(f"{SHARDS}{more}".encode(), (cell,))
    all_rows = {row[1]: (row[0], HolderRow(*row[2:])) for row in cursor}
    session.check()
    lacking = [shard for shard in shards if shard not in all_rows]
    if lacking or not all_rows:
        what = f"shard {', '.join(lacking)}" if lacking else "shards"
        raise StoreError(
            f"{name} has no {what} of cell {cell} (it has {', '.join(all_rows) or 'none'}); nothing"
            " was changed: restore the backup that has it, or leave it out, and it begins empty",
            path=name,
        )
    return {shard: all_rows[shard] for shard in all_rows if not shards or shard in shards}
