"""Where the rows and large bodies of a store are kept: a folder, opened, checked and written.

Nothing here knows what rows mean: `link.store.store` commits batches of them, and bodies that are
written before the rows that name them.  Rules that a change must keep:

- Order: blob files, the commit of their rows, the mark, then unlinking files without rows.  A file
  that was forced to the disk is unlinked only once the batch that removed its last row is on the
  disk too.
"""

from __future__ import annotations

import errno
import logging
import os
import shutil
import sqlite3
import stat
from collections.abc import Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, closing, contextmanager
from pathlib import Path
from typing import Final

from enact_dist.errors import StoreError
from enact_dist.link.folder.blobs import Blob, BlobFolder
from enact_dist.link.folder.folder import (
    ACCEPT_LOSS_FILE,
    BLOB_FOLDER,
    DATABASE_FILE,
    LOG_FILE,
    FolderFindings,
    check_log,
    check_reach,
    has_blobs,
    look_at,
    refuse,
)
from enact_dist.link.folder.held_bodies import remove_killed_backup
from enact_dist.link.folder.lock import FolderLock, check_format, sync_folder
from enact_dist.link.folder.mark import MarkFile
from enact_dist.link.folder.wal_check import commit_ends
from enact_dist.link.store.database import Database, DatabaseRow, is_damage
from enact_dist.link.store.gathering import Contents
from enact_dist.link.store.recovery import put_together, read_blobs, read_contents
from enact_dist.link.store.rows import EPOCH_KEY

LOG_BYTES: Final = 8 << 20
"""Approximate size of the log at which it is carried into the database."""
_ROW_LOG_BYTES: Final = 8 << 10
FULL_ERRNOS: Final = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG})
_DENIED_ERRNOS: Final = frozenset({errno.EACCES, errno.EPERM, errno.EROFS, errno.ENOTDIR})
_TRIAL_FILE: Final = "trial.db"
_log = logging.getLogger("enact.store")


class FolderMedium:
    """A folder, locked and read, with the files of a new epoch.  Used by one thread at a time.

    Attributes:
        name: Where it is, for messages.
        bodies: Its large bodies.
    """

    holding = None
    """The lock of the folder holds it."""

    def __init__(self, folder: Path, *, lock: FolderLock, database: Database, epoch: int) -> None:
        self.name = str(folder)
        self.bodies = BlobFolder(folder / BLOB_FOLDER, epoch=epoch)
        self._folder = folder
        self._lock = lock
        self._database = database
        self._mark: MarkFile | None = None
        self._log_bytes = 0
        self._rubbish: list[str] = []
        self._rubbish_once_forced: list[str] = []

    def begin(self) -> None:
        """Start a new generation of the log: remains of a torn one would later look like damage."""
        mode = stat.S_IMODE(self._folder.stat().st_mode)
        if mode & stat.S_IRWXO:
            text = "%s is open to every user of this host (mode %o): chmod 700, unless intended"
            _log.warning(text, self._folder, mode)
        remove_killed_backup(self._folder)
        self._database.checkpoint(cut=True)

    def begun(self, batch: int, named: Iterable[str]) -> None:
        """Mark the first batch of the new epoch, and remove remains of the past."""
        self._mark = MarkFile.open(self._folder, batch)
        (self._folder / ACCEPT_LOSS_FILE).unlink(missing_ok=True)
        sync_folder(self._folder)
        sync_folder(self._folder.parent)
        self.bodies.sweep(named)

    def commit(
        self,
        batch: int,
        rows: Sequence[DatabaseRow],
        gone: Sequence[int],
        unnamed: Iterable[Blob] = (),
        *,
        forced: bool,
    ) -> None:
        """Put `rows` and delete those with an id in `gone`, atomically.

        Args:
            batch: Number of this batch.
            rows: With new bodies.
            gone: Ids of deleted rows.
            unnamed: Bodies that no row names any more.
            forced: Whether everything so far must survive a power cut when this returns.
        """
        self._database.commit(rows, gone, forced=forced)
        if self._mark is not None:
            self._mark.note(batch, forced=forced)
        self._log_bytes += sum(len(row.body) + _ROW_LOG_BYTES for row in rows)
        self._discard(unnamed, forced=forced)
        if self._log_bytes > 4 * LOG_BYTES:
            self.rest()

    def _discard(self, unnamed: Iterable[Blob], *, forced: bool) -> None:
        """Record which files can be unlinked now, and which once the log is on the disk."""
        for blob in unnamed:
            later = blob.synced and not forced
            (self._rubbish_once_forced if later else self._rubbish).append(blob.name)
        if forced:
            self._rubbish += self._rubbish_once_forced
            self._rubbish_once_forced.clear()

    @property
    def tired(self) -> bool:
        """Whether there are files to unlink, or the log is long."""
        return bool(self._rubbish) or self._log_bytes > LOG_BYTES

    def rest(self) -> None:
        """Do what can wait until a batch is acknowledged: unlink files, shorten the log."""
        if self._log_bytes > LOG_BYTES:
            self._database.checkpoint()
            self._log_bytes = 0
            self._discard([], forced=True)
        for name in self._rubbish:
            self.bodies.unlink(name)
        self._rubbish.clear()

    def close(self) -> None:
        """Carry the log into the database and release the folder; idempotent."""
        self._database.close()
        if self._mark is not None:
            self._mark.close()
        self._lock.close()

    def errors(self) -> AbstractContextManager[None]:
        """Return `folder_errors` of this folder."""
        return folder_errors(self._folder)


