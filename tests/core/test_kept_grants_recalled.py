"""Kept grants that others wait for: revoked where idle, recalled where in use, kept less often."""

from __future__ import annotations

import pytest
from kept_parts import FRAME, KeepingBench
from shard_bench import MS, datum, item, slot

from enact_dist.core.protocol.messages import (
    NOT_KEPT,
    PLACES,
    Commit,
    Goodbye,
    Granted,
    Item,
    ListLocks,
    Refused,
    Release,
    WriteItem,
)
from enact_dist.core.state.tenure import ROW_MAX, ROW_MIN, USES_TO_HALVE
from enact_dist.terms import Access

COUNT = slot()
BENCH = KeepingBench
SESSIONS = "ann", "bob"


class TestRecall:
    def test_idle_grant_is_over_and_the_waiter_granted_in_the_same_step(self, bench):
        """No word to the client, and no waiting for it."""
        kept = bench.keep()
        _, handle = bench.waiter()

        assert isinstance(bench.answers[handle], Granted)
        assert not bench.lives(kept)
        assert bench.counter("grants_revoked") == 1

    def test_cell_is_cleared_before_the_mark_is_asked_for(self, bench):
        """A client that marks its use in between finds no number; the other order misses it."""
        kept = bench.keep()
        bench.marks.log.clear()
        bench.marks.meanwhile = lambda: bench.use(kept)
        _, handle = bench.waiter()

        number = kept.token.number
        assert bench.marks.log == [("cleared", number), ("asked", number)]
        assert bench.answers.get(handle) is None
        assert bench.lives(kept)

    @pytest.mark.parametrize("how", ["commit", "validate", "release", "tick", "not kept"])
    def test_used_grant_ends_with_its_block(self, bench, how):
        """The waiter is granted in that step."""
        kept, lock = bench.keep(), bench.next_lock(lane=1)
        bench.use(kept)
        _, handle = bench.waiter()
        assert bench.answers.get(handle) is None
        bench.wait(50 * MS)
        assert bench.answers.get(handle) is None

        if how == "commit":
            assert bench.end(lock, kept.token, "last").kept == NOT_KEPT
        elif how == "not kept":
            assert bench.end(lock, kept.token, "last", keep=False).kept == NOT_KEPT
        elif how == "validate":
            assert bench.validate(lock, kept.token).kept == NOT_KEPT
        elif how == "release":
            bench.ask(Release(kept.lock))
        else:
            bench.use(kept, on=False)
            bench.wait(MS)
        assert isinstance(bench.answers[handle], Granted)
        assert not bench.lives(kept)
        assert bench.counter("grants_recalled") == 1

    def test_shard_wakes_to_look_again(self, bench):
        """Word of the end may be lost with a client that was interrupted."""
        kept = bench.keep()
        bench.use(kept)
        bench.waiter()

        assert bench.shard.next_deadline_ns() <= bench.now_ns + 20 * MS

    def test_commit_in_flight_ends_with_itself(self, bench):
        """Whatever the mark says: its client may have given up."""
        kept, lock = bench.keep(to=COUNT), bench.next_lock(lane=1)
        bench.disk_is_done = False
        ended = bench.send(Commit(lock, kept.token, (WriteItem(COUNT, datum("x")),), 0, keep=True))
        _, handle = bench.waiter(to=COUNT)
        bench.wait(30 * MS)
        bench.ask(Release(kept.lock))
        again = bench.send(Commit(lock, kept.token, (WriteItem(COUNT, datum("x")),), 0, keep=True))
        other = bench.end(bench.next_lock(lane=2), kept.token, to=COUNT)
        assert isinstance(other, Refused)
        assert bench.answers.get(handle) is None
        bench.finish_disk()

        assert bench.answers[ended].kept == bench.answers[again].kept == NOT_KEPT
        assert bench.answers[handle].states[0].datum.body == b"x"

    def test_several_in_the_way_of_one(self, bench):
        """The idle ones are over at once, the used one ends with its block."""
        other = slot("other", "frame")
        idle, used = bench.keep(), bench.keep(to=other, lane=1)
        bench.use(used)
        lock = bench.next_lock("bob")
        handle = bench.send(bench.acquire_request(lock, item(Access.READ_EACH, "*", "frame")))

        assert (bench.lives(idle), bench.lives(used)) == (False, True)
        assert bench.answers.get(handle) is None
        bench.end(bench.next_lock(lane=1), used.token, to=other)
        assert isinstance(bench.answers[handle], Granted)

    def test_own_idle_grant_gives_way_to_an_own_lock(self, bench):
        """Other data of the same session that it stands in the way of."""
        kept, lock = bench.keep(), bench.next_lock()
        items = [Item(Access.WRITE, *FRAME), Item(Access.WRITE, *COUNT)]

        assert isinstance(bench.acquire(lock, *items), Granted)
        assert not bench.lives(kept)

    def test_newer_lock_of_its_lane_leaves_it(self, bench):
        """That it is not released does not mean that its release was lost."""
        kept = bench.keep()

        bench.granted(bench.next_lock(), Item(Access.WRITE, *COUNT))
        assert bench.lives(kept)
        assert bench.counter("superseded") == 0

    def test_waiter_that_gives_up_does_not_bring_it_back(self, bench):
        """The cell is cleared: its client knows no more of it."""
        kept = bench.keep()
        bench.use(kept)
        waiter, _ = bench.waiter()
        bench.ask(Release(waiter))

        assert bench.end(bench.next_lock(), kept.token).kept == NOT_KEPT
        assert not bench.lives(kept)

    def test_nobody_is_overtaken(self, bench):
        """Two waiters behind a grant in use are granted in the order of their arrival."""
        bench.hello("cyd")
        kept = bench.keep()
        bench.use(kept)
        first, one = bench.waiter("bob")
        _, two = bench.waiter("cyd")
        bench.end(bench.next_lock(), kept.token)

        assert isinstance(bench.answers[one], Granted)
        assert bench.answers.get(two) is None
        bench.ask(Release(first))
        assert isinstance(bench.answers[two], Granted)

    def test_listing_shows_how_it_is_used(self, bench):
        """For people: idle, in use, or awaited."""
        kept = bench.keep()
        shown = [bench.ask(ListLocks()).holders[0].kept]
        bench.use(kept)
        shown.append(bench.ask(ListLocks()).holders[0].kept)
        bench.waiter()
        shown += [holder.kept for holder in bench.ask(ListLocks()).holders]

        assert shown == ["unused", "used", "recalled", ""]


