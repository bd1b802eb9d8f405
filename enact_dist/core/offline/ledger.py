"""What a store holds once it has taken records: the specification that every store must meet.

Plain dictionaries, no disk: the simulated disk keeps its log and folds it with this, and the
tests compare the real store with it.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import replace
from typing import Any

from enact_dist.core.protocol.datum import LockId, Slot
from enact_dist.core.protocol.records import (
    AspectForgotten,
    AspectRecord,
    AuditRecord,
    BasesMoved,
    DecisionDone,
    DecisionRecord,
    EntitiesMoved,
    ForcedEnded,
    ForcedRecord,
    HistoryForgotten,
    KeptRecord,
    OutcomeRecord,
    PreparedEnded,
    PreparedRecord,
    Record,
    Recovered,
    SessionEnded,
    SessionRecord,
    SlotRecord,
    WorldDropped,
    WorldRecord,
)


class Ledger:
    """The records that count, after all that replaced or ended others."""

    def __init__(self, records: Iterable[Record] = ()) -> None:
        self.sessions: dict[str, SessionRecord] = {}
        self.worlds: dict[str, WorldRecord] = {}
        self.dropped: dict[str, WorldDropped] = {}
        self.aspects: dict[str, AspectRecord] = {}
        self.forgotten: dict[str, AspectForgotten] = {}
        self.slots: dict[Slot, SlotRecord] = {}
        self.history: dict[tuple[Slot, int], SlotRecord] = {}
        self.kept: dict[str, KeptRecord] = {}
        self.outcomes: dict[tuple[str, int], OutcomeRecord] = {}
        self.prepared: dict[LockId, PreparedRecord] = {}
        self.decisions: dict[LockId, DecisionRecord] = {}
        self.forced: dict[LockId, ForcedRecord] = {}
        self.audit: list[AuditRecord] = []
        for record in records:
            self.take(record)

    def take(self, record: Record) -> None:
        """Apply a record: it counts from now on, in place of what it replaces or ends."""
        match record:
            case SlotRecord():
                self._set(record)
            case HistoryForgotten():
                for version in record.versions:
                    self.history.pop(version, None)
            case KeptRecord():
                self.kept[record.label] = record
                if not record.versions:
                    del self.kept[record.label]
            case WorldRecord():
                self.worlds[record.name] = record
            case WorldDropped():
                self.worlds.pop(record.name, None)
                self.dropped[record.name] = record
                self._delete("context", {record.name})
            case AspectForgotten():
                self.aspects.pop(record.name, None)
                self.forgotten[record.name] = record
                self._delete("aspect", {record.name})
            case BasesMoved(base=AspectForgotten() as base):
                self.forgotten[base.name] = base
            case BasesMoved(base=WorldDropped() as base):
                self.dropped[base.name] = base
            case EntitiesMoved():
                self._delete("entity", frozenset(record.entities))
            case AspectRecord():
                self.aspects[record.entry.name] = record
            case SessionRecord():
                self.sessions[record.session] = record
            case SessionEnded():
                self.sessions.pop(record.session, None)
            case OutcomeRecord():
                self.outcomes[record.lock.session, record.lock.lane] = record
            case PreparedRecord():
                self.prepared[record.lock] = record
            case PreparedEnded():
                self.prepared.pop(record.lock, None)
            case DecisionRecord():
                self.decisions[record.lock] = record
            case DecisionDone():
                self.decisions.pop(record.lock, None)
            case ForcedRecord():
                self.forced[record.lock] = record
            case ForcedEnded():
                self.forced.pop(record.lock, None)
            case AuditRecord():
                self.audit.append(record)

    def _set(self, record: SlotRecord) -> None:
        old = self.slots.get(record.slot)
        if record.history and old is not None and not old.volatile:
            self.history[old.slot, old.version] = replace(old, history=False, same_as=None)
        self.slots[record.slot] = replace(record, history=False, same_as=None)

    def _delete(self, part: str, names: Collection[str]) -> None:
        """Delete all states of slots whose `part` is one of `names`."""
        tables: tuple[dict[Any, SlotRecord], ...] = (self.slots, self.history)
        for states in tables:
            for key in [key for key, found in states.items() if getattr(found.slot, part) in names]:
                del states[key]

    def recovered(self, epoch: int) -> Recovered:
        """Return everything as a store gives it back at the start of an epoch."""
        return Recovered(
            epoch,
            sessions=list(self.sessions.values()),
            worlds=list(self.worlds.values()),
            dropped=list(self.dropped.values()),
            aspects=[record.entry for record in self.aspects.values()],
            forgotten=list(self.forgotten.values()),
            slots=list(self.slots.values()),
            history=sorted(self.history.values(), key=lambda r: (r.slot, r.version)),
            kept=list(self.kept.values()),
            outcomes=list(self.outcomes.values()),
            prepared=list(self.prepared.values()),
            decisions=list(self.decisions.values()),
            forced=list(self.forced.values()),
            audit=list(self.audit),
        )
