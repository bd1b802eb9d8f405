"""The messages that an operator reads when the system below a store fails."""

from __future__ import annotations

import errno
import os
import sqlite3
from pathlib import Path
from typing import Final

from enact_dist.errors import StoreError

_FULL_ERRNOS: Final = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG})
_DENIED_ERRNOS: Final = frozenset({errno.EACCES, errno.EPERM, errno.EROFS, errno.ENOTDIR})


def store_error(folder: Path, failure: OSError | sqlite3.Error) -> StoreError:
    """Return the error that tells an operator about a system error."""
    if (file := _file_in(folder)) is not None:
        return StoreError(
            f"{file} is a file, not a folder, so a shard cannot keep its data in {folder}; name"
            " another folder in cell.toml (`folder` of the shard, or `data_folder`), or move the"
            " file away",
            path=str(file),
        )
    path = str(getattr(failure, "filename", None) or folder)
    code = getattr(failure, "sqlite_errorcode", 0) & 0xFF
    number = failure.errno if isinstance(failure, OSError) else None
    if number in _FULL_ERRNOS or code == sqlite3.SQLITE_FULL:
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


def backup_error(folder: Path, into: Path, failure: OSError) -> StoreError:
    """Return the error that tells an operator about a system error during a backup."""
    remedy = "name another place with --to that has room and is writable for this user"
    where = Path(str(getattr(failure, "filename", None) or into))
    if (file := _file_in(into.parent)) is not None:
        found = f"{file} is a file, not a folder: no backup can be written to {into}"
    elif where.is_relative_to(folder):
        found = f"the data of the shard in {folder} cannot be read ({failure})"
        remedy = "make the backup as the user that runs the shard"
    else:
        found = f"the backup cannot be written to {into} ({failure})"
    return StoreError(f"{found}; {remedy}; the shard is as it was", path=str(where))


def _file_in(folder: Path) -> Path | None:
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
