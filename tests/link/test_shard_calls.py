"""Calls from shard to shard over real Zenoh sessions on the loopback."""

import logging
import threading

import pytest

from enact_dist.core.protocol.datum import Datum, LockId, Position, Slot, Token
from enact_dist.core.protocol.messages import (
    Finish,
    Finished,
    Prepare,
    Prepared,
    Resolve,
    Resolved,
    ShardEntry,
    WriteItem,
)
from enact_dist.core.shard import on_prepare as prepares
from enact_dist.errors import LinkError
from enact_dist.link.daemon import shard_calls
from enact_dist.link.daemon.shard_calls import ShardCalls
from enact_dist.link.zenoh import config as zenoh_config

LOCK = LockId("0" * 32, 0, 1)
RESOLVE = Resolve(LOCK, Token(1, 1), "s0")


@pytest.fixture
def calling():
    """Make the calls of shard `s0`: `calling(s1=endpoint, …)`; closed after the test."""
    made = []

    def make(**endpoints):
        answers, returned = [], []
        shards = [ShardEntry(name, (endpoint,)) for name, endpoint in endpoints.items()]
        calls = ShardCalls(
            "cell",
            "s0",
            [ShardEntry("s0", ()), *shards],
            lease_s=1.0,
            answered=lambda *answer: answers.append(answer),
            returned=returned.append,
        )
        calls.answers, calls.returned = answers, returned
        made.append(calls)
        return calls

    yield make
    for calls in made:
        calls.close()


@pytest.fixture
def rounds(monkeypatch):
    """Of each round of calls that is over: whether a shard has answered."""
    over, note = [], shard_calls._Line._note_silence

    def noted(line, *, answered):
        note(line, answered=answered)
        over.append(answered)

    monkeypatch.setattr(shard_calls._Line, "_note_silence", noted)
    return over


def line_threads():
    return [thread for thread in threading.enumerate() if thread.name == "enact-calls"]


def test_call_is_answered_with_its_shard_and_request(daemon, calling, endpoint, until):
    """Both kinds: what became of a lock, and that it has committed."""
    daemon(endpoint, "s1")
    calls = calling(s1=endpoint)
    finish = Finish(LOCK, Position(5, "s0"))

    calls.submit("s1", RESOLVE)
    until(lambda: calls.answers or calls.submit("s1", RESOLVE))
    calls.submit("s1", finish)
    until(lambda: any(request == finish for _, request, _ in calls.answers))

    resolved = Resolved(LOCK, "aborted", Position(0, "s1"))
    assert calls.answers[0] == ("s1", RESOLVE, resolved)
    assert calls.answers[-1] == ("s1", finish, Finished(LOCK))


def test_shard_that_comes_late_is_reached_on_the_same_way(daemon, calling, endpoint, until, rounds):
    """A shard that is away costs one thread, and nothing has to be started again."""
    calls = calling(s1=endpoint)
    until(lambda: len(rounds) >= 3 or calls.submit("s1", RESOLVE))
    assert not any(rounds)
    assert not calls.answers
    assert len(line_threads()) == 1

    daemon(endpoint, "s1")
    until(lambda: calls.answers or calls.submit("s1", RESOLVE))

    assert len(line_threads()) == 1


def test_shard_that_comes_back_is_told(daemon, calling, endpoint, until):
    """Of one that was called and did not answer, and again after each restart."""
    calls = calling(s1=endpoint, s2=endpoint)
    calls.submit("s1", RESOLVE)
    until(lambda: calls._lines["s1"]._silent_since_s)  # it was called in vain
    assert calls.returned == []

    first = daemon(endpoint, "s1")
    until(lambda: calls.returned)
    assert calls.answers == []
    first.stop(drain_s=0.0)
    seen = len(calls.returned)
    daemon(endpoint, "s1")
    until(lambda: len(calls.returned) > seen)

    assert set(calls.returned) == {"s1"}


