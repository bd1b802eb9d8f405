"""The client half of a lock: lost answers, restarts and belief, and never guessing."""

from __future__ import annotations

from dataclasses import replace

import pytest
from client_bench import ANSWER, NOTHING, REQUEST, CellBench, ClientBench
from shard_bench import MS, TTL_NS, S, item, slot

from enact_dist.core.client.plan import Phase
from enact_dist.core.protocol.messages import (
    Acquire,
    AspectEntry,
    Commit,
    Granted,
    Outcome,
    Refused,
    Register,
)
from enact_dist.terms import Access

R, W, V, WE = Access.READ, Access.WRITE, Access.VIEW, Access.WRITE_EACH


@pytest.fixture
def cell() -> CellBench:
    return CellBench("s0")


class TestLostAnswers:
    @pytest.mark.parametrize("half", [REQUEST, ANSWER])
    def test_acquire_is_asked_again_with_the_same_id(self, cell, half):
        """Silence is no refusal: the same lock is asked for until it is answered."""
        ann = cell.client("ann")
        lost = iter([half, half])
        ann.lose = lambda _shard, request: (
            next(lost, NOTHING) if isinstance(request, Acquire) else NOTHING
        )
        lock = ann.locked(item(W))

        assert lock.phase is Phase.HELD
        assert {request.lock for _, request in ann.sent if isinstance(request, Acquire)} == {
            lock.lock
        }
        assert len(cell.shards["s0"].shard.state.tenures.by_lock) == 1

    @pytest.mark.parametrize(
        ("half", "sent"),
        [(REQUEST, ["Commit", "Outcome", "Commit"]), (ANSWER, ["Commit", "Outcome"])],
    )
    def test_commit_without_an_answer_is_asked_about(self, cell, half, sent):
        """The client asks for the outcome, and sends the data again only if they never came."""
        ann = cell.client("ann")
        lock = ann.locked(item(W))
        lost = iter([half])
        ann.lose = lambda _shard, request: (
            next(lost, NOTHING) if isinstance(request, Commit) else NOTHING
        )
        since = len(ann.sent)
        ann.finish(lock, (slot(), "1"))

        assert ann.kinds_sent(since=since) == sent
        assert lock.phase is Phase.COMMITTED
        assert cell.shards["s0"].shard.state.slots[slot()].version == 1

    @pytest.mark.parametrize("refused", [Outcome, Commit])
    def test_refusal_of_a_busy_shard_says_nothing_of_a_commit(self, cell, refused, monkeypatch):
        """The answer was lost and the question refused: the client asks on, and learns the truth."""
        ann = cell.client("ann")
        lock = ann.locked(item(W))
        lost = iter([ANSWER] if refused is Outcome else [])
        ann.lose = lambda _shard, request: (
            next(lost, NOTHING) if isinstance(request, Commit) else NOTHING
        )
        answer, busy = ann._answer, iter([True, True])

        def refusing(shard: str, request: object) -> object:
            if isinstance(request, refused) and next(busy, False):
                ann.sent.append((shard, request))
                return Refused("overload", "too many requests wait")
            return answer(shard, request)

        monkeypatch.setattr(ann, "_answer", refusing)
        ann.finish(lock, (slot(), "1"))

        assert lock.phase is Phase.COMMITTED
        assert [version.version for version in lock.versions] == [1]
        assert cell.shards["s0"].shard.state.slots[slot()].version == 1

    def test_commit_that_nobody_answers_is_unknown(self, cell):
        """Past the deadline the client says that it does not know, and nothing else."""
        ann = cell.client("ann")
        lock = ann.locked(item(W))
        ann.lose = lambda _shard, request: (
            ANSWER if isinstance(request, Commit | Outcome) else NOTHING
        )
        ann.finish(lock, (slot(), "1"), give_up_s=1.0)

        assert lock.phase is Phase.UNKNOWN
        assert cell.shards["s0"].value() == "1"

    def test_silent_shard_is_unreachable(self, cell):
        """A lock that nobody answers ends by naming the shard."""
        ann = cell.client("ann")
        ann.lose = lambda _shard, _request: REQUEST
        lock = ann.locked(item(W), wait_s=0.5)

        assert (lock.phase, lock.silent_shard) == (Phase.UNREACHABLE, "s0")

    def test_outcome_in_flight_is_asked_again(self, cell):
        """Pending is no answer yet: the client waits for the disk."""
        ann = cell.client("ann")
        lock = ann.locked(item(W))
        shard = cell.shards["s0"]
        shard.disk_is_done = False

        def lose(_shard: str, request: object) -> str:
            asked = [kind for kind in ann.kinds_sent() if kind == "Outcome"]
            if isinstance(request, Outcome) and len(asked) > 2:
                shard.disk_is_done = True
                shard.finish_disk()
            return NOTHING

        ann.lose = lose
        ann.finish(lock, (slot(), "1"))

        assert lock.phase is Phase.COMMITTED
        assert ann.kinds_sent().count("Commit") == 1


