"""Chunks of an MCAP file, read in bounded memory: what one claims is compared with what it has.

A chunk unpacks to as many bytes as it likes: 33 kB may stand for 1 GiB.  So its claim is looked at
before a byte of it is unpacked, it is unpacked in pieces, and it is read twice: once to its end,
against its size, checksum and records, and then message by message.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterable, Iterator
from typing import BinaryIO, Final, NamedTuple, cast

import zstandard
from lz4.frame import LZ4FrameDecompressor  # type: ignore[import-untyped]
from mcap.opcode import Opcode

from enact_dist.errors import ProtocolError
from enact_dist.wire.limits import BODY_BYTES_MAX

CHUNK_BYTES_MAX: Final = BODY_BYTES_MAX + (32 << 20)
"""A chunk ends after the commit that fills it: one largest datum and what stands before it."""
RATIO_MAX: Final = 1_000
RATIO_FREE_BYTES: Final = 64 << 20
"""A chunk may unpack to this many bytes, or to so many times its packed size."""
CHANNELS_BYTES_MAX: Final = 64 << 20
"""All channels of a file together; there are 65,536 at most."""
CHANNEL_BYTES_MAX: Final = 64 << 10
"""Longest record of a channel: some names, and a type's fingerprint."""
PIECE_BYTES: Final = 1 << 20
IN_MEMORY_BYTES: Final = 16 << 20
"""Up to this size a chunk is unpacked once and stays in memory."""

_HEAD: Final = struct.Struct("<QQQII")
_LENGTH: Final = struct.Struct("<Q")
_RECORD_HEAD: Final = struct.Struct("<BQ")
_MESSAGE_HEAD: Final = struct.Struct("<HIQQ")
_COMPRESSION_CHARACTERS_MAX: Final = 8


class DamagedChunkError(Exception):
    """A chunk is not whole, or not what it says."""


class RawMessage(NamedTuple):
    """One message: its channel, log time and bytes, and where these begin in the unpacked chunk."""

    channel_id: int
    log_time: int
    data: bytes
    begin: int


