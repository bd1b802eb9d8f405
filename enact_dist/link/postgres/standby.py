"""Waits until no other process holds a shard in a database.

A holder changes its row's beat at least every 0.4 s; `core.failover.lease` says when its lease is
over.  A lost connection, and a look that took long, count as an outage of the database.  A patient
process reads the shard ahead meanwhile.
"""

from __future__ import annotations

import logging
import threading
import time
from contextlib import ExitStack
from typing import TYPE_CHECKING, Final

from enact_dist.core.failover.lease import Standby
from enact_dist.link.postgres.address import (
    FreeShard,
    NamedHolder,
    ShardHeldError,
    StandbyFigures,
)
from enact_dist.link.postgres.ahead import ReadAhead
from enact_dist.link.postgres.connection import LOST, broken_off, connector_of, in_one_line, myself
from enact_dist.link.postgres.medium import database_errors
from enact_dist.link.postgres.opening import look
from enact_dist.link.postgres.tables import NAME_ME, name_of_standby

if TYPE_CHECKING:
    from collections.abc import Callable

    from enact_dist.core.failover.lease import HolderRow
    from enact_dist.link.postgres.address import StoreAddress
    from enact_dist.link.postgres.connection import DatabaseSession
    from enact_dist.link.store.gathering import Rows

LOOK_S: Final = 0.1
"""How often the row is looked at."""
_log = logging.getLogger("enact.shard")


class StandbyWatch:
    """What a standby keeps from one wait for its shard to the next.

    Attributes:
        figures: What it has counted.
        rows: What was read ahead of the shard; None: nothing.
    """

    def __init__(self) -> None:
        self.figures = StandbyFigures()
        self.rows: Rows | None = None
        self._mutex = threading.Lock()
        self._slow = 0
        self._longest_s = 0.0

    def count(self, name: str) -> None:
        """Add one to a figure; from any thread."""
        with self._mutex:
            self.figures = self.figures._replace(**{name: getattr(self.figures, name) + 1})

    def shown(self) -> dict[str, int]:
        """Return the figures by name."""
        return self.figures._asdict()

    def is_stale(self, took_s: float, lease_s: float) -> bool:
        """Whether a look has taken so long that it says little; a spell of them is logged once."""
        if took_s > lease_s / 2:
            self.count("slow_looks")
            if not self._slow:
                _log.warning(
                    "a look at the shard's row took %.1f s, more than half of lease_s (%g s): this"
                    " standby does not count the rest of the time, and takes over later",
                    took_s, lease_s,
                )  # fmt: skip
            self._slow, self._longest_s = self._slow + 1, max(self._longest_s, took_s)
            return True
        if self._slow:
            _log.warning(
                "looks at the shard's row are fast again, after %d slow ones of up to %.1f s",
                self._slow, self._longest_s,
            )  # fmt: skip
            self._slow, self._longest_s = 0, 0.0
        return False


def wait_free(
    address: StoreAddress,
    *,
    stopped: threading.Event,
    patient: bool,
    note: Callable[[str], None],
    looked: Callable[[bool], None] = lambda _: None,
    watch: StandbyWatch | None = None,
) -> FreeShard | None:
    """Wait until a shard is free; return it, None once `stopped` is set.

    Args:
        address: The shard.
        stopped: Ends the wait.
        patient: Whether to wait for the end of a holder that lives, and for the database.
        note: Called with what is waited for, once for each.
        looked: Called after each look, ten times a second, with whether the database answered.
        watch: What an earlier wait has left; it is kept up to date.

    Raises:
        ShardHeldError: Another process holds it, and this one is not patient.
        StoreError: The database cannot be used, and this one is not patient.
    """
    connector = connector_of(address)
    watch, standby = watch or StandbyWatch(), Standby(round(address.lease_s * 1e9))
    session: DatabaseSession | None = None
    ahead: ReadAhead | None = None
    noted = named = ""
    with ExitStack() as undo:
        undo.enter_context(broken_off(lambda: session, stopped))
        undo.callback(lambda: session.close() if session is not None else None)
        undo.callback(lambda: ahead.stop() if ahead is not None else None)
        while not stopped.is_set():
            answered = False
            try:
                if session is None:
                    session, named = connector.connect(), ""
                with connector.waiting(session):
                    began_s = time.monotonic()
                    shard, seen = _look(session, address)
                took_s = time.monotonic() - began_s
                if watch.is_stale(took_s, address.lease_s):
                    standby.stood_still(round((took_s - address.lease_s / 2) * 1e9))
                if seen.holder:
                    named = _named(session, shard, watch.figures, named)
                if standby.is_free(seen, time.monotonic_ns()):
                    watch.rows = ahead.stop() if ahead is not None else watch.rows
                    return FreeShard(address, seen, watch.rows, stopped)
                if patient and ahead is None:
                    ahead = ReadAhead(address, watch.rows)
                answered = True
                found = f"{address} {NamedHolder.read(seen.holder).in_words}"
                if standby.alive and not patient:
                    raise _held(found, address)
            except LOST as failure:
                if not patient:
                    with database_errors(str(address)):
                        raise
                if session is not None:
                    session.close()
                    session = None
                standby.was_away()
                found = f"{address} cannot be reached: {in_one_line(failure)}"
            if found != noted:
                note(found)
                noted = found
            looked(answered)
            stopped.wait(LOOK_S)
    return None


def _held(found: str, address: StoreAddress) -> ShardHeldError:
    return ShardHeldError(
        f"{found}: stop it first (a daemon can stand by for it: `enact shard run"
        f" {address.shard} --standby`)",
        path=str(address),
    )


def _named(session: DatabaseSession, shard: int, figures: StandbyFigures, before: str) -> str:
    """Let the database list a connection as a standby's, with its figures; return the name."""
    name = name_of_standby(shard, myself(), figures)
    if name != before:
        session.row(NAME_ME, (name,))
    return name


def _look(session: DatabaseSession, address: StoreAddress) -> tuple[int, HolderRow]:
    """Return the number of the shard's row, and the row."""
    shard, seen = look(session, address)
    holder = NamedHolder.read(seen.holder)
    if not holder.process and holder.to == myself():
        seen = seen._replace(holder="")  # given to this process; all others wait for the lease
    return shard, seen
