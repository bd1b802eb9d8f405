"""`enact shard restored`: what operators do to a store in a database."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from enact_dist.cli.target import cell_config
from enact_dist.cli.verbs import Output
from enact_dist.errors import ConfigError

if TYPE_CHECKING:
    import argparse

    from enact_dist.config.types import CellConfig


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


def _url(config: CellConfig) -> str:
    """Return the address of the database.

    Raises:
        ConfigError: The cell keeps its data elsewhere.
        StoreError: psycopg is not installed.
    """
    from enact_dist.link.postgres.address import require_driver

    if not config.store:
        raise ConfigError(
            f"{config.path} names no database: this command works on one; write"
            ' store = "postgresql://…", or set ENACT_STORE',
            path=str(config.path),
        )
    require_driver(config.store)
    return config.store
