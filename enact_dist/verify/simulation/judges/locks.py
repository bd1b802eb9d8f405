"""The rules of locks at one shard: I1, I8, I10, I11, I13, I14, I17, ends, no lock waits in vain."""

from __future__ import annotations

from typing import TYPE_CHECKING

from enact_dist.core.protocol.datum import LockId, Token
from enact_dist.core.protocol.messages import Acquire, KeepAlive
from enact_dist.core.protocol.records import Tick
from enact_dist.verify.simulation.judges.history import conflict

if TYPE_CHECKING:
    from enact_dist.core.state.tenure import Tenure
    from enact_dist.verify.simulation.hosts.shard_host import ShardNode
    from enact_dist.verify.simulation.hosts.world import SimulatedWorld
    from enact_dist.verify.simulation.judges.picture import ShardPicture


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
        if came is not None:
            picture.lanes[came[:2]] = None
        if came in tenures and came not in picture.arrivals:
            picture.came += 1
            picture.arrivals[came] = picture.came
        for lock in picture.in_flight:
            if lock not in picture.granted:
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
            self._check_wanted(message, tenures)
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

    def _check_wanted(self, message: KeepAlive, tenures: dict[LockId, Tenure]) -> None:
        """A keep-alive leaves nothing that its client does not want any more."""
        lowest = dict(message.view)
        for lock, tenure in tenures.items():
            unwanted = lock.session == message.session and lock.seq < lowest.get(lock.lane, 0)
            if unwanted and not (tenure.committing or tenure.prepared):
                self._fail("orphans are freed", lock, message.view)

    def _check_ends(self, host: ShardNode) -> None:
        """After a look at the clock no grant is left that should have ended."""
        state = host.shard.state
        for lock, tenure in state.tenures.by_lock.items():
            if tenure.token is None or tenure.committing or tenure.prepared:
                continue
            lease_end_ns = state.sessions.by_id[lock.session].lease_end_ns(state.now_ns)
            if min(tenure.hold_end_ns, lease_end_ns) <= state.now_ns:
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
