"""Small wrong edits of the core, each of which the simulator must catch.

A mutant is a function that replaces one decision of the core through `patch(owner, name, value)`.
The shard's own assertions are off while mutants run: what catches them is the judge.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

from enact_dist.core import lock_table, multilock, tenures
from enact_dist.core.beliefs import Sendings
from enact_dist.core.client import Client
from enact_dist.core.commits import Commits
from enact_dist.core.cuts import Cut
from enact_dist.core.datum import Token
from enact_dist.core.decisions import Decisions
from enact_dist.core.lock_table import Mode
from enact_dist.core.messages import Commit, KeepAlive
from enact_dist.core.multilock import MultiLock, Phase
from enact_dist.core.prepares import PrepareDesk
from enact_dist.core.records import Persist, Reply
from enact_dist.core.session_desk import SessionDesk
from enact_dist.core.sessions import Lane, Session, SessionTable
from enact_dist.core.slots import Content
from enact_dist.core.stamps import Stamps
from enact_dist.core.tenures import Tenure, Tenures
from enact_dist.core.view_desk import ViewDesk
from enact_dist.terms import Durability, NullReason

if TYPE_CHECKING:
    from collections.abc import Callable

    Patch = Callable[[Any, str, Any], None]


def no_fence(patch: Patch) -> None:
    """A commit is applied though its lock was taken away."""
    buried: dict[Any, Tenure] = {}
    remove, commit = Tenures.remove, Commits.commit

    def burying(self: Tenures, tenure: Tenure, *, now_ns: int) -> Any:
        if tenure.lock in self.by_lock:
            buried[tenure.lock] = tenure
            yield from remove(self, tenure, now_ns=now_ns)

    def digging(self: Commits, message: Commit, **options: Any) -> Any:
        ghost = buried.get(message.lock)
        absent = message.lock not in self._tenures.by_lock
        if absent and ghost is not None and ghost.token == message.token:
            self._tenures.table.enqueue(message.lock, {})
            self._tenures.by_lock[message.lock] = ghost
            self._tenures.by_session.setdefault(message.lock.session, {})[message.lock] = ghost
        yield from commit(self, message, **options)

    patch(Tenures, "remove", burying)
    patch(Commits, "commit", digging)


def expires_early(patch: Patch) -> None:
    """A lease ends a tenth of its TTL too early."""
    lease_end_ns = Session.lease_end_ns
    patch(Session, "lease_end_ns", lambda s, now_ns: lease_end_ns(s, now_ns) - s.ttl_ns // 10)


def barges(patch: Patch) -> None:
    """A newcomer passes waiters that conflict with it."""
    patch(
        lock_table._Queue,
        "admits",
        lambda q, mode: not any(q.held_modes[other] for other in lock_table.CONFLICTS[mode]),
    )
    patch(lock_table._Queue, "_first_conflicting_ticket", lambda _q, _mode: 1 << 62)


def forgets_to_wake(patch: Patch) -> None:
    """A release does not look for who may go on."""
    patch(lock_table._Queue, "newly_eligible", lambda _queue: [])


def readers_do_not_block(patch: Patch) -> None:
    """A writer does not wait for readers."""
    wrong = tuple(
        tuple(m for m in conflicts if m is not Mode.S) for conflicts in lock_table.CONFLICTS
    )
    patch(lock_table, "CONFLICTS", wrong)


def patterns_lock_nothing(patch: Patch) -> None:
    """A pattern does not lock its column against newcomers."""
    wants_of = tenures.wants_of

    def wrong(items: Any) -> Any:
        return wants_of([item for item in items if item.access < 4])

    patch(tenures, "wants_of", wrong)


def blind_acknowledgement(patch: Patch) -> None:
    """Any hello counts as an acknowledgement of the new epoch."""
    hello = SessionTable.hello

    def wrong(self: SessionTable, message: Any, **options: Any) -> Any:
        session, unrecorded = hello(self, message, **options)
        session.acknowledged = True
        return session, unrecorded

    patch(SessionTable, "hello", wrong)


def no_grace(patch: Patch) -> None:
    """A restarted shard grants at once."""
    patch(SessionTable, "in_grace", lambda _table, _now_ns: False)


def keeps_old_grants(patch: Patch) -> None:
    """A client acknowledges a new epoch without dropping what it holds."""
    patch(Client, "_drop_grants", lambda _client, _shard: None)


def believes_from_newest_sending(patch: Patch) -> None:
    """A client counts its belief from the newest message it sent, seen or not."""

    def wrong(self: Sendings, _count_seen: int, duration_ns: int) -> int:
        return self._sent.get(self.count, 0) + duration_ns

    patch(Sendings, "believe_until_ns", wrong)


def no_record_of_outcomes(patch: Patch) -> None:
    """A repeated commit or question finds no record of the first."""
    patch(Commits, "_recorded", lambda _commits, _lock: None)


def guesses_lost_answers(patch: Patch) -> None:
    """A client takes the silence after a commit for a no."""
    silent = MultiLock._silent

    def wrong(self: MultiLock, shard: str, request: Any, now_ns: int) -> None:
        if isinstance(request, Commit):
            self._end(Phase.LOST)
        else:
            silent(self, shard, request, now_ns)

    patch(MultiLock, "_silent", wrong)


def no_reconciliation(patch: Patch) -> None:
    """Keep-alives free nothing: lost releases and orphan grants stay."""
    on_keep_alive = SessionDesk.on_keep_alive

    def wrong(self: SessionDesk, message: KeepAlive, reply_to: int) -> Any:
        blind = KeepAlive(message.session, message.epoch, message.count, (), message.report)
        yield from on_keep_alive(self, blind, reply_to)

    patch(SessionDesk, "on_keep_alive", wrong)


def no_hold_limit(patch: Patch) -> None:
    """A hung holder that stays alive keeps its lock."""
    patch(Tenures, "held_too_long", lambda _tenures, _now_ns: [])


def tells_before_it_is_kept(patch: Patch) -> None:
    """A commit is applied and told while the disk still works on it."""

    def wrong(self: Commits, commit: Any, *, now_ns: int) -> Any:
        stamp_ns = commit.outcome.position.stamp_ns
        records = self.records(commit.writes, commit.outcome.versions, stamp_ns)
        decision = (commit.decision,) if commit.decision is not None else ()
        yield Persist(0, (*records, commit.outcome, *decision), Durability.DURABLE)
        yield from self._apply(commit, now_ns=now_ns)

    patch(Commits, "_make_durable", wrong)


def commits_in_flight_expire(patch: Patch) -> None:
    """A lease that ends takes the lock of a commit that the disk works on."""
    held = Tenure.committing
    patch(Tenure, "committing", property(lambda _t: False, lambda _t, _v: None))
    assert held is not None


def grants_a_seq_again(patch: Patch) -> None:
    """A seq that was granted and given back is queued again."""
    patch(Lane, "top", property(lambda _lane: 0, lambda _lane, _value: None))


def expects_in_vain(patch: Patch) -> None:
    """A commit does not look whether its expected views still stand."""
    patch(Commits, "moved_on", lambda _commits, _expects, _lock: None)


def skips_validation(patch: Patch) -> None:
    """Reads on other shards, and read-only locks, are not validated at the end."""
    after_votes = MultiLock._after_votes

    def wrong(self: MultiLock) -> None:
        finishing = self._finishing
        assert finishing is not None
        for shard in [shard for shard in finishing.left if shard not in finishing.writes]:
            del finishing.left[shard]
        after_votes(self)

    patch(MultiLock, "_after_votes", wrong)


def welcomes_early(patch: Patch) -> None:
    """Welcome and Registered do not wait for the disk."""

    def wrong(self: SessionDesk, reply_to: int, answer: Any, records: Any) -> Any:
        for session in self._state.sessions:
            session.present = session.durable = True
        self._ticket -= 1
        yield Reply(reply_to, answer)
        if records:
            yield Persist(0, records, Durability.DURABLE)

    patch(SessionDesk, "_answer_when_durable", wrong)


def stamps_follow_the_wall_clock(patch: Patch) -> None:
    """Stamps are what the wall clock says, also when it was set back."""
    patch(Stamps, "next", lambda _stamps, *, wall_ns, **_options: wall_ns)


def numbers_start_anew(patch: Patch) -> None:
    """Tokens say nothing of the epoch, so they repeat after a restart."""
    grant_ready = Tenures.grant_ready

    def wrong(self: Tenures, **options: Any) -> Any:
        effects = list(grant_ready(self, **options))
        for tenure in self.by_lock.values():
            if tenure.token is not None:
                tenure.token = Token(1, tenure.token.number)
        yield from effects

    patch(Tenures, "grant_ready", wrong)


def retries_with_another_commit(patch: Patch) -> None:
    """A client that hears nothing takes its lock for lost and its thread starts over."""
    patch(multilock, "RETRY_NS_MIN", 1)
    patch(MultiLock, "_on_outcome", lambda lock, _answer, _now_ns: lock._end(Phase.LOST))


def shows_before_it_is_kept(patch: Patch) -> None:
    """Readers see a commit while the disk still works on it."""
    make_durable = Commits._make_durable

    def wrong(self: Commits, commit: Any, *, now_ns: int) -> Any:
        for write, (slot, version) in zip(commit.writes, commit.outcome.versions, strict=True):
            stamp_ns = commit.outcome.position.stamp_ns
            self._slots.set(slot, Content(version, stamp_ns, write.datum, NullReason.DELETED))
        yield from make_durable(self, commit, now_ns=now_ns)

    patch(Commits, "_make_durable", wrong)


def asks_shards_in_the_order_of_the_request(patch: Patch) -> None:
    """A lock over several shards acquires them in the order in which they are named."""
    plan = Client.plan

    def wrong(self: Client, items: Any, **options: Any) -> Any:
        sorted_plan = plan(self, items, **options)
        first = {item.entity: number for number, item in enumerate(items)}
        locks = sorted(sorted_plan.locks, key=lambda part: first[part[1][0].entity])
        return replace(sorted_plan, locks=tuple(locks))

    patch(Client, "plan", wrong)


def keeps_one_outcome_per_session(patch: Patch) -> None:
    """The outcome table forgets a thread's commit when another thread commits."""
    recorded = Commits._recorded
    newest: dict[str, Any] = {}
    apply = Commits._apply

    def applying(self: Commits, commit: Any, *, now_ns: int) -> Any:
        newest[commit.tenure.lock.session] = commit.tenure.lock
        yield from apply(self, commit, now_ns=now_ns)

    def wrong(self: Commits, lock: Any) -> Any:
        return recorded(self, lock) if newest.get(lock.session, lock) == lock else None

    patch(Commits, "_apply", applying)
    patch(Commits, "_recorded", wrong)


