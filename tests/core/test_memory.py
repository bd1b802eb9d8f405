"""What a shard and a client keep does not grow with the number of commits."""

from __future__ import annotations

import gc
from collections import deque
from types import BuiltinFunctionType, FunctionType, MethodType, ModuleType
from typing import TYPE_CHECKING

import pytest
from shard_bench import ASPECTS, MS, TTL_NS, WALL_NS, S, datum, item, slot

from enact_dist.core.client.client import Client
from enact_dist.core.client.plan import Phase
from enact_dist.core.protocol.messages import (
    Commit,
    Goodbye,
    Hello,
    PlacementMap,
    Prepare,
    Register,
    ShardEntry,
    WriteItem,
)
from enact_dist.core.protocol.placement import shard_of
from enact_dist.core.protocol.records import (
    Call,
    Called,
    Persist,
    Persisted,
    Recovered,
    Reply,
    Tick,
)
from enact_dist.core.shard.shard import Shard
from enact_dist.core.shard.state import ShardSettings
from enact_dist.core.state import grants as tenures
from enact_dist.core.state import history, sessions
from enact_dist.terms import Access

if TYPE_CHECKING:
    from enact_dist.core.client.lock import MultiLock
    from enact_dist.core.protocol.messages import Answer, Request
    from enact_dist.core.protocol.records import Effect

PLACEMENT = PlacementMap(1, (ShardEntry("a", ()), ShardEntry("b", ())), ())
ROUNDS = 12
CODE = (type, FunctionType, MethodType, BuiltinFunctionType, ModuleType)


class FastCell:
    """Two shards whose disks and calls take no time, and nothing that remembers what was said."""

    def __init__(self) -> None:
        self.now_ns, self.wall_ns = 1_000 * S, WALL_NS
        self.shards = {
            name: Shard(
                ShardSettings(name, PLACEMENT, worlds=("online",)),
                Recovered(1),
                now_ns=self.now_ns,
                wall_ns=self.wall_ns,
            )
            for name in ("a", "b")
        }
        for name in self.shards:
            self.ask(name, Hello("admin", 0, TTL_NS, "admin", "host", 1, observer=True))
            self.ask(name, Register("admin", (), ASPECTS))
            self.ask(name, Goodbye("admin"))

    def ask(self, name: str, request: Request) -> Answer | None:
        """Return the answer that comes at once; every effect is carried out."""
        return self._do(name, self._handle(name, request, 1))

    def _handle(self, name: str, message: object, reply_to: int) -> list[Effect]:
        return self.shards[name].handle(
            message, reply_to=reply_to, now_ns=self.now_ns, wall_ns=self.wall_ns
        )

    def _do(self, name: str, effects: list[Effect]) -> Answer | None:
        answer = None
        left = deque((name, effect) for effect in effects)
        while left:
            where, effect = left.popleft()
            more: list[Effect] = []
            if isinstance(effect, Reply) and effect.reply_to == 1 and where == name:
                answer = effect.answer
            elif isinstance(effect, Persist) and effect.ticket:
                more = self._handle(where, Persisted(effect.ticket), 0)
            elif isinstance(effect, Call):
                said = self.ask(effect.shard, effect.request)
                if said is not None:
                    more = self._handle(where, Called(effect.shard, effect.request, said), 0)
            left.extend((where, one) for one in more)
        return answer

    def wait(self, ns: int) -> None:
        """Let time pass in steps that no shard takes for its own stall."""
        for _ in range(0, ns, 100 * MS):
            self.now_ns += 100 * MS
            self.wall_ns += 100 * MS
            for name in self.shards:
                self._do(name, self._handle(name, Tick(), 0))

    def objects(self, *others: object) -> int:
        """Count the objects that the shards, and `others`, keep alive; code not counted."""
        seen: dict[int, object] = {}
        left: list[object] = [*self.shards.values(), *others]
        while left:
            found = left.pop()
            if id(found) not in seen and not isinstance(found, CODE):
                seen[id(found)] = found
                left += gc.get_referents(found)
        return len(seen)


