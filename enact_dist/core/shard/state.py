"""The parts of one shard that its handlers work on, and the few acts that they share.

`ShardState` decides nothing by itself; `Shard` sets its time before each message and hands it to
the handler that the message is for.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from enact_dist.core.protocol.messages import (
    NO_PLACE,
    OVERLOAD,
    AspectEntry,
    Broken,
    EpochChanged,
    PlacementMap,
    Refused,
    Waiting,
    WorldEntry,
)
from enact_dist.core.protocol.records import Effect, Persist, Reply
from enact_dist.core.rights.guard import Guard
from enact_dist.core.shard.owners import Quotas
from enact_dist.core.state.audit import Audit
from enact_dist.core.state.catalogue import Catalogue
from enact_dist.core.state.clock import DueTimes, Stamps, newest_stamp
from enact_dist.core.state.commits import Commits
from enact_dist.core.state.decisions import Decisions
from enact_dist.core.state.grants import WAIT_SLICE_NS_MAX, Tenures
from enact_dist.core.state.sessions import LANES_MAX, SessionState, SessionTable
from enact_dist.core.state.slots import SlotMap

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

    from enact_dist.core.protocol.datum import Datum, LockId, Slot
    from enact_dist.core.protocol.messages import (
        Acquire,
        Answer,
        Break,
        DropWorld,
        ForceAbort,
        Fork,
        KeepVersions,
    )
    from enact_dist.core.protocol.records import Record, Recovered, Then
    from enact_dist.core.rights.rules import Rights
    from enact_dist.core.state.tenure import Tenure
    from enact_dist.terms import Durability

    Pinned = dict[tuple[Slot, int], Datum]

FETCH_BYTES_MAX: Final = 4 << 20
"""Largest part of a datum in one answer, so that small answers never wait long behind it."""

ANSWER_FETCHES: Final = 2
"""The small data of one grant may have as many bytes as two fetched parts of a large one."""


@dataclass(frozen=True, slots=True)
class ShardSettings:
    """What a shard learns from the configuration of its cell.

    Attributes:
        placement: All shards of the cell; the shard itself is one of them.
        worlds: World contexts that exist from the start.
        aspects: Aspects whose durability the cell decides; their fingerprints may be empty.
        ttl_ns_max: Longest lease a session may ask for.
        fetch_bytes_max: Largest part of a datum in one answer.
        shared: Name of this start's folder of shared memory ("": it shares none).
        shared_nonce: Content of its nonce file, for clients.
        start: A random number of this start.
        rights: Who may do what; None: every client may do everything.
    """

    name: str
    placement: PlacementMap
    worlds: tuple[str, ...] = ()
    aspects: tuple[AspectEntry, ...] = ()
    ttl_ns_max: int = 60_000_000_000
    fetch_bytes_max: int = FETCH_BYTES_MAX
    shared: str = ""
    shared_nonce: bytes = b""
    start: int = 0
    rights: Rights | None = None


class Pins:
    """What views without a lock keep fetchable: the large data that answers have only named.

    A client names a view by a lock of one of its lanes, and has at most `LANES_MAX` of these.  So a
    session keeps no more than that many views here: an older view of the same lane goes first, then
    the oldest of all.  What a client asks about costs by its own pins, never by those of others.

    Attributes:
        by_session: The data: by session, lock, then slot and version.
    """

    __slots__ = ("by_session",)

    def __init__(self) -> None:
        self.by_session: dict[str, dict[LockId, Pinned]] = {}

    def __bool__(self) -> bool:
        return bool(self.by_session)

    def __iter__(self) -> Iterator[LockId]:
        """Yield every lock that pins something."""
        for pinned in self.by_session.values():
            yield from pinned

    def get(self, lock: LockId) -> Mapping[tuple[Slot, int], Datum]:
        """Return what a lock pins."""
        return self.by_session.get(lock.session, {}).get(lock, {})

    def add(self, lock: LockId, data: Pinned) -> bool:
        """Pin more for a lock; return whether a view that may still be wanted had to go."""
        mine = self.by_session.setdefault(lock.session, {})
        displaced = False
        if lock not in mine and len(mine) >= LANES_MAX:
            self.drop_older(lock.session, {lock.lane: lock.seq})
            mine = self.by_session.setdefault(lock.session, {})
            displaced = len(mine) >= LANES_MAX
            if displaced:
                del mine[next(iter(mine))]
        # Added to: the client may have taken an answer to an earlier view of this lock.
        mine.setdefault(lock, {}).update(data)
        return displaced

    def drop(self, lock: LockId) -> None:
        """Forget what a lock pins."""
        mine = self.by_session.get(lock.session)
        if mine is not None and mine.pop(lock, None) is not None and not mine:
            del self.by_session[lock.session]

    def drop_older(self, session: str, lowest: Mapping[int, int]) -> None:
        """Forget what the locks of a session pin that come before the lowest seq of their lane."""
        mine = self.by_session.get(session, {})
        for lock in [lock for lock in mine if lock.seq < lowest.get(lock.lane, 0)]:
            self.drop(lock)

    def drop_session(self, session: str) -> None:
        """Forget everything that a session's views keep."""
        self.by_session.pop(session, None)


