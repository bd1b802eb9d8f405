"""Reads a store at the start of a shard and refuses anything that is not intact.

Remains of a crash are no damage: a torn tail of the log, drafts and orphans among the blobs.  After
a power cut (only possible if the system has rebooted since), unforced data may be missing too:
holes in the log behind the last durable batch, and bodies of `os` data, which come back as null
with the reason `LOST`, also in history.

At the start it checks every row, the existence and length of every file, and the content of files
with newest states or prepared writes; after a power cut, the content of all unforced files.
History may be much longer, so its other files are checked when their content is first requested
(`Datum.fault`).  All files are mapped at the start, which reads nothing and keeps no descriptor: a
body stays readable after its file is deleted.
"""

from __future__ import annotations

import logging
from contextlib import closing
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import msgpack

from enact_dist.core.protocol.records import Recovered, SlotRecord
from enact_dist.link.folder.blobs import Blob, DamagedBlobError, Mapped
from enact_dist.link.folder.folder import refuse
from enact_dist.link.store.fields import DamagedRowError
from enact_dist.link.store.rows import (
    Key,
    RowKind,
    RowOrder,
    StoredSlot,
    cause_key,
    prepared_writes,
    read_cause,
    read_epoch,
    read_lock,
    read_order,
    read_prepared,
    read_record,
    read_slot,
    read_slot_key,
    read_write_key,
    row_checksum,
)
from enact_dist.link.store.states import State, States
from enact_dist.terms import NullReason

if TYPE_CHECKING:
    from collections.abc import Generator, Iterable
    from pathlib import Path

    from enact_dist.core.protocol.datum import LockId, Slot
    from enact_dist.core.protocol.messages import Cause
    from enact_dist.core.protocol.records import AuditRecord
    from enact_dist.link.store.database import DatabaseRow
    from enact_dist.link.store.media import BodySource, RowSource

