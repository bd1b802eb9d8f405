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

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from enact_dist.core import inspection
from enact_dist.core.commits import Commits, duplicate_slot
from enact_dist.core.messages import (
    Acquire,
    Alive,
    Answer,
    AspectEntry,
    AwaitStamp,
    Break,
    Broken,
    Commit,
    EpochChanged,
    Fetch,
    Gone,
    Goodbye,
    GrantLeft,
    Hello,
    KeepAlive,
    ListLocks,
    ListSessions,
    Locks,
    Outcome,
    PlacementMap,
    Reached,
    Refused,
    Register,
    Registered,
    Release,
    Released,
    Slice,
    Stale,
    Survey,
    TakeView,
    Validate,
    Viewed,
    Welcome,
    WrongShard,
)
from enact_dist.core.datum import Datum, LockId, Slot
from enact_dist.core.records import (
    AspectRecord,
    AuditRecord,
    Drain,
    Effect,
    Persist,
    Persisted,
    Record,
    Recovered,
    Reply,
    SessionEnded,
    SessionRecord,
    SessionSeen,
    Story,
    Tick,
    WorldRecord,
)
from enact_dist.core.sessions import LANES_MAX, SESSIONS_MAX, Session, SessionTable
from enact_dist.core.slots import Catalogue, SlotMap
from enact_dist.core.stamps import Stamps
from enact_dist.core.tenures import Tenure, Tenures
from enact_dist.terms import Durability, checked_name

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from enact_dist.core.messages import Holder, Item, Request
    from enact_dist.core.records import Event

TTL_NS_MIN: Final = 100_000_000
"""Leases shorter than this would be lost to ordinary scheduling delays."""
ITEMS_MAX: Final = 4096
"""Requests in one lock or view."""
WAITERS_MAX: Final = 100_000
"""Locks, granted or waiting, at one shard."""
FETCH_BYTES_MAX: Final = 4 << 20
"""Largest part of a datum in one answer."""


@dataclass(frozen=True, slots=True)
class ShardSettings:
    """What a shard is told by its cell.

    Attributes:
        name: The shard's name.
        placement: All shards of the cell; the shard itself is one of them.
        worlds: World contexts that exist from the start.
        aspects: Aspects whose durability the cell decides; their fingerprints may be empty.
        ttl_ns_max: Longest lease a session may ask for.
    """

    name: str
    placement: PlacementMap
    worlds: tuple[str, ...] = ()
    aspects: tuple[AspectEntry, ...] = ()
    ttl_ns_max: int = 60_000_000_000


