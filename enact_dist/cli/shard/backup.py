"""`enact shard backup|restore`: a copy of a shard's folder, made while it runs, and back."""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

from enact_dist.cli.shard.shard import refuse_database
from enact_dist.cli.target import cell_config
from enact_dist.cli.text.output import shown_bytes
from enact_dist.cli.verbs import Output
from enact_dist.errors import ConfigError

if TYPE_CHECKING:
    import argparse

    from enact_dist.config.types import CellConfig
    from enact_dist.link.offline.backup import Backup


def run_backup(options: argparse.Namespace) -> Output:
    """Make a backup, every byte of it checked."""
    from enact_dist.link.offline.backup import back_up

    config = cell_config(options)
    backup = back_up(
        _folder(config, options),
        options.path,
        cell=config.name,
        shard=options.name,
        unix_s=int(time.time()),
    )
    return Output(backup, f"shard {backup.shard}: {_said(backup)} in {options.path}, checked")


def run_restore(options: argparse.Namespace) -> Output:
    """Put a backup in the place of a shard's folder."""
    from enact_dist.link.offline.backup import restore

    config = cell_config(options)
    folder = _folder(config, options)
    backup, aside = restore(
        options.path,
        folder,
        cell=config.name,
        shard=options.name,
        unix_s=int(time.time()),
        replace=options.replace,
    )
    if not backup.digests:
        print(
            f"enact: warning: {options.path} was made before backups had digests: what a shard's"
            " start checks was checked, and not every byte of it compared; make a new backup"
            " (see docs/operations.md)",
            file=sys.stderr,
        )
    made = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(backup.unix_s))
    text = (
        f"shard {backup.shard}: {_said(backup)} in {folder}, as of {made}\n"
        "what was committed there since is gone, and commits over several shards are half there;"
        " clients begin anew with the shard, and no lock or commit of before counts"
    )
    if aside is not None:
        text += f"\nwhat was there before is in {aside}"
    return Output({"backup": backup, "folder": folder, "before": aside}, text)


def _folder(config: CellConfig, options: argparse.Namespace) -> Path:
    if not options.folder:
        refuse_database(
            config,
            f"enact shard {options.verb.name} copies a folder",
            "pg_dump -n enact backs all shards up together, pg_restore brings them back while the"
            " cell is stopped (pg_basebackup: to a point in time), then say enact shard restored;"
            " enact shard export-store copies one shard to a folder",
        )
    folder = options.folder or config.shard(options.name).folder
    if folder is None:
        raise ConfigError(
            f"{config.path}: shard {options.name} keeps its data in memory only; there is nothing"
            " to back up or restore"
        )
    return Path(folder)


def _said(backup: Backup) -> str:
    data = f" and {shown_bytes(backup.size)}" if backup.size else ""
    return f"{backup.entities} entities with {backup.states} versions{data}"
