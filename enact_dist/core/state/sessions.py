"""Sessions: who is alive, what each lane did last, and what a restart waits for.

A session is one process of a client.  Its lease runs while its keep-alives arrive or its
liveliness token is seen:  ``max(last keep-alive + TTL, token last seen + TTL / 2)``.  The token is
kept alive by the transport's native threads, so a client whose interpreter is busy for half a
minute keeps its lease, while a stopped or unplugged one loses it.

A late expiry is always allowed, an early one never: when the shard itself stood still, every
deadline moves by as much (`stalled`).
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from itertools import islice
from typing import TYPE_CHECKING, Final

from enact_dist.core.protocol.parts import CAUSE_COMMIT, Cause
from enact_dist.core.state.clock import DueTimes

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Iterator

    from enact_dist.core.protocol.datum import LockId, Token
    from enact_dist.core.protocol.messages import (
        Answer,
        Changed,
        Commit,
        Hello,
        Prepare,
        SlotVersion,
    )
    from enact_dist.core.protocol.records import OutcomeRecord, SessionRecord

LANES_MAX: Final = 1024
"""Threads of one process that may hold locks; bounds the outcome table."""
SESSIONS_MAX: Final = 10_000
"""Sessions of one shard; a cell has some dozens."""
LOOKED_AT_MAX: Final = 1_000
"""Sessions among which one is looked for that may make room for another."""
DRIFT_PER_CENT: Final = 1
"""Assumed bound on the rate error between two hosts' monotonic clocks (a crystal has 0.01 %)."""
IDLE_TTLS: Final = 4
"""After so many TTLs without a sign of life a session is forgotten."""


@dataclass(slots=True)
class Lane:
    """What one thread of a client did: bounds exactly-once to one entry per thread.

    Attributes:
        top: Highest seq that asked for a lock here; each seq is granted at most once.
        outcome: Outcome of its newest commit.
        validated: The newest lock whose reads were found intact, with its token.
        changed: The answer to its newest lock whose expectation failed.
        ended: The newest lock that the shard took away, with the cause.
    """

    top: int = 0
    outcome: OutcomeRecord | None = None
    validated: tuple[LockId, Token] | None = None
    changed: Changed | None = None
    ended: tuple[LockId, str] | None = None


@dataclass(slots=True)
class _Retired:
    """What stays known of a session that has ended, for late questions and late copies."""

    identity: str = ""
    lanes: dict[int, Lane] = field(default_factory=dict)
    act: tuple[int, Answer | None] = (0, None)


