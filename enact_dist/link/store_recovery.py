"""Reads a data folder at the start of a shard and refuses whatever is not as it was left.

Refusing costs an operator minutes; serving from a damaged store costs trust in every datum.  So
each check ends in a `StoreError` that names the file and the way out.  What a crash may leave is no
damage: a torn tail of the log, drafts and orphans among the blobs.  What a power cut may leave in
addition (only if the system has started anew since) is what was never forced to the disk: holes
in the log behind the last durable batch, and the bodies of `os` data, which then come back as
null with the reason `LOST`.
"""

from __future__ import annotations

import logging
import shutil
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Final, NamedTuple, NoReturn

import msgpack

from enact_dist.core.records import Recovered, SlotRecord, WorldRecord
from enact_dist.errors import StoreError
from enact_dist.link.blobs import Blob, BlobFolder, DamagedBlobError, allow_mapped
from enact_dist.link.store_database import Database, DatabaseRow, is_damage
from enact_dist.link.store_mark import Mark, boot_id, read_mark
from enact_dist.link.store_prepared import (
    lock_of_write,
    read_decision,
    read_forced,
    read_prepared,
    read_prepared_lock,
    slot_of_write,
)
from enact_dist.link.store_rows import (
    EPOCH_KEY,
    DamagedRowError,
    Key,
    Kind,
    read_aspect,
    read_audit,
    read_ended,
    read_epoch,
    read_outcome,
    read_session,
    read_slot,
    read_world,
    row_checksum,
)
from enact_dist.link.wal_check import check_wal
from enact_dist.terms import NullReason

if TYPE_CHECKING:
    from pathlib import Path

    from enact_dist.core.datum import LockId, Slot

DATABASE_FILE: Final = "store.db"
LOG_FILE: Final = "store.db-wal"
BLOB_FOLDER: Final = "blobs"
_REFUSED_SUFFIX: Final = ".refused"

_RESTORE: Final = (
    "restore the whole folder from a backup, or give the shard an empty folder and start without"
    " its data"
)

_UNREADABLE: Final = (
    DamagedRowError,
    ValueError,
    TypeError,
    OverflowError,
    RecursionError,
    msgpack.UnpackException,
)
"""What reading a row may raise: none of it is an error of the system."""

_log = logging.getLogger("enact.store")


@dataclass(slots=True)
class Contents:
    """What a store's database holds, by key.

    Attributes:
        recovered: The records; `epoch` is the stored one, 0 in a new folder.
        ids: Row ids by key.
        blobs: Blob files by the key of their slot.
        ended: When sessions ended whose outcomes are kept still, wall clock in ns.
        kept: States of slots, and prepared ones.
        prepared: Rows of prepared locks, still packed.
        lost: Slots whose unforced body a power cut took, to be stored as null.
        batch: Number of the newest batch.
    """

    recovered: Recovered = field(default_factory=lambda: Recovered(epoch=0))
    ids: dict[Key, int] = field(default_factory=dict)
    blobs: dict[Key, Blob] = field(default_factory=dict)
    ended: dict[str, int] = field(default_factory=dict)
    lost: dict[Key, SlotRecord] = field(default_factory=dict)
    kept: dict[Key, SlotRecord] = field(default_factory=dict)
    prepared: dict[LockId, tuple[Key, bytes]] = field(default_factory=dict)
    batch: int = 0


class Found(NamedTuple):
    """What a folder says of itself before its database is opened."""

    mark: Mark | None
    is_new: bool
    power_cut: bool
    """Whether the system has started anew since the store was last opened."""

    @property
    def is_first(self) -> bool:
        """Whether no start before this one ever came to its end: nothing was acknowledged."""
        return self.mark.is_first if self.mark is not None else self.is_new


def refuse(path: Path, found: str, remedy: str = _RESTORE) -> NoReturn:
    """Raise the `StoreError` of a damaged file.

    Raises:
        StoreError: Always.
    """
    raise StoreError(f"{path} {found}; the shard does not start: {remedy}", path=str(path))


def look_at(folder: Path) -> Found:
    """Find out what kind of folder this is.

    Raises:
        StoreError: Data are there and their database is not.
        OSError: As the system reports it.
    """
    mark = read_mark(folder)
    database = folder / DATABASE_FILE
    is_new = not database.exists() or database.stat().st_size == 0
    if is_new:
        log = folder / LOG_FILE
        has_log = log.exists() and log.stat().st_size > 0
        has_mark = mark is not None and not mark.is_first
        if has_mark or has_log or _has_blobs(folder):
            refuse(database, "is missing or empty, but the folder has been in use")
    return Found(mark, is_new, mark is not None and mark.boot != boot_id())


def _has_blobs(folder: Path) -> bool:
    blobs = folder / BLOB_FOLDER
    return blobs.exists() and any(blobs.iterdir())


def check_log(folder: Path, *, power_cut: bool) -> None:
    """Refuse a log that is damaged in its middle.

    Raises:
        StoreError: It is damaged, and no power cut explains it.
        OSError: As the system reports it.
    """
    log = folder / LOG_FILE
    verdict = check_wal(log)
    if verdict.damaged_at is None:
        return
    if power_cut:
        _log.warning(
            "%s: what was written from byte %d on and not forced to the disk is gone after the"
            " system's restart",
            log,
            verdict.damaged_at,
        )
        return
    refuse(
        log,
        f"is damaged at byte {verdict.damaged_at}, and commits that were acknowledged follow",
        "restore the whole folder from a backup; or, to go on without what was written from there"
        f" on, keep a copy of the folder, delete its file 'mark', and cut the log with 'truncate -s"
        f" {verdict.damaged_at} {log}'",
    )


