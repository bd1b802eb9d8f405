"""Stamps from elsewhere never become the time of a shard where no right clock gives them."""

from __future__ import annotations

import pytest
from prepare_parts import ANN, FAR_TOKEN, W, prepare_of, prepared
from shard_bench import TTL_NS, S, ShardBench, item, lock_id, slot

from enact_dist.core.client.client import Client
from enact_dist.core.protocol.datum import Position
from enact_dist.core.protocol.messages import (
    RESOLVED_COMMITTED,
    Commit,
    Committed,
    Finish,
    Finished,
    ForceAbort,
    ListAudit,
    Refused,
    Resolve,
    Resolved,
    TakeView,
)
from enact_dist.core.protocol.records import Called
from enact_dist.core.state.clock import STAMP_NS_MAX
from enact_dist.terms import Access

BIG = (1 << 63) - 1
FAR_AHEAD = [2 * S, 3600 * S, BIG]
SESSIONS = "ann", "bob"


def far(bench: ShardBench, ahead_ns: int) -> Position:
    """Return a decision of the primary, stamped this far ahead of the participant's clock."""
    return Position(min(BIG, bench.wall_ns + ahead_ns), "far")


@pytest.mark.parametrize("ahead_ns", FAR_AHEAD)
def test_decision_from_far_ahead_is_refused_until_its_time_has_come(bench, ahead_ns):
    """The lock stays in doubt, the clock stays, and people are told once; then it is finished."""
    prepared(bench)
    before_ns = bench.shard.state.stamps.last_ns
    position = far(bench, ahead_ns)

    answers = [bench.ask(Finish(ANN, position)) for _ in range(3)]

    assert [answer.code for answer in answers] == ["clock_skew"] * 3
    assert "set the clocks" in answers[0].text
    assert bench.shard.state.stamps.last_ns == before_ns
    assert [story.event for story in bench.stories].count("lock.in_doubt") == 1
    assert bench.counter("decisions_refused") == 3
    assert bench.value() is None
    bench.wall_ns = position.stamp_ns - S
    assert bench.ask(Finish(ANN, position)) == Finished(ANN)
    assert bench.value() == "new"


@pytest.mark.parametrize("ahead_ns", FAR_AHEAD)
def test_answer_from_far_ahead_is_not_taken(bench, ahead_ns):
    """What the primary answers when it is asked counts no more than what it says by itself."""
    prepared(bench)
    answer = Resolved(ANN, RESOLVED_COMMITTED, far(bench, ahead_ns))

    bench.event(Called("far", Resolve(ANN, FAR_TOKEN, "s0"), answer))

    assert bench.value() is None
    assert bench.shard.state.stamps.last_ns <= bench.wall_ns + S
    bench.restart()
    assert bench.shard.state.stamps.last_ns <= bench.wall_ns + S


@pytest.mark.parametrize("stamp_ns", [0, -1, -BIG])
def test_decision_without_a_stamp_is_refused(bench, stamp_ns):
    """No shard gives these."""
    prepared(bench)

    answer = bench.ask(Finish(ANN, Position(stamp_ns, "far")))

    assert isinstance(answer, Refused)
    assert answer.code == "protocol"
    assert bench.value() is None


def test_decision_below_the_prepared_stamp_counts_as_the_prepared_one(bench):
    """Its client may have told the primary too little; refused, it would be in doubt for ever."""
    promised_ns = bench.ask(prepare_of(prepared(bench))).stamp_ns

    assert bench.ask(Finish(ANN, Position(1, "far"))) == Finished(ANN)

    assert bench.shard.state.slots[slot()].stamp_ns == promised_ns >= bench.wall_ns


