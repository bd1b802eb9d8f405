"""Puts the checked rows of a store together: newest states, their history, and all the rest.

Rows may come and go while they are put together, so that a standby has most of that behind it
before it takes a shard over.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import msgpack

from enact_dist.core.protocol.records import AuditRecord, Recovered, SlotRecord
from enact_dist.link.folder.folder import refuse
from enact_dist.link.store.fields import DamagedRowError
from enact_dist.link.store.rows import (
    Key,
    RowKind,
    RowOrder,
    StoredSlot,
    cause_key,
    read_cause,
    read_epoch,
    read_lock,
    read_order,
    read_record,
    read_slot,
    read_slot_key,
    read_write_key,
    row_checksum,
)
from enact_dist.link.store.states import State, States

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from enact_dist.core.protocol.datum import LockId, Slot
    from enact_dist.core.protocol.messages import Cause
    from enact_dist.link.folder.blobs import Blob
    from enact_dist.link.store.database import DatabaseRow

UNREADABLE: Final = (
    DamagedRowError,
    ValueError,
    TypeError,
    OverflowError,
    RecursionError,
    msgpack.UnpackException,
)
"""Exceptions that mean a damaged row; none of them is a system error."""

_LISTS: Final = {
    RowKind.SESSION: "sessions",
    RowKind.WORLD: "worlds",
    RowKind.DROPPED: "dropped",
    RowKind.ASPECT: "aspects",
    RowKind.FORGOTTEN: "forgotten",
    RowKind.KEPT: "kept",
    RowKind.OUTCOME: "outcomes",
    RowKind.DECISION: "decisions",
    RowKind.FORCED: "forced",
}
"""The lists of `Recovered` that rows go to as they are."""

_MANY: Final = frozenset((RowKind.SLOT, RowKind.CAUSE, RowKind.PREPARED_WRITE))
"""Kinds of rows that a store may have many of."""


@dataclass(slots=True)
class Contents:
    """The content of a store's database, by key.

    Attributes:
        recovered: The records; `epoch` is the stored one, 0 in a new folder.
        ids: Row ids by key.
        states: The rows of states of slots and of prepared writes.
        records: The records of these rows.
        orders: The rows of the states of a slot, and when these were set.
        causes: Causes with their own rows.
        acts: Operator actions, with their order.
        ended: When sessions with stored outcomes ended, wall clock in ns.
        prepared: Rows of prepared locks, still packed.
        lost: States whose unforced body was lost in a power cut, to be stored as null.
        batch: Number of the newest batch.
    """

    recovered: Recovered = field(default_factory=lambda: Recovered(epoch=0))
    ids: dict[Key, int] = field(default_factory=dict)
    states: States = field(default_factory=States)
    records: dict[Key, SlotRecord] = field(default_factory=dict)
    orders: dict[Slot, dict[Key, RowOrder]] = field(default_factory=dict)
    causes: dict[Key, Cause] = field(default_factory=dict)
    acts: dict[RowOrder, AuditRecord] = field(default_factory=dict)
    ended: dict[str, int] = field(default_factory=dict)
    prepared: dict[LockId, tuple[Key, bytes]] = field(default_factory=dict)
    lost: dict[Key, SlotRecord] = field(default_factory=dict)
    batch: int = 0


class CheckedRow(NamedTuple):
    """A row that was checked and read.

    Attributes:
        id: As stored; so are `batch` and `crc`.
        key: Identity of what it holds.
        holds: That, as `check_row` returns it for this kind of row.
    """

    id: int
    batch: int
    crc: int
    key: Key
    holds: Any


def check_row(row: DatabaseRow, path: Path | str) -> CheckedRow:
    """Check and read a row by itself; this takes most of the time of a start.

    Raises:
        StoreError: It is damaged.
    """
    try:
        key = Key(RowKind(row.kind), row.key)
        if row_checksum(key, row.batch, row.body) != row.crc:
            raise DamagedRowError("its checksum is wrong")
        return CheckedRow(row.id, row.batch, row.crc, key, _held_by(key, row.body))
    except UNREADABLE as damage:
        refuse(path, f"is damaged in row {row.id}: {damage}")


def _held_by(key: Key, body: bytes) -> Any:
    match key.kind:
        case RowKind.EPOCH:
            return read_epoch(body)
        case RowKind.SLOT:
            slot, order = read_slot_key(key)
            return order, _with_key(read_slot(slot, body))
        case RowKind.CAUSE:
            return cause_key(read_order(key)), read_cause(body)
        case RowKind.PREPARED_WRITE:
            return _with_key(read_slot(read_write_key(key)[1], body))
        case RowKind.PREPARED:
            return read_lock(key), body
        case RowKind.AUDIT:
            return read_order(key), read_record(key, body)
        case _:
            return read_record(key, body)


def gather(rows: Iterable[CheckedRow], path: Path | str) -> Contents:
    """Put rows together, oldest identity first, and separate newest states from history.

    Raises:
        StoreError: A row repeats another one, or names a missing row.
    """
    gathering = Gathering()
    for row in rows:
        gathering.put(row)
    return gathering.contents(path)


class Gathering:
    """Puts rows together as they come and go; what is together stays so.

    Causes and histories may contradict themselves until the last row is there: `settle` leaves
    these, `contents` refuses them.

    Attributes:
        repeated: The first row that repeats another one, and why that is wrong; once there is one,
            only a new gathering of all rows is right.
    """

    def __init__(self) -> None:
        self.repeated: tuple[int, str] | None = None
        self._found = Contents()
        self._others: dict[int, CheckedRow] = {}
        self._unsorted: dict[Slot, None] = {}
        self._without_cause: dict[Key, None] = {}
        self._gone_causes: set[Key] = set()

    def put(self, row: CheckedRow) -> None:
        """Take a row; the one that it replaces was dropped."""
        key, found = row.key, self._found
        found.batch = max(found.batch, row.batch)
        if key.kind not in _MANY:
            self._others[row.id] = row
            return
        self._name(row)
        if key.kind is RowKind.CAUSE:
            name, found.causes[name] = row.holds
            return
        state = row.holds
        if key.kind is RowKind.SLOT:
            order, state = row.holds
            slot = state[0].slot
            found.orders.setdefault(slot, {})[key] = order
            self._unsorted[slot] = None
        found.records[key], blob, cause = state
        if blob is not None:
            found.states.name_blob(key, blob)
        if cause is not None:
            found.states.name_cause(key, cause)
            self._without_cause[key] = None

    def drop(self, row: CheckedRow) -> None:
        """Forget a row that was put."""
        key, found = row.key, self._found
        if self._others.pop(row.id, None) is not None or self.repeated is not None:
            return
        del found.ids[key]
        if key.kind is RowKind.CAUSE:
            name = row.holds[0]
            del found.causes[name]
            self._gone_causes.add(name)
            return
        record, states = found.records.pop(key), found.states
        if key.kind is RowKind.SLOT:
            del found.orders[record.slot][key]
            self._unsorted[record.slot] = None
        if (blob := states.blobs.pop(key, None)) is not None:
            states.unname_blob(blob)
        if (cause := states.causes.pop(key, None)) is not None:
            states.unname_cause(cause)
            self._without_cause.pop(key, None)

    def _name(self, row: CheckedRow) -> None:
        ids = self._found.ids
        if ids.setdefault(row.key, row.id) != row.id and self.repeated is None:
            self.repeated = (row.id, f"it repeats row {ids[row.key]}")

    def settle(self) -> str:
        """Do what there is to do for the rows of now; return what contradicts itself, if any."""
        found, problem = self._found, ""
        if self.repeated is not None:
            return self.repeated[1]
        if self._gone_causes:
            named = found.states.causes.items()
            self._without_cause |= {key: None for key, name in named if name in self._gone_causes}
            self._gone_causes.clear()
        for key in list(self._without_cause):
            one, cause = found.records[key], found.causes.get(found.states.causes[key])
            if cause is None:
                problem = problem or f"the cause of {one.slot} is missing"
                continue
            del self._without_cause[key]  # `replace` would take three times as long
            found.records[key] = SlotRecord(
                one.slot, one.version, one.stamp_ns, one.datum, one.null_reason, cause=cause
            )
        unsorted, self._unsorted = self._unsorted, {}
        for slot in unsorted:
            if not _sort_states(slot, found):
                problem = problem or f"the history of {slot} contradicts itself"
                self._unsorted[slot] = None
        return problem

    def contents(self, path: Path | str) -> Contents:
        """Return all of it, to keep: nothing is put or dropped afterwards.

        Raises:
            StoreError: As `gather`.
        """
        found = self._found
        for _, row in sorted(self._others.items()):
            self._name(row)
            _place(row.key, row.holds, found)
        if self.repeated is not None:
            refuse(path, f"is damaged in row {self.repeated[0]}: {self.repeated[1]}")
        if problem := self.settle():
            refuse(path, f"is damaged: {problem}")
        return found


def _place(key: Key, holds: Any, contents: Contents) -> None:
    match key.kind:
        case RowKind.EPOCH:
            contents.recovered.epoch = holds
        case RowKind.ENDED:
            contents.ended[holds.session] = holds.wall_ns
        case RowKind.PREPARED:
            lock, body = holds
            contents.prepared[lock] = (key, body)
        case RowKind.AUDIT:
            order, contents.acts[order] = holds
        case _:
            getattr(contents.recovered, _LISTS[key.kind]).append(holds)


def _with_key(found: StoredSlot) -> tuple[SlotRecord, Blob | None, Key | None]:
    """Return a state with the row of its cause."""
    cause = None if found.shared_cause is None else cause_key(found.shared_cause)
    return found.record, found.blob, cause


def _sort_states(slot: Slot, contents: Contents) -> bool:
    """Find out which of a slot's rows is its newest state; the rest is history.

    Returns whether they agree with each other.
    """
    orders, states = contents.orders[slot], contents.states
    states.history.pop(slot, None)
    if not orders:
        del contents.orders[slot]
        states.newest.pop(slot, None)
        return True
    rows = sorted(orders, key=orders.__getitem__) if len(orders) > 1 else list(orders)
    key = rows.pop()
    newest = contents.records[key]
    states.newest[slot] = State(key, newest.version, newest.volatile)
    if not rows:
        return True
    states.history[slot] = history = {contents.records[key].version: key for key in rows}
    return len(history) == len(rows) and not any(contents.records[key].volatile for key in rows)


class Rows:
    """Rows of a shard, and what they are together.

    Attributes:
        by_id: The rows, by number.
        mutex: Held for each change.  Who stops the reader under it has the rows from then on.
    """

    def __init__(self) -> None:
        self.by_id: dict[int, CheckedRow] = {}
        self.mutex = threading.Lock()
        self._gathering: Gathering | None = Gathering()

    def put(self, row: CheckedRow) -> None:
        """Take a row, in place of the one of this number."""
        self.drop(row.id)
        self.together.put(row)
        self.by_id[row.id] = row

    def drop(self, number: int) -> None:
        """Forget a row; idempotent."""
        if number in self.by_id:
            self.together.drop(self.by_id[number])
            del self.by_id[number]

    @property
    def together(self) -> Gathering:
        """The rows together; made anew after `contents`."""
        if self._gathering is None:
            self._gathering = Gathering()
            for number in sorted(self.by_id):
                self._gathering.put(self.by_id[number])
        return self._gathering

    def contents(self, name: str) -> Contents:
        """Return what they are together.

        Raises:
            StoreError: As `gather`.
        """
        if self.together.repeated is not None:  # by a row that has gone since, if it is no damage
            self._gathering = None
        gathering, self._gathering = self.together, None
        return gathering.contents(name)
