"""A recording back from its file, chunk by chunk, as far as it is whole.

A recording that was cut off, by `kill -9` or a power cut, has no index and may end anywhere in a
record; one of a disk that lost power may end in zeros.  So the file is read from its begin, each
record against the file's length and each chunk against its checksum (`chunks`), and what follows
the first record that is not whole is counted as missing.  A recording may come from anywhere: what
it claims takes no memory, and its names are checked before they are shown.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Iterable, Iterator
from io import BytesIO
from itertools import groupby
from operator import attrgetter
from pathlib import Path
from typing import BinaryIO, Final, NamedTuple

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Metadata

from enact_dist.errors import ConfigError, ProtocolError
from enact_dist.recording.chunks import (
    CHANNEL_BYTES_MAX,
    CHANNELS_BYTES_MAX,
    Chunk,
    DamagedChunkError,
)
from enact_dist.recording.exact import FORMATS, Recorded, decode_recorded
from enact_dist.recording.file import BEGIN_RECORD, END_RECORD, EXACT_TOPIC
from enact_dist.terms import checked_name

MAGIC: Final = b"\x89MCAP0\r\n"
METADATA_BYTES_MAX: Final = 16 << 20
_RECORD_HEAD: Final = struct.Struct("<BQ")
_DAMAGES: Final = (
    DamagedChunkError,
    McapError,
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


class MessagePlace(NamedTuple):
    """Where a version lies in a recording.

    Attributes:
        chunk: Where the content of its chunk's record begins in the file.
        begin: Where its message begins in the unpacked chunk.
        length: Bytes of its message.
    """

    chunk: int
    begin: int
    length: int


class RecordedCommit(NamedTuple):
    """The data of one commit.

    Attributes:
        number: Its number in the recording; 0: what was there when the recording began.
        log_ns: Its log time in the file.
        versions: Its versions, in the order of the file.
        places: Where each of them lies; empty of a commit that is not as it is in the file.
    """

    number: int
    log_ns: int
    versions: tuple[Recorded, ...]
    places: tuple[MessagePlace, ...] = ()


class Recording:
    """A recording that is read.  Used by one thread at a time.

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
        self._exact: set[int] = set()
        self._channels_bytes = 0
        self._kept: Chunk | None = None
        for _ in self._chunks(until_begin=True):
            pass
        if not self.facts:
            raise ConfigError(f"{self.path} is an MCAP file, but no recording made by enact record")
        if self.facts.get("format") not in [str(each) for each in FORMATS]:
            raise ConfigError(
                f"{self.path} is a recording of format {self.facts.get('format')!r}; this one"
                f" reads {' and '.join(map(str, FORMATS))}"
            )

    def commits(self) -> Iterator[RecordedCommit]:
        """Yield the commits in the order of the file, as far as it is whole.

        Raises:
            ProtocolError: A whole chunk holds what this version cannot read, or does not read.
        """
        self.chunks = self.missing_bytes = 0
        for chunk in self._chunks():
            versions: list[Recorded] = []
            places: list[MessagePlace] = []
            log_ns = 0
            for message in chunk.messages(self._exact):
                recorded = self._checked(decode_recorded(message.data))
                begins = versions and recorded.commit != versions[-1].commit
                if begins:
                    yield RecordedCommit(versions[0].commit, log_ns, tuple(versions), tuple(places))
                    versions, places = [], []
                versions.append(recorded)
                places.append(MessagePlace(chunk.at, message.begin, len(message.data)))
                log_ns = message.log_time
            if versions:
                yield RecordedCommit(versions[0].commit, log_ns, tuple(versions), tuple(places))

    def versions_at(self, places: Iterable[MessagePlace]) -> Iterator[Recorded]:
        """Yield the versions at some places that `commits` told, in the order of the file.

        The chunk that was read last stays in memory, unless it is large.

        Raises:
            ConfigError: The file cannot be read any more.
            ProtocolError: It has been changed.
        """
        try:
            with self.path.open("rb") as stream:
                for at, group in groupby(sorted(places), key=attrgetter("chunk")):
                    chunk = self._chunk_at(stream, at)
                    for data in chunk.parts((place.begin, place.length) for place in group):
                        yield self._checked(decode_recorded(data))
        except OSError as error:
            raise ConfigError(f"cannot read {self.path}: {error.strerror}") from error
        except _DAMAGES as error:
            raise ProtocolError(f"{self.path} is not what it was before: {error}") from error

    def _chunk_at(self, stream: BinaryIO, at: int) -> Chunk:
        if self._kept is not None and self._kept.at == at:
            return self._kept
        self._kept = None  # two of them are never in memory at once
        stream.seek(at - _RECORD_HEAD.size)
        _, length = _RECORD_HEAD.unpack(stream.read(_RECORD_HEAD.size))
        chunk = self._chunk(stream, length)
        if chunk.in_memory:
            self._kept = chunk
        return chunk

    def _chunk(self, stream: BinaryIO, length: int) -> Chunk:
        return Chunk(stream, length, f"the chunk at byte {stream.tell()} of {self.path}")

    def _checked(self, recorded: Recorded) -> Recorded:
        """Return a version whose names no shard, log or terminal has to fear.

        Raises:
            ProtocolError: One of them can be no name.
        """
        for context, entity, aspect in (recorded.slot, *(one.slot for one in recorded.reads)):
            self._check_names(context, aspect, entity)
        return recorded

    def _check_names(self, context: str, aspect: str, entity: str = "e") -> None:
        try:
            checked_name("world context", context, slashes=False)
            checked_name("entity", entity, slashes=True)
            checked_name("aspect", aspect, slashes=False)
        except ValueError as error:
            raise ProtocolError(f"{self.path}: {error}") from None

    def look_through(self) -> frozenset[str]:
        """Learn of all aspects in the file and return the world contexts that it has versions of.

        A recording that was ended whole has an index of them; another one is read through.
        """
        indexed = self._indexed()
        if indexed is None:
            for _ in self._chunks():
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
                return list(_summary_channels(stream))
        except (OSError, *_DAMAGES):
            return None

    def _chunks(self, *, until_begin: bool = False) -> Iterator[Chunk]:
        """Yield each whole chunk; learn from what stands between, and of its channels."""
        try:
            with self.path.open("rb") as stream:
                yield from self._read(stream, until_begin=until_begin)
        except OSError as error:
            raise ConfigError(f"cannot read {self.path}: {error.strerror}") from error

    def _read(self, stream: BinaryIO, *, until_begin: bool) -> Iterator[Chunk]:
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
            try:
                chunk = self._take(opcode, stream, length)
            except _DAMAGES:
                break
            if chunk is not None:
                self.chunks += 1
                yield chunk
            good += len(head) + length
            stream.seek(good)
            self.whole = opcode == Opcode.DATA_END
            if until_begin and self.facts:
                return
        if not self.whole:
            self.missing_bytes = size - good

    def _take(self, opcode: int, stream: BinaryIO, length: int) -> Chunk | None:
        """Take one record; return it, if it is a chunk with anything in it."""
        if opcode == Opcode.METADATA:
            if length > METADATA_BYTES_MAX:
                raise DamagedChunkError(f"a metadata record of {length} bytes")
            record = Metadata.read(ReadDataStream(BytesIO(stream.read(length))))
            if record.name == BEGIN_RECORD:
                self.facts = record.metadata
            elif record.name == END_RECORD:
                self.end = record.metadata
        elif opcode == Opcode.CHUNK:
            chunk = self._chunk(stream, length)
            for content in chunk.channels():
                channel = Channel.read(ReadDataStream(BytesIO(content)))
                if channel.id not in self._channels:
                    self._channels_bytes += len(content)
                if self._channels_bytes > CHANNELS_BYTES_MAX:
                    raise ProtocolError(
                        f"{self.path} has channels of more than {CHANNELS_BYTES_MAX} bytes"
                    )
                self._learn(channel)
            return chunk
        return None

    def _learn(self, channel: Channel) -> None:
        self._channels[channel.id] = channel
        self._exact.discard(channel.id)
        facts = channel.metadata
        if not channel.topic.startswith(EXACT_TOPIC) or "exact" not in facts:
            return
        self._exact.add(channel.id)
        if not {"world", "aspect"} <= facts.keys():
            raise ProtocolError(f"{self.path} has a channel of no world context or aspect")
        self._check_names(facts["world"], facts["aspect"])
        if not facts.get("type", "").isprintable():
            raise ProtocolError(f"{self.path} has an aspect of the type {facts['type']!r:.80}")
        if "type" in facts:
            durability = facts.get("durability", "")
            self.aspects[facts["aspect"]] = AspectFacts(facts["type"], durability)


def _summary_channels(stream: BinaryIO) -> Iterator[Channel]:
    """Yield the channels that the index at the end of a file names.

    Raises:
        DamagedChunkError: The file has no end, or no index.
    """
    end = stream.seek(0, os.SEEK_END) - len(MAGIC) - _FOOTER.size - _RECORD_HEAD.size
    stream.seek(max(0, end))
    opcode, _ = _RECORD_HEAD.unpack(stream.read(_RECORD_HEAD.size))
    at, _, _ = _FOOTER.unpack(stream.read(_FOOTER.size))
    if opcode != Opcode.FOOTER or not at or stream.read() != MAGIC:
        raise DamagedChunkError("the file has no index")
    left = CHANNELS_BYTES_MAX
    while at < end and left > 0:
        stream.seek(at)
        opcode, length = _RECORD_HEAD.unpack(stream.read(_RECORD_HEAD.size))
        if opcode == Opcode.CHANNEL:
            if length > CHANNEL_BYTES_MAX:
                raise DamagedChunkError(f"a channel has a record of {length} bytes")
            left -= length
            yield Channel.read(ReadDataStream(BytesIO(stream.read(length))))
        at += _RECORD_HEAD.size + length


_FOOTER: Final = struct.Struct("<QQI")
