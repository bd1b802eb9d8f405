"""The MCAP file of a recording, chunk by chunk, each on the disk before the next one is begun.

The data of one commit are never divided: a chunk ends after a commit, once it holds `chunk_bytes`
or its first message has waited for `chunk_s`.  So whatever cuts a recording off, what can be read
of it ends with a whole commit.
"""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import TYPE_CHECKING, Final

from google.protobuf.descriptor_pb2 import FileDescriptorSet
from mcap.writer import CompressionType, Writer

from enact_dist.errors import ConfigError
from enact_dist.recording.drawing.pictures import Picture, json_bytes, json_schema, pictures_of
from enact_dist.recording.exact import FORMAT, Recorded, encode_recorded

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from google.protobuf.descriptor import FileDescriptor
    from google.protobuf.message import Message

    from enact_dist.config.shows import Shows
    from enact_dist.core.protocol.messages import AspectEntry

CHUNK_BYTES: Final = 8 << 20
CHUNK_S: Final = 1.0
"""A chunk ends with this size or age: what a power cut may take."""
SHOWN_TOPICS_MAX: Final = 60_000
"""MCAP counts channels with 16 bits; what goes beyond is in the exact messages only."""
EXACT_TOPIC: Final = "/enact/"
GAPS_TOPIC: Final = "/enact/gaps"
BEGIN_RECORD: Final = "enact"
END_RECORD: Final = "enact.end"
COMPRESSIONS: Final = {
    "none": CompressionType.NONE,
    "lz4": CompressionType.LZ4,
    "zstd": CompressionType.ZSTD,
}
_UNDIVIDED: Final = 1 << 62
_LIBRARY: Final = "enact-dist"


