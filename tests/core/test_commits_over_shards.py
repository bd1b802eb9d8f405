"""The rows of the failure table about PREPARE, COMMIT at the primary, FINISH and RESOLVE."""

from __future__ import annotations

from dataclasses import replace

import pytest
from shard_bench import MS, TTL_NS, S, ShardBench, datum, item, lock_id, slot

from enact_dist.core.datum import Position, Token
from enact_dist.core.messages import (
    RESOLVED_ABORTED,
    RESOLVED_COMMITTED,
    RESOLVED_OPEN,
    Break,
    Broken,
    Changed,
    Commit,
    Committed,
    EpochChanged,
    Fenced,
    Finish,
    Finished,
    ForceAbort,
    Goodbye,
    Granted,
    KeepAlive,
    LaneView,
    Outcome,
    OutcomeIs,
    Prepare,
    Prepared,
    Release,
    Resolve,
    Resolved,
    SlotVersion,
    TakeView,
    Valid,
    Validate,
    Viewed,
    Waiting,
    WriteItem,
)
from enact_dist.core.records import (
    AuditRecord,
    Called,
    DecisionDone,
    DecisionRecord,
    PreparedEnded,
    PreparedRecord,
    SessionDied,
    Tick,
)
from enact_dist.terms import Access

R, W, V = Access.READ, Access.WRITE, Access.VIEW
ANN = lock_id("ann")
FAR_TOKEN = Token(7, 7)
STAMP_NS = 1_800_000_000 * S + 5


@pytest.fixture
def bench() -> ShardBench:
    bench = ShardBench()
    bench.hello("ann", "bob")
    return bench


def prepare_of(grant: Granted, *, aspect: str = "count", **options: object) -> Prepare:
    """Return the request to prepare one write under a grant."""
    write = WriteItem(slot(aspect=aspect), datum("new"))
    expects = options.get("expects", ())
    return Prepare(grant.lock, grant.token, (write,), 0, expects, "far", FAR_TOKEN)


def prepared(bench: ShardBench, *, aspect: str = "count") -> Granted:
    """Get a lock and prepare its write."""
    grant = bench.granted(ANN, item(W, aspect=aspect))
    assert isinstance(bench.ask(prepare_of(grant, aspect=aspect)), Prepared)
    return grant


def decided(bench: ShardBench) -> Committed:
    """Commit at this shard, as the primary, with one participant."""
    grant = bench.granted(ANN, item(W))
    write = WriteItem(slot(), datum("new"))
    answer = bench.ask(Commit(ANN, grant.token, (write,), STAMP_NS, (), ("far",)))
    assert isinstance(answer, Committed)
    return answer


def called(bench: ShardBench, kind: str) -> None:
    """Tell the participant what its primary has answered."""
    request = Resolve(ANN, FAR_TOKEN, "s0")
    bench.event(Called("far", request, Resolved(ANN, kind, Position(STAMP_NS, "far"))))


