"""Large bodies as separate files beside the database that names them.

A database row holds the file's name, length and checksum; a file without a row is garbage, deleted
at the next start.  So the order is: write the whole file, commit the row, then unlink the row's
previous file.  Names are independent of the content and never reused (epoch and counter).

Errors of the system pass through as `OSError`.
"""

from __future__ import annotations

import os
import re
import zlib
from typing import TYPE_CHECKING, Final, NamedTuple

from enact_dist.link.folder.lock import file_mode, sync_folder
from enact_dist.link.memory.maps import body_of, map_file

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable
    from pathlib import Path

_SUFFIX: Final = ".blob"
_DRAFT_SUFFIX: Final = ".tmp"
_NAME: Final = re.compile(r"[0-9a-f]+-[0-9a-f]+(\.blob)?")
"""Names made here, and those that came from a database with the bodies."""
_PART_BYTES: Final = 1 << 20
"""Bodies are checksummed and written in parts of this size: the second touch hits the cache."""


class Blob(NamedTuple):
    """One file: its name, length in bytes and CRC-32, and whether it was forced to the disk."""

    name: str
    size: int
    crc: int
    synced: bool


class Mapped(NamedTuple):
    """A mapped file: its bytes, and its pending check.

    `fault` returns what is wrong with the content, "" if nothing; None: it was checked already.
    """

    body: memoryview
    fault: Callable[[], str] | None


class DamagedBlobError(Exception):
    """A blob file is missing or does not match its row; the message says which."""


class BlobFolder:
    """The blob files of one store.  Not thread-safe.

    Args:
        folder: Made if it does not exist.
        epoch: The shard's new epoch; makes the names of this run unique.
    """

    __slots__ = ("_count", "_epoch", "_mode", "folder")

    def __init__(self, folder: Path, *, epoch: int) -> None:
        self.folder = folder
        self._epoch = epoch
        self._count = 0
        self._mode = file_mode(folder)

    def write(self, body: bytes | memoryview, *, durable: bool) -> Blob:
        """Write a body to a new file; durable ones need `sync_names` before the row's commit.

        Raises:
            OSError: As the system reports it (disk full, I/O error); the draft is left behind.
        """
        flat = memoryview(body).cast("B")
        self._count += 1
        name = f"{self._epoch:x}-{self._count:x}{_SUFFIX}"
        draft = self.folder / (name + _DRAFT_SUFFIX)
        descriptor = os.open(draft, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, self._mode)
        try:
            crc = _write_all(descriptor, flat)
            if durable:
                os.fdatasync(descriptor)
        finally:
            os.close(descriptor)
        draft.rename(self.folder / name)
        return Blob(name, len(flat), crc, durable)

    def force(self, blob: Blob) -> Blob:
        """Force a file to the disk after it was written; its name needs `sync_names` too.

        The first caller that forces the file gets any error of its writeback.
        """
        descriptor = os.open(self.folder / blob.name, os.O_RDONLY | os.O_CLOEXEC)
        try:
            os.fdatasync(descriptor)
        finally:
            os.close(descriptor)
        return blob._replace(synced=True)

    def place(self, name: str) -> Path:
        """Return the path of a file."""
        return self.folder / name

    def sync_names(self) -> None:
        """Make the names of all files written so far durable."""
        sync_folder(self.folder)

    def unlink(self, name: str) -> None:
        """Unlink a file without a row; processes that have it mapped keep its content.

        Raises:
            OSError: As the system reports it; a missing file is no error.
        """
        (self.folder / name).unlink(missing_ok=True)

    def map(self, blob: Blob, *, whole: bool) -> Mapped:
        """Map an existing file of the length in its row; pages are loaded when touched.

        The bytes stay valid after the file is unlinked.  `whole` also checks the content, which
        reads all of it.

        Raises:
            DamagedBlobError: It is missing, of another length, or (`whole`) its checksum differs.
            OSError: As the system reports it (I/O error).
        """
        path = self.folder / blob.name
        try:
            descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
        except FileNotFoundError:
            raise DamagedBlobError(f"{path} is missing") from None
        try:
            found_bytes = os.fstat(descriptor).st_size
            if found_bytes != blob.size:
                raise DamagedBlobError(f"{path} has {found_bytes} bytes instead of {blob.size}")
            if whole and _crc_of(descriptor) != blob.crc:
                raise DamagedBlobError(_damaged(path))
            body = body_of(map_file(descriptor, blob.size, writable=False)).toreadonly()
        finally:
            os.close(descriptor)
        return Mapped(body, None if whole else _Check(path, body, blob.crc))

    def sweep(self, keep: Iterable[str]) -> int:
        """Delete blob files and drafts without a row; return how many there were."""
        kept = frozenset(keep)
        orphans = [name for name in self.names() if name not in kept]
        for name in orphans:
            self.unlink(name)
        return len(orphans)

    def names(self) -> list[str]:
        """Return the names of all blob files and drafts; other files are left alone."""
        return [
            path.name
            for path in self.folder.iterdir()
            if path.name.endswith((_SUFFIX, _DRAFT_SUFFIX)) or is_name(path.name)
        ]


def is_name(name: str) -> bool:
    """Whether a body of a store may have this name, in a folder or in a database."""
    return _NAME.fullmatch(name) is not None


def _write_all(descriptor: int, body: memoryview) -> int:
    """Write `body` whole; return its CRC-32."""
    crc = 0
    for begin in range(0, len(body), _PART_BYTES):
        part = body[begin : begin + _PART_BYTES]
        crc = zlib.crc32(part, crc)
        while part:
            part = part[os.write(descriptor, part) :]
    return crc


def _crc_of(descriptor: int) -> int:
    crc = 0
    part = bytearray(_PART_BYTES)
    while count := os.readv(descriptor, [part]):
        crc = zlib.crc32(memoryview(part)[:count], crc)
    return crc


class _Check:
    """Checks mapped bytes against their checksum on first use, and remembers the result."""

    __slots__ = ("_body", "_crc", "_fault", "_path")

    def __init__(self, path: Path, body: memoryview, crc: int) -> None:
        self._path, self._crc = path, crc
        self._body: memoryview | None = body
        self._fault = ""

    def __call__(self) -> str:
        body = self._body
        if body is not None:
            self._fault = self._looked(body)
            self._body = None
        return self._fault

    def _looked(self, body: memoryview) -> str:
        try:
            # Not through the map: there a disk error would kill the process.
            descriptor = os.open(self._path, os.O_RDONLY | os.O_CLOEXEC)
            try:
                crc = _crc_of(descriptor)
            finally:
                os.close(descriptor)
        except FileNotFoundError:
            crc = zlib.crc32(body)
        except OSError as failure:
            return f"{self._path} cannot be read: {failure.strerror}"
        return "" if crc == self._crc else _damaged(self._path)


def _damaged(path: Path) -> str:
    return f"{path} is damaged: its checksum is wrong"
