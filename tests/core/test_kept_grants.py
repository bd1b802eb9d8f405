"""Grants that stay with their session between two blocks: when they stay, and who may use them."""

from __future__ import annotations

from dataclasses import replace

import pytest
from kept_parts import FRAME, KeepingBench, reads
from shard_bench import MS, S, datum, item, lock_id, slot

from enact_dist.core.protocol.datum import Token
from enact_dist.core.protocol.messages import (
    NOT_KEPT,
    PLACES,
    PROVE,
    Changed,
    Commit,
    EpochChanged,
    Fenced,
    Granted,
    Item,
    Outcome,
    Prepare,
    Refused,
    Release,
    Released,
    Valid,
    WriteItem,
)
from enact_dist.core.state.sessions import LANES_MAX
from enact_dist.core.state.tenure import KEPT_ITEMS_MAX, ROW_MIN
from enact_dist.terms import Access

COUNT = slot()
BENCH = KeepingBench
SESSIONS = "ann", "bob"


class TestStays:
    def test_grant_stays_after_so_many_blocks_of_the_same_data_in_a_row(self, bench):
        """A process that locks once costs nothing more than it does without."""
        said = [bench.block().said for _ in range(ROW_MIN)]

        assert said == [NOT_KEPT] * (ROW_MIN - 1) + [PLACES]

    def test_blocks_of_other_data_are_another_row(self, bench):
        """Each set of data has its own."""
        assert bench.block().said == NOT_KEPT
        assert bench.block(to=slot("other", "frame")).said == NOT_KEPT
        assert bench.block("bob").said == NOT_KEPT
        assert bench.block().said >= PLACES

    def test_only_if_asked(self, bench):
        """A client that sees no page of its shard does not ask."""
        for _ in range(ROW_MIN + 2):
            assert bench.block(keep=False).said == NOT_KEPT
        assert not bench.shard.state.tenures.by_lock

    def test_validation_asks_as_a_commit_does(self, bench):
        """Blocks that only read keep their grant, too."""
        said = []
        for _ in range(ROW_MIN):
            lock = bench.next_lock()
            grant = bench.granted(lock, reads())
            said.append(bench.validate(lock, grant.token).kept)

        assert said == [NOT_KEPT] * (ROW_MIN - 1) + [PLACES]

    @pytest.mark.parametrize(
        "items",
        [
            [item(Access.WRITE_EACH, "*", "frame")],
            [item(Access.WRITE, "piece", "frame"), item(Access.READ_EACH, "*", "note")],
            [item(Access.WRITE, "piece", "frame"), item(Access.VIEW, "piece", "note")],
            [item(Access.WRITE, "piece", "frame"), Item(Access.READ, "online", "e", "note", 0, 5)],
            [item(Access.WRITE, "piece", "frame")]
            + [reads(f"e{number}") for number in range(KEPT_ITEMS_MAX)],
        ],
        ids=["pattern", "pattern beside", "view", "capture stamp", "many"],
    )
    def test_only_few_named_slots_all_locked(self, bench, items):
        """What stands in the way of many, or shows more than it holds, is not kept."""
        for _ in range(ROW_MIN + 1):
            assert bench.block("ann", *items).said == NOT_KEPT

    def test_as_many_slots_as_may_be(self, bench):
        """The bound itself is kept."""
        items = [reads(f"e{number}") for number in range(KEPT_ITEMS_MAX - 1)]
        assert bench.keep("ann", item(Access.WRITE, "piece", "frame"), *items).said >= PLACES

    def test_only_a_lock_of_this_shard_alone(self, bench):
        """Whoever holds elsewhere, too, has its turn there to think of."""
        for _ in range(ROW_MIN + 1):
            lock = bench.next_lock()
            grant = bench.granted(lock, Item(Access.WRITE, *FRAME), alone=False)
            assert bench.end(lock, grant.token).kept == NOT_KEPT

    def test_not_while_another_waits_and_the_row_begins_anew(self, bench):
        """Whoever waits is granted in the step that ends the block."""
        for _ in range(ROW_MIN - 1):
            bench.block()
        lock = bench.next_lock()
        grant = bench.granted(lock, Item(Access.WRITE, *FRAME))
        waiter, handle = bench.waiter()

        assert bench.end(lock, grant.token).kept == NOT_KEPT
        assert isinstance(bench.answers[handle], Granted)
        bench.ask(Release(waiter))
        assert [bench.block().said for _ in range(ROW_MIN - 1)] == [NOT_KEPT] * (ROW_MIN - 1)
        assert bench.block().said >= PLACES

    def test_readers_beside_a_kept_reader_do_not_wait(self, bench):
        """They take nothing from it."""
        for _ in range(ROW_MIN):
            lock = bench.next_lock()
            grant = bench.granted(lock, reads())
            said = bench.validate(lock, grant.token).kept
        assert said >= PLACES
        bench.granted(bench.next_lock("bob"), reads())
        assert grant.token.number in bench.marks.cells["ann"]

    @pytest.mark.parametrize("says", [NOT_KEPT, PROVE])
    def test_what_the_marks_say_is_passed_on(self, bench, says):
        """The grant is over, and asked for again with the next block."""
        bench.marks.says = says
        for _ in range(ROW_MIN - 1):
            bench.block()

        assert bench.block().said == says
        assert not bench.shard.state.tenures.by_lock
        assert bench.counter("grants_not_kept") == 1
        bench.marks.says = None
        assert bench.block().said >= PLACES

    def test_without_marks_nothing_is_kept(self, bench):
        """A shard that shares no memory with its clients."""
        bench._boot(bench.recovered(2))
        bench.hello("ann", "bob", known_epoch=2)
        for _ in range(ROW_MIN + 1):
            assert bench.block().said == NOT_KEPT


