"""Rows of commits over several shards: prepared here, or decided here and not yet passed on.

Also locks that an operator aborted here while the deciding shard was away.

A prepared lock has one row for the lock and one per write.  The latter has the form of a slot's
row, so that large bodies go to files as usual.  The rows of one lock are added and deleted
together.
"""

from __future__ import annotations

import reprlib
from collections.abc import Iterator
from typing import TYPE_CHECKING

from enact_dist.core.protocol.datum import LockId, Position, Slot
from enact_dist.core.protocol.messages import Item, WriteItem
from enact_dist.core.protocol.records import (
    DecisionRecord,
    ForcedRecord,
    PreparedRecord,
    SlotRecord,
)
from enact_dist.link.store.fields import (
    DamagedRowError,
    Fields,
    pack,
    packed_cause,
    packed_versions,
    read_cause,
)
from enact_dist.link.store.rows import Key, Kind, key_of

if TYPE_CHECKING:
    from collections.abc import Mapping


def prepared_key(lock: LockId) -> Key:
    """Return the key of a prepared lock."""
    return key_of(Kind.PREPARED, *lock)


def prepared_row(record: PreparedRecord) -> tuple[Key, bytes]:
    """Return the row of a prepared lock, without its data."""
    body = [
        list(record.token),
        [list(item) for item in record.items],
        packed_versions(record.versions),
        record.stamp_ns,
        record.primary,
        list(record.primary_token),
        None if record.cause is None else packed_cause(record.cause),
    ]
    return prepared_key(record.lock), pack(body)


def prepared_writes(record: PreparedRecord) -> Iterator[tuple[Key, SlotRecord]]:
    """Yield the writes of a prepared lock as slots, volatile ones with their data too."""
    for write, (slot, version) in zip(record.writes, record.versions, strict=True):
        key = key_of(Kind.PREPARED_WRITE, *record.lock, *slot)
        yield key, SlotRecord(slot, version, record.stamp_ns, write.datum, "")


def read_prepared(key: Key, body: bytes, writes: Mapping[Slot, SlotRecord]) -> PreparedRecord:
    """Read the row of a prepared lock, with its writes, which were read before."""
    fields = Fields(body)
    token, items, versions = fields.token(), fields.next(list), fields.versions()
    if {entry.slot for entry in versions} != set(writes):
        raise DamagedRowError("writes of this prepared lock are missing")
    stamp_ns, primary, primary_token = fields.next(int), fields.next(str), fields.token()
    cause = fields.last(object)
    return PreparedRecord(
        read_lock(key),
        token,
        tuple(_item(item) for item in items),
        tuple(WriteItem(entry.slot, writes[entry.slot].datum) for entry in versions),
        versions,
        stamp_ns,
        primary,
        primary_token,
        None if cause is None else read_cause(cause),
    )


def read_lock(key: Key) -> LockId:
    """Return the lock in the key of a prepared lock, a decision or a manual abort."""
    fields = Fields(key.name)
    lock = fields.lock()
    fields.end()
    return lock


def read_write_key(key: Key) -> tuple[LockId, Slot]:
    """Return the lock that a prepared write belongs to, and its slot."""
    fields = Fields(key.name)
    lock, slot = fields.lock(), fields.slot()
    fields.end()
    return lock, slot


def decision_key(lock: LockId) -> Key:
    """Return the key of a decision."""
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
    return DecisionRecord(read_lock(key), position, tuple(participants))


def forced_key(lock: LockId) -> Key:
    """Return the key of a manually aborted lock."""
    return key_of(Kind.FORCED, *lock)


def forced_row(record: ForcedRecord) -> tuple[Key, bytes]:
    """Return the row of a manually aborted lock."""
    slots = [list(slot) for slot in record.slots]
    return forced_key(record.lock), pack([record.primary, list(record.primary_token), slots])


def read_forced(key: Key, body: bytes) -> ForcedRecord:
    """Read the row of a manually aborted lock."""
    fields = Fields(body)
    primary, token = fields.next(str), fields.token()
    slots = tuple(_slot(entry) for entry in fields.last(list))
    return ForcedRecord(read_lock(key), primary, token, slots)


def _slot(packed: object) -> Slot:
    fields = Fields(packed)
    slot = fields.slot()
    fields.end()
    return slot


def _item(packed: object) -> Item:
    fields = Fields(packed)
    access, context = fields.next(int), fields.next(str)
    entity, aspect, known = fields.next(str), fields.next(str), fields.next(int)
    return Item(access, context, entity, aspect, known, fields.next(int), fields.last(bool))