class TestPrepare:
    def test_prepare_is_answered_when_it_is_durable(self, bench):
        """A promise that a crash could break is not given."""
        grant = bench.granted(ANN, item(W))
        bench.disk_is_done = False

        assert bench.ask(prepare_of(grant)) is None
        bench.disk_is_done = True
        bench.finish_disk()

        assert any(isinstance(record, PreparedRecord) for record in bench.log)

    def test_prepared_writes_are_not_visible(self, bench):
        """Until the primary has decided, readers see what was there before."""
        prepared(bench)

        assert bench.value() is None

    @pytest.mark.parametrize("aspect", ["note", "frame"])
    def test_prepare_of_lesser_data_survives_a_kill(self, bench, aspect):
        """What is `os` or volatile is kept too: its commit may be reported after a restart."""
        prepared(bench, aspect=aspect)
        bench.restart()

        bench.ask(Finish(ANN, Position(STAMP_NS, "far")))

        assert bench.value(slot(aspect=aspect)) == "new"

    def test_repeated_prepare_is_answered_again(self, bench):
        """A lost answer is had by asking again, also after a restart."""
        grant = prepared(bench)
        first = bench.ask(prepare_of(grant))
        bench.restart()

        assert bench.ask(prepare_of(grant)) == first

    def test_prepare_under_a_lost_lock_is_fenced(self, bench):
        """Whoever lost the lock promises nothing."""
        grant = bench.granted(ANN, item(W))
        bench.ask(Release(ANN))

        assert isinstance(bench.ask(prepare_of(grant)), Fenced)

    def test_prepare_after_a_restart_is_refused(self, bench):
        """A grant of an earlier epoch that was not prepared is gone."""
        grant = bench.granted(ANN, item(W))
        bench.restart()

        assert isinstance(bench.ask(prepare_of(grant)), EpochChanged)

    def test_prepare_after_the_end_is_fenced(self, bench):
        """A late copy of a request prepares nothing anew."""
        grant = prepared(bench)
        bench.ask(Finish(ANN, Position(STAMP_NS, "far")))

        assert isinstance(bench.ask(prepare_of(grant)), Fenced)
        assert not bench.shard.state.tenures.by_lock

    def test_prepare_with_a_view_that_moved_on_gives_the_lock_back(self, bench):
        """An expected view counts at prepare as it does at commit."""
        bench.write("bob", 1, "1", to=slot("other"))
        grant = bench.granted(ANN, item(W))
        expects = (SlotVersion(slot("other"), 0),)

        answer = bench.ask(prepare_of(grant, expects=expects))

        assert answer == Changed(ANN, slot("other"), 1)
        assert not bench.shard.state.tenures.by_lock


class TestPreparedIgnores:
    @pytest.mark.parametrize(
        "event",
        [
            Release(ANN),
            Goodbye("ann"),
            KeepAlive("ann", 1, 99, (LaneView(0, 50),), b""),
            Break(1, "by hand"),
        ],
        ids=lambda event: type(event).__name__,
    )
    def test_prepared_lock_stays_when_its_client_or_an_operator_ends_it(self, bench, event):
        """Only the primary's word frees it."""
        prepared(bench)
        bench.ask(event)

        assert ANN in bench.shard.state.tenures.by_lock
        assert bench.shard.state.tenures.by_lock[ANN].prepared is not None

    def test_prepared_lock_stays_when_its_process_dies(self, bench):
        """A proven death says nothing about what the primary decided."""
        prepared(bench)
        bench.event(SessionDied("ann"))

        assert bench.shard.state.tenures.by_lock[ANN].prepared is not None

    def test_prepared_lock_outlives_its_lease_and_hold_limit(self, bench):
        """Time does not free it."""
        grant = bench.granted(ANN, item(W), hold_ns=S)
        bench.ask(prepare_of(grant))
        bench.wait(20 * TTL_NS, keep=("bob",))

        assert ANN in bench.shard.state.tenures.by_lock

    def test_prepared_lock_is_held_again_before_anything_is_granted(self, bench):
        """After a restart nobody gets what is in doubt."""
        prepared(bench)
        bench.restart()
        bench.hello("ann", "bob", known_epoch=bench.shard.epoch)
        bench.wait(3 * TTL_NS, keep=("bob",))

        answer = bench.acquire(lock_id("bob"), item(R), wait_ns=0)

        assert isinstance(answer, Waiting)
        assert [holder.lock for holder in answer.blockers] == [ANN]


