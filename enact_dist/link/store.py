"""The durable store of one shard: applies batches of records whole, and gives them back at start.

::

    folder/
      lock        held by the one process that serves the folder
      format      version of all this
      mark        boot and newest batches (store_mark)
      store.db    one row per record: epoch, sessions, catalogue, slots, outcomes (store_rows)
      store.db-wal
      blobs/      bodies over 64 KiB, named by their rows (blobs)

What `write` promises when it returns: the batch survives `kill -9`; with a durable `Persist` in it,
a power cut too (also everything written before).  Rules that a change must keep:

- Order: blob files, then the commit of the rows that name them, then the mark, then the unlinking
  of files replaced.  A file that was forced to the disk is unlinked only when the row that
  replaces it is there too.
- After any error the store is dead: what the disk holds is unknown, and a second `fsync` may
  claim success for what the first one lost.
"""

from __future__ import annotations

import errno
import os
import sqlite3
from typing import TYPE_CHECKING, Final, NamedTuple

from enact_dist.core.records import (
    AspectRecord,
    AuditRecord,
    DecisionDone,
    DecisionRecord,
    ForcedEnded,
    ForcedRecord,
    OutcomeRecord,
    PreparedEnded,
    PreparedRecord,
    Recovered,
    SessionEnded,
    SessionRecord,
    SlotRecord,
    WorldRecord,
)
from enact_dist.errors import StoreError
from enact_dist.link.blobs import Blob, BlobFolder
from enact_dist.link.folder_lock import FolderLock, check_format, sync_folder
from enact_dist.link.store_database import Database, DatabaseRow
from enact_dist.link.store_mark import MarkFile
from enact_dist.link.store_prepared import (
    decision_key,
    decision_row,
    forced_key,
    forced_row,
    prepared_key,
    prepared_row,
    prepared_writes,
    slot_of_write,
)
from enact_dist.link.store_recovery import (
    BLOB_FOLDER,
    DATABASE_FILE,
    Contents,
    check_log,
    look_at,
    open_database,
    put_together,
    read_blobs,
)
from enact_dist.link.store_rows import (
    EPOCH_KEY,
    INLINE_BYTES_MAX,
    Key,
    Kind,
    aspect_row,
    audit_row,
    ended_row,
    epoch_body,
    key_of,
    outcome_key,
    outcome_row,
    row_checksum,
    session_row,
    slot_body,
    slot_key,
    world_row,
)
from enact_dist.terms import Durability

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from enact_dist.core.records import Persist, Record

OUTCOMES_KEPT_NS: Final = 24 * 3600 * 1_000_000_000
"""How long the outcomes of an ended session can be asked for."""
LOG_BYTES: Final = 8 << 20
"""About so much is written to the log before it is carried into the database."""
_ROW_LOG_BYTES: Final = 8 << 10
_FULL_ERRNOS: Final = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG})
_DENIED_ERRNOS: Final = frozenset({errno.EACCES, errno.EPERM, errno.EROFS, errno.ENOTDIR})


