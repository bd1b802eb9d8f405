"""The rows and bodies of one shard in a PostgreSQL database.

Each batch is one statement (with large bodies: one transaction) that also is the fence and the
renewal of the lease: it writes nothing unless the shard's row still has this epoch and the number
of the batch before.  So an old daemon cannot write, and a batch whose answer was lost is written
exactly once.
"""

from __future__ import annotations

from contextlib import AbstractContextManager, contextmanager
from typing import TYPE_CHECKING, Any, Final

import psycopg
from psycopg.types.numeric import Int8

from enact_dist.core.failover.lease import BrokenBatch, after_break
from enact_dist.errors import StoreError
from enact_dist.link.postgres.bodies import PART_BYTES, BodiesToWrite, NewBody
from enact_dist.link.postgres.connection import CONFIRMED, RECEIVED, DatabaseSession, in_one_line
from enact_dist.link.postgres.line import HeldRow, Line, Renewer
from enact_dist.link.postgres.tables import PUT_BODY, WRITE

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from enact_dist.link.folder.blobs import Blob
    from enact_dist.link.store.database import DatabaseRow

_PARTS_AT_ONCE: Final = (4 << 20) // PART_BYTES
"""Parts of a body in one message: what client and server hold of it at once."""


class PostgresMedium:
    """See `link.store.media.Medium` and `link.lease.Holding`; it closes its `renewer`."""

    tired = False

    def __init__(self, tenure: HeldRow, session: DatabaseSession, renewer: Renewer) -> None:
        self.name = tenure.name
        self.holding = self
        self.bodies = BodiesToWrite(tenure.epoch)
        self.lease = tenure.lease
        self.on_failure, self.on_move = renewer.on_failure, renewer.on_move
        self.line = Line(tenure, session)
        self._tenure = tenure
        self._renewer = renewer
        self._failed = self._closed = False

    def commit(
        self,
        batch: int,
        rows: Sequence[DatabaseRow],
        gone: Iterable[int],
        unnamed: Iterable[Blob] = (),
        *,
        forced: bool,
    ) -> None:
        """Put `rows` and new bodies, delete rows and bodies, atomically and exactly once.

        Raises:
            ShardTakenError: Another process has the shard.
            StoreError: The database warned.
            psycopg.Error: As the database reports it.
        """
        self._failed = True
        tenure = self._tenure
        gone, unnamed, new = list(gone), list(unnamed), self.bodies.take()

        def act(session: DatabaseSession) -> None:
            session.commit_as(CONFIRMED if forced else RECEIVED)
            send_batch(
                session.connection, tenure.shard, tenure.epoch, batch, rows, gone, unnamed, new
            )

        def done(session: DatabaseSession) -> bool:
            became = after_break(self.line.reached(session), epoch=tenure.epoch, batch=batch)
            if became is BrokenBatch.TAKEN:
                raise self.line.taken()
            return became is BrokenBatch.STANDS

        self.line.again(act, done)
        self._failed = False

    def rest(self) -> None:
        """Do nothing: the database cleans up by itself."""

    @property
    def copies(self) -> int:
        """See `Renewer`."""
        return self._renewer.copies

    @property
    def waits_s(self) -> float:
        """See `Line`."""
        return self.line.waits_s

    def end_soon(self) -> None:
        """Let whatever cannot reach the database fail soon; from any thread."""
        self.line.end_soon()
        self._renewer.end_soon()

    def close(self) -> None:
        """Free the shard for a standby, and close the connections; idempotent."""
        if self._closed:
            return
        self._closed = True
        self.end_soon()
        self._renewer.close()
        if not self._failed:
            self.line.resign()
        self.line.close()

    def errors(self) -> AbstractContextManager[None]:
        """Return `database_errors` of this shard."""
        return database_errors(self.name)


def send_batch(
    connection: psycopg.Connection[tuple[Any, ...]],
    shard: int,
    epoch: int,
    batch: int,
    rows: Sequence[DatabaseRow],
    gone: Iterable[int],
    unnamed: Iterable[Blob],
    new: Sequence[NewBody],
) -> None:
    """Write a batch of a shard, with its bodies in one transaction.

    Raises:
        psycopg.Error: As the database reports it; without its row of the fence, nothing is written
            and this is an `errors.DivisionByZero`.
    """
    values = (
        Int8(batch),
        Int8(shard),
        Int8(epoch),
        Int8(batch - 1),
        [Int8(row_id) for row_id in gone],
        [blob.name for blob in unnamed],
        [Int8(row.id) for row in rows],
        [Int8(row.kind) for row in rows],
        [Int8(batch)] * len(rows),
        [row.key for row in rows],
        [row.body for row in rows],
        [Int8(row.crc) for row in rows],
    )
    if not new:
        connection.execute(WRITE, values)
        return
    with connection.pipeline(), connection.transaction():
        for name, parts in new:
            for first in range(0, len(parts), _PARTS_AT_ONCE):
                some = parts[first : first + _PARTS_AT_ONCE]
                connection.execute(PUT_BODY, (Int8(shard), name, Int8(first), some))
        connection.execute(WRITE, values)


@contextmanager
def database_errors(name: str) -> Iterator[None]:
    """Raise a `StoreError` that tells an operator what to do about an error of the database.

    Raises:
        StoreError: In place of an error of the driver.
    """
    try:
        yield
    except psycopg.Error as failure:
        found = in_one_line(failure)
        code = f" (SQLSTATE {failure.sqlstate})" if failure.sqlstate else ""
        raise StoreError(
            f"{name}: the database reports {found}{code}: {remedy_of(failure)}; all acknowledged"
            " data are kept",
            path=name,
        ) from failure


def remedy_of(failure: psycopg.Error) -> str:
    """Return what an operator can do about an error."""
    kind, text = (failure.sqlstate or "")[:2], str(failure)
    if kind == "28" or "password" in text or "role " in text:
        return "correct the user or password in ENACT_STORE, ~/.pgpass or pg_hba.conf"
    if kind == "42":
        return "let this user make the schema enact (GRANT CREATE ON DATABASE), or own its tables"
    if kind == "53":
        return "free space on the database's disk, or raise its limits, and start the shard again"
    if kind == "3D" or ("database " in text and "does not exist" in text):
        return "create the database (createdb), or correct `store` in cell.toml"
    if not kind:
        return "look whether it runs and takes writes (enact doctor), and start the shard again"
    return "look at the database's log, and start the shard again"
