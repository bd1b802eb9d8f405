"""The store gives back what it was given, after a clean end."""

import os
import sqlite3
import stat
import subprocess
import sys

import pytest
from store_writer import contents, outcome_record, persist, reopened, slot_record

from enact_dist.core.protocol.datum import Datum, Slot
from enact_dist.core.protocol.messages import AspectEntry
from enact_dist.core.protocol.records import (
    AspectRecord,
    AuditRecord,
    Recovered,
    SessionEnded,
    SessionRecord,
    SlotRecord,
    WorldRecord,
)
from enact_dist.errors import StoreError
from enact_dist.link.folder.lock import FORMAT, FORMAT_READ_MIN
from enact_dist.link.store.fields import pack
from enact_dist.link.store.rows import Key, RowKind, row_checksum
from enact_dist.link.store.states import OUTCOMES_KEPT_NS
from enact_dist.link.store.store import open_store
from enact_dist.terms import Durability, NullReason

SLOT = Slot("online", "tray/package/1", "surface")


def test_store_is_empty_in_a_new_folder(tmp_path):
    """A new folder is made, parents too, and holds nothing; its epoch is the wall clock's."""
    assert reopened(tmp_path / "a" / "b", unix_s=1700) == Recovered(epoch=1700)


def test_epoch_grows_with_every_opening(tmp_path):
    """The epoch is new each time, whether the clock went on, stood still or went back."""
    clock = (100, 100, 50, 200)
    assert [reopened(tmp_path, unix_s=unix_s).epoch for unix_s in clock] == [100, 101, 102, 200]


def test_epoch_is_used_up_by_an_opening_that_is_killed(tmp_path):
    """A process that opened the store and died at once has used its epoch."""
    script = (
        "import os, sys; from pathlib import Path; from enact_dist.link.store.store import open_store\n"
        f"s, r = open_store(Path({str(tmp_path)!r}), unix_s=100); print(r.epoch, flush=True)\n"
        "os.kill(os.getpid(), 9)"
    )
    ended = subprocess.run([sys.executable, "-c", script], check=False, capture_output=True)
    assert (ended.returncode, ended.stdout) == (-9, b"100\n")
    assert reopened(tmp_path, unix_s=100).epoch == 101


@pytest.mark.parametrize("durability", [Durability.DURABLE, Durability.OS])
@pytest.mark.parametrize("size", [0, 1, 65_536, 65_537, 3_000_001])
def test_slot_comes_back_with_its_body_of_any_size(tmp_path, size, durability):
    """A body comes back byte for byte, in a row or in a file, in either class."""
    record = slot_record("tray/1", 3, size=size)
    store, _ = open_store(tmp_path, unix_s=1)
    store.write([persist(record, durability=durability)])
    store.close()
    (found,) = reopened(tmp_path).slots
    assert found.slot == record.slot
    assert (found.version, found.stamp_ns, found.null_reason, found.volatile) == (3, 30, "", False)
    assert (found.datum.encoding, found.datum.size, found.datum.stamp_ns) == (b"encoding", size, 3)
    assert bytes(found.datum.body) == record.datum.body
    assert (len(list((tmp_path / "blobs").iterdir())) == 1) == (size > 65_536)


def test_large_body_comes_back_as_a_read_only_map(tmp_path):
    """A large body is not read into memory, cannot be changed, and survives its file."""
    record = slot_record("tray/1", 1, size=100_000)
    store, _ = open_store(tmp_path, unix_s=1)
    store.write([persist(record)])
    store.close()
    store, recovered = open_store(tmp_path, unix_s=1)
    body = recovered.slots[0].datum.body
    assert isinstance(body, memoryview)
    assert body.readonly
    store.write([persist(slot_record("tray/1", 2))])
    store.rest()
    assert list((tmp_path / "blobs").iterdir()) == []
    assert bytes(body) == record.datum.body
    store.close()


def test_memoryview_body_is_stored(tmp_path):
    """A recovered or received body is a memoryview and is stored like bytes, large or small."""
    store, _ = open_store(tmp_path, unix_s=1)
    for name, size in (("small", 3), ("large", 70_000)):
        body = memoryview(bytes(range(256)) * 300)[:size]
        slot = Slot("w", name, "a")
        store.write([persist(SlotRecord(slot, 1, 1, Datum(b"e", body, size), ""))])
    store.close()
    assert {len(r.datum.body) for r in reopened(tmp_path).slots} == {3, 70_000}


