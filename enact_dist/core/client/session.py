"""The client half of a session: which epoch each shard is in, what is held, what may be believed.

One session per process, one lane per thread.  Rules a change must keep:

  * A new epoch of a shard, or a session that it forgot, ends every lock with a grant there; only
    then is the epoch acknowledged by `Hello` ("all my older grants here are dropped").
  * The keep-alive names the lowest seq that each lane still cares for; a grant that the shard lists
    no longer, though it existed when the keep-alive was sent, is lost.
  * A seq is used for one lock and never again.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

from enact_dist.core.client.kept import Keeping, OwnGrants
from enact_dist.core.client.lease_clock import Sendings
from enact_dist.core.client.own_commits import Unsettled
from enact_dist.core.client.plan import Part, Phase, Plan
from enact_dist.core.protocol.datum import LockId
from enact_dist.core.protocol.messages import (
    START,
    Acquire,
    Alive,
    Answer,
    AspectEntry,
    DatumRead,
    EpochChanged,
    Hello,
    KeepAlive,
    KeepVersions,
    LaneView,
    PlacementMap,
    Prepared,
    Registered,
    Request,
    Welcome,
)
from enact_dist.core.state.clock import STAMP_NS_MAX, is_older
from enact_dist.terms import Durability


class HeldThere(Protocol):
    """What a session needs of a lock: which grants it has, and how to end it."""

    lock: LockId
    phase: Phase
    parts: list[Part]
    keeping: Keeping | None

    def lose_at(self, shard: str, cause: str) -> None:
        """Take in that a shard has dropped its grant."""

    def lose(self, cause: str, *, asked_of: Part | None = None) -> None:
        """Take in that a shard has ended this lock."""

    def ask_again(self) -> None:
        """Make the next call without a further pause."""


L = TypeVar("L", bound=HeldThere)


@dataclass(slots=True)
class Peer:
    """What this client knows of one shard.

    `successions` is how many successions of datum types its newest known catalogue has; `recorded`
    are the aspects that it has shown in this epoch whose commits it still knows after a restart.
    """

    epoch: int = 0
    successions: int = 0
    recorded: frozenset[str] = frozenset()


class ClientSession(Generic[L]):
    """The session of one process over all shards, whose locks `core.client.client` begins.

    Attributes:
        greeted: The shards that know that this client is in their epoch.
        kept: The grants that stay here between two locks of the same data.
        peers: What is known of each shard that was met.
    """

    __slots__ = (
        "_locks",
        "_seqs",
        "actor",
        "greeted",
        "host",
        "kept",
        "observer",
        "peers",
        "pid",
        "placement",
        "report",
        "seen_stamp_ns",
        "sendings",
        "session",
        "ttl_ns",
        "unsettled",
    )

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
        self.session = session
        self.ttl_ns = ttl_ns
        self.actor, self.host, self.pid, self.observer = actor, host, pid, observer
        self.placement = PlacementMap(0, (), ())
        self.sendings = Sendings()
        self.seen_stamp_ns = 0
        self.report = b""
        self.peers: dict[str, Peer] = {}
        self._locks: dict[LockId, L] = {}
        self._seqs: dict[int, int] = {}
        self.greeted: set[str] = set()
        self.unsettled = Unsettled()
        self.kept = OwnGrants()

    # ---------------------------------------------------------------- shards

    def peer(self, shard: str) -> Peer:
        """Return what this client knows of a shard."""
        peer = self.peers.get(shard)
        if peer is None:
            peer = self.peers[shard] = Peer()
        return peer

    def epoch(self, shard: str) -> int:
        """Return the epoch that the shard was last known in (0: none)."""
        peer = self.peers.get(shard)
        return peer.epoch if peer is not None else 0

    def successions(self, shard: str) -> int:
        """Return how many successions of datum types are known of the shard's catalogue."""
        peer = self.peers.get(shard)
        return peer.successions if peer is not None else 0

    def knows_types(self, shard: str, successions: int) -> None:
        """Note how many successions of datum types the newest known catalogue of a shard has."""
        self.peer(shard).successions = successions

    def needs_hello(self, shard: str) -> bool:
        """Whether the shard does not know yet that this client is in its epoch."""
        return shard not in self.greeted

    def _enters(self, shard: str, epoch: int, *, acknowledged: bool) -> None:
        """Note the epoch of a shard, and whether a `Hello` has confirmed it there."""
        peer = self.peer(shard)
        if epoch != peer.epoch:
            peer.epoch, peer.recorded = epoch, frozenset()
        if acknowledged and epoch:
            self.greeted.add(shard)
        else:
            self.greeted.discard(shard)

    def hello(self, shard: str) -> Hello:
        """Return the greeting, which acknowledges the epoch that we know."""
        return Hello(
            self.session,
            self.epoch(shard),
            self.ttl_ns,
            self.actor,
            self.host,
            self.pid,
            self.observer,
        )

    def answered(self, shard: str, request: Request, answer: Answer, now_ns: int) -> bool:
        """Take what concerns the session; return whether that was all of the answer."""
        if isinstance(answer, Welcome) and isinstance(request, Hello):
            self._welcomed(shard, request, answer)
            return True
        if isinstance(answer, EpochChanged):
            self._epoch_changed(shard, answer.epoch, asked_in=_epoch_of(request))
            return False
        if isinstance(answer, Alive) and isinstance(request, KeepAlive):
            self._alive(shard, request, answer, now_ns)
            return True
        if isinstance(answer, Registered):
            self._records(self.peer(shard), answer.aspects)
            return True
        return False

    def _welcomed(self, shard: str, request: Hello, answer: Welcome) -> None:
        peer = self.peer(shard)
        if is_older(answer.epoch, peer.epoch):
            return  # an old answer
        if answer.epoch != peer.epoch:
            self._drop_grants(shard)
            # The first Hello of a session leaves nothing older to be acknowledged, unless the shard
            # restarted before its first answer came through and now waits for us.
            first = peer.epoch == 0
            self._enters(shard, answer.epoch, acknowledged=first and answer.open)
        elif request.known_epoch == answer.epoch:
            self._enters(shard, answer.epoch, acknowledged=True)
        self._records(peer, answer.aspects)
        self.ttl_ns = min(self.ttl_ns, answer.ttl_ns)
        self.learn_placement(answer.placement)

    @staticmethod
    def _records(peer: Peer, aspects: Iterable[AspectEntry]) -> None:
        """Note whose commits a shard records; a catalogue only grows in an epoch."""
        volatile = Durability.VOLATILE.value
        peer.recorded |= {entry.name for entry in aspects if entry.durability != volatile}

    def _epoch_changed(self, shard: str, epoch: int, *, asked_in: int | None) -> None:
        peer = self.peer(shard)
        late = asked_in is not None and asked_in != epoch == peer.epoch
        if is_older(epoch, peer.epoch) or late:
            return  # whatever was held before is dropped already
        self._drop_grants(shard)
        self._enters(shard, epoch, acknowledged=False)

    def _drop_grants(self, shard: str) -> None:
        self.kept.drop(shard)
        for lock in list(self._locks.values()):
            if any(part.shard == shard and part.token is not None for part in lock.parts):
                lock.lose_at(shard, f"shard {shard} restarted or forgot this session")

    def learn_placement(self, placement: PlacementMap) -> None:
        """Take over the shard's placement map; where shards differ, the newest answer counts."""
        if placement != self.placement:
            self.kept.by_items.clear()
        self.placement = placement

    def saw_stamp(self, stamp_ns: int) -> None:
        """Remember the largest stamp seen: later commits come after it everywhere.

        A timestamp that no clock gives is ignored: every shard would refuse any later one.
        """
        if self.seen_stamp_ns < stamp_ns <= STAMP_NS_MAX:
            self.seen_stamp_ns = stamp_ns

    def committed(self, votes: Mapping[str, Prepared], stamp_ns: int) -> None:
        """Note on which slots the shards that have voted may not show a commit of ours yet."""
        for shard, vote in votes.items():
            slots = (version.slot for version in vote.versions)
            self.unsettled.committed(shard, slots, stamp_ns)

    def unsettled_ns(self, shard: str) -> int:
        """Return the stamp of a commit of ours that a shard may not show yet (0: none)."""
        return self.unsettled.stamp_ns(shard)

    def reached(self, shard: str, stamp_ns: int) -> None:
        """Note that a shard shows everything up to a stamp."""
        self.unsettled.reached(shard, stamp_ns)

    # ---------------------------------------------------------------- keep-alive

    def keep_alive(self, shard: str, now_ns: int, *, wait_ns: int = 0) -> Request:
        """Return the next sign of life for a shard; with `wait_ns`, one that awaits recalls."""
        if self.needs_hello(shard):
            return self.hello(shard)
        live: dict[int, int] = {lane: seq + 1 for lane, seq in self._seqs.items()}
        for lock in self._locks:
            live[lock.lane] = min(lock.seq, live[lock.lane])
        view = tuple([LaneView(lane, seq) for lane, seq in live.items()])
        count = self.sendings.next(now_ns)
        heard = self.kept.heard(shard) if wait_ns else ()
        epoch = self.epoch(shard)
        return KeepAlive(self.session, epoch, count, view, self.report, wait_ns, heard)

    def _alive(self, shard: str, request: KeepAlive, answer: Alive, now_ns: int) -> None:
        if answer.epoch != self.epoch(shard):
            return
        self.saw_stamp(answer.stamp_ns)
        left = {grant.token: grant for grant in answer.grants}
        believe = self.sendings.believe_until_ns
        until_ns = believe(answer.count_seen, self.ttl_ns)
        self.kept.alive(shard, left, asked=request.count, until_ns=until_ns)
        if any(grant.far for grant in answer.grants):
            parts = (part for lock in self._locks.values() for part in lock.parts)
            used = {part.token for part in parts if part.shard == shard}
            self.kept.hear(shard, answer.grants, used)
        for lock in list(self._locks.values()):
            for part in lock.parts:
                if part.shard != shard or part.token is None:
                    continue
                grant = left.get(part.token)
                if grant is not None:
                    part.until_ns = max(part.until_ns, until_ns)
                    part.hold_until_ns = max(
                        part.hold_until_ns, believe(answer.count_seen, grant.hold_left_ns)
                    )
                elif part.granted_count < request.count and lock.phase in _GRANTS_COUNT:
                    cause = f"shard {shard} holds it for this session no more"
                    lock.lose(cause, asked_of=part)

    # ---------------------------------------------------------------- locks

    def acquire(
        self,
        lock: LockId,
        plan: Plan,
        part: Part,
        after: tuple[DatumRead, ...] = (),
        *,
        now_ns: int,
        wait_ns: int,
        hold_ns: int,
    ) -> Acquire:
        """Return the next request for one part of a lock.

        Args:
            lock: The lock.
            plan: Where it lies.
            part: What it asks for at this shard.
            after: It enters the queue once the shard has newer data than these; empty: at once.
            now_ns: The session's clock.
            wait_ns: How long this call may be parked.
            hold_ns: Hold limit after the grant.
        """
        peer = self.peer(part.shard)
        return Acquire(
            lock,
            peer.epoch,
            plan.placement.version,
            self.sendings.next(now_ns),
            part.items,
            wait_ns,
            hold_ns,
            self.seen_stamp_ns,
            len(plan.locks) == 1 and not plan.views,
            peer.successions,
            after,
        )

    def ended(self, lock: L) -> None:
        """Forget a lock that rests; called by the lock itself.

        Its far grant stays here in the same step, or is given back.
        """
        self._locks.pop(lock.lock, None)
        keeping = lock.keeping
        if keeping is not None and keeping.grant is not None and keeping.grant.far:
            self.kept.settle(keeping)
        if self.kept.recalled:
            self.kept.recalled -= {(part.shard, part.token) for part in lock.parts}

    def ask_again(self) -> None:
        """A shard has come back: no lock need wait any longer before it asks again."""
        for lock in self._locks.values():
            lock.ask_again()

    def shards_in_use(self) -> list[str]:
        """Return the shards that know this session, to keep it alive there.

        Also while another thread learns of one.
        """
        return [shard for shard, peer in tuple(self.peers.items()) if peer.epoch]


_GRANTS_COUNT = frozenset((Phase.ACQUIRING, Phase.VIEWING, Phase.HELD))


def _epoch_of(request: Request) -> int | None:
    """Return the epoch that a request was made for (that of its grant, token or cursor)."""
    made_in = getattr(request, "token", None) or getattr(request, "after", None)
    if made_in is None or (made_in == START and isinstance(request, KeepVersions)):
        return getattr(request, "epoch", None)
    epoch: int = made_in.epoch
    return epoch
