"""What a backup has of each of its files, so that a restore can tell one byte that differs.

``backup.json`` has the size and the SHA-256 of every other file, and ends with the SHA-256 of its
own text before.  A store finds its own damage where it decides something; a backup has lain on
other disks and gone over networks for a year, and is read once.  The text has also who may read the
shard's files, since the copies are for nobody but their owner.
"""

from __future__ import annotations

import hashlib
import json
import re
import stat
from contextlib import suppress
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from enact_dist.errors import StoreError
from enact_dist.link.folder_lock import FORMAT_FILE
from enact_dist.link.store_folder import BLOB_FOLDER, DATABASE_FILE, LOG_FILE
from enact_dist.link.store_mark import MARK_FILE

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

BACKUP_FILE: Final = "backup.json"
FILES: Final = "files"
MODES: Final = "modes"
HERE: Final = "."
MODE_MAX: Final = 0o7777
_SEAL: Final = re.compile(rb'(?s)(.*), "sha256": "([0-9a-f]{64})"\}')
_PLAIN: Final = frozenset((FORMAT_FILE, MARK_FILE, DATABASE_FILE, LOG_FILE))
_COPY_AGAIN: Final = "copy the backup again from where it is whole, or take another one"


class Digest(NamedTuple):
    """How many bytes a file has, and which, as far as a SHA-256 tells."""

    size: int
    sha256: str

    def __str__(self) -> str:
        """Return both, for people."""
        return f"{self.size} bytes with SHA-256 {self.sha256}"


def digest_of(path: Path) -> Digest:
    """Return the digest of a file.

    Raises:
        OSError: As the system reports it.
    """
    with path.open("rb") as file:
        sha256 = hashlib.file_digest(file, "sha256").hexdigest()
        return Digest(file.tell(), sha256)


def digests_of(folder: Path) -> dict[str, Digest]:
    """Return the digests of the files of a backup, by their path in it.

    Raises:
        OSError: As the system reports it.
    """
    return {name: digest_of(folder / name) for name in files_of(folder)}


def files_of(folder: Path) -> list[str]:
    """Return the files of a backup, by their path in it, but for what it says of itself.

    Raises:
        OSError: As the system reports it.
    """
    names = [name for name in sorted(_PLAIN) if (folder / name).exists()]
    names += sorted(f"{BLOB_FOLDER}/{path.name}" for path in (folder / BLOB_FOLDER).iterdir())
    return names


# ---------------------------------------------------------------- who may read them


def modes_of(folder: Path, names: Iterable[str]) -> dict[str, str]:
    """Return the permissions of a folder and of what is named in it, in octal digits.

    Raises:
        OSError: As the system reports it; what is not there has none.
    """
    modes: dict[str, str] = {}
    for name in (HERE, *names):
        with suppress(FileNotFoundError):
            modes[name] = mode_of(folder / name)
    return modes


def mode_of(path: Path) -> str:
    """Return the permissions of a file or folder, in octal digits.

    Raises:
        OSError: As the system reports it.
    """
    return f"{stat.S_IMODE(path.stat().st_mode):o}"


def set_modes(folder: Path, modes: dict[str, str]) -> None:
    """Let who is named there, and nobody else, read and write; the owner may in any case.

    Raises:
        OSError: As the system reports it.
    """
    for name, mode in reversed(modes.items()):  # the folder itself last
        path = folder / name
        with suppress(FileNotFoundError):
            owner = stat.S_IRWXU if path.is_dir() else stat.S_IRUSR | stat.S_IWUSR
            path.chmod(int(mode, 8) | owner)


def check_modes(modes: dict[str, str], files: Iterable[str]) -> dict[str, str]:
    """Return permissions of a backup.

    Raises:
        ValueError: They are none, or of something that it does not have.
        AttributeError: As `ValueError`.
        TypeError: As `ValueError`.
    """
    if modes.keys() - {HERE, BLOB_FOLDER, *files}:
        raise ValueError("it has permissions of what it does not have")
    if any(not 0 <= int(mode, 8) <= MODE_MAX for mode in modes.values()):
        raise ValueError("its permissions are none")
    return modes


# ---------------------------------------------------------------- backup.json


def sealed(told: dict[str, Any], files: dict[str, Digest]) -> bytes:
    """Return the text of `BACKUP_FILE`: what a backup says of itself, its files, its digest."""
    text = json.dumps({**told, FILES: files}).removesuffix("}").encode()
    return text + f', "sha256": "{hashlib.sha256(text).hexdigest()}"}}'.encode()


def read_sealed(path: Path) -> tuple[dict[str, Any], dict[str, Digest] | None]:
    """Return what a backup says of itself, and its files; None: it was made before it had digests.

    Raises:
        StoreError: There is no such text, or it is not what it was.
    """
    file = path / BACKUP_FILE
    try:
        text = file.read_bytes()
        seal = _SEAL.fullmatch(text)
        if seal is not None and (found := hashlib.sha256(seal[1]).hexdigest()) != seal[2].decode():
            raise StoreError(
                f"{file} is not what it was when the backup was made: its text has SHA-256 {found},"
                f" and says {seal[2].decode()} of itself; {_COPY_AGAIN}",
                path=str(file),
            )
        told = json.loads(text)
        if seal is None:
            return dict(told), None
        del told["sha256"]
        return told, {name: _listed(name, *digest) for name, digest in told.pop(FILES).items()}
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
        StoreError: One is missing, or is not what it was.
        OSError: One cannot be read.
    """
    wrong: list[str] = []
    for name, expected in files.items():
        try:
            found = digest_of(folder / name)
        except FileNotFoundError:
            wrong.append(f"{folder / name} is missing, expected are {expected}")
        else:
            if found != expected:
                wrong.append(f"{folder / name} has {found}, expected are {expected}")
    if wrong:
        more = f" (and {len(wrong) - 1} more files)" if wrong[1:] else ""
        raise StoreError(f"{wrong[0]}{more}; {_COPY_AGAIN}", path=str(folder))