def prepared_locks_expire(patch: Patch) -> None:
    """A lease, a release or a keep-alive ends a prepared lock."""
    patch(Tenure, "bound", property(lambda tenure: tenure.committing))

    ask = PrepareDesk.ask

    def asking(self: PrepareDesk) -> Any:
        for lock in [lock for lock in self._ask_ns if lock not in self._state.tenures.by_lock]:
            del self._ask_ns[lock]
        yield from ask(self)

    patch(PrepareDesk, "ask", asking)
    undecided = PrepareDesk.undecided

    def known(self: PrepareDesk) -> Any:
        for lock in [lock for lock in self._ask_ns if lock not in self._state.tenures.by_lock]:
            del self._ask_ns[lock]
        yield from undecided(self)

    patch(PrepareDesk, "undecided", known)


def promises_before_it_is_kept(patch: Patch) -> None:
    """Prepared is answered while the disk still works on the record."""
    on_prepare = PrepareDesk.on_prepare

    def wrong(self: PrepareDesk, message: Any, reply_to: int) -> Any:
        for effect in on_prepare(self, message, reply_to):
            if isinstance(effect, Persist):
                work = self._at_store[effect.ticket]
                replies, work.replies = work.replies, []
                for reply in replies:
                    yield Reply(reply, self._prepared(work.record))
            yield effect

    patch(PrepareDesk, "on_prepare", wrong)


