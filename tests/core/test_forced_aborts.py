"""Locks in doubt that an operator aborts: audited, durable first, and an alarm if that was wrong."""

from __future__ import annotations

import pytest
from shard_bench import S, ShardBench, datum, item, lock_id, slot

from enact_dist.core.protocol.datum import Position, Token
from enact_dist.core.protocol.messages import (
    RESOLVED_ABORTED,
    RESOLVED_COMMITTED,
    RESOLVED_OPEN,
    Audited,
    Break,
    Broken,
    Finish,
    Finished,
    ForceAbort,
    Granted,
    ListAudit,
    ListSessions,
    Prepare,
    Prepared,
    Resolve,
    Resolved,
    WriteItem,
)
from enact_dist.core.protocol.records import Called, ShardReturned
from enact_dist.terms import Access

ANN, BOB = lock_id("ann"), lock_id("bob")
FAR_TOKEN = Token(7, 7)
STAMP_NS = 1_800_000_000 * S + 5
POSITION = Position(STAMP_NS, "far")
FAR = Resolve(ANN, FAR_TOKEN, "s0")


@pytest.fixture
def bench() -> ShardBench:
    """A shard on which a lock of ann is prepared, in doubt for the shard `far`."""
    bench = ShardBench()
    bench.hello("ann", "bob")
    grant = bench.granted(ANN, item(Access.WRITE))
    write = WriteItem(slot(), datum("new"))
    prepare = Prepare(ANN, grant.token, (write,), 0, (), "far", FAR_TOKEN)
    assert isinstance(bench.ask(prepare), Prepared)
    return bench


def force(bench: ShardBench) -> int:
    """Ask for the abort; return the handle of its answer."""
    number = bench.shard.state.tenures.by_lock[ANN].claim.ticket
    return bench.send(ForceAbort(number, "disk gone"))


def says(bench: ShardBench, kind: str) -> None:
    """Let the lost shard be back and answer."""
    bench.event(Called("far", FAR, Resolved(ANN, kind, POSITION)))


def audit(bench: ShardBench) -> Audited:
    answer = bench.ask(ListAudit(""))
    assert isinstance(answer, Audited)
    return answer


def alarms_shown(bench: ShardBench) -> int:
    counters = {counter.name: counter.value for counter in bench.ask(ListSessions()).counters}
    return counters.get("alarms", 0)


def test_abort_by_hand_is_told_and_frees_when_it_is_durable(bench):
    """The operator hears nothing, and nobody gets the data, before the record is on the disk."""
    bench.disk_is_done = False
    handle = force(bench)
    waiting = bench.send(bench.acquire_request(BOB, item(Access.WRITE)))

    assert handle not in bench.answers
    assert waiting not in bench.answers
    bench.disk_is_done = True
    bench.finish_disk()

    assert bench.answers[handle].found
    assert isinstance(bench.answers[waiting], Granted)


def test_abort_by_hand_that_a_crash_took_leaves_the_lock_in_doubt(bench):
    """What was not told is not half done: after the restart the lock is prepared as before."""
    bench.disk_is_done = False
    force(bench)
    bench.disk_is_done = True
    bench.restart()

    assert bench.shard.state.tenures.by_lock[ANN].prepared is not None
    assert not audit(bench).entries


@pytest.mark.parametrize("restart", [False, True])
def test_commit_of_the_lost_shard_raises_an_alarm(bench, restart):
    """It comes back and says *committed*: counted, audited with the slots, shown until settled."""
    force(bench)
    if restart:
        bench.restart()
    bench.calls.clear()
    bench.wait(3 * S)
    assert ("far", FAR) in bench.calls

    says(bench, RESOLVED_COMMITTED)

    entry = audit(bench).entries[-1]
    assert (entry.kind, audit(bench).alarms) == ("alarm", 1)
    assert "online:piece/count" in entry.text
    assert "far had committed it" in entry.text
    assert bench.shard.counters["forced_but_committed"] == 1
    assert bench.value() is None, "nothing is written by itself over what came since"
    bench.restart()
    assert alarms_shown(bench) == 1
    bench.calls.clear()
    bench.wait(5 * S)
    assert not bench.calls, "it has its answer"


def test_finish_of_the_lost_shard_raises_an_alarm_and_is_answered_when_that_is_durable(bench):
    """The primary may forget the lock only when the alarm cannot be lost any more."""
    force(bench)
    bench.disk_is_done = False
    handles = [bench.send(Finish(ANN, POSITION)) for _ in range(2)]
    assert not set(handles) & set(bench.answers)
    bench.disk_is_done = True
    bench.finish_disk()

    assert [bench.answers[handle] for handle in handles] == [Finished(ANN)] * 2
    assert bench.ask(Finish(ANN, POSITION)) == Finished(ANN)
    assert audit(bench).alarms == 1
    assert bench.shard.counters["forced_but_committed"] == 1


def test_finish_that_crosses_the_abort_raises_an_alarm(bench):
    """The lost shard is back while the disk still works on the abort: both are answered."""
    bench.disk_is_done = False
    operator = force(bench)
    finish = bench.send(Finish(ANN, POSITION))
    bench.disk_is_done = True
    bench.finish_disk()

    assert bench.answers[operator].found
    assert bench.answers[finish] == Finished(ANN)
    assert audit(bench).alarms == 1