class TestRestart:
    def test_held_lock_is_lost(self, cell):
        """A new epoch ends every lock with a grant of the old one."""
        ann = cell.client("ann")
        lock = ann.locked(item(W))
        cell.shards["s0"].restart()
        ann.keep_alive()

        assert lock.phase is Phase.LOST
        assert "restarted" in lock.cause

    def test_waiting_lock_goes_on_in_the_new_epoch(self, cell):
        """A lock that was not granted yet is asked for again, under its id."""
        ann, bob = cell.client("ann"), cell.client("bob")
        ann.locked(item(W))
        lock = bob.begin(item(W), wait_s=20.0)
        bob.step(lock)
        cell.shards["s0"].restart()
        ann.keep_alive()
        ann.keep_alive()
        bob.drive(lock)

        assert lock.phase is Phase.HELD

    def test_client_whose_first_welcome_was_lost_ends_the_grace_too(self, cell):
        """A session that is on disk but never got an answer acknowledges the epoch it finds."""
        ann = cell.client("ann")
        bob = ClientBench(cell, "bob")
        bob.lose = lambda _shard, _request: ANSWER
        bob.call("s0", bob.core.hello("s0"))
        bob.lose = lambda _shard, _request: NOTHING
        cell.shards["s0"].restart()
        ann.keep_alive()
        ann.keep_alive()
        bob.call("s0", bob.core.hello("s0"))
        lock = bob.locked(item(W))

        assert lock.phase is Phase.HELD
        assert bob.kinds_sent() == ["Hello", "Hello", "Hello", "Acquire"]

    @pytest.mark.parametrize("epochs", [(1_700_000_000_000, 1_700_000_100), (9, 1_700_000_000_000)])
    def test_shard_that_got_or_lost_its_folder_has_restarted(self, epochs):
        """Its epochs count milliseconds without a folder and seconds with one: both are new."""
        cell = CellBench("s0")
        cell.shards["s0"].restart(epoch=epochs[0])
        ann = cell.client("ann")
        before = ann.locked(item(W))
        cell.shards["s0"].restart(epoch=epochs[1])
        ann.keep_alive()
        after = ann.locked(item(W), lane=1, wait_s=20.0)

        assert (before.phase, after.phase) == (Phase.LOST, Phase.HELD)
        assert ann.core.epoch("s0") == epochs[1]

    def test_commit_that_never_arrived_is_lost(self, cell):
        """In the new epoch an unseen commit can never come true any more."""
        ann = cell.client("ann")
        lock = ann.locked(item(W))

        def lose(_shard: str, request: object) -> str:
            if isinstance(request, Commit):
                cell.shards["s0"].restart()
                return REQUEST
            return NOTHING

        ann.lose = lose
        ann.finish(lock, (slot(), "1"))

        assert lock.phase is Phase.LOST
        assert "restarted before the commit arrived" in lock.cause
        assert cell.shards["s0"].value() is None

    def test_commit_that_was_kept_is_committed(self, cell):
        """In the new epoch the record of the old one still answers."""
        ann = cell.client("ann")
        lock = ann.locked(item(W))

        def lose(_shard: str, request: object) -> str:
            if isinstance(request, Commit):
                cell.shards["s0"].ask(request)
                cell.shards["s0"].restart()
                return REQUEST
            return NOTHING

        ann.lose = lose
        ann.finish(lock, (slot(), "1"))

        assert lock.phase is Phase.COMMITTED

    @pytest.mark.parametrize(("configured", "then"), [("os", "volatile"), ("volatile", "os")])
    def test_durability_counts_under_which_a_commit_was_sent(self, cell, configured, then):
        """A restart with another durability changes nothing about what was recorded before it."""
        shard = cell.shards["s0"]
        ann = cell.client("ann")
        ann.call("s0", Register("ann", (), (AspectEntry("late", "int", configured),)))
        lock = ann.locked(item(W, aspect="late"))

        def lose(_shard: str, request: object) -> str:
            if isinstance(request, Commit):
                shard.settings = replace(shard.settings, aspects=(AspectEntry("late", "", then),))
                shard.restart()
                for _ in range(2):  # the client greets before it asks for the outcome
                    ann.keep_alive()
                return REQUEST
            return NOTHING

        ann.lose = lose
        ann.finish(lock, (slot(aspect="late"), "1"))

        assert lock.phase is (Phase.LOST if configured == "os" else Phase.UNKNOWN)

    def test_commit_that_a_restarted_shard_refuses_may_have_come_before(self, cell):
        """Its copy was applied in the epoch before, and the answer to that was lost."""
        shard = cell.shards["s0"]
        ann = cell.client("ann")
        ann.call("s0", Register("ann", (), (AspectEntry("late", "int", "volatile"),)))
        lock = ann.locked(item(W, aspect="late"))

        def copy(_shard: str, request: object) -> str:
            if isinstance(request, Commit) and shard.value(slot(aspect="late")) is None:
                shard.ask(request)
                assert shard.value(slot(aspect="late")) is not None
                shard.restart()
            return NOTHING

        ann.lose = copy
        ann.finish(lock, (slot(aspect="late"), "1"))

        assert lock.phase is Phase.UNKNOWN
        assert lock.finishing is not None
        assert lock.finishing.known_in

    def test_shard_that_lost_its_folder_knows_nothing_of_a_commit(self, cell):
        """Its record went with the folder: nothing says whether others have read the data."""
        shard = cell.shards["s0"]
        ann = cell.client("ann")
        lock = ann.locked(item(W))

        def lose(_shard: str, request: object) -> str:
            if isinstance(request, Commit):
                shard.ask(request)
                shard.log.clear()
                shard.restart(epoch=1_700_000_000_000)
                for _ in range(2):
                    ann.keep_alive()
                return REQUEST
            return NOTHING

        ann.lose = lose
        ann.finish(lock, (slot(), "1"))

        assert lock.phase is Phase.UNKNOWN

    @pytest.mark.parametrize("durability", ["volatile", "os"])
    def test_aspect_registered_since_the_greeting_counts_as_what_it_is(self, cell, durability):
        """Whether a restart takes the record of its commit depends on how it was registered."""
        ann = cell.client("ann")
        ann.call("s0", Register("ann", (), (AspectEntry("late", "int", durability),)))
        lock = ann.locked(item(W, aspect="late"))
        ann.lose = lambda _shard, _request: REQUEST
        ann.finish(lock, (slot(aspect="late"), "1"), give_up_s=1.0)

        assert lock.phase is Phase.UNKNOWN
        assert lock.finishing.known_in == (1 if durability == "volatile" else 0)

    def test_grant_of_an_epoch_that_is_over_is_not_taken(self, cell):
        """A late grant is no grant: the client knows a newer epoch."""
        ann = cell.client("ann")
        lock = ann.begin(item(W))
        ((shard, request),), _ = lock.next_calls(cell.now_ns)
        late = cell.shards["s0"].ask(request)
        assert isinstance(late, Granted)
        cell.shards["s0"].restart()
        ann.keep_alive()

        lock.answered(shard, request, late, cell.now_ns)

        assert lock.phase is Phase.ACQUIRING
        assert not lock.valid(cell.now_ns)


