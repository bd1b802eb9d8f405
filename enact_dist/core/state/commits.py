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
from functools import partial
from typing import TYPE_CHECKING, Final

from enact_dist.core.protocol.checks import missing_payload, wrong_commit, wrong_name
from enact_dist.core.protocol.datum import LockId, Position, Slot, Token
from enact_dist.core.protocol.messages import (
    CLOCK_SKEW,
    NO_PAYLOAD,
    OUTCOME_COMMITTED,
    OUTCOME_EXPIRED,
    OUTCOME_PENDING,
    OUTCOME_UNSEEN,
    OVERLOAD,
    PROTOCOL,
    Cause,
    Changed,
    Commit,
    Committed,
    EpochChanged,
    Fenced,
    Notice,
    Outcome,
    OutcomeIs,
    Prepare,
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
    Publish,
    Record,
    Reply,
    SlotRecord,
    Then,
    cause_bytes,
)
from enact_dist.core.state.sessions import LANES_MAX, Lane, SessionTable
from enact_dist.core.state.tenure import Tenure, X
from enact_dist.terms import Durability, NullReason

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Iterator

    from enact_dist.core.rights.guard import Guard
    from enact_dist.core.state.catalogue import Catalogue
    from enact_dist.core.state.clock import Stamps
    from enact_dist.core.state.decisions import Decisions
    from enact_dist.core.state.grants import Tenures
    from enact_dist.core.state.slots import SlotMap

_DELETED: Final = NullReason.DELETED


@dataclass(slots=True)
class _InFlight:
    """A commit that the store is working on; `new` says that some of its slots were not there."""

    tenure: Tenure
    writes: tuple[WriteItem, ...]
    new: bool
    outcome: OutcomeRecord
    cause: Cause
    keep: bool
    reply_to: list[int] = field(default_factory=list)
    decision: DecisionRecord | None = None