def test_null_slot_keeps_version_and_reason(tmp_path):
    """A deleted slot comes back null with its version, so that none is reused; its file is gone."""
    store, _ = open_store(tmp_path, unix_s=1)
    store.write([persist(slot_record("tray/1", 4, size=70_000))])
    slot = Slot("online", "tray/1", "aspect")
    store.write([persist(SlotRecord(slot, 5, 99, None, NullReason.DELETED.name))])
    store.rest()
    assert list((tmp_path / "blobs").iterdir()) == []
    store.close()
    assert reopened(tmp_path).slots == [SlotRecord(slot, 5, 99, None, "DELETED")]


def test_volatile_slot_comes_back_as_existence_only(tmp_path):
    """Of a volatile slot neither version nor datum is kept, also where a durable one stood."""
    store, _ = open_store(tmp_path, unix_s=1)
    store.write([persist(SlotRecord(SLOT, 7, 70, Datum(b"e", b"x" * 70_000, 70_000), ""))])
    store.write([persist(SlotRecord(SLOT, 8, 80, None, "", volatile=True))])
    store.rest()
    assert list((tmp_path / "blobs").iterdir()) == []
    store.close()
    assert reopened(tmp_path).slots == [SlotRecord(SLOT, 0, 0, None, "", volatile=True)]


def test_catalogue_and_sessions_come_back(tmp_path):
    """Worlds, aspects and living sessions come back once each; a later record replaces."""
    store, _ = open_store(tmp_path, unix_s=1)
    first, second = AspectEntry("a", "int", "os"), AspectEntry("a", "int", "durable")
    store.write(
        [
            persist(WorldRecord("online"), AspectRecord(first), SessionRecord("x", 5)),
            persist(WorldRecord("online"), AspectRecord(second), SessionRecord("y", 6)),
            persist(SessionEnded("x", 10), AuditRecord(3, "broken"), AuditRecord(3, "broken")),
        ]
    )
    store.close()
    found = reopened(tmp_path)
    assert (found.worlds, found.aspects) == ([WorldRecord("online")], [second])
    assert found.sessions == [SessionRecord("y", 6)]


def test_outcome_of_a_lane_replaces_the_one_before(tmp_path):
    """One outcome per session and lane: the newest."""
    store, _ = open_store(tmp_path, unix_s=1)
    for lane, version in ((0, 1), (1, 1), (0, 2)):
        store.write([persist(outcome_record(lane, version))])
    store.close()
    assert reopened(tmp_path).outcomes == [outcome_record(0, 2), outcome_record(1, 1)]


@pytest.mark.parametrize("reopen", [False, True])
def test_outcomes_of_an_ended_session_go_after_a_day(tmp_path, reopen):
    """They are kept for 24 h of wall clock, over restarts too, then forgotten; others stay."""
    other = SessionRecord("other", 1)
    store, _ = open_store(tmp_path, unix_s=1)
    store.write([persist(SessionRecord("session", 1), outcome_record(0, 1), outcome_record(5, 1))])
    store.write([persist(SessionEnded("session", 1000), other)])
    end_ns = 1000 + OUTCOMES_KEPT_NS
    for wall_ns, kept in ((end_ns - 1, 2), (end_ns, 0)):
        if reopen:
            store.close()
            store, recovered = open_store(tmp_path, unix_s=1)
            assert len(recovered.outcomes) == 2
        store.write([persist(SessionEnded("third", wall_ns))])
        store.close()
        store, recovered = open_store(tmp_path, unix_s=1)
        assert len(recovered.outcomes) == kept
        assert recovered.sessions == [other]
    store.close()


def test_outcomes_of_an_ended_session_go_at_an_opening_a_day_later(tmp_path):
    """What is to be forgotten is forgotten at the start as well, and for good."""
    store, _ = open_store(tmp_path, unix_s=1)
    store.write([persist(outcome_record(0, 1), SessionEnded("session", 0))])
    store.close()
    day_s = OUTCOMES_KEPT_NS // 1_000_000_000
    assert len(reopened(tmp_path, unix_s=day_s - 1).outcomes) == 1
    reopened(tmp_path, unix_s=day_s)
    assert reopened(tmp_path, unix_s=2).outcomes == []


