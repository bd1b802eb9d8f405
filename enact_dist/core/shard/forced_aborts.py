"""Locks that an operator has aborted here, while the shard that decides was away.

::

    ForceAbort ── Persist ── freed, told ──> asks the lost shard on and on
                                             ├─ it says aborted:    forgotten, all is well
                                             └─ it says committed:  alarm, durable before it ends

Such a commit stands on the other shards and not here: nothing can mend that but people, so it must
not pass in silence.  The lost shard may come back after years; asking costs one message each
`ASK_NS`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Final

from enact_dist.core.protocol.messages import (
    RESOLVED_ABORTED,
    RESOLVED_COMMITTED,
    Finished,
    Resolve,
)
from enact_dist.core.protocol.records import (
    AuditRecord,
    Call,
    Effect,
    ForcedEnded,
    ForcedRecord,
    LogEvent,
    Persist,
    Reply,
)
from enact_dist.core.state.audit import ALARM, CONFIRMED
from enact_dist.terms import Durability

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from enact_dist.core.protocol.datum import LockId, Position
    from enact_dist.core.protocol.messages import Resolved
    from enact_dist.core.shard.state import ShardState

ASK_NS: Final = 2_000_000_000
"""How often a shard that was given up is asked what it had decided."""


@dataclass(slots=True)
class _Ending:
    """An answer of the lost shard that the store is to keep first."""

    record: ForcedRecord
    replies: list[int] = field(default_factory=list)


class ForcedAborts:
    """Everything that was aborted by hand and is not known to have been aborted for all."""

    def __init__(self, state: ShardState, recovered: Iterable[ForcedRecord]) -> None:
        self._state = state
        self._records = {record.lock: record for record in recovered}
        self._ask_ns = dict.fromkeys(self._records, state.now_ns)
        self._at_store: dict[LockId, _Ending] = {}

    def __contains__(self, lock: LockId) -> bool:
        return lock in self._records

    def get(self, lock: LockId) -> ForcedRecord | None:
        """Return what is kept of a lock that was aborted by hand."""
        return self._records.get(lock)

    def add(self, record: ForcedRecord) -> None:
        """A lock was aborted by hand, and that is durable."""
        self._records[record.lock] = record
        self._ask_ns[record.lock] = self._state.now_ns + ASK_NS

    def ask(self) -> Iterator[Effect]:
        """Ask the lost shards what they had decided."""
        now_ns = self._state.now_ns
        for lock, due_ns in self._ask_ns.items():
            if due_ns <= now_ns:
                record = self._records[lock]
                resolve = Resolve(lock, record.primary_token, self._state.settings.name)
                yield Call(record.primary, resolve)
                self._ask_ns[lock] = now_ns + ASK_NS

    def ask_now(self, shard: str) -> None:
        """Let the next `ask` ask this shard, whenever it was asked before."""
        for lock in self._ask_ns:
            if self._records[lock].primary == shard:
                self._ask_ns[lock] = self._state.now_ns

    def next_deadline_ns(self) -> int | None:
        """Return when a lost shard is to be asked again."""
        return min(self._ask_ns.values(), default=None)

    def resolved(self, answer: Resolved) -> Iterator[Effect]:
        """The lost shard is back and says what it had decided."""
        if answer.kind == RESOLVED_COMMITTED:
            yield from self.committed(answer.lock, answer.position, [])
        elif answer.kind == RESOLVED_ABORTED and answer.lock in self._ask_ns:
            record = self._records.pop(answer.lock)
            del self._ask_ns[answer.lock]
            text = f"{_named(record)}: {record.primary} is back and had not committed it"
            self._state.count("forced_confirmed")
            kept = self._state.audit.keep(AuditRecord(self._state.wall_ns, text, CONFIRMED))
            yield LogEvent("lock.forced", text)
            yield Persist(0, (kept, ForcedEnded(record.lock)), Durability.OS)

    def committed(self, lock: LockId, position: Position, replies: list[int]) -> Iterator[Effect]:
        """The lost shard is back and says that it had committed: the commit is torn."""
        under_way = self._at_store.get(lock)
        if under_way is not None:
            under_way.replies += replies
            return
        record = self._records[lock]
        self._ask_ns.pop(lock, None)
        slots = ", ".join(str(slot) for slot in record.slots)
        text = (
            f"{_named(record)}, but {record.primary} had committed it (stamp {position.stamp_ns}):"
            f" its writes of {slots} are missing on {self._state.settings.name}; compare these data"
            " with what the lock wrote elsewhere and write them again"
        )
        self._state.count("forced_but_committed")
        kept = self._state.audit.keep(AuditRecord(self._state.wall_ns, text, ALARM))
        ending = self._at_store[lock] = _Ending(record, replies)
        yield LogEvent("lock.alarm", text, grave=True)
        then = partial(self._persisted, ending)
        yield from self._state.persist((kept, ForcedEnded(lock)), Durability.DURABLE, then)

    def _persisted(self, ending: _Ending, _: int) -> Iterator[Effect]:
        """The alarm is durable: the shard that decided may forget the lock."""
        lock = ending.record.lock
        del self._at_store[lock], self._records[lock]
        for reply_to in ending.replies:
            yield Reply(reply_to, Finished(ending.record.lock))


def _named(record: ForcedRecord) -> str:
    return f"lock {record.lock}, aborted by hand without the word of {record.primary}"