class Commits:
    """Commits, validations and outcomes of one shard."""

    __slots__ = (
        "_catalogue",
        "_counters",
        "_decisions",
        "_epoch",
        "_guard",
        "_in_flight",
        "_peers",
        "_persist",
        "_sessions",
        "_shard",
        "_slots",
        "_stamps",
        "_tenures",
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
        counters: dict[str, int],
        persist: Callable[[tuple[Record, ...], Durability, Then], list[Effect]],
        guard: Guard | None = None,
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
        self._counters = counters
        self._in_flight: dict[LockId, _InFlight] = {}
        self._persist = persist
        self._guard = guard
        self.notice_number = 0

    def undecided(self) -> Iterator[tuple[int, tuple[WriteItem, ...]]]:
        """Yield stamp and writes of each commit that the store is working on."""
        for commit in self._in_flight.values():
            yield commit.outcome.position.stamp_ns, commit.writes

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
        lock = message.lock
        recorded = self._recorded(lock)
        if recorded is not None:
            self._counters["commits_repeated"] += 1
            kept = self._tenures.kept.told(lock, message.token)
            return [Reply(reply_to, Committed(lock, recorded.position, recorded.versions, kept))]
        if lock in self._in_flight:
            self._in_flight[lock].reply_to.append(reply_to)
            return []
        tenure = self._tenures.find(lock, message.token)
        new = not self._slots.exist(message.writes)
        refusal = self.refusal(message, tenure, new=new, wall_ns=wall_ns)
        if refusal is not None:
            return self._refused(refusal, tenure, reply_to=reply_to, now_ns=now_ns)
        assert tenure is not None
        moved = self.moved_on(message.expects, lock) if message.expects else None
        if moved is not None:
            return self.changed(lock, tenure, moved, reply_to=reply_to, now_ns=now_ns)
        stamp_ns = self._stamps.next(seen_ns=message.seen_stamp_ns, wall_ns=wall_ns)
        next_version = self._slots.next_version
        versions = tuple([SlotVersion(slot, next_version(slot)) for slot, _ in message.writes])
        outcome = OutcomeRecord(lock, Position(stamp_ns, self._shard), versions)
        session = self._sessions.by_id[lock.session]
        held_ns = now_ns - tenure.granted_ns
        if tenure.kept:
            session.lane(lock.lane).top = lock.seq
            held_ns = max(0, min(held_ns, message.held_ns))
        cause = session.cause(message, versions, stamp_ns, held_ns)
        commit = _InFlight(tenure, message.writes, new, outcome, cause, message.keep, [reply_to])
        if message.participants:
            commit.decision = DecisionRecord(lock, outcome.position, message.participants)
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
        self, lock: LockId, tenure: Tenure, moved: SlotVersion, *, reply_to: int, now_ns: int
    ) -> Iterator[Effect]:
        """End a lock whose expectation does not hold; a repeated request gets the same answer."""
        answer = Changed(lock, *moved)
        session = self._sessions.known(lock.session)
        if session is not None:
            session.lane(lock.lane).changed = answer
        self._counters["commits_changed"] += 1
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
        durability, outcome = self._strictest(commit), commit.outcome
        if durability is Durability.VOLATILE and not commit.new:
            return self._apply(commit, now_ns=now_ns)
        stamp_ns = outcome.position.stamp_ns
        kept = self.records(commit.writes, outcome.versions, stamp_ns, commit.cause)
        commit.tenure.committing = True
        self._in_flight[outcome.lock] = commit
        if durability is Durability.VOLATILE:
            # Once per slot: a reader that finds it null after a restart learns that it was lost.
            durability = Durability.OS
        else:
            kept = (*kept, outcome)
        decision = (commit.decision,) if commit.decision is not None else ()
        forgotten = self._slots.history.take_forgotten()
        return self._persist(
            (*kept, *decision, *forgotten), durability, partial(self._persisted, commit)
        )

    def _strictest(self, commit: _InFlight) -> Durability:
        """Return what a commit must survive; other shards rely on a decision, whatever its data."""
        decides = commit.decision is not None
        return Durability.DURABLE if decides else self._catalogue.strictest(commit.writes)

    def _persisted(self, commit: _InFlight, now_ns: int) -> Iterable[Effect]:
        """The store is done: apply, release and answer."""
        del self._in_flight[commit.outcome.lock]
        commit.tenure.committing = False
        return self._apply(commit, now_ns=now_ns)

    def _apply(self, commit: _InFlight, *, now_ns: int) -> Iterable[Effect]:
        lock, outcome = commit.outcome.lock, commit.outcome
        stamp_ns = outcome.position.stamp_ns
        changes = self.apply_writes(commit.writes, outcome.versions, stamp_ns, commit.cause)
        session = self._sessions.by_id.get(lock.session)
        lanes = session.lanes if session is not None else self._sessions.lanes_of(lock.session)
        if lanes is not None:
            if lock.lane not in lanes:
                lanes[lock.lane] = Lane()
            lane = lanes[lock.lane]
            # A commit whose client gave up may end after a newer one of its lane.
            if lane.outcome is None or lane.outcome.lock.seq < lock.seq:
                lane.outcome = outcome
        kept, ended = self._tenures.end_block(commit.tenure, keep=commit.keep, now_ns=now_ns)
        effects: list[Effect] = [*ended]
        self._counters["commits"] += 1
        committed = Committed(lock, outcome.position, outcome.versions, kept)
        for reply_to in commit.reply_to:
            effects += (Reply(reply_to, committed),)
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
        changes: list[SlotChange] = []
        size, replace = 0, self._slots.replace
        lineage = cause_bytes(cause) if cause is not None and cause.reads else 0
        for (_, datum), (slot, version) in zip(writes, versions, strict=True):
            captured_ns, own = 0, lineage
            if datum is not None:
                captured_ns, size = datum.stamp_ns, size + datum.size
                if not datum.file and datum.fault is None:
                    own += datum.size
            replace(slot, Content(version, stamp_ns, datum, _DELETED, cause, own))
            changes += (SlotChange(slot, version, stamp_ns, datum is None, captured_ns),)
        self._counters["bytes_written"] += size
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
        self, message: Commit | Prepare, tenure: Tenure | None, *, new: bool, wall_ns: int
    ) -> Fenced | Changed | EpochChanged | Refused | None:
        """Return why this holder may not write this now, `new` slots among it; None if it may."""
        # The fence comes first: what a stranger asks must not end the holder's lock.
        fenced = self._fence(message.lock, message.token, tenure)
        if fenced is not None:
            return fenced
        assert tenure is not None
        wrong = wrong_commit(message, peers=self._peers)
        if wrong is not None:
            return wrong
        if tenure.committing or tenure.prepared is not None:
            return Refused(PROTOCOL, f"{message.lock} is being committed in another way")
        wants, writes, whole = tenure.claim.wants, message.writes, True
        for slot, datum in writes:
            if datum is not None and len(datum.body) != datum.size:
                whole = False
            if not (slot in wants and wants[slot] is X) and not tenure.covers(slot):
                return Refused(PROTOCOL, f"{message.lock} does not hold {slot} for writing")
        if self._guard is not None and (denied := self._guard.may_not_write(writes, self._slots)):
            return denied
        if new:
            # Everybody whose pattern covers a slot must be able to read its name.
            for slot, _ in writes:
                wrong = wrong_name("entity", slot.entity, slashes=True)
                if wrong is not None and not self._slots.exists(slot):
                    return wrong
        seen_ns = message.seen_stamp_ns
        if seen_ns > wall_ns and self._stamps.too_far_ahead(seen_ns, wall_ns=wall_ns):
            ahead_s = (seen_ns - wall_ns) / 1e9
            return Refused(
                CLOCK_SKEW,
                f"the client has seen a commit stamped {ahead_s:.1f} s ahead of the clock of shard"
                f" {self._shard}; at most 1 s is accepted; set the clocks of both hosts",
                (str(ahead_s),),
            )
        return None if whole else missing_payload(writes)

    def _fence(
        self, lock: LockId, token: Token, tenure: Tenure | None
    ) -> Fenced | Changed | EpochChanged | Refused | None:
        """Return None only if exactly this grant is live, and this lock is its newest."""
        session = self._sessions.by_id.get(lock.session)
        if token.epoch != self._epoch or session is None or not session.present:
            self._counters["epoch_refusals"] += 1
            return EpochChanged(self._epoch)
        if tenure is None or tenure.token != token:
            lane = session.lanes.get(lock.lane)
            if lane is not None and lane.changed is not None and lane.changed.lock == lock:
                return lane.changed
            return self._tenures.fenced(lock, token)
        if tenure.kept:
            lane = session.lanes.get(lock.lane)
            if lane is not None and lock.seq <= lane.top:  # late: what it was built on may be gone
                return self._tenures.fenced(lock, token)
            if lane is None and len(session.lanes) >= LANES_MAX:
                return Refused(OVERLOAD, f"{LANES_MAX} lanes in one session")
        return None

    # ---------------------------------------------------------------- validate, outcome

    def validate(self, message: Validate, *, reply_to: int, now_ns: int) -> Iterable[Effect]:
        """Confirm that reads and expectations hold until now, and release the reads."""
        lock, token = message.lock, message.token
        if not token.number:
            return [Reply(reply_to, self._expected(message))]
        session = self._sessions.known(lock.session)
        lane = session.lanes.get(lock.lane) if session is not None else None
        if lane is not None and lane.validated == (lock, token):
            return [Reply(reply_to, Valid(lock, self._tenures.kept.told(lock, token)))]
        tenure = self._tenures.find(lock, token)
        fenced = self._fence(lock, token, tenure)
        if fenced is not None or tenure is None or tenure.bound:
            return [Reply(reply_to, fenced or self._tenures.fenced(lock, token))]
        assert session is not None
        moved = self.moved_on(message.expects, lock) if message.expects else None
        if moved is not None:
            return self.changed(lock, tenure, moved, reply_to=reply_to, now_ns=now_ns)
        lane = session.lane(lock.lane)
        lane.validated = (lock, token)
        if tenure.kept:
            lane.top = lock.seq
        kept, ended = self._tenures.end_block(tenure, keep=message.keep, now_ns=now_ns)
        self._counters["locks_validated"] += 1
        return [*ended, Reply(reply_to, Valid(lock, kept))]

    def _expected(self, message: Validate) -> Valid | Changed | EpochChanged:
        """Compare the expectations of a lock that holds nothing here."""
        if message.token.epoch != self._epoch or not self._sessions.known(message.lock.session):
            self._counters["epoch_refusals"] += 1
            return EpochChanged(self._epoch)
        moved = self.moved_on(message.expects, message.lock)
        if moved is None:
            return Valid(message.lock)
        self._counters["commits_changed"] += 1
        return Changed(message.lock, *moved)

    def outcome(self, message: Outcome, *, reply_to: int) -> Iterator[Effect]:
        """Say what became of a commit: committed, pending, never seen, or too old to tell."""
        recorded = self._recorded(message.lock)
        tenure = self._tenures.by_lock.get(message.lock)
        nothing = Position(0, self._shard)
        if recorded is not None:
            kind, position, versions = OUTCOME_COMMITTED, recorded.position, recorded.versions
        elif message.lock in self._in_flight or (
            tenure is not None and tenure.committing and not tenure.kept
        ):
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
        session = self._sessions.by_id.get(lock.session)
        lanes = session.lanes if session is not None else self._sessions.lanes_of(lock.session)
        if not lanes or lock.lane not in lanes:
            return None
        outcome = lanes[lock.lane].outcome
        return outcome if outcome is not None and outcome.lock == lock else None
