"""The durable store of one shard: applies batches of records atomically, restores them at start.

::

    folder/
      lock        held by the one process that serves the folder
      format      version of all this
      mark        boot and newest batches (store_mark)
      store.db    one row per record (store_rows); slots have one per stored state (store_batch)
      store.db-wal
      blobs/      bodies over 64 KiB, named by their rows (blobs)

Its content after a series of records is defined in `core.offline.ledger`; outcomes of ended
sessions are deleted after a day.  When `write` returns, the batch survives `kill -9`; if a
`Persist` in it is durable, it also survives a power cut, with everything written before.  This
includes history: a durable version stays durable when it is replaced.  Rules that a change must
keep:

- Order: blob files, the commit of their rows, the mark, then unlinking files without rows.  A file
  that was forced to the disk is unlinked only once the batch that removed its last row is on the
  disk too.
- A durable row names only forced files: an unforced one (a fork of an `os` datum) is forced first,
  which writes what is not yet on the disk and copies nothing.
- After any error the store is dead: the state of the disk is unknown, and a second `fsync` may
  report success for writes that the first one lost.
"""

from __future__ import annotations

import logging
import sqlite3
import stat
from contextlib import closing, contextmanager
from typing import TYPE_CHECKING, Final

from enact_dist.core.protocol.records import Recovered
from enact_dist.errors import StoreError
from enact_dist.link.folder.blobs import Blob, BlobFolder
from enact_dist.link.folder.folder import (
    ACCEPT_LOSS_FILE,
    BLOB_FOLDER,
    DATABASE_FILE,
    check_log,
    look_at,
    refuse_moving,
)
from enact_dist.link.folder.held_bodies import let_go_of_killed
from enact_dist.link.folder.lock import FolderLock, check_format, sync_folder
from enact_dist.link.folder.mark import MarkFile
from enact_dist.link.folder.torn_log import cut_torn_commits
from enact_dist.link.store.batch import Batch
from enact_dist.link.store.database import Database, DatabaseRow
from enact_dist.link.store.errors import store_error
from enact_dist.link.store.recovery import Contents, open_database, put_together, read_blobs
from enact_dist.link.store.rows import (
    EPOCH_KEY,
    Key,
    epoch_body,
    read_order,
    row_checksum,
    slot_body,
)
from enact_dist.link.store.states import Outcomes

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from pathlib import Path

    from enact_dist.core.protocol.records import Persist

_log = logging.getLogger("enact.store")
LOG_BYTES: Final = 8 << 20
"""Approximate size of the log at which it is carried into the database."""
FOLDER_MODE: Final = 0o700
"""A new data folder is private; an existing one keeps its owner's permissions."""
_ROW_LOG_BYTES: Final = 8 << 10


def open_store(folder: Path, *, unix_s: int, moving: bool = False) -> tuple[Store, Recovered]:
    """Open and check a shard's data folder (see `link.store.recovery`), in a new durable epoch.

    Args:
        folder: Made if it does not exist.
        unix_s: The wall clock, seconds since 1970; the epoch is this or one more than the last.
        moving: Whether the folder may be part of an unfinished rebalance.

    Returns:
        The store and its content; large bodies are read-only maps of their files.

    Raises:
        StoreError: The folder is in use, of another format, damaged, or not writable.
    """
    try:
        folder.mkdir(mode=FOLDER_MODE, parents=True, exist_ok=True)
        lock = FolderLock(folder)
    except OSError as failure:
        raise store_error(folder, failure) from failure
    try:
        if not moving:
            refuse_moving(folder)
        return _open_locked(folder, lock, unix_s)
    except BaseException as failure:
        lock.close()
        if isinstance(failure, OSError | sqlite3.Error):
            raise store_error(folder, failure) from failure
        raise


