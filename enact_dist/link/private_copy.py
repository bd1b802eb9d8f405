"""Copies that only their owner can read, from the first byte on, whatever the umask.

A folder is built beside its destination and renamed when it is complete.  One process at a time
builds it, under a lock that ends with the process; the next one deletes the remains of a killed
one.  Some file systems (NFS) cannot lock folders; backups work there without the lock.
"""

from __future__ import annotations

import errno
import fcntl
import logging
import os
import shutil
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Final

from enact_dist.errors import StoreError

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

FILE_MODE: Final = 0o600
FOLDER_MODE: Final = 0o700

_log = logging.getLogger("enact.store")


def copy_private(source: Path, target: Path) -> None:
    """Copy the bytes of a file to a new one that only its owner may read.

    Raises:
        OSError: As the system reports it.
    """
    target.touch(mode=FILE_MODE)
    shutil.copyfile(source, target)


@contextmanager
def partial_folder(path: Path, suffix: str) -> Iterator[Path]:
    """Make a private empty folder beside `path`, with its name and `suffix`.

    The caller renames it when it is complete; otherwise it is deleted.

    Raises:
        StoreError: Another process works in it.
        OSError: As the system reports it.
    """
    partial = path.with_name(path.name + suffix)
    partial.parent.mkdir(parents=True, exist_ok=True)
    descriptor = _made(partial)
    try:
        yield partial
    except BaseException:
        shutil.rmtree(partial, ignore_errors=True)
        raise
    finally:
        os.close(descriptor)


def _made(partial: Path) -> int:
    """Make the folder from scratch; return its lock."""
    left = _lock_of_left(partial)
    try:
        if left is not None:
            shutil.rmtree(partial)
        try:
            partial.mkdir(mode=FOLDER_MODE)
        except FileExistsError:
            raise _in_use(partial) from None
        return _locked(partial)
    finally:
        if left is not None:
            os.close(left)


def _lock_of_left(partial: Path) -> int | None:
    """Return the lock of a folder that a killed process has left; None: it does not exist."""
    with suppress(FileNotFoundError):
        while True:
            descriptor = _locked(partial)
            with suppress(FileNotFoundError):
                if os.path.samestat(os.fstat(descriptor), partial.stat()):
                    return descriptor
            os.close(descriptor)  # another process has removed or renamed it meanwhile
    return None


def _locked(partial: Path) -> int:
    descriptor = os.open(partial, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as failure:
        if failure.errno == errno.EWOULDBLOCK:
            os.close(descriptor)
            raise _in_use(partial) from failure
        _log.info("cannot lock %s, so concurrent backups stay undetected: %s", partial, failure)
    return descriptor


def _in_use(partial: Path) -> StoreError:
    return StoreError(
        f"another backup or restore works in {partial}: wait until it ends, or name another folder",
        path=str(partial),
    )
