"""Records as rows: what is stored of each, as msgpack, under which key.

A row is (kind, key, body); a later row of the same kind and key replaces the one before.  Reading
is strict: a row that is not exactly what this module writes is damage, not a default.  Changing
what is written means a new `FORMAT` in `folder_lock`.
"""

from __future__ import annotations

import enum
import zlib
from typing import Final, NamedTuple, TypeVar

import msgpack

from enact_dist.core.datum import Datum, LockId, Position, Slot
from enact_dist.core.messages import AspectEntry, SlotVersion
from enact_dist.core.records import (
    AuditRecord,
    OutcomeRecord,
    SessionEnded,
    SessionRecord,
    SlotRecord,
    WorldRecord,
)
from enact_dist.link.blobs import Blob

T = TypeVar("T")

INLINE_BYTES_MAX: Final = 64 * 1024
"""Bodies up to this size live in their row, larger ones in a file of their own."""


class Kind(enum.IntEnum):
    """What a row is about.  The numbers are on disk."""

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


class Key(NamedTuple):
    """Identity of a row."""

    kind: Kind
    name: bytes


class DamagedRowError(Exception):
    """A row is not what this module writes; the message says which and how."""


EPOCH_KEY: Final = Key(Kind.EPOCH, b"")


def key_of(kind: Kind, *parts: object) -> Key:
    """Return the key of a row of `kind` about `parts`."""
    return Key(kind, pack(list(parts)))


def row_checksum(key: Key, batch: int, body: bytes) -> int:
    """Return the CRC-32 over everything that a row says."""
    head = b"%d %d %d " % (key.kind, batch, len(key.name))
    return zlib.crc32(body, zlib.crc32(key.name, zlib.crc32(head)))


def pack(value: object) -> bytes:
    """Return a value as it is stored."""
    packed: bytes = msgpack.packb(value, use_bin_type=True)
    return packed


# ---------------------------------------------------------------- writing


def epoch_body(epoch: int) -> bytes:
    """Return the row of the shard's epoch."""
    return pack([epoch])


def session_row(record: SessionRecord) -> tuple[Key, bytes]:
    """Return the row of a session."""
    return key_of(Kind.SESSION, record.session), pack([record.ttl_ns])


def ended_row(record: SessionEnded) -> tuple[Key, bytes]:
    """Return the row of a session that ended."""
    return key_of(Kind.ENDED, record.session), pack([record.wall_ns])


def world_row(record: WorldRecord) -> tuple[Key, bytes]:
    """Return the row of a world context."""
    return key_of(Kind.WORLD, record.name), pack([])


def aspect_row(entry: AspectEntry) -> tuple[Key, bytes]:
    """Return the row of an aspect."""
    return key_of(Kind.ASPECT, entry.name), pack([entry.fingerprint, entry.durability])


def outcome_row(record: OutcomeRecord) -> tuple[Key, bytes]:
    """Return the row of a lane's newest outcome."""
    lock = record.lock
    versions = [[*entry.slot, entry.version] for entry in record.versions]
    return outcome_key(lock.session, lock.lane), pack([lock.seq, *record.position, versions])


def outcome_key(session: str, lane: int) -> Key:
    """Return where a lane's newest outcome stands."""
    return key_of(Kind.OUTCOME, session, lane)


def audit_row(record: AuditRecord, *, batch: int, number: int) -> tuple[Key, bytes]:
    """Return the row of an operator's act; `batch` and `number` in it keep acts apart."""
    return key_of(Kind.AUDIT, batch, number), pack([record.wall_ns, record.text, record.kind])


def slot_key(slot: Slot) -> Key:
    """Return where a slot's state stands."""
    return key_of(Kind.SLOT, *slot)


def slot_body(record: SlotRecord, blob: Blob | None) -> bytes:
    """Return the row of a slot; `blob` is where its body went, None if it goes into the row."""
    if record.volatile:
        return pack([])
    datum = record.datum
    if datum is None:
        return pack([record.version, record.stamp_ns, record.null_reason, None])
    place = bytes(datum.body) if blob is None else list(blob)
    return pack(
        [
            record.version,
            record.stamp_ns,
            record.null_reason,
            [datum.encoding, datum.stamp_ns, place],
        ]
    )


