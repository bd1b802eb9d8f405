"""The client half of kept grants: which may be used again, what they show, what lets them go."""

from __future__ import annotations

from dataclasses import replace

import pytest
from client_bench import ANSWER, NOTHING, REQUEST, CellBench
from kept_parts import FakeMarks
from shard_bench import MS, TTL_NS, S, datum, item, lock_id, slot

from enact_dist.core.client.kept import Keeping
from enact_dist.core.client.plan import Phase
from enact_dist.core.protocol.datum import Token
from enact_dist.core.protocol.messages import (
    NOT_KEPT,
    PLACES,
    PROVE,
    Commit,
    Committed,
    EpochChanged,
    Fenced,
    Granted,
    KeepAlive,
    Outcome,
    PlacementMap,
    Refused,
    Release,
    SlotVersion,
    Validate,
    WriteItem,
)
from enact_dist.core.state.slots import INLINE_BYTES_MAX
from enact_dist.terms import Access

FRAME = slot(aspect="frame")
ITEMS = (item(Access.WRITE, "piece", "frame"), item(Access.READ, "other", "frame"))


class User:
    """A client that uses its kept grants as the link does, with marks that a test sets."""

    def __init__(self) -> None:
        self.cell = CellBench("s0")
        self.marks = FakeMarks()
        self.shard = self.cell.shards["s0"]
        self.shard.shard.state.tenures.kept.marks = self.marks
        self.client = self.cell.client("ann")
        self.core = self.client.core

    def begin(self, *, lane: int = 0, hold_ns: int = 60 * S):
        """Begin under a kept grant; None if there is none."""
        grant = self.core.kept.take(ITEMS)
        if grant is None:
            return None
        assert grant.token.number in self.marks.cells["ann"]
        return self.core.begin_kept(lane, grant, now_ns=self.cell.now_ns, hold_ns=hold_ns)

    def ask(self, *, lane: int = 0):
        """Ask for the lock, and for keeping its grant."""
        lock = self.client.begin(*ITEMS, lane=lane)
        lock.keeping = Keeping(ITEMS)
        return self.client.drive(lock)

    def leave(self, lock):
        """Look at the cell, and put the grant back or give it back."""
        grant = lock.keeping.take_grant()
        if grant is not None and grant.token.number in self.marks.cells.get("ann", ()):
            self.core.kept.put_back(grant)
        elif grant is not None:
            lock.releases.append(("s0", Release(grant.origin)))
        for shard, release in lock.take_releases():
            self.client._answer(shard, release)
        return grant

    def write(self, lock, text: str | None = "1"):
        self.client.finish(lock, (FRAME, text))
        return lock

    def kept(self):
        """Write twice, so that the grant is kept; return it."""
        for _ in range(2):
            lock = self.write(self.ask())
            assert lock.phase is Phase.COMMITTED
            self.leave(lock)
        assert list(self.core.kept.by_items) == [ITEMS]
        return self.core.kept.by_items[ITEMS]

    def sent(self, since: int) -> list[str]:
        return self.client.kinds_sent(since=since)


@pytest.fixture
def user() -> User:
    return User()


class TestPlan:
    @pytest.mark.parametrize(
        ("items", "keepable"),
        [
            (ITEMS, True),
            (ITEMS[:1], True),
            ((*ITEMS, item(Access.VIEW, "third", "frame")), False),
            ((item(Access.WRITE_EACH, "*", "frame"),), False),
            ((item(Access.VIEW, "piece", "frame"),), False),
            (tuple(item(Access.READ, f"e{number}", "frame") for number in range(17)), False),
        ],
        ids=["two", "one", "view beside", "pattern", "view", "many"],
    )
    def test_says_what_may_be_kept(self, user, items, keepable):
        """As the shard does."""
        assert user.core.plan(items).keepable is keepable

    def test_over_shards_nothing_is_kept(self):
        """A lock that holds at two shards takes them in their order."""
        cell = CellBench("a", "b")
        client = cell.client("ann")
        items = [item(Access.WRITE, cell.entity_on(shard), "frame") for shard in ("a", "b")]
        assert not client.core.plan(items).keepable
        assert client.core.plan(items[:1]).keepable


