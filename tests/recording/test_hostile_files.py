"""Recordings that somebody has made to do harm: refused by name, in little memory, nothing made."""

import json
import struct
import subprocess
import sys
import zlib

import lz4.frame
import numpy as np
import pytest
import zstandard
from mcap.opcode import Opcode
from mcap.writer import CompressionType, Writer
from recording_samples import BEGIN_NS, datum, file, recorded

from enact_dist.core.protocol.datum import Slot
from enact_dist.errors import ConfigError, ProtocolError
from enact_dist.recording import Replay
from enact_dist.recording.exact import encode_recorded
from enact_dist.recording.file import BEGIN_RECORD, EXACT_TOPIC
from enact_dist.recording.reading import MAGIC, Recording

MEMORY_BYTES_MAX = 300 << 20
EXACT = {"world": "online", "aspect": "value", "exact": "1", "type": "int", "durability": "os"}


def record(opcode, content):
    return struct.pack("<BQ", opcode, len(content)) + content


def text(some):
    return struct.pack("<I", len(some)) + some.encode()


def pairs(facts):
    inside = b"".join(text(key) + text(value) for key, value in facts.items())
    return struct.pack("<I", len(inside)) + inside


def begin():
    facts = {"format": "1", "cell": "cell", "worlds": "online", "begin_ns": "1"}
    return MAGIC + record(Opcode.METADATA, text(BEGIN_RECORD) + pairs(facts))


def channel(number, topic, facts):
    head = struct.pack("<HH", number, 0)
    return record(Opcode.CHANNEL, head + text(topic) + text("msgpack") + pairs(facts))


def message(number, data):
    return record(Opcode.MESSAGE, struct.pack("<HIQQ", number, 0, BEGIN_NS, BEGIN_NS) + data)


def chunk(packed, size, *, compression="zstd", crc=0, length=None):
    head = struct.pack("<QQQI", 0, 1, size, crc) + text(compression)
    length = len(packed) if length is None else length
    return record(Opcode.CHUNK, head + struct.pack("<Q", length) + packed)


def packed(content):
    return chunk(zstandard.compress(content), len(content), crc=zlib.crc32(content))


def zeros(size):
    """Pack a chunk that is one message of so many zeros, without having them."""
    head = struct.pack("<BQ", Opcode.MESSAGE, size + 22) + struct.pack("<HIQQ", 7, 0, 1, 1)
    made = zstandard.ZstdCompressor().compressobj(size=len(head) + size)
    some = bytes(1 << 20)
    parts = [made.compress(head), *(made.compress(some) for _ in range(size >> 20)), made.flush()]
    return chunk(b"".join(parts), len(head) + size)


def write(path, *parts):
    path.write_bytes(b"".join((begin(), *parts)))
    return path


READ = """
import json, re, sys
from pathlib import Path
from enact_dist.recording.reading import Recording
told = []
for path in sys.argv[1:]:
    try:
        recording = Recording(path)
        recording.look_through()
        versions = sum(len(commit.versions) for commit in recording.commits())
        told.append([versions, recording.missing_bytes, ""])
    except Exception as error:
        told.append([0, 0, f"{type(error).__name__}: {error}"])
# Not getrusage: what that says begins with the memory of whoever has started this process.
(most_kib,) = re.findall(r"VmHWM:\\s+([0-9]+) kB", Path("/proc/self/status").read_text())
print(json.dumps([told, int(most_kib) << 10]))
"""


def read_apart(*paths):
    """Read files in a process of its own; return what came of each, and its memory in bytes."""
    done = subprocess.run(
        [sys.executable, "-c", READ, *map(str, paths)],
        capture_output=True, text=True, check=True, timeout=120,
    )  # fmt: skip
    return json.loads(done.stdout)


def test_what_a_file_claims_takes_no_memory(tmp_path):
    """1 GiB in 33 kB, sizes without end, a chunk longer than the file, and 70,000 channels."""
    gigabyte = write(tmp_path / "gigabyte.mcap", zeros(1 << 30))
    assert gigabyte.stat().st_size < 150_000
    many = b"".join(channel(n % 65_536, f"/{n}", {"world": "x"}) for n in range(70_000))
    wide = [channel(n, f"/{n}", {"world": "x" * 60_000}) for n in range(1_300)]
    whole = packed(channel(1, f"{EXACT_TOPIC}online/value", EXACT))
    found, memory = read_apart(
        gigabyte,
        write(tmp_path / "endless.mcap", chunk(b"", (1 << 64) - 1)),
        write(tmp_path / "stored.mcap", chunk(bytes(9), 1 << 33, compression="")),
        write(tmp_path / "beyond.mcap", struct.pack("<BQ", Opcode.CHUNK, 1 << 40)),
        write(tmp_path / "inside.mcap", chunk(bytes(99), 99, length=1 << 40)),
        write(tmp_path / "metadata.mcap", struct.pack("<BQ", Opcode.METADATA, 1 << 40)),
        write(tmp_path / "free.mcap", whole, zeros(60 << 20)),
        write(tmp_path / "many.mcap", packed(many)),
        write(tmp_path / "wide.mcap", packed(b"".join(wide[:650])), packed(b"".join(wide[650:]))),
    )
    errors = [error for _, _, error in found]
    for error in errors[:3]:
        assert error.startswith("ProtocolError")
        assert "claims to unpack" in error
        assert "--compress lz4" in error
    assert errors[3:8] == [""] * 5
    assert all(missing for _, missing, _ in found[3:6]), "they are damage, which is counted"
    assert "channels of more than" in errors[8]
    assert memory < MEMORY_BYTES_MAX


