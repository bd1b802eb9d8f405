"""Asks the daemon that serves a shard to hand it over to a certain standby.

The request stands in the shard's row, beside its holder, so each user who may write to the database
may make it.  The daemon finds it at its next renewal.
"""

from __future__ import annotations

from typing import NamedTuple

from enact_dist.errors import StoreError
from enact_dist.link.postgres.address import NamedHolder, StoreAddress
from enact_dist.link.postgres.connection import CONFIRMED, connector_of
from enact_dist.link.postgres.examine import ShardRow, examine_database
from enact_dist.link.postgres.medium import database_errors
from enact_dist.link.postgres.tables import MOVE


class AskedMove(NamedTuple):
    """A hand-over that was asked for: from which process to which, in which epoch."""

    holder: str
    to: str
    epoch: int


def ask_to_move(address: StoreAddress, host: str) -> AskedMove:
    """Ask for a standby on `host`, named with its process if it has several.

    Raises:
        StoreError: No such standby is seen, no process serves the shard, or the database cannot be
            used.
    """
    row = _row(address)
    to = _standby(address.shard, row, host)
    with database_errors(str(address)):
        session = connector_of(address).connect()
        try:
            session.commit_as(CONFIRMED)
            asked = str(NamedHolder(row.holder, to))
            values = (asked, address.cell, address.shard, row.epoch, row.holder)
            if session.row(MOVE, values) is None:
                raise StoreError(
                    f"shard {address.shard} has another holder than process {row.holder} by now, or"
                    " is asked to move already: look with enact doctor, and try again"
                )
        finally:
            session.close()
    return AskedMove(row.holder, to, row.epoch)


def holder_of(address: StoreAddress) -> str:
    """Return the process that serves a shard.

    Raises:
        StoreError: None does, or the database cannot be used.
    """
    return _row(address).holder


def _row(address: StoreAddress) -> ShardRow:
    report = examine_database(address.url, address.cell)
    if report.problem:
        raise StoreError(f"{address} cannot be used: {report.problem}; {report.remedy}")
    row = report.shards.get(address.shard)
    if row is None or not row.holder:
        raise StoreError(
            f"no process serves shard {address.shard}, so none can hand it over: start one with"
            f" `enact shard run {address.shard} --standby`"
        )
    return row


def _standby(shard: str, row: ShardRow, host: str) -> str:
    """Return the one standby that is meant."""
    meant = [who for who in row.standbys if host in (who, who.partition(" ")[0])]
    if len(meant) == 1:
        return meant[0]
    if meant:
        raise StoreError(
            f"{len(meant)} daemons stand by for shard {shard} on {host}: name one of them:"
            f" {', '.join(map(repr, meant))}"
        )
    if host in (row.holder, row.holder.partition(" ")[0]):
        raise StoreError(f"shard {shard} is on {host} already: process {row.holder} serves it")
    seen = f"those on {', '.join(row.standbys)} do" if row.standbys else "none does anywhere"
    raise StoreError(
        f"no daemon stands by for shard {shard} on {host} ({seen}, and process {row.holder} serves"
        f" it): run `enact shard run {shard} --standby` there, or correct --to"
    )
