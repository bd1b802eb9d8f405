"""Copies a stopped shard from a database to a folder, or from a folder to a database.

Rows and bodies are the same on both media, byte for byte: keys, checksums, names of bodies.  So a
copy has all data, history, labels, sessions, outcomes and operator actions, and promises of commits
over several shards.  All of it is compared before the copy counts: a database commits it in one
transaction, and a folder gets its name at the end.  The source stays as it is.

A copy begins above all epochs of its source, so no client mistakes a token or a version of the one
for one of the other.
"""

from __future__ import annotations

import os
import threading
import zlib
from contextlib import closing
from itertools import groupby, zip_longest
from operator import itemgetter
from typing import TYPE_CHECKING, Final, NamedTuple

from enact_dist.errors import StoreError
from enact_dist.link.folder.blobs import is_name
from enact_dist.link.folder.folder import (
    BLOB_FOLDER,
    DATABASE_FILE,
    holds_store,
    refuse,
    refuse_strangers,
)
from enact_dist.link.folder.lock import FolderLock, check_format
from enact_dist.link.folder.mark import MarkFile
from enact_dist.link.folder.moving_marks import refuse_moving
from enact_dist.link.offline.backup import check_bodies, renamed, sync_all
from enact_dist.link.offline.backup_files import FILE_MODE, FOLDER_MODE, partial_folder
from enact_dist.link.postgres.ahead import streamed
from enact_dist.link.postgres.bodies import PART_BYTES
from enact_dist.link.postgres.connection import CONFIRMED, connector_of
from enact_dist.link.postgres.medium import database_errors
from enact_dist.link.postgres.opening import (
    StreamedRows,
    read_rows,
    row_of_shard,
    take_over,
)
from enact_dist.link.postgres.standby import wait_free
from enact_dist.link.postgres.tables import BODIES, FENCE, FILL, SHARDS, make_tables
from enact_dist.link.store.database import Database
from enact_dist.link.store.medium import folder_errors, read_folder
from enact_dist.link.store.rows import RowKind
from enact_dist.link.store.store import open_store, read_store

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Iterable, Iterator
    from pathlib import Path

    from enact_dist.core.protocol.messages import PlacementMap
    from enact_dist.link.folder.blobs import Blob
    from enact_dist.link.postgres.address import StoreAddress
    from enact_dist.link.postgres.connection import DatabaseSession
    from enact_dist.link.postgres.opening import HeldShard
    from enact_dist.link.store.database import DatabaseRow
    from enact_dist.link.store.gathering import Contents
    from enact_dist.link.store.media import RowSource

    Rows = Generator[DatabaseRow, None, None]

_ROWS_AT_ONCE: Final = 1_000
_BYTES_AT_ONCE: Final = 8 << 20


class CopiedStore(NamedTuple):
    """What was copied.

    Attributes:
        states: How many states of its slots, replaced ones included.
        size: Bytes of the large bodies.
        batch: Number of the newest batch.
        epoch: The next start begins above this epoch.
    """

    entities: int
    states: int
    rows: int
    bodies: int
    size: int
    batch: int
    epoch: int


class _Told:
    """Tells how far a copy is."""

    def __init__(self, contents: Contents, tell: Callable[[str, int, int], None]) -> None:
        self.bodies: dict[str, Blob] = {blob.name: blob for blob in contents.states.blobs.values()}
        self.size = sum(blob.size for blob in self.bodies.values())
        self.epoch = contents.recovered.epoch
        self._rows = len(contents.ids)
        self._tell = tell
        self._contents = contents

    def rows(self, what: str, rows: Iterable[DatabaseRow]) -> Rows:
        """Pass rows on, and tell now and then how many."""
        for count, row in enumerate(rows):
            if count % _ROWS_AT_ONCE == 0:
                self._tell(f"rows {what}", count, self._rows)
            yield row

    def parts(
        self, what: str, parts: Iterable[tuple[str, bytes]]
    ) -> Generator[tuple[str, bytes], None, None]:
        """Pass parts of bodies on, checked; tell how many bytes.

        Raises:
            StoreError: A body is missing, or is not what its row says.
        """
        done = 0
        found: dict[str, tuple[int, int]] = {}
        for name, data in parts:
            self._tell(f"bytes of large data {what}", done, self.size)
            size, crc = found.get(name, (0, 0))
            found[name] = (size + len(data), zlib.crc32(data, crc))
            done += len(data)
            yield name, data
        for blob in self.bodies.values():
            if found.get(blob.name) != (blob.size, blob.crc):
                raise StoreError(
                    f"body {blob.name} is missing or damaged: it has"
                    f" {found.get(blob.name, (0, 0))[0]} bytes instead of {blob.size}, or another"
                    " checksum; nothing was copied: restore the source from a backup first"
                )

    def done(self, epoch: int) -> CopiedStore:
        """Return what was copied."""
        records = self._contents.records.items()
        states = [found.slot for key, found in records if key.kind is RowKind.SLOT]
        return CopiedStore(
            len({slot.entity for slot in states}), len(states), self._rows,
            len(self.bodies), self.size, self._contents.batch, epoch,
        )  # fmt: skip


