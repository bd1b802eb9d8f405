"""Ends of leases are kept by time: a tick looks at what is due, and finds what a walk would find."""

from __future__ import annotations

from random import Random

import pytest
from prepare_parts import FAR_TOKEN
from shard_bench import MS, S, ShardBench, item, lock_id, slot

from enact_dist.core.protocol.messages import (
    Commit,
    Goodbye,
    Granted,
    Ping,
    Prepare,
    Release,
    WriteItem,
)
from enact_dist.core.protocol.records import SessionSeen, Tick
from enact_dist.core.state.clock import STALE_MAX, DueTimes
from enact_dist.core.state.sessions import IDLE_TTLS, SessionState
from enact_dist.terms import Access

NAMES = ("ann", "bob", "cec", "dan", "eva")


def walked(bench):
    """Return the sessions whose leases are over, and those to be forgotten, by a look at each."""
    state, now_ns = bench.shard.state, bench.now_ns
    known = state.sessions.by_id
    over = {
        name
        for name in state.tenures.by_session
        if name not in known or known[name].lease_end_ns(now_ns) <= now_ns
    }
    idle = {
        session.session
        for session in state.sessions
        if not state.sessions.in_grace(now_ns)
        and now_ns - session.lease_end_ns(now_ns) > IDLE_TTLS * session.ttl_ns
    }
    return over, idle


def walked_end_ns(bench):
    """Return when the next lease ends that can end something, by a look at each."""
    state = bench.shard.state
    ends = [
        state.sessions.by_id[name].lease_end_ns(state.now_ns)
        for name, tenures in state.tenures.by_session.items()
        if name in state.sessions.by_id and not all(t.bound for t in tenures.values())
    ]
    return min(ends, default=None)


def something(bench, random, tops):
    """Let one thing happen to one session; tokens, bound locks, ends and restarts among them."""
    name, lane = random.choice(NAMES), random.randrange(2)
    lock = lock_id(name, lane, tops.get((name, lane), 0))
    tenure = bench.shard.state.tenures.by_lock.get(lock)
    act = random.randrange(11)
    if act <= 1:
        ttl_ns = random.choice((400 * MS, 400 * MS, 2 * S))
        bench.hello(name, known_epoch=bench.shard.epoch, ttl_ns=ttl_ns)
    elif act <= 3:
        tops[name, lane] = lock.seq + 1
        entity = f"e{random.randrange(3)}"
        asked = item(random.choice((Access.WRITE, Access.READ)), entity)
        alone = random.random() < 0.5
        answer = bench.acquire(lock_id(name, lane, lock.seq + 1), asked, alone=alone)
        assert answer is None or type(answer) is not Granted or answer.token
    elif act == 4:
        bench.keep_alive(name, view={lane: lock.seq})
    elif act == 5:
        bench.event(SessionSeen(name, random.random() < 0.5))
    elif act == 6:
        bench.ask(Release(lock))
    elif act == 7 and random.random() < 0.3:
        bench.ask(Goodbye(name))
    elif act == 8 and tenure is not None and tenure.token is not None:
        writes = (WriteItem(slot(tenure.items[0].entity), None),)
        if tenure.alone:
            bench.ask(Commit(lock, tenure.token, writes, 0, ()))
        else:
            bench.ask(Prepare(lock, tenure.token, writes, 0, (), "far", FAR_TOKEN))
    elif act == 9:
        bench.disk_is_done = not bench.disk_is_done
        if bench.disk_is_done:
            bench.finish_disk()
    elif act == 10 and random.random() < 0.1:
        bench.restart(lose_pending=False)


@pytest.mark.parametrize("seed", range(6))
def test_tick_finds_what_a_look_at_every_session_would_find(seed):
    """Renewed, restarted, stood still, bound: what is due is due at the same tick."""
    random, bench, tops = Random(seed), ShardBench(), {}
    found_over = found_idle = 0
    for _ in range(600):
        if random.random() < 0.35:
            something(bench, random, tops)
        step_ns = 2 * S if random.random() < 0.01 else random.choice((0, 50 * MS, 95 * MS, 95 * MS))
        bench.now_ns += step_ns
        bench.wall_ns += step_ns
        bench.ask(Ping())  # a stall moves the ends
        over, idle = walked(bench)
        state = bench.shard.state

        assert set(state.tenures.leases_over(bench.now_ns)) == over
        assert {session.session for session in state.sessions.idle(bench.now_ns)} == idle
        bench.event(Tick())
        end_ns, due_ns = walked_end_ns(bench), bench.shard.next_deadline_ns()
        assert end_ns is None or due_ns <= max(end_ns, bench.now_ns)
        found_over, found_idle = found_over + len(over), found_idle + len(idle)
    assert found_over
    assert found_idle


def test_tick_with_many_sessions_looks_at_those_that_are_due(monkeypatch):
    """With all of them a tick took 2.4 ms for 10,000 sessions, and everybody waited for it."""
    bench, looks = ShardBench(), 0
    for number in range(300):
        bench.hello(f"s{number}", ttl_ns=20 * S)
        bench.granted(lock_id(f"s{number}"), item(Access.READ))
    bench.hello("ann", ttl_ns=S)
    bench.granted(lock_id("ann"), item(Access.READ))
    lease_end_ns = SessionState.lease_end_ns

    def looking(session, now_ns):
        nonlocal looks
        looks += 1
        return lease_end_ns(session, now_ns)

    monkeypatch.setattr(SessionState, "lease_end_ns", looking)
    for _ in range(20):
        bench.now_ns += 100 * MS
        bench.event(Tick())
        bench.shard.next_deadline_ns()

    assert bench.counter("leases_expired") == 1
    assert looks < 40


def test_due_times_of_names_that_come_and_go_take_no_more_room():
    """What is dropped or moved leaves a trace only for a while."""
    due = DueTimes()
    for number in range(10 * STALE_MAX):
        due.put(f"s{number}", number)
        due.put("always", number)
        due.drop(f"s{number}")

    assert len(due) == 1
    assert len(due._heap) <= STALE_MAX + 3
    assert due.next_ns() == 10 * STALE_MAX - 1
    assert due.take(10 * STALE_MAX) == ["always"]
    assert due.next_ns() is None
