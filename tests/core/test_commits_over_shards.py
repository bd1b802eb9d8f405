"""The rows of the failure table about PREPARE, FINISH and RESOLVE at a participant."""

from __future__ import annotations

import pytest
from prepare_parts import ANN, FAR_TOKEN, STAMP_NS, R, W, called, prepare_of, prepared
from shard_bench import MS, TTL_NS, S, item, lock_id, slot

from enact_dist.core.protocol.datum import Position
from enact_dist.core.protocol.messages import (
    RESOLVED_ABORTED,
    RESOLVED_COMMITTED,
    RESOLVED_OPEN,
    Break,
    Broken,
    Changed,
    EpochChanged,
    Fenced,
    Finish,
    Finished,
    ForceAbort,
    Goodbye,
    Granted,
    KeepAlive,
    LaneView,
    Release,
    Resolve,
    SlotVersion,
    Waiting,
)
from enact_dist.core.protocol.records import (
    AuditRecord,
    PreparedEnded,
    PreparedRecord,
    SessionDied,
    ShardReturned,
    Tick,
)

SESSIONS = "ann", "bob"


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

    @pytest.mark.parametrize(("shard", "asked"), [("far", 1), ("elsewhere", 0)])
    def test_primary_that_comes_back_is_asked_at_once(self, bench, shard, asked):
        """It was asked while it was away; any other shard says nothing of this lock."""
        prepared(bench)
        bench.wait(TTL_NS)
        before = len(bench.calls)
        bench.event(ShardReturned(shard))

        assert bench.calls[before:] == asked * [("far", Resolve(ANN, FAR_TOKEN, "s0"))]

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
