"""The failure table of one writing shard, continued: how locks end, by commit or without."""

from __future__ import annotations

from failure_parts import ANN, BOB, READ, WRITE, seeded
from shard_bench import MS, TTL_NS, S, lock_id, slot

from enact_dist.core.protocol.messages import (
    OUTCOME_COMMITTED,
    OUTCOME_PENDING,
    OUTCOME_UNSEEN,
    Committed,
    EpochChanged,
    Fenced,
    Granted,
    Outcome,
    OutcomeIs,
    Release,
    Released,
    Stale,
    Valid,
    Validate,
)


class TestCommit:
    def test_dead_client_has_committed_or_not_by_the_record(self, bench):
        """Client dies: its commit stands once it is recorded, and its lock is free."""
        seeded(bench)
        grant = bench.granted(ANN, WRITE)
        bench.commit(ANN, grant.token, (slot(), "2"))

        assert bench.value() == "2"
        assert isinstance(bench.acquire(BOB, WRITE), Granted)

    def test_restart_before_the_disk_is_done_leaves_nothing(self, bench):
        """Shard restarts before the record is kept: as if it was never sent."""
        seeded(bench)
        grant = bench.granted(ANN, WRITE)
        bench.disk_is_done = False
        assert bench.commit(ANN, grant.token, (slot(), "2")) is None
        assert bench.value() == "1"

        bench.restart()

        answer = bench.ask(Outcome(ANN))
        assert isinstance(answer, OutcomeIs)
        assert (answer.kind, bench.value()) == (OUTCOME_UNSEEN, "1")

    def test_restart_after_the_disk_is_done_keeps_it(self, bench):
        """Shard restarts after the record is kept: the outcome says committed, the value is there."""
        seeded(bench)
        grant = bench.granted(ANN, WRITE)
        bench.disk_is_done = False
        bench.commit(ANN, grant.token, (slot(), "2"))
        bench.restart(lose_pending=False)

        answer = bench.ask(Outcome(ANN))

        assert isinstance(answer, OutcomeIs)
        assert (answer.kind, bench.value()) == (OUTCOME_COMMITTED, "2")

    def test_repeated_commit_after_a_restart_gets_the_recorded_answer(self, bench):
        """Shard restarts: the commit sent again is answered from the record, not executed."""
        seeded(bench)
        grant = bench.granted(ANN, WRITE)
        first = bench.commit(ANN, grant.token, (slot(), "2"))
        bench.restart()

        assert bench.commit(ANN, grant.token, (slot(), "2")) == first
        assert bench.shard.state.slots[slot()].version == 2

    def test_repeated_commit_is_executed_once(self, bench):
        """Duplicated: the same commit again gets the same answer and writes nothing."""
        seeded(bench)
        grant = bench.granted(ANN, WRITE)
        first = bench.commit(ANN, grant.token, (slot(), "2"))

        assert bench.commit(ANN, grant.token, (slot(), "2")) == first
        assert bench.shard.state.slots[slot()].version == 2
        assert len(bench.notices) == 2

    def test_repeated_commit_in_flight_is_answered_with_the_first(self, bench):
        """Duplicated while the disk works: both get the one answer."""
        seeded(bench)
        grant = bench.granted(ANN, WRITE)
        bench.disk_is_done = False
        bench.commit(ANN, grant.token, (slot(), "2"))
        assert bench.commit(ANN, grant.token, (slot(), "2")) is None
        last = max(bench.answers)

        bench.finish_disk()

        assert isinstance(bench.answers[last + 1], Committed)
        assert bench.answers[last + 1] == bench.answers[last + 2]

    def test_outcome_in_flight_is_pending(self, bench):
        """Lost answer: while the disk works nobody can say more than pending."""
        seeded(bench)
        grant = bench.granted(ANN, WRITE)
        bench.disk_is_done = False
        bench.commit(ANN, grant.token, (slot(), "2"))

        assert bench.ask(Outcome(ANN)).kind == OUTCOME_PENDING

    def test_lease_does_not_end_a_commit_in_flight(self, bench):
        """Lease ends while the disk works: the commit keeps its lock until it is done."""
        seeded(bench)
        grant = bench.granted(ANN, WRITE, hold_ns=S)
        bench.disk_is_done = False
        bench.commit(ANN, grant.token, (slot(), "2"))
        bench.wait(2 * TTL_NS, keep=["bob"])
        assert bench.acquire(BOB, WRITE) is None
        bench.ask(Release(ANN))
        bench.keep_alive("ann", view={0: 9})
        assert bench.acquire(BOB, WRITE) is None

        bench.finish_disk()

        assert bench.value() == "2"
        assert isinstance(bench.acquire(BOB, WRITE), Granted)

    def test_shard_sleeps_while_only_the_disk_can_help(self, bench):
        """Lease ends while the disk works: the next look at the clock is not overdue at once."""
        seeded(bench)
        grant = bench.granted(ANN, WRITE)
        bench.disk_is_done = False
        bench.commit(ANN, grant.token, (slot(), "2"))
        bench.wait(2 * TTL_NS, keep=["bob"])

        assert bench.shard.next_deadline_ns() > bench.now_ns

    def test_committed_seq_is_stale_after_a_restart(self, bench):
        """Shard restarts: a seq that is known to have committed is not granted again."""
        seeded(bench)
        bench.write("ann", 1, "2")
        bench.restart()
        bench.hello("ann", "bob", "eve", known_epoch=bench.shard.epoch)

        assert isinstance(bench.acquire(lock_id("ann", 9, 1), WRITE), Stale)

    def test_forgotten_session_does_not_end_a_commit_in_flight(self, bench):
        """Session stays away for good while the disk works: the commit is done and recorded."""
        seeded(bench)
        grant = bench.granted(ANN, WRITE)
        bench.disk_is_done = False
        bench.commit(ANN, grant.token, (slot(), "2"))
        bench.wait(6 * TTL_NS, keep=["bob"])
        assert "ann" not in bench.shard.state.sessions.by_id

        bench.finish_disk()

        assert bench.value() == "2"
        assert bench.ask(Outcome(ANN)).kind == OUTCOME_COMMITTED

    def test_commit_after_release_is_fenced(self, bench):
        """Late: a lock that was given back writes nothing."""
        seeded(bench)
        grant = bench.granted(ANN, WRITE)
        bench.ask(Release(ANN))

        assert isinstance(bench.commit(ANN, grant.token, (slot(), "2")), Fenced)
        assert bench.value() == "1"


