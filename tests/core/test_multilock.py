"""The client half of a lock: its calls in order, over one shard and over two."""

from __future__ import annotations

import pytest
from client_bench import CellBench
from shard_bench import MS, TTL_NS, item, slot

from enact_dist.core.client.plan import Phase
from enact_dist.core.protocol.datum import Slot
from enact_dist.core.protocol.messages import (
    Outcome,
    OutcomeIs,
    Release,
    Validate,
    Waiting,
)
from enact_dist.terms import Access

R, W, V, WE = Access.READ, Access.WRITE, Access.VIEW, Access.WRITE_EACH


@pytest.fixture
def cell() -> CellBench:
    return CellBench("s0")


@pytest.fixture
def two() -> CellBench:
    return CellBench("s0", "s1")


class TestOneShard:
    def test_update_takes_two_round_trips(self, cell):
        """Acquire brings the data, commit releases: nothing else is sent."""
        ann = cell.client("ann")
        since = len(ann.sent)
        lock = ann.locked(item(W))
        ann.finish(lock, (slot(), "1"))

        assert ann.kinds_sent(since=since) == ["Acquire", "Commit"]
        assert lock.phase is Phase.COMMITTED
        assert [tuple(version) for version in lock.versions] == [(slot(), 1)]

    def test_reading_is_confirmed_at_its_end(self, cell):
        """A lock that only reads asks once whether it was protected until the end."""
        ann = cell.client("ann")
        lock = ann.locked(item(R))
        since = len(ann.sent)
        ann.finish(lock)

        assert ann.kinds_sent(since=since) == ["Validate"]
        assert lock.phase is Phase.COMMITTED

    def test_view_alone_needs_no_lock(self, cell):
        """Views are taken in one round trip and leave nothing behind."""
        ann = cell.client("ann")
        since = len(ann.sent)
        lock = ann.locked(item(V))
        ann.finish(lock)

        assert ann.kinds_sent(since=since) == ["TakeView"]
        assert not cell.shards["s0"].shard.state.tenures.by_lock

    def test_release_writes_nothing(self, cell):
        """A block that raised publishes nothing and frees its lock."""
        ann = cell.client("ann")
        lock = ann.locked(item(W))
        lock.release()
        ann.drive(lock)

        assert (lock.phase, ann.kinds_sent()[-1]) == (Phase.RELEASED, "Release")
        assert not cell.shards["s0"].shard.state.tenures.by_lock

    def test_lock_times_out_and_tells_who_holds(self, cell):
        """When time is over the lock leaves the queue and knows who was in the way."""
        ann, bob = cell.client("ann"), cell.client("bob")
        held = ann.locked(item(W))
        lock = bob.begin(item(W), wait_s=0.0)
        bob.step(lock)
        answer = cell.shards["s0"].ask(bob.sent[-1][1])
        if isinstance(answer, Waiting):
            lock.answered("s0", bob.sent[-1][1], answer, cell.now_ns)
        cell.now_ns += MS
        bob.drive(lock)

        assert lock.phase is Phase.TIMED_OUT
        assert [holder.lock for holder in lock.blockers] == [held.lock]
        assert list(cell.shards["s0"].shard.state.tenures.by_lock) == [held.lock]

    def test_empty_lock_is_held_at_once(self, cell):
        """A lock of nothing needs nobody."""
        lock = cell.client("ann").begin()

        assert lock.phase is Phase.HELD


