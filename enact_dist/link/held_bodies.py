"""Links that keep the large bodies of a shard's folder for as long as a backup of it is made.

The shard unlinks what it replaces, whoever copies meanwhile; a second name keeps the file.  One
backup at a time holds such links, by a lock that ends with its process: what a killed one leaves is
let go by the next one, or when the shard starts.  Who holds it and where the copy goes is written
beside the links, for people.
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
from enact_dist.link.folder_lock import FORMAT_FILE

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

HELD_FOLDER: Final = "backup.held"
_HOLDER_FILE: Final = "holder"

_log = logging.getLogger("enact.store")


class HeldBodies:
    """The links of the one backup of a folder that is under way.

    Args:
        held: The folder of the links.
    """

    def __init__(self, held: Path) -> None:
        self._held = held

    def hold(self, blobs: Path) -> None:
        """Link all files of `blobs` that are not linked yet, so that they stay."""
        for path in blobs.iterdir():
            with suppress(FileNotFoundError, FileExistsError):
                os.link(path, self._held / path.name)

    def has(self, name: str) -> bool:
        """Return whether a body of this name is held."""
        return (self._held / name).exists()

    def path(self, name: str) -> Path:
        """Return where a body that is held can be read."""
        return self._held / name


@contextmanager
def held_bodies(folder: Path, into: Path) -> Iterator[HeldBodies]:
    """Hold bodies of a shard's folder; they are let go at the end.

    Args:
        folder: The shard's.
        into: Where its copy goes.

    Raises:
        StoreError: Another backup of this folder is under way.
        OSError: As the system reports it.
    """
    with _locked(folder) as held:
        held.mkdir(mode=0o700)
        try:
            (held / _HOLDER_FILE).write_text(
                f"process {os.getpid()} on host {socket.gethostname()} into {into.absolute()}"
            )
            yield HeldBodies(held)
        finally:
            shutil.rmtree(held, ignore_errors=True)


@contextmanager
def _locked(folder: Path) -> Iterator[Path]:
    """Be the one that backs a folder up; what a killed one has left is gone."""
    held = folder / HELD_FOLDER
    with (folder / FORMAT_FILE).open("rb") as locked:
        try:
            fcntl.flock(locked, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as failure:
            if failure.errno != errno.EWOULDBLOCK:
                raise
            raise StoreError(
                f"a backup of {folder} is under way, by {_holder(held)}; one is made at a time:"
                " wait for its end",
                path=str(folder),
            ) from failure
        if held.exists():
            killed = _holder(held)
            (held / _HOLDER_FILE).unlink(missing_ok=True)
            shutil.rmtree(held)
            _log.warning(
                "a backup was killed, by %s: what it held is let go; what it has copied lies beside"
                " its place, until the next backup goes there",
                killed,
            )
        yield held


def _holder(held: Path) -> str:
    try:
        return (held / _HOLDER_FILE).read_text(errors="replace")
    except OSError:
        return "another process"


def let_go_of_killed(folder: Path) -> None:
    """Remove the links of a backup of this folder that was killed, if nobody makes one now.

    They cost room on the disk and nothing else: what cannot be removed is logged.
    """
    if not (folder / HELD_FOLDER).exists():
        return
    try:
        with suppress(StoreError), _locked(folder):
            pass
    except OSError as failure:
        _log.warning("what a killed backup has left in %s stays: %s", folder, failure)
