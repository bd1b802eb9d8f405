"""What a backup has of each of its files, so that a restore can tell one byte that differs.

``backup.json`` has the size and the SHA-256 of every other file, and ends with the SHA-256 of its
own text before.  A store finds its own damage where it decides something; a backup has lain on
other disks and gone over networks for a year, and is read once.
"""

from __future__ import annotations

import hashlib
import json
import re
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from enact_dist.errors import StoreError
from enact_dist.link.folder_lock import FORMAT_FILE
from enact_dist.link.store_folder import BLOB_FOLDER, DATABASE_FILE, LOG_FILE
from enact_dist.link.store_mark import MARK_FILE

if TYPE_CHECKING:
    from pathlib import Path

BACKUP_FILE: Final = "backup.json"
FILES: Final = "files"
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
    names = [name for name in sorted(_PLAIN) if (folder / name).exists()]
    names += sorted(f"{BLOB_FOLDER}/{path.name}" for path in (folder / BLOB_FOLDER).iterdir())
    return {name: digest_of(folder / name) for name in names}


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
