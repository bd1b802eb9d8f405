"""What the state machines found, as directed tests."""

from __future__ import annotations

from shard_bench import ShardBench, datum, item, lock_id, slot

from enact_dist.core.protocol.datum import Token
from enact_dist.core.protocol.messages import (
    Commit,
    Committed,
    Fenced,
    Prepare,
    Prepared,
    Refused,
    WriteItem,
)
from enact_dist.terms import Access

LOCK = lock_id("ann")
WRITE = WriteItem(slot(), datum("new"))


def test_commit_of_a_lock_whose_promise_is_at_the_disk_is_refused():
    """It is decided elsewhere; the shard goes on, and the promise with it."""
    bench = ShardBench()
    bench.hello("ann")
    grant = bench.granted(LOCK, item(Access.WRITE))
    bench.disk_is_done = False
    handle = bench.send(Prepare(LOCK, grant.token, (WRITE,), 0, (), "far", Token(7, 7)))

    answer = bench.ask(Commit(LOCK, grant.token, (WRITE,), 0))

    assert isinstance(answer, Refused)
    bench.finish_disk()
    assert isinstance(bench.answers[handle], Prepared)
    assert bench.value() is None


def test_malformed_commit_of_a_stranger_does_not_end_a_lock():
    """Whoever does not hold the lock is fenced, whatever else is wrong with the request."""
    bench = ShardBench()
    bench.hello("ann")
    grant = bench.granted(LOCK, item(Access.WRITE))
    forged = Token(grant.token.epoch, grant.token.number + 1)

    assert isinstance(bench.ask(Commit(LOCK, forged, (WRITE, WRITE), 0)), Fenced)
    assert isinstance(bench.ask(Commit(LOCK, grant.token, (WRITE,), 0)), Committed)
