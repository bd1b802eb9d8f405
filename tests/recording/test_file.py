"""A recording is a file that the public library reads, good up to its last whole chunk."""

import io
import json
import os
import struct

import numpy as np
import pytest
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.exceptions import EndOfFile
from mcap.reader import make_reader
from mcap.records import Chunk, Message
from mcap.stream_reader import StreamReader
from recording_samples import BEGIN_NS, all_same, counting, data, file, recorded

from enact_dist.errors import ConfigError
from enact_dist.recording.exact import decode_recorded
from enact_dist.recording.reading import Recording


def read(path):
    """Return the recording once it is read, and its commits."""
    recording = Recording(path)
    return recording, list(recording.commits())


@settings(
    suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None, max_examples=40
)
@given(
    held=st.lists(data, min_size=1, max_size=6),
    compression=st.sampled_from(["none", "lz4", "zstd"]),
    per_chunk=st.integers(1, 3),
)
def test_recording_comes_back_bit_for_bit(tmp_path, held, compression, per_chunk):
    """Any data, however they are compressed and divided."""
    path = tmp_path / "any.mcap"
    path.unlink(missing_ok=True)
    written = [recorded("piece", each, version=n, commit=n) for n, each in enumerate(held, 1)]
    recording = file(path, compression=compression)
    for number, version in enumerate(written, 1):
        recording.add_commit([version], version.stamp_ns)
        if number % per_chunk == 0:
            recording.end_chunk()
    recording.close({})

    found, commits = read(path)
    assert all_same([version for commit in commits for version in commit.versions], written)
    assert (found.whole, found.missing_bytes) == (True, 0)


def test_public_library_reads_it(tmp_path):
    """Topics, times, sequence numbers, metadata and content are where others look for them."""
    path = tmp_path / "run.mcap"
    recording = file(path)
    image = recorded("camera/1", np.full((2, 3, 3), 7, np.uint8), version=5, commit=2)
    recording.add_commit([recorded("piece", 4, version=2)], BEGIN_NS + 10)
    recording.add_commit([image], BEGIN_NS + 20)
    recording.close({"versions": "2"})

    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        messages = {channel.topic: (schema, m) for schema, channel, m in reader.iter_messages()}
        metadata = {record.name: record.metadata for record in reader.iter_metadata()}
        statistics = reader.get_summary().statistics
    assert sorted(messages) == [
        "/enact/online/value",
        "/online/camera/1/value",
        "/online/piece/value",
    ]
    schema, message = messages["/online/camera/1/value"]
    assert (schema.name, schema.encoding) == ("foxglove.RawImage", "protobuf")
    assert (message.log_time, message.sequence) == (BEGIN_NS + 20, 5)
    shown = RawImage.FromString(message.data)
    assert (shown.encoding, shown.width, shown.height, shown.step) == ("rgb8", 3, 2, 9)
    schema, message = messages["/online/piece/value"]
    assert json.loads(message.data)["value"] == 4
    assert json.loads(schema.data)["properties"]["value"] == {"type": "integer"}
    assert (metadata["enact"]["format"], metadata["enact.end"]["versions"]) == ("2", "2")
    assert statistics.message_count == 4


def test_times_are_commit_and_capture(tmp_path):
    """Log time is the commit's stamp, publish time the capture's, or the commit's where unsaid."""
    from recording_samples import datum

    path = tmp_path / "run.mcap"
    recording = file(path)
    captured = recorded("piece", datum(1, stamp_ns=BEGIN_NS - 5))
    recording.add_commit([captured, recorded("bench", 1)], BEGIN_NS)
    recording.close({})
    with path.open("rb") as stream:
        found = {
            decode_recorded(m.data).slot.entity: (m.log_time, m.publish_time)
            for _, _, m in make_reader(stream).iter_messages(topics=["/enact/online/value"])
        }
    assert found["piece"] == (BEGIN_NS, BEGIN_NS - 5)
    assert found["bench"] == (BEGIN_NS, recorded("bench", 1).stamp_ns)


def test_exact_only_has_no_pictures(tmp_path):
    """Who only wants to replay writes each datum once."""
    path = tmp_path / "run.mcap"
    recording = file(path, shows=None)
    recording.add_commit([recorded("piece", 1)], BEGIN_NS)
    recording.close({})
    with path.open("rb") as stream:
        assert [c.topic for _, c, _ in make_reader(stream).iter_messages()] == [
            "/enact/online/value"
        ]


# ---------------------------------------------------------------- cut off


def chunk_ends(path):
    """Return the offsets at which whole chunks end, as the public library sees them."""
    ends = []
    with path.open("rb") as stream:
        for record in StreamReader(stream, emit_chunks=True).records:
            if isinstance(record, Chunk):
                ends.append(stream.tell())
    return ends


@pytest.fixture(scope="module", params=["none", "lz4", "zstd"])
def whole(request, tmp_path_factory):
    """A recording of five chunks of two commits each."""
    path = tmp_path_factory.mktemp("whole") / "whole.mcap"
    counting(path, 10, per_chunk=2, size=500, compression=request.param).close({})
    return path