class TestParticipant:
    def test_finish_applies_frees_and_is_answered_when_durable(self, bench):
        """Finished is said only when a restart would not ask the primary any more."""
        prepared(bench)
        bench.disk_is_done = False

        assert bench.ask(Finish(ANN, Position(STAMP_NS, "far"))) is None
        assert bench.value() is None
        handle = bench.send(Finish(ANN, Position(STAMP_NS, "far")))
        bench.finish_disk()

        assert bench.answers[handle] == Finished(ANN)
        assert bench.value() == "new"
        assert not bench.shard.state.tenures.by_lock

    def test_repeated_finish_is_finished_again(self, bench):
        """The primary asks until it hears an answer."""
        prepared(bench)
        for _ in range(3):
            assert bench.ask(Finish(ANN, Position(STAMP_NS, "far"))) == Finished(ANN)
        assert len(bench.notices) == 1

    def test_finish_that_a_crash_cut_off_is_done_after_it(self, bench):
        """A crash before the end is durable leaves it prepared."""
        prepared(bench)
        bench.disk_is_done = False
        bench.ask(Finish(ANN, Position(STAMP_NS, "far")))
        bench.restart()
        bench.disk_is_done = True

        assert bench.shard.state.tenures.by_lock[ANN].prepared is not None
        bench.ask(Finish(ANN, Position(STAMP_NS, "far")))
        assert bench.value() == "new"

    def test_participant_asks_its_primary_until_it_knows(self, bench):
        """Without news the primary is asked again every TTL / 2, for ever."""
        prepared(bench)
        bench.wait(10 * TTL_NS)

        asked = [request for shard, request in bench.calls if shard == "far"]
        assert 15 <= len(asked) <= 25
        assert set(asked) == {Resolve(ANN, FAR_TOKEN, "s0")}

    def test_restarted_participant_asks_at_once(self, bench):
        """It does not wait for a message that may have come while it was away."""
        prepared(bench)
        bench.restart()
        bench.calls.clear()
        bench.event(Tick())

        assert bench.calls == [("far", Resolve(ANN, FAR_TOKEN, "s0"))]

    def test_release_of_a_prepared_lock_makes_it_ask_soon(self, bench):
        """A client that gives up has told the primary too, so the answer is there."""
        prepared(bench)
        bench.ask(Release(ANN))
        bench.wait(100 * MS)

        assert len(bench.calls) == 1

    def test_answer_committed_applies(self, bench):
        """The participant needs no message from the primary if it hears it by asking."""
        prepared(bench)
        called(bench, RESOLVED_COMMITTED)

        assert bench.value() == "new"
        assert any(isinstance(record, PreparedEnded) for record in bench.log)

    def test_answer_aborted_frees_and_writes_nothing(self, bench):
        """Presumed abort: the next one gets the lock, the value stands."""
        prepared(bench)
        called(bench, RESOLVED_ABORTED)

        assert bench.value() is None
        assert isinstance(bench.acquire(lock_id("bob"), item(W)), Granted)

    def test_answer_open_changes_nothing(self, bench):
        """The primary's own lease will end the doubt."""
        prepared(bench)
        called(bench, RESOLVED_OPEN)

        assert bench.shard.state.tenures.by_lock[ANN].prepared is not None

    def test_late_answers_change_nothing(self, bench):
        """What was decided stays, whatever copies arrive later."""
        prepared(bench)
        called(bench, RESOLVED_COMMITTED)
        called(bench, RESOLVED_ABORTED)
        called(bench, RESOLVED_COMMITTED)

        assert bench.value() == "new"
        assert bench.shard.state.slots[slot()].version == 1

    def test_force_abort_is_audited_and_frees(self, bench):
        """An operator may give up what waits for a shard that never comes back."""
        prepared(bench)
        number = bench.shard.state.tenures.by_lock[ANN].claim.ticket
        answer = bench.ask(ForceAbort(number, "disk gone"))

        assert isinstance(answer, Broken)
        assert answer.found
        assert [r for r in bench.log if isinstance(r, AuditRecord) and "disk gone" in r.text]
        bench.restart()
        assert not bench.shard.state.tenures.by_lock

    def test_force_abort_refuses_what_is_not_in_doubt(self, bench):
        """A held lock is broken, not resolved."""
        bench.granted(ANN, item(W))
        number = bench.shard.state.tenures.by_lock[ANN].claim.ticket

        assert bench.ask(ForceAbort(number, "x")) == Broken(False, None)


class TestPrimary:
    def test_decision_is_one_record_with_the_writes(self, bench):
        """The commit and whom to tell are durable together, before the client hears of it."""
        answer = decided(bench)

        (record,) = [r for r in bench.log if isinstance(r, DecisionRecord)]
        assert record == DecisionRecord(ANN, answer.position, ("far",))
        assert answer.position.stamp_ns > STAMP_NS

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
