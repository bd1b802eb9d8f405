"""What the records of one batch change in a store, collected before anything is written.

Records apply in order, as in `core.offline.ledger`; a state that is replaced within its batch is
never written unless it stays as history.
"""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, NamedTuple

from enact_dist.core.protocol.records import (
    AspectForgotten,
    AspectRecord,
    AuditRecord,
    BasesMoved,
    DecisionDone,
    EntitiesMoved,
    ForcedEnded,
    HistoryForgotten,
    KeptRecord,
    OutcomeRecord,
    PreparedEnded,
    PreparedRecord,
    SessionEnded,
    SessionRecord,
    SlotRecord,
    WorldDropped,
)
from enact_dist.link.folder.blobs import Blob
from enact_dist.link.store.rows import (
    ROW_BODY_BYTES_MAX,
    Key,
    RowKind,
    RowOrder,
    cause_body,
    cause_key,
    key_of,
    prepared_writes,
    row_of,
    slot_body,
    slot_key,
)
from enact_dist.link.store.states import State, States
from enact_dist.terms import Durability

if TYPE_CHECKING:
    from collections.abc import Collection

    from enact_dist.core.protocol.datum import LockId, Slot
    from enact_dist.core.protocol.messages import AspectEntry, Cause
    from enact_dist.core.protocol.records import Persist, Record
    from enact_dist.link.store.media import Bodies
    from enact_dist.link.store.states import Outcomes


class _Staged(NamedTuple):
    """A state to write.

    Attributes:
        record: The state.
        durable: Whether it must survive a power cut.
        source: The file that already has its bytes, or the row in this batch that will name it.
    """

    record: SlotRecord
    durable: bool
    source: Blob | Key | None = None


