"""Commits over shards in the store: what was prepared and decided comes back, whole."""

from pathlib import Path

import pytest

from enact_dist.core.protocol.datum import Datum, LockId, Position, Slot, Token
from enact_dist.core.protocol.messages import Item, SlotVersion, WriteItem
from enact_dist.core.protocol.records import (
    AuditRecord,
    DecisionDone,
    DecisionRecord,
    ForcedEnded,
    ForcedRecord,
    Persist,
    PreparedEnded,
    PreparedRecord,
    SlotRecord,
)
from enact_dist.errors import StoreError
from enact_dist.link.store.rows import RowKind, key_of
from enact_dist.link.store.store import open_store
from enact_dist.terms import Durability

LOCK = LockId("ann", 3, 4)
SMALL, LARGE, NULL = (Slot("online", name, "count") for name in ("small", "large", "null"))
BODY = bytes(range(256)) * 400  # over 64 KiB: a file of its own


def prepared(body=BODY):
    writes = (
        WriteItem(SMALL, Datum(b"t", b"1", 1, 5)),
        WriteItem(LARGE, Datum(b"t", body, len(body))),
        WriteItem(NULL, None),
    )
    items = (Item(2, "online", "*", "count", 0), Item(1, "online", "read", "mesh", 7))
    versions = tuple(SlotVersion(write.slot, 9 + i) for i, write in enumerate(writes))
    return PreparedRecord(LOCK, Token(1, 2), items, writes, versions, 77, "far", Token(3, 4))


def kept(folder, *records, durability=Durability.DURABLE):
    """Write records one after the other and return what the next start finds."""
    store, _ = open_store(folder, unix_s=1)
    for number, record in enumerate(records, 1):
        store.write([Persist(number, (record,), durability)])
        store.rest()
    store.close()
    store, recovered = open_store(folder, unix_s=2)
    store.close()
    return recovered


def blobs(folder):
    return list((folder / "blobs").iterdir())


@pytest.mark.parametrize("durability", [Durability.DURABLE, Durability.OS])
def test_prepared_lock_comes_back_with_its_data(tmp_path, durability):
    """Small, large and null writes, what is held, and who decides."""
    (found,) = kept(tmp_path, prepared(), durability=durability).prepared

    large = found.writes[1].datum
    assert bytes(large.body) == BODY
    assert found.writes[0] == prepared().writes[0]
    assert found.writes[2].datum is None
    assert (found.items, found.versions) == (prepared().items, prepared().versions)
    assert (found.token, found.primary, found.primary_token) == (Token(1, 2), "far", Token(3, 4))
    assert (found.lock, found.stamp_ns) == (LOCK, 77)


def test_prepared_writes_are_no_slots(tmp_path):
    """Nothing of it is visible before its end."""
    assert kept(tmp_path, prepared()).slots == []


def test_ended_lock_leaves_nothing(tmp_path):
    """Rows and files go with the decision."""
    recovered = kept(tmp_path, prepared(), PreparedEnded(LOCK))

    assert recovered.prepared == []
    assert blobs(tmp_path) == []


def test_lock_that_ends_after_a_restart_leaves_nothing(tmp_path):
    """The next start knows which rows and files belong to it."""
    kept(tmp_path, prepared())
    recovered = kept(tmp_path, PreparedEnded(LOCK))

    assert recovered.prepared == []
    assert blobs(tmp_path) == []


def test_lock_that_begins_and_ends_in_one_batch_leaves_its_slots(tmp_path):
    """A batch may hold a whole life: its result counts."""
    store, _ = open_store(tmp_path, unix_s=1)
    record = prepared()
    slot = SlotRecord(LARGE, 10, 80, record.writes[1].datum, "")
    store.write(
        [
            Persist(1, (record,), Durability.DURABLE),
            Persist(2, (slot, PreparedEnded(LOCK)), Durability.DURABLE),
        ]
    )
    store.close()
    store, recovered = open_store(tmp_path, unix_s=2)
    store.close()

    assert recovered.prepared == []
    assert [(found.slot, bytes(found.datum.body)) for found in recovered.slots] == [(LARGE, BODY)]
    assert len(blobs(tmp_path)) == 1