class TestTable:
    def test_one_thread_takes_a_grant(self, user):
        """The next one finds none, until it is put back."""
        grant = user.kept()

        assert user.core.kept.take(ITEMS) is grant
        assert user.core.kept.take(ITEMS) is None
        user.core.kept.put_back(grant)
        assert user.core.kept.take(ITEMS) is grant

    def test_other_requests_find_none(self, user):
        """A grant is found under exactly what was requested."""
        user.kept()
        assert user.core.kept.take(ITEMS[:1]) is None

    def test_restarted_shard_takes_its_own_with_it(self, user):
        """Grants of others stay."""
        grant = user.kept()
        user.core.kept.drop("elsewhere")
        assert user.core.kept.by_items == {ITEMS: grant}
        user.core.kept.drop("s0")
        assert not user.core.kept.by_items

    def test_forgotten_session_forgets_them(self, user):
        """`EpochChanged` and a `Welcome` of a new epoch come before any acknowledgement."""
        user.kept()
        hello = user.core.hello("s0")
        request = KeepAlive("ann", 1, user.core.sendings.next(user.cell.now_ns), (), b"")
        user.core.answered("s0", request, EpochChanged(2), user.cell.now_ns)
        assert not user.core.kept.by_items
        assert user.core.needs_hello("s0")
        assert hello.known_epoch == 1

    def test_keep_alive_says_which_live(self, user):
        """Those listed are believed in for longer, the others are over."""
        grant = user.kept()
        before_ns = grant.until_ns
        user.cell.wait(S)
        user.client.keep_alive()
        assert grant.until_ns >= before_ns + S - MS
        assert user.core.kept.by_items

        user.shard.hello("bob")
        user.shard.acquire(lock_id("bob"), item(Access.WRITE, "piece", "frame"))
        user.client.keep_alive()
        assert not user.core.kept.by_items

    def test_keep_alive_from_before_the_grant_says_nothing_of_it(self, user):
        """Its answer may have been made before the grant."""
        early = user.core.keep_alive("s0", user.cell.now_ns)
        answer = user.shard.ask(early)
        grant = user.kept()
        user.core.answered("s0", early, answer, user.cell.now_ns)
        assert user.core.kept.by_items == {ITEMS: grant}

    def test_other_placement_forgets_all(self, user):
        """They were granted under the one before; the same map again changes nothing."""
        grant = user.kept()
        user.core.learn_placement(user.core.placement)
        assert user.core.kept.by_items == {ITEMS: grant}
        user.core.learn_placement(PlacementMap(2, user.core.placement.shards, ()))
        assert not user.core.kept.by_items


class TestBegin:
    def test_without_a_message(self, user):
        """Held at once, under a lock of its own, with what was shown before."""
        grant, since = user.kept(), len(user.client.sent)
        lock = user.begin(lane=3)

        assert (lock.phase, lock.lock.lane, lock.lock.seq) == (Phase.HELD, 3, 1)
        assert [reading.state for reading in lock.states] == list(grant.states)
        assert lock.valid(user.cell.now_ns)
        assert user.sent(since) == []

    def test_hold_limit_is_its_own(self, user):
        """It counts from here, and not from the grant."""
        user.kept()
        user.cell.wait(S)
        user.client.keep_alive()
        lock = user.begin(hold_ns=100 * MS)
        assert lock.valid(user.cell.now_ns + 90 * MS)
        assert not lock.valid(user.cell.now_ns + 100 * MS)

    @pytest.mark.parametrize("why", ["epoch", "belief", "hold", "placement"])
    def test_refused(self, user, why):
        """The lock has to be asked for."""
        grant = user.kept()
        hold_ns = grant.hold_ns
        if why == "epoch":
            grant.token = Token(2, grant.token.number)
        elif why == "belief":
            user.cell.now_ns = grant.until_ns
        elif why == "placement":
            user.core.placement = PlacementMap(2, user.core.placement.shards, ())
        else:
            hold_ns += 1
        assert user.begin(hold_ns=hold_ns) is None
        assert not user.core.live_locks()

    def test_last_moment_of_belief(self, user):
        """A nanosecond before its end it may still begin."""
        grant = user.kept()
        user.cell.now_ns = grant.until_ns - 1
        assert user.begin(hold_ns=grant.hold_ns) is not None


