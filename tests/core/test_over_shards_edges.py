"""Commits over shards at the edges of a shard's life: other maps of the cell, and the drain."""

from __future__ import annotations

from dataclasses import replace

import pytest
from client_bench import CellBench
from shard_bench import ShardBench, datum, item, lock_id, slot

from enact_dist.core.client.plan import Phase
from enact_dist.core.protocol.datum import Position, Token
from enact_dist.core.protocol.messages import (
    Commit,
    Finish,
    Finished,
    PlacementMap,
    Prepare,
    WriteItem,
)
from enact_dist.core.protocol.records import Called, DecisionDone, Drain
from enact_dist.terms import Access

W, V = Access.WRITE, Access.VIEW
ANN = lock_id("ann")
WRITES = (WriteItem(slot(), datum("new")),)


@pytest.fixture
def cell() -> CellBench:
    return CellBench("a", "b")


def moved_on(cell: CellBench, *shards: str) -> PlacementMap:
    """Start shards again with a later map of the cell."""
    placement = cell.placement._replace(version=2)
    for name in shards:
        bench = cell.shards[name]
        bench.settings = replace(bench.settings, placement=placement)
        bench.restart()
    return placement


class TestMaps:
    def test_client_with_an_older_map_learns_the_newer_and_locks_by_it(self, cell):
        """One attempt is refused by name, the next one is placed anew."""
        client = cell.client("ann")
        items = item(W, cell.entity_on("a")), item(W, cell.entity_on("b"))
        begun = client.begin(*items)
        placement = moved_on(cell, "a", "b")
        cell.wait(5_000_000_000)

        first = client.drive(begun)
        second = client.locked(*items)

        assert first.phase in (Phase.MISPLACED, Phase.LOST)
        assert client.core.placement == placement
        assert second.phase is Phase.HELD

    @pytest.mark.parametrize("later", ["a", "b"])
    def test_shards_with_different_maps_grant_no_lock_over_both(self, cell, later):
        """Whichever of them is older; what one of them had granted is given back."""
        client = cell.client("ann")
        moved_on(cell, later)
        cell.wait(5_000_000_000)
        items = item(W, cell.entity_on("a")), item(W, cell.entity_on("b"))

        phases = [client.locked(*items).phase for _ in range(4)]

        assert Phase.HELD not in phases
        assert Phase.MISPLACED in phases
        assert not any(bench.shard.state.tenures.by_lock for bench in cell.shards.values())

    def test_views_at_a_shard_with_another_map_give_the_locks_back(self, cell):
        """A lock whose views cannot be placed holds nothing."""
        client = cell.client("ann")
        moved_on(cell, "b")
        cell.wait(5_000_000_000)

        client.core.learn_placement(cell.placement)
        lock = client.locked(item(W, cell.entity_on("a")), item(V, cell.entity_on("b")))

        assert lock.phase is Phase.MISPLACED
        assert not cell.shards["a"].shard.state.tenures.by_lock


class TestDrain:
    @pytest.fixture
    def bench(self) -> ShardBench:
        bench = ShardBench()
        bench.hello("ann", "bob")
        return bench

    def test_what_is_prepared_does_not_hold_up_a_drain_and_is_there_again(self, bench):
        """Its primary may be away for days; the promise is on the disk."""
        grant = bench.granted(ANN, item(W))
        bench.ask(Prepare(ANN, grant.token, WRITES, 0, (), "far", Token(7, 7)))

        bench.event(Drain())
        assert bench.shard.idle
        bench.restart()

        assert bench.ask(Finish(ANN, Position(bench.wall_ns, "far"))) == Finished(ANN)
        assert bench.value() == "new"

    def test_what_is_being_prepared_does(self, bench):
        """Half a promise is nothing."""
        grant = bench.granted(ANN, item(W))
        bench.disk_is_done = False
        bench.send(Prepare(ANN, grant.token, WRITES, 0, (), "far", Token(7, 7)))

        bench.event(Drain())
        busy = not bench.shard.idle
        bench.disk_is_done = True
        bench.finish_disk()

        assert busy
        assert bench.shard.idle

    def test_decision_that_is_not_told_does_not_hold_up_a_drain_and_is_told_later(self, bench):
        """The participant that is away learns it when both are back."""
        grant = bench.granted(ANN, item(W))
        bench.ask(Commit(ANN, grant.token, WRITES, 0, (), ("far",)))

        bench.event(Drain())
        assert bench.shard.idle
        bench.restart()
        bench.calls.clear()
        bench.wait(1_000_000_000)

        shard, told = bench.calls[0]
        assert (shard, told.lock) == ("far", ANN)
        bench.event(Called("far", told, Finished(ANN)))
        assert isinstance(bench.log[-1], DecisionDone)

    def test_primary_that_is_away_for_long_is_asked_at_a_steady_pace(self, bench):
        """Ten minutes of it make neither calls nor effects pile up."""
        grant = bench.granted(ANN, item(W))
        bench.ask(Prepare(ANN, grant.token, WRITES, 0, (), "far", Token(7, 7)))
        bench.wait(600_000_000_000)

        assert 500 <= len(bench.calls) <= 620
        assert set(bench.calls) == {bench.calls[0]}
