"""The client half of the protocol: one session of a process over all shards, and its locks.

A lock is begun under a plan, which splits what was requested by shard.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import repeat
from typing import Final

from enact_dist.core.client.kept import Keeping, KeptGrant
from enact_dist.core.client.lease_clock import shortened_ns
from enact_dist.core.client.lock import WAIT_SLICE_NS, MultiLock
from enact_dist.core.client.plan import Phase, Plan, Reading
from enact_dist.core.client.session import ClientSession
from enact_dist.core.protocol.datum import LockId
from enact_dist.core.protocol.messages import Alive, Answer, Item, PlacementMap, Request
from enact_dist.core.protocol.placement import shard_of
from enact_dist.core.state.tenure import is_keepable
from enact_dist.terms import ACCESSES, Access

PLANNED_MAX: Final = 32
PLANS_MAX: Final = 256
"""Sets of so few requested items, at most so many, whose split by shard is remembered."""
QUIET_MAX: Final = 3
"""A session listens no more after so many answers in a row while it keeps no grant of the shard."""


class Client(ClientSession[MultiLock]):
    """The session of one process, over all shards, which begins locks."""

    __slots__ = ("_plans",)

    def __init__(
        self,
        session: str,
        *,
        ttl_ns: int,
        actor: str = "",
        host: str = "",
        pid: int = 0,
        observer: bool = False,
    ) -> None:
        super().__init__(session, ttl_ns=ttl_ns, actor=actor, host=host, pid=pid, observer=observer)
        self._plans: dict[tuple[Item, ...], Plan] = {}

    def begin(self, lane: int, plan: Plan, *, now_ns: int, wait_ns: int, hold_ns: int) -> MultiLock:
        """Start a lock of one thread under a new seq."""
        seq = self._seqs[lane] = self._seqs.get(lane, 0) + 1
        lock = LockId(self.session, lane, seq)
        multilock = MultiLock(self, lock, plan, now_ns + wait_ns, hold_ns)
        if multilock.phase.busy:
            self._locks[lock] = multilock
        return multilock

    def begin_kept(
        self, lane: int, grant: KeptGrant, *, now_ns: int, hold_ns: int
    ) -> MultiLock | None:
        """Start a lock under a kept grant whose mark was taken and whose cell was looked at.

        Returns:
            The lock, held; None if it has to be asked for.
        """
        epoch = grant.token.epoch
        if epoch != self.epoch(grant.shard) or grant.plan.placement != self.placement:
            return None
        if now_ns >= grant.until_ns or hold_ns > grant.hold_ns:
            return None
        seq = self._seqs[lane] = self._seqs.get(lane, 0) + 1
        lock = MultiLock(self, LockId(self.session, lane, seq), grant.plan, now_ns, hold_ns)
        lock.keeping, part = Keeping(grant.items, grant, now_ns), lock.parts[0]
        lock.keeping.values = grant.values
        part.token, part.granted_count, part.until_ns = grant.token, grant.count, grant.until_ns
        part.hold_until_ns = now_ns + shortened_ns(hold_ns)
        lock.states += map(Reading, repeat(part.shard), repeat(epoch), grant.states)
        lock.phase = Phase.HELD
        self._locks[lock.lock] = lock
        return lock

    def far(self, shard: str) -> bool:
        """Whether this session keeps far grants of a shard, in use or not."""
        used = [lock.keeping.grant for lock in self.live_locks() if lock.keeping is not None]
        mine = (*self.kept.by_items.values(), *used)
        return any(grant is not None and grant.far and grant.shard == shard for grant in mine)

    def works(self) -> bool:
        """Whether some thread holds a lock, or stands in a queue for one."""
        locks = list(self._locks.values())
        return any(
            lock.news is None or not lock.news.outside or lock.parts[0].token for lock in locks
        )

    def live_locks(self) -> list[MultiLock]:
        """Return the locks that are not at rest."""
        return list(self._locks.values())

    def learn_placement(self, placement: PlacementMap) -> None:
        """Take over the shard's placement map; where shards differ, the newest answer counts."""
        self._plans.clear()
        super().learn_placement(placement)

    def plan(self, items: Iterable[Item], *, lock_views: bool = False, past_ns: int = 0) -> Plan:
        """Split requested items by shard, in the one global order of acquisition.

        A pattern goes to every shard.  Views ride with the locks where one shard has them all,
        unless it may not show a commit of ours yet.  With `lock_views` they become reads.  With
        `past_ns` they are views alone, as of that stamp.
        """
        items = tuple(items)
        unsettled = self.unsettled.by_slot or self.unsettled.by_shard
        usual = not lock_views and not unsettled and len(items) <= PLANNED_MAX
        plan = self._plans.get(items) if usual else None
        if plan is None:
            plan = self._planned(items, lock_views=lock_views)
            if usual and not any(item.captured_ns for item in items):  # a stamp is asked once
                if len(self._plans) >= PLANS_MAX:
                    self._plans.clear()
                self._plans[items] = plan
        if past_ns:
            return Plan(plan.locks, plan.views, plan.placement, plan.floor_ns, past_ns)
        return plan

    def _planned(self, items: Iterable[Item], *, lock_views: bool) -> Plan:
        locks: dict[str, list[Item]] = {}
        views: dict[str, list[Item]] = {}
        every = [shard.name for shard in self.placement.shards]
        for item in items:
            access = ACCESSES[item.access]
            if lock_views and not access.locks:
                access = Access.READ_EACH if access.each else Access.READ
                item = item._replace(access=access)  # noqa: PLW2901 - the same, but locked
            shards = every if access.each else [shard_of(item.entity, self.placement)]
            for shard in shards:
                (locks if access.locks else views).setdefault(shard, []).append(item)
        if len(locks) == 1:
            only = next(iter(locks))
            here = views.get(only, ())
            if set(views) <= {only} and not self.unsettled.stamp_ns(only, here):
                locks[only] += views.pop(only, [])
        keepable = len(locks) == 1 and not views and is_keepable(tuple(next(iter(locks.values()))))
        return Plan(
            tuple([(shard, tuple(locks[shard])) for shard in sorted(locks)]),
            tuple([(shard, tuple(views[shard])) for shard in sorted(views)]),
            self.placement,
            max((self.unsettled.stamp_ns(shard, views[shard]) for shard in views), default=0),
            keepable=keepable,
        )

    def assert_invariants(self) -> None:
        """Assert the bookkeeping of all locks.  For tests and simulation."""
        lanes = [lock.lane for lock in self._locks]
        assert len(lanes) == len(set(lanes)), "two live locks in one lane"
        for lock_id, lock in self._locks.items():
            assert lock.lock == lock_id
            assert lock.phase.busy or lock.phase is Phase.HELD, lock.phase
            assert lock_id.seq <= self._seqs[lock_id.lane]


