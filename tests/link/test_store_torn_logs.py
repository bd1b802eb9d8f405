"""What a power cut leaves of a log: holes, missing frames and torn commits cost unforced data alone."""

import os
import random
import shutil

import pytest
from store_damage import (
    FRAME_BYTES,
    after_power_cut,
    flip,
    frame_offset,
    frames_of,
    refusal,
)
from store_writer import persist, reopened, slot_record

from enact_dist.errors import StoreError
from enact_dist.link.folder.wal_check import check_wal, commit_ends
from enact_dist.link.store import medium as store_module
from enact_dist.link.store.store import open_store
from enact_dist.terms import Durability


def test_power_cut_may_leave_a_hole_behind_the_last_forced_batch(tmp_path):
    """Unforced frames reach the disk in any order: what follows the hole is gone, no more."""
    folder = tmp_path / "folder"
    store, _ = open_store(folder, unix_s=1)
    store.write([persist(slot_record("kept", 1))])
    begin = (folder / "store.db-wal").stat().st_size
    for version in range(1, 8):
        store.write([persist(slot_record("later", version), durability=Durability.OS)])
    copy = tmp_path / "copy"
    shutil.copytree(folder, copy)
    store.close()
    flip(copy / "store.db-wal", begin + FRAME_BYTES + 30)
    assert f"damaged at byte {begin + FRAME_BYTES}" in str(refusal(copy))
    after_power_cut(copy)
    found = {record.slot.entity: record.version for record in reopened(copy).slots}
    assert found == {"kept": 1, "later": 1}


def test_power_cut_may_take_any_of_the_unforced_frames(tmp_path):
    """40 seeded subsets of the frames behind the last forced batch: a prefix from there on."""
    folder = tmp_path / "folder"
    store, _ = open_store(folder, unix_s=1)
    store.write([persist(slot_record("e", 1))])
    begin = (folder / "store.db-wal").stat().st_size
    for version in range(2, 9):
        records = [slot_record(f"{name}{version}", version) for name in "ab"]
        store.write([persist(slot_record("e", version), *records, durability=Durability.OS)])
    shutil.copytree(folder, tmp_path / "cut")
    store.close()
    log = (tmp_path / "cut" / "store.db-wal").read_bytes()
    rng = random.Random(8)
    reached = set()
    for _ in range(40):
        copy = tmp_path / "copy"
        shutil.copytree(tmp_path / "cut", copy)
        spoilt = bytearray(log)
        for offset in range(begin, len(log), FRAME_BYTES):
            if rng.random() < 0.2:
                spoilt[offset : offset + FRAME_BYTES] = bytes(FRAME_BYTES)
        (copy / "store.db-wal").write_bytes(spoilt)
        after_power_cut(copy)
        found = {record.slot.entity: record.version for record in reopened(copy).slots}
        last = found["e"]
        later = {f"{name}{version}": version for name in "ab" for version in range(2, last + 1)}
        assert found == {"e": last} | later
        reached.add(last)
        shutil.rmtree(copy)
    assert len(reached) > 3


def torn_unnoticed(folder, *, after):
    """Tear the last frame of page 1 behind a batch so that its checksum holds: stale page counts."""
    log = folder / "store.db-wal"
    raw = bytearray(log.read_bytes())
    frames = range(frames_of(folder) - 1, -1, -1)
    first_page = (
        frame_offset(n) for n in frames if raw[frame_offset(n) :][:4] == (1).to_bytes(4, "big")
    )
    begin = next(first_page) + 24
    assert begin > after
    for offset, change in ((28, -1), (32, 1), (36, 1)):
        place = slice(begin + offset, begin + offset + 4)
        raw[place] = ((int.from_bytes(raw[place], "big") + change) % 2**32).to_bytes(4, "big")
    log.write_bytes(raw)


@pytest.mark.parametrize("durability", [Durability.OS, Durability.DURABLE])
def test_commit_that_was_torn_without_a_wrong_checksum_goes_after_a_power_cut(
    tmp_path, durability, caplog
):
    """SQLite's sum misses three neighbouring words: unforced commits go, forced ones refuse."""
    folder = tmp_path / "folder"
    store, _ = open_store(folder, unix_s=1)
    store.write([persist(slot_record("forced", 1))])
    for number in range(4):
        store.write([persist(slot_record(f"small{number}", 1), durability=Durability.OS)])
    before = (folder / "store.db-wal").stat().st_size
    store.write([persist(slot_record("large", 1, size=30_000), durability=durability)])
    copy = tmp_path / "copy"
    shutil.copytree(folder, copy)
    store.close()
    torn_unnoticed(copy, after=before)
    assert check_wal(copy / "store.db-wal").damaged_at is None
    same_boot = tmp_path / "same-boot"
    shutil.copytree(copy, same_boot)
    assert "is damaged" in str(refusal(same_boot))
    after_power_cut(copy)
    if durability is Durability.DURABLE:
        with pytest.raises(StoreError, match="is damaged"):
            open_store(copy, unix_s=1)
        assert not list(copy.glob("trial*"))
        return
    entities = {record.slot.entity for record in reopened(copy).slots}
    assert entities == {"forced", *(f"small{number}" for number in range(4))}
    assert f"commits from byte {before} on: 1" in caplog.text
    assert not list(copy.glob("trial*"))


def test_first_commit_of_a_log_may_be_the_torn_one(tmp_path, monkeypatch):
    """After a checkpoint the log begins anew over its older generation: the database alone is left."""
    monkeypatch.setattr(store_module, "LOG_BYTES", 60_000)
    folder = tmp_path / "folder"
    store, _ = open_store(folder, unix_s=1)
    for number in range(8):
        store.write([persist(slot_record(f"forced{number}", 1, size=9_000))])
    store.rest()
    store.write([persist(slot_record("large", 1, size=30_000), durability=Durability.OS)])
    copy = tmp_path / "copy"
    shutil.copytree(folder, copy)
    store.close()
    log = copy / "store.db-wal"
    assert len(commit_ends(log)) == 1
    os.truncate(log, commit_ends(log)[0])  # what follows is of the older generation
    torn_unnoticed(copy, after=0)
    after_power_cut(copy)
    found = {record.slot.entity for record in reopened(copy).slots}
    assert found == {f"forced{number}" for number in range(8)}