def test_primary_that_comes_back_is_asked_by_whoever_waits_for_it(
    daemon, carry, make_peer, endpoint, free, tmp_path, until, monkeypatch
):
    """A lock in doubt ends with the cut, not with the pause after the last question."""
    monkeypatch.setattr(prepares, "ASK_NS_MAX", 3600 * 10**9)
    far = free()
    stored = {"folder": tmp_path, "durability": "durable", "others": (ShardEntry("s0", (far,)),)}
    first, carrier = daemon(endpoint, "s1", **stored), carry(endpoint, ttl_s=7200.0)
    peer = make_peer(lambda shard, message: carrier.request(shard, message, timeout_s=5), "s1")
    peer.hello(ttl_s=7200.0)
    grant = peer.acquire("piece")
    write = WriteItem(Slot("online", "piece", "count"), Datum(b"\x01", b"5", 1))
    prepare = Prepare(grant.lock, grant.token, (write,), 0, (), "s0", Token(1, 1))
    assert isinstance(carrier.request("s1", prepare, timeout_s=5), Prepared)
    first.stop(drain_s=0.0)
    second = daemon(endpoint, "s1", **stored)
    until(lambda: (line := second._calls._lines.get("s0")) and line._silent_since_s)

    daemon(far, "s0")

    until(lambda: second.host.figures().get("resolved_aborted"))
    assert second.host.figures()["locks_held"] == 0


def test_call_that_is_queued_is_not_queued_twice(calling, endpoint, until, monkeypatch):
    """What the core asks again each second does not pile up behind a shard that hangs."""
    asked, go_on = [], threading.Event()

    def hang(line, calls):
        asked.append(calls)
        assert go_on.wait(60)
        return []

    monkeypatch.setattr(shard_calls._Line, "_answers", hang)
    monkeypatch.setattr(shard_calls, "QUEUED_MAX", 3)
    calls = calling(s1=endpoint)
    calls.submit("s1", RESOLVE)
    until(lambda: asked)
    for _ in range(100):
        calls.submit("s1", RESOLVE)
    for number in range(10):
        calls.submit("s1", Resolve(LOCK, Token(1, number), "s0"))
    go_on.set()
    until(lambda: len(asked) > 1)

    assert asked[0] == [RESOLVE]
    assert len(asked[1]) == 3
    assert asked[1].count(RESOLVE) == 1


def test_call_without_a_thread_for_it_is_made_later(daemon, calling, endpoint, until, monkeypatch):
    """At the system's limit of threads the shard that calls goes on; the core asks again."""
    daemon(endpoint, "s1")
    calls = calling(s1=endpoint)

    def refused(_):
        raise RuntimeError("can't start new thread")

    with monkeypatch.context() as patched:
        patched.setattr(threading.Thread, "start", refused)
        calls.submit("s1", RESOLVE)

    assert line_threads() == []
    until(lambda: calls.answers or calls.submit("s1", RESOLVE))


def test_way_that_could_not_be_opened_is_tried_again(
    daemon, calling, endpoint, until, monkeypatch, caplog
):
    """A shortage of sockets at the first call must not cut two shards for ever."""
    daemon(endpoint, "s1")
    opened, real = [], shard_calls.open_session

    def open_session(**options):
        opened.append(options)
        if len(opened) == 1:
            raise LinkError("too many open files")
        return real(**options)

    monkeypatch.setattr(shard_calls, "open_session", open_session)
    calls = calling(s1=endpoint)

    until(lambda: calls.answers or calls.submit("s1", RESOLVE))

    assert len(opened) == 2
    assert "too many open files" in caplog.text