def open_database(folder: Path, found: Found) -> tuple[Database, Contents]:
    """Open the database and read all of it.

    Raises:
        StoreError: It is damaged, or lacks what was acknowledged.
        OSError: As the system reports it.
        sqlite3.Error: As SQLite reports it, except for damage.
    """
    path = folder / DATABASE_FILE
    database = None
    try:
        database = Database(path)
        problems = database.problems(may_be_empty=found.is_first)
        if problems:
            refuse(path, f"is damaged: {'; '.join(problems)}")
        if found.is_first:
            database.make_table()
        contents = read_contents(database, path)
        _check_complete(folder, contents, found)
    except BaseException as failure:
        if database is not None:
            database.close()
        if is_damage(failure):
            refuse(path, f"is damaged: {failure}")
        raise
    return database, contents


def _check_complete(folder: Path, contents: Contents, found: Found) -> None:
    """Compare what was read with what the mark says was acknowledged."""
    in_use = contents.ids or not found.is_first or _has_blobs(folder)
    if EPOCH_KEY not in contents.ids and in_use:
        refuse(folder / DATABASE_FILE, "holds no epoch: rows are missing")
    if found.mark is None or contents.batch >= found.mark.needed():
        return
    log = folder / LOG_FILE
    readable = check_wal(log)
    if log.exists() and log.stat().st_size:
        # Closing the database cuts the log to what SQLite could read; the whole is evidence.
        shutil.copyfile(log, log.with_name(log.name + _REFUSED_SUFFIX))
    refuse(
        log,
        f"is cut or damaged from byte {readable.end} on: batch {found.mark.needed()} was"
        f" acknowledged, the last one that can be read is {contents.batch}",
        "restore the whole folder from a backup; or, to go on without the missing commits, keep a"
        f" copy of the folder and delete {folder / 'mark'}",
    )


def read_contents(database: Database, path: Path) -> Contents:
    """Read all rows, each checked.

    Raises:
        StoreError: A row is damaged.
    """
    contents = Contents()
    for row in database.rows():
        try:
            _read_row(row, contents)
        except _UNREADABLE as damage:
            refuse(path, f"is damaged in row {row.id}: {damage}")
    return contents


def _read_row(row: DatabaseRow, contents: Contents) -> None:
    key = Key(Kind(row.kind), row.key)
    if row_checksum(key, row.batch, row.body) != row.crc:
        raise DamagedRowError("its checksum is wrong")
    if contents.ids.setdefault(key, row.id) != row.id:
        raise DamagedRowError(f"it says the same as row {contents.ids[key]}")
    contents.batch = max(contents.batch, row.batch)
    recovered = contents.recovered
    match key.kind:
        case Kind.EPOCH:
            recovered.epoch = read_epoch(row.body)
        case Kind.SESSION:
            recovered.sessions.append(read_session(key, row.body))
        case Kind.ENDED:
            ended = read_ended(key, row.body)
            contents.ended[ended.session] = ended.wall_ns
        case Kind.WORLD:
            recovered.worlds.append(WorldRecord(read_world(key)))
        case Kind.ASPECT:
            recovered.aspects.append(read_aspect(key, row.body))
        case Kind.SLOT | Kind.PREPARED_WRITE:
            of_slot = key if key.kind is Kind.SLOT else slot_of_write(key)
            slot = read_slot(of_slot, row.body)
            contents.kept[key] = slot.record
            if slot.blob is not None:
                contents.blobs[key] = slot.blob
        case Kind.PREPARED:
            contents.prepared[read_prepared_lock(key)] = (key, row.body)
        case Kind.DECISION:
            recovered.decisions.append(read_decision(key, row.body))
        case Kind.OUTCOME:
            recovered.outcomes.append(read_outcome(key, row.body))
        case Kind.FORCED:
            recovered.forced.append(read_forced(key, row.body))
        case Kind.AUDIT:
            recovered.audit.append(read_audit(row.body))


def read_blobs(contents: Contents, blobs: BlobFolder, *, power_cut: bool) -> None:
    """Check every blob file and give the slots their bodies.

    Raises:
        StoreError: A file is missing or damaged, and no power cut explains it.
        OSError: As the system reports it.
    """
    allow_mapped(len(contents.blobs))
    for key, record in contents.kept.items():
        blob = contents.blobs.get(key)
        if blob is None or record.datum is None:
            continue
        try:
            body = blobs.read(blob)
        except DamagedBlobError as damage:
            if blob.synced or not power_cut:
                refuse(
                    blobs.folder / blob.name,
                    f"holds {record.slot}, version {record.version}, and cannot be used: {damage}",
                )
            _log.warning("%s is lost with the power: %s", record.slot, damage)
            lost = replace(record, datum=None, null_reason=NullReason.LOST.name)
            contents.kept[key] = contents.lost[key] = lost
        else:
            contents.kept[key] = replace(record, datum=replace(record.datum, body=body))


def put_together(contents: Contents, path: Path) -> None:
    """Give back what is kept as the core knows it, bodies included.

    Raises:
        StoreError: A prepared lock lacks some of its writes.
    """
    writes: dict[LockId, dict[Slot, SlotRecord]] = {lock: {} for lock in contents.prepared}
    for key, record in contents.kept.items():
        if key.kind is Kind.SLOT:
            contents.recovered.slots.append(record)
        else:
            writes.setdefault(lock_of_write(key), {})[record.slot] = record
    for lock, found in writes.items():
        try:
            row = contents.prepared[lock]
            contents.recovered.prepared.append(read_prepared(*row, found))
        except (*_UNREADABLE, KeyError) as damage:
            refuse(path, f"is damaged: the prepared lock {lock} cannot be read ({damage})")
