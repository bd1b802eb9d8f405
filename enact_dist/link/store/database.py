"""The rows of one store in SQLite: one table, one writer, a write-ahead log.

Rules that a change must keep:

- Never `synchronous=OFF`: a checkpoint could then overwrite the database before the log is on the
  disk.  `NORMAL` forces nothing at a commit and everything at a checkpoint.
- Checkpoints run only here, where their errors are seen; SQLite's automatic ones hide them.
- Locking is `EXCLUSIVE`, so the log's index stays in memory and no other process writes.
"""

from __future__ import annotations

import contextlib
import os
import sqlite3
from typing import TYPE_CHECKING, Final, NamedTuple

from enact_dist.link.folder.lock import file_mode

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

_PRAGMAS: Final = (
    "locking_mode=EXCLUSIVE",
    "journal_mode=WAL",
    "synchronous=FULL",
    "wal_autocheckpoint=0",
    "secure_delete=OFF",
    "cell_size_check=ON",
    "trusted_schema=OFF",
    "cache_size=-16384",  # KiB
)
_TABLE: Final = """CREATE TABLE record (
    id INTEGER PRIMARY KEY, kind INTEGER NOT NULL, batch INTEGER NOT NULL,
    key BLOB NOT NULL, body BLOB NOT NULL, crc INTEGER NOT NULL
)"""
_PUT: Final = "INSERT OR REPLACE INTO record VALUES "
_ROW: Final = "(?, ?, ?, ?, ?, ?)"
FEW_ROWS: Final = 8
"""So many rows are put by one statement in place of four calls: 12 in place of 22 us for two."""
_CORRUPT: Final = frozenset({sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB, sqlite3.SQLITE_FORMAT})


class DatabaseRow(NamedTuple):
    """One stored row; `batch` is the number of the batch that wrote it."""

    id: int
    kind: int
    batch: int
    key: bytes
    body: bytes
    crc: int


class Database:
    """An open database of rows.  Used by one thread at a time.

    Args:
        path: The database file; made if it does not exist.
        writable: Otherwise nothing is written, not even at `close`; needs an existing file.

    Raises:
        OSError: The file cannot be opened.
        sqlite3.Error: In every method, as SQLite reports it; `is_damage` distinguishes damage from
            system errors.
    """

    __slots__ = ("_connection", "_forced")

    def __init__(self, path: Path, *, writable: bool = True) -> None:
        self._forced = True
        if not writable:
            uri = f"{path.absolute().as_uri()}?mode=ro"
            self._connection = sqlite3.connect(uri, uri=True, isolation_level=None)
            return
        # SQLite gives the database and its log the mode of an existing empty file.
        os.close(os.open(path, os.O_RDONLY | os.O_CREAT | os.O_CLOEXEC, file_mode(path.parent)))
        self._connection = sqlite3.connect(
            path, isolation_level=None, check_same_thread=False, timeout=0.0
        )
        try:
            for pragma in _PRAGMAS:
                self._connection.execute(f"PRAGMA {pragma}").fetchall()
        except BaseException:
            self._connection.close()
            raise

    def problems(self, *, may_be_empty: bool) -> list[str]:
        """Return what is wrong with the file's structure, according to SQLite's own check.

        SQLite reads columns by the table definition in the file, so that must be intact.
        """
        rows = self._connection.execute("PRAGMA quick_check(5)").fetchall()
        found = [str(problem) for (problem,) in rows]
        if found != ["ok"]:
            return found
        tables = self._connection.execute("SELECT sql FROM sqlite_schema").fetchall()
        if tables == [(_TABLE,)] or (may_be_empty and not tables):
            return []
        return [f"its tables are {tables!r:.200} instead of one for records"]

    def make_table(self) -> None:
        """Make the table of a database, unless an earlier start has made it."""
        if not self._connection.execute("SELECT 1 FROM sqlite_schema").fetchall():
            self._connection.execute(_TABLE)

    def rows(self) -> Iterator[DatabaseRow]:
        """Yield all rows, oldest identity first."""
        cursor = self._connection.execute(
            "SELECT id, kind, batch, key, body, crc FROM record ORDER BY id"
        )
        yield from map(DatabaseRow._make, cursor)

    def commit(self, rows: Sequence[DatabaseRow], gone: Sequence[int], *, forced: bool) -> None:
        """Put `rows` and delete those with an id in `gone`, atomically.

        With `forced` everything committed so far is on the disk when this returns.
        """
        if forced != self._forced:
            self._connection.execute(f"PRAGMA synchronous={'FULL' if forced else 'NORMAL'}")
            self._forced = forced
        if not gone and 0 < len(rows) <= FEW_ROWS:  # one statement is atomic by itself
            values = [value for row in rows for value in row]
            self._connection.execute(_PUT + ", ".join([_ROW] * len(rows)), values)
            return
        self._connection.execute("BEGIN IMMEDIATE")
        try:
            deleted = ((row_id,) for row_id in gone)
            self._connection.executemany("DELETE FROM record WHERE id = ?", deleted)
            self._connection.executemany(_PUT + _ROW, rows)
            self._connection.execute("COMMIT")
        except BaseException:
            with contextlib.suppress(sqlite3.Error):
                self._connection.execute("ROLLBACK")
            raise

    def checkpoint(self, *, cut: bool = False) -> None:
        """Force the log to the disk, carry it into the database, and restart it.

        The log keeps its length, so that later commits overwrite it (twice as fast as one that
        extends the file); `cut` empties it.
        """
        mode = "TRUNCATE" if cut else "RESTART"
        ((busy, _, _),) = self._connection.execute(f"PRAGMA wal_checkpoint({mode})").fetchall()
        if busy:
            raise sqlite3.OperationalError("the database is read or locked by another process")

    def close(self) -> None:
        """Carry the log into the database and close; an error leaves the log unchanged."""
        with contextlib.suppress(sqlite3.Error):
            self._connection.close()


def is_damage(failure: BaseException) -> bool:
    """Whether SQLite reports damage of the file itself, not a system error below it."""
    if isinstance(failure, UnicodeDecodeError):
        # SQLite quotes what it cannot read, and the quotation may not be text.
        return True
    code = getattr(failure, "sqlite_errorcode", None)
    return isinstance(failure, sqlite3.DatabaseError) and (code or 0) & 0xFF in _CORRUPT
