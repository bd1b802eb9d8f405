"""A recording of many commits: what a step through it reads, and what was there at each moment."""

import pytest
from polling import until
from quiet_browser import QuietClient
from view_samples import BEGIN_NS, SECOND_NS, moved, slot

from enact_dist.config.shows import GUESSED
from enact_dist.errors import ProtocolError
from enact_dist.recording import chunks, reading
from enact_dist.recording.exact import Recorded
from enact_dist.recording.file import RecordingFile
from enact_dist.view.pages.page import Page
from enact_dist.view.pages.viewer import Viewer, ViewSettings
from enact_dist.view.recorded import RecordingFeed, RecordingSource
from enact_dist.wire.payload import decode_untyped, encode_datum

PARTS = [slot(f"part/{number}", "count") for number in range(40)]
PER_CHUNK = 20


def at(number):
    """Return the moment of a commit."""
    return BEGIN_NS + number * SECOND_NS


def written(path, commits):
    """Write a recording of commits, each a map of slots to values, None for null."""
    facts = {"cell": "cell", "worlds": "online", "begin_ns": str(BEGIN_NS)}
    file = RecordingFile(path, facts, aspects=lambda _: None, shows=None)
    versions = {}
    for number, data in enumerate(commits):
        commit = []
        for each, value in data.items():
            versions[each] = versions.get(each, 0) + 1
            datum = encode_datum(value, type(value)) if value is not None else None
            null = "" if datum else "DELETED"
            commit.append(
                Recorded(each, versions[each], at(number), "left", number, datum, null, "writer")
            )
        file.add_commit(commit, at(number))
        if number % PER_CHUNK == 0:
            file.end_chunk()
    file.close({})
    return path


@pytest.fixture
def counting(tmp_path):
    """A recording of 40 data, each changed in turn, 400 commits in 20 chunks and the first one."""
    counts = ({PARTS[n % 40]: n} for n in range(1, 401))
    return RecordingSource(written(tmp_path / "run.mcap", [dict.fromkeys(PARTS, 0), *counts]))


def values(source, number, before=None):
    found = source.data_at(PARTS, at(number), before or {}).data
    return [decode_untyped(found[part].datum) for part in PARTS], found


def expected(number):
    return [max(0, number - (number - part) % 40) if number >= part else 0 for part in range(40)]


def test_a_step_back_reads_what_it_changes(counting, monkeypatch):
    """Not the file from its begin; a far jump reads the versions of its moment alone."""
    read, decode = [], reading.decode_recorded
    monkeypatch.setattr(reading, "decode_recorded", lambda data: read.append(1) or decode(data))
    source, before = counting.of_page(), {}
    for number, most in ((400, 40), (399, 1), (398, 1), (57, 40), (56, 1), (57, 1), (3, 40)):
        read.clear()
        found, before = values(source, number, before)
        assert found == expected(number)
        assert len(read) <= most


def test_no_page_reads_a_chunk_again_for_another(counting, monkeypatch):
    """Each keeps the one that it read last."""
    unpacked, unpack = [], chunks.Chunk._unpacked
    monkeypatch.setattr(chunks.Chunk, "_unpacked", lambda one: unpacked.append(1) or unpack(one))
    pages = {400: counting.of_page(), 41: counting.of_page()}
    unpacked.clear()
    for _ in range(3):
        for number, page in pages.items():
            assert page.data_at(PARTS[1:2], at(number)).data.keys() == {PARTS[1]}
    assert len(unpacked) == 2


def test_a_large_chunk_is_read_in_one_pass(counting, monkeypatch):
    """It does not stay in memory, and is not unpacked again for each of its versions."""
    monkeypatch.setattr(chunks, "IN_MEMORY_BYTES", 1)
    unpacked, unpack = [], chunks.Chunk._unpacked
    monkeypatch.setattr(chunks.Chunk, "_unpacked", lambda one: unpacked.append(1) or unpack(one))
    assert values(counting.of_page(), 0)[0] == [0] * 40
    assert len(unpacked) == 1


def test_a_file_that_was_changed_is_named(counting):
    """Its places are those of another file then."""
    path = counting._recording.path
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(ProtocolError, match=r"run\.mcap is not what it was"):
        values(counting.of_page(), 400)


def test_numbers_are_spread_over_the_recording(counting, monkeypatch):
    """Nothing but what is plotted is read."""
    read, decode = [], reading.decode_recorded
    monkeypatch.setattr(reading, "decode_recorded", lambda data: read.append(1) or decode(data))
    found = [decode_untyped(datum) for _, datum in counting.samples(PARTS[7], 4, 64)]
    assert found == [0, 87, 207, 327]
    assert len(read) == 4


POSE, LOST = slot("arm", "pose"), slot("lost", "pose")


@pytest.fixture
def passing(tmp_path):
    """A pose that is there in commits 1 to 2 alone, one that goes and comes back, and a number."""
    commits = [
        {PARTS[0]: 1},
        {LOST: moved(1.0), POSE: moved(2.0)},
        {POSE: None},
        {LOST: None},
        {POSE: moved(3.0)},
    ]
    return RecordingSource(written(tmp_path / "passing.mcap", commits))


def test_data_are_listed_at_the_moments_in_which_they_are_there(passing):
    """Also those that are null at the end, which are drawn as what they were."""
    listed = [passing.catalogue.slots("online", at(number)) for number in range(5)]
    assert listed == [
        [PARTS[0]],
        [POSE, LOST, PARTS[0]],
        [LOST, PARTS[0]],
        [PARTS[0]],
        [POSE, PARTS[0]],
    ]
    rows = [passing.catalogue.listing("online", "", "", at(n)).slots for n in (1, 3)]
    assert rows == [(POSE, LOST), ()]
    feed = RecordingFeed(passing, lambda _: GUESSED)
    assert feed.in_scene(passing.catalogue.slots("online")) == [POSE, LOST]


def test_a_page_lists_and_draws_what_was_there(passing):
    """Step by step back from the end, at which it is not."""
    with Viewer(passing, ViewSettings({}, "online")) as viewer:
        page = Page(viewer, QuietClient())
        page.start()
        handles = page._client.gui.handles
        until(lambda: "datum" in handles and "arm/pose" in handles["datum"].options)
        assert "lost/pose" not in handles["datum"].options
        page._send("step", -2)
        until(lambda: "lost/pose" in handles["datum"].options)
        assert "arm/pose" not in handles["datum"].options
        until(lambda: page.contents.data([LOST]).keys() == {LOST})
        page.close()
        page._thread.join()


def test_numbers_beyond_those_of_a_shard_are_refused(tmp_path):
    """Whoever made the file."""
    odd = Recorded(PARTS[0], 1 << 63, at(0), "left", 0, encode_datum(1, int))
    file = RecordingFile(tmp_path / "odd.mcap", {}, aspects=lambda _: None, shows=None)
    file.add_commit([odd], at(0))
    file.close({})
    with pytest.raises(ProtocolError, match=r"part/0/count has the state \(9223372036854775808"):
        RecordingSource(tmp_path / "odd.mcap")
