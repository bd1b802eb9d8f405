"""Backs a shard's folder up, while the shard runs too, and restores it.

How a copy of files that change becomes one state: the database is copied first and its log after
it.  While the log's header stays what it was, all that was carried into the database meanwhile is
in the log as well, and replaces what was copied torn.  Else both are copied again.  Large bodies
are files that never change; links hold all that are there just before and just after the log is
read (`held_bodies`).  The mark is copied before all, so the copy is refused if it lacks anything
that was acknowledged then.  A copy has its name only when every byte of it was checked and is on
the disk, with a digest (`backup_digests`) that is made of the copy: the shard waits for none.  Who
makes it may read it and nobody else; what is restored is for those who might read the shard's.

A shard that is restored begins with an epoch above that of its backup, of what was there before,
and the wall clock: whoever knew a later state is told that the shard has started anew, and no lock
or commit of before counts.
"""

from __future__ import annotations

import dataclasses
import errno
import os
import time
from contextlib import closing, suppress
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Final, NamedTuple

from enact_dist.errors import StoreError
from enact_dist.link.backup_digests import (
    BACKUP_FILE,
    MODES,
    Digest,
    check_files,
    check_modes,
    digests_of,
    files_of,
    mode_of,
    modes_of,
    read_sealed,
    sealed,
    set_modes,
)
from enact_dist.link.blobs import BlobFolder
from enact_dist.link.folder_lock import FORMAT_FILE, FolderLock, replace_file, sync_folder
from enact_dist.link.held_bodies import HeldBodies, held_bodies
from enact_dist.link.private_copy import (
    FILE_MODE,
    FOLDER_MODE,
    copy_private,
    partial_folder,
)
from enact_dist.link.store import open_store, read_store
from enact_dist.link.store_errors import backup_error, store_error
from enact_dist.link.store_folder import (
    BLOB_FOLDER,
    DATABASE_FILE,
    LOG_FILE,
    holds_store,
    look_at,
    refuse_moving,
)
from enact_dist.link.store_mark import MARK_FILE
from enact_dist.link.store_recovery import open_database, put_together, read_blobs
from enact_dist.link.wal_check import HEADER_BYTES, check_wal

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from enact_dist.core.records import Recovered

DIGESTS: Final = "digests"
TRIES_MAX: Final = 50
"""So often the files are copied anew because the shard has begun its log anew meanwhile."""
ASIDE: Final = ".replaced-"
"""In the names of folders that were put aside, before the second in which they were."""


@dataclass(frozen=True, slots=True)
class Backup:
    """What a backup says of itself.

    Attributes:
        cell: Name of the cell.
        shard: Name of the shard.
        unix_s: When it was begun, seconds since 1970: all that was acknowledged then is in it.
        epoch: The shard's epoch then.
        entities: How many entities it has.
        states: How many states of their slots, replaced ones included.
        size: Bytes of their data.
        digests: Whether it has digests of its files, or was made before backups had them.
    """

    cell: str
    shard: str
    unix_s: int
    epoch: int
    entities: int
    states: int
    size: int
    digests: bool = True


# ---------------------------------------------------------------- back up


def back_up(folder: Path, into: Path, *, cell: str, shard: str, unix_s: int) -> Backup:
    """Copy the folder of a shard, whether it runs or not, to a new folder.

    Raises:
        StoreError: There is no data, it is damaged or in the midst of a rebalance, another backup
            of it is under way, the copy cannot be written, or `into` is there.
    """
    if not holds_store(folder):
        raise StoreError(f"no shard has its data in {folder}", path=str(folder))
    if into.absolute().is_relative_to(folder.absolute()):
        raise StoreError(
            f"{into} lies in the folder of the shard, {folder}; name a folder elsewhere with --to",
            path=str(into),
        )
    refuse_moving(folder)
    try:
        if into.exists():
            raise _is_there(into)
        with held_bodies(folder, into) as bodies, partial_folder(into, ".partial") as partial:
            stored = _copied(folder, bodies, partial)
            backup = _told(stored, cell=cell, shard=shard, unix_s=unix_s)
            told = {name: value for name, value in asdict(backup).items() if name != DIGESTS}
            files = digests_of(partial)
            told[MODES] = _modes(folder, bodies, files)
            replace_file(partial / BACKUP_FILE, sealed(told, files), mode=FILE_MODE)
            read_backup(partial)
            _sync(partial)
            if not _renamed(partial, into):
                raise _is_there(into)
    except OSError as failure:
        raise backup_error(folder, into, failure) from failure
    return backup


def _is_there(into: Path) -> StoreError:
    return StoreError(f"{into} is there already; name a new folder", path=str(into))


