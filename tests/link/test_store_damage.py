"""A damaged folder is refused by file and remedy; what only a power cut explains is not damage."""

import os
import random
import shutil
import sqlite3
from pathlib import Path

import pytest
from store_damage import (
    CHANGED_ROWS,
    LOG_HEADER_BYTES,
    after_power_cut,
    flip,
    frame_offset,
    frames_of,
    refusal,
)
from store_writer import contents, outcome_record, persist, reopened, slot_record

from enact_dist.core.protocol.datum import Slot
from enact_dist.core.protocol.records import SlotRecord
from enact_dist.errors import StoreError
from enact_dist.link.folder import mark as store_mark
from enact_dist.link.folder.folder import DATABASE_FILE
from enact_dist.link.folder.mark import MARK_FILE
from enact_dist.link.store.store import open_store, read_store
from enact_dist.terms import Durability, NullReason


@pytest.fixture
def crashed(tmp_path):
    """A folder as kill -9 leaves it: everything is in the log, the last batch is durable."""
    folder = tmp_path / "folder"
    store, _ = open_store(folder, unix_s=1)
    for version in range(1, 9):
        durability = Durability.OS if 3 <= version <= 6 else Durability.DURABLE
        store.write([persist(slot_record(f"e{version}", version), durability=durability)])
    copy = tmp_path / "crashed"
    shutil.copytree(folder, copy)
    store.close()
    return copy


@pytest.fixture
def closed(tmp_path):
    """A folder as a clean end leaves it: everything is in the database and two files."""
    folder = tmp_path / "closed"
    store, _ = open_store(folder, unix_s=1)
    for number in range(40):
        store.write(
            [persist(slot_record(f"e{number}", 1, size=37 * number), outcome_record(number, 1))]
        )
    store.write([persist(slot_record("forced", 5, size=70_000))])
    store.write([persist(slot_record("unforced", 6, size=70_000), durability=Durability.OS)])
    store.close()
    return folder


@pytest.mark.parametrize("within", [0, 9, 17, 24, 2000, 4119])
def test_flipped_bit_in_mid_log_is_refused_with_its_frame(crashed, within):
    """A bit anywhere in a frame that has frames behind it: refused, untouched, frame named."""
    log = crashed / "store.db-wal"
    number = frames_of(crashed) // 2
    flip(log, frame_offset(number) + within)
    before = log.read_bytes()
    found = refusal(crashed)
    assert f"{log} is damaged at byte {frame_offset(number)}" in str(found)
    assert f"truncate -s {frame_offset(number)} {log}" in str(found)
    assert found.path == str(log)
    assert log.read_bytes() == before


def test_flipped_bit_in_the_last_frame_of_an_os_batch_is_refused_in_the_same_boot(tmp_path):
    """No power cut, so what the system had taken must be there; after one it may be gone."""
    folder = tmp_path / "folder"
    store, _ = open_store(folder, unix_s=1)
    store.write([persist(slot_record("a", 1))])
    store.write([persist(slot_record("a", 2), durability=Durability.OS)])
    copy = tmp_path / "copy"
    shutil.copytree(folder, copy)
    store.close()
    last = frame_offset(frames_of(copy) - 1)
    flip(copy / "store.db-wal", last + 100)
    assert f"from byte {last} on: batch 3 was acknowledged" in str(refusal(copy))
    after_power_cut(copy)
    assert [record.version for record in reopened(copy).slots] == [1]


def test_named_way_out_of_a_damaged_log_works(crashed):
    """Cutting the log and accepting the loss, as the message says, opens with what came before."""
    log = crashed / "store.db-wal"
    number = frames_of(crashed) // 2
    flip(log, frame_offset(number) + 100)
    assert f"make an empty file '{crashed / 'accept-loss'}'" in str(refusal(crashed))
    log.write_bytes(log.read_bytes()[: frame_offset(number)])
    assert "batch 9 was acknowledged" in str(refusal(crashed))
    (crashed / "accept-loss").touch()
    assert 0 < len(reopened(crashed).slots) < 8
    assert not (crashed / "accept-loss").exists()


