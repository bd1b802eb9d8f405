"""Stored forms of records: msgpack bodies and their keys.

A row is (kind, key, body); a later row of the same kind and key replaces the earlier one.  Only
states of slots have individual keys: a replaced state that stays as history keeps its row, and the
latest row of a slot is its newest state.

A cause is part of the row of its state.  If it made several states, it has its own row, which
theirs name: otherwise a commit of n data would store n² versions.

A prepared lock has one row for the lock and one per write.  The latter has the form of a slot's
row, so that large bodies go to files as usual.  The rows of one lock are added and deleted
together.

Reading is strict: a row that differs from what this module writes is damage, not a default.  Any
change of the stored form needs a new `FORMAT` in `link.folder.lock`; so does a change of the
annotations of a record that is stored here (`link.store.fields`).
"""

from __future__ import annotations

import enum
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any, Final, NamedTuple

from enact_dist.core.protocol.datum import Datum, LockId, Slot
from enact_dist.core.protocol.messages import AspectEntry, Cause, WriteItem
from enact_dist.core.protocol.records import (
    AspectForgotten,
    AuditRecord,
    DecisionRecord,
    ForcedRecord,
    KeptRecord,
    OutcomeRecord,
    PreparedRecord,
    SessionEnded,
    SessionRecord,
    SlotRecord,
    WorldDropped,
    WorldRecord,
)
from enact_dist.link.folder.blobs import Blob
from enact_dist.link.store.fields import DamagedRowError, RowLayout, pack, unpack

ROW_BODY_BYTES_MAX: Final = 64 * 1024
"""Bodies up to this size live in their row, larger ones in a file of their own."""


class RowKind(enum.IntEnum):
    """The subject of a row.  The numbers are stored on disk."""

    EPOCH = 0
    SESSION = 1
    ENDED = 2
    WORLD = 3
    ASPECT = 4
    SLOT = 5
    OUTCOME = 6
    AUDIT = 7
    PREPARED = 8
    PREPARED_WRITE = 9
    DECISION = 10
    FORCED = 11
    DROPPED = 12
    KEPT = 13
    CAUSE = 14
    FORGOTTEN = 15


class Key(NamedTuple):
    """Identity of a row."""

    kind: RowKind
    name: bytes


class RowOrder(NamedTuple):
    """When a row was written: the batch, and the position in it."""

    batch: int
    number: int


EPOCH_KEY: Final = Key(RowKind.EPOCH, b"")


def key_of(kind: RowKind, *parts: object) -> Key:
    """Return the key of a row of `kind` made of `parts`."""
    return Key(kind, pack(parts))


def row_checksum(key: Key, batch: int, body: bytes) -> int:
    """Return the CRC-32 over all of a row."""
    head = b"%d %d %d " % (key.kind, batch, len(key.name))
    return zlib.crc32(body, zlib.crc32(key.name, zlib.crc32(head)))


# ---------------------------------------------------------------- records with one row


class _Table(NamedTuple):
    """How records of one type are stored.

    Attributes:
        kind: That of their rows.
        layout: Their fields: those of the key, then those of the body.
        names: How many are in the key; 0: the key is the order of the row.
    """

    kind: RowKind
    layout: RowLayout[Any]
    names: int


_TABLES: Final = {
    SessionRecord: _Table(RowKind.SESSION, RowLayout(SessionRecord, open_end=True), 1),
    SessionEnded: _Table(RowKind.ENDED, RowLayout(SessionEnded), 1),
    WorldRecord: _Table(RowKind.WORLD, RowLayout(WorldRecord), 1),
    WorldDropped: _Table(RowKind.DROPPED, RowLayout(WorldDropped, open_end=True), 1),
    AspectEntry: _Table(RowKind.ASPECT, RowLayout(AspectEntry, without="reads", open_end=True), 1),
    AspectForgotten: _Table(RowKind.FORGOTTEN, RowLayout(AspectForgotten, open_end=True), 1),
    KeptRecord: _Table(RowKind.KEPT, RowLayout(KeptRecord), 1),
    OutcomeRecord: _Table(RowKind.OUTCOME, RowLayout(OutcomeRecord), 2),
    PreparedRecord: _Table(RowKind.PREPARED, RowLayout(PreparedRecord, without="writes"), 3),
    DecisionRecord: _Table(RowKind.DECISION, RowLayout(DecisionRecord), 3),
    ForcedRecord: _Table(RowKind.FORCED, RowLayout(ForcedRecord), 3),
    AuditRecord: _Table(RowKind.AUDIT, RowLayout(AuditRecord, open_end=True), 0),
}
_BY_KIND: Final = {table.kind: table for table in _TABLES.values()}


def row_of(record: object) -> tuple[Key, bytes]:
    """Return the row of a record; a prepared lock's is without its writes, an action's has no key.

    Raises:
        KeyError: Records of this type have no row, or several.
    """
    kind, layout, names = _TABLES[type(record)]
    fields = layout.fields(record)
    return Key(kind, pack(fields[:names])), pack(fields[names:])


def read_record(key: Key, body: bytes) -> Any:
    """Return the record of a row.

    Raises:
        DamagedRowError: It is none that `row_of` has made.
    """
    _, layout, names = _BY_KIND[key.kind]
    found = unpack(key.name) if names else []
    if len(found) != names:
        raise DamagedRowError(f"a key of {names} fields was expected, found {found}")
    return layout.read(found + unpack(body))


