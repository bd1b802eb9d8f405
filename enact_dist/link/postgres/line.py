"""A line to a shard's row: connects again when it is lost, and renews the shard's lease.

After a loss the next connection asks what became of an act.  *It is there* is believed only after
another commit that the standby has confirmed: the database's log is one sequence, so that confirms
all that was read before it.
"""

from __future__ import annotations

import logging
import threading
from contextlib import suppress
from typing import TYPE_CHECKING, Final, NamedTuple

import psycopg
from psycopg import errors

from enact_dist.errors import StoreError
from enact_dist.link.lease import ShardTakenError
from enact_dist.link.postgres.address import NamedHolder
from enact_dist.link.postgres.connection import CONFIRMED, LOST, in_one_line, is_lost
from enact_dist.link.postgres.tables import COUNT_COPIES, REACHED, RENEW, RESIGN

if TYPE_CHECKING:
    from collections.abc import Callable

    from enact_dist.link.lease import HostLease
    from enact_dist.link.postgres.connection import Connector, DatabaseSession

RENEW_S: Final = 0.4
"""A lease is renewed when nothing was confirmed for this long."""
LOOK_S: Final = 1.0
"""A busy store, whose batches renew its lease, is renewed this often all the same, for a look."""
COPIES_S: Final = 5.0
"""How often the database's copies are counted."""
AGAIN_S: Final = 0.1
"""Pause before another try to connect."""
FULL_S: Final = 1.0
"""Pause before another try to write to a disk that was full."""
CLOSE_S: Final = 1.0
"""How long a closing store still tries to reach its database."""
_log = logging.getLogger("enact.store")


class HeldRow(NamedTuple):
    """Which row of the shards a process holds, in which epoch, and until when it may answer."""

    connector: Connector
    shard: int
    epoch: int
    lease: HostLease
    name: str


class Trouble(NamedTuple):
    """Why a line waits.

    Attributes:
        since_s: Since when, on the clock of the lease.
        full: Whether a disk of the database is full; otherwise, it is not reached.
    """

    since_s: float
    full: bool


class Line:
    """One connection in the service of a tenure.  Used by one thread at a time, but for `end_soon`.

    Args:
        tenure: What it writes for.
        session: An open connection, None: it connects at the first act.

    Attributes:
        reconnects: How often it has connected again.
    """

    def __init__(self, tenure: HeldRow, session: DatabaseSession | None = None) -> None:
        self._tenure = tenure
        self._session = session
        self._ending = threading.Event()
        self._ends_s: float | None = None
        self._closed = threading.Event()
        self._trouble: Trouble | None = None
        self.reconnects = 0

    @property
    def waits_s(self) -> float:
        """How long the database has not taken now what it was sent, seconds."""
        trouble = self._trouble
        return self._tenure.lease.now_s() - trouble.since_s if trouble is not None else 0.0

    def end_soon(self) -> None:
        """Let an act without an answer fail after `CLOSE_S`; from any thread; idempotent."""
        if self._ending.is_set():
            return
        self._ends_s = self._tenure.lease.now_s() + CLOSE_S
        self._ending.set()
        threading.Thread(target=self._break_off, name="enact-store-end", daemon=True).start()

    def _break_off(self) -> None:
        """Once time is up, break each wait for an answer off, until the line is closed."""
        over_s = CLOSE_S
        while not self._closed.wait(over_s):
            over_s = AGAIN_S
            if (session := self._session) is not None:
                session.break_off()

    def again(
        self, act: Callable[[DatabaseSession], object], done: Callable[[DatabaseSession], bool]
    ) -> None:
        """Act, and confirm the lease; wait for the database as long as it takes.

        Args:
            act: Writes, in one transaction that is conditional on the epoch; no row of the shard
                is an `errors.DivisionByZero`.
            done: Asks whether an act whose answer was lost has been done.

        Raises:
            ShardTakenError: Another process has the shard.
            StoreError: The database warned, or stayed away from a store that ends.
            psycopg.Error: As the database reports it, except for lost connections.
        """
        tenure, uncertain = self._tenure, False
        while True:
            try:
                session = self._connected()
                sent_s = tenure.lease.now_s()
                with tenure.connector.waiting(session):
                    if uncertain and done(session):
                        self.confirm(session)
                    else:
                        uncertain = True
                        act(session)
                        session.check()
            except errors.DivisionByZero:
                # Another has the shard, or an earlier try was committed while this one waited.
                continue
            except LOST as failure:
                self._lost(failure)
                continue
            tenure.lease.confirmed(sent_s)
            self._back()
            return

    def confirm(self, session: DatabaseSession) -> str:
        """Renew the lease by a write of its own, as an act of `again`; return the row's holder.

        Raises:
            As `again`.
        """
        session.commit_as(CONFIRMED)
        found = session.row(RENEW, (self._tenure.shard, self._tenure.epoch))
        if found is None:
            raise self.taken()
        return str(found[0])

    def reached(self, session: DatabaseSession) -> tuple[int, int]:
        """Return the epoch of the shard and its newest batch, as the database shows them."""
        found = session.row(REACHED, (self._tenure.shard,))
        return (found[0], found[1]) if found is not None else (0, 0)

    def resign(self) -> None:
        """Free the shard, so that a standby need not wait for the end of the lease."""
        with suppress(psycopg.Error, StoreError):
            session = self._connected()
            session.commit_as(CONFIRMED)
            session.row(RESIGN, (self._tenure.shard, self._tenure.epoch))

    def close(self) -> None:
        """Close the connection; idempotent."""
        self._closed.set()
        self._drop()

    def _drop(self) -> None:
        if self._session is not None:
            self._session.close()
            self._session = None

    def taken(self) -> ShardTakenError:
        """Return the error of a process whose shard another one serves."""
        return ShardTakenError(
            f"{self._tenure.name} has another holder since epoch {self._tenure.epoch}: this"
            " process was silent for longer than lease_s, so a standby took over",
            path=self._tenure.name,
        )

    # ---------------------------------------------------------------- connections

    def _connected(self) -> DatabaseSession:
        if self._session is None:
            if self._over:
                raise self._ended("a connection was lost")
            self._session = self._tenure.connector.connect()
            self.reconnects += 1
        return self._session

    @property
    def _over(self) -> bool:
        """Whether the store ends, and has waited for long enough."""
        return self._ends_s is not None and self._tenure.lease.now_s() >= self._ends_s

    def _ended(self, why: object) -> StoreError:
        return StoreError(
            f"{self._tenure.name} cannot be reached ({why}), and the shard ends: what it has not"
            " acknowledged may be lost",
            path=self._tenure.name,
        )

    def _lost(self, failure: Exception) -> None:
        """Give a connection up and pause.

        Raises:
            StoreError: The store ends.
            Exception: `failure`, which no new connection mends.
        """
        if not is_lost(failure, self._session):
            raise failure
        self._drop()
        before, full = self._trouble, isinstance(failure, errors.DiskFull)
        if before is None or full != before.full:
            since_s = before.since_s if before is not None else self._tenure.lease.now_s()
            self._trouble = Trouble(since_s, full)
            what = "has no room: free some" if full else "cannot be reached"
            _log.warning("%s %s; waiting for it: %s", self._tenure.name, what, in_one_line(failure))
        if self._over:
            raise self._ended(failure) from failure
        if before is not None or full:
            pause_s = FULL_S if full else AGAIN_S
            (self._closed if self._ending.is_set() else self._ending).wait(pause_s)

    def _back(self) -> None:
        if (trouble := self._trouble) is not None:
            self._trouble = None
            what = "has room again" if trouble.full else "is reached again"
            _log.warning("%s %s", self._tenure.name, what)