class Batch:
    """The changes of one batch.

    Args:
        number: Number of the batch.
        states: The stored states; updated with every change of this batch.
        outcomes: As `states`.

    Attributes:
        changes: New bodies of rows, None for a deleted row; complete after `settle`.
        forced: Whether the batch must survive a power cut.
    """

    __slots__ = (
        "_count",
        "_number",
        "_outcomes",
        "_staged",
        "_states",
        "_unnamed_blobs",
        "_unnamed_causes",
        "changes",
        "forced",
    )

    def __init__(self, number: int, states: States, outcomes: Outcomes) -> None:
        self.changes: dict[Key, bytes | None] = {}
        self.forced = False
        self._number = number
        self._states = states
        self._outcomes = outcomes
        self._count = 0
        self._staged: dict[Key, _Staged] = {}
        self._unnamed_blobs: list[Blob] = []
        self._unnamed_causes: list[Key] = []

    def take(self, persist: Persist) -> None:
        """Apply records in order."""
        durable = persist.durability is Durability.DURABLE
        self.forced |= durable
        for record in persist.records:
            match record:
                case SlotRecord():
                    self._set(record, durable=durable)
                case HistoryForgotten():
                    for slot, version in record.versions:
                        self._forget(slot, version)
                case WorldDropped():
                    self.changes[key_of(RowKind.WORLD, record.name)] = None
                    self._remove_all("context", {record.name})
                    self._put(record)
                case AspectForgotten():
                    self.changes[key_of(RowKind.ASPECT, record.name)] = None
                    self._remove_all("aspect", {record.name})
                    self._put(record)
                case EntitiesMoved():
                    self._remove_all("entity", frozenset(record.entities))
                case PreparedRecord():
                    self._prepare(record, durable=durable)
                case PreparedEnded():
                    self._end_prepared(record.lock)
                case AspectRecord():
                    self._put(record.entry)
                case BasesMoved():
                    self._put(record.base)
                case _:
                    self._put(record)

    # ---------------------------------------------------------------- states of slots

    def _set(self, record: SlotRecord, *, durable: bool) -> None:
        slot, states = record.slot, self._states
        source = None if record.same_as is None else self._file_of(states.find(*record.same_as))
        old = states.newest.get(slot)
        if old is not None and record.history and not old.volatile:
            versions = states.history.setdefault(slot, {})
            if old.version in versions:
                self._remove(versions[old.version])
            versions[old.version] = old.key
        elif old is not None:
            # If a durable state is never written, its replacement must be durable, too.
            before = self._staged.get(old.key)
            durable |= before is not None and before.durable
            self._remove(old.key)
        key = slot_key(slot, self._next())
        self._staged[key] = _Staged(record, durable, source)
        states.newest[slot] = State(key, record.version, record.volatile)

    def _forget(self, slot: Slot, version: int) -> None:
        versions = self._states.history.get(slot, {})
        key = versions.pop(version, None)
        if key is not None:
            self._remove(key)
            if not versions:
                del self._states.history[slot]

    def _remove_all(self, part: str, names: Collection[str]) -> None:
        for key in self._states.take_out(part, names):
            self._remove(key)

    def _remove(self, key: Key) -> None:
        """Delete a state's row; whatever it names is deleted once everything else is settled."""
        if self._staged.pop(key, None) is not None:
            return
        self.changes[key] = None
        blob = self._states.blobs.pop(key, None)
        if blob is not None:
            self._unnamed_blobs.append(blob)
        cause = self._states.causes.pop(key, None)
        if cause is not None:
            self._unnamed_causes.append(cause)

    def _file_of(self, key: Key | None) -> Blob | Key | None:
        """Return the file that a row names, or the row if that is not written yet."""
        if key is None or key in self._staged:
            return key
        return self._states.blobs.get(key)

    # ---------------------------------------------------------------- prepared locks

    def _prepare(self, record: PreparedRecord, *, durable: bool) -> None:
        for key in self._states.prepared.pop(record.lock, ()):
            self._remove(key)
        self._put(record)
        writes = dict(prepared_writes(record))
        self._states.prepared[record.lock] = writes
        self._staged.update((key, _Staged(write, durable)) for key, write in writes.items())

    def _end_prepared(self, lock: LockId) -> None:
        """Delete a prepared lock; the slots that it has set take over its files."""
        self.changes[key_of(RowKind.PREPARED, *lock)] = None
        for key, write in self._states.prepared.pop(lock, {}).items():
            newest = self._states.newest.get(write.slot)
            staged = self._staged.get(newest.key) if newest is not None else None
            if newest is not None and staged is not None and staged.record.datum is write.datum:
                self._staged[newest.key] = staged._replace(source=self._file_of(key))
            self._remove(key)

    # ---------------------------------------------------------------- everything else

    def _put(self, record: Record | AspectEntry) -> None:
        """Record the change of a record's own row."""
        match record:
            case DecisionDone():
                self.changes[key_of(RowKind.DECISION, *record.lock)] = None
                return
            case ForcedEnded():
                self.changes[key_of(RowKind.FORCED, *record.lock)] = None
                return
            case SessionRecord() if self._outcomes.came_back(record.session):
                self.changes[key_of(RowKind.ENDED, record.session)] = None
            case SessionEnded():
                self.changes[key_of(RowKind.SESSION, record.session)] = None
                self.changes.update(dict.fromkeys(self._outcomes.expired(record.wall_ns)))
                self._outcomes.ended(record.session, record.wall_ns)
            case OutcomeRecord():
                self._outcomes.add(record.lock)
        key, body = row_of(record)
        if isinstance(record, AuditRecord):
            key = key_of(RowKind.AUDIT, *self._next())
        gone = isinstance(record, KeptRecord) and not record.versions
        self.changes[key] = None if gone else body

    def _next(self) -> RowOrder:
        self._count += 1
        return RowOrder(self._number, self._count)

    # ---------------------------------------------------------------- files and rows

    def settle(self, bodies: Bodies) -> list[Blob]:
        """Hand large bodies to the medium and record the rows that name them.

        Returns:
            The bodies without a row once the batch is committed.

        Raises:
            OSError: As the system reports it.
        """
        made = Counter(id(staged.record.cause) for staged in self._staged.values())
        causes: dict[int, RowOrder] = {}
        names_to_sync = False
        for key, staged in self._staged.items():
            record, durable = staged.record, staged.durable
            if record.volatile:
                self.changes[key] = slot_body(record, None)
                continue
            blob, body = self._shared_blob(staged), record.datum
            if blob is None and body is not None and body.size > ROW_BODY_BYTES_MAX:
                blob = bodies.write(body.body, durable=durable)
                names_to_sync |= durable
            elif blob is not None and durable and not blob.synced:
                blob = bodies.force(blob)
                names_to_sync = True
            if blob is not None:
                self._states.name_blob(key, blob)
            shared = None
            if record.cause is not None and made[id(record.cause)] > 1:
                shared = self._shared_cause(key, record.cause, causes)
            self.changes[key] = slot_body(record, blob, shared)
        if names_to_sync:
            bodies.sync_names()
        for cause in self._unnamed_causes:
            if self._states.unname_cause(cause):
                self.changes[cause] = None
        gone = [self._states.unname_blob(blob) for blob in self._unnamed_blobs]
        return [blob for blob in gone if blob is not None]

    def _shared_blob(self, staged: _Staged) -> Blob | None:
        """Return the file that already has a state's bytes; None: there is none."""
        source, datum = staged.source, staged.record.datum
        blob = self._states.blobs.get(source) if isinstance(source, Key) else source
        if blob is None or datum is None or blob.size != datum.size:
            return None
        return self._states.as_forced(blob)

    def _shared_cause(self, key: Key, cause: Cause, causes: dict[int, RowOrder]) -> RowOrder:
        """Make a row name the row of its cause, which is written with the first such row."""
        order = causes.get(id(cause))
        if order is None:
            order = causes[id(cause)] = self._next()
            self.changes[cause_key(order)] = cause_body(cause)
        self._states.name_cause(key, cause_key(order))
        return order
