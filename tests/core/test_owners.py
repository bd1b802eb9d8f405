"""A session belongs to the identity that said hello, and a shard's word to that shard."""

from __future__ import annotations

import pytest
from shard_bench import S, ShardBench, datum, item, lock_id, slot

from enact_dist.core.protocol import messages as m
from enact_dist.core.protocol.datum import Position, Token
from enact_dist.core.protocol.messages import (
    AuditEntry,
    Committed,
    EpochChanged,
    Finish,
    Finished,
    Hello,
    KeepAlive,
    LaneView,
    Refused,
    Released,
    Resolve,
    Resolved,
    Welcome,
    WriteItem,
)
from enact_dist.core.protocol.records import SessionDied, SessionRecord, SessionSeen
from enact_dist.terms import Access

ANN, EVE = "ann@h:1", "eve@h:2"
LOCK = lock_id("ann")


def hello(session="ann", epoch=0):
    return Hello(session, epoch, 2 * S, session, "h", 1, False)


@pytest.fixture
def bench():
    """A shard at which ann holds a lock, under her identity."""
    bench = ShardBench()
    assert isinstance(bench.ask_as(ANN, hello()), Welcome)
    bench.identity = ANN
    bench.token = bench.granted(LOCK, item(Access.WRITE)).token
    bench.identity = ""
    return bench


def takeovers(bench):
    """Return what would take ann's lock or session away, or use it."""
    epoch, write = bench.shard.epoch, (WriteItem(slot(), None),)
    return {
        "hello": hello(epoch=epoch),
        "release": m.Release(LOCK),
        "goodbye": m.Goodbye("ann"),
        "keep-alive": KeepAlive("ann", epoch, 9, (LaneView(0, 99),), b""),
        "acquire": bench.acquire_request(lock_id("ann", seq=2), item(Access.WRITE)),
        "view": m.TakeView(lock_id("ann", seq=2), epoch, 1, 0, (), 0),
        "commit": m.Commit(LOCK, bench.token, write, 0),
        "validate": m.Validate(LOCK, bench.token),
        "prepare": m.Prepare(LOCK, bench.token, write, 0, (), "far", Token(7, 7)),
        "fetch": m.Fetch(LOCK, epoch, slot(), 1, 0, 1),
        "register": m.Register("ann", ("mine",), ()),
        "stage": m.Stage("ann", "ann-1", 0, 1, datum("x")),
        "fork": m.Fork("ann", "what_if", "online", 0, epoch, 1),
        "drop": m.DropWorld("ann", "online", epoch, 1),
        "keep": m.KeepVersions("ann", "label", (), epoch, 1),
    }


def test_messages_of_another_in_a_session_are_refused_and_its_commit_stands(bench):
    """Whatever the stranger sends under the session's name: both are named, nothing is done."""
    for what, message in takeovers(bench).items():
        answer = bench.ask_as(EVE, message)
        assert isinstance(answer, Refused), what
        assert answer.code == "permission", what
        assert ANN in answer.text, what
        assert EVE in answer.text, what
    bench.identity = ANN

    assert isinstance(bench.commit(LOCK, bench.token, (slot(), "mine")), Committed)
    assert bench.value() == "mine"
    assert bench.counter("requests_refused") == len(takeovers(bench))


def test_restart_does_not_forget_whose_a_session_is(bench):
    """Not even before its client has greeted the new epoch."""
    assert SessionRecord("ann", 2 * S, ANN) in bench.log
    bench.restart()
    for what, message in takeovers(bench).items():
        answer = bench.ask_as(EVE, message)
        assert isinstance(answer, Refused), (what, answer)
        assert answer.code == "permission", what

    assert isinstance(bench.ask_as(ANN, hello(epoch=bench.shard.epoch)), Welcome)


def test_session_that_ended_is_not_taken_over_either(bench):
    """Its lanes, and what its last commit did, wait for its own client."""
    bench.identity = ANN
    bench.commit(LOCK, bench.token, (slot(), "mine"))
    bench.ask(m.Goodbye("ann"))

    answer = bench.ask_as(EVE, hello())

    assert isinstance(answer, Refused)
    assert isinstance(bench.ask_as(ANN, hello()), Welcome)


def test_session_kept_without_an_owner_is_nobodys_until_it_greets():
    """A folder of an older release: the first hello binds the session, on the disk as well."""
    bench = ShardBench()
    bench.hello("ann")
    bench.restart()
    gone = bench.ask_as(EVE, m.Goodbye("ann"))
    bench.ask_as(ANN, hello(epoch=bench.shard.epoch))
    late = bench.ask_as(EVE, m.Goodbye("ann"))

    assert isinstance(gone, EpochChanged)
    assert isinstance(late, Refused)
    assert bench.log[-1] == SessionRecord("ann", 2 * S, ANN)