class RecordingFile:
    """A recording that is being written.  One thread at a time may use it.

    Args:
        path: The file; it must not exist.
        facts: Content of the first metadata record besides the format.
        aspects: The catalogue entry of each aspect, written with its channel.
        shows: How to show the data of each aspect; None writes only exact messages.
        compression: "none", "lz4" or "zstd".
        chunk_bytes: Size from which a chunk ends.
        chunk_s: Age from which a chunk ends.

    Attributes:
        size: Bytes on the disk.
        chunks: Whole chunks on the disk.
        counts: What else happened, by name: ``unfit <aspect> <kind>`` (a datum that does not look
            as the cell says), ``not shown`` (topics beyond what MCAP can count).

    Raises:
        ConfigError: The file exists, or cannot be made.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        facts: Mapping[str, str],
        *,
        aspects: Callable[[str], AspectEntry | None],
        shows: Callable[[str], Shows] | None,
        compression: str = "zstd",
        chunk_bytes: int = CHUNK_BYTES,
        chunk_s: float = CHUNK_S,
    ) -> None:
        self.path = Path(path)
        self._aspects, self._shows = aspects, shows
        self._chunk_bytes, self._chunk_s = chunk_bytes, chunk_s
        self._schemas: dict[tuple[str, bytes], int] = {}
        self._channels: dict[str, int] = {}
        self._exact_facts: dict[str, dict[str, str]] = {}
        self._shown = 0
        self._held_bytes = 0
        self._held_since_s = 0.0
        self.size = self.chunks = 0
        self.counts: dict[str, int] = {}
        try:
            self._stream = self.path.open("xb")
        except OSError as error:
            raise ConfigError(f"cannot record into {path}: {error.strerror}") from error
        self._writer = Writer(
            self._stream,
            chunk_size=_UNDIVIDED,
            compression=COMPRESSIONS[compression],
        )
        self._writer.start(profile="", library=_LIBRARY)
        self._writer.add_metadata(BEGIN_RECORD, {"format": str(FORMAT), **facts})
        self._sync()
        _sync_folder(self.path.absolute().parent)

    # ---------------------------------------------------------------- content

    def add_commit(self, versions: Sequence[Recorded], log_ns: int) -> None:
        """Write the data of one commit.

        Raises:
            OSError: The disk refuses.
        """
        for recorded in versions:
            channel = self._exact_channel(recorded)
            self._add(channel, encode_recorded(recorded), recorded, log_ns)
            if self._shows is not None:
                self._add_pictures(recorded, self._shows(recorded.slot.aspect), log_ns)
        if self._held_bytes >= self._chunk_bytes:
            self.end_chunk()

    def add_gap(self, log_ns: int, facts: Mapping[str, object]) -> None:
        """Write down that versions are missing.

        Raises:
            OSError: The disk refuses.
        """
        data = json_bytes(dict(facts))
        if GAPS_TOPIC not in self._channels:
            schema = self._schema("enact.Gap", "jsonschema", json_bytes(json_schema(dict(facts))))
            self._channels[GAPS_TOPIC] = self._writer.register_channel(GAPS_TOPIC, "json", schema)
        self._hold(len(data))
        self._writer.add_message(self._channels[GAPS_TOPIC], log_ns, data, log_ns)

    def _add(self, channel: int, data: bytes, recorded: Recorded, log_ns: int) -> None:
        self._hold(len(data))
        published_ns = recorded.captured_ns or recorded.stamp_ns
        sequence = recorded.version & 0xFFFF_FFFF
        self._writer.add_message(channel, log_ns, data, published_ns, sequence)

    def _hold(self, length: int) -> None:
        if not self._held_bytes:
            self._held_since_s = time.monotonic()
        self._held_bytes += length

    def _add_pictures(self, recorded: Recorded, shows: Shows, log_ns: int) -> None:
        found = pictures_of(recorded, shows)
        for kind in found.unfit:
            self.count(f"unfit {recorded.slot.aspect} {kind}")
        for picture in found.pictures:
            message = picture.message
            data = json_bytes(message) if isinstance(message, dict) else message.SerializeToString()
            channel = self._shown_channel(recorded, picture)
            if channel is None:
                self.count("not shown")
            else:
                self._add(channel, data, recorded, log_ns)

    def count(self, name: str) -> None:
        """Count something that a reader of the summary should know."""
        self.counts[name] = self.counts.get(name, 0) + 1

    # ---------------------------------------------------------------- channels

    def _exact_channel(self, recorded: Recorded) -> int:
        context, _, aspect = recorded.slot
        topic = f"{EXACT_TOPIC}{context}/{aspect}"
        if topic not in self._channels:
            self._exact_facts[topic] = facts = self._facts_of(context, aspect)
            self._channels[topic] = self._writer.register_channel(topic, "msgpack", 0, facts)
        return self._channels[topic]

    def _facts_of(self, context: str, aspect: str) -> dict[str, str]:
        entry = self._aspects(aspect)
        facts = {"world": context, "aspect": aspect, "exact": str(FORMAT)}
        if entry is not None:
            facts |= {"type": entry.fingerprint, "durability": entry.durability}
        return facts

    def _note_newer_types(self) -> None:
        """Write an aspect's type again after a newer one has succeeded the first."""
        for topic, facts in self._exact_facts.items():
            now = self._facts_of(facts["world"], facts["aspect"])
            if now != facts:
                self._writer.register_channel(topic, "msgpack", 0, now)

    def _shown_channel(self, recorded: Recorded, picture: Picture) -> int | None:
        context, entity, aspect = recorded.slot
        topic = f"/{context}/{entity}/{aspect}{picture.suffix}"
        if topic in self._channels:
            return self._channels[topic]
        if self._shown >= SHOWN_TOPICS_MAX:
            return None
        self._shown += 1
        facts = {"world": context, "entity": entity, "aspect": aspect, "shard": recorded.shard}
        message = picture.message
        if isinstance(message, dict):
            encoding = "json"
            schema = self._schema("enact.Datum", "jsonschema", json_bytes(json_schema(message)))
        else:
            encoding = "protobuf"
            descriptor = message.DESCRIPTOR
            schema = self._schema(descriptor.full_name, "protobuf", _descriptors(message))
        self._channels[topic] = self._writer.register_channel(topic, encoding, schema, facts)
        return self._channels[topic]

    def _schema(self, name: str, encoding: str, data: bytes) -> int:
        if (name, data) not in self._schemas:
            self._schemas[name, data] = self._writer.register_schema(name, encoding, data)
        return self._schemas[name, data]

    # ---------------------------------------------------------------- chunks

    def chunk_left_s(self) -> float | None:
        """Return in how many seconds the open chunk is to end; None where it is empty."""
        if not self._held_bytes:
            return None
        return max(0.0, self._held_since_s + self._chunk_s - time.monotonic())

    def end_chunk(self) -> None:
        """Force the pending data to the disk as a complete chunk.

        Raises:
            OSError: The disk refuses.
        """
        if self._held_bytes:
            self._held_bytes = 0
            self._writer.flush()  # type: ignore[no-untyped-call]
            self._sync()
            self.chunks += 1

    def _sync(self) -> None:
        self._stream.flush()
        os.fdatasync(self._stream.fileno())
        self.size = self._stream.tell()

    def close(self, facts: Mapping[str, str]) -> None:
        """End the file with an index and a last metadata record; twice is harmless.

        Raises:
            OSError: The disk refuses; what it has is good up to its last whole chunk.
        """
        if self._stream.closed:
            return
        try:
            self._note_newer_types()
            self.end_chunk()
            self._writer.add_metadata(END_RECORD, dict(facts))
            self._writer.finish()  # type: ignore[no-untyped-call]
            self._sync()
        finally:
            self._stream.close()

    def abandon(self) -> None:
        """Leave the file without its end; raises nothing if the disk fails."""
        try:
            self._stream.raw.close()
        except OSError:
            self.count("not closed")


def _descriptors(message: Message) -> bytes:
    """Return the protobuf schema of a message: its file and all that this one imports."""
    found: dict[str, FileDescriptor] = {}

    def add(file: FileDescriptor) -> None:
        for needed in file.dependencies:
            add(needed)
        found.setdefault(file.name, file)

    add(message.DESCRIPTOR.file)
    described = FileDescriptorSet()
    for file in found.values():
        file.CopyToProto(described.file.add())
    return bytes(described.SerializeToString())


def _sync_folder(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
