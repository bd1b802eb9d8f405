"""`enact shard forget`: lets aspects go with all their data, while the cell is stopped.

It is how the type of an aspect changes: a shard that knows nothing of an aspect takes whatever type
it is registered with next.
"""

from __future__ import annotations

import shlex
import socket
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from enact_dist.cli.arguments import pairs
from enact_dist.cli.shard.shard import refuse_shared, whole_store
from enact_dist.cli.target import cell_config
from enact_dist.cli.text.output import ProgressLine, print_table, shown_bytes
from enact_dist.cli.verbs import DONE, FAILED, Output
from enact_dist.errors import ConfigError

if TYPE_CHECKING:
    import argparse
    from collections.abc import Iterable

    from enact_dist.config.types import CellConfig
    from enact_dist.link.offline.forgetting import Purged


def run_forget(options: argparse.Namespace) -> Output:
    """Say what goes and let it go; it may be killed at any time and called again."""
    from enact_dist.link.offline.forgetting import forget, look

    config = cell_config(options)
    stores = pairs(options.store, "--store")
    database = whole_store(config, stores) if config.store else None
    folders, elsewhere = ({}, []) if database else _folders(config, stores, options)
    if not options.aspects and not options.unused:
        raise ConfigError("name the aspects to forget, or --unused for all without data")
    with_data = len(config.shards if database else [s for s in config.shards if s.folder])
    some = len(options.shard or config.shards) if database else len(folders)
    if options.unused and some < with_data:
        raise ConfigError(
            f"--unused needs the data of all shards, but {'; '.join(elsewhere) or 'not all'}:"
            " name the folders of the others with --store"
        )
    if not folders and database is None:
        raise ConfigError(f"no shard of {config.path} has its data here: {'; '.join(elsewhere)}")
    told = _Told(as_json=options.json, goes="goes" if options.yes else "would go")
    unused = config.worlds if options.unused else None
    try:
        if database is not None:
            from enact_dist.link.offline.database import forget_database

            found = forget_database(
                database, options.aspects, only=options.shard, now_ns=time.time_ns(),
                unused=unused, dry_run=not options.yes, progress=told,
            )  # fmt: skip
        elif options.yes:
            found = forget(
                folders, options.aspects, now_ns=time.time_ns(), unused=unused, progress=told
            )
        else:
            found = look(folders, options.aspects, unused=unused, progress=told)
    finally:
        told.line.end()
    for line in elsewhere:
        print(f"enact: {line}", file=sys.stderr)
    goes = bool(found.going or found.resumed or found.worlds)
    refused = goes and not (options.yes or options.dry_run)
    if refused:
        named = ["--unused"] if options.unused else found.aspects or found.done
        words = _command(named, options.shard)
        print(f"enact: nothing was changed; to let it go: {words}", file=sys.stderr)
    return Output(
        _facts(found, elsewhere, done=options.yes),
        _end(found) if goes and options.yes else "",
        status=FAILED if refused else DONE,
    )


def _command(aspects: Iterable[str], shards: Iterable[str] = ()) -> str:
    only = [word for name in shards for word in ("--shard", name)]
    return shlex.join(["enact", "shard", "forget", *aspects, *only, "--yes"])


def _folders(
    config: CellConfig, stores: dict[str, str], options: argparse.Namespace
) -> tuple[dict[str, Path], list[str]]:
    """Return the folders of the shards that have data here, and remarks about the others."""
    from enact_dist.link.folder.folder import holds_store

    for name in (*stores, *options.shard):
        config.shard(name)
    folders: dict[str, Path] = {}
    elsewhere: list[str] = []
    command = f"`{_command(options.aspects)}`"
    for shard in config.shards:
        if options.shard and shard.name not in options.shard:
            continue
        folder = Path(stores[shard.name]) if shard.name in stores else shard.folder
        if folder is None:
            elsewhere.append(
                f"shard {shard.name} keeps its data in memory only: it forgets all when it stops"
            )
        elif shard.host not in {"", socket.gethostname()} and shard.name not in stores:
            elsewhere.append(
                f"shard {shard.name} is on host {shard.host}: run {command} there as well, before"
                " any shard starts"
            )
        elif not holds_store(folder):
            elsewhere.append(
                f"shard {shard.name} has no data in {folder}: if it has run on another host, run"
                f" {command} there as well, before any shard starts"
            )
        else:
            folders[shard.name] = folder
    refuse_shared(folders)
    return folders, elsewhere


def _facts(found: Purged, elsewhere: list[str], *, done: bool) -> dict[str, Any]:
    return {
        "done": done,
        "resumed": found.resumed,
        "aspects": found.aspects,
        "worlds": found.worlds,
        "forgotten_before": found.done,
        "going": [each._asdict() for each in found.going],
        "elsewhere": elsewhere,
    }


def _end(found: Purged) -> str:
    slots, versions = sum(g.slots for g in found.going), sum(g.versions for g in found.going)
    names = ", ".join(found.aspects or found.done)
    worlds = f"{len(found.worlds)} world contexts without data" if found.worlds else ""
    if not names:
        return f"forgot {worlds}; the shards may start"
    names += f", and {worlds}" if worlds else ""
    return (
        f"forgot {names}: {slots} slots with {versions} versions; the shards may start, and take"
        " whatever type is registered next"
    )


def _shown(size: int) -> str:
    return shown_bytes(size) if size else "-"


class _Told:
    """Says what goes before it does, and keeps one line of a terminal up to date."""

    def __init__(self, *, as_json: bool, goes: str) -> None:
        self.line = ProgressLine()
        self._as_json = as_json
        self._goes = goes

    def found(self, found: Purged) -> None:
        """Say what goes."""
        self.line.end()
        if self._as_json:
            return
        if found.done:
            print(f"a run that had forgotten {', '.join(found.done)} was cut off at its end")
        if found.resumed and (found.aspects or not found.done):
            print("an earlier run was cut off; this is what it had left")
        if found.worlds:
            more = f" and {len(found.worlds) - 10} more" if len(found.worlds) > 10 else ""
            print(
                f"{self._goes}: {len(found.worlds)} world contexts without data:"
                f" {', '.join(found.worlds[:10])}{more}"
            )
        if not found.aspects:
            return
        print_table(
            ("shard", "aspect", "type", "slots", "versions", "data", "kept by labels"),
            [
                (g.shard, g.aspect, g.type or "-", g.slots, g.versions, _shown(g.size),
                 f"{g.kept} ({', '.join(g.labels)})" if g.kept else "-")
                for g in found.going
            ],
            empty=f"nothing is here any more of {', '.join(found.aspects)}",
        )  # fmt: skip
        if found.going:
            versions = sum(g.versions for g in found.going)
            size = sum(g.size for g in found.going)
            data = f" with {shown_bytes(size)}" if size else ""
            print(f"{self._goes}: {versions} versions{data}, for good", flush=True)

    def act(self, name: str) -> None:
        """Show what is done next."""
        self.line.show(name, at_once=True)
