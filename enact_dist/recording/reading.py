"""A recording back from its file, chunk by chunk, as far as it is whole.

A recording that was cut off, by `kill -9` or a power cut, has no index and may end anywhere in a
record; one of a disk that lost power may end in zeros.  So the file is read from its begin, each
record against the file's length and each chunk against its checksum, and what follows the first
record that is not whole is counted as missing.
"""

from __future__ import annotations

import os
import struct
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import Channel, Chunk, Message, Metadata
from mcap.stream_reader import CRCValidationError, breakup_chunk

from enact_dist.errors import ConfigError, ProtocolError
from enact_dist.recording.exact import FORMAT, decode_recorded
from enact_dist.recording.file import BEGIN_RECORD, END_RECORD, EXACT_TOPIC

if TYPE_CHECKING:
    from collections.abc import Iterator
    from typing import BinaryIO

    from enact_dist.recording.exact import Recorded

MAGIC: Final = b"\x89MCAP0\r\n"
_RECORD_HEAD: Final = struct.Struct("<BQ")
_DAMAGES: Final = (
    McapError,
    CRCValidationError,
    struct.error,
    UnicodeDecodeError,
    RuntimeError,  # of lz4
    zstandard.ZstdError,
    MemoryError,
    OverflowError,
)
"""What the readers of records raise where bytes make no sense."""


class AspectFacts(NamedTuple):
    """What a recording knows of an aspect: its type's fingerprint and its durability."""

    fingerprint: str
    durability: str


class Commit(NamedTuple):
    """The data of one commit.

    Attributes:
        number: Its number in the recording; 0: what was there when the recording began.
        log_ns: The stamp under which it stands in the file.
        versions: What it has set, in the order of the file.
    """

    number: int
    log_ns: int
    versions: tuple[Recorded, ...]


class Recording:
    """A recording that is read.

    Args:
        path: The file.

    Attributes:
        facts: What its first metadata record says.
        end: What its last metadata record says; empty where it was cut off.
        aspects: What is known so far of its aspects; complete once all has been read.
        chunks: Whole chunks read so far.
        missing_bytes: What follows the last whole record, once all has been read.
        whole: Whether the file has its end, once all has been read.

    Raises:
        ConfigError: The file cannot be read, or is no recording of this project.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        self.facts: dict[str, str] = {}
        self.end: dict[str, str] = {}
        self.aspects: dict[str, AspectFacts] = {}
        self.chunks = self.missing_bytes = 0
        self.whole = False
        self._channels: dict[int, Channel] = {}
        for _ in self._records(until_begin=True):
            pass
        if not self.facts:
            raise ConfigError(f"{self.path} is an MCAP file, but no recording made by enact record")
        if self.facts.get("format") != str(FORMAT):
            raise ConfigError(
                f"{self.path} is a recording of format {self.facts.get('format')!r}; this one"
                f" reads {FORMAT}"
            )

    def commits(self) -> Iterator[Commit]:
        """Yield the commits in the order of the file, as far as it is whole.

        Raises:
            ProtocolError: A whole chunk holds what this version cannot read.
        """
        self.chunks = self.missing_bytes = 0
        for chunk in self._records():
            versions: list[Recorded] = []
            log_ns = 0
            for message in chunk:
                recorded = decode_recorded(message.data)
                begins = versions and recorded.commit != versions[-1].commit
                if begins:
                    yield Commit(versions[0].commit, log_ns, tuple(versions))
                    versions = []
                versions.append(recorded)
                log_ns = message.log_time
            if versions:
                yield Commit(versions[0].commit, log_ns, tuple(versions))

    def look_through(self) -> frozenset[str]:
        """Learn of all aspects in the file and return the world contexts that it has versions of.

        A recording that was ended whole has an index of them; another one is read through.
        """
        indexed = self._indexed()
        if indexed is None:
            for _ in self._records():
                pass
            indexed = list(self._channels.values())
        for channel in indexed:
            self._learn(channel)
        exact = (channel.metadata for channel in indexed if "exact" in channel.metadata)
        return frozenset(facts["world"] for facts in exact)

    def _indexed(self) -> list[Channel] | None:
        """Return the channels that the index of the file names, None where it has no index."""
        try:
            with self.path.open("rb") as stream:
                stream.seek(-len(MAGIC), os.SEEK_END)
                if stream.read() != MAGIC:
                    return None
                stream.seek(0)
                summary = SeekingReader(stream).get_summary()
        except (OSError, *_DAMAGES):
            return None
        return list(summary.channels.values()) if summary is not None else None

    def _records(self, *, until_begin: bool = False) -> Iterator[list[Message]]:
        """Yield the exact messages of each whole chunk; learn from what stands between."""
        try:
            with self.path.open("rb") as stream:
                yield from self._read(stream, until_begin=until_begin)
        except OSError as error:
            raise ConfigError(f"cannot read {self.path}: {error.strerror}") from error

    def _read(self, stream: BinaryIO, *, until_begin: bool) -> Iterator[list[Message]]:
        size = self.path.stat().st_size
        if stream.read(len(MAGIC)) != MAGIC:
            raise ConfigError(f"{self.path} is no MCAP file")
        good = len(MAGIC)
        self.whole = False
        while not self.whole:
            head = stream.read(_RECORD_HEAD.size)
            if len(head) < _RECORD_HEAD.size:
                break
            opcode, length = _RECORD_HEAD.unpack(head)
            if opcode == 0 or length > size - good - len(head):
                break
            content = stream.read(length) if opcode in _WANTED else b""
            if opcode not in _WANTED:
                stream.seek(length, 1)
            try:
                messages = self._take(opcode, content)
            except _DAMAGES:
                break
            good += len(head) + length
            if messages:
                yield messages
            self.whole = opcode == Opcode.DATA_END
            if until_begin and self.facts:
                return
        if not self.whole:
            self.missing_bytes = size - good

    def _take(self, opcode: int, content: bytes) -> list[Message]:
        """Take one record; return the exact messages in it, if it is a chunk."""
        stream = ReadDataStream(BytesIO(content))
        if opcode == Opcode.METADATA:
            record = Metadata.read(stream)
            if record.name == BEGIN_RECORD:
                self.facts = record.metadata
            elif record.name == END_RECORD:
                self.end = record.metadata
        elif opcode == Opcode.CHUNK:
            chunk = Chunk.read(stream)
            records = breakup_chunk(chunk, validate_crc=True)
            for each in records:
                if isinstance(each, Channel):
                    self._learn(each)
            self.chunks += 1
            exact = [each for each in records if isinstance(each, Message)]
            return [each for each in exact if self._is_exact(each)]
        return []

    def _learn(self, channel: Channel) -> None:
        self._channels[channel.id] = channel
        facts = channel.metadata
        if "exact" in facts and "type" in facts:
            self.aspects[facts["aspect"]] = AspectFacts(facts["type"], facts["durability"])

    def _is_exact(self, message: Message) -> bool:
        channel = self._channels.get(message.channel_id)
        if channel is None:
            raise ProtocolError(f"{self.path} has a message of no channel")
        return channel.topic.startswith(EXACT_TOPIC) and "exact" in channel.metadata


_WANTED: Final = (Opcode.METADATA, Opcode.CHUNK)
