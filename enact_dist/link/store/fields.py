"""The elements of rows: msgpack lists, read field by field, and parts shared by many rows.

Reading is strict: anything other than what is written here is damage, not a default.
"""

from __future__ import annotations

import reprlib
from typing import TypeVar

import msgpack

from enact_dist.core.protocol.datum import LockId, Slot, Token
from enact_dist.core.protocol.messages import Cause, DatumRead, SlotVersion

T = TypeVar("T")


class DamagedRowError(Exception):
    """A row differs from what a store writes; the message says how."""


def pack(value: object) -> bytes:
    """Return a value in its stored form."""
    packed: bytes = msgpack.packb(value, use_bin_type=True)
    return packed


class Fields:
    """The fields of a packed list, each read with its type, in order and to the end."""

    __slots__ = ("_fields", "_next")

    def __init__(self, packed: object) -> None:
        fields = msgpack.unpackb(packed) if isinstance(packed, bytes) else packed
        if not isinstance(fields, list):
            raise DamagedRowError(f"a list was expected, found {reprlib.repr(fields)}")
        self._fields: list[object] = fields
        self._next = 0

    @property
    def empty(self) -> bool:
        """Whether the list has no fields."""
        return not self._fields

    @property
    def at_end(self) -> bool:
        """Whether all fields were read."""
        return self._next == len(self._fields)

    def next(self, asked: type[T]) -> T:
        """Read the next field, which must be of this type."""
        if self._next >= len(self._fields):
            raise DamagedRowError(
                f"field {self._next + 1} of {reprlib.repr(self._fields)} is missing"
            )
        found = self._fields[self._next]
        if not isinstance(found, asked):
            raise DamagedRowError(f"{asked.__name__} was expected, found {reprlib.repr(found)}")
        self._next += 1
        return found

    def last(self, asked: type[T]) -> T:
        """Read the next field, which must be the last."""
        found = self.next(asked)
        self.end()
        return found

    def end(self) -> None:
        """Ensure that no field is left."""
        if not self.at_end:
            raise DamagedRowError(f"{reprlib.repr(self._fields)} has more than {self._next} fields")

    def slot(self) -> Slot:
        """Read the three fields of a slot."""
        return Slot(self.next(str), self.next(str), self.next(str))

    def lock(self) -> LockId:
        """Read the three fields of a lock's identity."""
        return LockId(self.next(str), self.next(int), self.next(int))

    def token(self) -> Token:
        """Read a field that holds a token."""
        fields = Fields(self.next(list))
        return Token(fields.next(int), fields.last(int))

    def versions(self) -> tuple[SlotVersion, ...]:
        """Read a field that holds versions of slots."""
        entries = [Fields(entry) for entry in self.next(list)]
        return tuple(SlotVersion(entry.slot(), entry.last(int)) for entry in entries)


def packed_versions(versions: tuple[SlotVersion, ...]) -> list[object]:
    """Return versions of slots in their stored form."""
    return [[*entry.slot, entry.version] for entry in versions]


def packed_cause(cause: Cause) -> list[object]:
    """Return a version's cause in its stored form."""
    return [
        *cause.lock,
        cause.kind,
        cause.actor,
        cause.host,
        cause.pid,
        cause.stamp_ns,
        cause.held_ns,
        [[*read.slot, read.version, read.stamp_ns] for read in cause.reads],
        cause.reads_left_out,
        packed_versions(cause.writes),
    ]


def read_cause(packed: object) -> Cause:
    """Read a version's cause."""
    fields = Fields(packed)
    lock, kind, actor, host = fields.lock(), fields.next(str), fields.next(str), fields.next(str)
    pid, stamp_ns, held_ns = fields.next(int), fields.next(int), fields.next(int)
    entries = [Fields(entry) for entry in fields.next(list)]
    reads = tuple(DatumRead(one.slot(), one.next(int), one.last(int)) for one in entries)
    left_out, writes = fields.next(int), fields.versions()
    fields.end()
    return Cause(lock, kind, actor, host, pid, stamp_ns, held_ns, reads, left_out, writes)
