"""The rules of locks at one shard: I1, I8, I10, I11, I13, I14, I17, ends, no lock waits in vain.

Besides them those of kept grants: R1, R4 to R6 and R9 of the design, and blocks that end without a
call.  A lock under a kept grant is a lock like any other; judges find its grant by its token.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from enact_dist.core.protocol.datum import LockId, Token
from enact_dist.core.protocol.messages import FAR, Acquire, Commit, Fenced, KeepAlive, Release
from enact_dist.core.protocol.records import Reply, Tick
from enact_dist.verify.simulation.judges.history import conflict

if TYPE_CHECKING:
    from collections.abc import Sequence

    from enact_dist.core.client.kept import KeptGrant
    from enact_dist.core.protocol.messages import SlotState
    from enact_dist.core.protocol.records import Effect
    from enact_dist.core.state.tenure import Tenure
    from enact_dist.verify.simulation.hosts.keeping import SimulatedMarks, SimulatedPage
    from enact_dist.verify.simulation.hosts.shard_host import ShardNode
    from enact_dist.verify.simulation.hosts.world import SimulatedWorld
    from enact_dist.verify.simulation.judges.history import Entry, Observations
    from enact_dist.verify.simulation.judges.picture import CommittedState, ShardPicture


class LockJudge:
    """Looks at a shard's locks after each step."""

    def __init__(self, world: SimulatedWorld) -> None:
        self._fail = world.violation
        self._waits: dict[str, dict[LockId, list[LockId]]] = {}
        self._hosts: dict[str, ShardNode] = {}

    def judge(self, host: ShardNode, message: object, picture: ShardPicture) -> None:
        """Note who came, went and was granted, and whether that was right."""
        tenures = host.shard.state.tenures.by_lock
        for lock in [lock for lock in picture.arrivals if lock not in tenures]:
            del picture.arrivals[lock]
            picture.granted.pop(lock, None)
        came = message.lock if isinstance(message, Acquire) else None
        if isinstance(message, Release) and host.shard.state.tenures.kept.has(message.lock.session):
            picture.lanes[message.lock[:2]] = None  # no later message of this lane counts before it
        if came is not None:
            picture.lanes[came[:2]] = None
        # Locks that waited for news arrive at the change, in the order of their places.
        arrived = [tenure for lock, tenure in tenures.items() if lock not in picture.arrivals]
        for tenure in sorted(arrived, key=lambda tenure: tenure.claim.ticket):
            picture.came += 1
            picture.arrivals[tenure.lock] = picture.came
        for lock in picture.in_flight:
            if picture.origin(lock) not in picture.granted:
                self._fail("I17 a commit in flight keeps its lock", lock)
        for lock in picture.prepared:
            if lock not in picture.granted:
                self._fail("I10 what is prepared keeps its locks", lock)
        fresh = [
            tenure
            for lock, tenure in tenures.items()
            if tenure.token is not None and lock not in picture.granted
        ]
        for tenure in sorted(fresh, key=lambda tenure: tenure.token or Token(0, 0)):
            self._check_grant(host, tenure, tenures, picture)
        if isinstance(message, KeepAlive) and message.epoch == picture.epoch:
            self._check_wanted(host, message, tenures)
        if isinstance(message, Tick):
            self._check_ends(host)
            self._check_outcomes(host, picture)
            self._check_waiters(host, picture)

    def _check_grant(
        self, host: ShardNode, tenure: Tenure, tenures: dict[LockId, Tenure], picture: ShardPicture
    ) -> None:
        lock, token = tenure.lock, tenure.token
        assert token is not None
        newest = picture.newest_token or Token(0, 0)
        if token <= newest or token.epoch != picture.epoch:
            self._fail("I8 tokens grow", lock, token, newest)
        if lock in picture.granted_ever:
            self._fail("I8 a seq is granted once", lock, token)
        if picture.grace_waits_for and host.local_ns < picture.grace_end_ns:
            self._fail("I11 no grant in the grace", lock, list(picture.grace_waits_for))
        arrival = picture.arrivals[lock]
        for other in tenures.values():
            if other is tenure or not conflict(tenure.items, other.items):
                continue
            if other.lock in picture.granted:
                self._fail("I1 no conflicting grants", lock, other.lock)
            if other.token is None and picture.arrivals[other.lock] < arrival:
                self._fail("I13 no lock is overtaken", other.lock, "by", lock)
        picture.newest_token = token
        picture.granted[lock] = picture.granted_ever[lock] = token
        picture.holders[token] = lock

    def _check_wanted(
        self, host: ShardNode, message: KeepAlive, tenures: dict[LockId, Tenure]
    ) -> None:
        """A keep-alive leaves nothing that its client neither wants any more nor keeps."""
        lowest = dict(message.view)
        for lock, tenure in tenures.items():
            unwanted = lock.session == message.session and lock.seq < lowest.get(lock.lane, 0)
            if unwanted and not (tenure.committing or tenure.prepared or host.is_living(tenure)):
                self._fail("orphans are freed", lock, message.view)

    def _check_ends(self, host: ShardNode) -> None:
        """After a look at the clock no grant is left that should have ended."""
        state = host.shard.state
        for lock, tenure in state.tenures.by_lock.items():
            if tenure.token is None or tenure.committing or tenure.prepared:
                continue
            lease_end_ns = state.sessions.by_id[lock.session].lease_end_ns(state.now_ns)
            waited_for = not host.is_living(tenure) or tenure.recalled
            hold_end_ns = tenure.hold_end_ns if waited_for else lease_end_ns
            if min(hold_end_ns, lease_end_ns) <= state.now_ns:
                self._fail("leases and hold limits end", lock, tenure.hold_end_ns, lease_end_ns)

    def _check_outcomes(self, host: ShardNode, picture: ShardPicture) -> None:
        """I14: what is remembered of commits is one entry per lane that ever asked here."""
        sessions = host.shard.state.sessions
        for session in sessions:
            for lane in session.lanes:
                if (session.session, lane) not in picture.lanes:
                    self._fail("I14 one outcome per lane", session.session, lane)

    def _check_waiters(self, host: ShardNode, picture: ShardPicture) -> None:
        """Each waiter waits for a holder or an earlier request, and never in a cycle."""
        state = host.shard.state
        everybody = list(state.tenures.by_lock.values())
        waits = self._waits[host.name] = {}
        self._hosts[host.name] = host
        for waiter in everybody:
            if waiter.token is not None:
                continue
            arrival = picture.arrivals[waiter.lock]
            waits[waiter.lock] = [
                other.lock
                for other in everybody
                if (other.token is not None or picture.arrivals[other.lock] < arrival)
                and conflict(waiter.items, other.items, columns=True)
            ]
            closed = state.draining or state.sessions.in_grace(state.now_ns)
            if not waits[waiter.lock] and not closed:
                self._fail("P6 no lock waits in vain", waiter.lock, waiter.items)
        for lock in waits:
            self._check_circle(lock)

    def _still_waits(self, name: str, lock: LockId) -> bool:
        """Whether a lock that waited when the shard last looked does so now."""
        host = self._hosts[name]
        tenure = host.shard.state.tenures.by_lock.get(lock) if host.up else None
        return tenure is not None and tenure.token is None

    def _check_circle(self, first: LockId) -> None:
        """Follow the waits-for edges over all shards, as of their last look at the clock."""
        reached, ahead = {first}, [first]
        while ahead:
            lock = ahead.pop()
            for name, waits in self._waits.items():
                for other in waits.get(lock, ()) if self._still_waits(name, lock) else ():
                    if other == first:
                        self._fail("no deadlock", first, self._waits)
                    if other not in reached:
                        reached.add(other)
                        ahead.append(other)