def test_session_that_comes_back_keeps_its_outcomes(tmp_path):
    """A session ended by silence and seen again is alive: its outcomes do not expire."""
    store, _ = open_store(tmp_path, unix_s=1)
    session = SessionRecord("session", 1)
    store.write([persist(outcome_record(0, 1), SessionEnded("session", 0)), persist(session)])
    store.write([persist(SessionEnded("other", 3 * OUTCOMES_KEPT_NS))])
    store.close()
    found = reopened(tmp_path)
    assert (found.outcomes, found.sessions) == ([outcome_record(0, 1)], [session])


def test_last_state_of_a_batch_stands(tmp_path):
    """Of several states of one slot in one batch the last one is stored, and one file at most."""
    store, _ = open_store(tmp_path, unix_s=1)
    store.write([persist(slot_record("a", version, size=70_000)) for version in (1, 2, 3)])
    store.rest()
    assert len(list((tmp_path / "blobs").iterdir())) == 1
    store.close()
    assert [record.version for record in reopened(tmp_path).slots] == [3]


def test_log_is_carried_over_while_the_store_is_used(tmp_path):
    """The log does not grow with the number of batches, and nothing is lost when it starts anew."""
    store, _ = open_store(tmp_path, unix_s=1)
    lengths = []
    for version in range(1, 61):
        batch = [persist(slot_record(f"e{n}", version, size=60_000)) for n in range(10)]
        store.write(batch)
        store.rest()
        lengths.append((tmp_path / "store.db-wal").stat().st_size)
    assert max(lengths) < 12 << 20
    store.close()
    assert {record.version for record in reopened(tmp_path).slots} == {60}


def test_empty_batch_changes_nothing(tmp_path):
    """A `Persist` without records is kept at once."""
    store, _ = open_store(tmp_path, unix_s=1)
    length = (tmp_path / "store.db-wal").stat().st_size
    store.write([persist()])
    assert (tmp_path / "store.db-wal").stat().st_size == length
    store.close()


def test_closed_store_refuses_writes(tmp_path):
    """After `close`, which may come twice, a write is refused; the folder is free."""
    store, _ = open_store(tmp_path, unix_s=1)
    store.close()
    store.close()
    with pytest.raises(StoreError, match="closed"):
        store.write([persist(slot_record("a", 1))])
    assert reopened(tmp_path).slots == []


def test_second_opener_is_refused_by_pid_and_host(tmp_path):
    """A folder serves one process: the second one is told folder, pid and host of the first."""
    store, _ = open_store(tmp_path, unix_s=1)
    script = (
        "from pathlib import Path; from enact_dist.link.store.store import open_store\n"
        f"open_store(Path({str(tmp_path)!r}), unix_s=1)"
    )
    ended = subprocess.run(
        [sys.executable, "-c", script], check=False, capture_output=True, text=True
    )
    assert ended.returncode == 1
    said = f"StoreError: data folder {tmp_path} is in use by process {os.getpid()} on host "
    assert said + os.uname().nodename in ended.stderr
    with pytest.raises(StoreError, match="this one") as refused:
        open_store(tmp_path, unix_s=1)
    assert refused.value.path == str(tmp_path)
    store.close()
    reopened(tmp_path)


@pytest.mark.parametrize(
    ("other", "age"), [(FORMAT + 1, "a newer"), (FORMAT_READ_MIN - 1, "an older")]
)
def test_folder_of_another_format_is_refused_untouched(tmp_path, other, age):
    """A program leaves the folder of a newer or older one exactly as it is, and names both."""
    store, _ = open_store(tmp_path, unix_s=1)
    store.write([persist(slot_record("a", 1))])
    store.close()
    (tmp_path / "format").write_text(f"enact-dist store {other}\n")
    before = files_of(tmp_path)
    said = f"store format {other}, this program reads {FORMAT}: it was written by {age} enact-dist"
    with pytest.raises(StoreError, match=said):
        open_store(tmp_path, unix_s=1)
    assert files_of(tmp_path) == before


