"""Rows of commits over shards: what is prepared here, and what was decided here and not told yet.

Also what an operator has aborted here while the deciding shard was away.

A prepared lock is one row about the lock and one row per write, in the form of a slot's row, so
that large bodies go to files like all others.  The rows of one lock come and go together.
"""

from __future__ import annotations

import reprlib
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from enact_dist.core.datum import LockId, Position, Slot, Token
from enact_dist.core.messages import Item, SlotVersion, WriteItem
from enact_dist.core.records import DecisionRecord, ForcedRecord, PreparedRecord, SlotRecord
from enact_dist.link.store_rows import DamagedRowError, Fields, Key, Kind, key_of, pack

if TYPE_CHECKING:
    from collections.abc import Mapping


def prepared_key(lock: LockId) -> Key:
    """Return where a prepared lock stands."""
    return key_of(Kind.PREPARED, *lock)


def prepared_row(record: PreparedRecord) -> tuple[Key, bytes]:
    """Return the row of a prepared lock, without its data."""
    body = [
        list(record.token),
        [list(item[:5]) for item in record.items],
        [[*entry.slot, entry.version] for entry in record.versions],
        record.stamp_ns,
        record.primary,
        list(record.primary_token),
    ]
    return prepared_key(record.lock), pack(body)


def prepared_writes(record: PreparedRecord) -> Iterator[tuple[Key, SlotRecord]]:
    """Yield the writes of a prepared lock as slots, volatile ones with their data too."""
    for write, (slot, version) in zip(record.writes, record.versions, strict=True):
        key = key_of(Kind.PREPARED_WRITE, *record.lock, *slot)
        yield key, SlotRecord(slot, version, record.stamp_ns, write.datum, "")


def read_prepared(key: Key, body: bytes, writes: Mapping[Slot, SlotRecord]) -> PreparedRecord:
    """Read the row of a prepared lock, with the writes that were read of it."""
    fields = Fields(body)
    token, items = _token(fields.next(list)), fields.next(list)
    versions = [_slot_version(entry) for entry in fields.next(list)]
    if {entry.slot for entry in versions} != set(writes):
        raise DamagedRowError("writes of this prepared lock are missing")
    return PreparedRecord(
        _lock(Fields(key.name)),
        token,
        tuple(_item(item) for item in items),
        tuple(WriteItem(entry.slot, writes[entry.slot].datum) for entry in versions),
        tuple(versions),
        fields.next(int),
        fields.next(str),
        _token(fields.last(list)),
    )


def read_prepared_lock(key: Key) -> LockId:
    """Return the lock of a prepared lock's row."""
    return _lock(Fields(key.name))


def lock_of_write(key: Key) -> LockId:
    """Return the lock that a prepared write belongs to."""
    fields = Fields(key.name)
    return LockId(fields.next(str), fields.next(int), fields.next(int))


def slot_of_write(key: Key) -> Key:
    """Return the key that the write's slot has, to read its row by."""
    fields = Fields(key.name)
    fields.next(str), fields.next(int), fields.next(int)
    return key_of(Kind.SLOT, fields.next(str), fields.next(str), fields.last(str))


def decision_key(lock: LockId) -> Key:
    """Return where a decision stands."""
    return key_of(Kind.DECISION, *lock)


def decision_row(record: DecisionRecord) -> tuple[Key, bytes]:
    """Return the row of a decision."""
    return decision_key(record.lock), pack([*record.position, list(record.participants)])


def read_decision(key: Key, body: bytes) -> DecisionRecord:
    """Read the row of a decision."""
    fields = Fields(body)
    position = Position(fields.next(int), fields.next(str))
    participants = fields.last(list)
    if not all(isinstance(shard, str) for shard in participants):
        raise DamagedRowError(f"names of shards were expected, found {reprlib.repr(participants)}")
    return DecisionRecord(_lock(Fields(key.name)), position, tuple(participants))


def forced_key(lock: LockId) -> Key:
    """Return where a lock stands that was aborted by hand."""
    return key_of(Kind.FORCED, *lock)


def forced_row(record: ForcedRecord) -> tuple[Key, bytes]:
    """Return the row of a lock that was aborted by hand."""
    slots = [list(slot) for slot in record.slots]
    return forced_key(record.lock), pack([record.primary, list(record.primary_token), slots])


def read_forced(key: Key, body: bytes) -> ForcedRecord:
    """Read the row of a lock that was aborted by hand."""
    fields = Fields(body)
    primary, token = fields.next(str), _token(fields.next(list))
    slots = tuple(_slot(entry) for entry in fields.last(list))
    return ForcedRecord(_lock(Fields(key.name)), primary, token, slots)


def _slot(packed: object) -> Slot:
    fields = Fields(packed)
    return Slot(fields.next(str), fields.next(str), fields.last(str))


def _lock(fields: Fields) -> LockId:
    return LockId(fields.next(str), fields.next(int), fields.last(int))


def _token(packed: list[Any]) -> Token:
    fields = Fields(packed)
    return Token(fields.next(int), fields.last(int))


def _item(packed: object) -> Item:
    fields = Fields(packed)
    access, context = fields.next(int), fields.next(str)
    return Item(access, context, fields.next(str), fields.next(str), fields.last(int))


def _slot_version(packed: object) -> SlotVersion:
    fields = Fields(packed)
    slot = Slot(fields.next(str), fields.next(str), fields.next(str))
    return SlotVersion(slot, fields.last(int))
