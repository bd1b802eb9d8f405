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
from dataclasses import replace
from typing import TYPE_CHECKING

from enact_dist.link.folder.blobs import Blob, DamagedBlobError, Mapped
from enact_dist.link.folder.folder import refuse
from enact_dist.link.store.gathering import UNREADABLE, CheckedRow, Contents, check_row, gather
from enact_dist.link.store.rows import RowKind, prepared_writes, read_prepared, read_write_key
from enact_dist.terms import NullReason

if TYPE_CHECKING:
    from collections.abc import Generator
    from pathlib import Path

    from enact_dist.core.protocol.datum import LockId, Slot
    from enact_dist.core.protocol.records import SlotRecord
    from enact_dist.link.store.media import BodySource, RowSource

_log = logging.getLogger("enact.store")


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
        except (*UNREADABLE, KeyError) as damage:
            refuse(path, f"is damaged: the prepared lock {lock} cannot be read ({damage})")
        recovered.prepared.append(prepared)
        states.prepared[lock] = dict(prepared_writes(prepared))
