"""The ends of kept grants: however one ends, its cell is cleared; and how many there may be."""

from __future__ import annotations

import pytest
from kept_parts import FRAME, KeepingBench
from shard_bench import MS, TTL_NS, S, datum, item, slot

from enact_dist.core.protocol.messages import (
    NOT_KEPT,
    PLACES,
    Break,
    Commit,
    Dropped,
    DropWorld,
    Fenced,
    Goodbye,
    Granted,
    Hello,
    Item,
    ListLocks,
    Refused,
    Register,
    Release,
    WriteItem,
)
from enact_dist.core.protocol.records import Drain, SessionDied, SessionSeen
from enact_dist.core.state import tenure as tenures
from enact_dist.core.state.tenure import CAUSES_MAX, HABITS_MAX, KEPT_OF_SESSION_MAX, ROW_MIN
from enact_dist.terms import Access

COUNT = slot()
BENCH = KeepingBench
SESSIONS = "ann", "bob"


def released(bench, kept):
    bench.ask(Release(kept.lock))


def silent(bench, kept):
    bench.wait(TTL_NS + 200 * MS, keep=["bob"])


def goodbye(bench, kept):
    bench.ask(Goodbye("ann"))


def died(bench, kept):
    bench.event(SessionDied("ann"))


def broken(bench, kept):
    bench.ask(Break(bench.shard.state.tenures.by_lock[kept.lock].claim.ticket, "by hand"))


def drained(bench, kept):
    bench.event(Drain())


def revoked(bench, kept):
    bench.waiter()


def refused(bench, kept):
    assert isinstance(bench.end(bench.next_lock(), kept.token, to=slot("no", "frame")), Refused)


def not_kept(bench, kept):
    bench.end(bench.next_lock(), kept.token, keep=False)


def validated(bench, kept):
    bench.validate(bench.next_lock(), kept.token, keep=False)


def moved(bench, kept):
    bench.end(bench.next_lock(), kept.token, expects={slot("other", "frame"): 9})


def recalled_and_unused(bench, kept):
    bench.use(kept)
    bench.waiter()
    bench.use(kept, on=False)
    bench.wait(MS)


def held_too_long(bench, kept):
    bench.use(kept)
    bench.waiter()
    bench.wait(61 * S, keep=["ann", "bob"])


ENDS = (
    released,
    silent,
    goodbye,
    died,
    broken,
    drained,
    revoked,
    refused,
    not_kept,
    validated,
    moved,
    recalled_and_unused,
    held_too_long,
)


@pytest.mark.parametrize("end", ENDS, ids=lambda end: end.__name__)
def test_cell_is_cleared_at_every_end(bench, end):
    """Cells outlive the shard's process: one that stays would be believed."""
    kept = bench.keep()
    number = kept.token.number
    bench.marks.log.clear()

    end(bench, kept)

    assert not bench.lives(kept)
    assert ("cleared", number) in bench.marks.log
    assert number not in bench.marks.cells.get("ann", {})
    assert not bench.shard.state.tenures.kept.by_number


TAKEN = {
    silent: "its lease of 2 s expired without a sign of life",
    broken: "broken by an operator: by hand",
    held_too_long: "held longer than its limit of 60 s",
    refused: "does not hold online:no/frame for writing",
}


@pytest.mark.parametrize("end", TAKEN, ids=lambda end: end.__name__)
def test_cause_is_told_to_the_next_commit_under_it(bench, end):
    """Whatever lock names the token: that one was never granted here."""
    kept = bench.keep()
    end(bench, kept)

    told = bench.end(bench.next_lock(lane=5), kept.token)
    assert isinstance(told, Fenced)
    assert TAKEN[end] in told.cause
    assert TAKEN[end] in bench.validate(bench.next_lock(lane=6), kept.token).cause