def open_store(folder: Path, *, unix_s: int) -> tuple[Store, Recovered]:
    """Open the data folder of a shard, checked whole, in a new epoch that is durable already.

    Args:
        folder: Made if it does not exist.
        unix_s: The wall clock, seconds since 1970; the epoch is this or one more than the last.

    Returns:
        The store, and everything it holds; large bodies are read-only maps of their files.

    Raises:
        StoreError: The folder is in use, of another format, damaged, or cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock = FolderLock(folder)
    except OSError as failure:
        raise _store_error(folder, failure) from failure
    try:
        return _open_locked(folder, lock, unix_s)
    except BaseException as failure:
        lock.close()
        if isinstance(failure, OSError | sqlite3.Error):
            raise _store_error(folder, failure) from failure
        raise


def _open_locked(folder: Path, lock: FolderLock, unix_s: int) -> tuple[Store, Recovered]:
    found = look_at(folder)
    check_format(folder, is_new=found.is_new)
    check_log(folder, power_cut=found.power_cut)
    if found.is_new and found.mark is None:
        # Before the first byte of the log: only a mark tells a power cut from damage.
        MarkFile.open(folder, 0).close()
        sync_folder(folder)
    database, contents = open_database(folder, found)
    try:
        epoch = max(contents.recovered.epoch + 1, unix_s)
        (folder / BLOB_FOLDER).mkdir(exist_ok=True)
        blobs = BlobFolder(folder / BLOB_FOLDER, epoch=epoch)
        read_blobs(contents, blobs, power_cut=found.power_cut)
        put_together(contents, folder / DATABASE_FILE)
        contents.recovered.epoch = epoch
        store = Store(folder, lock=lock, database=database, blobs=blobs, contents=contents)
        store._begin(contents, wall_ns=unix_s * 1_000_000_000)  # noqa: SLF001 - its constructor
    except BaseException:
        database.close()
        raise
    return store, contents.recovered


class _Staged(NamedTuple):
    """A slot's or prepared write's new state; `blob` is its body's file where there is one."""

    record: SlotRecord
    durable: bool
    blob: Blob | None = None


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
        self._blob_of = contents.blobs
        self._ended = dict(sorted(contents.ended.items(), key=lambda entry: entry[1]))
        self._lanes: dict[str, set[int]] = {}
        for outcome in contents.recovered.outcomes:
            self._lanes.setdefault(outcome.lock.session, set()).add(outcome.lock.lane)
        self._prepared = {
            record.lock: dict(prepared_writes(record)) for record in contents.recovered.prepared
        }
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
        """Make the new epoch durable, and leave nothing of the past in the folder."""
        # A new generation of the log: remains of a torn one must not look like damage later.
        self._database.checkpoint(cut=True)
        changes: dict[Key, bytes | None] = {EPOCH_KEY: epoch_body(contents.recovered.epoch)}
        for key, record in contents.lost.items():
            changes[key] = slot_body(record, None)
            self._blob_of.pop(key, None)
        self._forget_ended(changes, wall_ns=wall_ns)
        self._commit(changes, forced=True)
        self._mark = MarkFile.open(self._folder, self._batch)
        sync_folder(self._folder)
        sync_folder(self._folder.parent)
        self._blobs.sweep(blob.name for blob in self._blob_of.values())

    # ---------------------------------------------------------------- writing

    def write(self, batch: Sequence[Persist]) -> None:
        """Apply a batch whole and in order; see the module for what then survives what.

        Raises:
            StoreError: The disk is full or fails, now or earlier: nothing of the batch may be
                acknowledged, and the store takes no more.
        """
        self._guarded(lambda: self._write(batch))

    def rest(self) -> None:
        """Do what can wait until a batch is acknowledged: unlink files, shorten the log.

        Raises:
            StoreError: As in `write`.
        """
        self._guarded(self._rest)

    def close(self) -> None:
        """Carry the log into the database and let the folder go; twice is harmless."""
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
                f"the store {self._folder} has failed before ({self._failure}) and takes nothing"
                " more; start the shard again",
                path=str(self._folder),
            )
        try:
            act()
        except BaseException as failure:
            self._failure = failure
            if isinstance(failure, OSError | sqlite3.Error):
                raise _store_error(self._folder, failure) from failure
            raise

    def _write(self, batch: Sequence[Persist]) -> None:
        changes: dict[Key, bytes | None] = {}
        slots: dict[Key, _Staged] = {}
        forced = False
        gone: list[Blob] = []
        for persist in batch:
            durable = persist.durability is Durability.DURABLE
            forced |= durable
            for record in persist.records:
                if isinstance(record, SlotRecord):
                    key = slot_key(record.slot)
                    before = slots.get(key)
                    if before is not None and before.blob is not None:
                        gone.append(before.blob)
                    slots[key] = _Staged(record, durable or (before is not None and before.durable))
                elif isinstance(record, PreparedRecord):
                    self._stage_prepared(record, changes, slots, durable=durable)
                elif isinstance(record, PreparedEnded):
                    gone += self._stage_prepared_end(record, changes, slots)
                else:
                    self._stage(record, changes)
        replaced = gone + self._stage_slots(slots, changes)
        if changes:
            self._commit(changes, forced=forced)
        self._discard(replaced, forced=forced)
        if self._log_bytes > 4 * LOG_BYTES:
            self._rest()

    def _stage(self, record: Record, changes: dict[Key, bytes | None]) -> None:
        """Note what a record other than a slot's changes."""
        if isinstance(record, SessionRecord):
            if self._ended.pop(record.session, None) is not None:
                changes[key_of(Kind.ENDED, record.session)] = None
            key, body = session_row(record)
        elif isinstance(record, SessionEnded):
            changes[key_of(Kind.SESSION, record.session)] = None
            self._forget_ended(changes, wall_ns=record.wall_ns)
            self._ended[record.session] = record.wall_ns
            key, body = ended_row(record)
        elif isinstance(record, WorldRecord):
            key, body = world_row(record)
        elif isinstance(record, AspectRecord):
            key, body = aspect_row(record.entry)
        elif isinstance(record, OutcomeRecord):
            self._lanes.setdefault(record.lock.session, set()).add(record.lock.lane)
            key, body = outcome_row(record)
        elif isinstance(record, DecisionRecord):
            key, body = decision_row(record)
        elif isinstance(record, DecisionDone):
            changes[decision_key(record.lock)] = None
            return
        elif isinstance(record, ForcedRecord):
            key, body = forced_row(record)
        elif isinstance(record, ForcedEnded):
            changes[forced_key(record.lock)] = None
            return
        elif isinstance(record, AuditRecord):
            key, body = audit_row(record, batch=self._batch + 1, number=len(changes))
        else:
            raise TypeError(f"no record of a store: {record!r}")
        changes[key] = body

    def _stage_prepared(
        self,
        record: PreparedRecord,
        changes: dict[Key, bytes | None],
        slots: dict[Key, _Staged],
        *,
        durable: bool,
    ) -> None:
        """Note a prepared lock and its writes."""
        key, body = prepared_row(record)
        changes[key] = body
        writes = dict(prepared_writes(record))
        self._prepared[record.lock] = writes
        slots.update((key, _Staged(write, durable)) for key, write in writes.items())

    def _stage_prepared_end(
        self,
        record: PreparedEnded,
        changes: dict[Key, bytes | None],
        slots: dict[Key, _Staged],
    ) -> list[Blob]:
        """Note that a lock is prepared no more; return its files that no slot takes over."""
        changes[prepared_key(record.lock)] = None
        blobs: list[Blob] = []
        for key, write in self._prepared.pop(record.lock, {}).items():
            slots.pop(key, None)
            changes[key] = None
            blob = self._blob_of.pop(key, None)
            if blob is None:
                continue
            of_slot = slot_of_write(key)
            staged = slots.get(of_slot)
            same = staged is not None and staged.record.datum is write.datum
            if staged is not None and same and (blob.synced or not staged.durable):
                slots[of_slot] = staged._replace(blob=blob)
            else:
                blobs.append(blob)
        return blobs

    def _forget_ended(self, changes: dict[Key, bytes | None], *, wall_ns: int) -> None:
        """Remove the outcomes of sessions that ended long before `wall_ns`."""
        for session, ended_ns in list(self._ended.items()):
            if ended_ns > wall_ns - OUTCOMES_KEPT_NS:
                break
            del self._ended[session]
            changes[key_of(Kind.ENDED, session)] = None
            for lane in self._lanes.pop(session, ()):
                changes[outcome_key(session, lane)] = None

    def _stage_slots(
        self, slots: dict[Key, _Staged], changes: dict[Key, bytes | None]
    ) -> list[Blob]:
        """Write large bodies to files, note the rows; return the files that are replaced."""
        replaced: list[Blob] = []
        names_to_sync = False
        for key, (record, durable, promised) in slots.items():
            blob, datum = promised, record.datum
            if blob is None and datum is not None and datum.size > INLINE_BYTES_MAX:
                blob = self._blobs.write(datum.body, durable=durable)
                names_to_sync |= durable
            changes[key] = slot_body(record, blob)
            old = self._blob_of.pop(key, None)
            if old is not None:
                replaced.append(old)
            if blob is not None:
                self._blob_of[key] = blob
        if names_to_sync:
            self._blobs.sync_names()
        return replaced

    def _commit(self, changes: dict[Key, bytes | None], *, forced: bool) -> None:
        self._batch += 1
        if None in changes.values():
            # The newest row tells how far the store got; a batch must not only take rows away.
            changes[EPOCH_KEY] = epoch_body(self._epoch)
        rows: list[DatabaseRow] = []
        gone: list[int] = []
        for key, body in changes.items():
            if body is None:
                row_id = self._ids.pop(key, None)
                if row_id is not None:
                    gone.append(row_id)
                continue
            row_id = self._ids.get(key)
            if row_id is None:
                row_id = self._ids[key] = self._next_id
                self._next_id += 1
            crc = row_checksum(key, self._batch, body)
            rows.append(DatabaseRow(row_id, key.kind, self._batch, key.name, body, crc))
            self._log_bytes += len(body) + _ROW_LOG_BYTES
        self._database.commit(rows, gone, forced=forced)
        if self._mark is not None:
            self._mark.note(self._batch, forced=forced)

    # ---------------------------------------------------------------- between batches

    def _discard(self, replaced: list[Blob], *, forced: bool) -> None:
        """Note which files can be unlinked now, and which once the log is on the disk."""
        for blob in replaced:
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


