"""What a store must hold: the plainest model of its records, and the comparison with a real one."""

from dataclasses import dataclass, field

from store_workload import flat_datum, flat_record

from enact_dist.core.records import (
    AspectRecord,
    AuditRecord,
    DecisionDone,
    DecisionRecord,
    ForcedEnded,
    ForcedRecord,
    OutcomeRecord,
    PreparedEnded,
    PreparedRecord,
    SessionEnded,
    SessionRecord,
    SlotRecord,
    WorldRecord,
)
from enact_dist.terms import Durability

LARGE_BYTES = 64 * 1024
DAY_NS = 24 * 3600 * 10**9


@dataclass
class State:
    """Everything that is stored after some batch.

    Attributes:
        forced: Slots and prepared locks whose large bodies were forced to the disk.
    """

    slots: dict = field(default_factory=dict)
    outcomes: dict = field(default_factory=dict)
    sessions: dict = field(default_factory=dict)
    ended: dict = field(default_factory=dict)
    worlds: set = field(default_factory=set)
    aspects: dict = field(default_factory=dict)
    prepared: dict = field(default_factory=dict)
    decisions: dict = field(default_factory=dict)
    given_up: dict = field(default_factory=dict)
    audit: list = field(default_factory=list)
    forced: set = field(default_factory=set)

    def copy(self):
        parts = (getattr(self, name) for name in self.__dataclass_fields__)
        return State(*(part.copy() for part in parts))

    def after(self, batch):
        """Return the state after a batch of (durability, records)."""
        state = self.copy()
        written = {}
        for durability, records in batch:
            for record in records:
                state.apply(record)
                name = getattr(record, "slot", None) or getattr(record, "lock", None)
                written[name] = written.get(name, False) or durability is Durability.DURABLE
        for name, durable in written.items():
            (state.forced.add if durable else state.forced.discard)(name)
        return state

    def apply(self, record):
        if isinstance(record, SlotRecord):
            before = self.slots.get(record.slot)
            if record.volatile:
                record = SlotRecord(record.slot, 0, 0, None, "", volatile=True)
            else:
                # I2: versions of a slot are a chain without a gap.
                assert record.version == (before.version if before else 0) + 1, record
            self.slots[record.slot] = record
        elif isinstance(record, OutcomeRecord):
            self.outcomes[record.lock[:2]] = record
        elif isinstance(record, SessionRecord):
            self.ended.pop(record.session, None)
            self.sessions[record.session] = record
        elif isinstance(record, SessionEnded):
            self.sessions.pop(record.session, None)
            self.ended[record.session] = record.wall_ns
            self.forget(record.wall_ns)
        elif isinstance(record, WorldRecord):
            self.worlds.add(record.name)
        elif isinstance(record, AspectRecord):
            self.aspects[record.entry.name] = record.entry
        elif isinstance(record, PreparedRecord):
            self.prepared[record.lock] = record
        elif isinstance(record, PreparedEnded):
            self.prepared.pop(record.lock, None)
        elif isinstance(record, DecisionRecord):
            self.decisions[record.lock] = record
        elif isinstance(record, DecisionDone):
            self.decisions.pop(record.lock, None)
        elif isinstance(record, ForcedRecord):
            self.given_up[record.lock] = record
        elif isinstance(record, ForcedEnded):
            self.given_up.pop(record.lock, None)
        elif isinstance(record, AuditRecord):
            self.audit.append(record)
        else:
            raise AssertionError(record)

    def forget(self, wall_ns):
        """Forget the outcomes of sessions that ended a day before."""
        for session, ended_ns in list(self.ended.items()):
            if ended_ns <= wall_ns - DAY_NS:
                del self.ended[session]
                self.outcomes = {k: v for k, v in self.outcomes.items() if k[0] != session}

    def opened(self, wall_ns):
        """Return the state after a start of the shard."""
        state = self.copy()
        state.forget(wall_ns)
        return state

    # ---------------------------------------------------------------- comparison

    def difference(self, recovered, *, power_cut):
        """Return what of a recovered state is not this one, "" where nothing is."""
        pairs = (
            ("sessions", {r.session: r for r in recovered.sessions}, self.sessions),
            ("worlds", {record.name for record in recovered.worlds}, self.worlds),
            ("aspects", {entry.name: entry for entry in recovered.aspects}, self.aspects),
            ("outcomes", {r.lock[:2]: r for r in recovered.outcomes}, self.outcomes),
            ("given up", {r.lock: r for r in recovered.forced}, self.given_up),
            ("audit", recovered.audit, self.audit),
            ("decisions", {r.lock: r for r in recovered.decisions}, self.decisions),
        )
        for name, found, expected in pairs:
            if found != expected:
                return f"{name}: {found} instead of {expected}"
        return self._slots_differ(recovered, power_cut) or self._prepared_differ(
            recovered, power_cut
        )

    def _slots_differ(self, recovered, power_cut):
        found = {record.slot: record for record in recovered.slots}
        if found.keys() != self.slots.keys():
            return f"slots {sorted(found)} instead of {sorted(self.slots)}"
        for slot, record in found.items():
            expected = self.slots[slot]
            same = (record.version, record.stamp_ns) == (expected.version, expected.stamp_ns)
            if record.null_reason == "LOST" and same and power_cut and self.may_lose(slot):
                continue
            if not same or flat_record(record) != expected:
                return f"{slot}: {record!r:.200} instead of {expected!r:.200}"
        return ""

    def _prepared_differ(self, recovered, power_cut):
        found = {record.lock: record for record in recovered.prepared}
        if found.keys() != self.prepared.keys():
            return f"prepared {sorted(found)} instead of {sorted(self.prepared)}"
        for lock, record in found.items():
            expected = self.prepared[lock]
            rest = (record.items, record.token, record.versions, record.stamp_ns, record.primary)
            wanted = (
                expected.items,
                expected.token,
                expected.versions,
                expected.stamp_ns,
                expected.primary,
            )
            if rest != wanted or record.primary_token != expected.primary_token:
                return f"prepared {lock}: {rest} instead of {wanted}"
            for write, other in zip(record.writes, expected.writes, strict=True):
                lost = write.datum is None and other.datum is not None
                if (
                    lost
                    and power_cut
                    and lock not in self.forced
                    and other.datum.size > LARGE_BYTES
                ):
                    continue
                if write.slot != other.slot or flat_datum(write.datum) != other.datum:
                    return f"prepared {lock}: {write!r:.200} instead of {other!r:.200}"
        return ""

    def may_lose(self, slot):
        """Whether a power cut may take the body of a slot, which then is null."""
        datum = self.slots[slot].datum
        return slot not in self.forced and datum is not None and datum.size > LARGE_BYTES

    def with_lost(self, recovered):
        """Return this state with what a power cut took."""
        state = self.copy()
        for record in recovered.slots:
            if record.null_reason == "LOST" and not record.volatile:
                state.slots[record.slot] = flat_record(record)
        for record in recovered.prepared:
            state.prepared[record.lock] = flat_record(record)
        return state
