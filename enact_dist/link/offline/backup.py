"""Backs up and restores a shard's folder, also while the shard runs.

The database is copied first, its log afterwards.  While the log's header stays the same, everything
carried into the database during the copy is in the log too and replaces pages that were copied
torn; otherwise both are copied again.  Large bodies are files that never change: links hold all
bodies that exist just before and just after the log is read (`link.folder.held_bodies`).  The mark
is copied first, so a copy that lacks anything acknowledged by then is refused.  A copy gets its
name only once every byte is checked and on the disk.  Its digests (`link.offline.backup_files`) are
computed from the copy, so the shard waits for none of this.  Only the user who makes a backup may
read it; a restored folder gets the permissions of the shard's.

A restored shard starts with an epoch above that of its backup, of the folder it replaces, and of
the wall clock.  A client that knew a later state then sees that the shard has restarted, and no
earlier lock or commit counts.
"""

from __future__ import annotations

import dataclasses
import errno
import os
import time
from collections.abc import Iterable
from contextlib import closing, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final, NamedTuple

from enact_dist.core.protocol.records import Recovered
from enact_dist.errors import StoreError
from enact_dist.link.folder.blobs import BlobFolder
from enact_dist.link.folder.folder import (
    ASIDE,
    BLOB_FOLDER,
    DATABASE_FILE,
    LOG_FILE,
    holds_store,
    look_at,
)
from enact_dist.link.folder.held_bodies import held_bodies, hold
from enact_dist.link.folder.lock import FORMAT_FILE, FolderLock, replace_file, sync_folder
from enact_dist.link.folder.mark import MARK_FILE
from enact_dist.link.folder.moving_marks import refuse_moving
from enact_dist.link.folder.wal_check import HEADER_BYTES, check_wal
from enact_dist.link.offline.backup_files import (
    BACKUP_FILE,
    FILE_MODE,
    FOLDER_MODE,
    MODES,
    Digest,
    check_files,
    check_modes,
    copy_private,
    digests_of,
    files_of,
    mode_of,
    modes_of,
    partial_folder,
    read_sealed,
    sealed,
    set_modes,
)
from enact_dist.link.store.medium import FULL_ERRNOS, file_in, folder_errors, open_database
from enact_dist.link.store.recovery import put_together, read_blobs
from enact_dist.link.store.store import open_store, read_store

DIGESTS: Final = "digests"
TRIES_MAX: Final = 50
"""How often the files are copied again because the shard has restarted its log meanwhile."""


@dataclass(frozen=True, slots=True)
class Backup:
    """The description of a backup.

    Attributes:
        unix_s: When it began, seconds since 1970; it holds everything acknowledged by then.
        epoch: The shard's epoch then.
        states: How many states of its slots, replaced ones included.
        size: Bytes of their data.
        digests: Whether it has digests of its files; backups of older releases have none.
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
    """Copy the folder of a shard, running or stopped, to a new folder.

    Raises:
        StoreError: The folder has no data, is damaged or in the middle of a rebalance, another
            backup of it is under way, the copy cannot be written, or `into` exists.
    """
    if not holds_store(folder):
        raise StoreError(f"{folder} holds no data of a shard", path=str(folder))
    if into.absolute().is_relative_to(folder.absolute()):
        raise StoreError(
            f"{into} is inside the shard's folder {folder}; name another place with --to",
            path=str(into),
        )
    refuse_moving(folder)
    try:
        if into.exists():
            raise _is_there(into)
        with held_bodies(folder, into) as held, partial_folder(into, ".partial") as partial:
            stored = _copied(folder, held, partial)
            backup = _description(stored, cell=cell, shard=shard, unix_s=unix_s)
            facts = {name: value for name, value in asdict(backup).items() if name != DIGESTS}
            files = digests_of(partial)
            facts[MODES] = _modes(folder, held, files)
            replace_file(partial / BACKUP_FILE, sealed(facts, files), mode=FILE_MODE)
            read_backup(partial)
            sync_all(partial)
            if not renamed(partial, into):
                raise _is_there(into)
    except OSError as failure:
        raise _backup_error(folder, into, failure) from failure
    return backup


def _backup_error(folder: Path, into: Path, failure: OSError) -> StoreError:
    """Return the error that tells an operator about a system error during a backup."""
    remedy = "name another place with --to that has room and is writable for this user"
    names = (failure.filename, failure.filename2)  # of a copy: from where, and to where
    # Nothing is full where it is read, so a copy has failed where it is written.
    at = names[failure.errno in FULL_ERRNOS and names[1] is not None]
    where = Path(str(at or into))
    if (file := file_in(into.parent)) is not None:
        found = f"{file} is a file, not a folder: no backup can be written to {into}"
    elif where.is_relative_to(folder) and failure.errno in FULL_ERRNOS:
        found = f"the disk of the shard in {folder} has no room for links to its files ({failure})"
        remedy = "free some there"
    elif where.is_relative_to(folder):
        found = f"the data of the shard in {folder} cannot be read ({failure})"
        remedy = "make the backup as the user that runs the shard"
    else:
        found = f"the backup cannot be written to {into} ({failure})"
    return StoreError(f"{found}; {remedy}; the shard is as it was", path=str(where))


def _is_there(into: Path) -> StoreError:
    return StoreError(f"{into} exists already; name a new folder", path=str(into))


def renamed(partial: Path, path: Path) -> bool:
    """Rename a folder, replacing an empty one; return False if the target has data."""
    try:
        partial.rename(path)
    except OSError as failure:
        if failure.errno in {errno.ENOTEMPTY, errno.EEXIST}:
            return False
        raise
    sync_folder(path.parent)
    return True


def _modes(folder: Path, held: Path, files: Iterable[str]) -> dict[str, str]:
    """Return the permissions of a shard's files; it may delete bodies meanwhile."""
    modes = modes_of(folder, (BLOB_FOLDER, *(name for name in files if "/" not in name)))
    for name in files:
        if "/" in name:
            modes[name] = mode_of(held / name.rpartition("/")[2])
    return modes