@dataclass(frozen=True, slots=True)
class Standing:
    """The request of a lock that waits for news, until when it may be parked, and whose it is."""

    message: Acquire
    reply_to: int
    until_ns: int
    owner: str


class StandingLocks:
    """Locks that wait for newer data than their client has seen, outside the queue.

    Such a lock is its parked request and nothing else: when its slice of waiting ends, or word is
    lost, the client asks again, and the shard compares anew.  So nothing here survives, is repaired
    or is given back.

    Rule a change must keep
      * The shard compares when a request comes, and at each change: news between two requests of a
        client are found by the next one.

    Attributes:
        by_lane: The parked requests, by session and lane.
    """

    def __init__(self) -> None:
        self.by_lane: dict[tuple[str, int], Standing] = {}
        self._by_slot: dict[Slot, dict[tuple[str, int], None]] = {}
        self._ends = DueTimes[tuple[str, int]]()
        self._of: Counter[str] = Counter()

    def newer(self, lock: LockId) -> bool:
        """Whether a newer lock of the lane waits here already."""
        found = self.by_lane.get((lock.session, lock.lane))
        return found is not None and found.message.lock.seq > lock.seq

    def count_of(self, owner: str) -> int:
        """Return how many requests of an identity are parked."""
        return self._of[owner]

    def park(self, message: Acquire, *, reply_to: int, now_ns: int, owner: str) -> Iterator[Effect]:
        """Keep a request until there is news or its slice ends; the older one of its lane ends."""
        lane = message.lock.session, message.lock.lane
        yield from self._end(lane)
        wait_ns = max(0, min(message.wait_ns, WAIT_SLICE_NS_MAX))
        self.by_lane[lane] = Standing(message, reply_to, now_ns + wait_ns, owner)
        self._ends.put(lane, now_ns + wait_ns)
        self._of[owner] += 1
        for seen in message.seen:
            self._by_slot.setdefault(seen.slot, {})[lane] = None
        if not wait_ns:
            yield from self._end(lane)

    def take(self, slots: Iterable[Slot]) -> list[Standing]:
        """Return what waits for news of these slots, and forget it."""
        lanes = dict.fromkeys(lane for slot in slots for lane in self._by_slot.get(slot, ()))
        return [self._forget(lane) for lane in lanes]

    def has(self, lock: LockId) -> bool:
        """Whether this lock waits here."""
        found = self.by_lane.get((lock.session, lock.lane))
        return found is not None and found.message.lock == lock

    def drop(self, lock: LockId) -> Iterator[Effect]:
        """End the waiting of a lock that its client gives up."""
        if self.has(lock):
            yield from self._end((lock.session, lock.lane))

    def drop_session(
        self, session: str, lowest: Mapping[int, int] | None = None
    ) -> Iterator[Effect]:
        """End the waiting of a session, or of its locks below the lowest seq of their lane."""
        for lane, found in list(self.by_lane.items()):
            unwanted = lowest is None or found.message.lock.seq < lowest.get(lane[1], 0)
            if lane[0] == session and unwanted:
                yield from self._end(lane)

    def end_slices(self, now_ns: int) -> Iterator[Effect]:
        """Answer the requests whose slice of waiting is over."""
        for lane in self._ends.take(now_ns):
            yield from self._end(lane)

    def end_all(self) -> Iterator[Effect]:
        """Answer all: the shard is about to stop."""
        for lane in list(self.by_lane):
            yield from self._end(lane)

    def assert_invariants(self) -> None:
        """Assert the bookkeeping.  For tests and simulation."""
        by_slot: dict[Slot, set[tuple[str, int]]] = {}
        for lane, standing in self.by_lane.items():
            for seen in standing.message.seen:
                by_slot.setdefault(seen.slot, set()).add(lane)
        assert by_slot == {slot: {*lanes} for slot, lanes in self._by_slot.items()}
        assert self._ends.due == {lane: one.until_ns for lane, one in self.by_lane.items()}

    def next_deadline_ns(self) -> int | None:
        """Return when the next slice ends."""
        return self._ends.next_ns()

    def _end(self, lane: tuple[str, int]) -> Iterator[Effect]:
        if lane in self.by_lane:
            found = self._forget(lane)
            lock, epoch = found.message.lock, found.message.epoch
            yield Reply(found.reply_to, Waiting(lock, epoch, NO_PLACE, ()))

    def _forget(self, lane: tuple[str, int]) -> Standing:
        found = self.by_lane.pop(lane)
        self._ends.drop(lane)
        self._of[found.owner] -= 1
        if not self._of[found.owner]:
            del self._of[found.owner]
        for seen in found.message.seen:
            waiting = self._by_slot.get(seen.slot)
            if waiting is not None:
                waiting.pop(lane, None)
                if not waiting:
                    del self._by_slot[seen.slot]
        return found