@contextmanager
def read_store(folder: Path) -> Iterator[Recovered]:
    """Return the content of a folder, checked as in `open_store`; its epoch is the stored one.

    The folder is locked meanwhile and stays unchanged.  An empty or missing folder has no content.

    Raises:
        StoreError: As `open_store`.
    """
    if not folder.exists() or not any(folder.iterdir()):
        yield Recovered(epoch=0)
        return
    with closing(FolderLock(folder)):
        try:
            database, contents = _read_locked(folder)
        except (OSError, sqlite3.Error) as failure:
            raise store_error(folder, failure) from failure
        with closing(database):
            yield contents.recovered


def _read_locked(folder: Path) -> tuple[Database, Contents]:
    found = look_at(folder)
    check_format(folder, is_new=found.is_new)
    check_log(folder, power_cut=found.power_cut)
    if found.is_new:
        # Before the first byte of the log: only a mark distinguishes a power cut from damage.  An
        # existing one may be from a start that was killed before the mark was on the disk.
        MarkFile.open(folder, 0).close()
        sync_folder(folder)
    cut_torn_commits(folder, found)
    database, contents = open_database(folder, found)
    try:
        (folder / BLOB_FOLDER).mkdir(mode=folder.stat().st_mode & 0o777 | 0o700, exist_ok=True)
        blobs = BlobFolder(folder / BLOB_FOLDER, epoch=contents.recovered.epoch)
        read_blobs(contents, blobs, power_cut=found.power_cut)
        put_together(contents, folder / DATABASE_FILE)
    except BaseException:
        database.close()
        raise
    return database, contents


def _open_locked(folder: Path, lock: FolderLock, unix_s: int) -> tuple[Store, Recovered]:
    database, contents = _read_locked(folder)
    mode = stat.S_IMODE(folder.stat().st_mode)
    if mode & stat.S_IRWXO:
        text = "%s is open to every user of this host (mode %o): chmod 700, unless that is wanted"
        _log.warning(text, folder, mode)
    let_go_of_killed(folder)
    try:
        epoch = contents.recovered.epoch = max(contents.recovered.epoch + 1, unix_s)
        blobs = BlobFolder(folder / BLOB_FOLDER, epoch=epoch)
        store = Store(folder, lock=lock, database=database, blobs=blobs, contents=contents)
        store._begin(contents, wall_ns=unix_s * 1_000_000_000)  # noqa: SLF001 - its constructor
    except BaseException:
        database.close()
        raise
    return store, contents.recovered


