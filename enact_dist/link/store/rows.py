"""Stored forms of records: msgpack bodies and their keys.

A row is (kind, key, body); a later row of the same kind and key replaces the earlier one.  Only
states of slots have individual keys: a replaced state that stays as history keeps its row, and the
latest row of a slot is its newest state.

A cause is part of the row of its state.  If it made several states, it has its own row, which
theirs name: otherwise a commit of n data would store n² versions.

Reading is strict: a row that differs from what this module writes is damage, not a default.  Any
change of the stored form needs a new `FORMAT` in `link.folder.lock`.
"""

from __future__ import annotations

import enum
import zlib
from typing import TYPE_CHECKING, Final, NamedTuple

from enact_dist.core.protocol.datum import Datum, LockId, Position, Slot
from enact_dist.core.protocol.messages import AspectEntry
from enact_dist.core.protocol.records import (
    AspectForgotten,
    AuditRecord,
    KeptRecord,
    OutcomeRecord,
    SessionEnded,
    SessionRecord,
    SlotRecord,
    WorldDropped,
    WorldRecord,
)
from enact_dist.link.folder.blobs import Blob
from enact_dist.link.store.fields import (
    DamagedRowError,
    Fields,
    pack,
    packed_cause,
    packed_versions,
    read_cause,
)

if TYPE_CHECKING:
    from enact_dist.core.protocol.messages import Cause

INLINE_BYTES_MAX: Final = 64 * 1024
"""Bodies up to this size live in their row, larger ones in a file of their own."""


class Kind(enum.IntEnum):
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

    kind: Kind
    name: bytes


class Order(NamedTuple):
    """When a row was written: the batch, and the position in it."""

    batch: int
    number: int


EPOCH_KEY: Final = Key(Kind.EPOCH, b"")


def key_of(kind: Kind, *parts: object) -> Key:
    """Return the key of a row of `kind` made of `parts`."""
    return Key(kind, pack(list(parts)))


def row_checksum(key: Key, batch: int, body: bytes) -> int:
    """Return the CRC-32 over all of a row."""
    head = b"%d %d %d " % (key.kind, batch, len(key.name))
    return zlib.crc32(body, zlib.crc32(key.name, zlib.crc32(head)))


# ---------------------------------------------------------------- writing


def epoch_body(epoch: int) -> bytes:
    """Return the row of the shard's epoch."""
    return pack([epoch])


def session_row(record: SessionRecord) -> tuple[Key, bytes]:
    """Return the row of a session."""
    return key_of(Kind.SESSION, record.session), pack([record.ttl_ns, record.identity])


def ended_row(record: SessionEnded) -> tuple[Key, bytes]:
    """Return the row of an ended session."""
    return key_of(Kind.ENDED, record.session), pack([record.wall_ns])


def world_row(record: WorldRecord) -> tuple[Key, bytes]:
    """Return the row of a world context."""
    return key_of(Kind.WORLD, record.name), pack([record.source, record.at_ns])


def dropped_row(record: WorldDropped) -> tuple[Key, bytes]:
    """Return the row of a dropped world context."""
    return key_of(Kind.DROPPED, record.name), pack([record.version_base, *_moved(record)])


def aspect_row(entry: AspectEntry) -> tuple[Key, bytes]:
    """Return the row of an aspect."""
    older = [list(entry.older)] if entry.older else []
    figures = [entry.retention, entry.age_ns, entry.size]
    row = [entry.fingerprint, entry.durability, *figures, *older]
    return key_of(Kind.ASPECT, entry.name), pack(row)


def forgotten_row(record: AspectForgotten) -> tuple[Key, bytes]:
    """Return the row of a purged aspect."""
    body = [record.version_base, record.at_ns, *_moved(record)]
    return key_of(Kind.FORGOTTEN, record.name), pack(body)


def _moved(record: WorldDropped | AspectForgotten) -> list[list[list[object]]]:
    return [[list(entry) for entry in record.entity_bases]] if record.entity_bases else []