def read_folder(folder: Path) -> tuple[Database, Contents]:
    """Read and check a locked folder; see `link.store.recovery`.

    Raises:
        StoreError: It is damaged, or of another format.
        OSError: As the system reports it.
        sqlite3.Error: As SQLite reports it, except for damage.
    """
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


def open_database(folder: Path, found: FolderFindings) -> tuple[Database, Contents]:
    """Open the database and read it completely.

    Raises:
        StoreError: It is damaged, or lacks acknowledged data.
        OSError: As the system reports it.
        sqlite3.Error: As SQLite reports it, except for damage.
    """
    path = folder / DATABASE_FILE
    database = None
    try:
        database = Database(path)
        problems = database.problems(may_be_empty=found.is_first)
        if problems:
            refuse(path, f"is damaged: {'; '.join(problems)}")
        if found.is_first:
            database.make_table()
        contents = read_contents(database, path)
        in_use = contents.ids or not found.is_first or has_blobs(folder)
        if EPOCH_KEY not in contents.ids and in_use:
            refuse(path, "holds no epoch: rows are missing")
        check_reach(folder, found, batch=contents.batch)
    except BaseException as failure:
        if database is not None:
            database.close()
        if is_damage(failure):
            refuse(path, f"is damaged: {failure}")
        raise
    return database, contents


# ---------------------------------------------------------------- torn commits
#
# SQLite finds a torn commit by the checksum of each frame.  That sum adds words with weights of
# which each is the sum of the next two, so a frame whose stale sector differs in three neighbouring
# words by (+1, -1, -1) passes.  Page 1 holds the number of pages, the first free page and the
# number of free pages side by side, and a log is written over its older generation: such a frame
# exists.
#
# So after a power cut the content is read once through a link that writes nothing.  If it is
# damaged, the newest commit up to which it is sound is found by bisection, and the log is cut
# there.  Only unforced commits can be torn: a log whose forced commits are damaged stays as it is.


def cut_torn_commits(folder: Path, found: FolderFindings) -> None:
    """Cut the log behind the newest commit up to which the database is sound, if there is one.

    Raises:
        OSError: As the system reports it.
        sqlite3.Error: As SQLite reports it, except for damage.
    """
    log = folder / LOG_FILE
    if found.mark is None or not found.power_cut or not (commits := commit_ends(log)):
        return
    ends = [0, *commits]
    with _trial(folder) as trial:
        if _batch_of_sound(trial, log, ends[-1], found) is not None:
            return
        batch = _batch_of_sound(trial, log, 0, found)
        sound, damaged = 0, len(ends) - 1
        while batch is not None and damaged - sound > 1:
            middle = (sound + damaged) // 2
            read = _batch_of_sound(trial, log, ends[middle], found)
            if read is None:
                damaged = middle
            else:
                sound, batch = middle, read
    if batch is None or batch < found.mark.needed():
        return
    with log.open("r+b") as file:
        file.truncate(ends[sound])
        os.fsync(file.fileno())
    _log.warning(
        "%s: commits from byte %d on: %d are gone after the system's restart, since the first of"
        " them was written in part; none of them had been forced to the disk",
        log,
        ends[sound],
        len(ends) - 1 - sound,
    )