class Shard:
    """The whole state of one shard.  See the module docstring for the rules."""

    def __init__(
        self, settings: ShardSettings, recovered: Recovered, *, now_ns: int, wall_ns: int
    ) -> None:
        self.settings = settings
        self.epoch = recovered.epoch
        self.counters: dict[str, int] = {}
        self.slots = SlotMap(recovered.slots)
        self.catalogue = Catalogue(
            configured=settings.aspects,
            recovered=recovered.aspects,
            worlds=(*settings.worlds, *recovered.worlds),
        )
        self.sessions = SessionTable(
            recovered.sessions, outcomes=recovered.outcomes, now_ns=now_ns
        )
        stamps = [record.stamp_ns for record in recovered.slots]
        stamps += [record.position.stamp_ns for record in recovered.outcomes]
        self.stamps = Stamps(max(stamps, default=0))
        self.tenures = Tenures(
            epoch=self.epoch, slots=self.slots, sessions=self.sessions, count=self._count
        )
        self.tenures.describe = self._describe
        self.commits = Commits(
            shard=settings.name,
            epoch=self.epoch,
            slots=self.slots,
            catalogue=self.catalogue,
            sessions=self.sessions,
            tenures=self.tenures,
            stamps=self.stamps,
            count=self._count,
        )
        self.draining = False
        self._now_ns = now_ns
        self._wall_ns = wall_ns
        self._born_ns = now_ns
        self._pins: dict[LockId, dict[tuple[Slot, int], Datum]] = {}
        self._parked_stamps: dict[int, AwaitStamp] = {}
        self._parked_stamp_ends: dict[int, int] = {}
        self._answers_after: dict[int, tuple[int, Answer]] = {}
        self._register_ticket = 0
        self._shortest_ttl_ns = min(
            (session.ttl_ns for session in self.sessions), default=settings.ttl_ns_max
        )
        self._handlers: dict[type, Callable[..., Iterator[Effect]]] = {
            Hello: self._on_hello,
            Register: self._on_register,
            Acquire: self._on_acquire,
            TakeView: self._on_take_view,
            Fetch: self._on_fetch,
            KeepAlive: self._on_keep_alive,
            Commit: self._on_commit,
            Outcome: self._on_outcome,
            Validate: self._on_validate,
            Release: self._on_release,
            Goodbye: self._on_goodbye,
            AwaitStamp: self._on_await_stamp,
            Survey: self._on_survey,
            ListLocks: self._on_list_locks,
            ListSessions: self._on_list_sessions,
            Break: self._on_break,
            Persisted: self._on_persisted,
            SessionSeen: self._on_session_seen,
            Tick: self._on_tick,
            Drain: self._on_drain,
        }

    # ---------------------------------------------------------------- the one mutator

    def handle(
        self, message: Request | Event, *, reply_to: int = 0, now_ns: int, wall_ns: int
    ) -> list[Effect]:
        """Take one message and return what is to be done about it, in order.

        Args:
            message: A request of a client, or an event of this host.
            reply_to: Handle under which the request's answer will be asked to be sent.
            now_ns: This host's monotonic clock.
            wall_ns: This host's wall clock, since 1970; used for stamps only.
        """
        self._advance(now_ns, wall_ns)
        effects = list(self._handlers[type(message)](message, reply_to))
        effects += self._grant_ready()
        return effects

    def _advance(self, now_ns: int, wall_ns: int) -> None:
        """Move the time; if this host itself stood still, nobody's lease pays for it."""
        gap_ns = now_ns - self._now_ns
        if gap_ns > self._shortest_ttl_ns // 4:
            self.sessions.stalled(gap_ns)
            self.tenures.stalled(gap_ns)
            self._count("stalls")
        self._now_ns = max(self._now_ns, now_ns)
        self._wall_ns = wall_ns

    def _grant_ready(self) -> Iterator[Effect]:
        if not self.draining and not self.sessions.in_grace(self._now_ns):
            yield from self.tenures.grant_ready(now_ns=self._now_ns, stamp_ns=self._stamp())

    def next_deadline_ns(self) -> int:
        """Return the monotonic time at which a `Tick` is due at the latest."""
        now_ns = self._now_ns
        deadlines = [now_ns + self._shortest_ttl_ns // 8]
        if self.sessions.in_grace(now_ns):
            deadlines.append(self.sessions.grace_end_ns)
        deadlines += self._parked_stamp_ends.values()
        soonest = self.tenures.next_deadline_ns()
        if soonest is not None:
            deadlines.append(soonest)
        deadlines += [
            self.sessions.by_id[session].lease_end_ns(now_ns)
            for session in self.tenures.by_session
            if session in self.sessions.by_id
        ]
        return min(deadlines)

    @property
    def idle(self) -> bool:
        """Whether a draining shard may stop: no commit in flight and no lock held."""
        held = any(tenure.token is not None for tenure in self.tenures.by_lock.values())
        return not self.commits.in_flight and not held and not self._answers_after

    # ---------------------------------------------------------------- sessions

    def _on_hello(self, message: Hello, reply_to: int) -> Iterator[Effect]:
        known = self.sessions.by_id.get(message.session)
        if known is None and len(self.sessions.by_id) >= SESSIONS_MAX:
            yield Reply(reply_to, Refused("overload", f"{SESSIONS_MAX} sessions are open"))
            return
        ttl_ns = max(TTL_NS_MIN, min(message.ttl_ns, self.settings.ttl_ns_max))
        session, unrecorded = self.sessions.hello(
            message, epoch=self.epoch, ttl_ns=ttl_ns, now_ns=self._now_ns
        )
        self._shortest_ttl_ns = min(self._shortest_ttl_ns, session.ttl_ns)
        self.sessions.end_grace_if_all_acknowledged(self._now_ns)
        welcome = Welcome(
            self.settings.name,
            self.epoch,
            not self.sessions.in_grace(self._now_ns),
            session.ttl_ns,
            self._wall_ns,
            self.commits.notice_number,
            self.settings.placement,
            tuple(self.catalogue.worlds),
            tuple(self.catalogue.aspects.values()),
        )
        if unrecorded:
            # A session that a restart would not know could lose its grants without the grace.
            session.durable = True
            record = SessionRecord(session.session, session.ttl_ns)
            yield from self._answer_when_durable(reply_to, welcome, (record,))
        else:
            yield Reply(reply_to, welcome)

    def _answer_when_durable(
        self, reply_to: int, answer: Answer, records: tuple[Record, ...]
    ) -> Iterator[Effect]:
        self._register_ticket -= 1  # negative: the tickets of commits are positive
        self._answers_after[self._register_ticket] = (reply_to, answer)
        yield Persist(self._register_ticket, records, Durability.DURABLE)

    def _on_persisted(self, message: Persisted, _: int) -> Iterator[Effect]:
        if message.ticket > 0:
            yield from self.commits.persisted(message.ticket, now_ns=self._now_ns)
            yield from self._answer_reached()
        else:
            yield Reply(*self._answers_after.pop(message.ticket))

    def _on_register(self, message: Register, reply_to: int) -> Iterator[Effect]:
        records: list[Record] = []
        for name in message.worlds:
            try:
                checked_name("world context", name, slashes=False)
            except ValueError as error:
                yield Reply(reply_to, Refused("value", str(error)))
                return
            if name not in self.catalogue.worlds:
                records.append(WorldRecord(name))
        for entry in message.aspects:
            registered = self.catalogue.register(entry)
            if isinstance(registered, str):
                yield Reply(reply_to, Refused("datum_type", registered))
                return
            if registered[1]:
                records.append(AspectRecord(registered[0]))
        self.catalogue.worlds.update(dict.fromkeys(message.worlds))
        answer = Registered(tuple(self.catalogue.worlds), tuple(self.catalogue.aspects.values()))
        if records:
            yield from self._answer_when_durable(reply_to, answer, tuple(records))
        else:
            yield Reply(reply_to, answer)

    def _on_keep_alive(self, message: KeepAlive, reply_to: int) -> Iterator[Effect]:
        session = self._session_in_epoch(message.session, message.epoch)
        if session is None:
            yield Reply(reply_to, EpochChanged(self.epoch))
            return
        session.renewed_ns = max(session.renewed_ns, self._now_ns)
        session.count_seen = max(session.count_seen, message.count)
        session.report = message.report or session.report
        lowest = {view.lane: view.seq for view in message.view}
        for tenure in self.tenures.of_session(message.session):
            if tenure.lock.seq < lowest.get(tenure.lock.lane, 0) and not tenure.committing:
                self._count("orphans_freed")
                yield Story("lock.orphan", f"{tenure.lock} is not wanted any more")
                yield from self.tenures.remove(tenure, now_ns=self._now_ns)
        for lock in [lock for lock in self._pins if lock.session == message.session]:
            if lock.seq < lowest.get(lock.lane, 0):
                del self._pins[lock]
        grants = tuple(
            GrantLeft(tenure.lock, tenure.token, max(0, tenure.hold_end_ns - self._now_ns))
            for tenure in self.tenures.of_session(message.session)
            if tenure.token is not None
        )
        yield Reply(
            reply_to,
            Alive(self.epoch, session.count_seen, self.commits.notice_number, self._stamp(), grants),
        )

    def _session_in_epoch(self, session: str, epoch: int) -> Session | None:
        if epoch != self.epoch:
            self._count("epoch_refusals")
            return None
        return self.sessions.known(session)

    def _on_goodbye(self, message: Goodbye, reply_to: int) -> Iterator[Effect]:
        yield from self._end_session(message.session, "its session said goodbye")
        yield Reply(reply_to, Released())

    def _end_session(self, session: str, cause: str) -> Iterator[Effect]:
        found = self.sessions.by_id.get(session)
        if found is None:
            return
        tenures = self.tenures.of_session(session)
        for tenure in tenures:
            if not tenure.committing:
                yield from self.tenures.take_away(tenure, cause, now_ns=self._now_ns)
        self._drop_pins(session)
        self.sessions.forget(session)
        self.sessions.end_grace_if_all_acknowledged(self._now_ns)
        if found.durable:
            yield Persist(0, (SessionEnded(session, self._wall_ns),), Durability.OS)

    def _drop_pins(self, session: str) -> None:
        for lock in [lock for lock in self._pins if lock.session == session]:
            del self._pins[lock]

    def _on_session_seen(self, message: SessionSeen, _: int) -> Iterator[Effect]:
        self.sessions.token_seen(message.session, message.present, now_ns=self._now_ns)
        if not message.present:
            # Its waiters lose their place: a lock must not be granted to a dead process while
            # living ones wait.  A client that was only cut off asks again with the same id.
            for tenure in self.tenures.of_session(message.session):
                if tenure.token is None:
                    self._count("waiters_dropped")
                    yield from self.tenures.remove(tenure, now_ns=self._now_ns)
                    self._forget_top(tenure.lock)

    def _forget_top(self, lock: LockId) -> None:
        """Let a lock that never was granted be asked for again under the same seq."""
        session = self.sessions.by_id.get(lock.session)
        if session is not None and session.lane(lock.lane).top == lock.seq:
            session.lane(lock.lane).top = lock.seq - 1

    # ---------------------------------------------------------------- locks and views

    def _on_acquire(self, message: Acquire, reply_to: int) -> Iterator[Effect]:
        session = self._session_in_epoch(message.lock.session, message.epoch)
        refusal = self._placement_or_items_refused(session, message.map_version, message.items)
        if refusal is not None or session is None:
            yield Reply(reply_to, refusal or EpochChanged(self.epoch))
            return
        if session.observer:
            yield Reply(reply_to, Refused("protocol", "an observer session cannot lock"))
            return
        session.renewed_ns = max(session.renewed_ns, self._now_ns)
        session.count_seen = max(session.count_seen, message.count)
        tenure = self.tenures.by_lock.get(message.lock)
        if tenure is None:
            lane = session.lanes.get(message.lock.lane)
            if lane is None and len(session.lanes) >= LANES_MAX:
                yield Reply(reply_to, Refused("overload", f"{LANES_MAX} lanes in one session"))
                return
            lane = lane or session.lane(message.lock.lane)
            if message.lock.seq <= lane.top:
                self._count("stale")
                yield Reply(reply_to, Stale(message.lock, self.epoch))
                return
            yield from self._supersede(message.lock)
            lane.top = message.lock.seq
            tenure = self.tenures.enqueue(message, now_ns=self._now_ns)
            yield from self._grant_ready()
        if tenure.token is not None:
            granted = self.tenures.granted(
                tenure, now_ns=self._now_ns, stamp_ns=self._stamp(message.seen_stamp_ns)
            )
            yield Reply(reply_to, granted)
        else:
            self._count("lock_waits")
            yield from self.tenures.park(
                tenure, reply_to=reply_to, wait_ns=message.wait_ns, now_ns=self._now_ns
            )

    def _supersede(self, lock: LockId) -> Iterator[Effect]:
        """A newer lock of a lane ends the older ones: their release was lost."""
        for tenure in self.tenures.of_session(lock.session):
            older = tenure.lock.lane == lock.lane and tenure.lock.seq < lock.seq
            if older and not tenure.committing:
                self._count("superseded")
                yield from self.tenures.take_away(
                    tenure, "a newer lock of its thread", now_ns=self._now_ns
                )
        for pinned in [pinned for pinned in self._pins if pinned[:2] == lock[:2]]:
            if pinned.seq < lock.seq:
                del self._pins[pinned]

    def _placement_or_items_refused(
        self, session: Session | None, map_version: int, items: tuple[Item, ...]
    ) -> Answer | None:
        if session is None:
            return EpochChanged(self.epoch)
        if map_version != self.settings.placement.version:
            self._count("wrong_shard")
            return WrongShard(self.settings.placement)
        if len(items) > ITEMS_MAX:
            return Refused("value", f"{len(items)} requests in one lock; at most {ITEMS_MAX}")
        if len(self.tenures.by_lock) >= WAITERS_MAX:
            return Refused("overload", f"{WAITERS_MAX} locks are held or awaited here")
        for item in items:
            if item.context not in self.catalogue.worlds:
                known = ", ".join(sorted(self.catalogue.worlds)) or "none"
                return Refused(
                    "unknown_world", f"no world context {item.context!r} here; known: {known}"
                )
            if item.aspect not in self.catalogue.aspects:
                return Refused("unknown_aspect", f"aspect {item.aspect!r} is not registered here")
        return None

    def _on_take_view(self, message: TakeView, reply_to: int) -> Iterator[Effect]:
        session = self._session_in_epoch(message.lock.session, message.epoch)
        refusal = self._placement_or_items_refused(session, message.map_version, message.items)
        if refusal is not None or session is None:
            yield Reply(reply_to, refusal or EpochChanged(self.epoch))
            return
        session.count_seen = max(session.count_seen, message.count)
        states = self.slots.states(message.items)
        pins = self.tenures.pins_of(states)
        if pins:
            self._pins[message.lock] = pins
        stamp_ns = self._stamp(message.seen_stamp_ns)
        yield Reply(reply_to, Viewed(message.lock, self.epoch, stamp_ns, tuple(states)))

    def _on_fetch(self, message: Fetch, reply_to: int) -> Iterator[Effect]:
        if self._session_in_epoch(message.lock.session, message.epoch) is None:
            yield Reply(reply_to, EpochChanged(self.epoch))
            return
        datum = self._pinned(message)
        if datum is None:
            self._count("fetches_gone")
            yield Reply(reply_to, Gone(message.slot, message.version))
            return
        length = min(message.length, FETCH_BYTES_MAX)
        body = memoryview(datum.body)[message.offset : message.offset + length]
        part = Datum(b"", body, len(body))
        self._count("bytes_fetched", len(body))
        yield Reply(
            reply_to,
            Slice(
                message.slot,
                message.version,
                datum.encoding,
                datum.stamp_ns,
                datum.size,
                message.offset,
                part,
            ),
        )

    def _pinned(self, message: Fetch) -> Datum | None:
        tenure = self.tenures.by_lock.get(message.lock)
        key = (message.slot, message.version)
        for pins in (tenure.pins if tenure else {}, self._pins.get(message.lock, {})):
            if key in pins:
                return pins[key]
        content = self.slots[message.slot]
        return content.datum if content.version == message.version else None

    def _on_release(self, message: Release, reply_to: int) -> Iterator[Effect]:
        tenure = self.tenures.by_lock.get(message.lock)
        if tenure is not None and not tenure.committing:
            yield from self.tenures.remove(tenure, now_ns=self._now_ns)
        self._pins.pop(message.lock, None)
        yield Reply(reply_to, Released())

    # ---------------------------------------------------------------- commits

    def _on_commit(self, message: Commit, reply_to: int) -> Iterator[Effect]:
        twice = duplicate_slot(message.writes)
        if twice is not None:
            yield Reply(reply_to, Refused("protocol", f"{twice} is written twice in one commit"))
            return
        self._pins.pop(message.lock, None)
        yield from self.commits.commit(
            message, reply_to=reply_to, now_ns=self._now_ns, wall_ns=self._wall_ns
        )

    def _on_validate(self, message: Validate, reply_to: int) -> Iterator[Effect]:
        self._pins.pop(message.lock, None)
        yield from self.commits.validate(message, reply_to=reply_to, now_ns=self._now_ns)

    def _on_outcome(self, message: Outcome, reply_to: int) -> Iterator[Effect]:
        yield from self.commits.outcome(message, reply_to=reply_to)

    def _on_await_stamp(self, message: AwaitStamp, reply_to: int) -> Iterator[Effect]:
        self._parked_stamps[reply_to] = message
        self._parked_stamp_ends[reply_to] = self._now_ns + max(0, message.wait_ns)
        yield from self._answer_reached()

    def _answer_reached(self) -> Iterator[Effect]:
        for reply_to, message in list(self._parked_stamps.items()):
            stamp_ns = self._stamp()
            earliest = self.commits.earliest_in_flight_stamp_ns()
            reached = stamp_ns >= message.stamp_ns and (
                earliest is None or earliest > message.stamp_ns
            )
            if reached or self._parked_stamp_ends[reply_to] <= self._now_ns:
                del self._parked_stamps[reply_to], self._parked_stamp_ends[reply_to]
                yield Reply(reply_to, Reached(reached, stamp_ns))

    def _stamp(self, seen_ns: int = 0) -> int:
        """Return the present, after everything that an honest client has seen."""
        if seen_ns > self.stamps.last_ns and not self.stamps.too_far_ahead(
            seen_ns, wall_ns=self._wall_ns
        ):
            self.stamps.last_ns = seen_ns
        return self.stamps.now(wall_ns=self._wall_ns)

    # ---------------------------------------------------------------- time

    def _on_tick(self, _: Tick, __: int) -> Iterator[Effect]:
        now_ns = self._now_ns
        for session in list(self.tenures.by_session):
            yield from self._expire(session)
        for tenure in self.tenures.held_too_long(now_ns):
            self._count("held_too_long")
            cause = f"held longer than its limit of {tenure.hold_ns / 1e9:g} s"
            yield from self.tenures.take_away(tenure, cause, now_ns=now_ns)
        for idle in self.sessions.idle(now_ns):
            yield from self._end_session(idle.session, "its session stayed away")
        yield from self._grant_ready()
        yield from self.tenures.end_slices(now_ns)
        yield from self._answer_reached()

    def _expire(self, session: str) -> Iterator[Effect]:
        found = self.sessions.by_id.get(session)
        if found is not None and found.lease_end_ns(self._now_ns) > self._now_ns:
            return
        for tenure in self.tenures.of_session(session):
            if tenure.committing:
                continue
            if tenure.token is None:
                self._count("waiters_dropped")
                yield from self.tenures.remove(tenure, now_ns=self._now_ns)
                self._forget_top(tenure.lock)
            else:
                self._count("leases_expired")
                ttl_s = found.ttl_ns / 1e9 if found is not None else 0.0
                cause = f"its lease of {ttl_s:g} s expired without a sign of life"
                yield from self.tenures.take_away(tenure, cause, now_ns=self._now_ns)
        self._drop_pins(session)

    def _on_drain(self, _: Drain, __: int) -> Iterator[Effect]:
        self.draining = True
        for tenure in list(self.tenures.by_lock.values()):
            if tenure.parked is not None:
                yield self.tenures.waiting(tenure, self._now_ns)
        for reply_to in list(self._parked_stamps):
            self._parked_stamp_ends[reply_to] = self._now_ns
        yield from self._answer_reached()

    # ---------------------------------------------------------------- people

    def _on_survey(self, message: Survey, reply_to: int) -> Iterator[Effect]:
        yield Reply(reply_to, inspection.surveyed(self, message, stamp_ns=self._stamp()))

    def _on_list_locks(self, _: ListLocks, reply_to: int) -> Iterator[Effect]:
        oldest_first = sorted(self.tenures.by_lock.values(), key=lambda t: t.claim.ticket)
        holders = tuple(self._describe(tenure, self._now_ns) for tenure in oldest_first)
        yield Reply(reply_to, Locks(self.epoch, holders))

    def _on_list_sessions(self, _: ListSessions, reply_to: int) -> Iterator[Effect]:
        answer = inspection.sessions(
            self, now_ns=self._now_ns, wall_ns=self._wall_ns, born_ns=self._born_ns
        )
        yield Reply(reply_to, answer)

    def _on_break(self, message: Break, reply_to: int) -> Iterator[Effect]:
        found = [t for t in self.tenures.by_lock.values() if t.claim.ticket == message.number]
        if not found or found[0].committing:
            yield Reply(reply_to, Broken(False, None))
            return
        holder = self._describe(found[0], self._now_ns)
        cause = f"broken by an operator: {message.reason or 'no reason given'}"
        yield from self.tenures.take_away(found[0], cause, now_ns=self._now_ns)
        self._count("locks_broken")
        text = f"lock {message.number} of {holder.actor}@{holder.host} {cause}"
        yield Persist(0, (AuditRecord(self._wall_ns, text),), Durability.OS)
        yield Reply(reply_to, Broken(True, holder))

    def _describe(self, tenure: Tenure, now_ns: int) -> Holder:
        return inspection.holder(self, tenure, now_ns=now_ns)

    def _count(self, name: str, count: int = 1) -> None:
        self.counters[name] = self.counters.get(name, 0) + count

    def assert_invariants(self) -> None:
        """Assert I1, I8, I11 and the bookkeeping of all parts.  For tests and simulation."""
        self.tenures.assert_invariants()
        if self.sessions.in_grace(self._now_ns):
            assert all(t.token is None for t in self.tenures.by_lock.values()), "grant in grace"
        for slot_pins in self._pins:
            assert slot_pins.session in self.sessions.by_id