class Renewer:
    """Renews the lease of an idle store, on a line and a thread of its own.

    Attributes:
        copies: How many standbys of the database confirm each commit; -1: this user cannot see it.
    """

    def __init__(self, tenure: HeldRow) -> None:
        self.copies = 0
        self._counted_s: float | None = None
        self._lease = tenure.lease
        self._line = Line(tenure)
        self._stopped = threading.Event()
        self._failure: Exception | None = None
        self._failed: Callable[[Exception], None] | None = None
        self._moves: Callable[[str], None] | None = None
        self._thread = threading.Thread(target=self._renew_on, name="enact-lease", daemon=True)
        self._thread.start()

    def on_failure(self, failed: Callable[[Exception], None]) -> None:
        """Call `failed`, once, when another process has the shard or the database warned."""
        self._failed = failed
        if self._failure is not None:
            failed(self._failure)

    def on_move(self, moves: Callable[[str], None]) -> None:
        """Call `moves`, once, with the standby that the shard is asked to go to."""
        self._moves = moves

    def check(self) -> None:
        """Raise what ended the renewals, if anything did."""
        if self._failure is not None:
            raise self._failure

    def end_soon(self) -> None:
        """Let a renewal that cannot reach the database fail soon; from any thread."""
        self._line.end_soon()

    def close(self) -> None:
        """End the renewals; idempotent."""
        self._stopped.set()
        self._line.end_soon()
        if threading.current_thread() is not self._thread:
            self._thread.join()
        self._line.close()

    def _renew_on(self) -> None:
        lease, looked_s = self._lease, self._lease.now_s()
        try:
            while not self._stopped.is_set():
                due_s = lease.left_s - lease.usable_s + RENEW_S
                if due_s <= 0 or lease.now_s() - looked_s > LOOK_S:
                    self._line.again(self._renew, lambda _: False)
                    looked_s, due_s = lease.now_s(), RENEW_S
                self._stopped.wait(max(due_s, 0.01))
        except Exception as failure:  # noqa: BLE001 - the store must not go on without a lease
            if not self._stopped.is_set():
                self._failure = failure
                if self._failed is not None:
                    self._failed(failure)

    def _renew(self, session: DatabaseSession) -> None:
        to = NamedHolder.read(self._line.confirm(session)).to
        if to and self._moves is not None:
            moves, self._moves = self._moves, None
            moves(to)
        now_s = self._lease.now_s()
        if self._counted_s is None or now_s - self._counted_s > COPIES_S:
            self._counted_s = now_s
            found = session.row(COUNT_COPIES)
            self.copies = found[0] if found is not None else 0
