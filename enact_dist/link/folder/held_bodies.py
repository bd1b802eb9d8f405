"""Links that preserve the large bodies of a shard's folder while it is backed up.

The shard unlinks bodies that it replaces, even during a backup; a second name keeps the file.  One
backup at a time holds such links, under a lock that ends with its process; the next backup or the
shard's start deletes the links of a killed one.  A file beside the links names the holder and the
destination, for people.
"""

from __future__ import annotations

import errno
import fcntl
import logging
import os
import shutil
import socket
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Final

from enact_dist.errors import StoreError
from enact_dist.link.folder.lock import FORMAT_FILE

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

HELD_FOLDER: Final = "backup.held"
_HOLDER_FILE: Final = "holder"

_log = logging.getLogger("enact.store")


def hold(blobs: Path, held: Path) -> None:
    """Link all files of `blobs` that are not linked in `held` yet."""
    for path in blobs.iterdir():
        with suppress(FileNotFoundError, FileExistsError):
            os.link(path, held / path.name)


@contextmanager
def held_bodies(folder: Path, into: Path) -> Iterator[Path]:
    """Yield a folder for links that preserve the bodies of a shard's folder; remove it at the end.

    Raises:
        StoreError: Another backup of this folder is in progress.
        OSError: As the system reports it.
    """
    with _locked(folder) as held:
        held.mkdir(mode=0o700)
        try:
            (held / _HOLDER_FILE).write_text(
                f"process {os.getpid()} on host {socket.gethostname()} into {into.absolute()}"
            )
            yield held
        finally:
            shutil.rmtree(held, ignore_errors=True)


@contextmanager
def _locked(folder: Path) -> Iterator[Path]:
    """Lock the folder against other backups; delete the links of a killed one."""
    held = folder / HELD_FOLDER
    with (folder / FORMAT_FILE).open("rb") as locked:
        try:
            fcntl.flock(locked, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as failure:
            if failure.errno != errno.EWOULDBLOCK:
                raise
            raise StoreError(
                f"a backup of {folder} is in progress, by {_holder(held)}; make one at a time:"
                " wait until it ends",
                path=str(folder),
            ) from failure
        if held.exists():
            killed = _holder(held)
            (held / _HOLDER_FILE).unlink(missing_ok=True)
            shutil.rmtree(held)
            _log.warning(
                "a backup was killed, by %s: its links are removed; its copy stays beside"
                " the destination until the next backup to that place",
                killed,
            )
        yield held


def _holder(held: Path) -> str:
    try:
        return (held / _HOLDER_FILE).read_text(errors="replace")
    except OSError:
        return "another process"


def remove_killed_backup(folder: Path) -> None:
    """Remove the links of a killed backup of this folder, unless a backup is in progress.

    They only cost disk space; a failure to remove them is logged.
    """
    if not (folder / HELD_FOLDER).exists():
        return
    try:
        with suppress(StoreError), _locked(folder):
            pass
    except OSError as failure:
        _log.warning("cannot remove the remains of a killed backup in %s: %s", folder, failure)
