"""Commits: all or nothing, expected views, durability, what may be written."""

from __future__ import annotations

import pytest
from shard_bench import S, datum, item, lock_id, slot

from enact_dist.core.protocol.messages import (
    OUTCOME_COMMITTED,
    OUTCOME_EXPIRED,
    Changed,
    Commit,
    Committed,
    Fenced,
    Granted,
    Item,
    Outcome,
    Refused,
    WriteItem,
)
from enact_dist.core.protocol.records import OutcomeRecord, SlotRecord
from enact_dist.terms import Access, Durability

R, W, V, WE = Access.READ, Access.WRITE, Access.VIEW, Access.WRITE_EACH
ANN, BOB = lock_id("ann"), lock_id("bob")


def test_commit_writes_all_slots_with_one_stamp(bench):
    """All writes of a lock become visible together, at one position."""
    bench.hello("ann")
    grant = bench.granted(ANN, item(W, "a"), item(W, "b", "note"))

    answer = bench.commit(ANN, grant.token, (slot("a"), "1"), (slot("b", "note"), "2"))

    assert isinstance(answer, Committed)
    contents = [bench.shard.state.slots[s] for s in (slot("a"), slot("b", "note"))]
    assert {content.stamp_ns for content in contents} == {answer.position.stamp_ns}
    assert len(bench.notices) == 1


def test_null_is_written_and_keeps_the_version(bench):
    """Deleting a datum is a write: the version goes on and is never used again."""
    bench.hello("ann")
    bench.write("ann", 1, "1")
    lock = lock_id("ann", 9, 2)
    grant = bench.granted(lock, item(W))
    bench.commit(lock, grant.token, (slot(), None))

    assert bench.value() is None
    assert bench.shard.state.slots[slot()].version == 2
    bench.restart()
    assert bench.shard.state.slots[slot()].version == 2


@pytest.mark.parametrize(
    ("items", "target"),
    [
        ((item(R, "a"),), slot("a")),
        ((item(W, "a"),), slot("b")),
        ((item(V, "a"),), slot("a")),
        ((item(WE, "tray/*"),), slot("bench")),
        ((item(WE, "tray/*"),), slot("tray/1", "note")),
    ],
)
def test_commit_of_a_slot_that_is_not_locked_for_writing_is_refused(bench, items, target):
    """A lock writes what it asked to write and nothing else."""
    bench.hello("ann")
    grant = bench.granted(ANN, *items)

    answer = bench.commit(ANN, grant.token, (target, "1"))

    assert isinstance(answer, Refused)
    assert bench.value(target) is None


def test_pattern_lock_may_create_what_it_matches(bench):
    """Creating an entity is a write under a pattern lock."""
    bench.hello("ann")
    grant = bench.granted(ANN, item(WE, "tray/*"))

    assert isinstance(bench.commit(ANN, grant.token, (slot("tray/new"), "1")), Committed)


def test_one_slot_twice_in_a_commit_is_refused(bench):
    """Which of two values should stand cannot be told, so neither does."""
    bench.hello("ann")
    grant = bench.granted(ANN, item(W))
    writes = (WriteItem(slot(), datum("1")), WriteItem(slot(), datum("2")))

    assert isinstance(bench.ask(Commit(ANN, grant.token, writes, 0)), Refused)
    assert bench.value() is None