def epoch_body(epoch: int) -> bytes:
    """Return the row of the shard's epoch."""
    return pack([epoch])


def read_epoch(body: bytes) -> int:
    """Read the row of the epoch."""
    return _EPOCH.read(unpack(body))[0]


# ---------------------------------------------------------------- states of slots


class _StoredDatum(NamedTuple):
    encoding: bytes
    stamp_ns: int
    place: bytes | Blob


class _StoredState(NamedTuple):
    version: int
    stamp_ns: int
    null_reason: str
    datum: _StoredDatum | None
    cause: RowOrder | Cause | None


class _SlotKey(NamedTuple):
    slot: Slot
    batch: int
    number: int


class _WriteKey(NamedTuple):
    lock: LockId
    slot: Slot


class StoredSlot(NamedTuple):
    """A slot's row as read: its record, and where its other parts are.

    With a blob, the body of the record's datum is still empty; with a shared cause, the record has
    none yet.
    """

    record: SlotRecord
    blob: Blob | None = None
    shared_cause: RowOrder | None = None


_EPOCH: Final = RowLayout(tuple[int])
_ORDER: Final = RowLayout(RowOrder)
_LOCK: Final = RowLayout(LockId)
_CAUSE: Final = RowLayout(Cause)
_STATE: Final = RowLayout(_StoredState)
_SLOT_KEY: Final = RowLayout(_SlotKey)
_WRITE_KEY: Final = RowLayout(_WriteKey)


def slot_body(record: SlotRecord, blob: Blob | None, shared_cause: RowOrder | None = None) -> bytes:
    """Return the row of a slot's state.

    Args:
        record: The state.
        blob: The file of its body; None: the body goes into the row.
        shared_cause: The row of its cause; None: the cause, if any, goes into this row.
    """
    if record.volatile:
        return pack([])
    place: object = None
    cause: object = shared_cause
    if (datum := record.datum) is not None:
        place = [datum.encoding, datum.stamp_ns, blob or bytes(datum.body)]
    if record.cause is not None and shared_cause is None:
        cause = _CAUSE.fields(record.cause)
    return pack([record.version, record.stamp_ns, record.null_reason, place, cause])


def read_slot(slot: Slot, body: bytes) -> StoredSlot:
    """Read the row of a slot's state."""
    fields = unpack(body)
    if not fields:
        return StoredSlot(SlotRecord(slot, 0, 0, None, "", volatile=True))
    version, stamp_ns, reason, stored, cause = _STATE.read(fields)
    datum = blob = shared = None
    if stored is not None:
        encoding, captured_ns, place = stored
        if isinstance(place, Blob):
            datum, blob = Datum(encoding, b"", place.size, captured_ns), place
        else:
            datum = Datum(encoding, place, len(place), captured_ns)
    if isinstance(cause, RowOrder):
        cause, shared = None, cause
    return StoredSlot(SlotRecord(slot, version, stamp_ns, datum, reason, cause=cause), blob, shared)


def slot_key(slot: Slot, order: RowOrder) -> Key:
    """Return the key of the state of a slot that was set then."""
    return key_of(RowKind.SLOT, *slot, *order)


def read_slot_key(key: Key) -> tuple[Slot, RowOrder]:
    """Return which slot's state a row holds, and when it was set."""
    slot, batch, number = _SLOT_KEY.read(unpack(key.name))
    return slot, RowOrder(batch, number)


def cause_key(order: RowOrder) -> Key:
    """Return the key of a cause that several states share."""
    return key_of(RowKind.CAUSE, *order)


def cause_body(cause: Cause) -> bytes:
    """Return the row of a cause that several states share."""
    return pack(_CAUSE.fields(cause))


def read_cause(body: bytes) -> Cause:
    """Read the row of a cause that several states share."""
    return _CAUSE.read(unpack(body))


def read_order(key: Key) -> RowOrder:
    """Return when an operator's action or a shared cause was stored."""
    return _ORDER.read(unpack(key.name))


# ---------------------------------------------------------------- prepared locks


def prepared_writes(record: PreparedRecord) -> Iterator[tuple[Key, SlotRecord]]:
    """Yield the writes of a prepared lock as slots, volatile ones with their data too."""
    for write, (slot, version) in zip(record.writes, record.versions, strict=True):
        key = key_of(RowKind.PREPARED_WRITE, *record.lock, *slot)
        yield key, SlotRecord(slot, version, record.stamp_ns, write.datum, "")


def read_prepared(key: Key, body: bytes, writes: Mapping[Slot, SlotRecord]) -> PreparedRecord:
    """Read the row of a prepared lock, with its writes, which were read before."""
    record: PreparedRecord = read_record(key, body)
    if {entry.slot for entry in record.versions} != set(writes):
        raise DamagedRowError("writes of this prepared lock are missing")
    items = tuple(WriteItem(slot, writes[slot].datum) for slot, _ in record.versions)
    return replace(record, writes=items)


def read_lock(key: Key) -> LockId:
    """Return the lock in the key of a prepared lock."""
    return _LOCK.read(unpack(key.name))


def read_write_key(key: Key) -> tuple[LockId, Slot]:
    """Return the lock that a prepared write belongs to, and its slot."""
    return _WRITE_KEY.read(unpack(key.name))
