"""Changes shards of a stopped cell in its database together: moves, purges, erases.

One transaction holds the rows of the shards, reads everything, and writes everything.  So no daemon
takes a shard meanwhile, and a run that is cut off has changed nothing: there are no marks, and
nothing to complete.  The rules of `link.offline.rebalance` about epochs and old leases hold.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, closing, contextmanager
from typing import Final, NamedTuple

import psycopg
from psycopg.types.numeric import Int8

from enact_dist.config.types import without_password
from enact_dist.core.failover.lease import HolderRow
from enact_dist.core.offline.forgetting import world_drops
from enact_dist.core.offline.moving import Shards
from enact_dist.core.protocol.messages import PlacementMap
from enact_dist.core.protocol.records import Recovered
from enact_dist.errors import StoreError
from enact_dist.link.folder.blobs import Blob
from enact_dist.link.offline.cell import SILENT, refuse_obstacles, write
from enact_dist.link.offline.forgetting import Purged, PurgeProgress, planned_purge
from enact_dist.link.offline.rebalance import Progress, Rebalance, carry_out, wait_for_leases
from enact_dist.link.postgres.address import StoreAddress
from enact_dist.link.postgres.bodies import BodiesToWrite
from enact_dist.link.postgres.connection import CONFIRMED, DatabaseSession, connector_of
from enact_dist.link.postgres.medium import database_errors, send_batch
from enact_dist.link.postgres.opening import read_whole
from enact_dist.link.postgres.restored import idle_rows, refuse_served, rows_of_cell
from enact_dist.link.postgres.tables import ERASE, FENCE, MISSING, SHARDS, make_tables
from enact_dist.link.store.database import DatabaseRow
from enact_dist.link.store.store import Store

_STOP: Final = "stop all daemons of the cell first; nothing was changed"


class _SharedMedium:
    """The medium of one shard in the transaction of all; see `link.store.media.Medium`."""

    tired = False
    holding = None
    """The transaction holds the shard's row."""

    def __init__(self, session: DatabaseSession, shard: int, epoch: int, name: str) -> None:
        self.name = name
        self.bodies = BodiesToWrite(epoch)
        self._session, self._shard, self._epoch = session, shard, epoch

    def commit(
        self,
        batch: int,
        rows: Sequence[DatabaseRow],
        gone: Iterable[int],
        unnamed: Iterable[Blob] = (),
        *,
        forced: bool,
    ) -> None:
        """Put `rows` and new bodies, delete rows and bodies, once the transaction is committed."""
        del forced  # the transaction is
        send_batch(
            self._session.connection, self._shard, self._epoch, batch, rows, gone, unnamed,
            self.bodies.take(),
        )  # fmt: skip

    def rest(self) -> None:
        """Do nothing: the database cleans up by itself."""

    def close(self) -> None:
        """Do nothing: the transaction ends all."""

    def errors(self) -> AbstractContextManager[None]:
        """Return `database_errors` of this shard."""
        return database_errors(self.name)


class ErasedShard(NamedTuple):
    """What a database had of a shard.

    Attributes:
        epoch: Its last epoch.
        batch: Number of its newest batch.
        rows: How many rows of data it had.
    """

    shard: str
    epoch: int
    batch: int
    rows: int


@contextmanager
def _idle(
    cell: StoreAddress, progress: Progress | PurgeProgress, only: Collection[str]
) -> Iterator[tuple[DatabaseSession, Callable[[], dict[str, tuple[int, HolderRow]]]]]:
    """Wait until no daemon serves; yield a transaction, and what locks the shards' rows in it."""
    name = _named(cell)
    with database_errors(name), closing(connector_of(cell).connect()) as session:
        if session.row(MISSING) != (None,):
            raise StoreError(f"{name} has no data of shards (no schema enact)", path=name)
        progress.act("look for daemons")
        seen = idle_rows(session, cell.cell, only, name, cell.lease_s, remedy=_STOP)

        def locked() -> dict[str, tuple[int, HolderRow]]:
            held = rows_of_cell(session, cell.cell, only, name, " FOR UPDATE")
            changed = [s for s, (_, row) in held.items() if s in seen and seen[s][1] != row]
            refuse_served(changed, held, name, _STOP)
            return held

        session.commit_as(CONFIRMED)
        with session.connection.transaction():
            yield session, locked
        session.check()


def _named(cell: StoreAddress) -> str:
    return f"{without_password(cell.url)} (cell {cell.cell})"


