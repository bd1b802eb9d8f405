"""The client half of grants that stay without common memory: what word of a recall finds."""

from __future__ import annotations

import pytest
from client_bench import ANSWER, NOTHING, CellBench
from shard_bench import MS, TTL_NS, S, item, lock_id, slot

from enact_dist.core.client.kept import Keeping
from enact_dist.core.client.plan import Phase
from enact_dist.core.protocol.messages import (
    FAR,
    Commit,
    Granted,
    KeepAlive,
    Outcome,
    Release,
    WriteItem,
)
from enact_dist.terms import Access

FRAME = slot(aspect="frame")
ITEMS = (item(Access.WRITE, "piece", "frame"),)
SLICE_NS = 900 * MS


class FarUser:
    """A client on another host, which does what the link does: between its steps anything comes."""

    def __init__(self) -> None:
        self.cell = CellBench("s0")
        self.shard = self.cell.shards["s0"]
        self.shard.hello("bob")
        self.client = self.cell.client("ann")
        self.core = self.client.core
        self.asked = None

    def listen(self) -> None:
        """Ask for word of recalls."""
        question = self.core.keep_alive("s0", self.cell.now_ns, wait_ns=SLICE_NS)
        assert isinstance(question, KeepAlive)
        self.asked = question, self.shard.send(question)

    def hears(self) -> bool:
        """Take the answer, if there is one, and send what is given back."""
        assert self.asked is not None
        question, handle = self.asked
        answer = self.shard.answers.get(handle)
        if answer is None:
            return False
        self.core.answered("s0", question, answer, self.cell.now_ns)
        self.send_given_back()
        return True

    def send_given_back(self) -> None:
        for shard, release in self.core.kept.given_back:
            self.client._answer(shard, release)
        self.core.kept.given_back.clear()

    def begin(self, *, lane: int = 0, hold_ns: int = 60 * S):
        """Begin under a kept grant; None if there is none."""
        grant = self.core.kept.take(ITEMS)
        if grant is None:
            return None
        return self.core.begin_kept(lane, grant, now_ns=self.cell.now_ns, hold_ns=hold_ns)

    def ask(self, *, lane: int = 0):
        """Ask for the lock, and for keeping its grant."""
        lock = self.client.begin(*ITEMS, lane=lane)
        lock.keeping = Keeping(ITEMS)
        return self.client.drive(lock)

    def write(self, lock, text: str = "1"):
        self.client.finish(lock, (FRAME, text))
        self.send_given_back()
        return lock

    def kept(self):
        """Listen, and write until the grant stays; return it."""
        self.listen()
        for _ in range(2):
            assert self.write(self.ask()).phase is Phase.COMMITTED
        return self.core.kept.by_items[ITEMS]

    def waiter(self) -> int:
        """Let another session ask for the datum; return the handle of its answer."""
        lock = lock_id("bob", 0, self.shard.next_count("seqs"))
        return self.shard.send(self.shard.acquire_request(lock, *ITEMS))

    def granted(self, handle: int) -> bool:
        return isinstance(self.shard.answers.get(handle), Granted)


@pytest.fixture
def user() -> FarUser:
    return FarUser()


class TestUse:
    def test_update_is_one_call_and_a_read_none(self, user):
        """The first two locks ask; from then on only commits are sent."""
        grant = user.kept()
        assert grant.far
        since = len(user.client.sent)
        user.write(user.begin(), "2")
        lock = user.begin()
        assert lock.states[0].state.datum.body == b"2"
        assert lock.finish_kept(user.cell.now_ns)

        assert user.client.kinds_sent(since=since) == ["Commit"]
        assert user.core.kept.by_items == {ITEMS: grant}

    def test_one_thread_uses_it(self, user):
        """The other asks, and is granted when that block ends."""
        user.kept()
        lock = user.begin()
        assert user.begin(lane=1) is None
        user.write(lock)
        assert user.begin(lane=1) is not None

    def test_exception_in_a_block_leaves_it(self, user):
        """Nothing was sent, so all is as it was."""
        grant = user.kept()
        user.begin().release()
        assert user.core.kept.by_items == {ITEMS: grant}

    def test_lease_that_is_over_asks(self, user):
        """A block begins only while the lease is believed in, and ends alone only then."""
        user.kept()
        lock = user.begin()
        user.cell.wait(TTL_NS - S)
        assert lock.valid(user.cell.now_ns)
        user.cell.wait(S)
        assert not lock.finish_kept(user.cell.now_ns)
        lock.release()
        assert user.begin() is None


