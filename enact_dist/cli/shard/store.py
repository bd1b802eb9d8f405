"""`enact shard restored|export-store|import-store|erase`: work on a store in a database."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from enact_dist.cli.shard.shard import refuse_password
from enact_dist.cli.target import cell_config
from enact_dist.cli.text.output import ProgressLine, shown_bytes
from enact_dist.cli.verbs import DONE, FAILED, Output
from enact_dist.config.types import CellConfig, without_password
from enact_dist.errors import ConfigError
from enact_dist.link.postgres.address import StoreAddress, require_driver

if TYPE_CHECKING:
    import argparse
    from collections.abc import Callable

    from enact_dist.link.offline.store_copy import CopiedStore


def run_restored(options: argparse.Namespace) -> Output:
    """Give shards new epochs after a restore of their database."""
    config = cell_config(options)
    url = _url(config)
    from enact_dist.link.postgres.restored import raise_epochs

    raised = raise_epochs(
        url,
        config.name,
        options.shards,
        lease_s=config.lease_s,
        unix_s=int(time.time()),
        fence=options.fence,
    )
    in_database = {each.shard for each in raised}
    new = [s.name for s in config.shards if s.name not in in_database and not options.shards]
    text = "the shards may start; no lock or commit of before counts"
    if new:
        text += f"\nthe database has no {', '.join(new)}: such a shard begins empty"
    return Output(
        {"shards": [each._asdict() for each in raised], "not_in_database": new},
        text,
        rows=[(r.shard, r.before, r.epoch, r.batch, r.holder or "-") for r in raised],
    )


def run_erase(options: argparse.Namespace) -> Output:
    """Delete what the database has of shards; without `--yes`, list it with status 1."""
    config = cell_config(options)
    address = StoreAddress(_url(config), config.name, "", config.lease_s)
    from enact_dist.link.offline.database import erase_database

    found = erase_database(address, options.shards, dry_run=not options.yes)
    return Output(
        {"done": options.yes, "shards": [each._asdict() for each in found]},
        "erased, with all history; such a shard begins empty"
        if options.yes
        else "nothing was changed; say --yes to erase them",
        rows=found,
        status=DONE if options.yes else FAILED,
    )


def run_export(options: argparse.Namespace) -> Output:
    """Copy a shard from the database to a folder."""
    from enact_dist.link.offline.store_copy import export_store

    address = _address(options)
    progress = ProgressLine()
    try:
        copied = export_store(
            address, options.path, unix_s=int(time.time()), tell=_tell_on(progress)
        )
    finally:
        progress.end()
    return _copied(copied, address, options, f"{address} is as it was", options.path)


def run_import(options: argparse.Namespace) -> Output:
    """Copy a shard from a folder to the database."""
    from enact_dist.link.offline.store_copy import import_store

    address = _address(options)
    progress = ProgressLine()
    try:
        copied = import_store(
            options.path,
            address,
            placement=cell_config(options).placement_map(),
            unix_s=int(time.time()),
            tell=_tell_on(progress),
        )
    finally:
        progress.end()
    return _copied(copied, address, options, f"{options.path} is as it was", address)


def _tell_on(progress: ProgressLine) -> Callable[[str, int, int], None]:
    def tell(what: str, done: int, of: int) -> None:
        large = what.startswith("bytes")
        shown = f"{shown_bytes(done)} of {shown_bytes(of)}" if large else f"{done} of {of}"
        progress.show(f"{shown} {what.removeprefix('bytes of ')}")

    return tell


def _copied(
    copied: CopiedStore,
    address: StoreAddress,
    options: argparse.Namespace,
    left: str,
    target: object,
) -> Output:
    facts = {
        "shard": address.shard,
        "database": without_password(address.url),
        "folder": options.path,
        **copied._asdict(),
    }
    data = f", {copied.bodies} large data with {shown_bytes(copied.size)}" if copied.bodies else ""
    return Output(
        facts,
        f"shard {address.shard}: {copied.entities} entities with {copied.states} versions"
        f" ({copied.rows} rows{data}) are in {target}, compared\n"
        f"{left}; start the shard from one of the two only: it begins above epoch {copied.epoch}"
        " in the copy",
    )


def _address(options: argparse.Namespace) -> StoreAddress:
    """Return the place of the named shard in the database."""
    config = cell_config(options)
    shard = config.shard(options.name).name
    return StoreAddress(_url(config, options.store), config.name, shard, config.lease_s)


def _url(config: CellConfig, named: str | None = None) -> str:
    """Return the address of the database.

    Raises:
        ConfigError: The cell keeps its data elsewhere, and none is named.
        MisuseError: A password is part of the command.
        StoreError: psycopg is not installed.
    """
    refuse_password(named or "")
    url = named or config.store
    if not url:
        raise ConfigError(
            f"{config.path} names no database, and this command works on one: write"
            ' store = "postgresql://…", set ENACT_STORE, or say --store where it is an option',
            path=str(config.path),
        )
    require_driver(url)
    return url