@pytest.mark.parametrize(
    "slot",
    [
        Slot("../online", "piece", "value"),
        Slot("online", "../../piece", "value"),
        Slot("online", "/etc/passwd", "value"),
        Slot("online", "piece\x1b[2J", "value"),
        Slot("online", "piece", "value\n2026-11-23 CRITICAL all is lost"),
        Slot("online", "x" * 201, "value"),
    ],
)
def test_name_that_is_none_is_refused_without_being_written_anywhere(cell, tmp_path, slot):
    """In no path, no log and no terminal: the error quotes it."""
    data = encode_recorded(recorded(slot, 1))
    topic = channel(1, f"{EXACT_TOPIC}online/value", EXACT)
    path = write(tmp_path / "run.mcap", packed(topic + message(1, data)))

    with pytest.raises(ProtocolError, match=r"cannot name|characters") as refused:
        Replay(cell, path, speed=0.0).run()

    assert str(refused.value).isprintable()
    assert not any(world.list_slots() for world in map(cell.world, cell.worlds()))


@pytest.mark.parametrize(
    "facts",
    [
        {"exact": "1"},
        {"exact": "1", "world": "x"},
        EXACT | {"aspect": "\x1b]0;title\x07"},
        EXACT | {"world": "a\nb"},
        EXACT | {"type": "int\x1b[2J"},
    ],
)
def test_channel_that_does_not_say_what_it_has_is_refused(tmp_path, facts):
    """No traceback of a key that is missing, and nothing for a terminal to obey."""
    path = write(tmp_path / "run.mcap", packed(channel(1, f"{EXACT_TOPIC}x/y", facts)))

    with pytest.raises(ProtocolError) as refused:
        Recording(path).look_through()

    assert str(refused.value).isprintable()


def test_file_of_others_is_no_recording(tmp_path):
    """Whatever schemas and messages it has."""
    with (tmp_path / "others.mcap").open("wb") as stream:
        writer = Writer(stream, compression=CompressionType.NONE)
        writer.start()
        schema = writer.register_schema("sensor_msgs/Image", "ros2msg", b"uint32 height")
        image = writer.register_channel("/camera", "cdr", schema)
        writer.add_message(image, 1, b"\x00\x01", 1)
        writer.finish()

    with pytest.raises(ConfigError, match="no recording made by enact record"):
        Recording(tmp_path / "others.mcap")


def test_messages_of_others_in_a_recording_are_left_alone(tmp_path):
    """Their schemas and channels are skipped."""
    ours = channel(1, f"{EXACT_TOPIC}online/value", EXACT)
    others = record(Opcode.SCHEMA, struct.pack("<H", 1) + text("x") + text("y") + bytes(4))
    others += channel(2, "/camera", {}) + message(2, b"\xff" * 50) + message(9, b"\xfe")
    own = message(1, encode_recorded(recorded("piece", 1)))
    path = write(tmp_path / "run.mcap", packed(ours + others + own))

    (commit,) = Recording(path).commits()
    assert [version.slot.entity for version in commit.versions] == ["piece"]


@pytest.mark.parametrize("compression", ["zstd", "lz4", "none"])
def test_large_commit_comes_back_in_pieces_as_it_was(tmp_path, compression):
    """A chunk that is not kept in memory: noise and zeros, beside small data."""
    noise = np.random.default_rng(1).integers(0, 255, 21 << 20, np.uint8)
    data = [datum(value) for value in (noise, np.zeros(30 << 20, np.uint8), 5)]
    path = tmp_path / "run.mcap"
    recording = file(path, compression=compression)
    recording.add_commit([recorded(f"e/{n}", each) for n, each in enumerate(data)], BEGIN_NS)
    recording.close({})

    (commit,) = Recording(path).commits()

    assert [bytes(v.datum.body) for v in commit.versions] == [bytes(each.body) for each in data]


def test_damage_in_a_large_chunk_is_seen_before_its_first_message(tmp_path):
    """Its checksum stands before all of it: nothing of a chunk that is not whole is committed."""
    topic = channel(1, f"{EXACT_TOPIC}online/value", EXACT)
    large = encode_recorded(recorded("piece", datum(np.zeros(20 << 20, np.uint8))))
    content = topic + message(1, large) + message(1, large)
    broken = lz4.frame.compress(content)
    path = write(
        tmp_path / "run.mcap",
        chunk(broken, len(content), compression="lz4", crc=zlib.crc32(content) ^ 1),
    )
    recording = Recording(path)

    assert list(recording.commits()) == []
    assert recording.missing_bytes > len(broken)
