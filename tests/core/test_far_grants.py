"""Kept grants of sessions that share no memory with the shard: word of a recall, and what ends them."""

from __future__ import annotations

import pytest
from kept_parts import FRAME, KeepingBench, Kept
from shard_bench import MS, TTL_NS, S, item, slot

from enact_dist.core.protocol.messages import (
    FAR,
    NOT_KEPT,
    PROVE,
    Alive,
    Break,
    Committed,
    EpochChanged,
    Fenced,
    Goodbye,
    Granted,
    KeepAlive,
    ListLocks,
    Release,
)
from enact_dist.core.protocol.records import Drain
from enact_dist.core.state.tenure import KEPT_OF_SESSION_MAX, ROW_MIN
from enact_dist.terms import Access

COUNT = slot()
HOLD_NS = 60 * S
SLICE_NS = 900 * MS


class FarBench(KeepingBench):
    """A shard that shares no memory with any client: nobody's marks may be asked for."""

    def __init__(self) -> None:
        super().__init__()
        self.marks.says = PROVE

    def listen(self, session: str = "ann", *heard: Kept, wait_ns: int = SLICE_NS) -> int:
        """Ask for word of recalls; return the handle of the answer."""
        numbers = tuple(kept.token.number for kept in heard)
        count = self.next_count(session)
        return self.send(
            KeepAlive(session, self.shard.epoch, count, (), b"", wait_ns=wait_ns, heard=numbers)
        )

    def word(self, handle: int) -> list[tuple[int, bool]] | None:
        """Return the numbers that an answer lists, each with whether it is recalled."""
        answer = self.answers.get(handle)
        if answer is None:
            return None
        assert isinstance(answer, Alive), answer
        return [(grant.token.number, grant.recalled) for grant in answer.grants]


BENCH = FarBench
SESSIONS = "ann", "bob"


class TestStays:
    def test_session_that_listens_keeps_without_a_cell(self, bench):
        """As often in a row as on one host; until it listens, the answer says how to."""
        said = [bench.block().said for _ in range(ROW_MIN)]
        bench.listen()
        said.append(bench.block().said)

        assert said == [NOT_KEPT] * (ROW_MIN - 1) + [PROVE, FAR]
        assert bench.marks.log == []
        assert bench.counter("grants_kept") == 1

    def test_session_that_listens_no_more_keeps_no_further_grant(self, bench):
        """Word would come late."""
        handle = bench.listen()
        bench.block()
        bench.wait(SLICE_NS)

        assert bench.word(handle) == []
        assert bench.block().said == PROVE

    def test_later_blocks_commit_under_it(self, bench):
        """With a higher seq, and never an older copy."""
        bench.listen()
        kept, late = bench.keep(), bench.next_lock(lane=1)
        newer = bench.next_lock(lane=1)

        assert bench.end(newer, kept.token, "2").kept == FAR
        assert isinstance(bench.end(late, kept.token, "1"), Fenced)
        assert bench.validate(bench.next_lock(lane=2), kept.token).kept == FAR

    def test_bound_of_a_session(self, bench):
        """The oldest one is recalled, and the newest does not stay."""
        handle = bench.listen()
        kept = [bench.keep(to=slot(f"e{number}", "frame")) for number in range(KEPT_OF_SESSION_MAX)]
        bench.block("ann", to=FRAME)
        assert bench.block("ann", to=FRAME).said == NOT_KEPT
        assert (kept[0].token.number, True) in bench.word(handle)


