"""Questions that wait: what a message costs does not grow with them, and nobody parks too many."""

from __future__ import annotations

import sys
from collections import Counter

import pytest
from prepare_parts import FAR_TOKEN, W, prepare_of, prepared
from shard_bench import MS, S, ShardBench, item, lock_id, slot

from enact_dist.core.protocol.datum import Position
from enact_dist.core.protocol.messages import (
    Answer,
    AwaitStamp,
    EpochChanged,
    Finish,
    Hello,
    Item,
    KeepAlive,
    Reached,
    Refused,
    Release,
    TakeView,
    Viewed,
    Waiting,
)
from enact_dist.core.protocol.records import Drain, Tick
from enact_dist.core.shard.on_view import OF_A_SESSION_MAX
from enact_dist.terms import Access

ANN = lock_id("ann")
SESSIONS = "ann", "bob"


def far_ns(bench: ShardBench) -> int:
    """Return a stamp that is not reached for long."""
    return bench.wall_ns + 100 * S


def lines_run(act: object) -> int:
    """Return how many lines of the core an act takes: the same on every machine."""
    count = Counter[str]()

    def trace(frame, event, _):
        if "enact_dist/core" not in frame.f_code.co_filename:
            return None
        count[event] += 1
        return trace

    sys.settrace(trace)
    try:
        act()
    finally:
        sys.settrace(None)
    return count["line"]


def parked_by_many(bench: ShardBench, count: int) -> None:
    """Park so many stamps and views, of as many sessions as that takes."""
    prepared(bench)
    at_ns = bench.wall_ns + S // 2
    for number in range(count):
        session = f"s{number // OF_A_SESSION_MAX}"
        if number % OF_A_SESSION_MAX == 0:
            handle(bench, session)
        send(bench, AwaitStamp(far_ns(bench) - number, S, session, 1))
        view = (item(Access.VIEW),)
        send(bench, TakeView(lock_id(session, 1, number + 1), 1, 1, 1, view, 0, at_ns))


def handle(bench: ShardBench, session: str) -> None:
    send(bench, Hello(session, 0, 2 * S, session, "host", 1, True))


def send(bench: ShardBench, message: object) -> None:
    """Send without the walk over all invariants."""
    bench.shard.handle(
        message, reply_to=next(bench._handles), now_ns=bench.now_ns, wall_ns=bench.wall_ns
    )


def costs(count: int) -> dict[str, int]:
    """Return what messages cost beside so many parked questions."""
    bench = ShardBench()
    bench.hello("ann", "bob")
    parked_by_many(bench, count)
    far = far_ns(bench) + S
    messages = {
        "keep-alive": KeepAlive("bob", 1, 5, (), b""),
        "one more": AwaitStamp(far, S, "bob", 1),
        "ping": AwaitStamp(0, 0),
        "view": TakeView(lock_id("bob"), 1, 1, 9, (item(Access.VIEW),), 0),
        "lock": bench.acquire_request(lock_id("bob", 2), item(W, "other")),
    }
    return {name: lines_run(lambda m=m: send(bench, m)) for name, m in messages.items()}


def test_messages_cost_the_same_beside_one_and_beside_thousands():
    """A walk over what is parked, with each message, stopped a shard at 20,000."""
    few, many = costs(1), costs(3000)

    for name, lines in many.items():
        assert lines < few[name] + 60, (name, few, many)


def test_question_without_a_session_is_answered_at_once(bench):
    """Else anybody could leave as many as he likes."""
    for session, epoch in (("", 0), ("", 1)):
        answer = bench.ask(AwaitStamp(far_ns(bench), S, session, epoch))
        assert isinstance(answer, Reached)
        assert not answer.reached


@pytest.mark.parametrize(("session", "epoch"), [("zed", 1), ("ann", 7), ("ann", 0)])
def test_question_of_an_unknown_session_is_told_the_epoch(bench, session, epoch):
    """It greets and asks again; what is reached already is answered all the same."""
    assert bench.ask(AwaitStamp(far_ns(bench), S, session, epoch)) == EpochChanged(1)
    assert bench.ask(AwaitStamp(bench.wall_ns, S, session, epoch)).reached


def test_session_parks_so_many_and_no_more(bench):
    """The oldest question is answered for the next one; those of others wait on."""
    other = bench.send(AwaitStamp(far_ns(bench), S, "bob", 1))
    asked = [
        bench.send(AwaitStamp(far_ns(bench) - n, S, "ann", 1)) for n in range(OF_A_SESSION_MAX + 3)
    ]

    assert [handle for handle in asked if handle in bench.answers] == asked[:3]
    assert not any(bench.answers[handle].reached for handle in asked[:3])
    assert other not in bench.answers
    bench.wait(1100 * MS)
    assert {*asked, other} <= bench.answers.keys()


