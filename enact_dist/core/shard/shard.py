"""One shard: every decision about its slots, as messages in and effects out.

`Shard.handle(message, …)` is the only mutator.  Time and reply handles come in as arguments;
nothing here waits, reads a clock or draws a random number.  Each request is answered by exactly
one `Reply`, at once or (a parked `Acquire` or `AwaitStamp`) later.

Start of an epoch: the store has made the new epoch durable.  Until every recovered session has
acknowledged it, or could no longer believe in an older grant, the shard queues locks and grants
none (the grace); everything that needs no grant is answered.

Departures from the paper: it knows one process; leases, tokens, epochs and the shard itself are
ours.  Its rule *one lock per thread* is the lane: a newer seq ends the older one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import Final, cast

from enact_dist.core.protocol.checks import wrong_patterns
from enact_dist.core.protocol.messages import (
    PAGED,
    VALUE,
    Acquire,
    AwaitStamp,
    Break,
    Broken,
    Commit,
    DropWorld,
    EpochChanged,
    Explain,
    Fetch,
    FindEffects,
    Finish,
    ForceAbort,
    Fork,
    Goodbye,
    Hello,
    KeepAlive,
    KeepVersions,
    ListAudit,
    ListHistory,
    ListLocks,
    ListPlaces,
    ListRefusals,
    ListSessions,
    Notice,
    Outcome,
    Ping,
    Places,
    Prepare,
    Refusals,
    Refused,
    Register,
    Release,
    Request,
    Resolve,
    Stage,
    Survey,
    TakeView,
    Validate,
)
from enact_dist.core.protocol.records import (
    AuditRecord,
    Called,
    Drain,
    Effect,
    Event,
    MakeRoom,
    Persisted,
    Publish,
    Record,
    Recovered,
    Reply,
    Served,
    SessionBarred,
    SessionDied,
    SessionSeen,
    ShardReturned,
    Tick,
)
from enact_dist.core.rights.rules import Rights
from enact_dist.core.shard import inspection, owners
from enact_dist.core.shard.on_history import HistoryHandler, LineageHandler
from enact_dist.core.shard.on_lock import LockHandler
from enact_dist.core.shard.on_prepare import PrepareHandler
from enact_dist.core.shard.on_session import SessionHandler
from enact_dist.core.shard.on_view import StampHandler, ViewHandler
from enact_dist.core.shard.on_world import WorldHandler
from enact_dist.core.shard.places import PlaceHandler
from enact_dist.core.shard.state import ShardSettings, ShardState
from enact_dist.core.state.audit import BROKEN, SETTLED
from enact_dist.core.state.grants import HELD_TOO_LONG
from enact_dist.terms import Durability

_DECIDE: Final = frozenset((Persisted, Called, Drain))
"""After these, what was undecided may be decided; without a store after any message."""


LOOK_AGAIN_NS: Final = 20_000_000
"""How soon a shard looks again whether a recalled grant is still in use: word of its end may be
lost, with a client that was interrupted."""


class Shard:
    """The whole state of one shard.  See the module docstring for the rules."""

    def __init__(
        self, settings: ShardSettings, recovered: Recovered, *, now_ns: int, wall_ns: int
    ) -> None:
        self.state = ShardState(settings, recovered, now_ns=now_ns, wall_ns=wall_ns)
        self.settings, self.epoch = settings, self.state.epoch
        self._sessions = SessionHandler(self.state)
        self._prepares = PrepareHandler(self.state, recovered.prepared, recovered.forced)
        self._locks = LockHandler(self.state, self._prepares)
        self._history = HistoryHandler(self.state, self._sessions, self._prepares)
        self._views = ViewHandler(self.state, self._locks, self._prepares)
        self._worlds = WorldHandler(self.state, self._prepares)
        self._places = PlaceHandler(self.state)
        lineage = LineageHandler(self.state)
        self._stamps = StampHandler(self.state, self._prepares)
        self._handlers: dict[type, Callable[..., Iterable[Effect]]] = {
            Hello: self._sessions.on_hello,
            Register: self._sessions.on_register,
            KeepAlive: self._sessions.on_keep_alive,
            Goodbye: self._sessions.on_goodbye,
            SessionSeen: self._sessions.on_session_seen,
            SessionDied: self._sessions.on_session_died,
            SessionBarred: self._sessions.on_session_barred,
            Acquire: self._locks.on_acquire,
            TakeView: self._views.on_take_view,
            Fetch: self._locks.on_fetch,
            Release: self._locks.on_release,
            Commit: self._on_commit,
            Outcome: self._on_outcome,
            Validate: self._on_validate,
            Prepare: self._prepares.on_prepare,
            Finish: self._prepares.on_finish,
            Resolve: self._prepares.on_resolve,
            Called: self._on_called,
            ShardReturned: self._on_shard_returned,
            ForceAbort: self._prepares.on_force_abort,
            AwaitStamp: self._stamps.on_await_stamp,
            Ping: self._on_ping,
            ListPlaces: self._places.on_list_places,
            Served: self._places.on_served,
            Survey: self._on_survey,
            ListLocks: self._on_list_locks,
            ListSessions: self._on_list_sessions,
            Break: self._on_break,
            ListAudit: self._on_list_audit,
            ListRefusals: self._on_list_refusals,
            Explain: lineage.on_explain,
            FindEffects: lineage.on_find_effects,
            Fork: self._worlds.on_fork,
            DropWorld: self._worlds.on_drop,
            Stage: self._on_stage,
            Persisted: self._on_persisted,
            Tick: self._on_tick,
            Drain: self._on_drain,
            ListHistory: self._history.on_list_history,
            KeepVersions: self._history.on_keep_versions,
            MakeRoom: self._history.on_make_room,
        }

        for kind in PAGED:
            self._handlers[kind] = self._paged(self._handlers[kind])

    def _paged(self, handler: Callable[..., Iterable[Effect]]) -> Callable[..., Iterable[Effect]]:
        """Return the handler of a paged request, which refuses a cursor of another epoch."""

        def paged(message: Request, reply_to: int) -> Iterator[Effect]:
            if message.after.epoch in (0, self.epoch):  # type: ignore[union-attr]  # a paged one
                yield from handler(message, reply_to)
            else:
                self.state.count("epoch_refusals")
                yield Reply(reply_to, EpochChanged(self.epoch))

        return paged

    # ---------------------------------------------------------------- the one mutator

    def handle(
        self,
        message: Request | Event,
        *,
        reply_to: int = 0,
        identity: str = "",
        subject: str | None = None,
        now_ns: int,
        wall_ns: int,
    ) -> list[Effect]:
        """Take one message and return what is to be done about it, in order.

        Args:
            message: A request of a client, or an event of this host.
            reply_to: Handle under which the request's answer will be asked to be sent.
            identity: The caller, as the transport knows it; see `core.shard.owners`.
            subject: Whose rights it uses, see `core.rights.rules`; None: no name is proven.
            now_ns: This host's monotonic clock.
            wall_ns: This host's wall clock, since 1970; used for stamps only.
        """
        state = self.state
        gap_ns = now_ns - state.now_ns
        if gap_ns > 0:
            if gap_ns > (state.sessions.shortest_ttl_ns or state.settings.ttl_ns_max) // 4:
                self._stalled(gap_ns)
            state.now_ns = now_ns
        state.wall_ns, state.asker = wall_ns, identity
        stamps, ahead_ns = state.stamps, wall_ns - state.now_ns
        if ahead_ns > stamps.ahead_ns:  # noqa: PLR1730 - as in `Stamps.next`
            stamps.ahead_ns = ahead_ns
        stamps.wall_ns_max = state.now_ns + stamps.ahead_ns
        refusal = (
            owners.refusal(message, identity, state.sessions, state.epoch) if identity else None
        )
        guard = state.guard
        if guard is not None:
            refusal = refusal or self.denied(message, identity, subject)
        if refusal is None:
            found = self._handlers[type(message)](message, reply_to)
            effects: list[Effect] = found if type(found) is list else list(found)
        else:
            effects = [Reply(reply_to, refusal)]
            if type(refusal) is EpochChanged:
                state.count("epoch_refusals")
            elif guard is None or not guard.denials:
                state.count("requests_refused")
        if guard is not None and guard.denials:
            effects += guard.log_events(now_ns, wall_ns)
        if self._stamps.waits and not state.stored:
            effects += self._stamps.answer_reached()
        if self._views.waits or self._worlds.waits:
            decided = not state.stored or type(message) in _DECIDE
            effects += self._views.answer_parked(decided=decided)
            effects += self._worlds.answer_waiting(decided=decided)
        if state.standing.by_lane:
            changed = [
                change.slot
                for effect in effects
                if type(effect) is Publish
                for change in cast("Notice", effect.notice).changes
            ]
            if changed:
                effects += self._locks.begin_standing(changed)
        if state.tenures.kept.untold:
            effects += self._sessions.tell_recalled()
        if state.tenures.table.ready:
            effects += state.grant_ready()
        return effects

    def denied(
        self, message: Request | Event, identity: str, subject: str | None
    ) -> Refused | None:
        """Return why a sender has not the right to ask that, else None; see `handle`."""
        state = self.state
        if state.guard is None:
            return None
        state.guard.begin(identity, subject)
        if isinstance(message, Acquire | TakeView):
            session = state.sessions.by_id.get(message.lock.session)
            if message.epoch != state.epoch or session is None or not session.present:
                return None  # its answer is that the epoch has changed
            known = state.tenures.by_lock.get(message.lock)
            if known is not None and type(message) is Acquire:
                return state.guard.refusal_of(known.items)  # whatever this copy asks for
        return state.guard.refusal(message, state.catalogue.worlds)

    def take_rights(self, rights: Rights) -> None:
        """Replace the rights, from the next message on; held locks end with their commit.

        Raises:
            ValueError: The shard was started without rights.
        """
        if self.state.guard is None:
            raise ValueError("a shard that was started without rights takes none later")
        self.state.guard.rights = rights
        kept = self.state.tenures.kept
        for tenure in list(kept.by_number.values()):
            kept.recall(tenure, now_ns=self.state.now_ns)

    def keep_nothing(self) -> None:
        """Go on without a store from the start: what waits for records does so at once."""
        self.state.stored = False

    def _stalled(self, gap_ns: int) -> None:
        """Extend all leases by the time that this host itself stood still."""
        self.state.sessions.stalled(gap_ns)
        self.state.tenures.stalled(gap_ns)
        self.state.count("stalls")

    def next_deadline_ns(self) -> int:
        """Return the monotonic time at which a `Tick` is due at the latest."""
        now_ns = self.state.now_ns
        at_latest_ns = now_ns + self.state.shortest_ttl_ns // 8
        deadlines = [at_latest_ns]
        if self.state.tenures.kept.recalled:
            deadlines.append(now_ns + LOOK_AGAIN_NS)
        if self.state.sessions.in_grace(now_ns):
            deadlines.append(self.state.sessions.grace_end_ns)
        state = self.state
        tenures = state.tenures
        deadlines += [
            soonest
            for soonest in (
                tenures.next_deadline_ns(),
                tenures.next_lease_end_ns(now_ns, until_ns=at_latest_ns),
            )
            if soonest is not None
        ]
        for handler in (
            self._prepares, self._stamps, self._views, self._worlds, state.decisions,
            state.standing, self._sessions,
        ):  # fmt: skip
            due_ns = handler.next_deadline_ns()
            if due_ns is not None:
                deadlines.append(due_ns)
        return min(deadlines)

    @property
    def counters(self) -> dict[str, int]:
        """The shard's statistics by name; a transport may add its own."""
        return self.state.counters

    @property
    def idle(self) -> bool:
        """Whether a draining shard may stop: no commit in flight and no lock held.

        Prepared locks and unconfirmed decisions come back with the next start.
        """
        held = any(
            tenure.token is not None and (tenure.committing or tenure.prepared is None)
            for tenure in self.state.tenures.by_lock.values()
        )
        return not held and not self.state.waits_for_store

    # ---------------------------------------------------------------- commits

    def _on_commit(self, message: Commit, reply_to: int) -> Iterable[Effect]:
        state = self.state
        if message.lock.session in state.pins.by_session:
            state.pins.drop(message.lock)
        return state.commits.commit(
            message, reply_to=reply_to, now_ns=state.now_ns, wall_ns=state.wall_ns
        )

    def _on_validate(self, message: Validate, reply_to: int) -> Iterable[Effect]:
        state = self.state
        if message.lock.session in state.pins.by_session:
            state.pins.drop(message.lock)
        return state.commits.validate(message, reply_to=reply_to, now_ns=state.now_ns)

    def _on_persisted(self, message: Persisted, _: int) -> Iterator[Effect]:
        yield from self.state.persisted(message.ticket)
        if self._stamps.waits:
            yield from self._stamps.answer_reached()

    def _on_called(self, message: Called, reply_to: int) -> Iterator[Effect]:
        if isinstance(message.answer, Places):
            yield from self._places.on_called(message.answer)
        else:
            yield from self._prepares.on_called(message, reply_to)

    def _on_shard_returned(self, message: ShardReturned, reply_to: int) -> Iterator[Effect]:
        yield from self._prepares.on_shard_returned(message, reply_to)
        yield from self._places.on_shard_returned(message)

    def _on_outcome(self, message: Outcome, reply_to: int) -> Iterator[Effect]:
        yield from self.state.commits.outcome(message, reply_to=reply_to)

    # ---------------------------------------------------------------- time

    def _on_tick(self, _: Tick, __: int) -> Iterator[Effect]:
        now_ns = self.state.now_ns
        for session in self.state.tenures.leases_over(now_ns):
            yield from self._expire(session)
        self.state.tenures.kept.end_unused()
        for tenure in self.state.tenures.held_too_long(now_ns):
            self.state.count("held_too_long")
            cause = f"{HELD_TOO_LONG} {tenure.hold_ns / 1e9:g} s"
            yield from self.state.tenures.take_away(tenure, cause, now_ns=now_ns)
        for idle in self.state.sessions.idle(now_ns):
            yield from self._sessions.end(idle.session, "its session stayed away")
        yield from self.state.grant_ready()
        yield from self.state.tenures.end_slices(now_ns)
        yield from self.state.standing.end_slices(now_ns)
        yield from self._sessions.end_slices(now_ns)
        yield from self._stamps.answer_reached()
        yield from self._prepares.ask()
        yield from self.state.decisions.tell(now_ns)
        yield from self._history.tidy()

    def _expire(self, session: str) -> Iterator[Effect]:
        found = self.state.sessions.by_id.get(session)
        for tenure in self.state.tenures.of_session(session):
            if tenure.bound:
                continue
            if tenure.token is None:
                self.state.count("waiters_dropped")
                yield from self.state.tenures.remove(tenure, now_ns=self.state.now_ns)
                self.state.forget_top(tenure.lock)
            else:
                if not self.state.tenures.kept.is_unused(tenure):
                    self.state.count("leases_expired")
                ttl_s = found.ttl_ns / 1e9 if found is not None else 0.0
                cause = f"its lease of {ttl_s:g} s expired without a sign of life"
                yield from self.state.tenures.take_away(tenure, cause, now_ns=self.state.now_ns)
        self.state.pins.drop_session(session)
        yield from self.state.standing.drop_session(session)

    def _on_drain(self, _: Drain, __: int) -> Iterator[Effect]:
        self.state.draining = True
        tenures = self.state.tenures
        tenures.kept.closed = True
        for tenure in list(tenures.kept.by_number.values()):
            tenures.kept.recall(tenure, now_ns=self.state.now_ns)
        for tenure in list(self.state.tenures.by_lock.values()):
            if tenure.parked is not None:
                yield self.state.tenures.waiting(tenure, self.state.now_ns)
        yield from self.state.standing.end_all()
        yield from self._sessions.end_all()
        yield from self._stamps.answer_all()

    # ---------------------------------------------------------------- people

    def _on_ping(self, _: Ping, reply_to: int) -> Iterator[Effect]:
        yield Reply(reply_to, inspection.pong(self.state))

    def _on_survey(self, message: Survey, reply_to: int) -> Iterator[Effect]:
        wrong = wrong_patterns(message.patterns)
        stamp_ns = self.state.stamp()
        yield Reply(reply_to, wrong or inspection.surveyed(self.state, message, stamp_ns=stamp_ns))

    def _on_list_locks(self, message: ListLocks, reply_to: int) -> Iterator[Effect]:
        yield Reply(reply_to, inspection.locks(self.state, message))

    def _on_list_sessions(self, message: ListSessions, reply_to: int) -> Iterator[Effect]:
        yield Reply(reply_to, inspection.sessions(self.state, message))

    def _on_break(self, message: Break, reply_to: int) -> Iterator[Effect]:
        tell = self._sessions.answer_when_durable
        found = self.state.numbered(message.number, message.epoch)
        if found is None or found.bound:
            yield from tell(reply_to, self.state.told_by_hand(message), ())
            return
        holder = self.state.tenures.describe(found, self.state.now_ns)
        cause = (
            f"broken by {self.state.asker or 'an operator'}: {message.reason or 'no reason given'}"
        )
        yield from self.state.tenures.take_away(found, cause, now_ns=self.state.now_ns)
        self.state.count("locks_broken")
        text = f"lock {message.number} of {holder.actor}@{holder.host} {cause}"
        kept = self.state.audit.keep(
            AuditRecord(self.state.wall_ns, text, BROKEN, self.state.asker)
        )
        broken = Broken(True, holder)
        self.state.by_hand[Break] = message, broken
        # It holds at once; the record of who did it, and why, is kept before the answer.
        yield from tell(reply_to, broken, (kept,), Durability.OS)

    def _on_stage(self, _: Stage, reply_to: int) -> Iterator[Effect]:
        yield Reply(reply_to, Refused(VALUE, "this shard takes no data ahead of their commit"))

    def _on_list_audit(self, message: ListAudit, reply_to: int) -> Iterator[Effect]:
        audit = self.state.audit
        records: tuple[Record, ...] = ()
        if message.settle and audit.may_settle(message.seen_ns):
            records = (
                audit.keep(
                    AuditRecord(self.state.wall_ns, message.settle, SETTLED, self.state.asker)
                ),
            )
        answer = inspection.audited(self.state, message)
        yield from self._sessions.answer_when_durable(reply_to, answer, records, Durability.OS)

    def _on_list_refusals(self, _: ListRefusals, reply_to: int) -> Iterator[Effect]:
        guard = self.state.guard
        yield Reply(reply_to, Refusals(guard.noted() if guard is not None else ()))

    def biggest(self, count: int) -> list[tuple[str, int]]:
        """Return the slots whose newest data are the largest, with their bytes; for messages."""
        return self.state.slots.large.largest(count)

    def assert_invariants(self) -> None:
        """Assert I1, I8, I10, I11 and the bookkeeping of all parts.  For tests and simulation."""
        self._prepares.assert_invariants()
        self.state.tenures.assert_invariants()
        self.state.standing.assert_invariants()
        self._sessions.assert_invariants()
        self._worlds.assert_invariants()
        self.state.slots.assert_invariants()
        if self.state.sessions.in_grace(self.state.now_ns):
            granted = [t for t in self.state.tenures.by_lock.values() if t.token is not None]
            assert all(t.prepared is not None for t in granted), "grant in grace"
        for lock in self.state.pins:
            assert lock.session in self.state.sessions.by_id