def _renamed(partial: Path, path: Path) -> bool:
    """Give a folder its name, which an empty one gives up for it; False: one with data has it."""
    try:
        partial.rename(path)
    except OSError as failure:
        if failure.errno in {errno.ENOTEMPTY, errno.EEXIST}:
            return False
        raise
    sync_folder(path.parent)
    return True


def _modes(folder: Path, bodies: HeldBodies, files: Iterable[str]) -> dict[str, str]:
    """Return who may read the files of a shard; bodies may be gone from its folder meanwhile."""
    modes = modes_of(folder, (BLOB_FOLDER, *(name for name in files if "/" not in name)))
    for name in files:
        if "/" in name:
            modes[name] = mode_of(bodies.path(name.rpartition("/")[2]))
    return modes


def _copied(folder: Path, bodies: HeldBodies, partial: Path) -> Recovered:
    """Copy a state of a folder; return it, with all of its bytes checked."""
    for _ in range(TRIES_MAX):
        if not _copy_database(folder, bodies, partial):
            continue
        database, contents = open_database(partial, look_at(partial))
        with closing(database):
            names = {blob.name for blob in contents.states.blobs.values()}
            if not all(bodies.has(name) for name in names):
                continue
            (partial / BLOB_FOLDER).mkdir(mode=FOLDER_MODE, exist_ok=True)
            for name in names:
                copy_private(bodies.path(name), partial / BLOB_FOLDER / name)
            blobs = BlobFolder(partial / BLOB_FOLDER, epoch=0)
            read_blobs(contents, blobs, power_cut=False)
            put_together(contents, partial / DATABASE_FILE)
            _check_bodies(contents.recovered)
        return contents.recovered
    raise StoreError(
        f"{folder} changed so fast that no copy of it came to its end in {TRIES_MAX} tries; back it"
        " up while less is written, or stopped",
        path=str(folder),
    )


def _copy_database(folder: Path, bodies: HeldBodies, partial: Path) -> bool:
    """Copy rows and log; False if the log was begun anew meanwhile, so that they do not fit."""
    for name in (FORMAT_FILE, MARK_FILE):
        copy_private(folder / name, partial / name)
    log, copy = folder / LOG_FILE, partial / LOG_FILE
    header = _header(log)
    copy_private(folder / DATABASE_FILE, partial / DATABASE_FILE)
    copy.unlink(missing_ok=True)
    bodies.hold(folder / BLOB_FOLDER)
    with suppress(FileNotFoundError):
        copy_private(log, copy)
    bodies.hold(folder / BLOB_FOLDER)
    if _header(log) != header:
        return False
    if header:
        # Behind its end the copy may have frames that were half written as they were read.
        os.truncate(copy, check_wal(copy).end)
    return True


def _header(log: Path) -> bytes:
    try:
        with log.open("rb") as file:
            return file.read(HEADER_BYTES)
    except FileNotFoundError:
        return b""


def _check_bodies(stored: Recovered) -> None:
    """Read all bytes that nobody has read yet.

    Raises:
        StoreError: Some are not as they were written.
    """
    for record in (*stored.history, *stored.slots):
        fault = record.datum.fault if record.datum is not None else None
        found = fault() if fault is not None else ""
        if found:
            raise StoreError(f"{found}; it has version {record.version} of {record.slot}")


def _told(stored: Recovered, *, cell: str, shard: str, unix_s: int) -> Backup:
    states = (*stored.history, *stored.slots)
    size = sum(state.datum.size for state in states if state.datum is not None)
    entities = len({state.slot.entity for state in states})
    return Backup(cell, shard, unix_s, stored.epoch, entities, len(states), size)


def _sync(folder: Path) -> None:
    for path in folder.rglob("*"):
        if path.is_file():
            with path.open("rb") as file:
                os.fsync(file.fileno())
    for path in (folder / BLOB_FOLDER, folder):
        sync_folder(path)


# ---------------------------------------------------------------- restore


class Contents(NamedTuple):
    """What a backup says of itself, and of its files.

    Attributes:
        backup: Of itself.
        files: Their digests; None: it was made before there were any.
        modes: Who may read them where they are restored; empty: it was made before it said so.
    """

    backup: Backup
    files: dict[str, Digest] | None
    modes: dict[str, str]


def read_backup(path: Path) -> Contents:
    """Return what a backup says of itself and of its files.

    Raises:
        StoreError: It is none, or that is not what it was.
    """
    told, files = read_sealed(path)
    try:
        modes = check_modes(told.pop(MODES, {}), files) if files is not None else {}
        if told.keys() != {field.name for field in dataclasses.fields(Backup)} - {DIGESTS}:
            raise ValueError(f"it has {', '.join(told)}")
        return Contents(Backup(**told, digests=files is not None), files, modes)
    except (TypeError, ValueError, AttributeError) as failure:
        raise StoreError(
            f"{path} is no backup of a shard, or its {BACKUP_FILE} is damaged ({failure}); copy the"
            " backup again from where it is whole, or take another one",
            path=str(path),
        ) from failure