class TestLaterBlocks:
    def test_commits_by_token_under_another_lane_and_a_higher_seq(self, bench):
        """Any thread of the session may use it, one at a time."""
        kept = bench.keep()

        for lane in (0, 1, 1, 0):
            lock = bench.next_lock(lane=lane)
            answer = bench.end(lock, kept.token, f"lane {lane}")
            assert (answer.kept, answer.lock) == (kept.said, lock)
            assert bench.value(FRAME) == f"lane {lane}"
        assert bench.lives(kept)
        assert bench.counter("locks_granted") == ROW_MIN

    def test_validates_by_token(self, bench):
        """A client that does not believe any more asks."""
        kept, lock = bench.keep(), bench.next_lock(lane=3)

        assert bench.validate(lock, kept.token) == Valid(lock, kept.said)
        assert bench.validate(lock, kept.token) == Valid(lock, kept.said)
        assert isinstance(bench.end(lock, kept.token), Fenced)
        assert bench.lives(kept)

    def test_without_asking_again_it_ends(self, bench):
        """The block was the last one."""
        kept = bench.keep()

        assert bench.end(bench.next_lock(), kept.token, keep=False).kept == NOT_KEPT
        assert not bench.lives(kept)

    def test_what_its_lane_has_left_behind_is_fenced(self, bench):
        """A late copy was built on what may be gone; at the lane's top and below."""
        kept = bench.keep()
        late, last = bench.next_lock(), bench.next_lock()
        bench.end(last, kept.token, "newest")
        unknown = replace_lane(last)

        assert isinstance(bench.end(late, kept.token, "late"), Fenced)
        assert isinstance(bench.validate(late, kept.token), Fenced)
        assert isinstance(bench.validate(last, kept.token), Fenced)
        assert isinstance(bench.end(kept.lock, kept.token, "late"), Fenced)
        assert isinstance(bench.ask(prepared(kept.lock, kept.token)), Fenced)
        assert isinstance(bench.ask(prepared(unknown, kept.token)), Fenced)
        assert bench.value(FRAME) == "newest"
        assert bench.lives(kept)

    def test_token_of_another_session_is_no_use(self, bench):
        """A grant belongs to whom it was given."""
        kept = bench.keep()

        assert isinstance(bench.end(lock_id("bob", 0, 99), kept.token, "stolen"), Fenced)
        assert isinstance(bench.validate(lock_id("bob", 0, 99), kept.token), Fenced)
        assert bench.lives(kept)

    def test_dead_token_and_another_epoch_are_refused(self, bench):
        """The number says which grant, the epoch which shard."""
        kept, token = bench.keep(), bench.block(to=COUNT).token

        assert isinstance(bench.end(bench.next_lock(), token, "dead"), Fenced)
        invented = Token(kept.token.epoch, kept.token.number + 100)
        assert isinstance(bench.end(bench.next_lock(), invented, "invented"), Fenced)
        other = Token(kept.token.epoch - 1, kept.token.number)
        assert isinstance(bench.end(bench.next_lock(), other, "before"), EpochChanged)
        assert bench.lives(kept)

    def test_kept_grant_does_not_outlive_its_shard(self, bench):
        """After a restart the token is of another epoch."""
        kept = bench.keep()
        bench.restart()
        bench.hello("ann", known_epoch=2)

        assert isinstance(bench.end(bench.next_lock(), kept.token), EpochChanged)

    @pytest.mark.parametrize("recalled", [False, True])
    def test_repeated_commit_says_whether_the_grant_lives(self, bench, recalled):
        """Recalled or not: told that it is over, its client would not give it back."""
        kept, lock = bench.keep(), bench.next_lock(lane=1)
        first = bench.end(lock, kept.token, "once")
        bench.use(kept)
        if recalled:
            bench.waiter()

        again = bench.end(lock, kept.token, "once")

        assert (again, again.kept) == (first, kept.said)
        assert bench.shard.state.slots[FRAME].version == ROW_MIN + 1
        bench.use(kept, on=False)
        bench.waiter()
        bench.wait(MS)
        assert not bench.lives(kept)
        assert bench.end(lock, kept.token, "once").kept == NOT_KEPT

    def test_held_ns_is_what_the_client_says_within_the_age_of_the_grant(self, bench):
        """The shard cannot know when a later block began."""
        kept = bench.keep(to=COUNT)
        bench.wait(700 * MS, keep=["ann", "bob"])

        found = []
        for held_ns in (3 * MS, 5 * S, -1):
            bench.end(bench.next_lock(), kept.token, to=COUNT, held_ns=held_ns)
            found.append(bench.shard.state.slots[COUNT].cause.held_ns)
        assert found == [3 * MS, 700 * MS, 0]

    def test_moved_expectation_is_told_to_the_lock_that_asked(self, bench):
        """Its client takes no answer for another lock."""
        kept, lock = bench.keep(), bench.next_lock(lane=2)
        other = slot("other", "frame")

        answer = bench.end(lock, kept.token, expects={other: 7})

        assert answer == Changed(lock, other, 0)
        assert bench.end(lock, kept.token, expects={other: 7}) == answer
        assert not bench.lives(kept)

    def test_expectation_that_holds_keeps_the_grant(self, bench):
        """It is compared in the step that commits."""
        kept = bench.keep()
        bench.block("bob", to=slot("other", "frame"), keep=False)

        answer = bench.end(bench.next_lock(), kept.token, expects={slot("other", "frame"): 1})
        assert answer.kept == kept.said

    def test_refused_commit_ends_the_grant(self, bench):
        """A late copy must not find it again; the next message learns why."""
        kept, lock = bench.keep(), bench.next_lock(lane=1)

        assert isinstance(bench.end(lock, kept.token, to=slot("not held", "frame")), Refused)
        assert not bench.lives(kept)
        fenced = bench.end(lock, kept.token)
        assert "for writing" in fenced.cause

    def test_missing_payload_leaves_the_grant(self, bench):
        """The bytes come with the next copy."""
        kept, lock = bench.keep(), bench.next_lock(lane=1)
        named = (WriteItem(FRAME, replace(datum("x"), body=b"", size=5, file="draft")),)

        answer = bench.ask(Commit(lock, kept.token, named, 0, keep=True))

        assert answer.code == "no_payload"
        assert bench.end(lock, kept.token).kept == kept.said

    def test_lanes_are_bounded(self, bench):
        """A thread beyond the bound cannot commit under a kept grant; the others can."""
        kept = bench.keep()
        lanes = bench.shard.state.sessions.by_id["ann"].lanes
        for lane in range(1, LANES_MAX):
            bench.end(lock_id("ann", lane, 1), kept.token)
        assert len(lanes) == LANES_MAX

        assert isinstance(bench.validate(lock_id("ann", LANES_MAX, 1), kept.token), Refused)
        assert bench.end(bench.next_lock(), kept.token).kept == kept.said
        refused = bench.end(lock_id("ann", LANES_MAX, 1), kept.token)
        assert (refused.code, len(lanes)) == ("overload", LANES_MAX)
        assert not bench.lives(kept)