class MemoryStore:
    """A store without a folder: nothing outlives the process, every batch is kept at once."""

    def write(self, batch: Sequence[Persist]) -> None:
        """Keep nothing beyond what the shard itself has in memory."""

    def rest(self) -> None:
        """Do nothing."""

    def close(self) -> None:
        """Do nothing."""


def open_memory_store(*, unix_s: int) -> tuple[MemoryStore, Recovered]:
    """Return a store without a folder, and the nothing that it holds, in epoch `unix_s`."""
    return MemoryStore(), Recovered(epoch=unix_s)


def _free_bytes(folder: Path) -> int | str:
    """Return how many bytes this process may still write below `folder`."""
    try:
        found = os.statvfs(folder)
    except OSError:
        return "an unknown number of"
    return found.f_bavail * found.f_frsize


def _store_error(folder: Path, failure: OSError | sqlite3.Error) -> StoreError:
    """Return what an operator must read about an error of the system."""
    path = str(getattr(failure, "filename", None) or folder)
    code = getattr(failure, "sqlite_errorcode", 0) & 0xFF
    number = failure.errno if isinstance(failure, OSError) else None
    if number in _FULL_ERRNOS or code == sqlite3.SQLITE_FULL:
        found = f"no room for the data of {folder}: {_free_bytes(folder)} bytes are free there"
        remedy = "free space on its disk, or raise its quota"
    elif code in {sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED}:
        found = f"the database in {folder} is open in another program"
        remedy = "close that one (a database browser, a backup)"
    elif number in _DENIED_ERRNOS or code in {sqlite3.SQLITE_READONLY, sqlite3.SQLITE_CANTOPEN}:
        found = f"{folder} cannot be written by this process"
        remedy = "let the folder and all in it belong to the user that runs the shard"
    else:
        found = f"the disk or file system below {folder} fails"
        remedy = "look at the system's log, make it sound"
    return StoreError(
        f"{found} ({failure}): {remedy}, and start the shard again; everything acknowledged before"
        " is kept",
        path=path,
    )
