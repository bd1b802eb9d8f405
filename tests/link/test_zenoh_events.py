"""Rare events of Zenoh are heard by threads that sleep until there is one."""

import os
import queue
import threading
from pathlib import Path
from types import SimpleNamespace

import pytest
import zenoh

from enact_dist.link.zenoh.config import close_session, open_session
from enact_dist.link.zenoh.events import Events
from enact_dist.link.zenoh.queries import ShardPresence

QUIET_S = 1.0
"""A thread that waits in a channel of Zenoh's wakes ten times in this."""


def wakes(thread):
    """Return how often a thread has gone to sleep so far."""
    status = Path(f"/proc/{os.getpid()}/task/{thread}/status").read_text()
    return int(status.partition("\nvoluntary_ctxt_switches:")[2].split()[0])


def test_thread_of_a_listener_wakes_for_its_events_alone(endpoint):
    """It is a daemon, tells of each event in order, and ends with its session."""
    session = open_session(listen=[endpoint], lease_s=1.0)
    heard, gone_wrong = queue.SimpleQueue(), []

    def hear(sample):
        heard.put((bytes(sample.payload), threading.current_thread()))
        if not gone_wrong:
            gone_wrong.append(sample)
            raise ValueError("the first one is too much")

    def declare(callback):
        return session.declare_subscriber("some/key", callback)

    events = Events("enact-test", declare, hear)
    try:
        for payload in (b"1", b"2"):
            session.put("some/key", payload)
        (first, thread), (second, _) = (heard.get(timeout=30) for _ in range(2))
        before = wakes(thread.native_id)
        threading.Event().wait(QUIET_S)

        assert (first, second) == (b"1", b"2")
        assert (thread.daemon, thread.name) == (True, "enact-test")
        assert wakes(thread.native_id) - before <= 2
    finally:
        close_session(session)
    events.join(30.0)
    assert not thread.is_alive()


def test_listener_that_cannot_be_declared_raises_here(endpoint):
    """The error comes from the thread that declares it to whoever wanted it."""
    session = open_session(listen=[endpoint], lease_s=1.0)
    close_session(session)
    with pytest.raises(zenoh.ZError):
        Events("enact-test", lambda c: session.declare_subscriber("some/key", c), print)


def test_shard_that_goes_and_comes_at_once_is_told_whatever_event_is_the_last():
    """Zenoh tells of both from different threads; what counts is how it is when they are heard."""
    callbacks, returned, status = [], queue.SimpleQueue(), SimpleNamespace(matching=False)
    querier = SimpleNamespace(
        declare_matching_listener=callbacks.append,
        matching_status=status,
        undeclare=lambda: [callback.drop() for callback in callbacks],
    )
    session = SimpleNamespace(declare_querier=lambda _: querier)
    presence = ShardPresence(session, "some/key", lambda: returned.put("back"))
    try:
        callbacks[0](SimpleNamespace(matching=False))
        assert (presence.here, returned.empty()) == (False, True)

        status.matching = True
        callbacks[0](SimpleNamespace(matching=False))  # the later one, of its going

        assert presence.here
        assert returned.get(timeout=30) == "back"
    finally:
        presence.close(30.0)


def test_presence_may_be_asked_while_it_is_ended(endpoint):
    """From another thread: Zenoh's binding raises where one reads and another undeclares."""
    session = open_session(listen=[endpoint], lease_s=1.0)
    presences, asked, over, errors = [], threading.Event(), threading.Event(), []

    def ask():
        try:
            while not over.is_set():
                for presence in presences[-1:]:
                    assert presence.here in {True, False}
                    asked.set()
        except BaseException as error:
            errors.append(error)
            raise

    asking = [threading.Thread(target=ask) for _ in range(2)]
    try:
        for thread in asking:
            thread.start()
        for number in range(20):
            presences.append(ShardPresence(session, f"enact/cell/s{number}/hello/x", list))
            asked.clear()
            assert asked.wait(30)
            presences[-1].close(30.0)
    finally:
        over.set()
        for thread in asking:
            thread.join()
        close_session(session)
    assert not errors
