"""Bench `core`: the shard's decisions by themselves, without clock, wire and transport."""

from __future__ import annotations

import itertools
import time
from collections import deque
from collections.abc import Sequence
from typing import Any, Final

from enact_dist.bench.floors import QUERY
from enact_dist.bench.place import WORLD
from enact_dist.bench.rows import Case, Goal, at_most
from enact_dist.bench.timing import COUNT_MAX, timed
from enact_dist.core.protocol.datum import Datum, LockId, Slot, Token
from enact_dist.core.protocol.messages import (
    Acquire,
    AspectEntry,
    Commit,
    Granted,
    Hello,
    Item,
    PlacementMap,
    Register,
    Request,
    ShardEntry,
    WriteItem,
)
from enact_dist.core.protocol.records import Persist, Persisted, Recovered, Reply
from enact_dist.core.shard.shard import Shard
from enact_dist.core.shard.state import ShardSettings
from enact_dist.errors import MisuseError
from enact_dist.terms import Access

SESSION: Final = "bench"
WAITERS: Final = 1_000
SESSIONS: Final = 50
SECOND_NS: Final = 1_000_000_000
_DATUM: Final = Datum(b"t", b"1", 1)


class Decider:
    """A shard whose time stands still and whose disk is done at once."""

    def __init__(self, sessions: int = 1) -> None:
        placement = PlacementMap(1, (ShardEntry("s0", ()),), ())
        self._shard = Shard(
            ShardSettings("s0", placement, worlds=(WORLD,)),
            Recovered(1),
            now_ns=1_000 * SECOND_NS,
            wall_ns=1_800_000_000 * SECOND_NS,
        )
        self._counts = [itertools.count(1) for _ in range(sessions)]
        for number in range(sessions):
            name = f"{SESSION}{number}"
            self.ask(Hello(name, 0, 2 * SECOND_NS, name, "host", 1, False))
        self.ask(Register(f"{SESSION}0", (), (AspectEntry("count", "int", "volatile"),)))

    def ask(self, message: Request) -> list[Any]:
        """Return all answers that a request brought about, those of others included."""
        answers = []
        waiting: deque[Any] = deque([message])
        while waiting:
            for effect in self._shard.handle(
                waiting.popleft(),
                reply_to=1,
                now_ns=1_000 * SECOND_NS,
                wall_ns=1_800_000_000 * SECOND_NS,
            ):
                if isinstance(effect, Reply):
                    answers.append(effect.answer)
                elif isinstance(effect, Persist) and effect.ticket:
                    waiting.append(Persisted(effect.ticket))
        return answers

    def acquire(self, lane: int, seq: int, *slots: Slot, session: int = 0) -> list[Any]:
        """Ask for slots to write."""
        items = tuple(Item(Access.WRITE, *slot, 0) for slot in slots)
        lock = LockId(f"{SESSION}{session}", lane, seq)
        count = next(self._counts[session])
        return self.ask(Acquire(lock, 1, 1, count, items, SECOND_NS, 60 * SECOND_NS, 0, alone=True))

    def commit(self, lock: LockId, token: Token, *slots: Slot) -> list[Any]:
        """Publish a small datum in each slot."""
        return self.ask(Commit(lock, token, tuple(WriteItem(slot, _DATUM) for slot in slots), 0))


def granted_of(answers: Sequence[Any]) -> Granted:
    """Return the grant among answers.

    Raises:
        MisuseError: There is none: the bench asks wrongly.
    """
    for answer in answers:
        if isinstance(answer, Granted):
            return answer
    raise MisuseError(f"no grant among {answers!r}")


def _slots(count: int) -> tuple[Slot, ...]:
    return tuple(Slot(WORLD, f"counter{number}", "count") for number in range(count))


def _acquire_and_commit(count: int) -> Case:
    slots = _slots(count)
    goal = at_most(50.0, "≤ 50 µs") if count == 1 else None

    def measure(seconds_s: float) -> list[float]:
        decider, seqs = Decider(), itertools.count(1)

        def act() -> None:
            grant = granted_of(decider.acquire(0, next(seqs), *slots))
            decider.commit(grant.lock, grant.token, *slots)

        return timed(act, seconds_s)

    what = "one slot" if count == 1 else f"{count} slots"
    return Case("core", f"acquire + commit, {what}", measure, QUERY, goal)


def _hand_over() -> Case:
    goal: Goal = at_most(100.0, "≤ 100 µs")
    return Case("core", f"hand-over, {WAITERS:,} waiters", hand_over_us, QUERY, goal)


def hand_over_us(seconds_s: float) -> list[float]:
    """Commit the holder's lock over and over, while 1,000 wait: each commit grants the next."""
    decider = Decider(SESSIONS)
    (slot,) = _slots(1)
    lanes = [(n % SESSIONS, n // SESSIONS) for n in range(WAITERS + 1)]
    grant = granted_of(decider.acquire(lanes[0][1], 1, slot, session=lanes[0][0]))
    for session, lane in lanes[1:]:
        decider.acquire(lane, 1, slot, session=session)
    times_us: list[float] = []
    end_s = time.perf_counter() + seconds_s
    while len(times_us) < COUNT_MAX:
        held = grant
        started_s = time.perf_counter()
        answers = decider.commit(held.lock, held.token, slot)
        ended_s = time.perf_counter()
        times_us.append((ended_s - started_s) * 1e6)
        grant = granted_of(answers)
        session = int(held.lock.session.removeprefix(SESSION))
        decider.acquire(held.lock.lane, held.lock.seq + 1, slot, session=session)
        if ended_s > end_s:
            break
    return times_us


def core_cases() -> list[Case]:
    """Return the cases of the bench."""
    return [_acquire_and_commit(1), _acquire_and_commit(4), _hand_over()]