@pytest.mark.parametrize("restarts", [False, True])
def test_large_body_of_a_prepared_lock_becomes_its_slot_s(tmp_path, restarts):
    """It is written once: the file that was promised is the one that stays."""
    store, _ = open_store(tmp_path, unix_s=1)
    record = prepared()
    store.write([Persist(1, (record,), Durability.DURABLE)])
    promised = blobs(tmp_path)
    if restarts:
        store.close()
        store, recovered = open_store(tmp_path, unix_s=2)
        (record,) = recovered.prepared
    slot = SlotRecord(LARGE, 10, 80, record.writes[1].datum, "")
    store.write([Persist(2, (slot, PreparedEnded(LOCK)), Durability.DURABLE)])
    store.rest()
    store.close()
    store, recovered = open_store(tmp_path, unix_s=3)
    store.close()

    assert [(found.slot, bytes(found.datum.body)) for found in recovered.slots] == [(LARGE, BODY)]
    assert blobs(tmp_path) == promised


def test_file_taken_over_goes_when_the_same_batch_replaces_its_slot(tmp_path):
    """The end of one lock and the commit of the next may come together."""
    store, _ = open_store(tmp_path, unix_s=1)
    record = prepared()
    store.write([Persist(1, (record,), Durability.DURABLE)])
    slot = SlotRecord(LARGE, 10, 80, record.writes[1].datum, "")
    store.write(
        [
            Persist(2, (slot, PreparedEnded(LOCK)), Durability.DURABLE),
            Persist(3, (SlotRecord(LARGE, 11, 81, None, "DELETED"),), Durability.DURABLE),
        ]
    )
    store.rest()

    assert blobs(tmp_path) == []
    store.close()


def test_body_that_was_not_forced_is_forced_for_a_durable_end(tmp_path, monkeypatch):
    """Else a power cut could take what was promised to outlast it."""
    store, _ = open_store(tmp_path, unix_s=1)
    record = prepared()
    store.write([Persist(1, (record,), Durability.OS)])
    promised, forced = blobs(tmp_path), []
    monkeypatch.setattr(
        "enact_dist.link.folder.blobs.os.fdatasync",
        lambda descriptor: forced.append(Path(f"/proc/self/fd/{descriptor}").readlink()),
    )
    slot = SlotRecord(LARGE, 10, 80, record.writes[1].datum, "")
    store.write([Persist(2, (slot, PreparedEnded(LOCK)), Durability.DURABLE)])
    store.rest()

    assert blobs(tmp_path) == promised
    assert forced == promised
    store.close()


def test_missing_data_of_a_prepared_lock_are_refused(tmp_path):
    """A promise that cannot be kept stops the shard, with the file's name."""
    kept(tmp_path, prepared())
    blobs(tmp_path)[0].unlink()

    with pytest.raises(StoreError, match="cannot be used"):
        open_store(tmp_path, unix_s=3)


@pytest.mark.parametrize("body", [b"", b"\xc1", b"\x91\x01\x01", b"\x96\x92\xff\xff"])
def test_row_of_a_prepared_lock_that_cannot_be_read_is_refused_by_name(tmp_path, monkeypatch, body):
    """As any other damaged row, though it is read last: a `StoreError`, not msgpack's own."""
    monkeypatch.setattr(
        "enact_dist.link.store.batch.row_of",
        lambda record: (key_of(RowKind.PREPARED, *record.lock), body),
    )
    with pytest.raises(StoreError, match=r"the prepared lock ann\.3\.4 cannot be read"):
        kept(tmp_path, prepared())


def test_decision_comes_back_until_it_is_done(tmp_path):
    """Who has to be told is remembered as long as anybody has to."""
    decision = DecisionRecord(LOCK, Position(5, "near"), ("far", "farther"))

    assert kept(tmp_path, decision).decisions == [decision]
    assert kept(tmp_path, DecisionDone(LOCK)).decisions == []


def test_abort_by_hand_is_given_back_until_its_primary_has_answered(tmp_path):
    """What was aborted by hand and what an operator did outlive the process."""
    forced = ForcedRecord(LOCK, "far", Token(3, 4), (SMALL, NULL))
    acts = (AuditRecord(5, "given up", "forced"), AuditRecord(6, "torn", "alarm"))

    found = kept(tmp_path, forced, *acts)
    assert found.forced == [forced]
    assert sorted(found.audit, key=lambda act: act.wall_ns) == list(acts)

    found = kept(tmp_path, ForcedEnded(LOCK))
    assert found.forced == []
    assert len(found.audit) == 2