@pytest.mark.parametrize("mark", [None, b"", b"?"])
def test_cut_log_without_its_mark_is_refused_until_the_loss_is_accepted(crashed, caplog, mark):
    """A shard must not start with less than was acknowledged and say nothing."""
    log = crashed / "store.db-wal"
    log.write_bytes(log.read_bytes()[: frame_offset(frames_of(crashed) // 2)])
    (crashed / "mark").unlink()
    if mark is not None:
        (crashed / "mark").write_bytes(mark)

    found = refusal(crashed)
    with pytest.raises(StoreError, match="mark"), read_store(crashed):
        pass
    (crashed / "accept-loss").touch()
    with caplog.at_level("CRITICAL"):
        left = reopened(crashed).slots

    assert found.path == str(crashed / "mark")
    assert ("is missing" if mark is None else "cannot be read") in str(found)
    assert "restore the whole folder from a backup; or, to go on with what can be read" in str(
        found
    )
    assert 0 < len(left) < 8
    assert "unknown number of batches of acknowledged commits may be lost" in caplog.text
    caplog.clear()
    assert len(reopened(crashed).slots) == len(left)
    assert caplog.text == ""
    assert not (crashed / "accept-loss").exists()


def test_flipped_bit_in_the_last_frame_is_refused(crashed):
    """Nothing follows in the log, but the mark says that more was acknowledged; a copy is kept."""
    log = crashed / "store.db-wal"
    last = frame_offset(frames_of(crashed) - 1)
    flip(log, last + 100)
    spoilt = log.read_bytes()
    found = refusal(crashed)
    assert f"{log} is cut or damaged from byte {last} on: batch 9 was acknowledged" in str(found)
    assert (crashed / "store.db-wal.refused").read_bytes() == spoilt


@pytest.mark.parametrize("offset", range(0, LOG_HEADER_BYTES, 3))
def test_flipped_bit_in_the_head_of_the_log_is_refused(crashed, offset):
    """SQLite would take the log for empty and all its commits for never made."""
    flip(crashed / "store.db-wal", offset)
    assert "store.db-wal is damaged at byte 0" in str(refusal(crashed))


@pytest.mark.parametrize("file", ["store.db-wal", "store.db"])
def test_missing_file_of_the_database_is_refused(crashed, file):
    """A deleted log or database is no new folder; nothing else is swept away."""
    store, _ = open_store(crashed, unix_s=1)
    store.write([persist(slot_record("large", 1, size=70_000))])
    copy = crashed.with_name("copy")
    shutil.copytree(crashed, copy)
    store.close()
    (copy / file).unlink()
    assert file in str(refusal(copy))
    assert len(list((copy / "blobs").iterdir())) == 1


def test_emptied_database_is_refused(closed):
    """A database of no bytes would be a new one to SQLite."""
    (closed / "store.db").write_bytes(b"")
    assert "store.db is missing or empty, but the folder has been in use" in str(refusal(closed))


def test_older_copy_of_the_database_is_refused(closed):
    """A database from before the last durable batch lacks what was acknowledged."""
    older = (closed / "store.db").read_bytes()
    store, _ = open_store(closed, unix_s=1)
    store.write([persist(slot_record("later", 1))])
    store.close()
    (closed / "store.db").write_bytes(older)
    assert "was acknowledged" in str(refusal(closed))


def test_flipped_bit_in_the_database_never_changes_what_is_read(closed):
    """120 bits anywhere: refused by name, or in a part that nothing reads; both happen."""
    rng = random.Random(9)
    path = closed / "store.db"
    expected = contents(reopened(closed))
    refused = 0
    sound = path.read_bytes()
    for _ in range(120):
        path.write_bytes(sound)
        flip(path, rng.randrange(len(sound)))
        found, refused_as = opened_or_refused(closed)
        if refused_as:
            refused += 1
            assert "store.db" in refused_as.path
            assert "restore the whole folder" in str(refused_as)
        else:
            assert contents(found) == expected
        for name in ("store.db-wal", "store.db-journal"):
            (closed / name).unlink(missing_ok=True)
    assert 60 < refused < 120


def opened_or_refused(folder):
    """Return what a folder holds, or the error that refused it."""
    try:
        return reopened(folder), None
    except StoreError as failure:
        return None, failure


def test_flipped_bit_in_a_row_is_refused_by_its_checksum(closed):
    """SQLite sees no difference in a changed body; the row's own checksum does."""
    path = closed / "store.db"
    flip(path, path.read_bytes().index(slot_record("e30", 1, size=37 * 30).datum.body))
    assert "checksum is wrong" in str(refusal(closed))


def test_row_that_drops_out_of_its_page_is_refused(closed):
    """A page that says it has one row fewer: no row is wrong, one is missing."""
    path = closed / "store.db"
    sound = path.read_bytes()
    leaves = [begin for begin in range(4096, len(sound), 4096) if sound[begin] == 0x0D]
    assert leaves
    for begin in leaves:
        spoilt = bytearray(sound)
        spoilt[begin + 4] -= 1
        path.write_bytes(spoilt)
        assert "store.db is damaged" in str(refusal(closed))


def test_row_that_was_changed_by_hand_is_refused(closed):
    """A row with a wrong version, type or place does not pass for a record."""
    for change in (
        *(f"UPDATE record SET {change} WHERE id = 9" for change in CHANGED_ROWS),
        "INSERT INTO record SELECT 7777, kind, batch, key, body, crc FROM record WHERE id = 9",
        "DELETE FROM record WHERE kind = 0",
    ):
        copy = closed.with_name("copy")
        shutil.copytree(closed, copy)
        connection = sqlite3.connect(copy / "store.db", isolation_level=None)
        connection.execute(change)
        connection.close()
        assert "store.db" in str(refusal(copy)), change
        shutil.rmtree(copy)


def blob_of(folder, entity):
    """Return the file of a slot's body."""
    body = slot_record(entity, {"forced": 5, "unforced": 6}[entity], size=70_000).datum.body
    return next(path for path in (folder / "blobs").iterdir() if path.read_bytes() == body)


@pytest.mark.parametrize("entity", ["forced", "unforced"])
@pytest.mark.parametrize("damage", ["missing", "short", "long", "flipped"])
def test_damaged_file_of_a_body_is_refused_by_name(closed, entity, damage):
    """A body's file that is missing, of another length or changed: refused, slot and file named."""
    path = blob_of(closed, entity)
    spoil(path, damage)
    found = refusal(closed)
    assert found.path == str(path)
    assert f"online:{entity}/aspect" in str(found)
    assert "restore the whole folder" in str(found)


def spoil(path, damage):
    if damage == "missing":
        path.unlink()
    elif damage == "short":
        path.write_bytes(path.read_bytes()[:-1])
    elif damage == "long":
        path.write_bytes(path.read_bytes() + b"x")
    else:
        flip(path, 50_000)


def test_power_cut_takes_unforced_bodies_and_says_so(closed):
    """After a restart of the system an `os` body may be gone: null with the reason, for good."""
    spoil(blob_of(closed, "unforced"), "short")
    after_power_cut(closed)
    for _ in range(2):
        found = {record.slot.entity: record for record in reopened(closed).slots}
        slot = Slot("online", "unforced", "aspect")
        assert found["unforced"] == SlotRecord(slot, 6, 60, None, NullReason.LOST.name)
        assert found["forced"].datum is not None
    assert len(list((closed / "blobs").iterdir())) == 1


def test_system_that_does_not_name_its_boot_may_have_had_a_power_cut(tmp_path, monkeypatch):
    """Where the boot cannot be read (a sandbox hides it), what was not forced may be gone."""
    monkeypatch.setattr(store_mark, "_BOOT_ID", tmp_path / "hidden")
    folder = tmp_path / "folder"
    store, _ = open_store(folder, unix_s=1)
    unforced = slot_record("unforced", 6, size=70_000)
    store.write([persist(unforced, durability=Durability.OS)])
    store.close()

    spoil(blob_of(folder, "unforced"), "short")

    (found,) = reopened(folder).slots
    assert (found.datum, found.null_reason) == (None, NullReason.LOST.name)


def test_power_cut_does_not_excuse_a_forced_body(closed):
    """What was forced to the disk must be there, power cut or not."""
    spoil(blob_of(closed, "forced"), "short")
    after_power_cut(closed)
    assert "online:forced/aspect" in str(refusal(closed))


def test_power_cut_does_not_excuse_a_hole_before_a_forced_batch(crashed):
    """The mark says that a batch behind the hole was forced: refused, power cut or not."""
    flip(crashed / "store.db-wal", frame_offset(frames_of(crashed) // 2) + 50)
    after_power_cut(crashed)
    assert "cut or damaged from byte" in str(refusal(crashed))


def test_database_in_use_by_another_program_is_refused_as_such(closed):
    """A database browser that holds the file is named as the cause, not a broken disk."""
    browser = sqlite3.connect(closed / "store.db", isolation_level=None)
    browser.execute("BEGIN EXCLUSIVE")
    assert "is open in another program" in str(refusal(closed))
    browser.close()
    reopened(closed)


def test_mark_that_cannot_be_read_excuses_nothing(crashed):
    """Without a mark nothing proves a power cut: a hole in the log is damage."""
    (crashed / "mark").write_bytes(b"?")
    (crashed / "accept-loss").touch()
    assert len(reopened(crashed).slots) == 8
    store, _ = open_store(crashed, unix_s=1)
    for version in range(1, 6):
        store.write([persist(slot_record("e", version))])
    copy = crashed.with_name("copy")
    shutil.copytree(crashed, copy)
    store.close()
    (copy / "mark").unlink()
    (copy / "accept-loss").touch()
    flip(copy / "store.db-wal", frame_offset(2))
    assert "is damaged at byte" in str(refusal(copy))


def test_mark_of_a_first_start_that_was_killed_is_forced_by_the_next(tmp_path, monkeypatch):
    """Before the database is there: else a power cut could leave that one without the mark."""
    folder, force = tmp_path / "s", os.fsync
    forced = []

    def fsync(descriptor):
        path = Path(f"/proc/self/fd/{descriptor}").readlink()
        if path == folder / MARK_FILE:
            forced.append((folder / DATABASE_FILE).exists())
            if len(forced) == 1:
                raise KeyboardInterrupt  # killed
        force(descriptor)

    monkeypatch.setattr(os, "fsync", fsync)
    with pytest.raises(KeyboardInterrupt):
        open_store(folder, unix_s=1)
    assert (folder / MARK_FILE).stat().st_size
    store, _ = open_store(folder, unix_s=1)
    store.close()

    assert forced[:2] == [False, False]
