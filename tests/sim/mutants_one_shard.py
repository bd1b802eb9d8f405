"""Small wrong edits of the core of one shard and of its clients; the simulator must catch each.

A mutant is a function that replaces one decision of the core through `patch(owner, name, value)`.
The shard's own assertions are off while mutants run: what catches them is the judge.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

from enact_dist.core.client import lock as multilock
from enact_dist.core.client.client import Client
from enact_dist.core.client.finishing import Finishing
from enact_dist.core.client.lease_clock import SENDINGS_KEPT, Sendings
from enact_dist.core.client.lock import MultiLock
from enact_dist.core.client.plan import Phase
from enact_dist.core.protocol.datum import Token
from enact_dist.core.protocol.messages import Alive, Commit, Granted, GrantLeft, KeepAlive
from enact_dist.core.protocol.records import Content, Persist, Reply
from enact_dist.core.shard.on_session import SessionHandler
from enact_dist.core.shard.state import ShardState
from enact_dist.core.state import grants as tenures
from enact_dist.core.state import lock_table
from enact_dist.core.state import tenure as tenure_module
from enact_dist.core.state.catalogue import Catalogue
from enact_dist.core.state.clock import Stamps
from enact_dist.core.state.commits import Commits
from enact_dist.core.state.grants import Tenures
from enact_dist.core.state.lock_table import Mode
from enact_dist.core.state.sessions import Lane, SessionState, SessionTable
from enact_dist.core.state.slots import SlotMap
from enact_dist.core.state.tenure import Tenure
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
    lease_end_ns = SessionState.lease_end_ns
    patch(SessionState, "lease_end_ns", lambda s, now_ns: lease_end_ns(s, now_ns) - s.ttl_ns // 10)


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
    wants_of = tenure_module.wants_of

    def wrong(items: Any) -> Any:
        return wants_of([item for item in items if item.access < 4])

    for module in (tenures, tenure_module):
        patch(module, "wants_of", wrong)


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
        return self._sent[self.count % SENDINGS_KEPT] + duration_ns

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
    on_keep_alive = SessionHandler.on_keep_alive

    def wrong(self: SessionHandler, message: KeepAlive, reply_to: int) -> Any:
        blind = KeepAlive(message.session, message.epoch, message.count, (), message.report)
        yield from on_keep_alive(self, blind, reply_to)

    patch(SessionHandler, "on_keep_alive", wrong)


def no_hold_limit(patch: Patch) -> None:
    """A hung holder that stays alive keeps its lock."""
    patch(Tenures, "held_too_long", lambda _tenures, _now_ns: [])


def tells_before_it_is_kept(patch: Patch) -> None:
    """A commit is applied and told while the disk still works on it."""

    def wrong(self: Commits, commit: Any, *, now_ns: int) -> Any:
        outcome = commit.outcome
        stamp_ns, cause = outcome.position.stamp_ns, commit.cause
        records = self.records(commit.writes, outcome.versions, stamp_ns, cause)
        decision = (commit.decision,) if commit.decision is not None else ()
        yield Persist(0, (*records, outcome, *decision), Durability.DURABLE)
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
        finishing = self.finishing
        assert finishing is not None
        for shard in [shard for shard in finishing.left if shard not in finishing.writes]:
            del finishing.left[shard]
        after_votes(self)

    patch(MultiLock, "_after_votes", wrong)


def welcomes_early(patch: Patch) -> None:
    """Welcome and Registered do not wait for the disk."""

    def wrong(
        self: SessionHandler, reply_to: int, answer: Any, records: Any, *_: Any, **_options: Any
    ) -> Any:
        for session in self._state.sessions:
            session.present = session.durable = True
        yield Reply(reply_to, answer)
        if records:
            yield Persist(0, records, Durability.DURABLE)

    patch(SessionHandler, "answer_when_durable", wrong)


def stamps_follow_the_wall_clock(patch: Patch) -> None:
    """Stamps are what the wall clock says, also when it was set back."""
    patch(Stamps, "next", lambda _stamps, *, wall_ns, **_options: wall_ns)


def numbers_start_anew(patch: Patch) -> None:
    """Tokens say nothing of the epoch, so they repeat after a restart."""
    begin = Tenures._begin

    def wrong(self: Tenures, tenure: Tenure, **options: Any) -> None:
        begin(self, tenure, **options)
        assert tenure.token is not None
        tenure.token = Token(1, tenure.token.number)

    patch(Tenures, "_begin", wrong)


def retries_with_another_commit(patch: Patch) -> None:
    """A client that hears nothing takes its lock for lost and its thread starts over."""
    patch(multilock, "RETRY_NS_MIN", 1)
    patch(MultiLock, "_on_outcome", lambda lock, _answer, _now_ns: lock._end(Phase.LOST))


def takes_a_commit_without_record_for_lost(patch: Patch) -> None:
    """A client takes the silence of a restarted shard for the word that nothing was committed."""
    patch(Finishing, "_known_in", lambda _self: 0)


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


def believes_without_the_list(patch: Patch) -> None:
    """A client takes any answer to its keep-alive for a renewal of all its locks."""

    def wrong(self: Client, shard: str, request: Any, answer: Any, now_ns: int) -> None:
        if answer.epoch != self.epoch(shard):
            return
        until_ns = self.sendings.believe_until_ns(answer.count_seen, self.ttl_ns)
        for lock in self.live_locks():
            for part in lock.parts:
                if part.shard == shard and part.token is not None:
                    part.until_ns = max(part.until_ns, until_ns)

    patch(Client, "_alive", wrong)


def counts_the_hold_from_its_own_grant(patch: Patch) -> None:
    """A client takes its hold limit to begin when the grant arrives."""
    on_acquiring = MultiLock._on_acquiring

    def wrong(self: MultiLock, shard: str, answer: Any, now_ns: int) -> None:
        if isinstance(answer, Granted):
            answer = replace(answer, hold_left_ns=self.hold_ns)
        on_acquiring(self, shard, answer, now_ns)

    patch(MultiLock, "_on_acquiring", wrong)


def restarts_in_the_same_epoch(patch: Patch) -> None:
    """A restarted shard goes on in the epoch of its first start."""
    init = ShardState.__init__

    def wrong(self: ShardState, settings: Any, recovered: Any, **options: Any) -> None:
        init(self, settings, replace(recovered, epoch=1_700_000_000), **options)

    patch(ShardState, "__init__", wrong)


def grace_is_too_short(patch: Patch) -> None:
    """The grace after a restart lasts half a TTL."""
    init = SessionTable.__init__

    def wrong(self: SessionTable, *args: Any, now_ns: int, **options: Any) -> None:
        init(self, *args, now_ns=now_ns, **options)
        self.grace_end_ns -= (self.grace_end_ns - now_ns) // 2

    patch(SessionTable, "__init__", wrong)


def deleted_slots_start_anew(patch: Patch) -> None:
    """A slot that is set to null forgets its version."""
    put = SlotMap.replace

    def wrong(self: SlotMap, slot: Any, content: Content, **options: Any) -> None:
        kept = content if content.datum is not None else replace(content, version=0)
        put(self, slot, kept, **options)

    patch(SlotMap, "replace", wrong)


def forgets_a_slot_at_a_restart(patch: Patch) -> None:
    """A restart loses the last of the slots that the store gives back."""
    init = SlotMap.__init__

    def wrong(self: SlotMap, recovered: Any, **options: Any) -> None:
        init(self, list(recovered)[:-1], **options)

    patch(SlotMap, "__init__", wrong)


def all_data_may_be_lost(patch: Patch) -> None:
    """Durable data are kept as carelessly as those of class `os`."""
    durability = Catalogue.durability

    def wrong(self: Catalogue, aspect: str) -> Durability:
        kept = durability(self, aspect)
        return Durability.OS if kept is Durability.DURABLE else kept

    patch(Catalogue, "durability", wrong)


def keeps_every_outcome(patch: Patch) -> None:
    """The outcome table has an entry for each lock instead of one for each lane."""
    apply = Commits._apply

    def wrong(self: Commits, commit: Any, *, now_ns: int) -> Any:
        yield from apply(self, commit, now_ns=now_ns)
        lock = commit.tenure.lock
        lanes = self._sessions.lanes_of(lock.session)
        if lanes is not None:
            lanes[1000 + lock.seq] = Lane(outcome=commit.outcome)

    patch(Commits, "_apply", wrong)


def renews_what_is_over(patch: Patch) -> None:
    """A shard answers a keep-alive as if the locks that it took away were still there."""
    take_away, on_keep_alive = Tenures.take_away, SessionHandler.on_keep_alive
    gone: dict[Any, Tenure] = {}

    def taking(self: Tenures, tenure: Tenure, cause: str, *, now_ns: int) -> Any:
        if tenure.token is not None:
            gone[tenure.lock] = tenure
        yield from take_away(self, tenure, cause, now_ns=now_ns)

    def wrong(self: SessionHandler, message: KeepAlive, reply_to: int) -> Any:
        lowest = {view.lane: view.seq for view in message.view}
        for effect in on_keep_alive(self, message, reply_to):
            answer = effect.answer if isinstance(effect, Reply) else None
            if isinstance(answer, Alive):
                more = tuple(
                    GrantLeft(lock, tenure.token, tenure.hold_ns)
                    for lock, tenure in gone.items()
                    if lock.session == message.session and lock.seq == lowest.get(lock.lane)
                )
                effect = Reply(reply_to, replace(answer, grants=(*answer.grants, *more)))  # noqa: PLW2901
            yield effect

    patch(Tenures, "take_away", taking)
    patch(SessionHandler, "on_keep_alive", wrong)