def test_silence_is_told_once_and_so_is_its_end(
    daemon, calling, endpoint, until, rounds, monkeypatch, caplog
):
    """A log of hours says the same thing once, with what to do."""
    caplog.set_level(logging.INFO, "enact.link")
    monkeypatch.setattr(shard_calls, "SILENT_S", 0.0)
    calls = calling(s1=endpoint)
    until(lambda: len(rounds) >= 4 or calls.submit("s1", RESOLVE))
    assert not any(rounds)
    assert caplog.text.count("does not answer") == 1

    daemon(endpoint, "s1")
    until(lambda: "answers again" in caplog.text or calls.submit("s1", RESOLVE))

    assert caplog.text.count("answers again") == 1


def test_shard_that_the_cell_has_no_more_is_told_once(calling, endpoint, caplog):
    """The cell was restarted with another file while a lock was prepared."""
    calls = calling(s1=endpoint)
    for _ in range(5):
        calls.submit("gone", RESOLVE)

    assert caplog.text.count("shard gone") == 1
    assert "force-abort" in caplog.text
    assert not line_threads()


def test_closing_does_not_wait_for_each_shard_that_is_away(calling, free, monkeypatch, until):
    """A drain has 2 s in all, so those that do not end share one time."""
    calls, given_s = calling(**{f"s{number}": free() for number in range(1, 6)}), []

    def wait_in_vain(_, timeout_s):
        given_s.append(max(0.0, timeout_s))
        threading.Event().wait(given_s[-1])

    monkeypatch.setattr(shard_calls._Line, "join", wait_in_vain)
    for number in range(1, 6):
        calls.submit(f"s{number}", RESOLVE)
    until(lambda: len(line_threads()) == 5)

    calls.close()

    assert len(given_s) == 5
    assert sum(given_s) < 1.1 * shard_calls.JOIN_S
    monkeypatch.undo()
    calls.close()
    calls.submit("s1", RESOLVE)
    until(lambda: not line_threads())


def test_calls_go_on_after_what_nobody_expected(daemon, calling, endpoint, until, monkeypatch):
    """Here the session has no thread of its own when it is opened; the core asks again."""
    daemon(endpoint, "s1")
    sessions = list(zenoh_config._open_sessions)
    with monkeypatch.context() as patch:
        patch.setattr(zenoh_config, "LinkWatch", refused)
        calls = calling(s1=endpoint)
        calls.submit("s1", RESOLVE)
        until(lambda: refused.calls)
        until(lambda: zenoh_config._open_sessions == sessions)

    until(lambda: calls.answers or calls.submit("s1", RESOLVE))


def test_shard_that_could_not_be_watched_is_watched_from_the_next_call_on(
    daemon, calling, endpoint, until, monkeypatch
):
    """There was no thread for it at the first call; whoever waits for it is told all the same."""
    calls, before = calling(s1=endpoint), refused.calls
    with monkeypatch.context() as patch:
        patch.setattr(shard_calls, "ShardPresence", refused)
        calls.submit("s1", RESOLVE)
        until(lambda: refused.calls > before and calls._lines["s1"]._silent_since_s)
    calls.submit("s1", RESOLVE)
    until(lambda: calls._lines["s1"]._presence)

    daemon(endpoint, "s1")

    assert until(lambda: calls.returned)


def test_shard_that_comes_back_is_told_after_one_that_could_not_be(
    daemon, calling, endpoint, until, caplog
):
    """What failed once at whoever is told ends no watch."""
    calls, told = calling(s1=endpoint), []

    def tell(shard):
        told.append(shard)
        if len(told) == 1:
            raise RuntimeError("nobody listens")

    calls.pass_return = tell
    calls.submit("s1", RESOLVE)
    until(lambda: calls._lines["s1"]._silent_since_s)
    first = daemon(endpoint, "s1")
    until(lambda: told)
    first.stop(drain_s=0.0)
    daemon(endpoint, "s1")

    assert until(lambda: len(told) > 1)
    assert "nobody listens" in caplog.text


def refused(*_):
    refused.calls += 1
    raise RuntimeError("can't start new thread")


refused.calls = 0
