"""Requests that the wire can carry and no honest client makes: refused by name, nothing breaks."""

from __future__ import annotations

import pytest
from shard_bench import ShardBench, datum, item, lock_id, slot

from enact_dist.core.protocol.datum import Position, Token
from enact_dist.core.protocol.messages import (
    AspectEntry,
    Commit,
    Committed,
    Fenced,
    Finish,
    Finished,
    Granted,
    Item,
    ListHistory,
    Prepare,
    Prepared,
    Refused,
    Register,
    Release,
    Survey,
    TakeView,
    Validate,
    WriteItem,
)
from enact_dist.terms import Access

W = Access.WRITE
ANN = lock_id("ann")
FAR_TOKEN = Token(7, 7)
WRITES = (WriteItem(slot(), datum("new")),)
SESSIONS = "ann", "bob"


def refused(answer: object, match: str) -> None:
    """Assert that a request was refused for this reason."""
    assert isinstance(answer, Refused), answer
    assert match in answer.text


def free(bench: ShardBench) -> bool:
    """Whether the slot of all these tests can be locked by somebody else at once."""
    return isinstance(bench.acquire(lock_id("bob", 3), item(W)), Granted)


@pytest.mark.parametrize("access", [-1, 0, 7, 99])
def test_access_that_does_not_exist_is_refused(bench, access):
    """For a lock and for a view; the shard goes on."""
    wrong = Item(access, "online", "piece", "count")
    refused(bench.acquire(ANN, wrong), "access")
    refused(bench.ask(TakeView(ANN, 1, 1, 5, (wrong,), 0)), "access")

    assert free(bench)


@pytest.mark.parametrize("pattern", ["*a" * 9, "/".join(["**"] * 5), "a**b", "", "a//b", "a\0*"])
def test_pattern_that_no_client_makes_is_refused(bench, pattern):
    """Of a lock, of a view and of each listing: too many stars could stop everybody else."""
    bench.write("bob", 1, "new", to=slot("a" * 150))
    for access in (Access.READ_EACH, Access.WRITE_EACH):
        refused(bench.acquire(ANN, item(access, pattern)), "pattern")
    view = (item(Access.VIEW_EACH, pattern),)
    refused(bench.ask(TakeView(ANN, 1, 1, 5, view, 0)), "pattern")
    refused(bench.ask(Survey((), ("piece", pattern), ())), "pattern")
    refused(bench.ask(ListHistory((), (pattern,), ())), "pattern")

    assert free(bench)


def test_more_patterns_than_a_shard_matches_at_once_are_refused(bench):
    """4,096 of them in one lock, each against each slot, kept a shard for seconds."""
    patterns = [f"*{index}*a*" for index in range(4096)]
    each = tuple(item(Access.READ_EACH, pattern) for pattern in patterns)
    views = tuple(item(Access.VIEW_EACH, pattern) for pattern in patterns)

    refused(bench.acquire(ANN, *each), "at most 256")
    refused(bench.ask(TakeView(ANN, 1, 1, 5, views, 0)), "at most 256")
    refused(bench.ask(Survey((), tuple(patterns), ())), "at most 256")
    refused(bench.ask(ListHistory((), tuple(patterns), ())), "at most 256")
    assert free(bench)


@pytest.mark.parametrize("parties", [("nosuch",), ("s0",), ("far", "s0"), ("",)])
def test_commit_with_participants_that_cannot_be_told_is_refused(bench, parties):
    """An unknown shard, and this one itself; else the decision would be kept for ever."""
    grant = bench.granted(ANN, item(W))

    refused(bench.ask(Commit(ANN, grant.token, WRITES, 0, (), parties)), "far")

    assert not bench.shard.state.decisions.by_lock
    assert free(bench)


def test_participant_named_twice_counts_once(bench):
    """It is told once, and once it has finished the decision is over."""
    grant = bench.granted(ANN, item(W))
    answer = bench.ask(Commit(ANN, grant.token, WRITES, 0, (), ("far", "far")))

    assert isinstance(answer, Committed)
    assert [shard for shard, _ in bench.calls] == ["far"]


@pytest.mark.parametrize("primary", ["nosuch", "s0", ""])
def test_prepare_for_a_primary_that_cannot_be_asked_is_refused(bench, primary):
    """Nothing would ever end it."""
    grant = bench.granted(ANN, item(W))

    refused(bench.ask(Prepare(ANN, grant.token, WRITES, 0, (), primary, FAR_TOKEN)), "far")

    bench.ask(Release(ANN))
    assert free(bench)


def test_prepared_lock_does_not_commit_by_itself(bench):
    """Only its primary decides; and it stays prepared."""
    grant = bench.granted(ANN, item(W))
    assert isinstance(
        bench.ask(Prepare(ANN, grant.token, WRITES, 0, (), "far", FAR_TOKEN)), Prepared
    )

    refused(bench.ask(Commit(ANN, grant.token, WRITES, 0)), "another way")

    assert not free(bench)


def test_finish_by_another_than_the_primary_is_refused(bench):
    """A misdirected message decides nothing."""
    grant = bench.granted(ANN, item(W))
    bench.ask(Prepare(ANN, grant.token, WRITES, 0, (), "far", FAR_TOKEN))

    refused(bench.ask(Finish(ANN, Position(bench.wall_ns, "nosuch"))), "far")

    assert bench.ask(Finish(ANN, Position(bench.wall_ns, "far"))) == Finished(ANN)


@pytest.mark.parametrize(
    ("name", "durability"), [("speed", "bogus"), ("", "os"), ("a/b", "os"), ("**", "")]
)
def test_aspect_that_nobody_could_use_is_refused(bench, name, durability):
    """A durability that does not exist would only be found by the first commit."""
    before = dict(bench.shard.state.catalogue.aspects)

    answer = bench.ask(Register("ann", (), (AspectEntry(name, "int", durability),)))

    assert isinstance(answer, Refused)
    assert bench.shard.state.catalogue.aspects == before


@pytest.mark.parametrize("entity", ["", "a//b", "tray/*", "\0"])
def test_entity_that_nobody_could_read_is_not_made(bench, entity):
    """Every client whose pattern covers it would stumble over its name."""
    lock = bench.granted(ANN, item(W, entity))

    answer = bench.commit(ANN, lock.token, (slot(entity), "new"))

    assert isinstance(answer, Refused)
    assert not bench.shard.state.slots.exists(slot(entity))


def test_validations_of_unknown_lanes_leave_nothing(bench):
    """The exactly-once table has a row per lane that locked here, not per question."""
    for lane in range(1, 50):
        assert isinstance(bench.ask(Validate(lock_id("ann", lane), Token(1, 99))), Fenced)

    assert not bench.shard.state.sessions.by_id["ann"].lanes
