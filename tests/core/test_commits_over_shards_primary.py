"""The rows of the failure table about COMMIT at the primary, and what others see meanwhile."""

from __future__ import annotations

from dataclasses import replace

import pytest
from prepare_parts import ANN, FAR_TOKEN, STAMP_NS, V, W, decided, prepared
from shard_bench import MS, TTL_NS, S, ShardBench, datum, item, lock_id, slot

from enact_dist.core.protocol.datum import Position, Token
from enact_dist.core.protocol.messages import (
    RESOLVED_ABORTED,
    RESOLVED_COMMITTED,
    RESOLVED_OPEN,
    Changed,
    Commit,
    Committed,
    EpochChanged,
    Fenced,
    Finish,
    Finished,
    Outcome,
    OutcomeIs,
    Release,
    Resolve,
    Resolved,
    SlotVersion,
    TakeView,
    Valid,
    Validate,
    Viewed,
    WriteItem,
)
from enact_dist.core.protocol.records import (
    Called,
    DecisionDone,
    DecisionRecord,
    SessionDied,
    ShardReturned,
    Tick,
)
from enact_dist.core.state.decisions import AGAIN_NS_MIN

SESSIONS = "ann", "bob"


class TestPrimary:
    def test_decision_is_one_record_with_the_writes(self, bench):
        """The commit and whom to tell are durable together, before the client hears of it."""
        answer = decided(bench)

        (record,) = [r for r in bench.log if isinstance(r, DecisionRecord)]
        assert record == DecisionRecord(ANN, answer.position, ("far",))
        assert answer.position.stamp_ns > STAMP_NS

    def test_participant_that_comes_back_is_told_at_once(self, bench):
        """The pauses have grown while it was away, and are short again after that."""
        finish = ("far", Finish(ANN, decided(bench).position))
        bench.wait(5 * S, keep=("ann",))
        bench.calls.clear()

        bench.event(ShardReturned("elsewhere"))
        assert bench.calls == []
        bench.event(ShardReturned("far"))
        assert bench.calls == [finish]
        bench.wait(AGAIN_NS_MIN, keep=("ann",))
        assert bench.calls == [finish, finish]

    def test_participants_are_told_until_they_have_finished(self, bench):
        """Lost messages are made up for; then the decision is forgotten."""
        answer = decided(bench)
        bench.wait(3 * S, keep=("ann",))
        assert len(bench.calls) >= 4
        finish = Finish(ANN, answer.position)
        assert {request for _, request in bench.calls} == {finish}

        bench.event(Called("far", finish, Finished(ANN)))
        bench.calls.clear()
        bench.wait(5 * S, keep=("ann",))

        assert not bench.calls
        assert any(isinstance(record, DecisionDone) for record in bench.log)

    def test_restarted_primary_tells_again(self, bench):
        """A decision survives, and so does the duty to tell it."""
        answer = decided(bench)
        bench.restart()
        bench.calls.clear()
        bench.event(Tick())

        assert bench.calls == [("far", Finish(ANN, answer.position))]
        assert bench.value() == "new"

    def test_resolve_after_the_decision_is_committed(self, bench):
        """Also when the lane has long gone on, and after a restart."""
        answer = decided(bench)
        bench.write("ann", 2, "later")
        question = Resolve(ANN, FAR_TOKEN, "far")
        committed = Resolved(ANN, RESOLVED_COMMITTED, answer.position)

        assert bench.ask(question) == committed
        bench.restart()
        assert bench.ask(question) == committed

    def test_resolve_is_open_while_the_grant_lives(self, bench):
        """The client may still commit."""
        grant = bench.granted(ANN, item(W))
        answer = bench.ask(Resolve(ANN, grant.token, "far"))

        assert isinstance(answer, Resolved)
        assert answer.kind == RESOLVED_OPEN

    def test_resolve_is_open_while_the_disk_works_on_the_decision(self, bench):
        """Neither yes nor no before the record is there."""
        grant = bench.granted(ANN, item(W))
        bench.disk_is_done = False
        write = WriteItem(slot(), datum("new"))
        bench.send(Commit(ANN, grant.token, (write,), 0, (), ("far",)))
        answer = bench.ask(Resolve(ANN, grant.token, "far"))

        assert isinstance(answer, Resolved)
        assert answer.kind == RESOLVED_OPEN

    @pytest.mark.parametrize("end", ["lease", "release", "restart"])
    def test_resolve_is_aborted_when_the_grant_is_dead(self, bench, end):
        """A dead token never lives again, so no record of an abort is needed."""
        grant = bench.granted(ANN, item(W))
        if end == "lease":
            bench.wait(2 * TTL_NS, keep=("bob",))
        elif end == "release":
            bench.ask(Release(ANN))
        else:
            bench.restart()

        answer = bench.ask(Resolve(ANN, grant.token, "far"))
        late = bench.ask(
            Commit(ANN, grant.token, (WriteItem(slot(), datum("x")),), 0, (), ("far",))
        )

        assert isinstance(answer, Resolved)
        assert answer.kind == RESOLVED_ABORTED
        assert isinstance(late, Fenced | EpochChanged)

    def test_lost_answer_of_a_decision_is_had_by_asking(self, bench):
        """Outcome tells it, after a restart too."""
        answer = decided(bench)
        bench.restart()
        outcome = bench.ask(Outcome(ANN))

        assert isinstance(outcome, OutcomeIs)
        assert (outcome.kind, outcome.position) == ("committed", answer.position)

    def test_decision_over_volatile_data_alone_is_recorded(self, bench):
        """A participant must be able to learn it whatever the primary's own data are."""
        grant = bench.granted(ANN, item(W, aspect="frame"))
        write = WriteItem(slot(aspect="frame"), datum("new"))
        bench.ask(Commit(ANN, grant.token, (write,), 0, (), ("far",)))

        assert any(isinstance(record, DecisionRecord) for record in bench.log)