class TestOutcomes:
    def test_later_lock_unseen_in_flight_committed_and_too_old(self, bench):
        """As of any lock, though the shard has never granted this one."""
        kept, lock = bench.keep(to=COUNT), bench.next_lock(lane=4)
        kinds = [bench.ask(Outcome(lock)).kind]
        bench.disk_is_done = False
        handle = bench.send(Commit(lock, kept.token, (WriteItem(COUNT, datum("x")),), 0, keep=True))
        kinds.append(bench.ask(Outcome(lock)).kind)
        first = bench.ask(Outcome(kept.lock)).kind
        bench.finish_disk()
        bench.disk_is_done = True
        kinds.append(bench.ask(Outcome(lock)).kind)
        bench.end(bench.next_lock(lane=4), kept.token, to=COUNT)
        kinds.append(bench.ask(Outcome(lock)).kind)

        assert kinds == ["unseen", "pending", "committed", "expired"]
        assert first == "committed"
        assert bench.answers[handle].kept == kept.said

    def test_commit_of_a_later_lock_is_not_that_of_the_first(self, bench):
        """Whoever asks late about the first lock is not told to wait."""
        kept = bench.keep(to=COUNT)
        bench.end(bench.next_lock(), kept.token, to=COUNT)
        bench.disk_is_done = False
        bench.end(bench.next_lock(), kept.token, to=COUNT)

        assert bench.ask(Outcome(kept.lock)).kind == "expired"

    def test_release_of_a_later_lock_fences_late_copies_of_its_commit(self, bench):
        """Its client gave up before it knew whether the commit had arrived."""
        kept, lock = bench.keep(), bench.next_lock()

        assert bench.ask(Release(lock)) == Released()
        assert isinstance(bench.end(lock, kept.token, "late"), Fenced)
        assert bench.ask(Release(kept.lock._replace(seq=0))) == Released()
        assert bench.end(bench.next_lock(), kept.token).kept == kept.said


def prepared(lock, token):
    """Return a promise under a token."""
    return Prepare(lock, token, (WriteItem(FRAME, datum()),), 0, (), "far", Token(7, 7))


def replace_lane(lock):
    """Return a later lock of another lane."""
    return lock._replace(lane=lock.lane + 5)
