"""Large bodies in a database: those of the next batch, and those read at the start."""

from __future__ import annotations

import zlib
from collections.abc import Iterable
from typing import Final, NamedTuple

from enact_dist.link.folder.blobs import Blob, DamagedBlobError, Mapped

PART_BYTES: Final = 1 << 20
"""Bodies are stored in parts of this size, which bounds what one row takes of memory."""


class NewBody(NamedTuple):
    """A body that goes with the next batch."""

    name: str
    parts: list[memoryview]


class BodiesToWrite:
    """Gathers the large bodies of a batch.  Not thread-safe.

    Args:
        epoch: The shard's epoch; makes the names unique.
    """

    def __init__(self, epoch: int) -> None:
        self._epoch = epoch
        self._count = 0
        self._new: list[NewBody] = []

    def write(self, body: bytes | memoryview, *, durable: bool) -> Blob:
        """Take a body; it is written in the transaction of its rows."""
        flat = memoryview(body).cast("B")
        parts = [flat[at : at + PART_BYTES] for at in range(0, len(flat), PART_BYTES)]
        crc = 0
        for part in parts:
            crc = zlib.crc32(part, crc)
        self._count += 1
        name = f"{self._epoch:x}-{self._count:x}"
        self._new.append(NewBody(name, parts))
        return Blob(name, len(flat), crc, synced=True)

    def force(self, blob: Blob) -> Blob:
        """Return the body as it is: the next durable commit forces all before it."""
        return blob._replace(synced=True)

    def sync_names(self) -> None:
        """Do nothing: names are in rows."""

    def take(self) -> list[NewBody]:
        """Return the bodies gathered since the last call."""
        new, self._new = self._new, []
        return new


class ReadBodies:
    """The bodies of a shard, as read."""

    def __init__(self, place: str, rows: Iterable[tuple[str, bytes]]) -> None:
        self._place = place
        self._parts: dict[str, list[bytes]] = {}
        for name, data in rows:
            self._parts.setdefault(name, []).append(data)

    def place(self, name: str) -> str:
        """Return where a body is, for people."""
        return f"{self._place}: body {name}"

    def map(self, blob: Blob, *, whole: bool) -> Mapped:
        """Return a body, checked; its parts are joined only now.

        Raises:
            DamagedBlobError: It is missing, of another length, or its checksum differs.
        """
        parts = self._parts.pop(blob.name, None)
        if parts is None:
            raise DamagedBlobError("it is missing")
        body = parts[0] if len(parts) == 1 else b"".join(parts)
        if len(body) != blob.size:
            raise DamagedBlobError(f"it has {len(body)} bytes instead of {blob.size}")
        if zlib.crc32(body) != blob.crc:
            raise DamagedBlobError("it is damaged: its checksum is wrong")
        return Mapped(memoryview(body), None)
