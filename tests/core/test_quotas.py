"""What one client takes of a shard leaves the others theirs."""

from __future__ import annotations

from shard_bench import MS, S, ShardBench, item, lock_id

from enact_dist.core.protocol.messages import Goodbye, Granted, Hello, KeepAlive, Refused, Welcome
from enact_dist.core.protocol.records import SessionSeen
from enact_dist.core.shard import owners
from enact_dist.core.state import sessions
from enact_dist.terms import Access

GREEDY, MODEST = "greedy@h:1", "modest@h:2"


def hello(session, *, observer=True):
    return Hello(session, 0, 2 * S, session, "h", 1, observer)


def test_process_with_all_its_sessions_is_refused_and_the_others_get_in():
    """By name, counted, told to the log once; what it ends it may open again."""
    bench = ShardBench()
    opened = [bench.ask_as(GREEDY, hello(f"s{n}")) for n in range(owners.SESSIONS_MAX)]
    refused = [bench.ask_as(GREEDY, hello(f"more{n}")) for n in range(3)]
    again = bench.ask_as(GREEDY, hello("s0"))
    other = bench.ask_as(MODEST, hello("mine"))
    stories = [story for story in bench.stories if story.event == "quota.refused"]
    bench.ask_as(GREEDY, Goodbye("s0"))
    one_more = bench.ask_as(GREEDY, hello("more"))

    assert all(isinstance(answer, Welcome) for answer in (*opened, again, other, one_more))
    assert {answer.code for answer in refused} == {"overload"}
    assert all("greedy@h:1 has 256 sessions" in answer.text for answer in refused)
    assert bench.counter("quota_refused") == 3
    assert len(stories) == 1


def test_two_hundred_clients_of_one_name_on_one_host_are_as_many_shares():
    """A big cell is no attack: each process has its own."""
    bench = ShardBench()
    for pid in range(1000):
        assert isinstance(bench.ask_as(f"camera@robot:{pid}", hello(f"camera{pid}")), Welcome)

    assert bench.counter("quota_refused") == 0


def test_recovered_sessions_count_for_their_identity():
    """A restart is no way to get more."""
    bench = ShardBench()
    for number in range(owners.SESSIONS_MAX):
        bench.ask_as(GREEDY, hello(f"s{number}", observer=False))
    bench.restart()

    assert isinstance(bench.ask_as(GREEDY, hello("more")), Refused)


def test_full_table_makes_room_for_who_shows_a_sign_of_life(monkeypatch):
    """Sessions opened in a loop, under ever new names, keep nobody out, nor displace who works."""
    monkeypatch.setattr("enact_dist.core.state.sessions.SESSIONS_MAX", 20)
    bench = ShardBench()
    epoch = bench.shard.epoch
    bench.ask_as("alive@h:1", hello("alive"))
    bench.ask_as("alive@h:1", KeepAlive("alive", epoch, 1, (), b""))
    bench.event(SessionSeen("seen", True, "seen@h:1"))
    bench.ask_as("seen@h:1", hello("seen"))
    bench.ask_as("holds@h:1", hello("holds", observer=False))
    bench.identity = "holds@h:1"
    bench.granted(lock_id("holds"), item(Access.WRITE))
    bench.identity = ""
    flood = [bench.ask_as(f"x@h:{n}", hello(f"flood{n}")) for n in range(200)]
    late = bench.ask_as(MODEST, hello("mine"))

    known = bench.shard.state.sessions.by_id
    assert all(isinstance(answer, Welcome) for answer in (*flood, late))
    assert {"alive", "seen", "holds", "mine"} <= set(known)
    assert len(known) == 20
    assert bench.counter("sessions_displaced") == 3 + 200 + 1 - 20


def test_table_full_of_living_sessions_refuses_by_name(monkeypatch):
    """Nobody who works is displaced."""
    monkeypatch.setattr("enact_dist.core.state.sessions.SESSIONS_MAX", 5)
    bench = ShardBench()
    for number in range(5):
        bench.ask_as(f"a@h:{number}", hello(f"s{number}"))
        bench.ask_as(f"a@h:{number}", KeepAlive(f"s{number}", bench.shard.epoch, 1, (), b""))

    answer = bench.ask_as(MODEST, hello("mine"))

    assert isinstance(answer, Refused)
    assert answer.text == "5 sessions are open"


def test_table_that_was_full_before_a_restart_keeps_nobody_out_after_it(monkeypatch):
    """Neither while the shard waits for those that it knew, nor when they have not come back."""
    monkeypatch.setattr("enact_dist.core.state.sessions.SESSIONS_MAX", 20)
    bench = ShardBench()
    for number in range(20):
        bench.ask_as(f"x@h:{number}", hello(f"flood{number}", observer=False))
    bench.restart()
    known = bench.shard.state.sessions.by_id
    before = set(known)
    in_grace = bench.shard.state.sessions.in_grace(bench.shard.state.now_ns)

    early = bench.ask_as(MODEST, hello("early"))
    waited_for = before - set(known)
    bench.wait(3 * S)
    late = [bench.ask_as(f"y@h:{number}", hello(f"late{number}")) for number in range(5)]

    assert len(before) == 20
    assert in_grace
    assert all(isinstance(answer, Welcome) for answer in (early, *late))
    assert waited_for == set()
    assert bench.counter("sessions_displaced") == 5
    assert len(known) == 21


def test_process_with_all_its_locks_is_refused_and_the_others_are_granted(monkeypatch):
    """Held and awaited ones count together, over all its sessions; asking again does not."""
    monkeypatch.setattr(owners, "WAITERS_MAX", 6)
    bench = ShardBench()
    bench.ask_as(GREEDY, hello("s0", observer=False))
    bench.ask_as(GREEDY, hello("s1", observer=False))
    bench.ask_as(MODEST, hello("mine", observer=False))
    requests = [
        bench.acquire_request(lock_id(f"s{n % 2}", n), item(Access.WRITE), wait_ns=10 * MS)
        for n in range(8)
    ]
    first = [bench.ask_as(GREEDY, request) for request in requests]
    bench.wait(20 * MS)
    again = bench.ask_as(GREEDY, requests[0])
    bench.identity = MODEST
    other = bench.acquire(lock_id("mine"), item(Access.WRITE, "bench"))

    assert isinstance(first[0], Granted)
    assert first[1:6] == [None] * 5
    assert [answer.code for answer in first[6:]] == ["overload"] * 2
    assert "6 locks held or awaited" in first[6].text
    assert isinstance(again, Granted)
    assert isinstance(other, Granted)
    assert bench.counter("quota_refused") == 2


def test_bounds_leave_room_for_any_program():
    """A session has at most so many threads; a table holds many shares."""
    assert owners.WAITERS_MAX >= 2 * sessions.LANES_MAX
    assert owners.SESSIONS_MAX * 10 < sessions.SESSIONS_MAX
