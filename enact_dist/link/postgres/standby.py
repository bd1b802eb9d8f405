"""Waits until no other process holds a shard in a database.

A holder changes its row's beat at least every 0.4 s; `core.failover.lease` says when its lease is
over.  A lost connection, and a look that took long, count as an outage of the database.  A patient
process reads the shard ahead meanwhile.
"""

from __future__ import annotations

import time
from contextlib import ExitStack
from typing import TYPE_CHECKING, Final

from enact_dist.core.failover.lease import Standby
from enact_dist.link.postgres.address import FreeShard, NamedHolder, ShardHeldError
from enact_dist.link.postgres.ahead import ReadAhead
from enact_dist.link.postgres.connection import LOST, broken_off, connector_of, in_one_line, myself
from enact_dist.link.postgres.medium import database_errors
from enact_dist.link.postgres.opening import look
from enact_dist.link.postgres.tables import NAME_ME, name_of_standby

if TYPE_CHECKING:
    import threading
    from collections.abc import Callable

    from enact_dist.core.failover.lease import HolderRow
    from enact_dist.link.postgres.address import StoreAddress
    from enact_dist.link.postgres.connection import DatabaseSession

LOOK_S: Final = 0.1
"""How often the row is looked at."""


def wait_free(
    address: StoreAddress,
    *,
    stopped: threading.Event,
    patient: bool,
    note: Callable[[str], None],
    looked: Callable[[bool], None] = lambda _: None,
) -> FreeShard | None:
    """Wait until a shard is free; return it, None once `stopped` is set.

    Args:
        address: The shard.
        stopped: Ends the wait.
        patient: Whether to wait for the end of a holder that lives, and for the database.
        note: Called with what is waited for, once for each.
        looked: Called after each look, ten times a second, with whether the database answered.

    Raises:
        ShardHeldError: Another process holds it, and this one is not patient.
        StoreError: The database cannot be used, and this one is not patient.
    """
    connector = connector_of(address)
    watch = Standby(round(address.lease_s * 1e9))
    session: DatabaseSession | None = None
    ahead: ReadAhead | None = None
    noted, told = "", False
    with ExitStack() as undo:
        undo.enter_context(broken_off(lambda: session, stopped))
        undo.callback(lambda: session.close() if session is not None else None)
        undo.callback(lambda: ahead.stop() if ahead is not None else None)
        while not stopped.is_set():
            answered = False
            try:
                if session is None:
                    session, told = connector.connect(), False
                with connector.waiting(session):
                    shard, seen = _look(session, address, watch)
                if not told and seen.holder:
                    told = True
                    session.row(NAME_ME, (name_of_standby(shard, myself()),))
                if watch.is_free(seen, time.monotonic_ns()):
                    rows = ahead.stop() if ahead is not None else {}
                    return FreeShard(address, seen, rows, stopped)
                if patient and ahead is None:
                    ahead = ReadAhead(address)
                answered = True
                found = f"{address} {NamedHolder.read(seen.holder).in_words}"
                if watch.alive and not patient:
                    raise ShardHeldError(
                        f"{found}: stop it first (a daemon can stand by for it: `enact shard run"
                        f" {address.shard} --standby`)",
                        path=str(address),
                    )
            except LOST as failure:
                if not patient:
                    with database_errors(str(address)):
                        raise
                if session is not None:
                    session.close()
                    session = None
                watch.was_away()
                found = f"{address} cannot be reached: {in_one_line(failure)}"
            if found != noted:
                note(found)
                noted = found
            looked(answered)
            stopped.wait(LOOK_S)
    return None


def _look(session: DatabaseSession, address: StoreAddress, watch: Standby) -> tuple[int, HolderRow]:
    """Return the number of the shard's row, and the row."""
    began_s = time.monotonic()
    shard, seen = look(session, address)
    if time.monotonic() - began_s > address.lease_s / 2:
        watch.was_away()
    holder = NamedHolder.read(seen.holder)
    if not holder.process and holder.to == myself():
        seen = seen._replace(holder="")  # given to this process; all others wait for the lease
    return shard, seen