def _compare(source: RowSource, copy: RowSource, told: _Told, place: str) -> None:
    """Compare all rows of a copy with their source.

    Raises:
        StoreError: One differs.
    """
    # A connection is free for other statements once what it streams is closed.
    with (
        closing(told.rows("compared", source.rows())) as ours,
        closing(told.rows("compared", copy.rows())) as theirs,
    ):
        for our, their in zip_longest(ours, theirs):
            if our != their:
                raise StoreError(
                    f"{place}: row {(our or their).id} was not stored as it was written; nothing"
                    " was copied: look at the log of the database and the disk"
                )


# ---------------------------------------------------------------- to a folder


def export_store(
    address: StoreAddress,
    folder: Path,
    *,
    unix_s: int,
    tell: Callable[[str, int, int], None] = lambda _what, _done, _all: None,
) -> CopiedStore:
    """Copy a shard from a database to a new folder, from which it can start.

    Args:
        address: The shard; no daemon takes it meanwhile.
        folder: Missing or empty.
        unix_s: The wall clock, seconds since 1970.
        tell: Called with what is done, how much of it, and how much there is.

    Raises:
        StoreError: The database has no such shard, a daemon serves it, it is damaged; or the folder
            has data or cannot be written.
    """
    name = str(address)
    _refuse_full(folder)
    with database_errors(name):
        _refuse_missing(address)
        free = wait_free(address, stopped=threading.Event(), patient=False, note=lambda _: None)
        assert free is not None  # the wait is not stopped
        held = take_over(free, unix_s=unix_s)
        with closing(held.medium):
            contents = read_rows(held.session, held.shard, held.batch, name)
            told, line = _Told(contents, tell), held.medium.line
            with folder_errors(folder), partial_folder(folder, ".exporting") as partial:
                _build(held, partial, told, batch=contents.batch, unix_s=unix_s)
                line.again(
                    line.confirm, lambda _: False
                )  # no other process has changed the shard meanwhile
                if not renamed(partial, folder):
                    raise _is_full(folder)
    return told.done(held.epoch)


def _refuse_full(folder: Path) -> None:
    with folder_errors(folder):
        if folder.exists() and any(folder.iterdir()):
            raise _is_full(folder)


def _is_full(folder: Path) -> StoreError:
    found = "holds data of a shard" if holds_store(folder) else "is not empty"
    return StoreError(
        f"{folder} {found}; name a new folder, or move this one aside; nothing was copied",
        path=str(folder),
    )


def _refuse_missing(address: StoreAddress) -> None:
    """Refuse a shard that the database does not have; a look at it would make its row.

    Raises:
        StoreError: It has none.
    """
    with closing(connector_of(address).connect()) as session:
        there = session.row("SELECT to_regclass('enact.shard') IS NOT NULL")
        names = []
        if there == (True,):
            rows = session.connection.execute(SHARDS.encode(), (address.cell,))
            names = [name for _, name, epoch, *_ in rows if epoch]
    if address.shard not in names:
        raise StoreError(
            f"{address} has no data (shards of this cell there: {', '.join(names) or 'none'});"
            " nothing was copied",
            path=str(address),
        )


def _build(held: HeldShard, folder: Path, told: _Told, *, batch: int, unix_s: int) -> None:
    """Build a folder from a shard in a database, compare it, and begin a new epoch in it."""
    source = StreamedRows(held.session, held.shard)
    check_format(folder, is_new=True)
    (folder / BLOB_FOLDER).mkdir(mode=FOLDER_MODE)
    MarkFile.open(folder, batch).close()
    with closing(Database(folder / DATABASE_FILE)) as database:
        database.make_table()
        for some in _chunks(told.rows("copied", source.rows())):
            database.commit(some, (), forced=False)
        database.checkpoint(cut=True)
        _compare(source, database, told, str(folder))
    with closing(told.parts("copied", streamed(held.session, BODIES, (held.shard,)))) as parts:
        _write_bodies(folder / BLOB_FOLDER, parts, held.medium.name)
    store, _ = open_store(folder, unix_s=unix_s)
    with closing(store):
        store.raise_epoch(held.epoch)
    with read_store(folder) as stored:
        check_bodies(stored)
    sync_all(folder)


