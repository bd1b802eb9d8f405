"""`enact shard backup|restore`: a copy of a shard's folder, made while it runs, and back."""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

from enact_dist.cli.text.output import print_json, shown_bytes
from enact_dist.cli.verbs import DONE, add_cell, add_verb, cell_config
from enact_dist.errors import ConfigError

if TYPE_CHECKING:
    import argparse

    from enact_dist.cli.verbs import Verb
    from enact_dist.config.types import CellConfig
    from enact_dist.link.offline.backup import Backup


def add_to(verbs: argparse._SubParsersAction[Verb]) -> None:
    """Add both verbs."""
    backup = add_verb(
        verbs,
        "backup",
        "copy the data of a shard on this host to a new folder, whether it runs or not",
        run=run_backup,
        example="enact shard backup left --to backups/left-1 --cell cell.toml",
    )
    restore = add_verb(
        verbs,
        "restore",
        "let a shard that is stopped begin again with what a backup has",
        run=run_restore,
        example="enact shard restore left --from backups/left-1 --replace --cell cell.toml",
    )
    for verb, option, text in (
        (backup, "--to", "a folder that is not there yet"),
        (restore, "--from", "the folder of the backup"),
    ):
        verb.add_argument("name", metavar="NAME", help="name of the shard in cell.toml")
        verb.add_argument(option, dest="path", type=Path, required=True, metavar="DIR", help=text)
        verb.add_argument("--folder", type=Path, metavar="DIR", help="the shard's, if not as usual")
        add_cell(verb, file_only=True)
        verb.add_argument("--json", action="store_true", help="print JSON instead of a sentence")
    restore.add_argument(
        "--replace", action="store_true", help="put the present folder aside, beside it"
    )


def run_backup(arguments: argparse.Namespace) -> int:
    """Make a backup, every byte of it checked."""
    from enact_dist.link.offline.backup import back_up

    config = cell_config(arguments)
    backup = back_up(
        _folder(config, arguments),
        arguments.path,
        cell=config.name,
        shard=arguments.name,
        unix_s=int(time.time()),
    )
    if arguments.json:
        print_json(backup)
    else:
        print(f"shard {backup.shard}: {_said(backup)} in {arguments.path}, checked")
    return DONE


def run_restore(arguments: argparse.Namespace) -> int:
    """Put a backup in the place of a shard's folder."""
    from enact_dist.link.offline.backup import restore

    config = cell_config(arguments)
    folder = _folder(config, arguments)
    backup, aside = restore(
        arguments.path,
        folder,
        cell=config.name,
        shard=arguments.name,
        unix_s=int(time.time()),
        replace=arguments.replace,
    )
    if not backup.digests:
        print(
            f"enact: warning: {arguments.path} was made before backups had digests: what a shard's"
            " start checks was checked, and not every byte of it compared; make a new backup",
            file=sys.stderr,
        )
    if arguments.json:
        print_json({"backup": backup, "folder": folder, "before": aside})
        return DONE
    made = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(backup.unix_s))
    print(f"shard {backup.shard}: {_said(backup)} in {folder}, as of {made}")
    print(
        "what was committed there since is gone, and commits over several shards are half there;"
        " clients begin anew with the shard, and no lock or commit of before counts"
    )
    if aside is not None:
        print(f"what was there before is in {aside}")
    return DONE


def _folder(config: CellConfig, arguments: argparse.Namespace) -> Path:
    folder = arguments.folder or config.shard(arguments.name).folder
    if folder is None:
        raise ConfigError(
            f"{config.path}: shard {arguments.name} keeps its data in memory only; there is nothing"
            " to back up or restore"
        )
    return Path(folder)


def _said(backup: Backup) -> str:
    data = f" and {shown_bytes(backup.size)}" if backup.size else ""
    return f"{backup.entities} entities with {backup.states} versions{data}"