class TestWord:
    def test_of_an_idle_grant(self, user):
        """It is given back at once."""
        user.kept()
        waiter = user.waiter()
        assert not user.granted(waiter)
        assert user.hears()

        assert user.granted(waiter)
        assert user.begin() is None

    @pytest.mark.parametrize("how", ["write", "read", "exception"])
    def test_in_a_block(self, user, how):
        """It is given back with the block; until then the block goes on."""
        user.kept()
        lock, waiter = user.begin(), user.waiter()
        assert user.hears()
        assert not user.granted(waiter)
        assert lock.valid(user.cell.now_ns)
        if how == "write":
            user.write(lock, "2")
            assert lock.phase is Phase.COMMITTED
        elif how == "read":
            assert lock.finish_kept(user.cell.now_ns)
        else:
            lock.release()
        user.send_given_back()

        assert user.granted(waiter)
        assert user.begin() is None
        assert not user.core.kept.recalled

    def test_between_a_commit_and_its_answer(self, user):
        """The answer says that the grant stays; what was heard meanwhile counts."""
        user.kept()
        lock = user.begin()
        writes = {"s0": [WriteItem(FRAME, None)]}
        lock.finish(writes, give_up_ns=user.cell.now_ns + 10 * S)
        ((shard, commit),), _ = lock.next_calls(user.cell.now_ns)
        answer = user.shard.ask(commit)
        assert answer.kept == FAR
        waiter = user.waiter()
        assert user.hears()
        assert not user.granted(waiter)
        lock.answered(shard, commit, answer, user.cell.now_ns)
        assert user.begin() is None
        user.send_given_back()

        assert user.granted(waiter)

    def test_between_a_commit_and_its_outcome(self, user):
        """The outcome says nothing of the grant, so the next question brings word again."""
        user.kept()
        lock, waiters = user.begin(), []

        def lose(_, request):
            if isinstance(request, Commit) and not waiters:
                return ANSWER
            return NOTHING

        user.client.lose = lose
        lock.finish({"s0": [WriteItem(FRAME, None)]}, give_up_ns=user.cell.now_ns + 10 * S)
        user.client.step(lock)
        waiters.append(user.waiter())
        assert user.hears()
        assert not user.granted(waiters[0])
        user.write(lock)
        assert lock.phase is Phase.COMMITTED
        user.listen()
        user.hears()

        assert user.granted(waiters[0])

    def test_of_a_grant_that_was_forgotten(self, user):
        """A commit without an answer forgets the grant; word of it gives it back."""
        user.kept()
        lock = user.begin()
        ends = Commit, Outcome
        user.client.lose = lambda _, request: ANSWER if isinstance(request, ends) else NOTHING
        lock.finish({"s0": [WriteItem(FRAME, None)]}, give_up_ns=user.cell.now_ns + 50 * MS)
        user.client.drive(lock)
        assert lock.phase is Phase.UNKNOWN
        assert user.begin() is None
        waiter = user.waiter()
        assert not user.granted(waiter)
        user.hears()

        assert user.granted(waiter)

    def test_that_was_lost_comes_with_the_next_keep_alive(self, user):
        """The grant is believed in no longer than its last keep-alive without such word."""
        grant = user.kept()
        waiter, until_ns = user.waiter(), grant.until_ns
        user.cell.wait(S // 2)
        user.client.keep_alive()
        assert grant.until_ns >= until_ns
        assert user.core.kept.by_items == {}
        user.send_given_back()

        assert user.granted(waiter)

    def test_says_what_it_has_heard(self, user):
        """So that the shard does not answer again and again while a block lasts."""
        grant = user.kept()
        lock = user.begin()
        user.waiter()
        user.hears()
        user.listen()
        assert user.asked[0].heard == (grant.token.number,)
        assert not user.hears()
        user.write(lock)
        user.listen()
        assert user.asked[0].heard == ()

    def test_release_that_is_lost_is_repeated(self, user):
        """The shard lists the grant as recalled as long as it lives."""
        user.kept()
        waiter = user.waiter()
        user.client.lose = lambda _, request: "request" if isinstance(request, Release) else NOTHING
        user.hears()
        assert not user.granted(waiter)
        user.client.lose = lambda *_: NOTHING
        user.listen()
        user.hears()

        assert user.granted(waiter)

    def test_is_not_needed_for_a_grant_that_the_client_does_not_know(self, user):
        """The answer that said that it stays was lost; the next sign of life finds it."""
        grant = user.kept()
        user.core.kept.by_items.clear()
        user.client.keep_alive()
        assert [release.lock for _, release in user.core.kept.given_back] == [grant.origin]
        user.send_given_back()
        user.client.keep_alive()
        assert not user.core.kept.given_back
        assert user.granted(user.waiter())

    def test_leaves_what_a_block_uses(self, user):
        """A far grant in use is in no table, and known all the same."""
        user.kept()
        lock = user.begin()
        user.client.keep_alive()
        assert not user.core.kept.given_back
        lock.release()
        user.client.keep_alive()
        assert not user.core.kept.given_back


class TestLeft:
    def test_of_another_epoch(self, user):
        """A restarted shard takes what was heard, too."""
        user.kept()
        lock = user.begin()
        user.waiter()
        user.hears()
        assert user.core.kept.recalled
        user.core.kept.drop("s0")
        assert not user.core.kept.recalled
        assert lock.valid(user.cell.now_ns)

    def test_rests_for_two_slices(self, user):
        """What nobody locks any more is given back, so that it stands in nobody's way."""
        user.kept()
        user.core.kept.rest("s0")
        user.begin().release()
        user.core.kept.rest("s0")
        assert user.core.far("s0")
        user.core.kept.rest("elsewhere")
        user.core.kept.rest("s0")
        assert not user.core.far("s0")
        user.send_given_back()

        assert user.granted(user.waiter())

    def test_in_use_counts_as_kept(self, user):
        """A session listens while a block uses its far grant."""
        user.kept()
        lock = user.begin()
        assert user.core.far("s0")
        assert not user.core.far("elsewhere")
        lock.release()