class TestRecall:
    def test_word_goes_to_who_listens(self, bench):
        """The waiter stands in the queue until the grant is given back."""
        handle = bench.listen()
        kept = bench.keep()
        _, waiter = bench.waiter()

        assert bench.word(handle) == [(kept.token.number, True)]
        assert bench.answers.get(waiter) is None
        bench.ask(Release(kept.lock))
        assert isinstance(bench.answers[waiter], Granted)
        assert (bench.counter("grants_recalled"), bench.counter("grants_revoked")) == (1, 0)

    def test_who_listens_later_hears_at_once_and_once(self, bench):
        """Word may be lost; what was heard is not said again to who waits for the next."""
        first = bench.listen()
        kept = bench.keep()
        bench.waiter()
        assert bench.word(first)
        assert bench.word(bench.listen()) == [(kept.token.number, True)]

        third = bench.listen("ann", kept)
        assert bench.word(third) is None
        other = bench.keep(to=COUNT, lane=1)
        bench.waiter("bob", to=COUNT)
        assert bench.word(third) == [(kept.token.number, True), (other.token.number, True)]

    def test_every_keep_alive_repeats_it(self, bench):
        """Whoever does not listen any more hears of it then."""
        bench.listen()
        bench.keep()
        bench.waiter()

        assert [grant.recalled for grant in bench.keep_alive("ann").grants] == [True]

    @pytest.mark.parametrize("how", ["commit", "validate", "again"])
    def test_block_ends_it(self, bench, how):
        """The commit of a block that was begun before is taken, and its grant is over."""
        bench.listen()
        kept, lock = bench.keep(), bench.next_lock(lane=1)
        _, waiter = bench.waiter()
        if how == "validate":
            answer = bench.validate(lock, kept.token)
        else:
            answer = bench.end(lock, kept.token, "last")
        if how == "again":
            answer = bench.end(lock, kept.token, "last")
            assert isinstance(answer, Committed)

        assert answer.kept == NOT_KEPT
        assert isinstance(bench.answers[waiter], Granted)

    def test_repeated_answer_says_that_it_lives(self, bench):
        """Recalled or not: its client gives it back when it hears of that."""
        bench.listen()
        kept, lock = bench.keep(), bench.next_lock(lane=1)
        bench.end(lock, kept.token, "2")
        bench.waiter()

        assert bench.end(lock, kept.token, "2").kept == FAR

    def test_commit_in_flight_is_not_released(self, bench):
        """A Release that crosses it changes nothing: the commit ends the recalled grant."""
        bench.listen()
        kept, lock = bench.keep(to=COUNT), bench.next_lock(lane=1)
        bench.disk_is_done = False
        bench.end(lock, kept.token, "last", to=COUNT)
        _, waiter = bench.waiter(to=COUNT)
        bench.ask(Release(kept.lock))
        assert bench.answers.get(waiter) is None
        bench.finish_disk()

        assert bench.answers[waiter].states[0].datum.body == b"last"

    def test_late_release_ends_no_other_grant(self, bench):
        """It names the first lock of a grant that is over."""
        bench.listen()
        kept = bench.keep()
        bench.ask(Release(kept.lock))
        again = bench.block()
        assert again.said == FAR
        bench.ask(Release(kept.lock))

        assert bench.end(bench.next_lock(), again.token).kept == FAR

    def test_each_recall_doubles_the_row(self, bench):
        """As on one host: contended data are not kept for long."""
        found = []
        for _ in range(4):
            bench.listen()
            count = 1
            while (kept := bench.block()).said != FAR:
                count += 1
            found.append(count)
            waiter, _ = bench.waiter()
            bench.ask(Release(kept.lock))
            bench.ask(Release(waiter))

        assert found == [2, 4, 8, 16]

    def test_listing_shows_what_is_known(self, bench):
        """Kept and recalled; whether a block uses it nobody knows here."""
        bench.listen()
        bench.keep()
        shown = [bench.ask(ListLocks()).holders[0].kept]
        bench.waiter()
        shown.append(bench.ask(ListLocks()).holders[0].kept)

        assert shown == ["far", "recalled"]