def aborts_what_is_open(patch: Patch) -> None:
    """A primary that has not decided yet says that it never will."""
    resolved = PrepareDesk._resolved

    def wrong(self: PrepareDesk, message: Any) -> Any:
        answer = resolved(self, message)
        return replace(answer, kind="aborted") if answer.kind == "open" else answer

    patch(PrepareDesk, "_resolved", wrong)


def forgets_decisions_at_a_restart(patch: Patch) -> None:
    """A restarted primary knows neither decisions nor outcomes."""
    patch(Commits, "position_of", lambda _self, _lock: None)


def loses_prepared_at_a_restart(patch: Patch) -> None:
    """A restarted participant has forgotten what it has prepared."""
    init = PrepareDesk.__init__
    patch(PrepareDesk, "__init__", lambda self, state, _recovered: init(self, state, ()))


def never_tells_participants(patch: Patch) -> None:
    """Neither a decision is told nor is it asked for."""
    patch(Decisions, "tell", lambda _self, _now_ns: iter(()))
    patch(PrepareDesk, "ask", lambda _self: iter(()))


def commits_without_votes(patch: Patch) -> None:
    """A client commits though a participant has not prepared yet."""

    def wrong(self: MultiLock) -> None:
        if self._finishing is not None and self._finishing.primary:
            self.phase = Phase.COMMITTING
        else:
            after_votes(self)

    after_votes = MultiLock._after_votes
    patch(MultiLock, "_after_votes", wrong)


