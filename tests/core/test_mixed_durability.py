"""Commits over shards are forced to the disk at each step, whatever the class of their data."""

from __future__ import annotations

import pytest
from shard_bench import S, ShardBench, datum, item, lock_id, slot

from enact_dist.core.protocol.datum import Position, Token
from enact_dist.core.protocol.messages import (
    Commit,
    Finish,
    Finished,
    Granted,
    Prepare,
    TakeView,
    WriteItem,
)
from enact_dist.core.protocol.records import DecisionRecord, PreparedEnded, PreparedRecord
from enact_dist.terms import Access, Durability

ANN = lock_id("ann")
SESSIONS = "ann", "bob"


def granted(bench: ShardBench, aspect: str) -> tuple[Granted, tuple[WriteItem, ...]]:
    """Return a grant on one slot, and a write under it."""
    grant = bench.granted(ANN, item(Access.WRITE, aspect=aspect))
    return grant, (WriteItem(slot(aspect=aspect), datum("new")),)


def prepare(bench: ShardBench, aspect: str) -> int:
    """Ask to prepare one write; return the handle of the request."""
    grant, writes = granted(bench, aspect)
    return bench.send(Prepare(ANN, grant.token, writes, 0, (), "far", Token(7, 7)))


@pytest.mark.parametrize("aspect", ["count", "note", "frame"])
class TestEveryStepIsForced:
    """A power cut would else tear the commit, or end locks that its decision relies on."""

    def test_promise(self, bench, aspect):
        """Prepared is answered when it outlasts a power cut."""
        bench.disk_is_done = False
        handle = prepare(bench, aspect)

        (persist,) = bench.pending
        assert isinstance(persist.records[0], PreparedRecord)
        assert persist.durability is Durability.DURABLE
        assert handle not in bench.answers

    def test_decision(self, bench, aspect):
        """Other shards apply theirs because of it."""
        grant, writes = granted(bench, aspect)
        bench.disk_is_done = False
        handle = bench.send(Commit(ANN, grant.token, writes, 0, (), ("far",)))

        (persist,) = bench.pending
        assert any(isinstance(record, DecisionRecord) for record in persist.records)
        assert persist.durability is Durability.DURABLE
        assert handle not in bench.answers
        assert not bench.calls

    def test_end(self, bench, aspect):
        """Once told that it has finished, the primary may forget."""
        prepare(bench, aspect)
        bench.disk_is_done = False
        handle = bench.send(Finish(ANN, Position(bench.wall_ns + S, "far")))

        (persist,) = bench.pending
        assert isinstance(persist.records[-1], PreparedEnded)
        assert persist.durability is Durability.DURABLE
        assert handle not in bench.answers
        bench.disk_is_done = True
        bench.finish_disk()
        assert bench.answers[handle] == Finished(ANN)


def test_commit_of_one_shard_still_costs_what_its_data_ask_for(bench):
    """No more is forced than before where nobody else relies on it."""
    grant, writes = granted(bench, "note")
    bench.disk_is_done = False
    bench.send(Commit(ANN, grant.token, writes, 0))

    assert [persist.durability for persist in bench.pending] == [Durability.OS]


def test_commit_is_never_applied_before_its_promise(bench):
    """Views were told that nothing more comes up to it, and a client may give a wrong stamp."""
    prepare(bench, "count")
    before = bench.ask(TakeView(lock_id("bob"), 1, 1, 1, (item(Access.VIEW),), 0))

    bench.ask(Finish(ANN, Position(5, "far")))

    assert bench.shard.state.slots[slot()].stamp_ns > before.until_ns