class TestBelief:
    def test_belief_counts_from_sending(self, cell):
        """The answer came late; the belief ends a TTL after the request was sent, less drift."""
        ann = cell.client("ann")
        lock = ann.begin(item(W))
        sent_ns = cell.now_ns
        ((shard, request),), _ = lock.next_calls(sent_ns)
        answer = cell.shards["s0"].ask(request)
        lock.answered(shard, request, answer, sent_ns + TTL_NS // 2)

        assert lock.valid(sent_ns + TTL_NS * 98 // 100 - 1)
        assert not lock.valid(sent_ns + TTL_NS * 98 // 100)

    def test_belief_ends_with_the_hold_limit(self, cell):
        """Renewal does not make a lock longer than it was asked for."""
        ann = cell.client("ann")
        lock = ann.locked(item(W), hold_s=1.0)
        begun_ns = cell.now_ns
        cell.wait(S // 2)
        ann.keep_alive()

        assert lock.valid(begun_ns + S * 98 // 100 - 10 * MS)
        assert not lock.valid(begun_ns + S)

    def test_hold_limit_runs_from_the_grant_whose_answer_was_lost(self, cell):
        """The shard has counted since then; a later answer to the same lock gives no new time."""
        ann = cell.client("ann")
        lock = ann.begin(item(W), hold_s=1.0)
        begun_ns = cell.now_ns
        ((shard, request),), _ = lock.next_calls(begun_ns)
        cell.shards["s0"].ask(request)
        cell.wait(S * 6 // 10)
        lock.answered(shard, request, None, cell.now_ns)
        _, again_ns = lock.next_calls(cell.now_ns)
        cell.wait(again_ns - cell.now_ns)
        ((shard, again),), _ = lock.next_calls(cell.now_ns)

        lock.answered(shard, again, cell.shards["s0"].ask(again), cell.now_ns)

        assert lock.phase is Phase.HELD
        assert lock.valid(begun_ns + S * 98 // 100 - 10 * MS)
        assert not lock.valid(begun_ns + S)

    def test_keep_alive_prolongs_the_belief(self, cell):
        """What the shard has renewed may be believed in for longer."""
        ann = cell.client("ann")
        lock = ann.locked(item(W))
        for _ in range(8):
            cell.wait(TTL_NS // 4)
            ann.keep_alive()

        assert lock.valid(cell.now_ns + TTL_NS // 2)

    def test_belief_that_ran_out_is_not_a_loss(self, cell):
        """After silence the client asks; if the shard still holds it, all is well."""
        ann = cell.client("ann")
        lock = ann.locked(item(W))
        cell.now_ns += 2 * TTL_NS
        assert not lock.valid(cell.now_ns)
        ann.keep_alive()

        assert lock.valid(cell.now_ns)

    def test_grant_that_the_shard_lists_no_more_is_lost(self, cell):
        """A lease that ended at the shard ends at the client."""
        ann = cell.client("ann")
        lock = ann.locked(item(W))
        cell.wait(TTL_NS + 100 * MS)
        ann.keep_alive()

        assert lock.phase is Phase.LOST

    def test_keep_alive_sent_before_the_grant_proves_nothing(self, cell):
        """An answer about an older moment does not take a newer lock away."""
        ann = cell.client("ann")
        request = ann.core.keep_alive("s0", cell.now_ns)
        answer = cell.shards["s0"].ask(request)
        lock = ann.locked(item(W))

        ann.core.answered("s0", request, answer, cell.now_ns)

        assert lock.phase is Phase.HELD