@dataclass(slots=True)
class SessionState:
    """One client process as a shard sees it.

    `acknowledged` says that it has dropped all grants of earlier epochs; until every recovered
    session has, or their leases must have run out, a restarted shard grants nothing.
    `present` says that it has said hello in this epoch.  `act` is the count of the newest
    `Fork`, `DropWorld` or `KeepVersions` that it has asked for, and its answer once there is one.
    `identity` is whose it is, see `core.shard.owners`.
    """

    session: str
    ttl_ns: int
    renewed_ns: int
    actor: str = ""
    host: str = ""
    pid: int = 0
    observer: bool = False
    present: bool = False
    acknowledged: bool = False
    durable: bool = False
    count_seen: int = 0
    report: bytes = b""
    token_present: bool = False
    token_seen_ns: int | None = None
    lanes: dict[int, Lane] = field(default_factory=dict)
    act: tuple[int, Answer | None] = (0, None)
    identity: str = ""

    def cause(
        self,
        message: Commit | Prepare,
        versions: tuple[SlotVersion, ...],
        stamp_ns: int,
        held_ns: int,
    ) -> Cause:
        """Return the cause of what one of its locks, held for so long, is about to write.

        The client says what it has read; who it is, and how long it has held the lock, the shard
        knows itself.  All slots of a commit share the object.
        """
        return Cause(
            message.lock,
            CAUSE_COMMIT,
            self.actor,
            self.host,
            self.pid,
            stamp_ns,
            held_ns,
            message.reads,
            message.reads_left_out,
            versions,
        )

    def lease_end_ns(self, now_ns: int) -> int:
        """Return when the lease ends if no further sign of life comes."""
        by_message = self.renewed_ns + self.ttl_ns
        if self.token_seen_ns is None:
            return by_message
        seen_ns = now_ns if self.token_present else self.token_seen_ns
        return max(by_message, seen_ns + self.ttl_ns // 2)

    def idle_ns(self, now_ns: int) -> int:
        """Return from when on the session is forgotten if no further sign of life comes."""
        return self.lease_end_ns(now_ns) + IDLE_TTLS * self.ttl_ns + 1

    def renew(self, now_ns: int, count: int) -> None:
        """Take a message with this counter for a sign of life."""
        if now_ns > self.renewed_ns:  # noqa: PLR1730 - as in `Stamps.next`
            self.renewed_ns = now_ns
        if count > self.count_seen:  # noqa: PLR1730 - as in `Stamps.next`
            self.count_seen = count

    def lane(self, lane: int) -> Lane:
        """Return the lane, made on first use."""
        found = self.lanes.get(lane)
        if found is None:
            found = self.lanes[lane] = Lane()
        return found


class SessionTable:
    """All sessions of one shard, and the grace after a restart.

    Attributes:
        shortest_ttl_ns: Shortest lease of all sessions; None without sessions.
    """

    __slots__ = (
        "_idle",
        "_of_identity",
        "_recovered",
        "_retired",
        "_tokens",
        "_ttls",
        "by_id",
        "grace_end_ns",
        "shortest_ttl_ns",
    )

    def __init__(
        self,
        recovered: Iterable[SessionRecord],
        *,
        outcomes: Iterable[OutcomeRecord] = (),
        now_ns: int,
    ) -> None:
        self.by_id: dict[str, SessionState] = {}
        self._idle = DueTimes[str]()
        self._tokens: dict[tuple[str, str], None] = {}
        self._retired: dict[str, _Retired] = {}
        self._of_identity: dict[str, set[str]] = {}
        self._ttls: Counter[int] = Counter()
        self.shortest_ttl_ns: int | None = None
        for record in recovered:
            self._add(
                SessionState(
                    record.session,
                    record.ttl_ns,
                    renewed_ns=now_ns,
                    durable=True,
                    identity=record.identity,
                )
            )
            self._of_identity.setdefault(record.identity, set()).add(record.session)
        self._recovered = len(self.by_id)
        for outcome in outcomes:
            session = self.by_id.get(outcome.lock.session)
            lanes = (
                session.lanes
                if session is not None
                else self._retired.setdefault(outcome.lock.session, _Retired()).lanes
            )
            lanes[outcome.lock.lane] = Lane(top=outcome.lock.seq, outcome=outcome)
        longest_ns = max((session.ttl_ns for session in self.by_id.values()), default=0)
        self.grace_end_ns = now_ns + longest_ns * (100 + 2 * DRIFT_PER_CENT) // 100

    def _add(self, session: SessionState) -> None:
        self.by_id[session.session] = session
        self._idle.put(session.session, session.idle_ns(session.renewed_ns))
        self._ttls[session.ttl_ns] += 1
        self.shortest_ttl_ns = min(self.shortest_ttl_ns or session.ttl_ns, session.ttl_ns)

    def __iter__(self) -> Iterator[SessionState]:
        return iter(self.by_id.values())

    def in_grace(self, now_ns: int) -> bool:
        """Whether grants of an earlier epoch may still be believed in somewhere."""
        return now_ns < self.grace_end_ns

    def end_grace_if_all_acknowledged(self, now_ns: int) -> None:
        """End the grace early once no client can still believe in an older grant."""
        if now_ns < self.grace_end_ns and all(
            session.acknowledged for session in self if session.durable
        ):
            self.grace_end_ns = now_ns

    def owner(self, session: str) -> str | None:
        """Return the identity of a session, even of an ended one; None if unknown."""
        found = self.by_id.get(session) or self._retired.get(session)
        return found.identity if found is not None else None

    def of(self, identity: str) -> Collection[str]:
        """Return the sessions of an identity."""
        return self._of_identity.get(identity, ())

    def _disown(self, session: SessionState) -> None:
        mine = self._of_identity.get(session.identity, set())
        mine.discard(session.session)
        if not mine:
            self._of_identity.pop(session.identity, None)

    def full(self, now_ns: int) -> bool:
        """Whether one more session has to wait for room.

        Those that a restarted shard waits for take none until the grace is over.
        """
        awaited = self._recovered if self.in_grace(now_ns) else 0
        return len(self.by_id) >= SESSIONS_MAX + min(awaited, SESSIONS_MAX)

    def unproven(self, now_ns: int) -> Iterator[SessionState]:
        """Yield sessions, the oldest first, that showed no sign of life since their hello.

        Only the oldest of all are looked at: it is asked for each hello beyond the bound.
        """
        awaited = self.in_grace(now_ns)
        for session in islice(self.by_id.values(), LOOKED_AT_MAX):
            away = awaited and not session.present
            if not away and not session.token_present and not session.count_seen:
                yield session

    def hello(
        self, message: Hello, *, identity: str, epoch: int, ttl_ns: int, now_ns: int
    ) -> tuple[SessionState, bool]:
        """Open or refresh a session; say also whether it needs a durable record first.

        Only the exact epoch counts as an acknowledgement of it.
        """
        session = self.by_id.get(message.session)
        if session is None:
            session = SessionState(message.session, ttl_ns, renewed_ns=now_ns, acknowledged=True)
            retired = self._retired.pop(message.session, None)
            if retired is not None:
                session.lanes, session.act = retired.lanes, retired.act
            self._add(session)
        bound = bool(identity) and not session.identity
        if bound:
            self._disown(session)
            session.identity = identity
        self._of_identity.setdefault(session.identity, set()).add(session.session)
        if (message.session, identity) in self._tokens:
            del self._tokens[message.session, identity]
            session.token_present = True
            session.token_seen_ns = now_ns
        session.renewed_ns = max(session.renewed_ns, now_ns)
        session.actor, session.host, session.pid = message.actor, message.host, message.pid
        session.observer = message.observer
        if message.known_epoch == epoch:
            session.acknowledged = True
        return session, not message.observer and (bound or not session.durable)

    def known(self, session: str) -> SessionState | None:
        """Return the session if it has sent a hello in this epoch."""
        found = self.by_id.get(session)
        return found if found is not None and found.present else None

    def token_seen(self, session: str, present: bool, *, identity: str, now_ns: int) -> bool:
        """Note that a liveliness token appeared or vanished; whether the session is live and its.

        A token of an identity other than the session's is ignored.
        """
        found = self.by_id.get(session)
        if found is None or found.identity != identity:
            self._tokens.pop((session, identity), None)
            if present:
                self._expect(session, identity)
            return False
        if present or found.token_present:
            found.token_seen_ns = now_ns
        found.token_present = present
        return True

    def _expect(self, session: str, identity: str) -> None:
        """Record a token without a hello of its session; the oldest ones make room."""
        self._tokens[session, identity] = None
        while len(self._tokens) > SESSIONS_MAX:
            del self._tokens[next(iter(self._tokens))]

    def stalled(self, gap_ns: int) -> None:
        """Move every deadline by the time that the shard itself stood still."""
        self.grace_end_ns += gap_ns
        for session in self:
            session.renewed_ns += gap_ns
            if session.token_seen_ns is not None:
                session.token_seen_ns += gap_ns

    def idle(self, now_ns: int) -> list[SessionState]:
        """Return sessions that have shown no sign of life for `IDLE_TTLS` TTLs.

        They are looked at once more at the next call, unless they are forgotten by then.
        """
        idle: list[SessionState] = []
        if self.in_grace(now_ns):
            return idle
        for name in self._idle.take(now_ns):
            session = self.by_id[name]
            idle_ns = session.idle_ns(now_ns)
            if idle_ns <= now_ns:
                idle.append(session)
            self._idle.put(name, idle_ns)
        idle.sort(key=lambda session: (session.idle_ns(now_ns), session.session))
        return idle

    def lanes_of(self, session: str) -> dict[int, Lane] | None:
        """Return the lanes of a session, also of one that ended a while ago."""
        found = self.by_id.get(session)
        if found is not None:
            return found.lanes
        retired = self._retired.get(session)
        return retired.lanes if retired is not None else None

    def forget(self, session: str) -> None:
        """Drop a session; what it did last stays known, for late questions and late copies."""
        found = self.by_id.pop(session, None)
        if found is None:
            return
        self._idle.drop(session)
        self._disown(found)
        self._ttls[found.ttl_ns] -= 1
        if not self._ttls[found.ttl_ns]:
            del self._ttls[found.ttl_ns]
            if found.ttl_ns == self.shortest_ttl_ns:
                self.shortest_ttl_ns = min(self._ttls, default=None)
        if found.token_present:
            self._expect(session, found.identity)
        if found.lanes or found.act[0]:
            self._retired[session] = _Retired(found.identity, found.lanes, found.act)
            while len(self._retired) > SESSIONS_MAX:
                del self._retired[next(iter(self._retired))]