def kept_row(record: KeptRecord) -> tuple[Key, bytes | None]:
    """Return the row of the versions that a label pins; None: there are none."""
    body = pack([packed_versions(record.versions)]) if record.versions else None
    return key_of(Kind.KEPT, record.label), body


def outcome_row(record: OutcomeRecord) -> tuple[Key, bytes]:
    """Return the row of a lane's newest outcome."""
    lock = record.lock
    body = [lock.seq, *record.position, packed_versions(record.versions)]
    return outcome_key(lock.session, lock.lane), pack(body)


def outcome_key(session: str, lane: int) -> Key:
    """Return the key of a lane's newest outcome."""
    return key_of(Kind.OUTCOME, session, lane)


def audit_row(record: AuditRecord, order: Order) -> tuple[Key, bytes]:
    """Return the row of an operator's action; `order` makes its key unique."""
    return key_of(Kind.AUDIT, *order), pack(
        [record.wall_ns, record.text, record.kind, record.identity]
    )


def slot_key(slot: Slot, order: Order) -> Key:
    """Return the key of the state of a slot that was set then."""
    return key_of(Kind.SLOT, *slot, *order)


def cause_key(order: Order) -> Key:
    """Return the key of a cause that several states share."""
    return key_of(Kind.CAUSE, *order)


def cause_body(cause: Cause) -> bytes:
    """Return the row of a cause that several states share."""
    return pack(packed_cause(cause))


def slot_body(record: SlotRecord, blob: Blob | None, shared_cause: Order | None = None) -> bytes:
    """Return the row of a slot's state.

    Args:
        record: The state.
        blob: The file of its body; None: the body goes into the row.
        shared_cause: The row of its cause; None: the cause, if any, goes into this row.
    """
    if record.volatile:
        return pack([])
    cause: object = None
    if shared_cause is not None:
        cause = list(shared_cause)
    elif record.cause is not None:
        cause = packed_cause(record.cause)
    place: object = None
    datum = record.datum
    if datum is not None:
        bytes_at = bytes(datum.body) if blob is None else list(blob)
        place = [datum.encoding, datum.stamp_ns, bytes_at]
    return pack([record.version, record.stamp_ns, record.null_reason, place, cause])


# ---------------------------------------------------------------- reading


class StoredSlot(NamedTuple):
    """A slot's row as read: its record, and where its other parts are.

    With a blob, the body of the record's datum is still empty; with a shared cause, the record has
    none yet.
    """

    record: SlotRecord
    blob: Blob | None = None
    shared_cause: Order | None = None


def read_epoch(body: bytes) -> int:
    """Read the row of the epoch."""
    return Fields(body).last(int)


def read_session(key: Key, body: bytes) -> SessionRecord:
    """Read the row of a session."""
    fields = Fields(body)
    ttl_ns = fields.next(int)
    return SessionRecord(Fields(key.name).last(str), ttl_ns, _identity(fields))


def _identity(fields: Fields) -> str:
    """Read the last field, an identity, which format 3 lacks."""
    return "" if fields.at_end else fields.last(str)


def read_ended(key: Key, body: bytes) -> SessionEnded:
    """Read the row of an ended session."""
    return SessionEnded(Fields(key.name).last(str), Fields(body).last(int))


def read_world(key: Key, body: bytes) -> WorldRecord:
    """Read the row of a world context."""
    fields = Fields(body)
    return WorldRecord(Fields(key.name).last(str), fields.next(str), fields.last(int))


def read_dropped(key: Key, body: bytes) -> WorldDropped:
    """Read the row of a dropped world context."""
    name, fields = Fields(key.name).last(str), Fields(body)
    base, moved = fields.next(int), _moved_here(fields)
    return WorldDropped(name, base, tuple((one.next(str), one.last(int)) for one in moved))