def _write_bodies(folder: Path, parts: Iterable[tuple[str, bytes]], source: str) -> None:
    """Write the bodies of a shard to files of their own."""
    for name, some in groupby(parts, key=itemgetter(0)):
        if not is_name(name):
            refuse(source, f"has a body with the name {name!r}")
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC
        with os.fdopen(os.open(folder / name, flags, FILE_MODE), "wb") as file:
            file.writelines(data for _, data in some)


def _chunks(rows: Iterable[DatabaseRow]) -> Iterator[list[DatabaseRow]]:
    some: list[DatabaseRow] = []
    size = 0
    for row in rows:
        some.append(row)
        size += len(row.body)
        if len(some) >= _ROWS_AT_ONCE or size >= _BYTES_AT_ONCE:
            yield some
            some, size = [], 0
    yield some


# ---------------------------------------------------------------- to a database


def import_store(
    folder: Path,
    address: StoreAddress,
    *,
    placement: PlacementMap | None = None,
    unix_s: int,
    tell: Callable[[str, int, int], None] = lambda _what, _done, _all: None,
) -> CopiedStore:
    """Copy a shard from its folder to a database that has no data of it, from where it can start.

    Args:
        folder: The folder; no daemon may use it.
        address: The place in the database.
        placement: Where the cell's entities belong; None: this is not checked.
        unix_s: The wall clock, seconds since 1970.
        tell: Called with what is done, how much of it, and how much there is.

    Raises:
        StoreError: The folder is in use, damaged, or of another shard; or the database has data of
            the shard or cannot be used.
    """
    if not holds_store(folder):
        raise StoreError(
            f"{folder} holds no data of a shard; nothing was copied: name the folder from which the"
            " shard was started",
            path=str(folder),
        )
    while True:
        with folder_errors(folder), closing(FolderLock(folder)):
            refuse_moving(folder)
            database, contents = read_folder(folder)
            with closing(database):
                if not contents.lost:
                    if placement is not None:
                        refuse_strangers(folder, contents.recovered, address.shard, placement)
                    check_bodies(contents.recovered)
                    return _fill(address, folder, database, _Told(contents, tell), unix_s=unix_s)
        # A power cut took unforced bodies: the store makes null of them when it is opened.
        open_store(folder, unix_s=unix_s)[0].close()


def _fill(
    address: StoreAddress, folder: Path, source: Database, told: _Told, *, unix_s: int
) -> CopiedStore:
    """Write rows and bodies in one transaction, and compare them before it is committed."""
    with database_errors(str(address)), closing(connector_of(address).connect()) as session:
        make_tables(session, address.cell, address.shard)
        session.commit_as(CONFIRMED)
        connection = session.connection
        with connection.transaction():
            connection.execute("SET LOCAL idle_in_transaction_session_timeout = '60s'")
            shard, row = row_of_shard(session, address, " FOR UPDATE")
            if row.epoch or row.batch:
                served = f", served by process {row.holder}" if row.holder else ""
                raise StoreError(
                    f"{address} has data already: epoch {row.epoch}, batch {row.batch}{served};"
                    " nothing was copied: docs/surviving.md says how to delete a shard's rows"
                    " (`enact shard export-store` keeps a copy of them)",
                    path=str(address),
                )
            _put(session, shard, folder, source, told)
            _compare(source, StreamedRows(session, shard), told, str(address))
            with closing(told.parts("compared", streamed(session, BODIES, (shard,)))) as parts:
                for _ in parts:
                    pass
            done = told.done(max(told.epoch + 1, unix_s))
            session.row(FENCE, (done.epoch, "", shard))
            session.row(FILL, (done.batch, shard))
        session.check()
    return done


def _put(session: DatabaseSession, shard: int, folder: Path, source: Database, told: _Told) -> None:
    with session.connection.cursor() as cursor:
        with cursor.copy("COPY enact.record FROM STDIN (FORMAT BINARY)") as copy:
            copy.set_types(["int4", "int8", "int2", "int8", "bytea", "bytea", "int8"])
            for row in told.rows("copied", source.rows()):
                copy.write_row((shard, *row))
        with cursor.copy("COPY enact.body FROM STDIN (FORMAT BINARY)") as copy:
            copy.set_types(["int4", "text", "int4", "bytea"])
            number, at = 0, ""
            for name, data in told.parts("copied", _parts_of(folder, told.bodies)):
                number, at = (number + 1, at) if name == at else (0, name)
                copy.write_row((shard, name, number, data))


def _parts_of(folder: Path, names: Iterable[str]) -> Iterator[tuple[str, bytes]]:
    for name in names:
        with (folder / BLOB_FOLDER / name).open("rb") as file:
            while data := file.read(PART_BYTES):
                yield name, data