def restore(
    source: Path, folder: Path, *, cell: str, shard: str, unix_s: int, replace: bool = False
) -> tuple[Backup, Path | None]:
    """Make the folder of a stopped shard what a backup has, every byte of it compared before.

    A backup that was made before there were digests has to do with the checks of a shard's start:
    whoever has no other one would rather have it than nothing.

    Args:
        source: The backup.
        folder: The shard's folder.
        cell: Name of the cell; the backup must be of it.
        shard: Name of the shard, as `cell`.
        unix_s: The wall clock, seconds since 1970.
        replace: Whether a folder that is there goes aside; it is not removed.

    Returns:
        The backup, and where what was there before is now.

    Raises:
        StoreError: The backup is of another shard, damaged or from the future; the folder is in
            use, or is there and not to be replaced; or it cannot be written.
    """
    contents = read_backup(source)
    backup = contents.backup
    if (backup.cell, backup.shard) != (cell, shard):
        raise StoreError(
            f"{source} is a backup of shard {backup.shard} of cell {backup.cell}, not of {shard} of"
            f" {cell}"
        )
    if unix_s < backup.unix_s:
        raise StoreError(
            f"the clock of this host says {_time(unix_s)}, the backup is of {_time(backup.unix_s)};"
            " the restored shard must begin later than all that clients have seen of it: set the"
            " clock first"
        )
    try:
        if contents.files is not None:
            check_files(source, contents.files)
        with partial_folder(folder, ".restoring") as partial:
            aside = _put(source, contents, partial, folder, unix_s=unix_s, replace=replace)
    except OSError as failure:
        raise store_error(folder, failure) from failure
    return backup, aside


def _put(
    source: Path, contents: Contents, partial: Path, folder: Path, *, unix_s: int, replace: bool
) -> Path | None:
    """Build a folder in `partial` and put it in its place; return where the one before is now."""
    if not folder.exists() or not any(folder.iterdir()):
        _build(source, partial, contents, unix_s=unix_s, epoch=_epoch_before(folder))
        if not _renamed(partial, folder):  # one was begun meanwhile
            raise _has_data(folder)
        return None
    if not replace:
        raise _has_data(folder)
    epoch = _epoch_before(folder)
    with closing(FolderLock(folder)):
        _build(source, partial, contents, unix_s=unix_s, epoch=epoch)
        while (aside := folder.with_name(f"{folder.name}{ASIDE}{unix_s}")).exists():
            unix_s += 1
        folder.rename(aside)
        partial.rename(folder)
        sync_folder(folder.parent)
    return aside


def _has_data(folder: Path) -> StoreError:
    return StoreError(
        f"{folder} has data; say --replace to put the backup in its place, what is there now is"
        " kept beside it",
        path=str(folder),
    )


def _build(source: Path, partial: Path, contents: Contents, *, unix_s: int, epoch: int) -> None:
    """Make a folder of a backup, checked whole, whose next epoch is above `epoch`."""
    backup, files, modes = contents
    names = files if files is not None else files_of(source)
    (partial / BLOB_FOLDER).mkdir(mode=FOLDER_MODE)
    for name in names:
        copy_private(source / name, partial / name)
    if files is not None:
        check_files(partial, files)
    with read_store(partial) as stored:
        _check_bodies(stored)
        found = _told(stored, cell=backup.cell, shard=backup.shard, unix_s=backup.unix_s)
    if found != dataclasses.replace(backup, digests=True):
        raise StoreError(
            f"{source} is not what it was when it was made: {found.states} states with"
            f" {found.size} bytes are there of {backup.states} with {backup.size}; copy it again",
            path=str(source),
        )
    store, _ = open_store(partial, unix_s=unix_s)
    with closing(store):
        store.raise_epoch(epoch)
    set_modes(partial, modes or modes_of(source, (BLOB_FOLDER, *names)))
    _sync(partial)


def _epoch_before(folder: Path) -> int:
    """Return the largest epoch that a folder and those that were replaced are known to have had."""
    epochs = [0]
    for path in (folder, *folder.parent.glob(f"{folder.name}{ASIDE}*")):
        if holds_store(path):
            # A folder that cannot be read is a reason to restore one; then the clock has to do.
            with suppress(StoreError), read_store(path) as stored:
                epochs.append(stored.epoch)
    return max(epochs)


def _time(unix_s: int) -> str:
    return time.strftime("%Y-%m-%d %H:%M:%S UTC", time.gmtime(unix_s))