class TestHabit:
    def needed(self, bench) -> int:
        """Return how many blocks in a row it takes until the grant stays."""
        count = 1
        while bench.block().said < PLACES:
            count += 1
        return count

    def take_back(self, bench) -> None:
        waiter, _ = bench.waiter()
        bench.ask(Release(waiter))

    def test_each_recall_doubles_the_row(self, bench):
        """Contended data are not kept for long."""
        found = []
        for _ in range(8):
            found.append(self.needed(bench))
            self.take_back(bench)

        assert found == [2, 4, 8, 16, 32, 64, ROW_MAX, ROW_MAX]

    def test_uses_halve_it(self, bench):
        """What was contended once is kept again."""
        for _ in range(3):
            self.needed(bench)
            self.take_back(bench)
        assert self.needed(bench) == 16
        token = next(iter(bench.shard.state.tenures.kept.by_number.values())).token
        for _ in range(USES_TO_HALVE):
            bench.end(bench.next_lock(), token)
        self.take_back(bench)  # doubles it again

        assert self.needed(bench) == 16
        token = next(iter(bench.shard.state.tenures.kept.by_number.values())).token
        for _ in range(6 * USES_TO_HALVE):
            bench.end(bench.next_lock(), token)
        self.take_back(bench)
        assert self.needed(bench) == 2 * ROW_MIN

    def test_session_that_ended_leaves_no_habit(self, bench):
        """They are bounded, and go with their session."""
        bench.keep()
        assert bench.shard.state.tenures.kept._habits
        bench.ask(Goodbye("ann"))

        assert not bench.shard.state.tenures.kept._habits