class TestExpect:
    def test_commit_fails_when_an_expected_view_moved_on(self, bench):
        """A view that the writes rest on must still be the newest; nothing is written."""
        bench.hello("ann", "bob")
        bench.write("bob", 1, "1", to=slot("a"))
        grant = bench.granted(ANN, item(W, "b"), item(V, "a"))
        bench.write("bob", 2, "2", to=slot("a"))

        answer = bench.commit(ANN, grant.token, (slot("b"), "x"), expects={slot("a"): 1})

        assert answer == Changed(ANN, slot("a"), 2)
        assert bench.value(slot("b")) is None
        assert isinstance(bench.acquire(BOB, item(W, "b")), Granted)

    def test_commit_stands_when_the_expected_view_did(self, bench):
        """An expected view that nobody touched does not get in the way."""
        bench.hello("ann", "bob")
        bench.write("bob", 1, "1", to=slot("a"))
        grant = bench.granted(ANN, item(W, "b"), item(V, "a"))

        answer = bench.commit(ANN, grant.token, (slot("b"), "x"), expects={slot("a"): 1})

        assert isinstance(answer, Committed)

    def test_two_locks_that_expect_what_the_other_writes_do_not_both_commit(self, bench):
        """A commit in flight counts as done: no write skew (simulation seed 199)."""
        bench.hello("ann", "bob")
        ann = bench.granted(ANN, item(W, "a"), item(V, "b"))
        bob = bench.granted(BOB, item(W, "b"), item(V, "a"))
        bench.disk_is_done = False
        assert bench.commit(ANN, ann.token, (slot("a"), "1"), expects={slot("b"): 0}) is None

        answer = bench.commit(BOB, bob.token, (slot("b"), "1"), expects={slot("a"): 0})

        assert answer == Changed(BOB, slot("a"), 1)

    def test_commit_in_flight_counts_as_a_newer_version(self, bench):
        """What the disk is busy with comes before us in the log, and so in the order of stamps."""
        bench.hello("ann", "bob")
        ann = bench.granted(ANN, item(W, "b"), item(V, "a"))
        bob = bench.granted(BOB, item(W, "a"))
        bench.disk_is_done = False
        bench.commit(BOB, bob.token, (slot("a"), "1"))

        answer = bench.commit(ANN, ann.token, (slot("b"), "1"), expects={slot("a"): 0})

        assert answer == Changed(ANN, slot("a"), 1)

    def test_view_that_an_earlier_lock_may_still_write_does_not_stand(self, bench):
        """A writer that was there first counts as first, though nothing is to be seen of it yet.

        If it also read on another shard, it may have given that read back already, and others
        may have built on it (simulation seed 100584).
        """
        bench.hello("ann", "bob")
        bench.granted(BOB, item(W, "a"), alone=False)
        ann = bench.granted(ANN, item(W, "b"), item(V, "a"))

        answer = bench.commit(ANN, ann.token, (slot("b"), "1"), expects={slot("a"): 0})

        assert answer == Changed(ANN, slot("a"), 0)

    def test_view_that_a_pattern_may_still_write_does_not_stand(self, bench):
        """A pattern writes whatever it matches."""
        bench.hello("ann", "bob")
        bench.granted(BOB, item(WE, "tray/*"), alone=False)
        ann = bench.granted(ANN, item(W, "b", "note"), item(V, "tray/1"))

        answer = bench.commit(ANN, ann.token, (slot("b", "note"), "1"), expects={slot("tray/1"): 0})

        assert answer == Changed(ANN, slot("tray/1"), 0)

    def test_view_that_a_lock_on_this_shard_alone_may_write_stands(self, bench):
        """Such a lock commits in one step, here: it comes after this commit whole."""
        bench.hello("ann", "bob")
        ann = bench.granted(ANN, item(W, "b"), item(V, "a"))
        bench.granted(BOB, item(W, "a"))

        answer = bench.commit(ANN, ann.token, (slot("b"), "1"), expects={slot("a"): 0})

        assert isinstance(answer, Committed)


class TestDurability:
    @pytest.mark.parametrize(
        ("aspects", "strictest"),
        [
            (["count"], Durability.DURABLE),
            (["note"], Durability.OS),
            (["note", "count"], Durability.DURABLE),
            (["frame", "note"], Durability.OS),
            (["frame", "count"], Durability.DURABLE),
        ],
    )
    def test_commit_takes_the_strictest_class_of_its_slots(self, bench, aspects, strictest):
        """Nothing is told before it survives what its strictest aspect promises."""
        bench.hello("ann")
        grant = bench.granted(ANN, *(item(W, "a", aspect) for aspect in aspects))
        bench.disk_is_done = False

        answer = bench.commit(ANN, grant.token, *((slot("a", aspect), "1") for aspect in aspects))

        assert answer is None
        (persist,) = bench.pending
        assert persist.durability is strictest
        assert any(isinstance(record, OutcomeRecord) for record in persist.records)

    def test_volatile_commit_to_a_known_slot_does_not_wait_for_the_disk(self, bench):
        """What survives nothing is visible at once, once its slot is known."""
        bench.hello("ann")
        frame = slot("a", "frame")
        bench.write("ann", 1, "1", to=frame)
        again = lock_id("ann", 0, 2)
        grant = bench.granted(again, item(W, "a", "frame"))
        bench.disk_is_done = False

        assert isinstance(bench.commit(again, grant.token, (frame, "2")), Committed)
        assert bench.value(frame) == "2"

    def test_first_volatile_commit_of_a_slot_stands_when_its_existence_is_kept(self, bench):
        """Whoever has seen it is told after a restart that it is lost, not that it never was."""
        bench.hello("ann")
        frame = slot("a", "frame")
        grant = bench.granted(ANN, item(W, "a", "frame"))
        bench.disk_is_done = False

        assert bench.commit(ANN, grant.token, (frame, "1")) is None
        assert bench.value(frame) is None
        (persist,) = bench.pending
        assert persist.durability is Durability.OS
        assert not any(isinstance(record, OutcomeRecord) for record in persist.records)

        bench.finish_disk()
        assert bench.value(frame) == "1"

    def test_volatile_slot_is_null_and_known_as_lost_after_a_restart(self, bench):
        """A volatile datum goes with its shard; that the slot existed is remembered once."""
        bench.hello("ann")
        frame = slot("a", "frame")
        bench.write("ann", 1, "1", to=frame)
        bench.write("ann", 2, "2", to=frame)
        assert sum(isinstance(record, SlotRecord) for record in bench.log) == 1

        bench.restart()

        content = bench.shard.state.slots[frame]
        assert content.datum is None
        assert (content.version, content.null_reason.name) == (0, "LOST")


