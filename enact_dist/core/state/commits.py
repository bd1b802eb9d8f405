"""The commit: all writes of one lock or none, and only if the lock is still held.

The fence: a commit is compared with its live grant in the step that applies it.  Whatever a holder
sends after it lost its lock is refused, so the safety of data depends on no clock.

::

    Commit ── recorded before? ──> the recorded answer again
       │
       ├─ epoch or token differ ──> EpochChanged / Fenced, nothing written
       │
       ├─ all aspects volatile, no slot new ──> applied and answered at once
       └─ else committing ── Persist ── Persisted ──> applied, released, answered
                                                      └─ participants told (see `decisions`)

Expected views are compared in the step that commits, prepares or validates, and no other lock may
hold the slot for writing then, unless that lock lies on this shard alone.  So all that a lock has
read and expected was current together at the moment in which its client began to finish it (or,
for a lock on one shard alone, at its commit), and these moments are a serial order: a lock
that overwrites something later was granted later.

Between `Persist` and `Persisted` the tenure cannot end (I17) and no reader sees its writes.  Writes
and outcome are one record of the store, so an outcome is known exactly when the writes stand (I5).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from enact_dist.core.protocol.checks import (
    NO_PAYLOAD,
    missing_payload,
    wrong_commit,
    wrong_name,
)
from enact_dist.core.protocol.datum import Position, Slot
from enact_dist.core.protocol.messages import (
    OUTCOME_COMMITTED,
    OUTCOME_EXPIRED,
    OUTCOME_PENDING,
    OUTCOME_UNSEEN,
    Changed,
    Commit,
    Committed,
    EpochChanged,
    Fenced,
    Notice,
    Outcome,
    OutcomeIs,
    Refused,
    SlotChange,
    SlotVersion,
    Valid,
    Validate,
    WriteItem,
)
from enact_dist.core.protocol.records import (
    Content,
    DecisionRecord,
    Effect,
    OutcomeRecord,
    Persist,
    Publish,
    Record,
    Reply,
    SlotRecord,
)
from enact_dist.core.state.causes import cause_of
from enact_dist.core.state.sessions import Lane
from enact_dist.terms import Durability, NullReason

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Iterator

    from enact_dist.core.protocol.datum import LockId, Token
    from enact_dist.core.protocol.messages import Cause, Prepare
    from enact_dist.core.state.catalogue import Catalogue
    from enact_dist.core.state.clock import Stamps
    from enact_dist.core.state.decisions import Decisions
    from enact_dist.core.state.grants import Tenure, Tenures
    from enact_dist.core.state.sessions import SessionTable
    from enact_dist.core.state.slots import SlotMap

NOT_HELD: Final = "it is not held here (never granted, released, or forgotten)"

_DELETED: Final = NullReason.DELETED
_STRICTNESS: Final = (Durability.VOLATILE, Durability.OS, Durability.DURABLE)


@dataclass(slots=True)
class _InFlight:
    """A commit that the store is working on."""

    tenure: Tenure
    writes: tuple[WriteItem, ...]
    outcome: OutcomeRecord
    cause: Cause
    reply_to: list[int] = field(default_factory=list)
    decision: DecisionRecord | None = None


class Commits:
    """Commits, validations and outcomes of one shard."""

    __slots__ = (
        "_catalogue",
        "_count",
        "_decisions",
        "_epoch",
        "_in_flight",
        "_peers",
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
        peers: Collection[str],
        epoch: int,
        slots: SlotMap,
        catalogue: Catalogue,
        sessions: SessionTable,
        tenures: Tenures,
        stamps: Stamps,
        decisions: Decisions,
        count: Callable[..., None],
    ) -> None:
        self._decisions = decisions
        self._shard = shard
        self._peers = peers
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

    def undecided(self) -> Iterator[tuple[int, tuple[WriteItem, ...]]]:
        """Yield stamp and writes of each commit that the store is working on."""
        for commit in self._in_flight.values():
            yield commit.outcome.position.stamp_ns, commit.writes

    def new_ticket(self) -> int:
        """Return a number for the store to report under."""
        self._ticket += 1
        return self._ticket

    def position_of(self, lock: LockId) -> Position | None:
        """Return the position at which a lock has finally committed, as far as still known."""
        decision = self._decisions.by_lock.get(lock)
        if decision is not None:
            return decision.position
        recorded = self._recorded(lock)
        return recorded.position if recorded is not None else None

    # ---------------------------------------------------------------- commit

    def commit(
        self, message: Commit, *, reply_to: int, now_ns: int, wall_ns: int
    ) -> Iterable[Effect]:
        """Apply a commit, or say why not; the same commit again gets the same answer."""
        recorded = self._recorded(message.lock)
        if recorded is not None:
            self._count("commits_repeated")
            committed = Committed(recorded.lock, recorded.position, recorded.versions)
            return [Reply(reply_to, committed)]
        tenure = self._tenures.by_lock.get(message.lock)
        at_store = tenure is not None and tenure.committing
        in_flight = self._in_flight_of(message.lock) if at_store else None
        if in_flight is not None:
            in_flight.reply_to.append(reply_to)
            return []
        refusal = self.refusal(message, tenure, wall_ns=wall_ns)
        if refusal is not None:
            return self._refused(refusal, tenure, reply_to=reply_to, now_ns=now_ns)
        assert tenure is not None
        moved = self.moved_on(message.expects, message.lock) if message.expects else None
        if moved is not None:
            return self.changed(tenure, moved, reply_to=reply_to, now_ns=now_ns)
        stamp_ns = self._stamps.next(seen_ns=message.seen_stamp_ns, wall_ns=wall_ns)
        next_version = self._slots.next_version
        versions = tuple([SlotVersion(slot, next_version(slot)) for slot, _ in message.writes])
        outcome = OutcomeRecord(message.lock, Position(stamp_ns, self._shard), versions)
        session = self._sessions.by_id[message.lock.session]
        cause = cause_of(message, session, versions, stamp_ns, now_ns - tenure.granted_ns)
        commit = _InFlight(tenure, message.writes, outcome, cause, [reply_to])
        if message.participants:
            commit.decision = DecisionRecord(message.lock, outcome.position, message.participants)
        return self._make_durable(commit, now_ns=now_ns)

    def _refused(
        self,
        refusal: Fenced | Changed | EpochChanged | Refused,
        tenure: Tenure | None,
        *,
        reply_to: int,
        now_ns: int,
    ) -> Iterator[Effect]:
        if (
            isinstance(refusal, Refused)
            and refusal.code != NO_PAYLOAD
            and tenure is not None
            and not tenure.bound
        ):
            # Final: a late copy must not find the lock again later.
            yield from self._tenures.take_away(tenure, refusal.text, now_ns=now_ns)
        yield Reply(reply_to, refusal)

    def moved_on(self, expects: Iterable[SlotVersion], lock: LockId) -> SlotVersion | None:
        """Return an expected slot that has changed, or that another lock may be about to change."""
        for slot, version in expects:
            found = self._newest_version(slot)
            if found != version or self._in_the_way(slot, lock):
                return SlotVersion(slot, found)
        return None

    def changed(
        self, tenure: Tenure, moved: SlotVersion, *, reply_to: int, now_ns: int
    ) -> Iterator[Effect]:
        """End a lock whose expectation does not hold; a repeated request gets the same answer."""
        answer = Changed(tenure.lock, *moved)
        session = self._sessions.known(tenure.lock.session)
        if session is not None:
            session.lane(tenure.lock.lane).changed = answer
        self._count("commits_changed")
        yield from self._tenures.remove(tenure, now_ns=now_ns)
        yield Reply(reply_to, answer)

    def _in_the_way(self, slot: Slot, lock: LockId) -> bool:
        """Whether a lock that is no single step on this shard may write an expected slot."""
        for other in self._tenures.table.writers_of(slot):
            tenure = self._tenures.by_lock[other]
            if other != lock and (tenure.prepared is not None or not tenure.alone):
                return True
        return False

    def _newest_version(self, slot: Slot) -> int:
        """Return the version of a slot, one in flight included: its stamp comes before ours."""
        for commit in self._in_flight.values():
            for written, version in commit.outcome.versions:
                if written == slot:
                    return version
        return self._slots[slot].version

    def _make_durable(self, commit: _InFlight, *, now_ns: int) -> Iterable[Effect]:
        """Hand the commit to the store, or apply it at once where nothing is to survive."""
        durability = self._strictest(commit)
        versions, stamp_ns = commit.outcome.versions, commit.outcome.position.stamp_ns
        if durability is Durability.VOLATILE and self._slots.exist(versions):
            return self._apply(commit, now_ns=now_ns)
        kept = self.records(commit.writes, versions, stamp_ns, commit.cause)
        ticket = self.new_ticket()
        commit.tenure.committing = True
        self._in_flight[ticket] = commit
        if durability is Durability.VOLATILE:
            # Once per slot: a reader that finds it null after a restart learns that it was lost.
            durability = Durability.OS
        else:
            kept = (*kept, commit.outcome)
        decision = (commit.decision,) if commit.decision is not None else ()
        forgotten = self._slots.history.take_forgotten()
        return [Persist(ticket, (*kept, *decision, *forgotten), durability)]

    def _strictest(self, commit: _InFlight) -> Durability:
        """Return what a commit must survive: the most that one of its data asks for.

        A decision is relied on by other shards, so it outlasts everything.
        """
        if commit.decision is not None:
            return Durability.DURABLE
        strictest = Durability.VOLATILE
        for slot, _ in commit.writes:
            durability = self._catalogue.durability(slot.aspect)
            if durability is not strictest:
                strictest = max(strictest, durability, key=_STRICTNESS.index)
        return strictest

    def persisted(self, ticket: int, *, now_ns: int) -> Iterable[Effect]:
        """The store is done: apply, release and answer."""
        commit = self._in_flight.pop(ticket)
        commit.tenure.committing = False
        return self._apply(commit, now_ns=now_ns)

    def is_commit(self, ticket: int) -> bool:
        """Whether the store was asked to keep a commit under this number."""
        return ticket in self._in_flight

    def _apply(self, commit: _InFlight, *, now_ns: int) -> Iterable[Effect]:
        lock, outcome = commit.tenure.lock, commit.outcome
        stamp_ns = outcome.position.stamp_ns
        changes = self.apply_writes(commit.writes, outcome.versions, stamp_ns, commit.cause)
        lanes = self._sessions.lanes_of(lock.session)
        if lanes is not None:
            lane = lanes.get(lock.lane)
            if lane is None:
                lane = lanes[lock.lane] = Lane()
            # A commit whose client gave up may end after a newer one of its lane.
            if lane.outcome is None or lane.outcome.lock.seq < lock.seq:
                lane.outcome = outcome
        effects = list(self._tenures.remove(commit.tenure, now_ns=now_ns))
        self._count("commits")
        committed = Committed(outcome.lock, outcome.position, outcome.versions)
        effects += [Reply(reply_to, committed) for reply_to in commit.reply_to]
        effects += self.publish(changes)
        if commit.decision is not None:
            effects += self._decisions.decided(commit.decision, now_ns=now_ns)
        return effects

    def apply_writes(
        self,
        writes: tuple[WriteItem, ...],
        versions: tuple[SlotVersion, ...],
        stamp_ns: int,
        cause: Cause | None,
    ) -> list[SlotChange]:
        """Make writes visible; return what a notice tells of them."""
        changes, size = [], 0
        for (_, datum), (slot, version) in zip(writes, versions, strict=True):
            content = Content(version, stamp_ns, datum, _DELETED, cause)
            self._slots.replace(slot, content)
            captured_ns = 0
            if datum is not None:
                captured_ns, size = datum.stamp_ns, size + datum.size
            changes.append(SlotChange(slot, version, stamp_ns, datum is None, captured_ns))
        self._count("bytes_written", size)
        return changes

    def publish(self, changes: list[SlotChange]) -> Iterable[Effect]:
        """Tell everybody who watches."""
        if not changes:
            return ()
        self.notice_number += 1
        return (Publish(Notice(self._shard, self._epoch, self.notice_number, tuple(changes))),)

    def records(
        self,
        writes: tuple[WriteItem, ...],
        versions: tuple[SlotVersion, ...],
        stamp_ns: int,
        cause: Cause | None,
    ) -> tuple[Record, ...]:
        """Return what the store must keep: durable states, and that volatile slots exist."""
        records: list[Record] = []
        for write, (slot, version) in zip(writes, versions, strict=True):
            volatile = self._catalogue.durability(slot.aspect) is Durability.VOLATILE
            if volatile and self._slots.exists(slot):
                continue
            reason = "" if write.datum else NullReason.DELETED.name
            if volatile:
                records.append(SlotRecord(slot, version, stamp_ns, None, reason, volatile=True))
            else:
                stays = self._slots.history.will_hold(slot, self._slots[slot])
                records.append(
                    SlotRecord(
                        slot, version, stamp_ns, write.datum, reason, history=stays, cause=cause
                    )
                )
        return tuple(records)

    # ---------------------------------------------------------------- fence

    def refusal(
        self, message: Commit | Prepare, tenure: Tenure | None, *, wall_ns: int
    ) -> Fenced | Changed | EpochChanged | Refused | None:
        """Return why this holder may not write this now, None if it may."""
        # The fence comes first: what a stranger asks must not end the holder's lock.
        fenced = self._fence(message.lock, message.token, tenure)
        if fenced is not None:
            return fenced
        assert tenure is not None
        wrong = wrong_commit(message, peers=self._peers)
        if wrong is not None:
            return wrong
        if tenure.bound:
            return Refused("protocol", f"{message.lock} is being committed in another way")
        for slot, _ in message.writes:
            if not tenure.covers(slot):
                return Refused("protocol", f"{message.lock} does not hold {slot} for writing")
        for slot, _ in message.writes:
            # Everybody whose pattern covers it must be able to read its name.
            if not self._slots.exists(slot):
                wrong = wrong_name("entity", slot.entity, slashes=True)
                if wrong is not None:
                    return wrong
        if self._stamps.too_far_ahead(message.seen_stamp_ns, wall_ns=wall_ns):
            ahead_s = (message.seen_stamp_ns - wall_ns) / 1e9
            return Refused(
                "clock_skew",
                f"the client has seen a commit stamped {ahead_s:.1f} s ahead of the clock of shard"
                f" {self._shard}; at most 1 s is accepted; set the clocks of both hosts",
            )
        return missing_payload(message.writes)

    def _fence(
        self, lock: LockId, token: Token, tenure: Tenure | None
    ) -> Fenced | Changed | EpochChanged | None:
        """Return None only if exactly this grant is live."""
        session = self._sessions.known(lock.session)
        if token.epoch != self._epoch or session is None:
            self._count("epoch_refusals")
            return EpochChanged(self._epoch)
        if tenure is None or tenure.token != token:
            lane = session.lanes.get(lock.lane)
            if lane is not None and lane.changed is not None and lane.changed.lock == lock:
                return lane.changed
            self._count("fenced")
            return Fenced(lock, self._cause(lock))
        return None

    def _cause(self, lock: LockId) -> str:
        session = self._sessions.known(lock.session)
        lane = session.lanes.get(lock.lane) if session is not None else None
        ended = lane.ended if lane is not None else None
        return ended[1] if ended is not None and ended[0] == lock else NOT_HELD

    # ---------------------------------------------------------------- validate, outcome

    def validate(self, message: Validate, *, reply_to: int, now_ns: int) -> Iterator[Effect]:
        """Confirm that reads and expectations hold until now, and release the reads."""
        if not message.token.number:
            yield Reply(reply_to, self._expected(message))
            return
        session = self._sessions.known(message.lock.session)
        lane = session.lanes.get(message.lock.lane) if session is not None else None
        if lane is not None and lane.validated == (message.lock, message.token):
            yield Reply(reply_to, Valid(message.lock))
            return
        tenure = self._tenures.by_lock.get(message.lock)
        fenced = self._fence(message.lock, message.token, tenure)
        if fenced is None and tenure is not None and not tenure.bound:
            assert session is not None
            moved = self.moved_on(message.expects, message.lock)
            if moved is not None:
                yield from self.changed(tenure, moved, reply_to=reply_to, now_ns=now_ns)
                return
            session.lane(message.lock.lane).validated = (message.lock, message.token)
            yield from self._tenures.remove(tenure, now_ns=now_ns)
            self._count("locks_validated")
            yield Reply(reply_to, Valid(message.lock))
        else:
            yield Reply(reply_to, fenced or Fenced(message.lock, NOT_HELD))

    def _expected(self, message: Validate) -> Valid | Changed | EpochChanged:
        """Compare the expectations of a lock that holds nothing here."""
        if message.token.epoch != self._epoch or not self._sessions.known(message.lock.session):
            self._count("epoch_refusals")
            return EpochChanged(self._epoch)
        moved = self.moved_on(message.expects, message.lock)
        if moved is None:
            return Valid(message.lock)
        self._count("commits_changed")
        return Changed(message.lock, *moved)

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

    def _in_flight_of(self, lock: LockId) -> _InFlight | None:
        """Return the commit of a lock that the store works on; it may work on a promise instead."""
        return next((c for c in self._in_flight.values() if c.tenure.lock == lock), None)