@contextmanager
def _trial(folder: Path) -> Iterator[Path]:
    """Yield a second name of the database, under which it has a log of its own."""
    trial = folder / _TRIAL_FILE
    files = [trial, *(folder / f"{_TRIAL_FILE}-{suffix}" for suffix in ("wal", "shm"))]
    try:
        for file in files:
            file.unlink(missing_ok=True)
        try:
            trial.hardlink_to(folder / DATABASE_FILE)
        except OSError:  # a file system without links
            shutil.copyfile(folder / DATABASE_FILE, trial)
        yield trial
    finally:
        for file in files:
            file.unlink(missing_ok=True)


def _batch_of_sound(trial: Path, log: Path, end: int, found: FolderFindings) -> int | None:
    """Return the newest batch of the database with its log up to `end`; None if it is damaged."""
    trial.with_name(f"{trial.name}-wal").write_bytes(log.read_bytes()[:end])
    try:
        with closing(Database(trial, writable=False)) as database:
            if database.problems(may_be_empty=found.is_first):
                return None
            return read_contents(database, trial).batch
    except StoreError:
        return None
    except sqlite3.Error as failure:
        if is_damage(failure):
            return None
        if found.is_first and isinstance(failure, sqlite3.OperationalError):
            return 0  # it has no table yet
        raise


# ---------------------------------------------------------------- errors of the system


@contextmanager
def folder_errors(folder: Path) -> Iterator[None]:
    """Raise a `StoreError` that tells an operator what to do about an error of the system.

    Raises:
        StoreError: In place of an `OSError` or an error of SQLite.
    """
    try:
        yield
    except (OSError, sqlite3.Error) as failure:
        raise _store_error(folder, failure) from failure


def _store_error(folder: Path, failure: OSError | sqlite3.Error) -> StoreError:
    """Return the error that tells an operator about a system error."""
    if (file := file_in(folder)) is not None:
        return StoreError(
            f"{file} is a file, not a folder, so a shard cannot keep its data in {folder}; name"
            " another folder in cell.toml (`folder` of the shard, or `data_folder`), or move the"
            " file away",
            path=str(file),
        )
    path = str(getattr(failure, "filename", None) or folder)
    code = getattr(failure, "sqlite_errorcode", 0) & 0xFF
    number = failure.errno if isinstance(failure, OSError) else None
    if number in FULL_ERRNOS or code == sqlite3.SQLITE_FULL:
        found = f"no room for the data of {folder}: {_free_bytes(folder)} bytes are free there"
        remedy = "free space on its disk, or raise its quota"
    elif number == errno.ENOMEM:
        found = f"the system cannot map all large data of {folder}"
        remedy = "raise vm.max_map_count (sysctl), or retain fewer versions"
    elif code in {sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED}:
        found = f"the database in {folder} is open in another program"
        remedy = "close that program (a database browser, a backup)"
    elif number in _DENIED_ERRNOS or code in {sqlite3.SQLITE_READONLY, sqlite3.SQLITE_CANTOPEN}:
        found = f"{folder} cannot be written by this process"
        remedy = "let the folder and all in it belong to the user that runs the shard"
    else:
        found = f"the disk or file system below {folder} fails"
        remedy = "check the system's log and repair it"
    return StoreError(
        f"{found} ({failure}): {remedy}, and start the shard again; all acknowledged data are kept",
        path=path,
    )


def file_in(folder: Path) -> Path | None:
    """Return the file that takes the place of the folder or one of its parents."""
    for place in (folder, *folder.parents):
        try:
            if place.exists():
                return None if place.is_dir() else place
        except OSError:
            return None
    return None


def _free_bytes(folder: Path) -> int | str:
    """Return how many bytes this process may still write below `folder`."""
    try:
        found = os.statvfs(folder)
    except OSError:
        return "an unknown number of"
    return found.f_bavail * found.f_frsize