class KeepingJudge:
    """Looks at pages, at blocks that begin and end without a call, and at the waiters."""

    def __init__(self, observed: Observations) -> None:
        self._observed, self._fail = observed, observed.fail
        self._kept: dict[str, tuple[SimulatedMarks, dict[int, str]]] = {}

    # ---------------------------------------------------------------- clients

    def looked(self, grant: KeptGrant, page: SimulatedPage | None) -> None:
        """A client has its mark and reads that its grant lives: the lock begins in this moment.

        Without a page the grant is a far one: it lives as long as its client believes in it.  If
        its shard has restarted, it shows what was there before, as a lock does that was held then.
        """
        number = grant.token.number
        cleared = page.cleared.get(number) if page is not None else None
        if page is not None and cleared is not None and cleared < page.marks[number]:
            self._fail("R5 no use begins once its cell was cleared", grant.origin, number)
        self._observed.count("locks begun from afar", page is None)
        picture = self._observed.pictures[grant.shard]
        if page is None and grant.token.epoch != picture.epoch:
            return
        for state in grant.states:
            newest = picture.now(state.slot)
            if not _is(state, newest):
                self._fail("R6 a use shows what is current", grant.origin, state, newest)

    def begun(self, entry: Entry) -> None:
        """A lock has begun under a kept grant."""
        self._observed.count("locks begun without a call", 1)
        keeping = entry.lock.keeping
        if keeping is None or not entry.lock.valid(keeping.begun_ns):
            self._fail("R1 a use begins in belief", entry.id, entry.lock.parts)

    def ended(self, entry: Entry) -> None:
        """A lock has ended without writes and without a call: nothing came in between."""
        self._observed.count("locks ended without a call", 1)
        for reading in entry.lock.states:
            picture = self._observed.pictures[reading.shard]
            newest = picture.now(reading.state.slot)
            if not _is(reading.state, newest) and not isinstance(newest.writer, str):
                self._fail("P3 every lock is held to its end", entry.id, reading.state, newest)

    # ---------------------------------------------------------------- shards

    def handled(
        self, host: ShardNode, message: object, effects: Sequence[Effect], picture: ShardPicture
    ) -> None:
        """Judge one step of a shard, after its locks."""
        marks = host.marks
        if marks is None:
            return
        tenures = host.shard.state.tenures.by_lock
        staying = {t.token.number: t for t in tenures.values() if t.kept and t.token is not None}
        kept = {number: tenure for number, tenure in staying.items() if tenure.kept != FAR}
        for session, page in marks.made.items():
            for number in page.numbers():
                if number not in kept or kept[number].lock.session != session:
                    self._fail("R9 cells of ended grants are cleared", host.name, session, number)
        of, before = self._kept.get(host.name, (marks, {}))
        self._kept[host.name] = marks, {number: t.lock.session for number, t in kept.items()}
        if isinstance(message, Acquire) and of is marks:
            for number in [number for number in before if number not in kept]:
                if number in marks.made[before[number]].uses:
                    self._fail("R1 what a block uses is not revoked", host.name, message, number)
        if isinstance(message, Tick) and staying:
            self._check_waiters(host, list(staying.values()))
        for effect in effects:
            if isinstance(effect, Reply) and isinstance(effect.answer, Fenced):
                asked = host.asked.get(effect.reply_to)
                if isinstance(asked, Commit) and asked.lock not in picture.granted_ever:
                    self._count_fenced(asked, picture)

    def _count_fenced(self, asked: Commit, picture: ShardPicture) -> None:
        origin = picture.holders.get(asked.token)
        if origin is not None:
            lives = picture.granted.get(origin) == asked.token
            self._observed.count("late commits under a kept grant fenced", 1)
            self._observed.count("late commits under a living grant fenced", lives)

    def _check_waiters(self, host: ShardNode, kept: list[Tenure]) -> None:
        """R4: a waiter behind a kept grant waits for a block; its client finds the cell cleared."""
        marks = host.marks
        assert marks is not None
        for waiter in host.shard.state.tenures.by_lock.values():
            if waiter.token is not None:
                continue
            for tenure in kept:
                if not conflict(waiter.items, tenure.items, columns=True):
                    continue
                assert tenure.token is not None
                if tenure.kept == FAR:
                    if not tenure.recalled:
                        self._fail("R4 what is waited for is recalled", waiter.lock, tenure.lock)
                    continue
                page, number = marks.made[tenure.lock.session], tenure.token.number
                if number in page.numbers():
                    self._fail("R4 what is waited for is recalled", waiter.lock, tenure.lock)
                free = number not in page.marks and not tenure.committing
                now_ns = self._observed.world.now_ns  # a client may have gone on in this very step
                if free and page.freed_ns.get(number, -1) < now_ns:
                    self._fail("R4 no lock waits for an unused grant", waiter.lock, tenure.lock)


def _is(state: SlotState, newest: CommittedState) -> bool:
    same = (state.version, state.stamp_ns) == newest.name
    return same and (state.null_reason == "") == (newest.datum is not None)
