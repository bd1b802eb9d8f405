"""The files of a backup: readable by their owner only, with digests that tell one changed byte.

``backup.json`` holds the size and SHA-256 of every other file and ends with the SHA-256 of its own
preceding text.  A store checks its data where it decides something; a backup may lie on other disks
and cross networks for a year before it is read once.  The text also records the permissions of the
shard's files, since the copies are readable by their owner only.

A folder is built beside its destination and renamed when it is complete.  One process at a time
builds it, under a lock that ends with the process; the next one deletes the remains of a killed
one.  Some file systems (NFS) cannot lock folders; backups work there without the lock.

Errors of the system pass through as `OSError`.
"""

from __future__ import annotations

import errno
import fcntl
import hashlib
import json
import logging
import os
import re
import shutil
import stat
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Final, NamedTuple

from enact_dist.errors import StoreError
from enact_dist.link.folder.folder import BLOB_FOLDER, DATABASE_FILE, LOG_FILE
from enact_dist.link.folder.lock import FORMAT_FILE
from enact_dist.link.folder.mark import MARK_FILE

FILE_MODE: Final = 0o600
FOLDER_MODE: Final = 0o700

_log = logging.getLogger("enact.store")


def copy_private(source: Path, target: Path) -> None:
    """Copy the bytes of a file to a new one that only its owner may read."""
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


BACKUP_FILE: Final = "backup.json"
FILES: Final = "files"
MODES: Final = "modes"
HERE: Final = "."
MODE_MAX: Final = 0o7777
_SEAL: Final = re.compile(rb'(?s)(.*), "sha256": "([0-9a-f]{64})"\}')
_PLAIN: Final = frozenset((FORMAT_FILE, MARK_FILE, DATABASE_FILE, LOG_FILE))
_COPY_AGAIN: Final = "copy the backup again from an intact source, or use another one"


class Digest(NamedTuple):
    """Size and SHA-256 of a file."""

    size: int
    sha256: str

    def __str__(self) -> str:
        """Return both, for people."""
        return f"{self.size} bytes with SHA-256 {self.sha256}"


def digest_of(path: Path) -> Digest:
    """Return the digest of a file."""
    with path.open("rb") as file:
        sha256 = hashlib.file_digest(file, "sha256").hexdigest()
        return Digest(file.tell(), sha256)


def digests_of(folder: Path) -> dict[str, Digest]:
    """Return the digests of all files of a backup, by their path in it."""
    return {name: digest_of(folder / name) for name in files_of(folder)}


def files_of(folder: Path) -> list[str]:
    """Return the files of a backup except its description, by their path in it."""
    names = [name for name in sorted(_PLAIN) if (folder / name).exists()]
    names += sorted(f"{BLOB_FOLDER}/{path.name}" for path in (folder / BLOB_FOLDER).iterdir())
    return names


# ---------------------------------------------------------------- permissions


def modes_of(folder: Path, names: Iterable[str]) -> dict[str, str]:
    """Return the permissions of a folder and of the files named in it, in octal digits.

    Raises:
        OSError: As the system reports it; a missing file is left out.
    """
    modes: dict[str, str] = {}
    for name in (HERE, *names):
        with suppress(FileNotFoundError):
            modes[name] = mode_of(folder / name)
    return modes


def mode_of(path: Path) -> str:
    """Return the permissions of a file or folder, in octal digits."""
    return f"{stat.S_IMODE(path.stat().st_mode):o}"


def set_modes(folder: Path, modes: dict[str, str]) -> None:
    """Set the permissions of the named files and folders; the owner always keeps access."""
    for name, mode in reversed(modes.items()):  # the folder itself last
        path = folder / name
        with suppress(FileNotFoundError):
            owner = stat.S_IRWXU if path.is_dir() else stat.S_IRUSR | stat.S_IWUSR
            path.chmod(int(mode, 8) | owner)


def check_modes(modes: dict[str, str], files: Iterable[str]) -> dict[str, str]:
    """Return the permissions of a backup, checked.

    Raises:
        ValueError: They are invalid, or belong to a file that the backup lacks.
        AttributeError: As `ValueError`.
        TypeError: As `ValueError`.
    """
    if modes.keys() - {HERE, BLOB_FOLDER, *files}:
        raise ValueError("it has permissions of files that it lacks")
    if any(not 0 <= int(mode, 8) <= MODE_MAX for mode in modes.values()):
        raise ValueError("its permissions are invalid")
    return modes


# ---------------------------------------------------------------- backup.json


def sealed(facts: dict[str, Any], files: dict[str, Digest]) -> bytes:
    """Return the text of `BACKUP_FILE`: description, digests of the files, its own digest."""
    text = json.dumps({**facts, FILES: files}).removesuffix("}").encode()
    return text + f', "sha256": "{hashlib.sha256(text).hexdigest()}"}}'.encode()


def read_sealed(path: Path) -> tuple[dict[str, Any], dict[str, Digest] | None]:
    """Return a backup's description and its digests; None: it is from before digests existed.

    Raises:
        StoreError: The text is missing or has changed.
    """
    file = path / BACKUP_FILE
    try:
        text = file.read_bytes()
        seal = _SEAL.fullmatch(text)
        if seal is not None and (found := hashlib.sha256(seal[1]).hexdigest()) != seal[2].decode():
            raise StoreError(
                f"{file} has changed since the backup was made: its text has SHA-256 {found},"
                f" but records {seal[2].decode()}; {_COPY_AGAIN}",
                path=str(file),
            )
        facts = json.loads(text)
        if seal is None:
            return dict(facts), None
        del facts["sha256"]
        return facts, {name: _listed(name, *digest) for name, digest in facts.pop(FILES).items()}
    except (OSError, ValueError, TypeError, KeyError, AttributeError) as failure:
        raise StoreError(
            f"{path} is no backup of a shard: its {BACKUP_FILE} cannot be read ({failure})",
            path=str(path),
        ) from failure


def _listed(name: str, size: int, sha256: str) -> Digest:
    folder, _, body = name.rpartition("/")
    if name not in _PLAIN and (folder != BLOB_FOLDER or body in {"", ".", ".."}):
        raise ValueError(f"{name!r} is no file of a backup")
    return Digest(size, sha256)


def check_files(folder: Path, files: dict[str, Digest]) -> None:
    """Read all files of a backup.

    Raises:
        StoreError: One is missing or has changed.
        OSError: One cannot be read.
    """
    wrong: list[str] = []
    for name, expected in files.items():
        try:
            found = digest_of(folder / name)
        except FileNotFoundError:
            wrong.append(f"{folder / name} is missing, expected {expected}")
        else:
            if found != expected:
                wrong.append(f"{folder / name} has {found}, expected {expected}")
    if wrong:
        more = f" (and {len(wrong) - 1} more files)" if wrong[1:] else ""
        raise StoreError(f"{wrong[0]}{more}; {_COPY_AGAIN}", path=str(folder))