def test_outcome_may_be_asked_by_anybody(bench):
    """The process that made a commit may be gone; which data it wrote is no secret."""
    bench.identity = ANN
    bench.commit(LOCK, bench.token, (slot(), "mine"))

    answer = bench.ask_as(EVE, m.Outcome(LOCK))

    assert isinstance(answer, m.OutcomeIs)
    assert answer.kind == m.OUTCOME_COMMITTED


def test_token_counts_for_a_session_of_its_own_identity_only(bench):
    """Neither keeps a foreign token a silent session alive, nor does its end cost waiters a place.

    A token that comes before the hello counts from then on, whoever else has declared one.
    """
    found = bench.shard.state.sessions.by_id["ann"]
    bench.event(SessionSeen("ann", True, EVE))
    foreign = found.token_present
    bench.event(SessionSeen("ann", True, ANN))
    bench.event(SessionSeen("ann", False, EVE))
    mine = found.token_present
    bench.event(SessionSeen("bob", True, EVE))
    bench.event(SessionSeen("bob", True, "bob@h:3"))
    bench.event(SessionSeen("bob", False, EVE))
    bench.ask_as("bob@h:3", hello("bob"))

    assert not foreign
    assert mine
    assert bench.shard.state.sessions.by_id["bob"].token_present


def test_decision_of_a_shard_comes_from_that_shard():
    """An actor may neither end what is prepared nor ask for it; nor may a third shard."""
    bench = ShardBench()
    bench.ask_as(ANN, hello())
    bench.identity = ANN
    grant = bench.granted(LOCK, item(Access.WRITE))
    write = (WriteItem(slot(), datum("new")),)
    bench.ask(m.Prepare(LOCK, grant.token, write, 0, (), "far", Token(7, 7)))
    finish = Finish(LOCK, Position(bench.wall_ns, "far"))
    resolve = Resolve(LOCK, Token(7, 7), "far")

    for who in (ANN, "far", "shard.third", "shard.far@h:1"):
        for message in (finish, resolve):
            answer = bench.ask_as(who, message)
            assert isinstance(answer, Refused), who
            assert answer.code == "permission", who
            assert who in answer.text
    assert bench.value() is None
    assert isinstance(bench.ask_as("shard.far", resolve), Resolved)
    assert isinstance(bench.ask_as("shard.far", finish), Finished)
    assert bench.value() == "new"


@pytest.mark.parametrize(
    "message",
    [
        m.Break(1, "why"),
        m.ForceAbort(1, "why"),
        m.Fork("nobody", "what_if", "online", 0),
        m.DropWorld("nobody", "training"),
        m.KeepVersions("nobody", "label", ()),
    ],
    ids=lambda message: type(message).__name__,
)
def test_request_over_a_network_that_names_no_epoch_is_refused(bench, message):
    """Else it would skip the question whether its session is known."""
    answer = bench.ask_as(EVE, message)

    assert isinstance(answer, Refused)
    assert (answer.code, "names no epoch" in answer.text) == ("protocol", True)
    assert "training" in bench.shard.state.catalogue.worlds


def test_audit_and_holder_name_who_broke_a_lock(bench):
    """Kept on the disk with its act, and told to the holder."""
    number = bench.shard.state.tenures.by_lock[LOCK].claim.ticket
    bench.ask_as(EVE, m.Break(number, "stuck", bench.shard.epoch))
    bench.identity = ANN
    fenced = bench.commit(LOCK, bench.token, (slot(), "mine"))
    bench.identity = ""
    bench.restart()
    (entry,) = bench.ask(m.ListAudit("")).entries

    assert "broken by eve@h:2: stuck" in fenced.cause
    assert isinstance(entry, AuditEntry)
    assert entry.identity == EVE


def test_release_of_an_unknown_session_is_answered():
    """There is nothing to take from anybody."""
    bench = ShardBench()

    assert isinstance(bench.ask_as(EVE, m.Release(lock_id("gone"))), Released)


def test_release_of_an_ended_session_is_answered_to_anybody(bench):
    """Another process may ask then what became of its commit: no copy of it comes any more."""
    refused = bench.ask_as(EVE, m.Release(LOCK))
    bench.event(SessionDied("ann"))

    assert refused.code == "permission"
    assert isinstance(bench.ask_as(EVE, m.Release(LOCK)), Released)
    assert bench.ask_as(EVE, m.Outcome(LOCK)).kind == m.OUTCOME_UNSEEN
    assert bench.ask_as(EVE, hello()).code == "permission"