def test_newer_locks_of_its_lane_keep_their_own_cause(bench):
    """The end of an old grant says nothing about them."""
    kept, lock = bench.keep(), bench.next_lock()
    grant = bench.granted(lock, Item(Access.WRITE, *COUNT))
    ticket = bench.shard.state.tenures.by_lock[lock].claim.ticket
    bench.ask(Break(ticket, "the newer one"))
    broken(bench, kept)

    assert "the newer one" in bench.end(lock, grant.token, to=COUNT).cause
    assert "by hand" in bench.end(bench.next_lock(), kept.token).cause


def keep_again(bench, **options):
    """Lock the same data until the grant stays; the row goes on after a grant was broken."""
    while (kept := bench.block(**options)).said < PLACES:
        pass
    return kept


def test_causes_are_bounded(bench):
    """The oldest goes first."""
    causes = bench.shard.state.tenures.kept._causes
    for _ in range(3):
        broken(bench, keep_again(bench))
    causes.update(dict.fromkeys(range(1000, 1000 + CAUSES_MAX - 3), "?"))
    first = next(iter(causes))
    broken(bench, keep_again(bench))

    assert len(causes) == CAUSES_MAX
    assert first not in causes


def test_dropped_world_takes_idle_grants_and_waits_for_used_ones(bench):
    """What nobody uses does not hold it up."""
    bench.ask(Register("ann", ("spare",), ()))
    spare = slot(aspect="frame", context="spare")
    kept = bench.keep(to=spare)
    bench.keep(to=FRAME, lane=1)
    bench.use(kept)

    refused = bench.ask(DropWorld("bob", "spare", bench.shard.epoch, 1))
    assert (type(refused), refused.code) == (Refused, "held")
    assert bench.end(bench.next_lock(), kept.token, to=spare).kept == NOT_KEPT
    kept = keep_again(bench, to=spare)
    assert isinstance(bench.ask(DropWorld("bob", "spare", bench.shard.epoch, 2)), Dropped)
    assert not bench.lives(kept)
    assert len(bench.shard.state.tenures.kept.by_number) == 1


class TestDrain:
    def test_idle_grants_are_over_and_used_ones_end_with_their_block(self, bench):
        """A shard may stop once no block uses what it has granted."""
        idle, used = bench.keep(), bench.keep(to=COUNT, lane=1)
        bench.use(used)
        bench.event(Drain())

        assert (bench.lives(idle), bench.lives(used)) == (False, True)
        assert not bench.shard.idle
        bench.use(used, on=False)
        bench.wait(MS)
        assert bench.shard.idle

    def test_nothing_stays_from_then_on(self, bench):
        """A block that ends while the shard drains ends its grant."""
        for _ in range(ROW_MIN - 1):
            bench.block()
        lock = bench.next_lock()
        grant = bench.granted(lock, Item(Access.WRITE, *FRAME))
        bench.event(Drain())

        assert bench.end(lock, grant.token).kept == NOT_KEPT
        assert bench.shard.idle


