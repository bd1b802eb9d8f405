"""Tenures: the life of each lock at one shard, from its place in the queue to its end.

::

    Acquire ──> waiting ──> granted ──> committing ──> (gone)
                   │           │ └────> preparing ──> prepared ──> finishing ──> (gone)
                   │           │
                   └───────────┴── released · superseded · not wanted any more ·
                                   lease ended · held too long · broken ──> (gone, cause kept)

Rules a change must keep
  * A token is given once and never again; `Commit` and `Validate` compare it (the fence).
  * A tenure that is bound (committing, or prepared for another shard's decision) ends only by
    that: no expiry, no release, no break.  A restart restores what was prepared.
  * A grant names the data as of the moment it is sent; large ones stay fetchable by pins.
  * Every parked request is answered, at the latest when its slice of waiting ends.
"""

from __future__ import annotations

import heapq
from collections import Counter
from itertools import islice
from typing import TYPE_CHECKING, Final

from enact_dist.core.protocol.datum import LockId, Token
from enact_dist.core.protocol.messages import (
    FAR,
    HOLD_NS_MAX,
    NOT_KEPT,
    PLACES,
    Acquire,
    Fenced,
    Granted,
    Holder,
    Item,
    Waiting,
)
from enact_dist.core.protocol.records import Effect, LogEvent, PreparedRecord, Reply
from enact_dist.core.state.clock import DueTimes, Latencies
from enact_dist.core.state.lock_table import LockTable, Mode
from enact_dist.core.state.slots import SlotMap
from enact_dist.core.state.tenure import KeptGrants, Shape, Tenure, shape_of, wants_of

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from enact_dist.core.state.sessions import SessionState, SessionTable

WAIT_SLICE_NS_MAX: Final = 1_000_000_000
"""Longest time one request is parked; a client that still waits asks again (long poll)."""
NOT_HELD: Final = "it is not held here (never granted, released, or forgotten)"
HELD_TOO_LONG: Final = "held longer than its limit of"
"""So begins the cause of a lock that ends by its hold limit."""
STALE_ENDS_MAX: Final = 1024
"""Entries of ended locks that the deadline heaps may hold before they are swept."""
SLOTS_TOLD_MAX: Final = 16
"""Slots of one lock that are listed by name."""
WAITS_TOLD_MAX: Final = 16
"""Locks that one waiter is shown to wait for."""
BLOCKERS_TOLD_MAX: Final = 8
"""How many of the locks ahead of it a waiter learns of."""


_WORDS: Final = {Mode.S: "read", Mode.X: "write", Mode.SIX: "read all, write some"}
SHAPE_ITEMS_MAX: Final = 32
SHAPES_MAX: Final = 256
"""Sets of so few requested items, at most so many, that are remembered."""


