"""Checks the database of a cell with a `store`: reachable, tables, copies, who serves."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from enact_dist.config.types import CellConfig, without_password
from enact_dist.errors import StoreError
from enact_dist.operate.doctor_cell import Finding, fail, ok, warn

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from enact_dist.link.postgres.examine import DatabaseReport

_BEING_MADE: Final = "pg_basebackup"
"""As what a standby is connected that is not there yet."""


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
    return lambda shard: _holder(found, shard)


def overview(config: CellConfig) -> Iterator[str]:
    """Yield who serves and who stands by, a line for each shard, and how many copies there are."""
    try:
        found = database_of(config)
    except StoreError as error:
        yield f"store: {error}"
        return
    if found.problem:
        shown = without_password(config.store)
        yield f"store: {shown} cannot be used: {found.problem}; {found.remedy}"
        return
    for shard in config.shards:
        yield f"shard {shard.name}: {_holder(found, shard.name)}"
    copies = _copies(found)
    yield f"{copies.subject}: {copies.text}"


def _holder(found: DatabaseReport, shard: str) -> str:
    row = found.shards.get(shard)
    if row is None or not (row.holder or row.standbys):
        return "no process holds it in its database, and none stands by"
    return f"{row.served}, as its database says; {row.stands_by or 'no standby is seen'}"


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
    if len(found.copies) == 1:
        return ok(subject, f"two, as {found.copies[0]} confirms each commit{others}")
    if found.copies:
        return ok(subject, f"at least two, as {', '.join(found.copies)} confirm commits{others}")
    if found.named:
        return fail(
            subject,
            f"synchronous_standby_names is {found.named!r}, and no such standby is connected, so no"
            f" commit ends{others}",
            "start the standby, or let the database's manager take it out of the setting; if this"
            " user cannot see standbys: GRANT pg_monitor",
        )
    alone = "one: a commit stands on the database's one host, and is lost with it"
    if any(one.startswith(_BEING_MADE) for one in found.others):
        return warn(subject, f"{alone}; a second one is being made", "wait until it is made")
    return warn(
        subject,
        f"{alone}{others}",
        "start the host that is away, or add a synchronous standby (synchronous_standby_names)",
    )