class TestValidate:
    def test_validation_releases_the_read(self, bench):
        """A valid read is over: writers go on."""
        seeded(bench)
        grant = bench.granted(ANN, READ)

        assert bench.ask(Validate(ANN, grant.token)) == Valid(ANN)
        assert isinstance(bench.acquire(BOB, WRITE), Granted)

    def test_repeated_validation_gets_the_same_answer(self, bench):
        """Lost answer: the same question again is answered the same, though others write now."""
        seeded(bench)
        grant = bench.granted(ANN, READ)
        bench.ask(Validate(ANN, grant.token))
        bench.write("bob", 1, "2")

        assert bench.ask(Validate(ANN, grant.token)) == Valid(ANN)

    def test_validation_after_a_restart_says_the_epoch(self, bench):
        """Shard restarts: nobody can say that the read was protected."""
        seeded(bench)
        grant = bench.granted(ANN, READ)
        bench.restart()

        assert isinstance(bench.ask(Validate(ANN, grant.token)), EpochChanged)

    def test_validation_after_the_lease_is_fenced(self, bench):
        """Lease ends before the question: the read was not protected until now (write skew)."""
        seeded(bench)
        grant = bench.granted(ANN, READ)
        bench.wait(TTL_NS + 100 * MS, keep=["bob"])

        assert isinstance(bench.ask(Validate(ANN, grant.token)), Fenced)


class TestRelease:
    def test_release_is_always_answered(self, bench):
        """Duplicated or late: giving back what is not held is fine."""
        seeded(bench)

        assert bench.ask(Release(ANN)) == Released()
        bench.granted(ANN, WRITE)
        assert bench.ask(Release(ANN)) == bench.ask(Release(ANN)) == Released()

    def test_late_release_does_not_touch_the_next_lock_of_its_lane(self, bench):
        """Late: a release names one seq."""
        seeded(bench)
        bench.granted(lock_id("ann", 0, 2), WRITE)
        bench.ask(Release(ANN))

        assert bench.acquire(BOB, WRITE) is None