class ShardState:
    """Slots, sessions, locks and commits of one shard at one moment.

    Attributes:
        now_ns: Monotonic time of the message being handled.
        asker: The identity under which it came; "": this process.
        wall_ns: Wall clock at that moment; for timestamps only.
        peers: The other shards of the cell.
        pins: Data that a view without a lock keeps fetchable.
        standing: The locks that wait for newer data before they enter the queue.
        busy_worlds: The operation in progress on a context of this name, which is unusable
            meanwhile.
        by_hand: The last lock broken and the last one aborted by operators: request and answer.
        stored: Whether there is a store; without one, records are kept as long as this process.
        draining: The shard is about to stop and grants nothing.
        guard: Compares requests with the rights of their senders; None: there are none.
        doubled: The shards of the cell that several daemons serve now, with the start of each.
    """

    def __init__(
        self, settings: ShardSettings, recovered: Recovered, *, now_ns: int, wall_ns: int
    ) -> None:
        self.settings = settings
        self.epoch = recovered.epoch
        self.now_ns, self.wall_ns, self.born_ns = now_ns, wall_ns, now_ns
        self.asker = ""
        rights = settings.rights
        self.guard = Guard(rights, self.count) if rights is not None else None
        self.draining = False
        self.stored = True
        self._then: dict[int, Then] = {}
        self._ticket = 0
        self.counters: dict[str, int] = defaultdict(int)
        self.pins = Pins()
        self.standing = StandingLocks()
        self.busy_worlds: dict[str, str] = {}
        self.doubled: dict[str, tuple[int, ...]] = {}
        self.by_hand: dict[type, tuple[Break | ForceAbort, Broken]] = {}
        names = {shard.name for shard in settings.placement.shards}
        self.peers = frozenset(names - {settings.name})
        self.catalogue = Catalogue(
            configured=settings.aspects,
            recovered=recovered.aspects,
            # Contexts that were only configured once have data, which must stay in reach.
            worlds=(
                *map(WorldEntry, settings.worlds),
                *map(WorldEntry, dict.fromkeys(r.slot.context for r in recovered.slots)),
                *(WorldEntry(r.name, r.source, r.at_ns) for r in recovered.worlds),
            ),
        )
        self.stamps = Stamps(newest_stamp(recovered)[0])
        self.slots = SlotMap(
            recovered.slots,
            policies=self.catalogue.policies,
            since_ns=max(self.stamps.last_ns, wall_ns),
            answer_bytes_max=ANSWER_FETCHES * settings.fetch_bytes_max,
            dropped=recovered.dropped,
            forgotten=recovered.forgotten,
        )
        self.slots.recover_history(recovered.history, recovered.kept)
        self.sessions = SessionTable(recovered.sessions, outcomes=recovered.outcomes, now_ns=now_ns)
        self.tenures = Tenures(
            epoch=self.epoch, slots=self.slots, sessions=self.sessions, counters=self.counters
        )
        self.quotas = Quotas(self.count)
        self.audit = Audit(recovered.audit)
        self.decisions = Decisions(recovered.decisions, now_ns=now_ns, count=self.count)
        self.commits = Commits(
            shard=settings.name,
            peers=self.peers,
            epoch=self.epoch,
            slots=self.slots,
            catalogue=self.catalogue,
            sessions=self.sessions,
            tenures=self.tenures,
            stamps=self.stamps,
            decisions=self.decisions,
            counters=self.counters,
            persist=self.persist,
            guard=self.guard,
        )

    def hides(self, slot: Slot) -> bool:
        """Whether a listing leaves a slot out, which the sender of the request may not read."""
        return self.guard is not None and self.guard.hides(slot)

    def count(self, name: str, count: int = 1) -> None:
        """Add to one of the shard's statistics."""
        self.counters[name] += count

    def persist(
        self, records: tuple[Record, ...], durability: Durability, then: Then
    ) -> list[Effect]:
        """Have the store keep records, and go on once it has; at once without a store."""
        if not self.stored:
            return list(then(self.now_ns))
        self._ticket += 1
        self._then[self._ticket] = then
        return [Persist(self._ticket, records, durability)]

    def persisted(self, ticket: int) -> Iterable[Effect]:
        """Go on: the store has kept what it was asked for under this number."""
        return self._then.pop(ticket)(self.now_ns)

    @property
    def waits_for_store(self) -> bool:
        """Whether something goes on only once the store has kept its records."""
        return bool(self._then)

    def epoch_changed(self, epoch: int) -> EpochChanged:
        """Refuse what names another epoch, or a session that has sent no hello in this one."""
        if epoch != self.epoch:
            self.count("epoch_refusals")
        return EpochChanged(self.epoch)

    def session_in_epoch(self, session: str, epoch: int) -> SessionState | None:
        """Return the session if it and the client's idea of the epoch are current."""
        if epoch != self.epoch:
            self.count("epoch_refusals")
            return None
        return self.sessions.known(session)

    def answered_before(self, message: Fork | DropWorld | KeepVersions) -> Answer | None:
        """Return what a copy of an earlier request is answered, None to what is new or under way.

        A session asks for one after the other, each with a larger count (0 with its epoch: unsaid).
        """
        if not message.epoch:
            return None
        session = self.session_in_epoch(message.session, message.epoch)
        if session is None:
            return EpochChanged(self.epoch)
        session.renew(self.now_ns, message.count)
        count, answer = session.act
        if message.count > count:
            session.act = (message.count, None)
            return None
        if message.count == count:
            return answer
        return Refused(OVERLOAD, "the request came after a newer one of its session; ask again")

    def remember_answer(self, message: Fork | DropWorld | KeepVersions, answer: Answer) -> None:
        """Let a copy of a request be answered as the request was."""
        session = self.sessions.by_id.get(message.session)
        if session is not None and session.act[0] == message.count:
            session.act = (message.count, answer)

    @property
    def shortest_ttl_ns(self) -> int:
        """Of all sessions; bounds how often the shard must look at the time."""
        return self.sessions.shortest_ttl_ns or self.settings.ttl_ns_max

    @property
    def grants(self) -> bool:
        """Whether locks are granted now: not in the grace after a start, not before an end."""
        return not self.draining and not self.sessions.in_grace(self.now_ns)

    def grant_ready(self) -> Iterator[Effect]:
        """Grant whatever may be granted now."""
        if self.grants:
            yield from self.tenures.grant_ready(now_ns=self.now_ns, stamp_ns=self.stamp())

    def stamp(self, seen_ns: int = 0) -> int:
        """Return the present, after everything that an honest client has seen."""
        return self.stamps.now(wall_ns=self.wall_ns, seen_ns=seen_ns)

    def forget_top(self, lock: LockId) -> None:
        """Let a lock that never was granted be asked for again under the same seq."""
        session = self.sessions.by_id.get(lock.session)
        if session is not None and session.lane(lock.lane).top == lock.seq:
            session.lane(lock.lane).top = lock.seq - 1

    def busy_world(self, world: str) -> Refused | None:
        """Refuse the name of a context that is just being made or dropped."""
        act = self.busy_worlds.get(world)
        if act is None:
            return None
        return Refused(OVERLOAD, f"world context {world!r} is {act}; ask again")

    def numbered(self, number: int, epoch: int) -> Tenure | None:
        """Return the lock with a number that people saw in an epoch (0: this one)."""
        if epoch not in (0, self.epoch):
            return None
        found = (t for t in self.tenures.by_lock.values() if t.claim.ticket == number)
        return next(found, None)

    def told_by_hand(self, message: Break | ForceAbort) -> Broken:
        """Return the answer to an operator's request to end a lock that does not exist.

        A repeated request (the client timed out on a slow disk) gets the original answer.
        """
        asked, answer = self.by_hand.get(type(message), (None, None))
        return answer if answer is not None and asked == message else Broken(False, None)