def expects_beside_writers(patch: Patch) -> None:
    """An expected view does not mind that another lock holds the slot for writing."""
    patch(Commits, "_in_the_way", lambda _self, _slot, _lock: False)


def takes_the_first_views(patch: Patch) -> None:
    """Views over several shards are taken as they come, of one cut or not."""
    patch(Cut, "settled", lambda cut, _epoch: cut._answers)


def views_do_not_wait_for_the_undecided(patch: Patch) -> None:
    """A view promises to be current though a prepared commit may come before its end."""
    patch(ViewDesk, "_undecided_ns", lambda _desk, _items: 1 << 62)


ALL = (
    no_fence,
    expires_early,
    barges,
    forgets_to_wake,
    readers_do_not_block,
    patterns_lock_nothing,
    blind_acknowledgement,
    no_grace,
    keeps_old_grants,
    believes_from_newest_sending,
    no_record_of_outcomes,
    guesses_lost_answers,
    no_reconciliation,
    no_hold_limit,
    tells_before_it_is_kept,
    commits_in_flight_expire,
    grants_a_seq_again,
    expects_in_vain,
    skips_validation,
    welcomes_early,
    stamps_follow_the_wall_clock,
    numbers_start_anew,
    retries_with_another_commit,
    shows_before_it_is_kept,
    asks_shards_in_the_order_of_the_request,
    keeps_one_outcome_per_session,
    prepared_locks_expire,
    promises_before_it_is_kept,
    aborts_what_is_open,
    forgets_decisions_at_a_restart,
    loses_prepared_at_a_restart,
    never_tells_participants,
    commits_without_votes,
    expects_beside_writers,
    takes_the_first_views,
    views_do_not_wait_for_the_undecided,
)
