"""A commit under a kept grant that comes late: once its client has given it up, it must not count."""

from __future__ import annotations

from shard_bench import ShardBench, item, lock_id, slot

from enact_dist.core.protocol.messages import (
    NOT_KEPT,
    OUTCOME_UNSEEN,
    PLACES,
    Commit,
    Fenced,
    Outcome,
    Release,
    WriteItem,
)
from enact_dist.terms import Access


class Cells:
    """Pages on which nobody uses anything."""

    def keep(self, session, number):
        return PLACES

    def recall(self, session, number):
        return True

    def used(self, session, number):
        return False

    def over(self, session, number):
        pass

    def drop(self, session):
        pass


def kept_grant(bench, session="ann"):
    """Lock the same slot until the grant stays; return its token."""
    bench.shard.state.tenures.kept.marks = Cells()
    bench.hello(session)
    for seq in range(1, 9):
        lock = lock_id(session, 0, seq)
        grant = bench.granted(lock, item(Access.WRITE))
        write = WriteItem(slot(), grant.states[0].datum)
        answer = bench.ask(Commit(lock, grant.token, (write,), 0, keep=True))
        if answer.kept != NOT_KEPT:
            return grant.token
    raise AssertionError("no grant was kept")


def test_commit_that_was_given_up_in_a_new_lane_never_counts():
    """A thread without a lock here so far: asked what became of its commit, the answer stands."""
    bench = ShardBench()
    token = kept_grant(bench)
    version = bench.shard.state.slots[slot()].version
    later = lock_id("ann", 1, 1)

    bench.ask(Release(later))
    assert bench.ask(Outcome(later)).kind == OUTCOME_UNSEEN
    late = bench.ask(Commit(later, token, (WriteItem(slot(), None),), 0, keep=True))

    assert isinstance(late, Fenced)
    assert bench.shard.state.slots[slot()].version == version