class Store:
    """The open store of one shard; made by `open_store`.  Used by one thread at a time."""

    def __init__(
        self,
        folder: Path,
        *,
        lock: FolderLock,
        database: Database,
        blobs: BlobFolder,
        contents: Contents,
    ) -> None:
        self._folder = folder
        self._lock = lock
        self._database = database
        self._blobs = blobs
        self._ids = contents.ids
        self._states = contents.states
        locks = (outcome.lock for outcome in contents.recovered.outcomes)
        self._outcomes = Outcomes(locks, contents.ended)
        self._next_id = max(self._ids.values(), default=0) + 1
        self._batch = contents.batch
        self._epoch = contents.recovered.epoch
        self._mark: MarkFile | None = None
        self._log_bytes = 0
        self._rubbish: list[str] = []
        self._rubbish_once_forced: list[str] = []
        self._failure: BaseException | None = None
        self._closed = False

    def _begin(self, contents: Contents, *, wall_ns: int) -> None:
        """Make the new epoch durable, and remove remains of the past from the folder."""
        # A new generation of the log: remains of a torn one must not be taken for damage later.
        self._database.checkpoint(cut=True)
        changes: dict[Key, bytes | None] = {EPOCH_KEY: epoch_body(contents.recovered.epoch)}
        for key, record in contents.lost.items():
            cause = self._states.causes.get(key)
            changes[key] = slot_body(record, None, cause and read_order(cause))
        changes.update(dict.fromkeys(self._outcomes.expired(wall_ns)))
        self._commit(changes, forced=True)
        self._mark = MarkFile.open(self._folder, self._batch)
        (self._folder / ACCEPT_LOSS_FILE).unlink(missing_ok=True)
        sync_folder(self._folder)
        sync_folder(self._folder.parent)
        self._blobs.sweep(blob.name for blob in self._states.blobs.values())

    # ---------------------------------------------------------------- writing

    def write(self, batch: Sequence[Persist]) -> None:
        """Apply a batch atomically and in order; see the module for what it survives.

        Raises:
            StoreError: The disk is full or fails, now or earlier: nothing of the batch may be
                acknowledged, and the store accepts no more.
        """
        self._guarded(lambda: self._write(batch))

    def raise_epoch(self, epoch: int) -> None:
        """Make every later epoch exceed `epoch`, in which another shard had some of its data.

        Raises:
            StoreError: As in `write`.
        """
        self._epoch = max(self._epoch, epoch)
        changes: dict[Key, bytes | None] = {EPOCH_KEY: epoch_body(self._epoch)}
        self._guarded(lambda: self._commit(changes, forced=True))

    def rest(self) -> None:
        """Do what can wait until a batch is acknowledged: unlink files, shorten the log.

        Raises:
            StoreError: As in `write`.
        """
        self._guarded(self._rest)

    def close(self) -> None:
        """Carry the log into the database and release the folder; idempotent."""
        if self._closed:
            return
        self._closed = True
        self._database.close()
        if self._mark is not None:
            self._mark.close()
        self._lock.close()

    def _guarded(self, act: Callable[[], None]) -> None:
        if self._closed:
            raise StoreError(f"the store {self._folder} is closed", path=str(self._folder))
        if self._failure is not None:
            raise StoreError(
                f"the store {self._folder} has failed before ({self._failure}) and accepts nothing"
                " more; restart the shard",
                path=str(self._folder),
            )
        try:
            act()
        except BaseException as failure:
            self._failure = failure
            if isinstance(failure, OSError | sqlite3.Error):
                raise store_error(self._folder, failure) from failure
            raise

    def _write(self, batch: Sequence[Persist]) -> None:
        gathered = Batch(self._batch + 1, self._states, self._outcomes)
        for persist in batch:
            gathered.take(persist)
        unnamed = gathered.settle(self._blobs)
        if gathered.changes:
            self._commit(gathered.changes, forced=gathered.forced)
        self._discard(unnamed, forced=gathered.forced)
        if self._log_bytes > 4 * LOG_BYTES:
            self._rest()

    def _commit(self, changes: dict[Key, bytes | None], *, forced: bool) -> None:
        self._batch += 1
        if all(body is None for body in changes.values()):
            # The newest row shows how far the store got, so a batch must not only delete rows.
            changes[EPOCH_KEY] = epoch_body(self._epoch)
        # A new row replaces a deleted one: as many pages are written as for an update.
        free = [self._ids.pop(key, 0) for key, body in changes.items() if body is None]
        free = [row_id for row_id in reversed(free) if row_id]
        rows: list[DatabaseRow] = []
        for key, body in changes.items():
            if body is None:
                continue
            row_id = self._ids.get(key) or self._new_id(free)
            self._ids[key] = row_id
            crc = row_checksum(key, self._batch, body)
            rows.append(DatabaseRow(row_id, key.kind, self._batch, key.name, body, crc))
            self._log_bytes += len(body) + _ROW_LOG_BYTES
        self._database.commit(rows, free, forced=forced)
        if self._mark is not None:
            self._mark.note(self._batch, forced=forced)

    def _new_id(self, free: list[int]) -> int:
        if free:
            return free.pop()
        self._next_id += 1
        return self._next_id - 1

    # ---------------------------------------------------------------- between batches

    def _discard(self, unnamed: list[Blob], *, forced: bool) -> None:
        """Record which files can be unlinked now, and which once the log is on the disk."""
        for blob in unnamed:
            later = blob.synced and not forced
            (self._rubbish_once_forced if later else self._rubbish).append(blob.name)
        if forced:
            self._rubbish += self._rubbish_once_forced
            self._rubbish_once_forced.clear()

    def _rest(self) -> None:
        if self._log_bytes > LOG_BYTES:
            self._database.checkpoint()
            self._log_bytes = 0
            self._discard([], forced=True)
        for name in self._rubbish:
            self._blobs.unlink(name)
        self._rubbish.clear()