@contextmanager
def _opened(
    cell: StoreAddress, progress: Progress | PurgeProgress, only: Collection[str],
    new: Collection[str], *, unix_s: int, dry_run: bool,
) -> Iterator[tuple[dict[str, Store], dict[str, Recovered]]]:  # fmt: skip
    """Open shards of a cell in one transaction, in one new epoch; yield stores and contents."""
    with _idle(cell, progress, only) as (session, locked):
        session.connection.execute("SET LOCAL idle_in_transaction_session_timeout = '10min'")
        for shard in new:
            make_tables(session, cell.cell, shard)
        held = locked()
        epoch = max(unix_s, *(row.epoch + 1 for _, row in held.values()))
        stores: dict[str, Store] = {}
        stored: dict[str, Recovered] = {}
        for shard, (row_id, row) in held.items():
            if not row.epoch and shard not in new:
                continue  # a daemon has looked for it, and never served it
            progress.act(f"open {shard}")
            session.row(FENCE, (Int8(epoch), "", row_id))
            place = str(StoreAddress(cell.url, cell.cell, shard))
            contents = read_whole(session, row_id, row.batch, place)
            contents.recovered.epoch = epoch
            medium = _SharedMedium(session, row_id, epoch, place)
            stores[shard] = Store(medium, contents, wall_ns=unix_s * 1_000_000_000)
            stored[shard] = contents.recovered
        yield stores, stored
        progress.act("commit")
        if dry_run:
            raise psycopg.Rollback


def rebalance_database(
    cell: StoreAddress,
    placement: PlacementMap,
    *,
    new: Collection[str] = (),
    unix_s: int,
    dry_run: bool = False,
    progress: Progress | None = None,
) -> Rebalance:
    """Move every entity to its shard under `placement`, all or none.

    Shards that the database has of the cell and the placement has not are emptied.

    Args:
        cell: The database and the cell; the shard does not matter.
        placement: The new placement of entities.
        new: Shards that may have no data yet.
        unix_s: The wall clock, seconds since 1970.
        dry_run: Whether to change nothing.
        progress: Receives the progress.

    Raises:
        StoreError: A daemon serves a shard, one has no data, the database cannot be used or is
            damaged, or something would be lost; the message says what to do.
    """
    progress = progress or SILENT
    with _opened(cell, progress, (), new, unix_s=unix_s, dry_run=dry_run) as (stores, stored):
        locked_s, wait_s = time.monotonic(), 0.0
        lacking = [each.name for each in placement.shards if each.name not in stored]
        if lacking:
            raise StoreError(
                f"the database of cell {cell.cell} has no data of {', '.join(lacking)} (it has"
                f" {', '.join(stored) or 'none'}); nothing was moved: if the shard is new, say"
                f" --new {lacking[0]}; if it has another name there, correct cell.toml"
            )
        shards = Shards(stored, placement, under_way=False)
        plan = shards.plan()
        refuse_obstacles("nothing was moved", plan.obstacles)
        if not dry_run:
            carry_out(shards, plan, stores, stored, progress)
            if plan.moves:
                wait_s = wait_for_leases(stored, locked_s, progress)
    return Rebalance(plan.moves, resumed=False, waited_s=wait_s)


def forget_database(
    cell: StoreAddress,
    aspects: Iterable[str],
    *,
    only: Collection[str] = (),
    now_ns: int,
    unused: Collection[str] | None = None,
    dry_run: bool = False,
    progress: PurgeProgress | None = None,
) -> Purged:
    """Purge aspects, with all data that the shards have of them; all or none.

    Args:
        cell: The database and the cell; the shard does not matter.
        aspects: Names of the aspects.
        only: Shards; empty: all that the database has of the cell.
        now_ns: The wall clock, nanoseconds since 1970.
        unused: As for `link.offline.forgetting.forget`.
        dry_run: Whether to change nothing.
        progress: Receives what is purged, and each step.

    Raises:
        StoreError: A daemon serves a shard, the database cannot be used or is damaged, or a commit
            that names an aspect is undecided; the message says what to do.
        MisuseError: None of these shards ever knew one of the aspects.
    """
    progress = progress or SILENT
    unix_s = now_ns // 1_000_000_000
    with _opened(cell, progress, only, (), unix_s=unix_s, dry_run=dry_run) as (stores, stored):
        found, plan = planned_purge({}, stored, aspects, now_ns=now_ns, unused=unused)
        progress.found(found)
        if not dry_run:
            for records in (plan.records, world_drops(stored, found.worlds)):
                for name, some in records.items():
                    progress.act(f"forget on {name}")
                    write(stores[name], some)
    return found


def shards_in_database(cell: StoreAddress) -> list[str]:
    """Return the shards that a database has of a cell; the address's shard does not matter.

    Raises:
        StoreError: The database cannot be used.
    """
    with database_errors(_named(cell)), closing(connector_of(cell).connect()) as session:
        if session.row(MISSING) != (None,):
            return []
        found = session.connection.execute(SHARDS.encode(), (cell.cell,)).fetchall()
        return [name for _, name, *_ in found]


def erase_database(
    cell: StoreAddress, only: Collection[str] = (), *, dry_run: bool = False
) -> list[ErasedShard]:
    """Delete all that a database has of shards, or of all its shards of the cell; all or none.

    Raises:
        StoreError: A daemon serves one, there is no such shard, or the database cannot be used.
    """
    with _idle(cell, SILENT, only) as (session, locked):
        erased = []
        for shard, (row_id, row) in locked().items():
            (rows,) = session.row(ERASE, (Int8(row_id),)) or (0,)
            erased.append(ErasedShard(shard, row.epoch, row.batch, rows))
        if dry_run:
            raise psycopg.Rollback
    return erased