_UNREADABLE: Final = (
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

_log = logging.getLogger("enact.store")


@dataclass(slots=True)
class Contents:
    """The content of a store's database, by key.

    Attributes:
        recovered: The records; `epoch` is the stored one, 0 in a new folder.
        ids: Row ids by key.
        states: The rows of states of slots and of prepared writes.
        records: The records of these rows.
        orders: When the states of a slot were set, and their rows.
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
    orders: dict[Slot, list[tuple[RowOrder, Key]]] = field(default_factory=dict)
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


def read_contents(source: RowSource, path: Path | str) -> Contents:
    """Read and check all rows, and separate newest states from history.

    Raises:
        StoreError: A row is damaged, or names a missing row.
    """
    with closing(_checked(source, path)) as rows:  # a cursor left open would lock a database
        return gather(rows, path)


def _checked(source: RowSource, path: Path | str) -> Generator[CheckedRow, None, None]:
    for row in source.rows():
        yield check_row(row, path)


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
    except _UNREADABLE as damage:
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
    contents = Contents()
    for row in rows:
        if contents.ids.setdefault(row.key, row.id) != row.id:
            refuse(path, f"is damaged in row {row.id}: it repeats row {contents.ids[row.key]}")
        contents.batch = max(contents.batch, row.batch)
        _place(row.key, row.holds, contents)
    try:
        for slot, states in contents.orders.items():
            _sort_states(slot, sorted(states), contents)
        for key, cause in contents.states.causes.items():
            if cause not in contents.causes:
                raise DamagedRowError(f"the cause of {contents.records[key].slot} is missing")
            one = contents.records[key]  # `replace` would take three times as long
            contents.records[key] = SlotRecord(
                one.slot,
                one.version,
                one.stamp_ns,
                one.datum,
                one.null_reason,
                cause=contents.causes[cause],
            )
    except DamagedRowError as damage:
        refuse(path, f"is damaged: {damage}")
    return contents


def _place(key: Key, holds: Any, contents: Contents) -> None:
    match key.kind:
        case RowKind.SLOT:
            order, found = holds
            _take_state(key, found, contents)
            contents.orders.setdefault(found[0].slot, []).append((order, key))
        case RowKind.EPOCH:
            contents.recovered.epoch = holds
        case RowKind.ENDED:
            contents.ended[holds.session] = holds.wall_ns
        case RowKind.CAUSE:
            name, contents.causes[name] = holds
        case RowKind.PREPARED_WRITE:
            _take_state(key, holds, contents)
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


def _take_state(
    key: Key, found: tuple[SlotRecord, Blob | None, Key | None], contents: Contents
) -> None:
    contents.records[key], blob, cause = found
    if blob is not None:
        contents.states.name_blob(key, blob)
    if cause is not None:
        contents.states.name_cause(key, cause)


def _sort_states(slot: Slot, rows: list[tuple[RowOrder, Key]], contents: Contents) -> None:
    """Find out which of a slot's rows, oldest first, is its newest state; the rest is history."""
    _, key = rows.pop()
    newest = contents.records[key]
    contents.states.newest[slot] = State(key, newest.version, newest.volatile)
    if not rows:
        return
    history = {contents.records[key].version: key for _, key in rows}
    if len(history) < len(rows) or any(contents.records[key].volatile for _, key in rows):
        raise DamagedRowError(f"the history of {slot} contradicts itself")
    contents.states.history[slot] = history


def read_blobs(contents: Contents, blobs: BodySource, *, power_cut: bool) -> None:
    """Map every blob file and assign the bodies to states; see above for the checks.

    Raises:
        StoreError: A file is missing or damaged, and a power cut does not explain it.
        OSError: As the system reports it.
    """
    states = contents.states
    history = {key for rows in states.history.values() for key in rows.values()}
    whole = {
        blob.name
        for key, blob in states.blobs.items()
        if key not in history or (power_cut and not blob.synced)
    }
    files: dict[str, Mapped | DamagedBlobError] = {}
    for key, blob in list(states.blobs.items()):
        record = contents.records[key]
        if record.datum is None:
            continue
        file = files.get(blob.name)
        if file is None:
            file = files[blob.name] = _mapped(blobs, blob, whole=blob.name in whole)
        if isinstance(file, Mapped):
            datum = replace(record.datum, body=file.body, fault=file.fault)
            contents.records[key] = replace(record, datum=datum)
            continue
        if blob.synced or not power_cut:
            refuse(
                blobs.place(blob.name),
                f"holds {record.slot}, version {record.version}, and cannot be used: {file}",
            )
        _log.warning("%s was lost in a power cut: %s", record.slot, file)
        states.unname_blob(states.blobs.pop(key))
        lost = replace(record, datum=None, null_reason=NullReason.LOST.name)
        contents.records[key] = contents.lost[key] = lost


def _mapped(blobs: BodySource, blob: Blob, *, whole: bool) -> Mapped | DamagedBlobError:
    try:
        return blobs.map(blob, whole=whole)
    except DamagedBlobError as damage:
        return damage


def put_together(contents: Contents, path: Path | str) -> None:
    """Return states, operator actions and prepared locks in the form of the core.

    Raises:
        StoreError: A prepared lock lacks some of its writes.
    """
    states, recovered = contents.states, contents.recovered
    recovered.slots = [contents.records[state.key] for state in states.newest.values()]
    recovered.history = [
        contents.records[rows[version]]
        for _, rows in sorted(states.history.items())
        for version in sorted(rows)
    ]
    recovered.audit = [act for _, act in sorted(contents.acts.items())]
    writes: dict[LockId, dict[Slot, SlotRecord]] = {lock: {} for lock in contents.prepared}
    for key, record in contents.records.items():
        if key.kind is RowKind.PREPARED_WRITE:
            lock, slot = read_write_key(key)
            writes.setdefault(lock, {})[slot] = record
    for lock, found in writes.items():
        try:
            prepared = read_prepared(*contents.prepared[lock], found)
        except (*_UNREADABLE, KeyError) as damage:
            refuse(path, f"is damaged: the prepared lock {lock} cannot be read ({damage})")
        recovered.prepared.append(prepared)
        states.prepared[lock] = dict(prepared_writes(prepared))
