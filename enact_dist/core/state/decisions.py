"""The primary's half of a commit over shards: its one record decides for all participants.

::

    Commit(participants) ── record durable = decided ── client answered
                                      └── Finish to each participant, again until Finished
                                                       └── all: DecisionDone (lazily)

There is no record of an abort: a token that is not live can never become live again, so the
answer about a lock that is neither decided nor held is *aborted* (presumed abort).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Final

from enact_dist.core.protocol.datum import LockId, Position
from enact_dist.core.protocol.messages import Finish
from enact_dist.core.protocol.records import Call, DecisionDone, DecisionRecord, Effect, Persist
from enact_dist.terms import Durability

AGAIN_NS_MIN: Final = 200_000_000
AGAIN_NS_MAX: Final = 2_000_000_000
"""Pause before `Finish` is sent again; doubles up to the second figure."""


@dataclass(slots=True)
class Decision:
    """A commit that not every participant is known to have applied."""

    position: Position
    left: dict[str, None]
    due_ns: int
    pause_ns: int = AGAIN_NS_MIN


class Decisions:
    """All decisions of one shard that participants have not confirmed yet."""

    __slots__ = ("_count", "by_lock")

    def __init__(
        self, recovered: Iterable[DecisionRecord], *, now_ns: int, count: Callable[..., None]
    ) -> None:
        self._count = count
        self.by_lock: dict[LockId, Decision] = {
            record.lock: Decision(record.position, dict.fromkeys(record.participants), now_ns)
            for record in recovered
        }

    def decided(self, record: DecisionRecord, *, now_ns: int) -> Iterator[Effect]:
        """A decision is durable: tell every participant."""
        self.by_lock[record.lock] = Decision(
            record.position, dict.fromkeys(record.participants), now_ns
        )
        self._count("decisions")
        yield from self.tell(now_ns)

    def tell(self, now_ns: int) -> Iterator[Effect]:
        """Tell those participants whose time has come (again)."""
        for lock, decision in self.by_lock.items():
            if decision.due_ns > now_ns:
                continue
            for shard in decision.left:
                yield Call(shard, Finish(lock, decision.position))
            decision.due_ns = now_ns + decision.pause_ns
            decision.pause_ns = min(2 * decision.pause_ns, AGAIN_NS_MAX)

    def tell_now(self, shard: str, now_ns: int) -> Iterator[Effect]:
        """Tell a participant that has come back into reach, and begin with short pauses again."""
        for decision in self.by_lock.values():
            if shard in decision.left:
                decision.due_ns, decision.pause_ns = now_ns, AGAIN_NS_MIN
        yield from self.tell(now_ns)

    def finished(self, lock: LockId, shard: str) -> Iterator[Effect]:
        """A participant has applied the commit, and that survives."""
        decision = self.by_lock.get(lock)
        if decision is None:
            return
        decision.left.pop(shard, None)
        if not decision.left:
            del self.by_lock[lock]
            yield Persist(0, (DecisionDone(lock),), Durability.OS)

    def next_deadline_ns(self) -> int | None:
        """Return when the next participant is to be notified again."""
        return min((decision.due_ns for decision in self.by_lock.values()), default=None)