class Tenures:
    """All tenures of one shard.

    Attributes:
        shapes: The sets of items that were requested lately, all without a fault.
        waiting_of: How many requests the waiting locks of each identity have.
        kept: The grants that stay with their sessions between two blocks.
        waited: How long locks were in the queue until their grant.
    """

    __slots__ = (
        "_epoch",
        "_granted",
        "_hold_ends",
        "_lease_ends",
        "_over",
        "_parked_ends",
        "_sessions",
        "_slots",
        "by_lock",
        "by_session",
        "counters",
        "kept",
        "shapes",
        "table",
        "waited",
        "waiting_of",
    )

    def __init__(
        self, *, epoch: int, slots: SlotMap, sessions: SessionTable, counters: dict[str, int]
    ) -> None:
        self._epoch = epoch
        self._slots = slots
        self._sessions = sessions
        self._granted = 0
        self._hold_ends: list[tuple[int, LockId]] = []
        self._lease_ends = DueTimes[str]()
        self._over: dict[str, None] = {}
        self._parked_ends: list[tuple[int, int, LockId]] = []
        self.waiting_of: dict[str, int] = {}
        self.shapes: dict[tuple[Item, ...], Shape] = {}
        self.table = LockTable()
        self.by_lock: dict[LockId, Tenure] = {}
        self.by_session: dict[str, dict[LockId, Tenure]] = {}
        self.counters = counters
        self.kept = KeptGrants(counters, lambda tenure: self.remove(tenure, now_ns=0))
        self.waited = Latencies()

    def of_session(self, session: str) -> list[Tenure]:
        """Return the tenures of one session."""
        return list(self.by_session.get(session, {}).values())

    def remember(self, items: tuple[Item, ...]) -> None:
        """Remember the shape of items in which no fault was found, if they are few."""
        if len(items) <= SHAPE_ITEMS_MAX:
            if len(self.shapes) >= SHAPES_MAX:
                self.shapes.clear()
            self.shapes[items] = shape_of(items)

    def enqueue(
        self, message: Acquire, shape: Shape, session: SessionState, *, now_ns: int, at_once: bool
    ) -> Tenure:
        """Give a new lock its place in the queue; with `at_once` its grant if nothing waits."""
        lock, items, hold_ns = message.lock, message.items, message.hold_ns
        claim = self.table.enqueue(lock, shape.wants, at_once=at_once)
        if hold_ns > HOLD_NS_MAX:  # noqa: PLR1730 - as in `Stamps.next`
            hold_ns = HOLD_NS_MAX
        keepable = message.alone and shape.keepable
        tenure = Tenure(lock, claim, items, hold_ns, now_ns, shape.named, message.alone, keepable)
        self._add(tenure, session)
        if claim.granted:
            self._begin(tenure, now_ns=now_ns)
        else:
            self._count_waiting(tenure, 1)
        return tenure

    def _begin(self, tenure: Tenure, *, now_ns: int) -> None:
        """Give a lock its token; its hold limit begins."""
        self._granted += 1
        tenure.token = Token(self._epoch, self._granted)
        tenure.granted_ns = now_ns
        tenure.hold_end_ns = now_ns + tenure.hold_ns
        if len(self._hold_ends) > 2 * len(self.by_lock) + STALE_ENDS_MAX:
            self._hold_ends = [end for end in self._hold_ends if end[1] in self.by_lock]
            heapq.heapify(self._hold_ends)
        heapq.heappush(self._hold_ends, (tenure.hold_end_ns, tenure.lock))
        self.counters["locks_granted"] += 1
        if now_ns > tenure.asked_ns:
            self.waited.add((now_ns - tenure.asked_ns) / 1e9)
        else:
            self.waited.counts[0] += 1

    def _count_waiting(self, tenure: Tenure, change: int) -> None:
        items = self.waiting_of.get(tenure.owner, 0) + change * len(tenure.items)
        if items:
            self.waiting_of[tenure.owner] = items
        else:
            self.waiting_of.pop(tenure.owner, None)

    def _add(self, tenure: Tenure, session: SessionState | None) -> None:
        lock, name = tenure.lock, tenure.lock.session
        if session is not None:
            tenure.owner = session.identity
        self.by_lock[lock] = tenure
        if name in self.by_session:
            self.by_session[name][lock] = tenure
        else:
            self.by_session[name] = {lock: tenure}
        if name not in self._lease_ends.due and name not in self._over:
            self._expect_end(name, session, now_ns=tenure.asked_ns)

    def _expect_end(self, name: str, session: SessionState | None, *, now_ns: int) -> None:
        """Look at a session that has locks, and is not looked at yet, when its lease may end."""
        if session is None:
            self._over[name] = None
        else:
            self._lease_ends.put(name, session.lease_end_ns(now_ns))

    def leases_over(self, now_ns: int) -> list[str]:
        """Return the sessions with locks here whose lease has ended, or that have ended."""
        for name in [*self._over, *self._lease_ends.take(now_ns)]:
            self._over.pop(name, None)
            if name in self.by_session:
                session = self._sessions.by_id.get(name)
                end_ns = session.lease_end_ns(now_ns) if session is not None else now_ns
                if end_ns > now_ns:
                    self._lease_ends.put(name, end_ns)
                else:
                    self._over[name] = None
        return list(self._over)

    def session_ended(self, name: str) -> None:
        """Stop watching a session without locks; watch it at the next tick if some are bound."""
        self._lease_ends.drop(name)
        self._over.pop(name, None)
        if name in self.by_session:
            self._over[name] = None

    def restore(self, record: PreparedRecord, *, now_ns: int) -> None:
        """Hold again what was prepared before a restart, before anything else is granted."""
        claim = self.table.enqueue(record.lock, wants_of(record.items))
        granted = self.table.take_ready()
        assert granted == [claim], "two prepared locks were never in conflict"
        tenure = Tenure(record.lock, claim, record.items, 0, asked_ns=now_ns, granted_ns=now_ns)
        tenure.token, tenure.prepared = record.token, record
        self._add(tenure, self._sessions.by_id.get(record.lock.session))

    def park(self, tenure: Tenure, *, reply_to: int, wait_ns: int, now_ns: int) -> Iterator[Effect]:
        """Keep a waiter's request until the grant or the end of its slice."""
        if tenure.parked is not None:
            yield self.waiting(tenure, now_ns)
        tenure.parked = reply_to
        wait_ns = max(0, min(wait_ns, WAIT_SLICE_NS_MAX))
        if not wait_ns:
            yield self.waiting(tenure, now_ns)
        else:
            if len(self._parked_ends) > 2 * len(self.by_lock) + STALE_ENDS_MAX:
                self._parked_ends = [
                    end
                    for end in self._parked_ends
                    if (found := self.by_lock.get(end[2])) is not None and found.parked == end[1]
                ]
                heapq.heapify(self._parked_ends)
            heapq.heappush(self._parked_ends, (now_ns + wait_ns, reply_to, tenure.lock))

    def waiting(self, tenure: Tenure, now_ns: int) -> Effect:
        """Answer a parked request: not yet, and who is in the way."""
        assert tenure.parked is not None
        blockers = self.table.blockers(tenure.claim, count_max=BLOCKERS_TOLD_MAX)
        holders = tuple(
            [
                self.describe(self.by_lock[claim.lock], now_ns)
                for claim in blockers
                if claim.lock in self.by_lock
            ]
        )
        reply_to, tenure.parked = tenure.parked, None
        place = self.table.place(tenure.claim)
        return Reply(reply_to, Waiting(tenure.lock, self._epoch, place, holders))

    def grant_ready(self, *, now_ns: int, stamp_ns: int) -> Iterator[Effect]:
        """Grant whatever may be granted; to be called after each change, outside the grace."""
        for claim in self.table.take_ready():
            tenure = self.by_lock[claim.lock]
            self._count_waiting(tenure, -1)
            self._begin(tenure, now_ns=now_ns)
            if self.table.overtook(claim):
                self.counters["locks_bypassed"] += 1
            if tenure.parked is not None:
                reply_to, tenure.parked = tenure.parked, None
                yield Reply(reply_to, self.granted(tenure, now_ns=now_ns, stamp_ns=stamp_ns))
            elif now_ns > tenure.asked_ns:
                # No request is parked right now: the client's next call fetches the grant, or its
                # keep-alive gives it back.
                self.counters["grants_without_listener"] += 1

    def granted(self, tenure: Tenure, *, now_ns: int, stamp_ns: int) -> Granted:
        """Return the grant with its data as of now."""
        assert tenure.token is not None
        states, pins, from_ns = self._slots.shown(tenure.items, named=tenure.named)
        if pins:
            # Added to: the client may have taken an earlier answer, whose views have moved on.
            tenure.pins.update(pins)
        lock, hold_left_ns = tenure.lock, tenure.hold_end_ns - now_ns
        if hold_left_ns < 0:  # noqa: PLR1730 - as in `Stamps.next`
            hold_left_ns = 0
        return Granted(
            lock,
            tenure.token,
            self._epoch,
            self._sessions.by_id[lock.session].count_seen,
            hold_left_ns,
            stamp_ns,
            tuple(states),
            from_ns,
            tenure.granted_ns - tenure.asked_ns,
        )

    def find(self, lock: LockId, token: Token) -> Tenure | None:
        """Return the tenure that a message is about: of its lock, or kept under its token."""
        return self.by_lock.get(lock) or self.kept.find(lock, token)

    def fenced(self, lock: LockId, token: Token) -> Fenced:
        """Refuse a lock that is not held, with the cause as far as it is known."""
        self.counters["fenced"] += 1
        session = self._sessions.known(lock.session)
        lane = session.lanes.get(lock.lane) if session is not None else None
        ended = lane.ended if lane is not None else None
        cause = ended[1] if ended is not None and ended[0] == lock else None
        return Fenced(lock, cause or self.kept.cause(token) or NOT_HELD)

    def works(self, session: str) -> bool:
        """Whether a session holds or awaits a lock, grants that it only keeps left out."""
        mine = self.by_session.get(session, {}).values()
        return any(not self.kept.is_unused(tenure) for tenure in mine)

    def recall_for(self, waiter: Tenure, *, now_ns: int) -> None:
        """Recall the kept grants in the way of a waiter; those that no block uses are over."""
        for claim in self.table.holders_against(waiter.claim):
            tenure = self.by_lock[claim.lock]
            if tenure.kept:
                self.kept.recall(tenure, now_ns=now_ns)

    def end_block(self, tenure: Tenure, *, keep: bool, now_ns: int) -> tuple[int, Iterable[Effect]]:
        """End a block that ended well: its grant stays, or is over.

        Args:
            tenure: The grant.
            keep: Whether the client asks to keep it.
            now_ns: The present.

        Returns:
            What the answer to the client says (see `Committed`), and the answers to others.
        """
        told = NOT_KEPT
        if keep and tenure.keepable:
            told = self.kept.stays(tenure, awaited=self.table.awaited(tenure.claim), now_ns=now_ns)
        if told < PLACES:
            return told, self.remove(tenure, now_ns=now_ns)
        tenure.pins.clear()
        return told, ()

    def remove(self, tenure: Tenure, *, now_ns: int) -> Iterable[Effect]:
        """End a tenure; who waited for it becomes ready (see `grant_ready`)."""
        answers = [] if tenure.parked is None else [self.waiting(tenure, now_ns)]
        if tenure.kept:
            self.kept.over(tenure)
        if tenure.token is None:
            self._count_waiting(tenure, -1)
        lock = tenure.lock
        self.table.remove(lock)
        del self.by_lock[lock]
        of_session = self.by_session[lock.session]
        if len(of_session) > 1:
            del of_session[lock]
        else:
            del self.by_session[lock.session]
        return answers

    def take_away(self, tenure: Tenure, cause: str, *, now_ns: int) -> Iterator[Effect]:
        """End a tenure against its holder's will, remembering why for its next message."""
        assert not tenure.bound
        session = self._sessions.by_id.get(tenure.lock.session)
        if tenure.kept:
            self.kept.taken(tenure, cause)  # its lane has newer locks, with causes of their own
        elif session is not None and tenure.token is not None:
            session.lane(tenure.lock.lane).ended = (tenure.lock, cause)
        if not self.kept.is_unused(tenure):  # else no block loses anything
            yield LogEvent("lock.taken", f"{self.told(tenure, now_ns)}: {cause}")
        yield from self.remove(tenure, now_ns=now_ns)

    def describe(self, tenure: Tenure, now_ns: int) -> Holder:
        """Describe one lock: its holder or waiter, since when, and the locks that block it."""
        session = self._sessions.by_id.get(tenure.lock.session)
        modes = {mode: None for mode in tenure.claim.wants.values() if mode in _WORDS}
        named = (
            f"{resource} ({_WORDS[mode]})"
            for resource, mode in tenure.claim.wants.items()
            if mode in _WORDS
        )
        waits_for = self.table.blockers(tenure.claim, count_max=WAITS_TOLD_MAX)
        granted = tenure.token is not None
        words = [_WORDS[mode] for mode in modes]
        if tenure.prepared is not None:
            words.append(f"in doubt until {tenure.prepared.primary} decides")
        return Holder(
            tenure.lock,
            tenure.claim.ticket,
            session.actor if session else "?",
            session.host if session else "?",
            session.pid if session else 0,
            granted,
            ", ".join(words),
            now_ns - (tenure.granted_ns if granted else tenure.asked_ns),
            max(0, session.lease_end_ns(now_ns) - now_ns) if session else 0,
            max(0, tenure.hold_end_ns - now_ns) if granted else tenure.hold_ns,
            tuple(islice(named, SLOTS_TOLD_MAX)),
            tuple(claim.ticket for claim in waits_for),
            self._use(tenure),
        )

    def _use(self, tenure: Tenure) -> str:
        """Return how a kept grant is used now; "" for one that is not kept."""
        if not tenure.kept or tenure.token is None:
            return ""
        if tenure.recalled:
            return "recalled"
        if tenure.kept == FAR:
            return "far"
        return "unused" if self.kept.is_unused(tenure) else "used"

    def told(self, tenure: Tenure, now_ns: int) -> str:
        """Return a lock as the log names it: whose it is, and of what."""
        holder = self.describe(tenure, now_ns)
        who = f"{holder.actor or 'client'}@{holder.host} pid {holder.pid}"
        return f"{tenure.lock} of {who}, {', '.join(holder.slots) or 'views alone'}"

    def end_slices(self, now_ns: int) -> Iterator[Effect]:
        """Answer the parked requests whose slice of waiting is over."""
        while self._parked_ends and self._parked_ends[0][0] <= now_ns:
            _, reply_to, lock = heapq.heappop(self._parked_ends)
            tenure = self.by_lock.get(lock)
            if tenure is not None and tenure.parked == reply_to:
                yield self.waiting(tenure, now_ns)

    def held_too_long(self, now_ns: int) -> list[Tenure]:
        """Return the tenures whose hold limit is over, bound ones left out."""
        over = []
        while self._hold_ends and self._hold_ends[0][0] <= now_ns:
            _, lock = heapq.heappop(self._hold_ends)
            tenure = self.by_lock.get(lock)
            if tenure is None or tenure.token is None or tenure.bound:
                continue
            if tenure.kept:
                continue  # its hold limit begins when it is recalled
            if tenure.hold_end_ns > now_ns:
                heapq.heappush(self._hold_ends, (tenure.hold_end_ns, lock))
            else:
                over.append(tenure)
        return over + [t for t in self.kept.in_use() if t.hold_end_ns <= now_ns]

    def stalled(self, gap_ns: int) -> None:
        """Move every hold limit by the time that the shard itself stood still."""
        for tenure in self.by_lock.values():
            tenure.hold_end_ns += gap_ns

    def next_deadline_ns(self) -> int | None:
        """Return when the next slice or hold limit ends."""
        heads = [heap[0][0] for heap in (self._hold_ends, self._parked_ends) if heap]
        heads += [tenure.hold_end_ns for tenure in self.kept.in_use()]
        return min(heads, default=None)

    def next_lease_end_ns(self, now_ns: int, *, until_ns: int) -> int | None:
        """Return when the next lease of a session with locks ends; exact up to `until_ns`.

        A lease cannot end what is bound, so a session that a tick has found over counts again only
        once one of its locks is not bound any more.
        """
        if any(not t.bound for name in self._over for t in self.of_session(name)):
            return now_ns
        for name in self._lease_ends.take(until_ns):
            if name in self.by_session:
                self._lease_ends.put(name, self._sessions.by_id[name].lease_end_ns(now_ns))
        return self._lease_ends.next_ns()

    def assert_invariants(self) -> None:
        """Assert I1, I8 and the bookkeeping over all tenures.  For tests and simulation."""
        self.table.assert_invariants()
        self.kept.assert_invariants(self.by_lock)
        assert self.by_lock.keys() == self.table.claims.keys()
        waiting = Counter[str]()
        for tenure in self.by_lock.values():
            waiting[tenure.owner] += 0 if tenure.token is not None else len(tenure.items)
        waiting = +waiting
        assert waiting == self.waiting_of
        tokens = [tenure.token for tenure in self.by_lock.values() if tenure.token is not None]
        assert len(tokens) == len(set(tokens))
        for tenure in self.by_lock.values():
            assert tenure.claim.granted == (tenure.token is not None), tenure
            assert not tenure.bound or tenure.token is not None
            assert not (tenure.claim.granted and tenure.parked is not None)
            assert self.by_session[tenure.lock.session][tenure.lock] is tenure
            looked_at = tenure.lock.session in self._over
            assert looked_at is not (tenure.lock.session in self._lease_ends)
