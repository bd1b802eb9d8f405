"""Large bodies as files of their own, beside the database that names them.

A database row names the file, its length and its checksum; a file that no row names is rubbish and
is swept at the next start.  So the order is: write the file whole, then commit the row, then
unlink the file that the row named before.  Names tell nothing about the content and are never
used twice (epoch and counter).
"""

from __future__ import annotations

import mmap
import os
import resource
import zlib
from typing import TYPE_CHECKING, Final, NamedTuple

from enact_dist.errors import StoreError
from enact_dist.link.folder_lock import sync_folder

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

_SUFFIX: Final = ".blob"
_DRAFT_SUFFIX: Final = ".tmp"
_PART_BYTES: Final = 1 << 20
"""Bodies are checksummed and written in parts of this size: the second touch hits the cache."""
_SPARE_DESCRIPTORS: Final = 256
"""File descriptors left to the rest of the process beside the mapped blobs."""


class Blob(NamedTuple):
    """One file: its name, length in bytes and CRC-32, and whether it was forced to the disk."""

    name: str
    size: int
    crc: int
    synced: bool


class DamagedBlobError(Exception):
    """A blob file is missing, or is not what its row says; the message says which."""


class BlobFolder:
    """The blob files of one store.  Not thread-safe.

    Args:
        folder: Made if it does not exist.
        epoch: The shard's new epoch; makes the names of this run unique.
    """

    __slots__ = ("_count", "_epoch", "folder")

    def __init__(self, folder: Path, *, epoch: int) -> None:
        self.folder = folder
        self._epoch = epoch
        self._count = 0

    def write(self, body: bytes | memoryview, *, durable: bool) -> Blob:
        """Write a body to a new file; durable ones need `sync_names` before the row's commit.

        Raises:
            OSError: As the system reports it (disk full, I/O error); the draft is left behind.
        """
        flat = memoryview(body).cast("B")
        self._count += 1
        name = f"{self._epoch:x}-{self._count:x}{_SUFFIX}"
        draft = self.folder / (name + _DRAFT_SUFFIX)
        descriptor = os.open(draft, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
        try:
            crc = _write_all(descriptor, flat)
            if durable:
                os.fdatasync(descriptor)
        finally:
            os.close(descriptor)
        draft.rename(self.folder / name)
        return Blob(name, len(flat), crc, durable)

    def sync_names(self) -> None:
        """Make the names of all files written so far durable.

        Raises:
            OSError: As the system reports it.
        """
        sync_folder(self.folder)

    def unlink(self, name: str) -> None:
        """Remove a file that no row names any more; whoever has it mapped keeps its content.

        Raises:
            OSError: As the system reports it, unless the file is gone already.
        """
        (self.folder / name).unlink(missing_ok=True)

    def read(self, blob: Blob) -> memoryview:
        """Check a file against its row and map it; pages are loaded when they are touched.

        Raises:
            DamagedBlobError: It is missing, of another length, or its checksum differs.
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
                raise DamagedBlobError(f"{path} has {found_bytes} bytes, stored were {blob.size}")
            if _crc_of(descriptor) != blob.crc:
                raise DamagedBlobError(f"{path} is damaged: its checksum is wrong")
            return memoryview(mmap.mmap(descriptor, blob.size, access=mmap.ACCESS_READ))
        finally:
            os.close(descriptor)

    def sweep(self, keep: Iterable[str]) -> int:
        """Remove blob files and drafts that no row names; return how many there were.

        Raises:
            OSError: As the system reports it.
        """
        kept = frozenset(keep)
        orphans = [name for name in self.names() if name not in kept]
        for name in orphans:
            self.unlink(name)
        return len(orphans)

    def names(self) -> list[str]:
        """Return the names of all blob files and drafts; other files are not ours.

        Raises:
            OSError: As the system reports it.
        """
        return [
            path.name
            for path in self.folder.iterdir()
            if path.name.endswith((_SUFFIX, _DRAFT_SUFFIX))
        ]


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


def allow_mapped(count: int) -> None:
    """Raise this process's limit of open files so that `count` blobs can be mapped.

    A mapping keeps a descriptor for as long as somebody has the body.

    Raises:
        StoreError: The system does not allow so many.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    needed = count + _SPARE_DESCRIPTORS
    if soft == resource.RLIM_INFINITY or soft >= needed:
        return
    if hard != resource.RLIM_INFINITY and hard < needed:
        raise StoreError(
            f"{count} large data are stored, each needs an open file, and the system allows"
            f" {hard}: raise the limit (ulimit -Hn, or LimitNOFILE in the service unit) to {needed}"
        )
    resource.setrlimit(resource.RLIMIT_NOFILE, (needed, hard))