def _copied(folder: Path, held: Path, partial: Path) -> Recovered:
    """Copy a state of a folder; return it, with every byte checked."""
    for _ in range(TRIES_MAX):
        if not _copy_database(folder, held, partial):
            continue
        database, contents = open_database(partial, look_at(partial))
        with closing(database):
            names = {blob.name for blob in contents.states.blobs.values()}
            if not all((held / name).exists() for name in names):
                continue
            (partial / BLOB_FOLDER).mkdir(mode=FOLDER_MODE, exist_ok=True)
            for name in names:
                copy_private(held / name, partial / BLOB_FOLDER / name)
            blobs = BlobFolder(partial / BLOB_FOLDER, epoch=0)
            read_blobs(contents, blobs, power_cut=False)
            put_together(contents, partial / DATABASE_FILE)
            check_bodies(contents.recovered)
        return contents.recovered
    raise StoreError(
        f"{folder} changed too fast for a consistent copy in {TRIES_MAX} tries; back it"
        " up while less is written, or while the shard is stopped",
        path=str(folder),
    )


def _copy_database(folder: Path, held: Path, partial: Path) -> bool:
    """Copy rows and log; return False if the shard restarted its log, so that they do not match."""
    for name in (FORMAT_FILE, MARK_FILE):
        copy_private(folder / name, partial / name)
    log, copy = folder / LOG_FILE, partial / LOG_FILE
    header = _header(log)
    copy_private(folder / DATABASE_FILE, partial / DATABASE_FILE)
    copy.unlink(missing_ok=True)
    hold(folder / BLOB_FOLDER, held)
    with suppress(FileNotFoundError):
        copy_private(log, copy)
    hold(folder / BLOB_FOLDER, held)
    if _header(log) != header:
        return False
    if header:
        # Frames behind its end may have been half written when they were read.
        os.truncate(copy, check_wal(copy).end)
    return True


def _header(log: Path) -> bytes:
    try:
        with log.open("rb") as file:
            return file.read(HEADER_BYTES)
    except FileNotFoundError:
        return b""


def check_bodies(stored: Recovered) -> None:
    """Read all bytes that nothing has checked yet.

    Raises:
        StoreError: Some differ from what was written.
    """
    for record in (*stored.history, *stored.slots):
        fault = record.datum.fault if record.datum is not None else None
        found = fault() if fault is not None else ""
        if found:
            raise StoreError(f"{found}; it has version {record.version} of {record.slot}")


def _description(stored: Recovered, *, cell: str, shard: str, unix_s: int) -> Backup:
    states = (*stored.history, *stored.slots)
    size = sum(state.datum.size for state in states if state.datum is not None)
    entities = len({state.slot.entity for state in states})
    return Backup(cell, shard, unix_s, stored.epoch, entities, len(states), size)


def sync_all(folder: Path) -> None:
    """Force all files of a shard's folder to the disk, with their names."""
    for path in folder.rglob("*"):
        if path.is_file():
            with path.open("rb") as file:
                os.fsync(file.fileno())
    for path in (folder / BLOB_FOLDER, folder):
        sync_folder(path)