class Chunk:
    """One chunk of a file, its place and its claims.

    Args:
        stream: The file, at the content of the chunk's record.
        length: Bytes of that content.
        where: What messages call the chunk.

    Attributes:
        at: Where that content begins in the file.
        size: Its bytes once it is unpacked.
        packed: Its bytes in the file.
        in_memory: Whether it is unpacked once and stays in memory; the file is not needed then.

    Raises:
        DamagedChunkError: It is no chunk.
        ProtocolError: It claims to unpack to more than this version reads.
    """

    def __init__(self, stream: BinaryIO, length: int, where: str) -> None:
        self._stream, self.at = stream, stream.tell()
        fixed = stream.read(_HEAD.size)
        if len(fixed) < _HEAD.size:
            raise DamagedChunkError("a chunk ends in its head")
        _, _, self.size, self._crc, characters = _HEAD.unpack(fixed)
        if characters > _COMPRESSION_CHARACTERS_MAX:
            raise DamagedChunkError("a chunk has a compression of no known name")
        self._compression = stream.read(characters)
        rest = stream.read(_LENGTH.size)
        if len(rest) < _LENGTH.size:
            raise DamagedChunkError("a chunk ends in its head")
        (self.packed,) = _LENGTH.unpack(rest)
        self._packed_at = stream.tell()
        if self.packed != length - _HEAD.size - characters - _LENGTH.size:
            raise DamagedChunkError("a chunk is not as long as its record")
        if self._compression not in (b"", b"zstd", b"lz4"):
            raise DamagedChunkError("a chunk has a compression of no known name")
        self._refuse_claim(where)
        self.in_memory = self.size <= IN_MEMORY_BYTES
        self._whole: bytes | None = None

    def _refuse_claim(self, where: str) -> None:
        by_ratio = max(RATIO_FREE_BYTES, RATIO_MAX * self.packed)
        if self.size <= min(CHUNK_BYTES_MAX, by_ratio):
            return
        raise ProtocolError(
            f"{where} claims to unpack from {self.packed} to {self.size} bytes; at most"
            f" {CHUNK_BYTES_MAX} are read, and beyond {RATIO_FREE_BYTES} at most {RATIO_MAX} times"
            " the packed size: enact record did not write this file, or its data are large and very"
            " uniform; record such data with --compress lz4"
        )

    def channels(self) -> Iterator[bytes]:
        """Read the chunk to its end, checked; yield the content of each channel's record.

        Raises:
            DamagedChunkError: It is not whole; what was yielded counts all the same.
        """
        checked = self._checked()
        if self.in_memory:
            self._whole = b"".join(checked)
            checked = iter((self._whole,))
        for opcode, length, parts in _records(_Pieces(checked)):
            if opcode != Opcode.CHANNEL:
                parts.skip(length)
            elif length > CHANNEL_BYTES_MAX:
                raise DamagedChunkError(f"a channel has a record of {length} bytes")
            else:
                yield parts.take(length)

    def messages(self, wanted: set[int]) -> Iterator[RawMessage]:
        """Yield the messages of these channels, each as it is unpacked; after `channels`."""
        begin = 0
        for opcode, length, parts in _records(self._pieces()):
            begin += _RECORD_HEAD.size + length
            if opcode != Opcode.MESSAGE:
                parts.skip(length)
                continue
            head = parts.take(min(length, _MESSAGE_HEAD.size))
            if len(head) < _MESSAGE_HEAD.size:
                raise DamagedChunkError("a message ends in its head")
            channel_id, _, log_time, _ = _MESSAGE_HEAD.unpack(head)
            rest = length - len(head)
            if channel_id in wanted:
                yield RawMessage(channel_id, log_time, parts.take(rest), begin - rest)
            else:
                parts.skip(rest)

    def parts(self, places: Iterable[tuple[int, int]]) -> Iterator[bytes]:
        """Yield parts of the unpacked chunk, each by its begin and its length; they ascend.

        Raises:
            DamagedChunkError: It is not whole, or not as long.
        """
        if self._whole is None and self.in_memory:
            self._whole = b"".join(self._checked())
        pieces, at = self._pieces(), 0
        for begin, length in places:
            pieces.skip(begin - at)
            yield pieces.take(length)
            at = begin + length

    def _pieces(self) -> _Pieces:
        return _Pieces(iter((self._whole,)) if self._whole is not None else self._unpacked())

    def _checked(self) -> Iterator[bytes]:
        """Yield the unpacked pieces; at the end they are as many and what the chunk says."""
        size = crc = 0
        for piece in self._unpacked():
            size, crc = size + len(piece), zlib.crc32(piece, crc)
            if size > self.size:
                break
            yield piece
        if size != self.size or (self._crc and crc != self._crc):
            raise DamagedChunkError("a chunk has another size or checksum than it says")

    def _unpacked(self) -> Iterator[bytes]:
        left = self.packed
        lz4 = LZ4FrameDecompressor()
        self._stream.seek(self._packed_at)
        if self._compression == b"zstd":
            packed = cast("BinaryIO", _Part(self._stream, left))
            with zstandard.ZstdDecompressor().stream_reader(packed, closefd=False) as reader:
                while piece := reader.read(PIECE_BYTES):
                    yield piece
            return
        while left:
            some = self._stream.read(min(left, PIECE_BYTES))
            left -= len(some)
            if not some:
                return
            if not self._compression:
                yield some
                continue
            if lz4.eof:
                return
            while piece := lz4.decompress(some, max_length=PIECE_BYTES):
                yield piece
                some = b""
                if lz4.needs_input or lz4.eof:
                    break


class _Part:
    """The next bytes of a file, as the decompressor reads them."""

    def __init__(self, stream: BinaryIO, length: int) -> None:
        self._stream, self._left = stream, length

    def read(self, length: int = -1) -> bytes:
        length = self._left if length < 0 else min(length, self._left)
        some = self._stream.read(length)
        self._left -= len(some)
        return some


class _Pieces:
    """Bytes that come in pieces, taken or skipped by their number."""

    def __init__(self, pieces: Iterator[bytes]) -> None:
        self._pieces = pieces
        self._piece = memoryview(b"")

    def _more(self) -> bool:
        """Whether there are further bytes."""
        while not self._piece:
            found = next(self._pieces, None)
            if found is None:
                return False
            self._piece = memoryview(found)
        return True

    def at_end(self) -> bool:
        return not self._more()

    def take(self, length: int) -> bytes:
        if length <= len(self._piece):
            taken = bytes(self._piece[:length])
            self._piece = self._piece[length:]
            return taken
        parts = bytearray()
        while len(parts) < length:
            parts += self._some(length - len(parts))
        return bytes(parts)

    def skip(self, length: int) -> None:
        while length:
            length -= len(self._some(length))

    def _some(self, length: int) -> memoryview:
        if not self._more():
            raise DamagedChunkError("a chunk ends in a record")
        some = self._piece[:length]
        self._piece = self._piece[length:]
        return some


def _records(parts: _Pieces) -> Iterator[tuple[int, int, _Pieces]]:
    """Yield the records: code, length, and the pieces, of which so much is to be taken."""
    while not parts.at_end():
        opcode, length = _RECORD_HEAD.unpack(parts.take(_RECORD_HEAD.size))
        yield opcode, length, parts
