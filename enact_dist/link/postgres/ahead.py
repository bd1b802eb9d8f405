"""Reads the rows of a shard while another daemon serves it, so that a takeover need not.

Rules that a change must keep:

- Nothing that was read ahead is believed.  At the takeover, after the fence, the database lists the
  number, batch and checksum of each row, and whatever differs is read then.  So rows that only a
  lost primary had, and rows that are gone, do no harm.
- A statement sees whole batches only, so rows of later batches are all there is to read again, as
  long as the connection lasts.
- Large bodies are read at the takeover: they are most of the bytes, and least of the time.
- Rows are put together as they come, which takes a third of the time of a start: what is left for
  the takeover is what the last rows have changed.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Iterator
from typing import Any, Final

import psycopg

from enact_dist.errors import StoreError
from enact_dist.link.postgres.address import StoreAddress
from enact_dist.link.postgres.connection import LOST, DatabaseSession, connector_of
from enact_dist.link.postgres.tables import LISTED, NEWER, ROWS, THESE, state_of_shard
from enact_dist.link.store.database import DatabaseRow
from enact_dist.link.store.gathering import Rows, check_row

READ_S: Final = 0.25
"""How often new rows are read."""
SHARE: Final = 20
"""A pause is at least this many times as long as what was read before it took."""
SWEEP_S: Final = 30.0
"""How often rows that are gone are forgotten; also the pause after damaged rows."""
_log = logging.getLogger("enact.store")

_AT_ONCE: Final = 500 if psycopg.capabilities.has_stream_chunked() else 1
"""Rows that the driver hands over in one piece."""


class RowReader:
    """Reads rows of a shard over one connection, until `stopped` is set."""

    def __init__(
        self, session: DatabaseSession, shard: int, name: str, stopped: threading.Event
    ) -> None:
        self._session, self._shard = session, shard
        self._name, self._stopped = name, stopped

    def bring_up(self, rows: Rows) -> int:
        """Make `rows` those of the database, and read what differs; return the newest batch.

        Raises:
            StoreError: A row is damaged.
            psycopg.Error: As the database reports it.
        """
        if not rows.by_id:
            return self._read(rows, ROWS, (self._shard,))
        with self._session.connection.cursor(binary=True) as cursor:
            listed = cursor.execute(LISTED.encode(), (self._shard,)).fetchall()
        with rows.mutex:
            if self._stopped.is_set():
                return 0
            held = rows.by_id
            for number in held.keys() - {number for number, _, _ in listed}:
                rows.drop(number)
            missing = [
                number
                for number, batch, crc in listed
                if (row := held.get(number)) is None or row.crc != crc or row.batch != batch
            ]
        self._read(rows, THESE, (missing, self._shard))
        return max((batch for _, batch, _ in listed), default=0)

    def read_newer(self, rows: Rows, batch: int) -> int:
        """Read the rows of later batches than this; return the newest batch.

        Raises:
            As `bring_up`.
        """
        return max(batch, self._read(rows, NEWER, (self._shard, batch)))

    def _read(self, rows: Rows, statement: str, values: tuple[Any, ...]) -> int:
        newest = 0
        for row in streamed(self._session, statement, values):
            checked = check_row(DatabaseRow._make(row), self._name)
            with rows.mutex:
                if self._stopped.is_set():
                    return newest
                rows.put(checked)
            newest = max(newest, checked.batch)
        with rows.mutex:
            if not self._stopped.is_set():
                rows.together.settle()
        return newest


def streamed(
    session: DatabaseSession, statement: str, values: tuple[Any, ...]
) -> Iterator[tuple[Any, ...]]:
    """Yield rows as they come, some at a time."""
    with session.connection.cursor(binary=True) as cursor:
        yield from cursor.stream(statement.encode(), values, size=_AT_ONCE)


class ReadAhead:
    """Keeps the rows of a shard in memory, on a thread and a connection of its own."""

    def __init__(self, address: StoreAddress, rows: Rows | None = None) -> None:
        self._address = address
        self._name = str(address)
        self._rows = rows or Rows()
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._read_on, name="enact-ahead", daemon=True)
        self._thread.start()

    def stop(self) -> Rows:
        """End, without waiting for the database, and return the rows read so far."""
        with self._rows.mutex:
            self._stopped.set()
        return self._rows

    def _read_on(self) -> None:
        connector, pause_s = connector_of(self._address), 0.0
        while not self._stopped.wait(pause_s):
            try:
                session = connector.connect()
            except LOST:
                pause_s = 1.0  # the wait for the shard logs it
                continue
            try:
                self._follow(session)
            except LOST:
                pause_s = READ_S
            except StoreError as damage:
                _log.warning("rows cannot be read before a takeover: %s", damage)
                pause_s = SWEEP_S
            finally:
                session.close()

    def _follow(self, session: DatabaseSession) -> None:
        """Read over one connection until this ends, or it."""
        found = session.row(*state_of_shard(self._address.cell, self._address.shard))
        shard = found[0] if found is not None else 0
        reader = RowReader(session, shard, self._name, self._stopped)
        swept_s, batch, pause_s = 0.0, 0, 0.0
        while not self._stopped.wait(pause_s):
            began_s = time.monotonic()
            if not swept_s or began_s - swept_s > SWEEP_S:
                batch, swept_s = reader.bring_up(self._rows), began_s
            else:
                batch = reader.read_newer(self._rows, batch)
            pause_s = max(READ_S, SHARE * (time.monotonic() - began_s))
