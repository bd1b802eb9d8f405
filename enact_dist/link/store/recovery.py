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
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Final

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


def read_contents(source: RowSource, path: Path | str) -> Contents:
    """Read and check all rows, and separate newest states from history.

    Raises:
        StoreError: A row is damaged, or names a missing row.
    """
    contents = Contents()
    for row in source.rows():
        try:
            _read_row(row, contents)
        except _UNREADABLE as damage:
            refuse(path, f"is damaged in row {row.id}: {damage}")
    try:
        for slot, rows in contents.orders.items():
            _sort_states(slot, sorted(rows), contents)
        for key, cause in contents.states.causes.items():
            if cause not in contents.causes:
                raise DamagedRowError(f"the cause of {contents.records[key].slot} is missing")
            contents.records[key] = replace(contents.records[key], cause=contents.causes[cause])
    except DamagedRowError as damage:
        refuse(path, f"is damaged: {damage}")
    return contents


def _read_row(row: DatabaseRow, contents: Contents) -> None:
    key = Key(RowKind(row.kind), row.key)
    if row_checksum(key, row.batch, row.body) != row.crc:
        raise DamagedRowError("its checksum is wrong")
    if contents.ids.setdefault(key, row.id) != row.id:
        raise DamagedRowError(f"it repeats row {contents.ids[key]}")
    contents.batch = max(contents.batch, row.batch)
    match key.kind:
        case RowKind.EPOCH:
            contents.recovered.epoch = read_epoch(row.body)
        case RowKind.ENDED:
            ended = read_record(key, row.body)
            contents.ended[ended.session] = ended.wall_ns
        case RowKind.SLOT:
            slot, order = read_slot_key(key)
            _take_state(key, read_slot(slot, row.body), contents)
            contents.orders.setdefault(slot, []).append((order, key))
        case RowKind.CAUSE:
            contents.causes[cause_key(read_order(key))] = read_cause(row.body)
        case RowKind.PREPARED_WRITE:
            _take_state(key, read_slot(read_write_key(key)[1], row.body), contents)
        case RowKind.PREPARED:
            contents.prepared[read_lock(key)] = (key, row.body)
        case RowKind.AUDIT:
            contents.acts[read_order(key)] = read_record(key, row.body)
        case _:
            getattr(contents.recovered, _LISTS[key.kind]).append(read_record(key, row.body))


def _take_state(key: Key, found: StoredSlot, contents: Contents) -> None:
    contents.records[key] = found.record
    if found.blob is not None:
        contents.states.name_blob(key, found.blob)
    if found.shared_cause is not None:
        contents.states.name_cause(key, cause_key(found.shared_cause))


def _sort_states(slot: Slot, rows: list[tuple[RowOrder, Key]], contents: Contents) -> None:
    """Find out which of a slot's rows, oldest first, is its newest state; the rest is history."""
    _, key = rows.pop()
    newest = contents.records[key]
    contents.states.newest[slot] = State(key, newest.version, newest.volatile)
    history = {contents.records[key].version: key for _, key in rows}
    if len(history) < len(rows) or any(contents.records[key].volatile for _, key in rows):
        raise DamagedRowError(f"the history of {slot} contradicts itself")
    if history:
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