class TestHoldLimit:
    def test_does_not_run_while_nobody_waits(self, bench):
        """A grant may stay for longer than a block may last."""
        kept = bench.keep(hold_ns=2 * S)
        bench.wait(5 * S, keep=["ann", "bob"])

        assert bench.lives(kept)
        assert bench.end(bench.next_lock(), kept.token).kept == kept.said

    @pytest.mark.parametrize("age_ns", [100 * MS, 5 * S], ids=["young", "old"])
    def test_runs_from_the_recall(self, bench, age_ns):
        """The block in use has as long as a lock that was just granted."""
        kept = bench.keep(hold_ns=2 * S)
        bench.wait(age_ns, keep=["ann", "bob"])
        bench.use(kept)
        lock, handle = bench.waiter()
        for _ in range(19):
            bench.wait(100 * MS, keep=["ann", "bob"])
            assert bench.lives(kept)
        assert bench.shard.next_deadline_ns() <= bench.now_ns + 100 * MS
        bench.wait(100 * MS, keep=["ann", "bob"])

        assert not bench.lives(kept)
        assert bench.counter("held_too_long") == 1
        assert isinstance(bench.acquire(lock, Item(Access.WRITE, *FRAME)), Granted)
        assert handle in bench.answers

    def test_commit_in_flight_outlasts_it(self, bench):
        """It ends with the commit."""
        kept = bench.keep(to=COUNT, hold_ns=1 * S)
        bench.disk_is_done = False
        handle = bench.send(
            Commit(bench.next_lock(), kept.token, (WriteItem(COUNT, datum("x")),), 0, keep=True)
        )
        bench.waiter(to=COUNT)
        bench.wait(3 * S, keep=["ann", "bob"])
        assert bench.lives(kept)
        assert bench.shard.next_deadline_ns() > bench.now_ns
        bench.finish_disk()

        assert bench.answers[handle].kept == NOT_KEPT
        assert not bench.lives(kept)

    def test_moves_with_a_stall_of_the_shard(self, bench):
        """As every deadline does."""
        kept = bench.keep(hold_ns=2 * S)
        bench.use(kept)
        bench.waiter()
        bench.now_ns += 10 * S
        bench.wait(1900 * MS, keep=["ann", "bob"])
        assert bench.lives(kept)
        bench.wait(200 * MS, keep=["ann", "bob"])

        assert not bench.lives(kept)


class TestSessions:
    def test_keep_alive_lists_and_frees_none(self, bench):
        """The client compares tokens: the locks that use them were never seen here."""
        kept = bench.keep()
        bench.next_lock()
        alive = bench.keep_alive("ann", view={0: 100})

        assert [(grant.lock, grant.token) for grant in alive.grants] == [(kept.lock, kept.token)]
        assert bench.lives(kept)
        assert bench.counter("orphans_freed") == 0

    def test_lease_runs_on_while_the_session_is_heard_of(self, bench):
        """A kept grant is held by nobody's thread, but it is held by a session."""
        kept = bench.keep()
        bench.wait(3 * TTL_NS, keep=["ann", "bob"])
        assert bench.lives(kept)

    def test_token_that_vanishes_leaves_it(self, bench):
        """Its process may only be cut off; the lease decides."""
        kept = bench.keep()
        bench.event(SessionSeen("ann", True))
        bench.event(SessionSeen("ann", False))
        assert bench.lives(kept)

    @pytest.mark.parametrize("used", [False, True])
    @pytest.mark.parametrize("end", [silent, goodbye, died], ids=lambda end: end.__name__)
    @pytest.mark.parametrize("later", [False, True], ids=["first block", "later block"])
    def test_commit_in_flight_of_a_session_that_ended_is_the_last(self, bench, later, end, used):
        """The page is gone: nobody may look for it, nor keep anything there."""
        if later:
            kept = bench.keep(to=COUNT)
            lock, token = bench.next_lock(), kept.token
            if used:
                bench.use(kept)
        else:
            for _ in range(ROW_MIN - 1):
                bench.block(to=COUNT)
            lock = bench.next_lock()
            token = bench.granted(lock, Item(Access.WRITE, *COUNT)).token
        bench.disk_is_done = False
        bench.send(Commit(lock, token, (WriteItem(COUNT, datum("x")),), 0, keep=True))
        end(bench, None)
        _, handle = bench.waiter(to=COUNT)
        bench.ask(ListLocks())
        bench.finish_disk()
        bench.disk_is_done = True
        bench.wait(50 * MS, keep=["bob"])

        assert bench.answers[handle].states[0].datum.body == b"x"
        assert not bench.shard.state.tenures.kept.by_number
        assert end is silent or "ann" not in bench.marks.cells

    def test_session_that_comes_back_begins_anew(self, bench):
        """Its old page is gone, and so is the row."""
        bench.keep(to=COUNT)
        bench.ask(Goodbye("ann"))
        bench.ask(Hello("ann", bench.shard.epoch, TTL_NS, "ann", "host", 1, False))

        assert bench.keep(to=COUNT).said == PLACES