class FastClient:
    """A client of such a cell: one thread, and a death where it is asked for."""

    def __init__(self, cell: FastCell, session: str) -> None:
        self.cell = cell
        self.core = Client(session, ttl_ns=TTL_NS)
        self.entities = [
            next(e for e in (f"e{n}" for n in range(99)) if shard_of(e, PLACEMENT) == shard)
            for shard in cell.shards
        ]
        for shard in cell.shards:
            hello = self.core.hello(shard)
            self.core.answered(shard, hello, cell.ask(shard, hello), cell.now_ns)

    def commit(self, *, dies_before: type | None = None) -> MultiLock:
        """Write on both shards, or die before the first request of a kind."""
        core, cell = self.core, self.cell
        plan = core.plan([item(Access.WRITE, entity) for entity in self.entities])
        lock = core.begin(0, plan, now_ns=cell.now_ns, wait_ns=5 * S, hold_ns=60 * S)
        while lock.phase.busy or lock.phase is Phase.HELD:
            if lock.phase is Phase.HELD:
                writes = {
                    shard: [WriteItem(slot(entity), datum("x"))]
                    for shard, entity in zip(cell.shards, self.entities, strict=True)
                }
                lock.finish(writes, give_up_ns=cell.now_ns + 10 * S)
            calls, _ = lock.next_calls(cell.now_ns)
            if not calls:
                cell.wait(100 * MS)
            for shard, request in calls:
                if dies_before is not None and isinstance(request, dies_before):
                    return lock
                lock.answered(shard, request, cell.ask(shard, request), cell.now_ns)
        for shard, release in lock.take_releases():
            cell.ask(shard, release)
        return lock


@pytest.mark.parametrize(
    "commits", [3_000, pytest.param(100_000, marks=pytest.mark.slow)], ids=["3k", "100k"]
)
def test_nothing_grows_with_the_number_of_commits(commits, monkeypatch):
    """Over two shards, with clients that die before and after they have prepared."""
    monkeypatch.setattr(sessions, "SESSIONS_MAX", 4)
    monkeypatch.setattr(history, "LOOSE_NS", 0)
    monkeypatch.setattr(tenures, "STALE_ENDS_MAX", 16)
    cell = FastCell()
    survivor = FastClient(cell, "survivor")
    found = []
    for number in range(commits):
        cell.now_ns += MS // 10
        cell.wall_ns += MS // 10
        assert survivor.commit().phase is Phase.COMMITTED
        if number % (commits // ROUNDS) == 0:
            mortal = FastClient(cell, f"mortal {number}")
            mortal.commit()
            mortal.commit(dies_before=(Prepare, Commit)[number // (commits // ROUNDS) % 2])
            cell.wait(12 * S)
            survivor = FastClient(cell, f"survivor {number}")
            for _ in range(600):
                survivor.commit()
            found.append(cell.objects(survivor.core))

    assert max(found[ROUNDS // 2 :]) <= 1.1 * max(found[: ROUNDS // 2]), found
    for shard in cell.shards.values():
        shard.assert_invariants()
        assert not shard.state.decisions.by_lock
        assert not shard.state.tenures.by_lock
        assert shard.counters["leases_expired"] >= ROUNDS // 2
    assert cell.shards["b"].counters["resolved_aborted"] >= ROUNDS // 4


def test_plans_are_remembered_unless_they_name_a_stamp():
    """Each set of data with one stamp is asked for once; what is asked over and over is planned."""
    cell = FastCell()
    client = FastClient(cell, "ann")
    usual = [item(Access.VIEW, entity) for entity in client.entities]
    plan = client.core.plan(usual)
    before = cell.objects(client.core)

    for stamp_ns in range(1, 100):
        found = client.core.plan([one._replace(captured_ns=stamp_ns) for one in usual])
        assert {one.captured_ns for _, items in found.views for one in items} == {stamp_ns}

    assert client.core.plan(usual) is plan
    assert cell.objects(client.core) == before


def test_past_is_bounded_where_the_clock_stands_still(monkeypatch):
    """A wall clock that was set back lets the stamps count by one: nothing gets old."""
    monkeypatch.setattr(history, "LOOSE_STATES_MAX", 100)
    cell = FastCell()
    client = FastClient(cell, "ann")
    client.commit()
    cell.wall_ns -= 3600 * S
    for _ in range(300):
        client.commit()

    kept = cell.shards["a"].state.slots.history.of(slot(client.entities[0]))
    assert len(kept.states) == 100
    assert kept.at(kept.states[0].stamp_ns + 50) is not None