def read_forgotten(key: Key, body: bytes) -> AspectForgotten:
    """Read the row of a purged aspect."""
    name, fields = Fields(key.name).last(str), Fields(body)
    base, at_ns, moved = fields.next(int), fields.next(int), _moved_here(fields)
    entity_bases = ((one.next(str), one.next(int), one.last(int)) for one in moved)
    return AspectForgotten(name, base, at_ns, tuple(entity_bases))


def _moved_here(fields: Fields) -> list[Fields]:
    """Read the optional last field: first versions of entities that were moved here."""
    if fields.at_end:
        return []
    moved = [Fields(entry) for entry in fields.last(list)]
    if not moved:
        raise DamagedRowError("bases of entities were expected, found none")
    return moved


def read_aspect(key: Key, body: bytes) -> AspectEntry:
    """Read the row of an aspect."""
    fields = Fields(body)
    entry = AspectEntry(
        Fields(key.name).last(str),
        fields.next(str),
        fields.next(str),
        fields.next(int),
        fields.next(int),
        fields.next(int),
    )
    if fields.at_end:
        return entry
    older = fields.last(list)
    if not older or not all(isinstance(one, str) for one in older):
        raise DamagedRowError(f"older types of aspect {entry.name} were expected, found {older}")
    return entry._replace(older=tuple(older))


def read_kept(key: Key, body: bytes) -> KeptRecord:
    """Read the row of the versions that a label pins."""
    fields = Fields(body)
    versions = fields.versions()
    fields.end()
    return KeptRecord(Fields(key.name).last(str), versions)


def read_outcome(key: Key, body: bytes) -> OutcomeRecord:
    """Read the row of an outcome."""
    names, fields = Fields(key.name), Fields(body)
    lock = LockId(names.next(str), names.last(int), fields.next(int))
    position = Position(fields.next(int), fields.next(str))
    versions = fields.versions()
    fields.end()
    return OutcomeRecord(lock, position, versions)


def read_audit(body: bytes) -> AuditRecord:
    """Read the row of an operator's action."""
    fields = Fields(body)
    wall_ns, text, kind = fields.next(int), fields.next(str), fields.next(str)
    return AuditRecord(wall_ns, text, kind, _identity(fields))


def read_slot_key(key: Key) -> tuple[Slot, Order]:
    """Return which slot's state a row holds, and when it was set."""
    fields = Fields(key.name)
    return fields.slot(), Order(fields.next(int), fields.last(int))


def read_order(key: Key) -> Order:
    """Return when an operator's action or a shared cause was stored."""
    fields = Fields(key.name)
    return Order(fields.next(int), fields.last(int))


def read_slot(slot: Slot, body: bytes) -> StoredSlot:
    """Read the row of a slot's state."""
    fields = Fields(body)
    if fields.empty:
        return StoredSlot(SlotRecord(slot, 0, 0, None, "", volatile=True))
    version, stamp_ns, reason = fields.next(int), fields.next(int), fields.next(str)
    datum, blob = _datum(fields.next(object))
    cause, shared_cause = _cause(fields.last(object))
    record = SlotRecord(slot, version, stamp_ns, datum, reason, cause=cause)
    return StoredSlot(record, blob, shared_cause)


def _datum(packed: object) -> tuple[Datum | None, Blob | None]:
    if packed is None:
        return None, None
    fields = Fields(packed)
    encoding, stamp_ns, place = fields.next(bytes), fields.next(int), fields.last(object)
    if isinstance(place, bytes):
        return Datum(encoding, place, len(place), stamp_ns), None
    fields = Fields(place)
    blob = Blob(fields.next(str), fields.next(int), fields.next(int), fields.last(bool))
    return Datum(encoding, b"", blob.size, stamp_ns), blob


def _cause(packed: object) -> tuple[Cause | None, Order | None]:
    if packed is None:
        return None, None
    if isinstance(packed, list) and len(packed) == len(Order._fields):
        fields = Fields(packed)
        return None, Order(fields.next(int), fields.last(int))
    return read_cause(packed), None
