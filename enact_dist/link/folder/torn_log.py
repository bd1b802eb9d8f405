"""Drops commits at the end of the log that a power cut has torn without SQLite noticing it.

SQLite finds a torn commit by the checksum of each frame.  That sum adds words with weights of which
each is the sum of the next two, so a frame whose stale sector differs in three neighbouring words
by (+1, -1, -1) passes.  Page 1 holds the number of pages, the first free page and the number of
free pages side by side, and a log is written over its older generation: such a frame exists.

So after a power cut the content is read once through a link that writes nothing.  If it is damaged,
the newest commit up to which it is sound is found by bisection, and the log is cut there.  Only
unforced commits can be torn: a log whose forced commits are damaged stays as it is.
"""

from __future__ import annotations

import contextlib
import logging
import os
import shutil
import sqlite3
from typing import TYPE_CHECKING, Final

from enact_dist.errors import StoreError
from enact_dist.link.folder.folder import DATABASE_FILE, LOG_FILE, Found
from enact_dist.link.folder.wal_check import commit_ends
from enact_dist.link.store.database import Database, is_damage
from enact_dist.link.store.recovery import read_contents

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

_TRIAL_FILE: Final = "trial.db"
_log = logging.getLogger("enact.store")


def cut_torn_commits(folder: Path, found: Found) -> None:
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


@contextlib.contextmanager
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


def _batch_of_sound(trial: Path, log: Path, end: int, found: Found) -> int | None:
    """Return the newest batch of the database with its log up to `end`; None if it is damaged."""
    trial.with_name(f"{trial.name}-wal").write_bytes(log.read_bytes()[:end])
    try:
        with contextlib.closing(Database(trial, writable=False)) as database:
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