@dataclass(slots=True, eq=False)
class RecallListener:
    """Listens for recalls of one shard while its session keeps far grants there.

    Who drives it sends what `ask` returns, and gives `hear` the answer, until it is `over`.

    Attributes:
        word: Whether the last answer told of a recall.
    """

    client: Client
    shard: str
    word: bool = False
    _asked_ns: int = 0
    _quiet: int = 0

    @property
    def over(self) -> bool:
        """Whether the session has kept no grant of the shard for some answers in a row."""
        return self._quiet >= QUIET_MAX

    def ask(self, now_ns: int) -> Request:
        """Return the next question, which the shard keeps until a recall, or for a slice."""
        self._asked_ns = now_ns
        return self.client.keep_alive(self.shard, now_ns, wait_ns=WAIT_SLICE_NS)

    def hear(self, question: Request, answer: Answer | None, now_ns: int) -> bool:
        """Take the answer, None if there is none; return whether to pause before the next question.

        One that came early without word of a recall would else be followed at once by the next.
        """
        self.word = isinstance(answer, Alive) and any(grant.recalled for grant in answer.grants)
        early = now_ns - self._asked_ns < WAIT_SLICE_NS // 2
        if answer is not None:
            self.client.answered(self.shard, question, answer, now_ns)
        if not self.word and not early:
            self.client.kept.rest(self.shard)
        self._quiet = 0 if self.client.far(self.shard) else self._quiet + 1
        return early and not self.word