class TestExpectations:
    def test_validation_compares_what_it_expects(self, bench):
        """Write skew over shards: what a reader expects is checked where it lies."""
        bench.write("bob", 1, "1")
        nothing_held = Token(bench.shard.epoch, 0)
        stands = bench.ask(Validate(ANN, nothing_held, (SlotVersion(slot(), 1),)))
        moved = bench.ask(Validate(ANN, nothing_held, (SlotVersion(slot(), 0),)))

        assert (stands, moved) == (Valid(ANN), Changed(ANN, slot(), 1))

    def test_expectation_fails_while_a_lock_over_shards_may_write_it(self, bench):
        """The other lock may have been checked already where this one writes."""
        request = bench.acquire_request(lock_id("bob"), item(W))
        bench.ask(replace(request, alone=False))
        answer = bench.ask(Validate(ANN, Token(bench.shard.epoch, 0), (SlotVersion(slot(), 0),)))

        assert answer == Changed(ANN, slot(), 0)

    def test_expectation_of_an_earlier_epoch_fails(self, bench):
        """Versions of volatile slots start again, so an epoch belongs to them."""
        asked = Validate(ANN, Token(bench.shard.epoch, 0), (SlotVersion(slot(), 0),))
        bench.restart()

        assert isinstance(bench.ask(asked), EpochChanged)


class TestViews:
    def view(self, bench: ShardBench, *, at_ns: int = 0) -> TakeView:
        counter = bench.next_count("bob")
        epoch = bench.shard.epoch
        return TakeView(lock_id("bob", 5, 1), epoch, 1, counter, (item(V),), 0, at_ns)

    def test_view_promises_nothing_beyond_a_prepared_commit(self, bench):
        """Its data are current up to the stamp that the prepared commit may get."""
        grant = prepared(bench)
        stamp_ns = bench.shard.state.tenures.by_lock[grant.lock].prepared.stamp_ns
        viewed = bench.ask(self.view(bench))

        assert isinstance(viewed, Viewed)
        assert viewed.until_ns == stamp_ns - 1

    def test_view_as_of_a_stamp_waits_for_what_is_undecided(self, bench):
        """The answer shows the commit whole, once it is decided."""
        prepared(bench)
        at_ns = bench.wall_ns + 50 * MS
        handle = bench.send(self.view(bench, at_ns=at_ns))
        assert handle not in bench.answers

        bench.ask(Finish(ANN, Position(bench.wall_ns + 10 * MS, "far")))

        viewed = bench.answers[handle]
        assert isinstance(viewed, Viewed)
        assert [state.version for state in viewed.states] == [1]
        assert viewed.from_ns <= at_ns <= viewed.until_ns

    def test_view_as_of_a_stamp_moves_the_clock_past_it(self, bench):
        """Whatever commits later gets a larger stamp and stays outside."""
        at_ns = bench.wall_ns + 300 * MS
        bench.ask(self.view(bench, at_ns=at_ns))
        answer = bench.write("bob", 1, "later")

        assert isinstance(answer, Committed)
        assert answer.position.stamp_ns > at_ns

    def test_view_as_of_the_past_shows_the_past(self, bench):
        """A replaced state is remembered for a moment."""
        first = bench.write("bob", 1, "1")
        bench.write("bob", 2, "2")
        assert isinstance(first, Committed)
        viewed = bench.ask(self.view(bench, at_ns=first.position.stamp_ns))

        assert isinstance(viewed, Viewed)
        assert [state.version for state in viewed.states] == [1]

    def test_view_is_answered_when_it_has_waited_enough(self, bench):
        """A primary that stays away stops no view."""
        prepared(bench)
        handle = bench.send(self.view(bench, at_ns=bench.wall_ns + 50 * MS))
        bench.wait(S, keep=("bob",))

        viewed = bench.answers[handle]
        assert isinstance(viewed, Viewed)
        assert viewed.until_ns < bench.wall_ns

    def test_view_whose_session_ended_while_it_waited_pins_nothing(self, bench):
        """Nobody fetches what it would show, and nobody would let go of that."""
        bench.write("bob", 1, "x" * 100_000)
        prepared(bench)
        handle = bench.send(self.view(bench, at_ns=bench.wall_ns + 50 * MS))
        bench.event(SessionDied("bob"))
        assert handle not in bench.answers

        bench.ask(Finish(ANN, Position(bench.wall_ns + 90 * MS, "far")))

        assert bench.answers[handle] == EpochChanged(bench.shard.epoch)
        assert not bench.shard.state.pins