class TestShows:
    @pytest.mark.parametrize("size", [3, INLINE_BYTES_MAX + 1], ids=["small", "large"])
    @pytest.mark.parametrize("file", ["", "payload"])
    def test_own_commit(self, user, size, file):
        """What was written is shown as its shard would show it."""
        user.kept()
        written = replace(datum("x" * size), stamp_ns=5, file=file)
        lock = user.begin()
        lock.finish({"s0": [WriteItem(FRAME, written)]}, give_up_ns=user.cell.now_ns + S)
        user.client.drive(lock)
        assert lock.phase is Phase.COMMITTED
        state, other = lock.keeping.take_grant().states

        assert (state.slot, state.version, state.stamp_ns) == (FRAME, 3, lock.position.stamp_ns)
        assert (state.size, state.captured_ns, state.same) == (size, 5, False)
        large = size > INLINE_BYTES_MAX
        assert state.large is large
        assert state.datum.body == (b"" if large else written.body)
        assert state.datum.file == file
        assert state.datum.size == (size if file or not large else 0)
        assert other.version == 0

    @pytest.mark.parametrize("size", [3, INLINE_BYTES_MAX + 1], ids=["small", "large"])
    def test_is_what_the_shard_shows(self, user, size):
        """Asked for anew, the states are the same."""
        user.kept()
        lock = user.write(user.begin(), "x" * size)
        states = lock.keeping.take_grant().states
        user.core.kept.by_items.clear()
        assert [reading.state for reading in user.ask().states] == list(states)

    def test_deleted(self, user):
        """A null with its reason."""
        user.kept()
        lock = user.write(user.begin(), None)
        state = lock.keeping.take_grant().states[0]
        assert (state.version, state.datum, state.null_reason) == (3, None, "DELETED")

    def test_next_block_reads_what_the_last_one_wrote(self, user):
        """Over several blocks, some of which end without a message."""
        user.kept()
        for number in range(6):
            lock = user.begin(lane=number % 2)
            if number % 3 == 2:
                assert lock.finish_kept(user.cell.now_ns)
            else:
                user.write(lock, f"v{number}")
            user.leave(lock)
        lock = user.begin()
        assert lock.states[0].state.datum.body == b"v4"
        assert user.shard.value(FRAME) == "v4"
        assert user.shard.counter("locks_granted") == 2


