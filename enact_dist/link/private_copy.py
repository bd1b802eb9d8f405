"""Copies that nobody else may read, from their first byte on, and whatever the umask says.

A folder is put together beside its place and gets its name when it is whole.  One process at a
time does so, by a lock on the folder that ends with it: what a killed one leaves is removed by the
next one.  Some file systems (NFS) lock no folders; there a backup is made all the same.
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
    """Copy the bytes of a file to a new one that its owner alone may read.

    Raises:
        OSError: As the system reports it.
    """
    target.touch(mode=FILE_MODE)
    shutil.copyfile(source, target)


@contextmanager
def partial_folder(path: Path, suffix: str) -> Iterator[Path]:
    """Make an empty folder beside `path`, with its name and `suffix`, that nobody else reads.

    Whoever has put all into it renames it; else it is removed.

    Raises:
        StoreError: Somebody else works in it.
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
    """Make the folder anew; return its lock."""
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
    """Return the lock of a folder that a killed process has left; None: there is none."""
    with suppress(FileNotFoundError):
        while True:
            descriptor = _locked(partial)
            with suppress(FileNotFoundError):
                if os.path.samestat(os.fstat(descriptor), partial.stat()):
                    return descriptor
            os.close(descriptor)  # another one has removed it meanwhile, or given it its name
    return None


def _locked(partial: Path) -> int:
    descriptor = os.open(partial, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as failure:
        if failure.errno == errno.EWOULDBLOCK:
            os.close(descriptor)
            raise _in_use(partial) from failure
        _log.info("%s cannot be locked, so two at once are not told: %s", partial, failure)
    return descriptor


def _in_use(partial: Path) -> StoreError:
    return StoreError(
        f"another backup or restore works in {partial} just now: wait for its end, or name another"
        " folder",
        path=str(partial),
    )
