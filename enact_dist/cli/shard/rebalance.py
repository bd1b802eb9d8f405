"""`enact shard rebalance`: moves entities to where cell.toml places them, while it is stopped."""

from __future__ import annotations

import socket
import sys
import time
from collections import Counter
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final

from enact_dist.cli.arguments import pairs
from enact_dist.cli.shard.shard import refuse_shared, whole_store
from enact_dist.cli.target import cell_config
from enact_dist.cli.text.output import ProgressLine, print_table, shown_bytes
from enact_dist.cli.verbs import Output
from enact_dist.errors import ConfigError, StoreError
from enact_dist.world.trees import shown_s

if TYPE_CHECKING:
    import argparse

    from enact_dist.config.types import CellConfig, ShardConfig
    from enact_dist.link.offline.rebalance import Rebalance

LISTED_MAX: Final = 20
"""So many moves are listed one by one for people; `--json` lists all."""


def run_rebalance(options: argparse.Namespace) -> Output:
    """Move what has to be moved; it may be killed at any time and called again."""
    from enact_dist.link.offline.rebalance import look, rebalance

    config = cell_config(options)
    stores = pairs(options.store, "--store")
    placement = config.placement_map()
    progress = _Shown()
    folders: dict[str, Path] = {}
    try:
        if config.store:
            found = _in_database(config, stores, options, progress)
        else:
            folders = _folders(config, stores, options.new)
            if options.dry_run:
                found = look(folders, placement)
            else:
                found = rebalance(folders, placement, unix_s=int(time.time()), progress=progress)
    finally:
        progress.line.end()
    _name_others(config, folders)
    moves = [move._asdict() for move in found.moves]
    facts = {"done": not options.dry_run, "resumed": found.resumed, "moves": moves}
    return Output(facts, partial(_print, found, dry_run=options.dry_run))


def _in_database(
    config: CellConfig, stores: dict[str, str], options: argparse.Namespace, progress: _Shown
) -> Rebalance:
    """Move what has to be moved in the database of a cell, in one transaction."""
    address = whole_store(config, stores)
    from enact_dist.link.offline.database import rebalance_database

    for name in options.new:
        config.shard(name)
    return rebalance_database(
        address,
        config.placement_map(),
        new=options.new,
        unix_s=int(time.time()),
        dry_run=options.dry_run,
        progress=progress,
    )


def _folders(config: CellConfig, stores: dict[str, str], new: list[str]) -> dict[str, Path]:
    """Return the folder of each shard of the cell, and of each further one that is named.

    Raises:
        ConfigError: One is not known, or not there and not said to be new.
    """
    from enact_dist.link.folder.folder import holds_store

    known = [shard.name for shard in config.shards]
    for name in new:
        config.shard(name)
    folders = {shard.name: _folder(shard, stores, new, config) for shard in config.shards}
    for name in stores.keys() - set(known):
        folders[name] = Path(stores[name])
        if not holds_store(folders[name]):
            raise ConfigError(f"--store {name}={stores[name]}: no shard has its data there")
    refuse_shared(folders)
    return folders


def _name_others(config: CellConfig, folders: dict[str, Path]) -> None:
    """Say where else entities lie: a shard that has left the cell must be named to be emptied."""
    from enact_dist.link.folder.folder import stores_in
    from enact_dist.link.store.store import read_store

    parent = config.data_folder
    known = {folder.resolve() for folder in folders.values()}
    for path in stores_in(parent) if parent is not None and parent.is_dir() else ():
        if path.resolve() in known:
            continue
        with suppress(StoreError), read_store(path) as stored:
            count = len({record.slot.entity for record in stored.slots})
            if count:
                print(
                    f"enact: {path} has {count} entities of a shard that is not in {config.path};"
                    f" if it was one of this cell, say --store {path.name}={path}",
                    file=sys.stderr,
                )


def _folder(shard: ShardConfig, stores: dict[str, str], new: list[str], config: CellConfig) -> Path:
    from enact_dist.link.folder.folder import holds_store

    name = shard.name
    folder = Path(stores[name]) if name in stores else shard.folder
    if folder is None:
        raise ConfigError(
            f"{config.path}: shard {name} keeps its data in memory only, so nothing can be moved"
            " while it is stopped; give it a `folder`, or the cell a `data_folder`"
        )
    elsewhere = shard.host not in {"", socket.gethostname()} and name not in stores
    if elsewhere or (name not in new and not holds_store(folder)):
        where = f"is on host {shard.host}" if elsewhere else f"has no data in {folder}"
        raise ConfigError(
            f"shard {name} {where}: copy its folder here and name it with --store {name}=PATH;"
            f" if the shard is new, say --new {name}{' as well' if elsewhere else ''}"
            " (see docs/operations.md)"
        )
    return folder


def _print(found: Rebalance, *, dry_run: bool) -> None:
    moves = found.moves
    versions = sum(move.states for move in moves)
    total = f"{len(moves)} entities with {versions} versions"
    if not moves:
        print("every entity is where it belongs")
    elif dry_run and len(moves) <= LISTED_MAX:
        print_table(
            ("entity", "from", "to", "versions", "data"),
            [(m.entity, m.source, m.target, m.states, _shown(m.size)) for m in moves],
            empty="",
        )
    else:
        ways = [(move.source, move.target) for move in moves]
        sizes: Counter[tuple[str, str]] = Counter()
        for way, move in zip(ways, moves, strict=True):
            sizes[way] += move.size
        rows = [(*way, count, _shown(sizes[way])) for way, count in Counter(ways).items()]
        print_table(("from", "to", "entities", "data"), rows, empty="")
    if found.resumed:
        print("an earlier rebalance was cut off; this is what it had left")
    if moves:
        print(f"{'would move' if dry_run else 'moved'} {total}")


def _shown(size: int) -> str:
    return shown_bytes(size) if size else ""


class _Shown:
    """Keeps one line of a terminal up to date."""

    def __init__(self) -> None:
        self.line = ProgressLine()
        self._so_far = ""

    def act(self, name: str) -> None:
        """Show what is done next."""
        self.line.show(f"{self._so_far}{name}", at_once=True)

    def moved(self, entities: int, size: int) -> None:
        """Show how much is where it belongs."""
        self._so_far = f"{entities} entities with {shown_bytes(size)} moved; "

    def waits(self, wait_s: float) -> None:
        """Show what is waited for."""
        self.act(f"waiting {shown_s(wait_s)} for leases to end")