def test_cut_anywhere_it_is_good_up_to_its_last_whole_chunk(whole, tmp_path):
    """At every chunk's end, one byte before and after it, and in its middle."""
    ends = chunk_ends(whole)
    content = whole.read_bytes()
    assert len(ends) == 5
    starts = [0, *ends]
    cuts = {cut for end in ends for cut in (end - 1, end, end + 1)}
    cuts |= {(a + b) // 2 for a, b in zip(starts, ends, strict=False)}
    for cut in sorted(cuts):
        path = tmp_path / f"{cut}.mcap"
        path.write_bytes(content[:cut])
        chunks = sum(end <= cut for end in ends)
        recording, commits = read(path)
        assert [commit.number for commit in commits] == list(range(1, 2 * chunks + 1)), cut
        assert all(len(commit.versions) == 2 for commit in commits), "each commit is whole"
        assert (recording.chunks, recording.whole) == (chunks, False)
        assert recording.missing_bytes <= cut
        if cut in ends:
            assert recording.missing_bytes == 0


def test_every_byte_of_the_last_chunk_is_a_place_to_cut(whole, tmp_path):
    """None of them makes anything but the chunks before."""
    ends = chunk_ends(whole)
    content = whole.read_bytes()
    path = tmp_path / "cut.mcap"
    for cut in range(ends[-2], ends[-1]):
        path.write_bytes(content[:cut])
        _, commits = read(path)
        assert len(commits) == 8, cut


def test_tail_of_zeros_and_of_noise_are_missing(whole, tmp_path):
    """A disk that lost power may leave a length without its content."""
    ends = chunk_ends(whole)
    content = whole.read_bytes()
    half = (ends[2] + ends[3]) // 2
    for tail in (bytes(ends[3] - half), os.urandom(ends[3] - half)):
        path = tmp_path / "tail.mcap"
        path.write_bytes(content[:half] + tail)
        recording, commits = read(path)
        assert len(commits) == 6
        assert recording.missing_bytes > 0


def test_hole_in_a_chunk_is_where_the_recording_ends(whole, tmp_path):
    """Pages that never reached the disk: its checksum tells, wherever in the chunk they are."""
    ends = chunk_ends(whole)
    content = whole.read_bytes()
    path = tmp_path / "hole.mcap"
    with whole.open("rb") as stream:
        chunks = [r for r in StreamReader(stream, emit_chunks=True).records if isinstance(r, Chunk)]
    length = len(chunks[3].data)
    for offset in range(0, length - 8, max(1, length // 40)):
        at = ends[3] - length + offset
        path.write_bytes(content[:at] + bytes(8) + content[at + 8 : ends[3]])
        if content[at : at + 8] != bytes(8):
            assert len(read(path)[1]) == 6, offset


def test_public_library_reads_whole_chunks_of_a_cut_file(whole):
    """Record by record, it gives the same messages before it meets the cut."""
    ends = chunk_ends(whole)
    cut = io.BytesIO(whole.read_bytes()[: ends[3] + 40])
    found = []
    with pytest.raises((EndOfFile, ValueError, struct.error)):
        for record in StreamReader(cut).records:
            found += [record] if isinstance(record, Message) else []
    assert len(found) == 8 * 4


def test_open_chunk_is_not_on_the_disk_and_an_ended_one_is(tmp_path):
    """What is forced to the disk is whole chunks."""
    path = tmp_path / "run.mcap"
    recording = counting(path, 1, per_chunk=2)
    assert read(path)[1] == []
    recording.end_chunk()
    assert len(read(path)[1]) == 1
    recording.close({})


def test_chunk_ends_by_size_with_a_whole_commit(tmp_path):
    """The commit that fills a chunk is the last one in it, whole."""
    path = tmp_path / "run.mcap"
    recording = file(path, chunk_bytes=100)
    for number in (1, 2):
        pair = [recorded(name, b"x" * 400, commit=number) for name in ("bench", "piece")]
        recording.add_commit(pair, pair[0].stamp_ns)
    assert recording.chunks == 2
    assert [len(commit.versions) for commit in read(path)[1]] == [2, 2]
    recording.close({})


# ---------------------------------------------------------------- refused


def test_file_that_exists_is_refused(tmp_path):
    """A recording never takes the place of another one."""
    path = tmp_path / "run.mcap"
    path.write_bytes(b"precious")
    with pytest.raises(ConfigError, match="exists"):
        file(path)
    assert path.read_bytes() == b"precious"


def test_other_files_are_named_for_what_they_are(tmp_path):
    """No MCAP file, and one that somebody else made."""
    path = tmp_path / "other.mcap"
    path.write_bytes(b"something else")
    with pytest.raises(ConfigError, match="no MCAP file"):
        Recording(path)
    from mcap.writer import Writer

    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        writer.finish()
    with pytest.raises(ConfigError, match="no recording"):
        Recording(path)
    with pytest.raises(ConfigError, match="cannot read"):
        Recording(tmp_path / "none.mcap")