class TestOutcome:
    def test_outcome_of_a_lock_that_its_lane_left_behind_is_expired(self, bench):
        """One outcome is kept per lane; about older ones nobody claims to know."""
        bench.hello("ann")
        bench.write("ann", 1, "1")
        bench.write("ann", 2, "2")

        assert bench.ask(Outcome(lock_id("ann", 9, 1))).kind == OUTCOME_EXPIRED

    def test_older_commit_that_ends_later_does_not_hide_the_newer_one(self, bench):
        """A thread that gave up on a slow commit and made another learns about the other."""
        bench.hello("ann")
        first = bench.granted(ANN, item(W))
        bench.disk_is_done = False
        bench.commit(ANN, first.token, (slot(), "1"))
        newer = lock_id("ann", 0, 2)
        second = bench.granted(newer, item(W, "a", "frame"))
        bench.commit(newer, second.token, (slot("a", "frame"), "2"))
        bench.finish_disk()

        assert bench.ask(Outcome(newer)).kind == OUTCOME_COMMITTED
        assert bench.value() == "1"

    def test_outcome_survives_the_session(self, bench):
        """A client that comes back late still learns what became of its commit."""
        bench.hello("ann", "bob")
        bench.write("ann", 1, "1")
        bench.wait(20 * S, keep=["bob"])
        assert "ann" not in bench.shard.state.sessions.by_id

        assert bench.ask(Outcome(lock_id("ann", 9, 1))).kind == "committed"
        bench.restart()
        assert bench.ask(Outcome(lock_id("ann", 9, 1))).kind == "committed"

    def test_outcome_table_holds_one_entry_per_lane(self, bench):
        """Nothing grows with the number of commits."""
        bench.hello("ann")
        for seq in range(1, 50):
            bench.write("ann", seq, str(seq))

        assert len(bench.recovered(2).outcomes) == 1
        assert len(bench.shard.state.sessions.by_id["ann"].lanes) == 1


class TestStampsOfCommits:
    def test_stamp_exceeds_what_the_client_has_seen(self, bench):
        """Cause comes before effect, whatever the wall clocks say."""
        bench.hello("ann")
        seen_ns = bench.wall_ns + S // 2
        grant = bench.granted(ANN, item(W))
        answer = bench.ask(Commit(ANN, grant.token, (WriteItem(slot(), datum()),), seen_ns))

        assert isinstance(answer, Committed)
        assert answer.position.stamp_ns > seen_ns

    def test_client_that_has_seen_the_far_future_is_refused_by_name(self, bench):
        """More than a second ahead is a wrong clock somewhere; the message says how far."""
        bench.hello("ann")
        seen_ns = bench.wall_ns + 10 * S
        grant = bench.granted(ANN, item(W))
        answer = bench.ask(Commit(ANN, grant.token, (WriteItem(slot(), datum()),), seen_ns))

        assert isinstance(answer, Refused)
        assert (answer.code, "10.0 s ahead" in answer.text) == ("clock_skew", True)
        assert bench.value() is None

    def test_refused_commit_stays_refused_when_the_clock_is_set(self, bench):
        """A late copy of a refused commit writes nothing (simulation seed 402476)."""
        bench.hello("ann")
        grant = bench.granted(ANN, item(W))
        commit = Commit(ANN, grant.token, (WriteItem(slot(), datum()),), bench.wall_ns + 10 * S)
        assert isinstance(bench.ask(commit), Refused)
        bench.wall_ns += 3600 * S

        assert isinstance(bench.ask(commit), Fenced)
        assert bench.value() is None

    def test_wall_clock_set_back_does_not_turn_stamps_back(self, bench):
        """`date -s` changes nothing about the order of commits."""
        bench.hello("ann")
        first = bench.write("ann", 1, "1")
        bench.wall_ns -= 3600 * S
        second = bench.write("ann", 2, "2")

        assert second.position.stamp_ns > first.position.stamp_ns


def test_unregistered_aspect_is_refused_by_name(bench):
    """A lock on an aspect that nobody registered says so."""
    bench.hello("ann")
    answer = bench.acquire(ANN, Item(W, "online", "a", "nonsense"))

    assert isinstance(answer, Refused)
    assert answer.code == "unknown_aspect"


def test_unregistered_aspect_is_null_to_readers(bench):
    """Reading needs no registration: there is null, and the catalogue stays as it was."""
    bench.hello("ann")
    before = dict(bench.shard.state.catalogue.aspects)
    each = Item(Access.READ_EACH, "online", "*", "nonsense")
    grant = bench.granted(ANN, Item(R, "online", "a", "nonsense"), each)

    assert [(state.version, state.null_reason) for state in grant.states] == [(0, "NEVER_SET")]
    assert bench.shard.state.catalogue.aspects == before
    answer = bench.commit(ANN, grant.token, (slot("a", "nonsense"), "1"))
    assert isinstance(answer, Refused)


def test_unknown_world_is_refused_with_those_that_exist(bench):
    """A lock in a world context that does not exist names those that do."""
    bench.hello("ann")
    answer = bench.acquire(ANN, Item(W, "nowhere", "a", "count"))

    assert isinstance(answer, Refused)
    assert "online, training" in answer.text