class TestEnds:
    def test_client_that_does_not_answer_holds_others_up_until_its_lease_ends(self, bench):
        """As any lock of it would."""
        bench.listen()
        bench.keep()
        _, waiter = bench.waiter()
        bench.wait(TTL_NS - MS, keep=("bob",))
        assert bench.answers[waiter].place == 1
        lock = bench.answers[waiter].lock
        again = bench.send(bench.acquire_request(lock, item(Access.WRITE, "piece", "frame")))
        bench.wait(100 * MS, keep=("bob",))

        assert isinstance(bench.answers[again], Granted)

    def test_hold_limit_is_longer_by_a_lease(self, bench):
        """Whoever has not heard may begin a block within its lease, and then hold it so long."""
        bench.listen()
        hold_ns = S
        kept = bench.keep(hold_ns=hold_ns)
        bench.wait(3 * S, keep=("ann",))
        lock, _ = bench.waiter()
        bench.wait(hold_ns + TTL_NS - 100 * MS, keep=("ann", "bob"))
        assert bench.end(bench.next_lock(), kept.token, keep=False).kept == NOT_KEPT
        bench.ask(Release(lock))

        bench.listen()
        for _ in range(4):
            kept = bench.block()
        assert kept.said == FAR
        bench.waiter()
        bench.wait(HOLD_NS + TTL_NS, keep=("ann", "bob"))
        assert isinstance(bench.end(bench.next_lock(), kept.token), Fenced)
        assert bench.counter("held_too_long") == 1

    def test_goodbye_ends_it_without_a_story(self, bench):
        """Whoever says goodbye uses none; and its question is answered."""
        handle = bench.listen()
        bench.keep()
        bench.ask(Goodbye("ann"))
        _, waiter = bench.waiter()

        assert isinstance(bench.answers[waiter], Granted)
        assert isinstance(bench.answers[handle], EpochChanged)
        assert [story.kind for story in bench.stories if story.kind == "lock.taken"] == []

    def test_broken_by_hand(self, bench):
        """A listening session hears at once; a commit under it is refused with the cause."""
        handle = bench.listen()
        kept = bench.keep()
        number = bench.ask(ListLocks()).holders[0].number
        bench.ask(Break(number, "a test", bench.shard.epoch))

        assert bench.word(handle) == []
        answer = bench.end(bench.next_lock(), kept.token)
        assert isinstance(answer, Fenced)
        assert "a test" in answer.cause

    def test_draining_shard_recalls_all_and_answers_who_listens(self, bench):
        """It stops once they were given back."""
        handle = bench.listen()
        kept = bench.keep()
        bench.event(Drain())
        assert bench.word(handle) == [(kept.token.number, True)]
        assert not bench.shard.idle
        bench.ask(Release(kept.lock))

        assert bench.shard.idle
        assert bench.word(bench.listen()) == []

    def test_restart_ends_it(self, bench):
        """The token is of an epoch that is over."""
        bench.listen()
        kept, lock = bench.keep(), bench.next_lock()
        bench.restart()
        bench.hello("ann")
        bench.hello("ann", known_epoch=bench.shard.epoch)

        assert isinstance(bench.end(lock, kept.token), Fenced | EpochChanged)


class TestListening:
    def test_slice_ends(self, bench):
        """A question is kept for a second at most."""
        handle = bench.listen(wait_ns=60 * S)
        assert bench.shard.next_deadline_ns() <= bench.now_ns + S
        bench.wait(S - MS)
        assert bench.word(handle) is None
        bench.wait(MS)
        assert bench.word(handle) == []

    def test_newer_question_ends_the_older(self, bench):
        """A session listens once."""
        first, second = bench.listen(), bench.listen()
        assert (bench.word(first), bench.word(second)) == ([], None)

    def test_it_renews_the_session(self, bench):
        """It is a keep-alive."""
        for _ in range(4):
            bench.listen()
            bench.wait(TTL_NS - 200 * MS)
        lock = bench.next_lock()
        assert isinstance(bench.acquire(lock, item(Access.WRITE, "piece", "frame")), Granted)

    def test_session_of_another_epoch_does_not_listen(self, bench):
        """The answer is that the epoch has changed."""
        question = KeepAlive("ann", bench.shard.epoch + 1, 1, (), b"", SLICE_NS)
        assert isinstance(bench.ask(question), EpochChanged)