class TestEnds:
    def test_read_alone_sends_nothing(self, user):
        """Believed in until its end, it was held until its end."""
        user.kept()
        lock, since = user.begin(), len(user.client.sent)
        assert lock.finish_kept(user.cell.now_ns)
        user.leave(lock)
        assert (lock.phase, user.sent(since)) == (Phase.COMMITTED, [])
        assert user.core.kept.by_items
        assert not user.core.live_locks()

    def test_read_alone_without_belief_asks(self, user):
        """And keeps its grant if the shard confirms it."""
        user.kept()
        lock, since = user.begin(hold_ns=10 * MS), len(user.client.sent)
        user.cell.wait(20 * MS)
        assert not lock.finish_kept(user.cell.now_ns)
        user.client.finish(lock)
        assert (lock.phase, user.sent(since)) == (Phase.COMMITTED, ["Validate"])
        assert user.leave(lock) is not None
        assert user.core.kept.by_items

    def test_lock_that_was_asked_for_does_not_end_by_itself(self, user):
        """Its shard has to know."""
        assert not user.ask().finish_kept(user.cell.now_ns)

    def test_given_back_before_anything_was_sent(self, user):
        """Nothing happened: the grant stays, and no release is sent."""
        user.kept()
        lock, since = user.begin(), len(user.client.sent)
        lock.release()
        user.leave(lock)
        assert (lock.phase, user.sent(since)) == (Phase.RELEASED, [])
        assert user.core.kept.by_items

    def test_what_was_believed_meanwhile_is_kept(self, user):
        """Keep-alives during a block count for the grant that it leaves."""
        user.kept()
        lock = user.begin()
        for _ in range(3):
            user.cell.wait(TTL_NS // 2)
            user.client.keep_alive()
        assert lock.finish_kept(user.cell.now_ns)
        user.leave(lock)
        assert user.begin() is not None

    def test_recalled_meanwhile_is_given_back(self, user):
        """Its cell is empty: its first lock is released."""
        grant = user.kept()
        lock, since = user.begin(), len(user.client.sent)
        user.marks.in_use.add(("ann", grant.token.number))
        user.shard.hello("bob")
        handle = user.shard.send(
            user.shard.acquire_request(lock_id("bob"), item(Access.WRITE, "piece", "frame"))
        )
        assert lock.finish_kept(user.cell.now_ns)
        user.leave(lock)
        assert user.sent(since) == ["Release"]
        assert isinstance(user.shard.answers[handle], Granted)
        assert not user.core.kept.by_items

    def test_taken_away_while_it_is_used(self, user):
        """The next keep-alive does not list it; the cause can be asked for."""
        grant = user.kept()
        lock = user.begin()
        user.marks.in_use.add(("ann", grant.token.number))
        tenure = user.shard.shard.state.tenures.by_lock[grant.origin]
        list(user.shard.shard.state.tenures.take_away(tenure, "by hand", now_ns=user.shard.now_ns))
        since = len(user.client.sent)
        user.client.keep_alive()
        assert lock.phase is Phase.LOST
        shard, question = lock.ask_cause()
        lock.told_cause(user.client._answer(shard, question))
        assert lock.cause == "by hand"
        assert user.leave(lock) is None
        assert user.sent(since) == ["Validate"]

    @pytest.mark.parametrize("said", [NOT_KEPT, PROVE])
    def test_grant_that_is_over_leaves_nothing(self, user, said):
        """What was said of it stays known: the link may have to prove its locks."""
        user.marks.says = said
        for _ in range(2):
            lock = user.write(user.ask())
            assert user.leave(lock) is None
        assert lock.keeping.said == said

    @pytest.mark.parametrize("lost", [REQUEST, ANSWER])
    def test_commit_without_an_answer_leaves_no_grant(self, user, lost):
        """Nothing clear is known of it, even where the outcome becomes known."""
        user.kept()
        lock = user.begin()
        calls = iter([lost])
        user.client.lose = lambda _, request: (
            next(calls, NOTHING) if isinstance(request, Commit) else NOTHING
        )
        user.write(lock, "unknown at first")
        assert lock.phase is Phase.COMMITTED
        assert user.shard.value(FRAME) == "unknown at first"
        assert user.leave(lock) is None
        assert not user.core.kept.by_items

    def test_unknown_outcome_leaves_no_grant(self, user):
        """A late copy may still arrive: whoever locks next has to ask, which ends its token."""
        user.kept()
        lock = user.begin()
        user.client.lose = lambda _, request: (
            REQUEST if isinstance(request, Commit | Outcome) else NOTHING
        )
        user.client.finish(lock, (FRAME, "late"), give_up_s=0.1)
        late = next(r for _, r in reversed(user.client.sent) if isinstance(r, Commit))
        assert lock.phase is Phase.UNKNOWN
        assert user.leave(lock) is None
        user.client.lose = lambda *_: NOTHING
        user.client.keep_alive()
        user.write(user.ask(), "newer")

        assert isinstance(user.shard.ask(late), Fenced)
        assert user.shard.value(FRAME) == "newer"

    @pytest.mark.parametrize(
        ("answer", "phase"),
        [
            (lambda lock: Fenced(lock, "gone"), Phase.LOST),
            (lambda _: EpochChanged(2), Phase.UNKNOWN),  # another copy may have come before
            (lambda _: Refused("protocol", "no"), Phase.REFUSED),
        ],
        ids=["fenced", "epoch", "refused"],
    )
    def test_commit_that_did_not_happen_leaves_no_grant(self, user, answer, phase):
        """Whatever the reason; late copies are fenced by the release of this lock."""
        user.kept()
        lock = user.begin()
        lock.finish({"s0": [WriteItem(FRAME, datum())]}, give_up_ns=user.cell.now_ns + S)
        calls, _ = lock.next_calls(user.cell.now_ns)
        (shard, request) = calls[0]
        lock.answered(shard, request, answer(lock.lock), user.cell.now_ns)
        if lock.phase.busy:  # the outcome is asked for first
            user.shard.restart()
            user.shard.shard.state.tenures.kept.marks = user.marks
            user.client.drive(lock)
        assert lock.phase is phase
        assert user.leave(lock) is None
        assert not user.core.kept.by_items

    def test_validation_that_times_out_leaves_no_grant(self, user):
        """Nobody knows whether it has arrived."""
        user.kept()
        lock = user.begin(hold_ns=10 * MS)
        user.cell.wait(20 * MS)
        user.client.lose = lambda _, request: REQUEST if isinstance(request, Validate) else NOTHING
        user.client.finish(lock, give_up_s=0.1)
        assert lock.phase is Phase.UNREACHABLE
        assert user.leave(lock) is None

    def test_first_block_that_was_asked_about_may_keep_its_grant(self, user):
        """Where the commit was sent again and clearly answered."""
        user.write(user.ask())
        lock = user.ask()
        calls = iter([REQUEST])
        user.client.lose = lambda _, request: (
            next(calls, NOTHING) if isinstance(request, Commit) else NOTHING
        )
        user.write(lock)
        grant = user.leave(lock)
        assert (grant.origin, grant.place) == (lock.lock, 0)

    def test_held_ns_is_that_of_the_block(self, user):
        """And none under a lock that was asked for, which the shard knows better."""
        user.kept()
        lock = user.begin()
        user.cell.wait(30 * MS)
        user.write(lock)
        commits = [request for _, request in user.client.sent if isinstance(request, Commit)]
        assert [commit.held_ns for commit in commits] == [0, 0, 30 * MS]
        assert all(commit.keep for commit in commits)


def test_answer_to_one_that_was_never_kept_changes_nothing():
    """What a commit without `keep` is told of its grant is not looked at."""
    user = User()
    lock = user.client.drive(user.client.begin(*ITEMS))
    lock.finish({"s0": [WriteItem(FRAME, datum())]}, give_up_ns=user.cell.now_ns + S)
    ((shard, request),), _ = lock.next_calls(user.cell.now_ns)
    assert not request.keep
    position = user.shard.ask(request).position
    said = Committed(lock.lock, position, (SlotVersion(FRAME, 1),), PLACES)
    lock.answered(shard, request, said, user.cell.now_ns)
    assert (lock.phase, lock.keeping) == (Phase.COMMITTED, None)
