"""Looks at the database of a cell for an operator: whether it answers, what it holds, its copies.

It changes nothing and takes nothing over.
"""

from __future__ import annotations

import time
from contextlib import closing, suppress
from dataclasses import dataclass, field
from typing import Any, Final

import psycopg

from enact_dist.errors import StoreError
from enact_dist.link.postgres.address import NamedHolder, StandbyFigures
from enact_dist.link.postgres.connection import Connector, DatabaseSession, in_one_line, myself
from enact_dist.link.postgres.line import RENEW_S
from enact_dist.link.postgres.medium import remedy_of
from enact_dist.link.postgres.tables import (
    COPIES,
    MISSING,
    SHARDS,
    STANDBYS,
    read_standby,
    state_of_shard,
)

BEAT_S: Final = 2.5 * RENEW_S
"""Within that a holder that lives has renewed its lease."""
LOOK_S: Final = 0.05
"""How often that is looked at: the database tells of no beat."""
_SYNCHRONOUS: Final = frozenset({"sync", "quorum"})


@dataclass(frozen=True, slots=True)
class ShardRow:
    """A shard in a database.

    Attributes:
        holder: Host and process that serve it; empty: none does.
        batch: Number of its newest batch.
        standbys: Hosts and processes that stand by for it, with what they have counted.
        alive: Whether the holder renewed its lease while this was looked at.
    """

    holder: str
    epoch: int
    batch: int
    standbys: dict[str, StandbyFigures] = field(default_factory=dict)
    alive: bool = False

    @property
    def served(self) -> str:
        """By whom it is served, for people."""
        if not self.holder:
            return "served by no process"
        return (
            f"served by {self.holder}"
            if self.alive
            else f"last served by {self.holder}, which shows no sign of life"
        )

    @property
    def stands_by(self) -> str:
        """Who stands by, for people; empty: no process does."""
        who = ", ".join(f"{who}{figures.in_words}" for who, figures in self.standbys.items())
        return f"{who} stands by" if who else ""


@dataclass(slots=True)
class DatabaseReport:
    """What was found of a database.

    Attributes:
        problem: Why it cannot be used; empty: it can.
        remedy: What to do about that.
        took_s: How long a connection took.
        missing: Tables that are not there.
        copies: Names of the standbys that confirm commits.
        others: Names of other standbys, with their states.
        named: What `synchronous_standby_names` says.
    """

    problem: str = ""
    remedy: str = ""
    took_s: float = 0.0
    version: str = ""
    missing: tuple[str, ...] = ()
    copies: tuple[str, ...] = ()
    others: tuple[str, ...] = ()
    named: str = ""
    shards: dict[str, ShardRow] = field(default_factory=dict)


def examine_database(url: str, cell: str) -> DatabaseReport:
    """Look at the database of a cell."""
    found = DatabaseReport()
    started_s = time.monotonic()
    try:
        session = Connector(url, f"enact doctor on {myself()}").connect()
    except psycopg.Error as error:
        found.problem, found.remedy = in_one_line(error), remedy_of(error)
        return found
    found.took_s = time.monotonic() - started_s
    try:
        _fill(found, session, cell)
    except psycopg.Error as error:
        found.problem, found.remedy = in_one_line(error), remedy_of(error)
    except StoreError as error:
        found.problem, found.remedy = str(error), "look at the database's log"
    finally:
        session.close()
    return found


def _renewed(
    session: DatabaseSession, cell: str, before: dict[int, tuple[Any, ...]]
) -> list[tuple[Any, ...]]:
    """Return the rows of shards once each holder has renewed its lease, or had the time for it."""
    end_s = time.monotonic() + BEAT_S
    while True:
        rows = session.connection.execute(SHARDS, (cell,)).fetchall()
        still = [row for row in rows if row[-1] and row == before.get(row[0])]
        if not still or time.monotonic() > end_s:
            return rows
        time.sleep(LOOK_S)


def standbys_of(url: str, cell: str, shard: str) -> dict[str, StandbyFigures]:
    """Return who stands by for a shard, with what they have counted; empty if it cannot be seen."""
    with (
        suppress(psycopg.Error, StoreError),
        closing(Connector(url, f"enact on {myself()}").connect()) as session,
    ):
        row = session.row(*state_of_shard(cell, shard))
        return _standbys(session).get(row[0], {}) if row is not None else {}
    return {}


def _standbys(session: DatabaseSession) -> dict[int, dict[str, StandbyFigures]]:
    found: dict[int, dict[str, StandbyFigures]] = {}
    for (text,) in session.connection.execute(STANDBYS):
        shard, who, figures = read_standby(text)
        found.setdefault(shard, {})[who] = figures
    return found


def _fill(found: DatabaseReport, session: DatabaseSession, cell: str) -> None:
    found.version = str((session.row("SHOW server_version") or ("unknown",))[0])
    found.named = str((session.row("SHOW synchronous_standby_names") or ("",))[0])
    found.missing = tuple((session.row(MISSING) or (None,))[0] or ())
    for name, sync, state in session.connection.execute(COPIES):
        if sync in _SYNCHRONOUS:
            found.copies += (name,)
        else:
            found.others += (f"{name} ({sync or 'not visible'}, {state or 'not visible'})",)
    if found.missing:
        return
    standbys = _standbys(session)
    before = {row[0]: row for row in session.connection.execute(SHARDS, (cell,))}
    for row in _renewed(session, cell, before):
        row_id, name, epoch, batch, _, text = row
        holder = NamedHolder.read(text).process
        alive = bool(holder) and row != before.get(row_id)
        found.shards[name] = ShardRow(holder, epoch, batch, standbys.get(row_id, {}), alive)