class TestBounds:
    def fill(self, bench, session: str = "ann") -> list:
        """Let a session keep as many grants as it may."""
        return [
            bench.keep(session, to=slot(f"e{number}", "frame"), lane=number, hold_ns=2 * S)
            for number in range(KEPT_OF_SESSION_MAX)
        ]

    def test_oldest_idle_grant_of_a_session_makes_room(self, bench):
        """Another session's stay."""
        other = bench.keep("bob", to=slot("bobs", "frame"))
        kept = self.fill(bench)
        bench.use(kept[0])

        one_more = bench.keep(to=slot("more", "frame"))

        assert [number for number, one in enumerate(kept) if not bench.lives(one)] == [1]
        assert bench.lives(one_more)
        assert bench.lives(other)
        assert len(bench.marks.cells["ann"]) == KEPT_OF_SESSION_MAX

    def test_none_makes_room_while_all_are_in_use(self, bench):
        """A block in use is not recalled for a grant that nobody waits for."""
        kept = self.fill(bench)
        for one in kept:
            bench.use(one)
        for _ in range(ROW_MIN + 1):
            assert bench.block(to=slot("more", "frame")).said == NOT_KEPT

        assert all(bench.lives(one) for one in kept)
        assert not bench.shard.state.tenures.kept.recalled

    def test_one_that_a_block_begins_to_use_meanwhile_has_its_hold_limit(self, bench):
        """It is recalled as for a waiter: the limit runs from then on."""
        kept = self.fill(bench)
        bench.wait(1900 * MS, keep=["ann", "bob"])
        bench.marks.meanwhile = lambda: bench.use(kept[0])
        for _ in range(ROW_MIN):
            assert bench.block(to=slot("more", "frame")).said == NOT_KEPT
        bench.marks.meanwhile = lambda: None

        bench.wait(1900 * MS, keep=["ann", "bob"])
        assert bench.lives(kept[0])
        bench.wait(100 * MS, keep=["ann", "bob"])
        assert not bench.lives(kept[0])

    def test_grant_with_a_commit_in_flight_makes_no_room(self, bench):
        """It is in use whatever its mark says."""
        first = bench.keep(to=COUNT, lane=99)
        kept = self.fill_but_one(bench)
        bench.disk_is_done = False
        bench.send(
            Commit(bench.next_lock(), first.token, (WriteItem(COUNT, datum("x")),), 0, keep=True)
        )
        for _ in range(ROW_MIN):
            lock = bench.next_lock("ann", 98)
            grant = bench.granted(lock, item(Access.READ, "more", "frame"))
            said = bench.validate(lock, grant.token).kept
        bench.finish_disk()

        assert said >= PLACES
        assert bench.lives(first)
        assert not bench.lives(kept[0])

    def fill_but_one(self, bench) -> list:
        return [
            bench.keep(to=slot(f"e{number}", "frame"), lane=number)
            for number in range(KEPT_OF_SESSION_MAX - 1)
        ]

    def test_grants_of_a_shard_are_bounded(self, bench, monkeypatch):
        """No session's grants make room for another's."""
        assert tenures.KEPT_MAX == 4096
        monkeypatch.setattr(tenures, "KEPT_MAX", 3)
        kept = [bench.keep(to=slot(f"e{n}", "frame"), lane=n) for n in range(3)]
        for _ in range(ROW_MIN + 1):
            assert bench.block("bob", to=slot("bobs", "frame")).said == NOT_KEPT
        bench.ask(Release(kept[0].lock))

        assert bench.block("bob", to=slot("bobs", "frame")).said >= PLACES

    def test_habits_are_bounded(self, bench):
        """The oldest goes first."""
        habits = bench.shard.state.tenures.kept._habits
        bench.block()
        first = next(iter(habits))
        for number in range(HABITS_MAX):
            habits["?", (slot(f"e{number}"),)] = tenures._Habit()
            if len(habits) == HABITS_MAX:
                break
        bench.block(to=COUNT)

        assert len(habits) == HABITS_MAX
        assert first not in habits