# ---------------------------------------------------------------- reading


class StoredSlot(NamedTuple):
    """A slot's row as read: its record, and where its body is if not in the row.

    With a blob the record's datum has an empty body still.
    """

    record: SlotRecord
    blob: Blob | None


def read_epoch(body: bytes) -> int:
    """Read the row of the epoch."""
    fields = Fields(body)
    return fields.last(int)


def read_session(key: Key, body: bytes) -> SessionRecord:
    """Read the row of a session."""
    return SessionRecord(Fields(key.name).last(str), Fields(body).last(int))


def read_ended(key: Key, body: bytes) -> SessionEnded:
    """Read the row of a session that ended."""
    return SessionEnded(Fields(key.name).last(str), Fields(body).last(int))


def read_world(key: Key) -> str:
    """Read the row of a world context."""
    return Fields(key.name).last(str)


def read_aspect(key: Key, body: bytes) -> AspectEntry:
    """Read the row of an aspect."""
    fields = Fields(body)
    return AspectEntry(Fields(key.name).last(str), fields.next(str), fields.last(str))


def read_outcome(key: Key, body: bytes) -> OutcomeRecord:
    """Read the row of an outcome."""
    names, fields = Fields(key.name), Fields(body)
    lock = LockId(names.next(str), names.last(int), fields.next(int))
    position = Position(fields.next(int), fields.next(str))
    versions = [Fields(entry) for entry in fields.last(list)]
    return OutcomeRecord(
        lock, position, tuple(SlotVersion(_slot(entry), entry.last(int)) for entry in versions)
    )


def read_audit(body: bytes) -> AuditRecord:
    """Read the row of an operator's act."""
    fields = Fields(body)
    return AuditRecord(fields.next(int), fields.next(str), fields.last(str))


def read_slot(key: Key, body: bytes) -> StoredSlot:
    """Read the row of a slot."""
    names = Fields(key.name)
    slot = _slot(names)
    names.end()
    fields = Fields(body)
    if fields.empty:
        return StoredSlot(SlotRecord(slot, 0, 0, None, "", volatile=True), None)
    version, stamp_ns, reason = fields.next(int), fields.next(int), fields.next(str)
    packed = fields.last(object)
    if packed is None:
        return StoredSlot(SlotRecord(slot, version, stamp_ns, None, reason), None)
    fields = Fields(packed)
    encoding, datum_stamp_ns, place = fields.next(bytes), fields.next(int), fields.last(object)
    blob = None
    if isinstance(place, bytes):
        datum = Datum(encoding, place, len(place), datum_stamp_ns)
    else:
        fields = Fields(place)
        blob = Blob(fields.next(str), fields.next(int), fields.next(int), fields.last(bool))
        datum = Datum(encoding, b"", blob.size, datum_stamp_ns)
    return StoredSlot(SlotRecord(slot, version, stamp_ns, datum, reason), blob)


def _slot(fields: Fields) -> Slot:
    return Slot(fields.next(str), fields.next(str), fields.next(str))


class Fields:
    """The fields of a packed list, each asked for with its type, in order and to the end."""

    __slots__ = ("_fields", "_next")

    def __init__(self, packed: object) -> None:
        fields = msgpack.unpackb(packed) if isinstance(packed, bytes) else packed
        if not isinstance(fields, list):
            raise DamagedRowError(f"a list was expected, found {fields!r:.80}")
        self._fields: list[object] = fields
        self._next = 0

    @property
    def empty(self) -> bool:
        """Whether there is no field at all."""
        return not self._fields

    def next(self, asked: type[T]) -> T:
        """Take the next field, which must be of this type."""
        if self._next >= len(self._fields):
            raise DamagedRowError(f"field {self._next + 1} of {self._fields!r:.80} is missing")
        found = self._fields[self._next]
        if not isinstance(found, asked):
            raise DamagedRowError(f"{asked.__name__} was expected, found {found!r:.80}")
        self._next += 1
        return found

    def last(self, asked: type[T]) -> T:
        """Take the next field, which must be the last."""
        found = self.next(asked)
        self.end()
        return found

    def end(self) -> None:
        """Make sure that nothing is left."""
        if self._next != len(self._fields):
            raise DamagedRowError(f"{self._fields!r:.80} has more than {self._next} fields")
