"""One run: a cell on hosts of its own, clients, faults, rest, and a last look at everything."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from enact_dist.config.types import without_password
from enact_dist.errors import ConfigError, LinkError
from enact_dist.verify.chaos import daemon
from enact_dist.verify.chaos.cell import END_S, TestedCell
from enact_dist.verify.chaos.evidence import FAULTS, SETTINGS
from enact_dist.verify.chaos.faults import DECK, FaultInjector, StagedRun
from enact_dist.verify.chaos.journal import Journal
from enact_dist.verify.chaos.network.hosts import open_hosts
from enact_dist.verify.chaos.replicated import daemon as replicated_daemon
from enact_dist.verify.chaos.replicated.stage import NODES, stage_replicated
from enact_dist.verify.checker import LockOutcome

TTL_S: Final = 1.0
CLIENTS_PER_HOST: Final = 2
WATCHER_HOST: Final = "watch"
REST_S: Final = 30.0
"""How long locks may be left after the last client has gone; leases end after one TTL."""


@dataclass(frozen=True, slots=True)
class ChaosSettings:
    """The settings of a run.

    Attributes:
        seconds: How long faults happen.
        seed: What faults and clients are drawn from.
        namespaces_required: Whether to fail where there are no network namespaces.
        daemon_module: Runs a shard; tests put a broken one in its place.  "": as usual.
        deck: How many faults of each kind come in turn; None: as usual.
        store: Address of a database that keeps the shards, `NODES`: two servers of the run's own,
            "": folders do.
    """

    seconds: float
    seed: int
    shards: int = 3
    actors: int = 8
    namespaces_required: bool = False
    daemon_module: str = ""
    deck: Mapping[str, int] | None = None
    store: str = ""


def run(settings: ChaosSettings, folder: Path, *, progress: Callable[[str, float], None]) -> None:
    """Run once; everything that happened is in `folder` afterwards, also where it went wrong.

    Args:
        settings: What to do.
        folder: Existing and empty.
        progress: Gets what is being done, and how many seconds of faults are left.

    Raises:
        ConfigError: The folder is not empty, or the settings exclude each other.
        LinkError: Namespaces are required and cannot be made, or the database cannot be used.
    """
    if any(folder.iterdir()):
        raise ConfigError(f"{folder} is not empty; name a new folder")
    shards = tuple(f"s{index}" for index in range(settings.shards))
    groups = tuple(f"g{index}" for index in range(-(-settings.actors // CLIENTS_PER_HOST)))
    log = Journal(folder / FAULTS)
    with ExitStack() as undo:
        undo.callback(log.close)
        staged = _stage(settings, folder, log, shards, groups, undo)
        told = {
            "seed": settings.seed,
            "seconds": settings.seconds,
            "shards": settings.shards,
            "actors": settings.actors,
            "ttl_s": TTL_S,
            "missing": staged.hosts.missing,
            "groups": {f"a{i}": groups[i // CLIENTS_PER_HOST] for i in range(settings.actors)},
        }
        if settings.store:
            told["store"] = without_password(settings.store)
        (folder / SETTINGS).write_text(json.dumps(told, indent=1) + "\n")
        progress("starting", settings.seconds)
        cell = staged.cell
        try:
            cell.start(shards, told["groups"], watcher_host=WATCHER_HOST)  # type: ignore[arg-type]
            try:
                staged.injector.run(
                    settings.seconds, progress=lambda left_s: progress("faults", left_s)
                )
            except LinkError as error:  # the last look is for the other anomalies
                log.write("failure", "a process failed", str(error))
            progress("coming to rest", 0.0)
            _rest(cell, log)
        except LinkError as error:
            log.write("failure", "a process failed", str(error))


def _stage(
    settings: ChaosSettings,
    folder: Path,
    log: Journal,
    shards: tuple[str, ...],
    groups: tuple[str, ...],
    undo: ExitStack,
) -> StagedRun:
    """Make the hosts, the cell, and what harms them."""
    seed = settings.seed
    if settings.store:
        if settings.namespaces_required and settings.store != NODES:
            raise ConfigError(
                "--require-namespaces: no network of a run leads to the database of --store;"
                " leave one of them out, or say --store nodes"
            )
        return stage_replicated(
            settings.store,
            folder,
            log,
            shards,
            groups,
            undo,
            watcher=WATCHER_HOST,
            seed=seed,
            ttl_s=TTL_S,
            deck=settings.deck,
            daemon_module=settings.daemon_module or replicated_daemon.MODULE,
        )
    required = settings.namespaces_required
    hosts = open_hosts((*shards, *groups, WATCHER_HOST), seed=seed, required=required)
    undo.callback(hosts.close)
    module = settings.daemon_module or daemon.MODULE
    cell = TestedCell(folder, hosts, shards, log, ttl_s=TTL_S, seed=seed, daemon_module=module)
    undo.callback(cell.close)
    deck = settings.deck or DECK
    injector = FaultInjector(cell, hosts, groups, log, seed=seed, ttl_s=TTL_S, deck=deck)
    return StagedRun(hosts, cell, injector)


def _rest(cell: TestedCell, log: Journal) -> None:
    """Let everything end by itself, and check the final state."""
    cell.wait_ready()
    for client in cell.clients.values():
        client.process.tell("stop")
    for client in cell.clients.values():
        client.process.expect("done", timeout_s=END_S)
    cell.watcher.tell("final")
    told = cell.watcher.expect("final", timeout_s=END_S)
    if told != LockOutcome.COMMITTED.value:
        log.write("failure", "not everything can be read at the end", told)
    cell.watcher.tell(f"rest {REST_S}")
    left = int(cell.watcher.expect("left", timeout_s=END_S))
    if left:
        what = f"{left} locks" if left > 0 else "a shard that does not answer"
        log.write("failure", "a lock is left", what)
    cell.watcher.tell("end")
    cell.watcher.expect("done", timeout_s=END_S)
    cell.end_shards()


def seed_of_now() -> int:
    """Return a seed that no run had before."""
    return (time.time_ns() // 1000 ^ os.getpid()) % 10**9