def test_forced_abort_takes_no_decision_from_far_ahead(bench):
    """Nor one of another shard than the lost one: its alarm would be false."""
    prepared(bench)
    number = bench.shard.state.tenures.by_lock[ANN].claim.ticket
    bench.ask(ForceAbort(number, "lost"))

    assert bench.ask(Finish(ANN, far(bench, BIG))).code == "clock_skew"
    assert bench.ask(Finish(ANN, Position(bench.wall_ns, "s9"))).code == "protocol"
    assert bench.ask(ListAudit("")).alarms == 0
    assert bench.ask(Finish(ANN, Position(bench.wall_ns, "far"))) == Finished(ANN)
    assert bench.ask(ListAudit("")).alarms == 1


def test_seen_stamps_cannot_pull_the_clock_ahead_step_by_step(bench):
    """A second was taken with each request, each on top of the last: an hour in an hour's calls."""
    for seq in range(1, 20):
        seen_ns = bench.shard.state.stamps.last_ns + S - 1
        bench.ask(TakeView(lock_id("bob", 1, seq), 1, 1, seq, (), seen_ns))

    assert bench.shard.state.stamps.last_ns <= bench.wall_ns + S
    grant = bench.granted(ANN, item(W))
    late = bench.ask(prepare_of(grant))
    assert late.stamp_ns <= bench.wall_ns + 2 * S


@pytest.mark.parametrize("seen_ns", [BIG, -BIG, -1])
def test_seen_stamp_that_no_clock_gives_leaves_the_clock(bench, seen_ns):
    """In a view, in a grant, in a commit: refused, or passed over."""
    last_ns = bench.shard.state.stamps.last_ns
    bench.ask(TakeView(lock_id("bob"), 1, 1, 1, (item(Access.VIEW),), seen_ns))
    grant = bench.granted(ANN, item(W))
    answer = bench.ask(Commit(ANN, grant.token, (), seen_ns))

    assert isinstance(answer, Refused if seen_ns > 0 else Committed)
    assert last_ns <= bench.shard.state.stamps.last_ns <= bench.wall_ns + S


def test_view_as_of_a_negative_stamp_is_refused(bench):
    """There was nothing before the year 1970, not even null."""
    view = TakeView(lock_id("bob"), 1, 1, 1, (item(Access.VIEW),), 0, -1)

    assert bench.ask(view).code == "protocol"


def test_own_clock_may_be_ahead_of_the_wall(bench):
    """The wall clock was set back by an hour: what this shard has stamped itself stays good."""
    bench.write("bob", 1, "1")
    seen_ns = bench.shard.state.stamps.last_ns
    bench.wall_ns -= 3600 * S
    grant = bench.granted(ANN, item(W))

    answer = bench.ask(Commit(ANN, grant.token, (), seen_ns))

    assert isinstance(answer, Committed)
    assert answer.position.stamp_ns > seen_ns


def test_stamps_of_others_from_before_the_wall_clock_was_set_back_are_taken(bench):
    """The clock of the host went back an hour: its other shards have stamped by it as it was."""
    bench.write("bob", 1, "1")
    elsewhere_ns = bench.shard.state.stamps.last_ns + S // 2
    bench.wall_ns -= 3600 * S
    grant = bench.granted(ANN, item(W))

    committed = bench.ask(Commit(ANN, grant.token, (), elsewhere_ns))
    refused = bench.ask(TakeView(lock_id("bob", 2), 1, 1, 9, (item(Access.VIEW),), 0, BIG, True))

    assert isinstance(committed, Committed)
    assert committed.position.stamp_ns > elsewhere_ns
    assert isinstance(refused, Refused)


def test_decision_is_taken_though_the_wall_clock_was_set_back(bench):
    """What was promised lies an hour ahead of it now; refused, the lock would be in doubt for it."""
    promised_ns = bench.ask(prepare_of(prepared(bench))).stamp_ns
    bench.wall_ns -= 3600 * S

    assert bench.ask(Finish(ANN, Position(promised_ns + 5, "far"))) == Finished(ANN)


def test_client_passes_over_a_stamp_that_no_clock_gives():
    """All its later commits would be refused, by every shard."""
    client = Client("ann", ttl_ns=TTL_NS)
    client.saw_stamp(5)
    client.saw_stamp(STAMP_NS_MAX + 1)

    assert client.seen_stamp_ns == 5
