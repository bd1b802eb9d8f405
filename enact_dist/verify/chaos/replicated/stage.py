"""Makes what a run in a database needs: hosts, servers, the cell, and what harms them."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Final, NamedTuple

from enact_dist.errors import LinkError, StoreError
from enact_dist.link.postgres.address import StoreAddress, require_driver
from enact_dist.verify.chaos.faults import StagedRun
from enact_dist.verify.chaos.journal import Journal
from enact_dist.verify.chaos.network.hosts import Hosts, Loopback, Namespaces
from enact_dist.verify.chaos.replicated.cell import ReplicatedCell
from enact_dist.verify.chaos.replicated.cuts import SharedCuts
from enact_dist.verify.chaos.replicated.database_faults import DatabaseFaults
from enact_dist.verify.chaos.replicated.faults import DECK, ReplicatedFaults
from enact_dist.verify.chaos.replicated.nodes import USER, DatabaseNode, DatabasePair, programs

NODES: Final = "nodes"
"""In place of an address: two servers of the run's own."""
LEASE_S: Final = 1.0
_DATABASES: Final = ("d0", "d1")
_PLACES: Final = ("h0", "h1")


def stage_replicated(
    store: str,
    folder: Path,
    log: Journal,
    shards: tuple[str, ...],
    groups: tuple[str, ...],
    undo: ExitStack,
    *,
    watcher: str,
    seed: int,
    ttl_s: float,
    deck: Mapping[str, int] | None,
    daemon_module: str,
) -> StagedRun:
    """Make hosts and a cell whose shards store in a database.

    Args:
        store: Its address, or `NODES`.
        folder: Gets what is left of the run.
        log: Gets faults and takeovers.
        shards: Their names.
        groups: Hosts of clients.
        undo: Gets what removes everything.
        watcher: Host of the watcher.
        seed: What happens is drawn from it.
        ttl_s: Session TTL.
        deck: How many faults of each kind come in turn; None: as usual.
        daemon_module: Runs a shard.

    Raises:
        LinkError: The database cannot be used, or the system allows no namespaces.
    """
    opened = _open_nodes if store == NODES else _open_loopback
    found = opened(store, folder, log, (*_PLACES, *groups, watcher), undo, seed)
    cell = ReplicatedCell(
        folder,
        found.hosts,
        shards,
        log,
        ttl_s=ttl_s,
        seed=seed,
        store=found.store,
        cell=found.cell,
        places=_PLACES,
        lease_s=LEASE_S,
        daemon_module=daemon_module,
    )
    undo.callback(cell.close)
    injector = ReplicatedFaults(
        cell,
        found.hosts,
        groups,
        log,
        seed=seed,
        ttl_s=ttl_s,
        deck=deck or DECK,
        places=_PLACES,
        lease_s=LEASE_S,
        cuts=found.cuts,
        database=found.database,
    )
    return StagedRun(found.hosts, cell, injector)


class _Opened(NamedTuple):
    """Where a run takes place; `cell`: its name in the database at `store`."""

    hosts: Hosts
    cuts: SharedCuts
    database: DatabaseFaults | None
    cell: str
    store: str


def _open_nodes(
    _: str, folder: Path, _log: Journal, others: tuple[str, ...], undo: ExitStack, seed: int
) -> _Opened:
    """Make hosts, and two servers on their own ones."""
    programs()
    hosts = Namespaces((*_DATABASES, *others), seed=seed)
    undo.callback(hosts.close)
    cuts = SharedCuts(hosts)
    one, other = (DatabaseNode(hosts, name, folder) for name in _DATABASES)
    database = DatabaseFaults(DatabasePair(one, other), others, cuts)
    undo.callback(database.close)
    database.start()
    places = ",".join(hosts.address(host) for host in _DATABASES)
    return _Opened(hosts, cuts, database, "chaos", f"postgresql://{USER}@{places}/postgres")


def _open_loopback(
    store: str, _: Path, log: Journal, others: tuple[str, ...], undo: ExitStack, _seed: int
) -> _Opened:
    """Use a database that is there."""
    hosts = Loopback(others, why="the database is not on a network of the run's own")
    undo.callback(hosts.close)
    hosts.missing += ("faults of the database (it is not the run's own)",)
    cell = f"chaos-{os.getpid()}-{time.time_ns()}"
    undo.callback(_leave_nothing, store, cell, log)
    _forget(store, cell)
    return _Opened(hosts, SharedCuts(hosts), None, cell, store)


def _leave_nothing(store: str, cell: str, log: Journal) -> None:
    """Remove a cell at its end."""
    try:
        _forget(store, cell)
    except LinkError as error:
        log.write("failure", "the rows of the cell are left in the database", f"{cell}: {error}")


def _forget(store: str, cell: str) -> None:
    """Remove a cell from a database.

    Raises:
        LinkError: The database cannot be used.
    """
    address = StoreAddress(store, cell, "", LEASE_S)
    try:
        require_driver(store)
        from enact_dist.link.offline.database import erase_database, shards_in_database

        if shards_in_database(address):
            erase_database(address)
    except StoreError as failure:
        raise LinkError(str(failure)) from failure