def test_lost_shard_that_had_not_committed_raises_no_alarm(bench):
    """*Aborted* is what the operator has guessed; *open* is no answer yet."""
    force(bench)
    says(bench, RESOLVED_OPEN)
    assert [entry.kind for entry in audit(bench).entries] == ["forced"]
    says(bench, RESOLVED_ABORTED)
    says(bench, RESOLVED_ABORTED)

    assert [entry.kind for entry in audit(bench).entries] == ["forced", "confirmed"]
    assert audit(bench).alarms == 0
    bench.restart()
    bench.calls.clear()
    bench.wait(5 * S)
    assert not bench.calls


def test_lost_shard_that_comes_back_is_asked_at_once(bench):
    """Whether the commit is torn should be known as soon as it can be."""
    force(bench)
    bench.wait(S)
    bench.calls.clear()

    bench.event(ShardReturned("elsewhere"))
    assert bench.calls == []
    bench.event(ShardReturned("far"))

    assert bench.calls == [("far", FAR)]


def test_second_abort_by_hand_finds_nothing_in_doubt(bench):
    """The same number for another reason is refused, also while the disk works on the first."""
    bench.disk_is_done = False
    force(bench)
    number = bench.shard.state.tenures.by_lock[ANN].claim.ticket
    assert bench.ask(ForceAbort(number, "again")) == Broken(False, None)
    bench.disk_is_done = True
    bench.finish_disk()

    assert bench.ask(ForceAbort(number, "again")) == Broken(False, None)
    assert len(audit(bench).entries) == 1


def test_settled_alarms_are_shown_no_more_and_later_ones_are(bench):
    """Settling is an entry of its own; it says nothing about what comes after."""
    force(bench)
    says(bench, RESOLVED_COMMITTED)
    assert alarms_shown(bench) == 1

    answer = bench.ask(ListAudit("written again by hand"))

    assert answer.alarms == 0
    assert answer.entries[-1].text == "written again by hand"
    bench.restart()
    assert alarms_shown(bench) == 0


def test_alarms_are_settled_when_that_is_kept(bench):
    """Nobody is told that there are no alarms whom a crash would contradict."""
    force(bench)
    says(bench, RESOLVED_COMMITTED)
    bench.disk_is_done = False
    settle = ListAudit("written again by hand")
    handles = [bench.send(settle), bench.send(settle), bench.send(ListAudit(""))]
    assert not set(handles) & set(bench.answers)
    bench.disk_is_done = True
    bench.finish_disk()

    assert [bench.answers[handle].alarms for handle in handles] == [0, 0, 0]
    assert [entry.kind for entry in audit(bench).entries] == ["forced", "alarm", "settled"]


def test_alarms_whose_settling_a_crash_took_are_there_again(bench):
    """Nobody was told that they were settled."""
    force(bench)
    says(bench, RESOLVED_COMMITTED)
    bench.disk_is_done = False
    settled = bench.send(ListAudit("written again by hand"))
    assert settled not in bench.answers
    bench.disk_is_done = True
    bench.restart()

    assert audit(bench).alarms == 1


def broken(bench: ShardBench, reason: str) -> int:
    """Let bob hold a lock and ask to break it; return the handle of the answer."""
    bench.granted(BOB, item(Access.WRITE, "other"))
    number = bench.shard.state.tenures.by_lock[BOB].claim.ticket
    return bench.send(Break(number, reason))


def test_lock_is_broken_at_once_and_that_is_told_when_it_is_kept(bench):
    """The next one gets it; the operator hears of it when the entry cannot be lost any more."""
    bench.disk_is_done = False
    handle = broken(bench, "camera unplugged")
    following = lock_id("ann", 1)

    assert isinstance(bench.acquire(following, item(Access.WRITE, "other")), Granted)
    assert handle not in bench.answers
    bench.disk_is_done = True
    bench.finish_disk()
    assert bench.answers[handle].found
    bench.restart()
    assert [entry.kind for entry in audit(bench).entries] == ["broken"]


@pytest.mark.parametrize("at_disk", [True, False], ids=["at the disk", "answered"])
@pytest.mark.parametrize("kind", [Break, ForceAbort])
def test_who_asks_again_in_the_same_words_is_told_the_same(bench, kind, at_disk):
    """A client asks again after a second; a disk that is slower must not make that a *no*."""
    lock = ANN if kind is ForceAbort else BOB
    bench.granted(BOB, item(Access.WRITE, "other"))
    number = bench.shard.state.tenures.by_lock[lock].claim.ticket
    bench.disk_is_done = False
    handles = [bench.send(kind(number, "disk gone")) for _ in range(2 if at_disk else 1)]
    assert not set(handles) & set(bench.answers)
    bench.disk_is_done = True
    bench.finish_disk()
    handles += [bench.send(kind(number, "disk gone")) for _ in range(0 if at_disk else 1)]

    first, again = (bench.answers[handle] for handle in handles)
    assert first.found
    assert again == first
    assert bench.ask(kind(number, "another reason")) == Broken(False, None)
    assert len(audit(bench).entries) == 1


def test_broken_lock_is_audited(bench):
    """`Break` can be read afterwards, too, by number, actor and reason."""
    bench.granted(BOB, item(Access.WRITE, "other"))
    number = bench.shard.state.tenures.by_lock[BOB].claim.ticket
    bench.ask(Break(number, "camera unplugged"))
    bench.restart()

    (entry,) = audit(bench).entries
    assert entry.kind == "broken"
    assert "camera unplugged" in entry.text