# ---------------------------------------------------------------- restore


class Manifest(NamedTuple):
    """The contents of a backup's description.

    Attributes:
        files: Digests of its files; None: it is from before backups had digests.
        modes: Permissions of the restored files; empty: it is from before backups recorded them.
    """

    backup: Backup
    files: dict[str, Digest] | None
    modes: dict[str, str]


def read_backup(path: Path) -> Manifest:
    """Return the description of a backup and of its files.

    Raises:
        StoreError: This is no backup, or its description has changed.
    """
    facts, files = read_sealed(path)
    try:
        modes = check_modes(facts.pop(MODES, {}), files) if files is not None else {}
        if facts.keys() != {field.name for field in dataclasses.fields(Backup)} - {DIGESTS}:
            raise ValueError(f"it has {', '.join(facts)}")
        return Manifest(Backup(**facts, digests=files is not None), files, modes)
    except (TypeError, ValueError, AttributeError) as failure:
        raise StoreError(
            f"{path} is no backup of a shard, or its {BACKUP_FILE} is damaged ({failure}); copy the"
            " backup again from an intact source, or use another one",
            path=str(path),
        ) from failure


def restore(
    source: Path, folder: Path, *, cell: str, shard: str, unix_s: int, replace: bool = False
) -> tuple[Backup, Path | None]:
    """Replace the folder of a stopped shard with a backup, after comparing every byte of it.

    A backup from before digests existed gets only the checks of a shard's start: it may be the only
    one.

    Args:
        source: The backup.
        folder: The shard's folder.
        cell: Name of the cell; must match the backup's.
        shard: Name of the shard; must match the backup's.
        unix_s: The wall clock, seconds since 1970.
        replace: Whether to put an existing folder aside; it is never deleted.

    Returns:
        The backup, and the new path of the folder that was there before.

    Raises:
        StoreError: The backup is of another shard, damaged or from the future; the folder is in
            use, or exists without `replace`; or it cannot be written.
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
            " the restored shard must start later than anything its clients have seen: set the"
            " clock first"
        )
    with folder_errors(folder):
        if contents.files is not None:
            check_files(source, contents.files)
        with partial_folder(folder, ".restoring") as partial:
            aside = _put(source, contents, partial, folder, unix_s=unix_s, replace=replace)
    return backup, aside


def _put(
    source: Path,
    contents: Manifest,
    partial: Path,
    folder: Path,
    *,
    unix_s: int,
    replace: bool,
) -> Path | None:
    """Build a folder in `partial` and move it into place; return the path of the previous one."""
    if not folder.exists() or not any(folder.iterdir()):
        _build(source, partial, contents, unix_s=unix_s, epoch=_epoch_before(folder))
        if not renamed(partial, folder):  # another start has made one
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
        f"{folder} has data; use --replace to put the backup in its place (the present folder is"
        " kept beside it)",
        path=str(folder),
    )


def _build(source: Path, partial: Path, contents: Manifest, *, unix_s: int, epoch: int) -> None:
    """Build a folder from a backup, fully checked, whose next epoch is above `epoch`."""
    backup, files, modes = contents
    names = files if files is not None else files_of(source)
    (partial / BLOB_FOLDER).mkdir(mode=FOLDER_MODE)
    for name in names:
        copy_private(source / name, partial / name)
    if files is not None:
        check_files(partial, files)
    with read_store(partial) as stored:
        check_bodies(stored)
        found = _description(stored, cell=backup.cell, shard=backup.shard, unix_s=backup.unix_s)
    if found != dataclasses.replace(backup, digests=True):
        raise StoreError(
            f"{source} has changed since it was made: it has {found.states} states with"
            f" {found.size} bytes instead of {backup.states} with {backup.size}; copy it again",
            path=str(source),
        )
    store, _ = open_store(partial, unix_s=unix_s)
    with closing(store):
        store.raise_epoch(epoch)
    set_modes(partial, modes or modes_of(source, (BLOB_FOLDER, *names)))
    sync_all(partial)


def _epoch_before(folder: Path) -> int:
    """Return the largest epoch known of a folder and of those it replaced."""
    epochs = [0]
    for path in (folder, *folder.parent.glob(f"{folder.name}{ASIDE}*")):
        if holds_store(path):
            # An unreadable folder is a reason to restore one; then the clock must do.
            with suppress(StoreError), read_store(path) as stored:
                epochs.append(stored.epoch)
    return max(epochs)


def _time(unix_s: int) -> str:
    return time.strftime("%Y-%m-%d %H:%M:%S UTC", time.gmtime(unix_s))
