"""The commit: all writes of one lock or none, and only if the lock is still held.

The fence: a commit is compared with its live grant in the step that applies it.  Whatever a holder
sends after it lost its lock is refused, so the safety of data depends on no clock.

::

    Commit ── recorded before? ──> the recorded answer again
       │
       ├─ epoch or token differ ──> EpochChanged / Fenced, nothing written
       │
       ├─ all aspects volatile ──> applied and answered at once
       └─ else committing ── Persist ── Persisted ──> applied, released, answered

Between `Persist` and `Persisted` the tenure cannot end (I17) and nobody sees its writes.  Writes
and outcome are one record of the store, so an outcome is known exactly when the writes stand (I5).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from enact_dist.core.datum import Position, Slot
from enact_dist.core.messages import (
    OUTCOME_COMMITTED,
    OUTCOME_EXPIRED,
    OUTCOME_PENDING,
    OUTCOME_UNSEEN,
    Change,
    Changed,
    Commit,
    Committed,
    EpochChanged,
    Fenced,
    Notice,
    Outcome,
    OutcomeIs,
    Refused,
    SlotVersion,
    Valid,
    Validate,
    WriteItem,
)
from enact_dist.core.records import (
    Effect,
    OutcomeRecord,
    Persist,
    Publish,
    Record,
    Reply,
    SlotRecord,
)
from enact_dist.core.sessions import Lane
from enact_dist.core.slots import Catalogue, Content, SlotMap
from enact_dist.terms import Durability, NullReason

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from enact_dist.core.datum import LockId, Token
    from enact_dist.core.sessions import SessionTable
    from enact_dist.core.stamps import Stamps
    from enact_dist.core.tenures import Tenure, Tenures

NOT_HELD: Final = "it is not held here (never granted, released, or forgotten)"

_STRICTNESS: Final = (Durability.VOLATILE, Durability.OS, Durability.DURABLE)


@dataclass(slots=True)
class _InFlight:
    """A commit that the store is working on."""

    tenure: Tenure
    writes: tuple[WriteItem, ...]
    outcome: OutcomeRecord
    reply_to: list[int] = field(default_factory=list)


class Commits:
    """Commits, validations and outcomes of one shard."""

    __slots__ = (
        "_catalogue",
        "_count",
        "_epoch",
        "_in_flight",
        "_sessions",
        "_shard",
        "_slots",
        "_stamps",
        "_tenures",
        "_ticket",
        "notice_number",
    )

    def __init__(
        self,
        *,
        shard: str,
        epoch: int,
        slots: SlotMap,
        catalogue: Catalogue,
        sessions: SessionTable,
        tenures: Tenures,
        stamps: Stamps,
        count: Callable[..., None],
    ) -> None:
        self._shard = shard
        self._epoch = epoch
        self._slots = slots
        self._catalogue = catalogue
        self._sessions = sessions
        self._tenures = tenures
        self._stamps = stamps
        self._count = count
        self._in_flight: dict[int, _InFlight] = {}
        self._ticket = 0
        self.notice_number = 0

    @property
    def in_flight(self) -> int:
        """How many commits the store is working on."""
        return len(self._in_flight)

    def earliest_in_flight_stamp_ns(self) -> int | None:
        """Return the smallest stamp whose commit is not visible yet."""
        return min(
            (commit.outcome.position.stamp_ns for commit in self._in_flight.values()), default=None
        )

    # ---------------------------------------------------------------- commit

    def commit(
        self, message: Commit, *, reply_to: int, now_ns: int, wall_ns: int
    ) -> Iterator[Effect]:
        """Apply a commit, or say why not; the same commit again gets the same answer."""
        recorded = self._recorded(message.lock)
        if recorded is not None:
            self._count("commits_repeated")
            yield Reply(reply_to, _committed(recorded))
            return
        tenure = self._tenures.by_lock.get(message.lock)
        if tenure is not None and tenure.committing:
            self._in_flight_of(tenure).reply_to.append(reply_to)
            return
        refusal = self._refusal(message, tenure, wall_ns=wall_ns)
        if refusal is not None:
            if isinstance(refusal, Refused) and tenure is not None:
                # For good: a late copy must not find the lock again at another time of day.
                yield from self._tenures.take_away(tenure, refusal.text, now_ns=now_ns)
            yield Reply(reply_to, refusal)
            return
        assert tenure is not None
        moved = next((e for e in message.expects if self._moved(e, tenure)), None)
        if moved is not None:
            self._count("commits_changed")
            yield from self._tenures.remove(tenure, now_ns=now_ns)
            found = self._newest_version(moved.slot)
            yield Reply(reply_to, Changed(message.lock, moved.slot, found))
            return
        stamp_ns = self._stamps.next(seen_ns=message.seen_stamp_ns, wall_ns=wall_ns)
        outcome = OutcomeRecord(
            message.lock,
            Position(stamp_ns, self._shard),
            tuple(
                SlotVersion(write.slot, self._slots[write.slot].version + 1)
                for write in message.writes
            ),
        )
        commit = _InFlight(tenure, message.writes, outcome, [reply_to])
        yield from self._make_durable(commit, now_ns=now_ns)

    def _moved(self, expected: SlotVersion, tenure: Tenure) -> bool:
        """Whether an expected view does not stand, or may have to come after a later write.

        A writer that was granted before the view was taken comes before us: if it also reads on
        other shards, it may have released those reads already, and others built on that.  Seeing
        its slot unchanged would put us before it as well.
        """
        if self._newest_version(expected.slot) != expected.version:
            return True
        return self._tenures.earlier_writer(tenure, expected.slot) is not None

    def _newest_version(self, slot: Slot) -> int:
        """Return the version of a slot, one in flight included: its stamp comes before ours."""
        for commit in self._in_flight.values():
            for written, version in commit.outcome.versions:
                if written == slot:
                    return version
        return self._slots[slot].version

    def _make_durable(self, commit: _InFlight, *, now_ns: int) -> Iterator[Effect]:
        """Hand the commit to the store, or apply it at once where nothing is to survive."""
        durability = max(
            (self._catalogue.durability(write.slot.aspect) for write in commit.writes),
            key=_STRICTNESS.index,
            default=Durability.VOLATILE,
        )
        records = self._records(commit)
        if durability is Durability.VOLATILE:
            if records:
                yield Persist(0, records, Durability.OS)
            yield from self._apply(commit, now_ns=now_ns)
            return
        self._ticket += 1
        commit.tenure.committing = True
        self._in_flight[self._ticket] = commit
        yield Persist(self._ticket, (*records, commit.outcome), durability)

    def persisted(self, ticket: int, *, now_ns: int) -> Iterator[Effect]:
        """The store is done: apply, release and answer."""
        commit = self._in_flight.pop(ticket, None)
        if commit is not None:
            commit.tenure.committing = False
            yield from self._apply(commit, now_ns=now_ns)

    def _apply(self, commit: _InFlight, *, now_ns: int) -> Iterator[Effect]:
        lock, outcome = commit.tenure.lock, commit.outcome
        changes = []
        for write, (slot, version) in zip(commit.writes, outcome.versions, strict=True):
            stamp_ns = outcome.position.stamp_ns
            self._slots.set(slot, Content(version, stamp_ns, write.datum, NullReason.DELETED))
            changes.append(Change(slot, version, stamp_ns, write.datum is None))
        lanes = self._sessions.lanes_of(lock.session)
        if lanes is not None:
            lane = lanes.setdefault(lock.lane, Lane())
            # A commit whose client gave up may end after a newer one of its lane.
            if lane.outcome is None or lane.outcome.lock.seq < lock.seq:
                lane.outcome = outcome
        yield from self._tenures.remove(commit.tenure, now_ns=now_ns)
        self._count("commits")
        self._count("bytes_written", sum(w.datum.size for w in commit.writes if w.datum))
        for reply_to in commit.reply_to:
            yield Reply(reply_to, _committed(outcome))
        if changes:
            self.notice_number += 1
            yield Publish(Notice(self._shard, self._epoch, self.notice_number, tuple(changes)))

    def _records(self, commit: _InFlight) -> tuple[Record, ...]:
        """Return what the store must keep: durable states, and that volatile slots exist."""
        records: list[Record] = []
        for write, (slot, version) in zip(commit.writes, commit.outcome.versions, strict=True):
            volatile = self._catalogue.durability(slot.aspect) is Durability.VOLATILE
            if volatile and self._slots.exists(slot):
                continue
            reason = "" if write.datum else NullReason.DELETED.name
            stamp_ns = commit.outcome.position.stamp_ns
            datum = None if volatile else write.datum
            records.append(SlotRecord(slot, version, stamp_ns, datum, reason, volatile))
        return tuple(records)

    # ---------------------------------------------------------------- fence

    def _refusal(
        self, message: Commit, tenure: Tenure | None, *, wall_ns: int
    ) -> Fenced | EpochChanged | Refused | None:
        fenced = self._fence(message.lock, message.token, tenure)
        if fenced is not None:
            return fenced
        assert tenure is not None
        uncovered = [write.slot for write in message.writes if not tenure.covers(write.slot)]
        if uncovered:
            return Refused("protocol", f"{message.lock} does not hold {uncovered[0]} for writing")
        if self._stamps.too_far_ahead(message.seen_stamp_ns, wall_ns=wall_ns):
            ahead_s = (message.seen_stamp_ns - wall_ns) / 1e9
            return Refused(
                "clock_skew",
                f"the client has seen a commit stamped {ahead_s:.1f} s ahead of the clock of shard"
                f" {self._shard}; at most 1 s is accepted; set the clocks of both hosts",
            )
        return None

    def _fence(
        self, lock: LockId, token: Token, tenure: Tenure | None
    ) -> Fenced | EpochChanged | None:
        """Return None only if exactly this grant is live."""
        if token.epoch != self._epoch or self._sessions.known(lock.session) is None:
            self._count("epoch_refusals")
            return EpochChanged(self._epoch)
        if tenure is None or tenure.token != token:
            self._count("fenced")
            return Fenced(lock, self._cause(lock))
        return None

    def _cause(self, lock: LockId) -> str:
        session = self._sessions.known(lock.session)
        ended = session.lane(lock.lane).ended if session is not None else None
        return ended[1] if ended is not None and ended[0] == lock else NOT_HELD

    # ---------------------------------------------------------------- validate, outcome

    def validate(self, message: Validate, *, reply_to: int, now_ns: int) -> Iterator[Effect]:
        """Confirm that reads were protected until now, and release them."""
        session = self._sessions.known(message.lock.session)
        if session is not None:
            lane = session.lane(message.lock.lane)
            if lane.validated == (message.lock, message.token):
                yield Reply(reply_to, Valid(message.lock))
                return
        tenure = self._tenures.by_lock.get(message.lock)
        fenced = self._fence(message.lock, message.token, tenure)
        if fenced is None and tenure is not None and not tenure.committing:
            assert session is not None
            session.lane(message.lock.lane).validated = (message.lock, message.token)
            yield from self._tenures.remove(tenure, now_ns=now_ns)
            self._count("locks_validated")
            yield Reply(reply_to, Valid(message.lock))
        else:
            yield Reply(reply_to, fenced or Fenced(message.lock, NOT_HELD))

    def outcome(self, message: Outcome, *, reply_to: int) -> Iterator[Effect]:
        """Say what became of a commit: committed, pending, never seen, or too old to tell."""
        recorded = self._recorded(message.lock)
        tenure = self._tenures.by_lock.get(message.lock)
        nothing = Position(0, self._shard)
        if recorded is not None:
            kind, position, versions = OUTCOME_COMMITTED, recorded.position, recorded.versions
        elif tenure is not None and tenure.committing:
            kind, position, versions = OUTCOME_PENDING, nothing, ()
        else:
            lanes = self._sessions.lanes_of(message.lock.session)
            lane = lanes.get(message.lock.lane) if lanes is not None else None
            newer = lane is not None and (
                lane.top > message.lock.seq
                or (lane.outcome is not None and lane.outcome.lock.seq > message.lock.seq)
            )
            kind = OUTCOME_EXPIRED if newer or lanes is None else OUTCOME_UNSEEN
            position, versions = nothing, ()
        yield Reply(reply_to, OutcomeIs(message.lock, self._epoch, kind, position, versions))

    def _recorded(self, lock: LockId) -> OutcomeRecord | None:
        lanes = self._sessions.lanes_of(lock.session)
        lane = lanes.get(lock.lane) if lanes is not None else None
        outcome = lane.outcome if lane is not None else None
        return outcome if outcome is not None and outcome.lock == lock else None

    def _in_flight_of(self, tenure: Tenure) -> _InFlight:
        return next(commit for commit in self._in_flight.values() if commit.tenure is tenure)


def _committed(outcome: OutcomeRecord) -> Committed:
    return Committed(outcome.lock, outcome.position, outcome.versions)


def duplicate_slot(writes: tuple[WriteItem, ...]) -> Slot | None:
    """Return a slot that is written twice in one commit, if any."""
    seen: set[Slot] = set()
    for write in writes:
        if write.slot in seen:
            return write.slot
        seen.add(write.slot)
    return None
