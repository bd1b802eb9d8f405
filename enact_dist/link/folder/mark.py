"""The mark beside a store: the boot in which it was written, and the batches that it must hold.

The mark is written after each batch, in place and without forcing it to the disk.  So it never runs
ahead of the store; it may lag by the system's writeback time after a power cut, but not after `kill
-9`.  It answers two questions that the database cannot answer about itself:

- Is anything acknowledged missing at the end (a cut or deleted log, an older copy)?  In the same
  boot nothing may be missing; otherwise nothing that was forced to the disk.
- Can the system have gone down since?  Only then may unforced writes be missing in any order.

So a store whose mark is missing or damaged is refused: it may lack acknowledged data.
"""

from __future__ import annotations

import os
import struct
import uuid
import zlib
from pathlib import Path
from typing import Final, NamedTuple, Self

from enact_dist.link.folder.lock import file_mode

MARK_FILE: Final = "mark"
_LAYOUT: Final = struct.Struct("<8s16sQQ")
_UNKNOWN_BOOT: Final = bytes(16)
_MAGIC: Final = b"enactmrk"
_BOOT_ID: Final = Path("/proc/sys/kernel/random/boot_id")


class Mark(NamedTuple):
    """The content of a store's mark."""

    boot: bytes
    """Id of the boot in which the store was last opened, 16 bytes; zeros: unknown."""
    batch: int
    """Number of the newest batch known to be on the disk."""
    written: int
    """Number of the newest batch passed to the system; not lost unless the system went down."""

    @property
    def is_first(self) -> bool:
        """Whether nothing was acknowledged yet."""
        return self.written == 0

    @property
    def same_boot(self) -> bool:
        """Whether the system has not gone down since; an unknown boot counts as a new one."""
        return self.boot == boot_id() != _UNKNOWN_BOOT

    def needed(self) -> int:
        """Return the number of the batch that must be there now."""
        return self.written if self.same_boot else self.batch


def boot_id() -> bytes:
    """Return the id of this boot of the system, 16 bytes; zeros: unknown."""
    try:
        return uuid.UUID(_BOOT_ID.read_text(encoding="ascii").strip()).bytes
    except (OSError, ValueError):
        return _UNKNOWN_BOOT


def read_mark(folder: Path) -> Mark | None:
    """Return the mark of a folder, or None if there is no readable one.

    Raises:
        OSError: As the system reports it.
    """
    try:
        raw = (folder / MARK_FILE).read_bytes()
    except FileNotFoundError:
        return None
    if len(raw) != _LAYOUT.size + 4:
        return None
    magic, boot, batch, written = _LAYOUT.unpack_from(raw)
    if magic != _MAGIC or raw[_LAYOUT.size :] != _checksum(raw[: _LAYOUT.size]):
        return None
    return Mark(boot, batch, written)


def _checksum(packed: bytes) -> bytes:
    return zlib.crc32(packed).to_bytes(4, "little")


class MarkFile:
    """The mark of an open store.

    Raises:
        OSError: As the system reports it, in every method.
    """

    __slots__ = ("_batch", "_boot", "_descriptor")

    def __init__(self, descriptor: int, boot: bytes) -> None:
        self._descriptor = descriptor
        self._boot = boot
        self._batch = 0

    @classmethod
    def open(cls, folder: Path, batch: int) -> Self:
        """Record durably that this boot opened the store, and that `batch` is on the disk."""
        flags = os.O_RDWR | os.O_CREAT | os.O_CLOEXEC
        descriptor = os.open(folder / MARK_FILE, flags, file_mode(folder))
        mark = cls(descriptor, boot_id())
        try:
            mark.note(batch, forced=True)
            os.fsync(descriptor)
        except BaseException:
            mark.close()
            raise
        return mark

    def note(self, batch: int, *, forced: bool) -> None:
        """Record that the system has `batch`; with `forced` also that it is on the disk."""
        if forced:
            self._batch = batch
        packed = _LAYOUT.pack(_MAGIC, self._boot, self._batch, batch)
        os.pwrite(self._descriptor, packed + _checksum(packed), 0)

    def close(self) -> None:
        """Close the file; idempotent."""
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1
