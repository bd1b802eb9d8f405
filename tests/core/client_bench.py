"""A real client against real shards, in one thread: calls are answered at once or lost.

`lose` decides for each call which half of it is lost: the request, the answer, or nothing.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from shard_bench import MS, TTL_NS, S, ShardBench, datum

from enact_dist.core.client.client import Client
from enact_dist.core.protocol.messages import (
    Answer,
    Item,
    KeepAlive,
    PlacementMap,
    Request,
    ShardEntry,
    WriteItem,
)
from enact_dist.core.protocol.placement import shard_of

if TYPE_CHECKING:
    from collections.abc import Callable

    from enact_dist.core.client.lock import MultiLock
    from enact_dist.core.protocol.datum import Slot

REQUEST, ANSWER, NOTHING = "request", "answer", "nothing"


class CellBench:
    """Some shards and some clients, all with one time."""

    def __init__(self, *shards: str) -> None:
        placement = PlacementMap(1, tuple(ShardEntry(name, ()) for name in shards), ())
        self.placement = placement
        self.shards = {name: ShardBench(name=name, placement=placement) for name in shards}
        self.now_ns = next(iter(self.shards.values())).now_ns

    def client(self, session: str) -> ClientBench:
        """Open a session at every shard."""
        bench = ClientBench(self, session)
        for shard in self.shards:
            bench.call(shard, bench.core.hello(shard))
        return bench

    def wait(self, ns: int) -> None:
        """Let time pass everywhere; nobody is kept alive."""
        for shard in self.shards.values():
            shard.wait(ns)
        self.now_ns += ns

    def entity_on(self, shard: str, prefix: str = "e") -> str:
        """Return the name of an entity that is placed on a shard."""
        names = (f"{prefix}{number}" for number in range(1000))
        return next(name for name in names if shard_of(name, self.placement) == shard)


class ClientBench:
    """One client process."""

    def __init__(self, cell: CellBench, session: str) -> None:
        self.cell = cell
        self.core = Client(session, ttl_ns=TTL_NS, actor=session)
        self.sent: list[tuple[str, Request]] = []
        self.lose: Callable[[str, Request], str] = lambda _shard, _request: NOTHING

    def call(self, shard: str, request: Request) -> Answer | None:
        """Make one call outside of any lock."""
        answer = self._answer(shard, request)
        if answer is not None:
            self.core.answered(shard, request, answer, self.cell.now_ns)
        return answer

    def _answer(self, shard: str, request: Request) -> Answer | None:
        self.sent.append((shard, request))
        lost = self.lose(shard, request)
        if lost == REQUEST:
            return None
        answer = self.cell.shards[shard].ask(request)
        return None if lost == ANSWER else answer

    def keep_alive(self) -> None:
        """Send one round of keep-alives."""
        for shard in self.core.shards_in_use():
            self.call(shard, self.core.keep_alive(shard, self.cell.now_ns))

    def begin(
        self,
        *items: Item,
        lane: int = 0,
        wait_s: float = 5.0,
        hold_s: float = 60.0,
        past_ns: int = 0,
    ) -> MultiLock:
        """Start a lock, or a view of the past, without making its calls."""
        return self.core.begin(
            lane,
            self.core.plan(items, past_ns=past_ns),
            now_ns=self.cell.now_ns,
            wait_ns=int(wait_s * S),
            hold_ns=int(hold_s * S),
        )

    def step(self, lock: MultiLock) -> None:
        """Make the calls that the lock wants now, or let time pass until it wants some."""
        calls, until_ns = lock.next_calls(self.cell.now_ns)
        self.core.assert_invariants()
        if not calls and lock.phase.busy:
            self.cell.wait(max(MS, until_ns - self.cell.now_ns))
        answers = [self._answer(shard, request) for shard, request in calls]
        for (shard, request), answer in zip(calls, answers, strict=True):
            lock.answered(shard, request, answer, self.cell.now_ns)

    def drive(self, lock: MultiLock, *, steps: int = 60) -> MultiLock:
        """Make the lock's calls until it rests, then send its releases."""
        for _ in range(steps):
            if not lock.phase.busy:
                break
            self.step(lock)
        for shard, release in lock.take_releases():
            self._answer(shard, release)
        return lock

    def locked(self, *items: Item, **options: float) -> MultiLock:
        """Take a lock."""
        return self.drive(self.begin(*items, **options))

    def finish(
        self, lock: MultiLock, *writes: tuple[Slot, str | None], give_up_s: float = 10.0
    ) -> None:
        """Commit values, or nulls, under a lock."""
        by_shard: dict[str, list[WriteItem]] = {}
        for slot, text in writes:
            shard = shard_of(slot.entity, self.cell.placement)
            by_shard.setdefault(shard, []).append(
                WriteItem(slot, None if text is None else datum(text))
            )
        lock.finish(by_shard, give_up_ns=self.cell.now_ns + int(give_up_s * S))
        self.drive(lock)

    def kinds_sent(self, *, since: int = 0) -> list[str]:
        """Return the names of the requests that were sent, keep-alives left out."""
        return [
            type(request).__name__
            for _, request in self.sent[since:]
            if not isinstance(request, KeepAlive)
        ]