def test_folder_of_the_format_before_is_read_and_marked(tmp_path):
    """Its sessions and acts name nobody; from then on an older program leaves the folder alone."""
    store, _ = open_store(tmp_path, unix_s=1)
    store.write([persist(SessionRecord("x", 5), AuditRecord(3, "broken"))])
    store.close()
    (tmp_path / "format").write_text(f"enact-dist store {FORMAT_READ_MIN}\n")
    with sqlite3.connect(tmp_path / "store.db") as database:
        for kind, body in (
            (RowKind.SESSION, pack([5])),
            (RowKind.AUDIT, pack([3, "broken", "broken"])),
        ):
            found = database.execute("SELECT key, batch FROM record WHERE kind = ?", (kind,))
            ((name, batch),) = found
            crc = row_checksum(Key(kind, name), batch, body)
            change = "UPDATE record SET body = ?, crc = ? WHERE kind = ?"
            database.execute(change, (body, crc, kind))
    database.close()

    store, found = open_store(tmp_path, unix_s=2)
    store.close()

    assert (found.sessions, found.audit) == ([SessionRecord("x", 5)], [AuditRecord(3, "broken")])
    assert (tmp_path / "format").read_text() == f"enact-dist store {FORMAT}\n"


@pytest.mark.parametrize("text", ["", "enact-dist store", "something else 1", None])
def test_folder_without_a_readable_format_is_refused(tmp_path, text):
    """A damaged or missing format beside data is refused by name."""
    reopened(tmp_path)
    path = tmp_path / "format"
    path.unlink() if text is None else path.write_text(text)
    with pytest.raises(StoreError, match="is no data folder of a shard, or the file is damaged"):
        open_store(tmp_path, unix_s=1)


def test_file_in_the_place_of_the_folder_is_refused_by_name(tmp_path):
    """A file where the folder should be ends in a `StoreError` that names it."""
    path = tmp_path / "file"
    path.touch()
    with pytest.raises(StoreError, match="file") as refused:
        open_store(path, unix_s=1)
    assert refused.value.path == str(path)


def test_other_contents_of_the_folder_are_left_alone(tmp_path):
    """Files that are not the store's survive the sweep; drafts and orphans do not."""
    reopened(tmp_path)
    for name in ("1-1.blob", "1-2.blob.tmp", "readme.txt"):
        (tmp_path / "blobs" / name).write_bytes(b"x")
    assert contents(reopened(tmp_path)) == contents(Recovered(epoch=1))
    assert [path.name for path in (tmp_path / "blobs").iterdir()] == ["readme.txt"]


def files_of(folder):
    """Return the content of all files but the lock."""
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.name != "lock"
    }


@pytest.mark.parametrize("place", ["file", "file/left"])
def test_folder_that_is_a_file_is_named_with_the_remedy(tmp_path, place):
    """Nothing is wrong with the disk, and no permission is missing."""
    (tmp_path / "file").write_text("notes")

    with pytest.raises(
        StoreError, match=r"/file is a file, not a folder.*`data_folder`"
    ) as refused:
        open_store(tmp_path / place, unix_s=1)

    assert "start the shard again" not in str(refused.value)
    assert (tmp_path / "file").read_text() == "notes"


@pytest.mark.parametrize(
    ("given", "folder_mode", "file_mode"),
    [(None, 0o700, 0o600), (0o750, 0o750, 0o640), (0o2770, 0o2770, 0o660)],
)
def test_files_are_for_their_user_or_as_wide_as_the_folder_is(
    tmp_path, given, folder_mode, file_mode
):
    """Data at rest are nobody else's, but where somebody has opened the folder to a group."""
    folder = tmp_path / "data" / "s0"
    if given is not None:
        folder.mkdir(parents=True)
        folder.chmod(given)
    before = os.umask(0)
    try:
        store, _ = open_store(folder, unix_s=1)
        store.write([persist(slot_record("a", 1, size=100_000))])
        found = {path.name: stat.S_IMODE(path.stat().st_mode) for path in folder.rglob("*")}
    finally:
        os.umask(before)
    store.close()

    blobs = found.pop("blobs")
    assert (stat.S_IMODE(folder.stat().st_mode), blobs & 0o777) == (
        folder_mode,
        folder_mode & 0o777,
    )
    assert {"lock", "mark", "format", "store.db", "store.db-wal"} < found.keys()
    assert set(found.values()) == {file_mode}


def test_folder_that_everybody_may_read_is_told_of(tmp_path, caplog):
    """An earlier release made it so."""
    tmp_path.chmod(0o755)
    store, _ = open_store(tmp_path, unix_s=1)
    store.close()

    assert f"{tmp_path} is open to every user of this host (mode 755): chmod 700" in caplog.text