class TestTwoShards:
    def test_shards_are_asked_in_the_order_of_their_names(self, two):
        """One global order, whatever order the requests are written in: no deadlock."""
        ann = two.client("ann")
        since = len(ann.sent)
        first, second = two.entity_on("s0"), two.entity_on("s1")
        ann.locked(item(R, second), item(W, first))

        assert [shard for shard, _ in ann.sent[since:]] == ["s0", "s1"]

    def test_opposite_orders_do_not_deadlock(self, two):
        """Two locks over the same shards wait one behind the other."""
        ann, bob = two.client("ann"), two.client("bob")
        first, second = two.entity_on("s0"), two.entity_on("s1")
        held = ann.locked(item(W, first), item(R, second))
        lock = bob.begin(item(R, first), item(W, second))
        bob.step(lock)
        assert [part.token for part in lock.parts] == [None, None]
        held.release()
        ann.drive(held)

        assert bob.drive(lock).phase is Phase.HELD

    def test_reads_elsewhere_are_validated_before_the_commit(self, two):
        """Every lock was held at the last grant: strict two-phase locking."""
        ann = two.client("ann")
        first, second = two.entity_on("s0"), two.entity_on("s1")
        lock = ann.locked(item(R, first), item(W, second))
        since = len(ann.sent)
        ann.finish(lock, (slot(second), "1"))

        assert ann.kinds_sent(since=since) == ["Validate", "Commit"]
        assert lock.phase is Phase.COMMITTED

    def test_read_lost_elsewhere_lets_nothing_be_written(self, two):
        """A read that was not protected until the end takes the write with it (write skew)."""
        ann, bob = two.client("ann"), two.client("bob")
        first, second = two.entity_on("s0"), two.entity_on("s1")
        lock = ann.locked(item(R, first), item(W, second))
        two.shards["s0"].wait(TTL_NS + 100 * MS)
        assert bob.call("s0", bob.core.keep_alive("s0", two.now_ns)) is not None
        bob.finish(bob.locked(item(W, first)), (slot(first), "2"))

        ann.finish(lock, (slot(second), "1"))

        assert lock.phase is Phase.LOST
        assert two.shards["s1"].value(slot(second)) is None
        assert not two.shards["s1"].shard.state.tenures.by_lock

    def test_lock_lost_on_one_shard_is_given_back_on_the_other(self, two):
        """Nothing is kept half."""
        ann = two.client("ann")
        first, second = two.entity_on("s0"), two.entity_on("s1")
        lock = ann.locked(item(R, first), item(W, second))
        two.shards["s0"].restart()
        ann.keep_alive()
        since = len(ann.sent)
        ann.drive(lock)

        assert lock.phase is Phase.LOST
        assert ("s1", Release(lock.lock)) in ann.sent[since:]

    def test_pattern_goes_to_every_shard(self, two):
        """Any shard may hold an entity that matches."""
        ann = two.client("ann")
        lock = ann.locked(item(WE, "tray/*"))

        assert [part.shard for part in lock.parts] == ["s0", "s1"]
        assert all(len(bench.shard.state.tenures.by_lock) == 1 for bench in two.shards.values())

    def test_creation_writes_one_shard_and_confirms_the_other(self, two):
        """Look, then create: the other shard is asked whether nobody came in."""
        ann = two.client("ann")
        lock = ann.locked(item(WE, "tray/*"))
        since = len(ann.sent)
        ann.finish(lock, (slot("tray/1"), "1"))

        assert sorted(ann.kinds_sent(since=since)) == ["Commit", "Validate"]
        assert all(not bench.shard.state.tenures.by_lock for bench in two.shards.values())

    def test_views_are_taken_after_the_last_grant(self, two):
        """Over several shards the views come last, so that they are not older than the locks."""
        ann = two.client("ann")
        first, second = two.entity_on("s0"), two.entity_on("s1")
        since = len(ann.sent)
        ann.locked(item(W, first), item(R, second), item(V, two.entity_on("s0", "v")))

        assert ann.kinds_sent(since=since) == ["Acquire", "Acquire", "TakeView"]


def test_late_fenced_of_an_older_lock_is_not_taken(cell):
    """An answer names its lock; another lock's bad news is nobody's."""
    ann = cell.client("ann")
    old = ann.locked(item(W))
    old.release()
    ann.drive(old)
    lock = ann.locked(item(W))
    request = Validate(old.lock, lock.parts[0].token)
    answer = cell.shards["s0"].ask(request)

    lock.answered("s0", request, answer, cell.now_ns)

    assert lock.phase is Phase.HELD


def test_committed_position_is_seen_by_later_commits(cell):
    """A client's next commit comes after everything it has seen."""
    ann = cell.client("ann")
    positions = []
    for value in ("1", "2"):
        lock = ann.locked(item(W))
        ann.finish(lock, (slot(), value))
        positions.append(lock.position)

    assert positions[0] < positions[1]
    assert ann.core.seen_stamp_ns >= positions[1].stamp_ns


def test_unknown_kind_of_slot_is_no_part_of_a_plan(cell):
    """A plan names each shard once, locks and views together where one shard has them all."""
    ann = cell.client("ann")
    plan = ann.core.plan([item(W, "a"), item(V, "b"), item(R, "c")])

    assert [(shard, len(items)) for shard, items in plan.locks] == [("s0", 3)]
    assert plan.views == ()


def test_slot_prints_as_people_write_it():
    """Messages name a slot as world, entity and aspect."""
    assert str(Slot("online", "tray/1", "count")) == "online:tray/1/count"


def test_outcome_answer_names_its_lock(cell):
    """An outcome is about one lock."""
    ann = cell.client("ann")
    lock = ann.locked(item(W))

    answer = cell.shards["s0"].ask(Outcome(lock.lock))

    assert isinstance(answer, OutcomeIs)
    assert answer.lock == lock.lock
