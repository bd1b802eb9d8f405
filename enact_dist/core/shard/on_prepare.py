"""The participant's half of a commit over shards: keep writes and locks until the decision arrives.

::

    Prepare ── fence, expectations ── Persist ── prepared ──┬─ Finish, or Resolved(committed):
                                                            │     Persist ── applied, freed
                                                            └─ Resolved(aborted): freed

Rules a change must keep
  * What is prepared ignores its client and every lease; only its primary's word ends it (or an
    operator's).  This shard asks for that word by itself, again and again, and at once when the
    primary comes back into reach: there is no coordinator, and no scan at a restart that could
    miss a late prepare.
  * `Finished` is said only when the end of the prepared state survives: after that the primary
    may forget, and would answer *aborted*.
  * No reader sees the writes before their record is durable (a restart must not take them back).
  * Promise and end are forced to the disk whatever the class of the data: a power cut that took
    the promise would tear the commit and free reads that the decision relies on; one that took the
    end would let this shard ask a primary that has forgotten.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, Final, cast

from enact_dist.core.protocol.checks import wrong_finish
from enact_dist.core.protocol.datum import LockId, Position
from enact_dist.core.protocol.messages import (
    RESOLVED_ABORTED,
    RESOLVED_COMMITTED,
    RESOLVED_OPEN,
    Broken,
    Finish,
    Finished,
    ForceAbort,
    Holder,
    Prepare,
    Prepared,
    Refused,
    Resolve,
    Resolved,
    SlotVersion,
)
from enact_dist.core.protocol.records import (
    AuditRecord,
    Call,
    Called,
    Effect,
    ForcedRecord,
    LogEvent,
    Persist,
    PreparedEnded,
    PreparedRecord,
    Record,
    Reply,
)
from enact_dist.core.shard.forced_aborts import ForcedAborts
from enact_dist.core.state.audit import FORCED
from enact_dist.core.state.clock import wrong_decision
from enact_dist.terms import Durability

if TYPE_CHECKING:
    from collections.abc import Generator, Iterable, Iterator

    from enact_dist.core.protocol.messages import Cause, WriteItem
    from enact_dist.core.protocol.records import ShardReturned
    from enact_dist.core.shard.state import ShardState
    from enact_dist.core.state.tenure import Tenure

ASK_NS_MAX: Final = 1_000_000_000
"""A prepared lock asks its primary at least so often (TTL / 2 of its session where shorter)."""
HINT_NS: Final = 50_000_000
"""After a release of a prepared lock the primary is asked so soon: it was probably released too."""


@dataclass(slots=True)
class _AtStore:
    """A preparation (no stamp) or an end, with the commit's stamp, that the store works on.

    Where an operator ends it, `forced` is what is kept of it; `told` is the position that its
    primary names too late.
    """

    tenure: Tenure
    record: PreparedRecord
    stamp_ns: int | None = None
    replies: list[int] = field(default_factory=list)
    forced: ForcedRecord | None = None
    holder: Holder | None = None
    operators: list[int] = field(default_factory=list)
    asked: ForceAbort | None = None
    told: Position | None = None


class PrepareHandler:
    """Everything that is prepared at this shard, and what it tells others about its own locks."""

    def __init__(
        self,
        state: ShardState,
        recovered: Iterable[PreparedRecord],
        forced: Iterable[ForcedRecord] = (),
    ) -> None:
        self._state = state
        self._at_store: dict[LockId, _AtStore] = {}
        self._ask_ns: dict[LockId, int] = {}
        self._refused: set[LockId] = set()
        self._forced = ForcedAborts(state, forced)
        for record in recovered:
            # Versions of volatile slots have started again.
            next_version = state.slots.next_version
            versions = tuple([SlotVersion(slot, next_version(slot)) for slot, _ in record.writes])
            record = replace(record, versions=versions)  # noqa: PLW2901 - the same, as of now
            state.tenures.restore(record, now_ns=state.now_ns)
            state.stamps.saw(record.stamp_ns)
            self._ask_ns[record.lock] = state.now_ns
            state.count("prepared_restored")

    # ---------------------------------------------------------------- prepare

    def on_prepare(self, message: Prepare, reply_to: int) -> Iterator[Effect]:
        """Keep writes for another shard's decision, or say why not."""
        state = self._state
        tenure = state.tenures.by_lock.get(message.lock)
        if tenure is not None and tenure.prepared is not None:
            state.count("prepares_repeated")
            yield Reply(reply_to, _prepared(tenure.prepared))
            return
        under_way = self._at_store.get(message.lock)
        if under_way is not None:
            under_way.replies.append(reply_to)
            return
        new = not state.slots.exist(message.writes)
        refusal = state.commits.refusal(message, tenure, new=new, wall_ns=state.wall_ns)
        if refusal is not None or tenure is None:
            yield Reply(reply_to, refusal)
            return
        moved = state.commits.moved_on(message.expects, message.lock)
        if moved is not None:
            yield from state.commits.changed(
                message.lock, tenure, moved, reply_to=reply_to, now_ns=state.now_ns
            )
            return
        stamp_ns = state.stamps.next(seen_ns=message.seen_stamp_ns, wall_ns=state.wall_ns)
        next_version = state.slots.next_version
        versions = tuple([SlotVersion(slot, next_version(slot)) for slot, _ in message.writes])
        session = state.sessions.by_id[message.lock.session]
        record = PreparedRecord(
            message.lock,
            message.token,
            tenure.items,
            message.writes,
            versions,
            stamp_ns,
            message.primary,
            message.primary_token,
            session.cause(message, versions, stamp_ns, state.now_ns - tenure.granted_ns),
        )
        state.pins.drop(message.lock)
        yield from self._persist(_AtStore(tenure, record, replies=[reply_to]), (record,))

    def _persist(self, work: _AtStore, records: tuple[Record, ...]) -> list[Effect]:
        work.tenure.committing = True
        self._at_store[work.record.lock] = work
        kept = (*records, *self._state.slots.history.take_forgotten())
        return self._state.persist(kept, Durability.DURABLE, partial(self._persisted, work))

    def _persisted(self, work: _AtStore, _: int) -> Iterator[Effect]:
        """The store is done with a preparation, or with the end of one."""
        tenure, record = work.tenure, work.record
        del self._at_store[record.lock]
        tenure.committing = False
        if work.forced is not None:
            yield from self._given_up(work, work.forced)
            return
        if work.stamp_ns is None:
            tenure.prepared = record
            self._ask_ns[record.lock] = self._state.now_ns + self._ask_again_ns(record.lock)
            self._state.count("prepared")
            for reply_to in work.replies:
                yield Reply(reply_to, _prepared(record))
            return
        commits = self._state.commits
        cause = _decided_cause(record, stamp_ns=work.stamp_ns)
        changes = commits.apply_writes(record.writes, record.versions, work.stamp_ns, cause)
        yield from self._end(tenure)
        self._state.count("commits_finished")
        for reply_to in work.replies:
            yield Reply(reply_to, Finished(record.lock))
        yield from commits.publish(changes)

    # ---------------------------------------------------------------- the decision

    def on_finish(self, message: Finish, reply_to: int) -> Iterator[Effect]:
        """The primary says: committed."""
        tenure = self._state.tenures.by_lock.get(message.lock)
        forced = self._forced.get(message.lock)
        prepared = tenure.prepared if tenure is not None else None
        if forced is None and prepared is None:
            self._state.count("finishes_repeated")
            yield Reply(reply_to, Finished(message.lock))
            return
        wrong = wrong_finish(message, (forced or cast("PreparedRecord", prepared)).primary)
        if wrong is not None:
            yield Reply(reply_to, wrong)
            return
        wrong = yield from self._wrong_decision(message.lock, message.position)
        if wrong is not None:
            yield Reply(reply_to, wrong)
        elif forced is not None:
            yield from self._forced.committed(message.lock, message.position, [reply_to])
        elif tenure is not None:
            yield from self._finish(tenure, message.position, [reply_to])

    def _wrong_decision(
        self, lock: LockId, position: Position
    ) -> Generator[Effect, None, Refused | None]:
        """Return why a decision is not taken with this stamp, and tell people once a lock."""
        wrong = wrong_decision(lock, position, self._state.stamps, wall_ns=self._state.wall_ns)
        if wrong is not None:
            self._state.count("decisions_refused")
            if lock not in self._refused:
                self._refused.add(lock)
                yield LogEvent("lock.in_doubt", wrong.text, grave=True)
        return wrong

    def _finish(self, tenure: Tenure, position: Position, replies: list[int]) -> Iterator[Effect]:
        record = tenure.prepared
        assert record is not None
        under_way = self._at_store.get(record.lock)
        if under_way is not None:
            under_way.replies += replies
            under_way.told = position
            return
        # Never before the stamp that views know of the lock, whatever its client said elsewhere.
        stamp_ns = max(position.stamp_ns, record.stamp_ns)
        self._state.stamps.saw(stamp_ns)
        cause = _decided_cause(record, stamp_ns=stamp_ns)
        written = self._state.commits.records(record.writes, record.versions, stamp_ns, cause)
        yield from self._persist(
            _AtStore(tenure, record, stamp_ns, replies), (*written, PreparedEnded(record.lock))
        )

    def _end(self, tenure: Tenure) -> Iterator[Effect]:
        tenure.prepared = None
        self._ask_ns.pop(tenure.lock, None)
        self._refused.discard(tenure.lock)
        yield from self._state.tenures.remove(tenure, now_ns=self._state.now_ns)

    def on_called(self, message: Called, _: int) -> Iterator[Effect]:
        """Another shard has answered."""
        request, answer = message.request, message.answer
        if isinstance(request, Finish) and isinstance(answer, Finished):
            yield from self._state.decisions.finished(request.lock, message.shard)
        if not (isinstance(request, Resolve) and isinstance(answer, Resolved)):
            return
        if answer.kind == RESOLVED_COMMITTED:
            wrong = yield from self._wrong_decision(request.lock, answer.position)
            if wrong is not None:
                return
        if request.lock in self._forced:
            yield from self._forced.resolved(answer)
            return
        tenure = self._state.tenures.by_lock.get(request.lock)
        if tenure is None or tenure.prepared is None:
            return
        if answer.kind == RESOLVED_COMMITTED:
            self._state.count("resolved_committed")
            yield from self._finish(tenure, answer.position, [])
        elif answer.kind == RESOLVED_ABORTED and not tenure.committing:
            self._state.count("resolved_aborted")
            told = self._state.tenures.told(tenure, self._state.now_ns)
            yield LogEvent("lock.aborted", f"{told}: {message.shard} has not committed it")
            yield Persist(0, (PreparedEnded(tenure.lock),), Durability.OS)
            yield from self._end(tenure)

    def on_resolve(self, message: Resolve, reply_to: int) -> Iterator[Effect]:
        """Another shard asks what became of a lock whose primary this is."""
        yield Reply(reply_to, self._resolved(message))

    def _resolved(self, message: Resolve) -> Resolved:
        state, lock = self._state, message.lock
        position = state.commits.position_of(lock)
        if position is not None:
            return Resolved(lock, RESOLVED_COMMITTED, position)
        tenure = state.tenures.by_lock.get(lock)
        nowhere = Position(0, state.settings.name)
        if tenure is not None and tenure.token == message.primary_token:
            return Resolved(lock, RESOLVED_OPEN, nowhere)
        return Resolved(lock, RESOLVED_ABORTED, nowhere)

    # ---------------------------------------------------------------- time and views

    def _ask_again_ns(self, lock: LockId) -> int:
        session = self._state.sessions.by_id.get(lock.session)
        return min(ASK_NS_MAX, session.ttl_ns // 2) if session is not None else ASK_NS_MAX

    def hint(self, lock: LockId) -> None:
        """The client has given up: its primary probably knows already."""
        if lock in self._ask_ns:
            self._ask_ns[lock] = min(self._ask_ns[lock], self._state.now_ns + HINT_NS)

    def ask(self) -> Iterator[Effect]:
        """Ask the primaries whose word is overdue."""
        now_ns, name = self._state.now_ns, self._state.settings.name
        for lock, due_ns in self._ask_ns.items():
            if due_ns > now_ns:
                continue
            record = self._state.tenures.by_lock[lock].prepared
            assert record is not None
            self._state.count("resolves_asked")
            yield Call(record.primary, Resolve(lock, record.primary_token, name))
            self._ask_ns[lock] = now_ns + self._ask_again_ns(lock)
        yield from self._forced.ask()

    def on_shard_returned(self, message: ShardReturned, _: int) -> Iterator[Effect]:
        """Another shard is in reach again: ask for its word, and say ours, without a pause."""
        state, shard = self._state, message.shard
        for lock in self._ask_ns:
            record = state.tenures.by_lock[lock].prepared
            if record is not None and record.primary == shard:
                self._ask_ns[lock] = state.now_ns
        self._forced.ask_now(shard)
        yield from self.ask()
        yield from state.decisions.tell_now(shard, state.now_ns)

    def next_deadline_ns(self) -> int | None:
        """Return when a primary is to be asked again."""
        forced_ns = self._forced.next_deadline_ns()
        others = () if forced_ns is None else (forced_ns,)
        return min((*self._ask_ns.values(), *others), default=None)

    def undecided(self) -> list[tuple[int, tuple[WriteItem, ...]]]:
        """Return stamps and writes of the commits that are not decided as far as is known here.

        The store works on them, or they are prepared for another shard's decision, or about to be.
        """
        records = [work.record for work in self._at_store.values()]
        tenures = map(self._state.tenures.by_lock.__getitem__, self._ask_ns)
        records += [one.prepared for one in tenures if one.prepared is not None]
        return [*self._state.commits.undecided(), *((one.stamp_ns, one.writes) for one in records)]

    # ---------------------------------------------------------------- people

    def on_force_abort(self, message: ForceAbort, reply_to: int) -> Iterator[Effect]:
        """Abort a prepared lock for an operator; audited, and durable before the answer."""
        state = self._state
        tenure = state.numbered(message.number, message.epoch)
        record = tenure.prepared if tenure is not None else None
        if tenure is None or record is None or tenure.committing:
            under_way = self._at_store.get(tenure.lock) if tenure is not None else None
            if under_way is not None and under_way.asked == message:
                under_way.operators.append(reply_to)
            else:
                yield Reply(reply_to, state.told_by_hand(message))
            return
        holder = state.tenures.describe(tenure, state.now_ns)
        why = message.reason or "no reason given"
        text = (
            f"prepared lock {message.number} ({tenure.lock}) of {holder.actor}@{holder.host} was"
            f" aborted by hand without the word of {record.primary}: {why}"
        )
        state.count("prepared_forced")
        slots = tuple(write.slot for write in record.writes)
        forced = ForcedRecord(tenure.lock, record.primary, record.primary_token, slots)
        work = _AtStore(tenure, record, forced=forced, holder=holder, asked=message)
        work.operators.append(reply_to)
        audit = state.audit.keep(AuditRecord(state.wall_ns, text, FORCED, state.asker))
        yield LogEvent("lock.forced", text, grave=True)
        yield from self._persist(work, (audit, forced, PreparedEnded(tenure.lock)))

    def _given_up(self, work: _AtStore, forced: ForcedRecord) -> Iterator[Effect]:
        """An abort by hand is durable: free the slots, and go on asking the lost shard."""
        yield from self._end(work.tenure)
        self._forced.add(forced)
        assert work.asked is not None
        broken = Broken(True, work.holder)
        self._state.by_hand[ForceAbort] = work.asked, broken
        for reply_to in work.operators:
            yield Reply(reply_to, broken)
        if work.told is not None:
            yield from self._forced.committed(forced.lock, work.told, work.replies)

    def assert_invariants(self) -> None:
        """Assert I10 and the bookkeeping.  For tests and simulation."""
        prepared = {
            lock for lock, t in self._state.tenures.by_lock.items() if t.prepared is not None
        }
        assert prepared == set(self._ask_ns), (prepared, self._ask_ns)
        for lock in prepared:
            assert self._state.tenures.by_lock[lock].claim.granted, "prepared without its locks"


def _prepared(record: PreparedRecord) -> Prepared:
    return Prepared(record.lock, record.stamp_ns, record.versions)


def _decided_cause(record: PreparedRecord, *, stamp_ns: int) -> Cause | None:
    """Return the cause of what was prepared, now that its stamp and its versions are certain."""
    if record.cause is None:
        return None
    return record.cause._replace(stamp_ns=stamp_ns, writes=record.versions)
