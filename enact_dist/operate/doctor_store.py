"""Checks the database of a cell with a `store`: reachable, tables, copies, who serves."""

from __future__ import annotations

from typing import TYPE_CHECKING

from enact_dist.config.types import without_password
from enact_dist.errors import StoreError
from enact_dist.operate.doctor_cell import Finding, fail, ok, warn

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from enact_dist.config.types import CellConfig
    from enact_dist.link.postgres.examine import DatabaseReport


def database_of(config: CellConfig) -> DatabaseReport:
    """Look at the database of a cell.

    Raises:
        StoreError: No driver is installed.
    """
    from enact_dist.link.postgres.address import require_driver

    require_driver(config.store)
    from enact_dist.link.postgres.examine import examine_database

    return examine_database(config.store, config.name)


def holders(config: CellConfig) -> Callable[[str], str]:
    """Return a function that says who serves a shard and who stands by, as the database has it."""
    try:
        found = database_of(config)
    except StoreError as error:
        problem = str(error)
        return lambda _: problem
    if found.problem:
        return lambda _: f"its database cannot be used: {found.problem}; {found.remedy}"

    def why(shard: str) -> str:
        row = found.shards.get(shard)
        if row is None or not (row.holder or row.standbys):
            return "no process holds it in its database, and none stands by"
        stands_by = row.stands_by and f", {row.stands_by}"
        return f"{row.served}, as its database says{stands_by}"

    return why


def database(config: CellConfig) -> Iterator[Finding]:
    """Check the database of a cell, and who serves each of its shards."""
    shown = without_password(config.store)
    try:
        found = database_of(config)
    except StoreError as error:
        yield fail("store", str(error))
        return
    if found.problem:
        yield fail("store", f"{shown}: {found.problem}", found.remedy)
        return
    answers = f"{shown}: PostgreSQL {found.version} answers in {found.took_s * 1e3:.0f} ms"
    yield ok("store", answers)
    yield _copies(found)
    if found.missing:
        text = (
            f"{', '.join(found.missing)} are not there yet: the first start of a shard makes them"
        )
        yield ok("tables of the store", text)
        return
    for shard in config.shards:
        row = found.shards.get(shard.name)
        subject = f"store of {shard.name}"
        if row is None:
            yield ok(subject, "nothing yet: the shard has never been started")
            continue
        text = f"epoch {row.epoch}, batch {row.batch}, {row.served}"
        if row.holder and not row.alive:
            yield fail(
                subject, text, f"start it, or a standby: enact shard run {shard.name} --standby"
            )
        elif row.standbys:
            yield ok(subject, f"{text}; {row.stands_by}")
        else:
            yield warn(
                subject,
                f"{text}; no standby is seen",
                f"on another host: enact shard run {shard.name} --standby",
            )


def _copies(found: DatabaseReport) -> Finding:
    subject = "copies of the store"
    others = f"; standbys that confirm nothing: {', '.join(found.others)}" if found.others else ""
    if found.copies:
        return ok(subject, f"{', '.join(found.copies)} confirms each commit{others}")
    if found.named:
        return fail(
            subject,
            f"synchronous_standby_names is {found.named!r}, and no such standby is connected, so no"
            f" commit ends{others}",
            "start the standby, or let the database's manager take it out of the setting; if this"
            " user cannot see standbys: GRANT pg_monitor",
        )
    return warn(
        subject,
        f"one: a commit stands on the database's one host, and is lost with it{others}",
        "add a synchronous standby (synchronous_standby_names)",
    )