def test_stamps_are_answered_in_the_order_in_which_they_are_reached(bench):
    """Whoever waits for less is answered before whoever asked earlier for more."""
    base_ns = bench.wall_ns
    asked = {ms: bench.send(AwaitStamp(base_ns + ms * MS, S, "ann", 1)) for ms in (300, 100, 200)}

    for ms, expected in ((50, []), (150, [100]), (250, [100, 200]), (350, [100, 200, 300])):
        bench.now_ns, bench.wall_ns = bench.now_ns + 100 * MS, base_ns + ms * MS
        bench.event(Tick())
        assert sorted(ms for ms, handle in asked.items() if handle in bench.answers) == expected
    assert all(bench.answers[handle].reached for handle in asked.values())


def test_view_waits_for_one_undecided_commit_after_the_other(bench):
    """Decided one by one, the first does not answer a view that the second stands before."""
    prepared(bench)
    second = bench.granted(lock_id("bob"), item(W, aspect="note"))
    promise = bench.ask(prepare_of(second, aspect="note"))
    at_ns = promise.stamp_ns
    view = (item(Access.VIEW), item(Access.VIEW, aspect="note"))
    waiting = bench.send(TakeView(lock_id("ann", 5), 1, 1, 9, view, 0, at_ns))
    beside = bench.send(TakeView(lock_id("ann", 6), 1, 1, 10, view[:1], 0, at_ns))

    bench.ask(Finish(ANN, Position(bench.wall_ns, "far")))
    assert isinstance(bench.answers[beside], Viewed)
    assert waiting not in bench.answers
    bench.ask(Finish(lock_id("bob"), Position(at_ns, "far")))

    shown = bench.answers[waiting]
    assert [state.version for state in shown.states] == [1, 1]
    assert FAR_TOKEN.number == 7


def test_view_that_is_one_too_many_is_answered_early(bench, monkeypatch):
    """Its interval says that it ends before the commit; it may be asked again."""
    monkeypatch.setattr("enact_dist.core.shard.on_view.WAITING_MAX", 2)
    prepared(bench)
    at_ns = bench.wall_ns + S // 2
    asked = [
        bench.send(TakeView(lock_id("bob", n), 1, 1, n, (item(Access.VIEW),), 0, at_ns))
        for n in range(3)
    ]

    assert [handle for handle in asked if handle in bench.answers] == asked[2:]
    assert bench.answers[asked[2]].until_ns < at_ns


def test_drain_answers_everybody_who_waits(bench):
    """And whoever asks afterwards is answered at once."""
    prepared(bench)
    view = TakeView(lock_id("bob"), 1, 1, 1, (item(Access.VIEW),), 0, bench.wall_ns + S // 2)
    asked = [bench.send(AwaitStamp(far_ns(bench), S, "ann", 1)), bench.send(view)]

    bench.event(Drain())

    assert set(asked) <= bench.answers.keys()
    assert not bench.ask(AwaitStamp(far_ns(bench), S, "ann", 1)).reached


def waiting(bench: ShardBench, session: str, number: int, *items: Item) -> Answer | None:
    """Ask for a lock in a lane of its own."""
    return bench.acquire(lock_id(session, number), *items, wait_ns=0)


def test_requests_of_one_identity_that_wait_are_bounded(bench, monkeypatch):
    """A few locks of thousands of requests each are as bad as thousands of locks."""
    monkeypatch.setattr("enact_dist.core.shard.owners.ITEMS_WAITING_MAX", 5)
    for session in ("dora", "dan"):
        bench.ask_as("d", Hello(session, 0, 2 * S, session, "host", 1, False))
    holder = bench.granted(lock_id("ann", 9), item(W))
    several = [item(W, f"e{number}") for number in range(4)]

    first = [waiting(bench, session, 0, item(W), *several) for session in ("dora", "dan")]
    other = waiting(bench, "bob", 0, item(W), *several)

    assert [type(answer).__name__ for answer in first] == ["Waiting", "Refused"]
    assert "d has 5 requests in locks that wait at this shard" in first[1].text
    assert isinstance(other, Waiting)
    bench.ask(Release(holder.lock))
    bench.event(Tick())
    assert isinstance(waiting(bench, "dan", 1, item(W)), Waiting)


def test_many_patterns_over_many_slots_are_refused(bench, monkeypatch):
    """Each is matched with every slot while everybody waits; one pattern alone is always looked at."""
    monkeypatch.setattr("enact_dist.core.shard.on_lock.LOOKED_MAX", 5)
    for number in range(6):
        bench.write("bob", number + 1, "1", to=slot(f"e{number}"))
    one = item(Access.VIEW_EACH, "*")

    answer = bench.ask(TakeView(ANN, 1, 1, 5, (one, item(Access.VIEW_EACH, "e*")), 0))

    assert isinstance(answer, Refused)
    assert "2 patterns in one lock would look at 12 slots; at most 5" in answer.text
    assert len(bench.ask(TakeView(ANN, 1, 1, 5, (one,), 0)).states) == 6
