"""What a store must hold: the core's ledger, and what a power cut may take of it."""

import copy
from dataclasses import replace

from store_workload import flat_record

from enact_dist.core.offline.ledger import Ledger
from enact_dist.core.protocol.records import SessionEnded, SessionRecord, SlotRecord
from enact_dist.terms import Durability

LARGE_BYTES = 64 * 1024
DAY_NS = 24 * 3600 * 10**9


class State:
    """Everything that is stored after some batch.

    Attributes:
        ledger: The records that count.
        ended: When sessions ended whose outcomes are kept still.
        forced: Versions of slots and prepared locks whose large bodies were forced to the disk.
    """

    def __init__(self):
        self.ledger = Ledger()
        self.ended = {}
        self.forced = set()

    def copy(self):
        state = State()
        for name, part in vars(self.ledger).items():
            setattr(state.ledger, name, copy.copy(part))
        state.ended, state.forced = self.ended.copy(), self.forced.copy()
        return state

    def after(self, batch):
        """Return the state after a batch of (durability, records)."""
        state = self.copy()
        durable_in_batch = {}
        for durability, records in batch:
            for record in records:
                durable = durability is Durability.DURABLE
                name = None
                if isinstance(record, SlotRecord):
                    # A durable state that is replaced in its batch is never written.
                    durable |= durable_in_batch.get(record.slot, False) and not record.history
                    durable_in_batch[record.slot] = durable
                    name = (record.slot, record.version)
                elif hasattr(record, "writes"):
                    name = record.lock
                if name is not None:
                    (state.forced.add if durable else state.forced.discard)(name)
                state.apply(record)
        return state

    def assert_chains(self, batch):
        """Assert I2: versions of a slot are a chain without a gap."""
        newest = dict(self.ledger.slots)
        for record in (record for _, records in batch for record in records):
            if isinstance(record, SlotRecord):
                before = newest.get(record.slot)
                if before is not None and not (before.volatile or record.volatile):
                    assert record.version == before.version + 1, record
                newest[record.slot] = record

    def apply(self, record):
        self.ledger.take(record)
        if isinstance(record, SessionRecord):
            self.ended.pop(record.session, None)
        elif isinstance(record, SessionEnded):
            self.forget(record.wall_ns)
            self.ended[record.session] = record.wall_ns

    def forget(self, wall_ns):
        """Forget the outcomes of sessions that ended a day before."""
        for session, ended_ns in list(self.ended.items()):
            if ended_ns <= wall_ns - DAY_NS:
                del self.ended[session]
                for lane in [lane for lane in self.ledger.outcomes if lane[0] == session]:
                    del self.ledger.outcomes[lane]

    def opened(self, wall_ns):
        """Return the state after a start of the shard."""
        state = self.copy()
        state.forget(wall_ns)
        return state

    # ---------------------------------------------------------------- comparison

    def difference(self, recovered, *, power_cut=False):
        """Return what of a recovered state is not this one, "" where nothing is."""
        wanted = self.ledger.recovered(recovered.epoch)
        for name, by_name in PARTS.items():
            found, expected = (by_name(getattr(one, name)) for one in (recovered, wanted))
            if found.keys() != expected.keys():
                return f"{name} {sorted(map(str, found))} instead of {sorted(map(str, expected))}"
            for key, record in found.items():
                if record == expected[key]:
                    continue
                if not (power_cut and self._is_lost(record, expected[key])):
                    return f"{name} {key}: {record!r:.300} instead of {expected[key]!r:.300}"
        if [r.version for r in recovered.history] != [r.version for r in wanted.history]:
            return "the history is not in order"
        return ""

    def _is_lost(self, record, expected):
        """Whether a power cut explains the difference: it took a large body, that is now null."""
        if isinstance(record, SlotRecord):
            return record == self._without(expected, (expected.slot, expected.version))
        if hasattr(record, "writes"):
            if record.lock in self.forced:
                return False
            writes = tuple(
                found if found.datum is None and is_large(wanted.datum) else wanted
                for found, wanted in zip(record.writes, expected.writes, strict=True)
            )
            return record == replace(expected, writes=writes)
        return False

    def _without(self, expected, name):
        if name in self.forced or not is_large(expected.datum):
            return expected
        return replace(expected, datum=None, null_reason="LOST")

    def with_lost(self, recovered):
        """Return this state with what a power cut took."""
        state = self.copy()
        for record in recovered.slots:
            if not record.volatile:
                state.ledger.slots[record.slot] = flat_record(record)
        for record in recovered.history:
            state.ledger.history[record.slot, record.version] = flat_record(record)
        for record in recovered.prepared:
            state.ledger.prepared[record.lock] = flat_record(record)
        return state


def is_large(datum):
    """Whether a datum has a file of its own."""
    return datum is not None and datum.size > LARGE_BYTES


def _stored(record):
    """Return a state as it comes back: nothing of a volatile one but that it exists."""
    if record.volatile:
        return SlotRecord(record.slot, 0, 0, None, "", volatile=True)
    return flat_record(record)


PARTS = {
    "sessions": lambda records: {record.session: record for record in records},
    "worlds": lambda records: {record.name: record for record in records},
    "dropped": lambda records: {record.name: record for record in records},
    "aspects": lambda entries: {entry.name: entry for entry in entries},
    "forgotten": lambda records: {record.name: record for record in records},
    "slots": lambda records: {record.slot: _stored(record) for record in records},
    "history": lambda records: {(r.slot, r.version): _stored(r) for r in records},
    "kept": lambda records: {record.label: record for record in records},
    "outcomes": lambda records: {record.lock[:2]: record for record in records},
    "prepared": lambda records: {record.lock: flat_record(record) for record in records},
    "decisions": lambda records: {record.lock: record for record in records},
    "forced": lambda records: {record.lock: record for record in records},
    "audit": lambda records: dict(enumerate(records)),
}
"""What a store gives back, each part by what names its records."""
