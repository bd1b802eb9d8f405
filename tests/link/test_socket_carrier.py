"""Sockets between client and shard on one host: when they are taken, lost and found again."""

import logging
import os
import signal
import statistics
import threading
import time
from types import SimpleNamespace

import pytest
from parked_parts import parked
from socket_parts import COUNT, CUP, add_one, carrier_of, over_socket

from enact_dist import Entity, Lock, Write, connect
from enact_dist.access import watch as watches
from enact_dist.core.protocol.messages import (
    Hello,
    ListLocks,
    ListSessions,
    Locks,
    Reached,
)
from enact_dist.errors import ConfigError, LinkError
from enact_dist.link.memory.shared_folder import open_shared
from enact_dist.link.socket.carrier import LATE_S, SocketCarrier
from enact_dist.link.socket.line import SocketLine
from enact_dist.link.socket.watcher import SKIP_S
from enact_dist.link.zenoh.carrier import ZenohCarrier

pytestmark = pytest.mark.carrier("auto")  # what is taken, and when, is what is tested

# ---------------------------------------------------------------- which way


def test_socket_is_taken_where_both_ends_share_the_folder(daemon, endpoint):
    """Nobody has to ask for it; the first call after the welcome takes it."""
    daemon(endpoint)

    with connect(endpoint) as cell:
        add_one(cell)
        carrier = carrier_of(cell)

        assert carrier.transport_of("s0") == "socket"
        assert carrier.calls["zenoh"] == 0
        assert carrier.calls["socket"] >= 2
        assert [shard.carrier for shard in cell.shards()] == ["socket"]


def test_zenoh_alone_is_taken_where_it_is_asked_for(daemon, endpoint, monkeypatch):
    """`ENACT_CARRIER=zenoh` makes a client without sockets."""
    daemon(endpoint)
    monkeypatch.setenv("ENACT_CARRIER", "zenoh")

    with connect(endpoint) as cell:
        add_one(cell)

        assert isinstance(carrier_of(cell), ZenohCarrier)


def test_unknown_carrier_is_refused_by_name(daemon, endpoint, monkeypatch):
    """A misspelt choice is no silent default, also where only an endpoint is given."""
    monkeypatch.setenv("ENACT_CARRIER", "sokcet")

    with pytest.raises(ConfigError, match="sokcet"):
        connect(endpoint)


def test_zenoh_is_taken_where_the_folder_is_not_shared(daemon, endpoint, monkeypatch, tmp_path):
    """A client with other shared memory falls back without an error, and says why to people."""
    daemon(endpoint)
    monkeypatch.setenv("ENACT_SHARED_FOLDER", str(tmp_path))

    with connect(endpoint) as cell:
        request = add_one(cell)
        with Lock(request) as lock:
            assert lock[request] == 1

        assert "not shared with this process" in carrier_of(cell).transport_of("s0")
        assert carrier_of(cell).calls["socket"] == 0


def test_zenoh_is_taken_where_the_folder_is_another_one(daemon, endpoint, shared_root):
    """A folder of the same name with another nonce, as after a restart with new memory."""
    shard = daemon(endpoint)
    nonce = shard._shared.path / "nonce"
    nonce.chmod(0o600)
    nonce.write_bytes(os.urandom(16))

    with connect(endpoint) as cell:
        add_one(cell)

        assert "nonces differ" in carrier_of(cell).transport_of("s0")


def test_socket_that_is_asked_for_and_impossible_is_an_error(
    daemon, endpoint, monkeypatch, tmp_path
):
    """Forced, a client does not fall back: it says what is wrong with the socket."""
    daemon(endpoint)
    monkeypatch.setenv("ENACT_CARRIER", "socket")
    monkeypatch.setenv("ENACT_SHARED_FOLDER", str(tmp_path))

    with pytest.raises(LinkError, match=r"a socket is required.*not shared with this process"):
        connect(endpoint)


def test_forced_socket_of_a_shard_that_has_gone_since_its_welcome_is_no_error(
    daemon, endpoint, monkeypatch
):
    """It is killed between its welcome and the connection: the client waits for its next start."""
    first = daemon(endpoint)
    monkeypatch.setenv("ENACT_CARRIER", "socket")
    with connect(endpoint) as cell:
        add_one(cell)
        first.stop()
        second = daemon(endpoint)
        gone, there = threading.Event(), threading.Event()

        def learn_late(carrier, welcome, _learn=SocketCarrier.learn):
            if welcome.epoch == second.host.epoch:
                second.stop()
                gone.set()
                assert there.wait(60)
            _learn(carrier, welcome)

        monkeypatch.setattr(SocketCarrier, "learn", learn_late)
        following = []
        starting = threading.Thread(
            target=lambda: (gone.wait(60), following.append(daemon(endpoint)), there.set())
        )
        starting.start()
        add_one(cell)
        starting.join()

        assert carrier_of(cell).transport_of("s0") == "socket"
        assert [shard.epoch for shard in cell.shards()] == [following[0].host.epoch]


def test_forced_socket_that_another_thread_could_not_have_is_no_error(
    daemon, endpoint, monkeypatch
):
    """What is wrong is asked of the own attempt: another one may fail at the same moment."""
    daemon(endpoint)
    monkeypatch.setenv("ENACT_CARRIER", "socket")

    def tried(carrier, line, open_one, _tried=SocketCarrier.tried):
        connection = _tried(carrier, line, open_one)
        line.problem = "[Errno 104] Connection reset by peer"  # as the other thread was told
        return connection

    monkeypatch.setattr(SocketCarrier, "tried", tried)
    with connect(endpoint) as cell:
        add_one(cell)

        assert carrier_of(cell).calls["zenoh"] == 0


# ---------------------------------------------------------------- lost on the way


def test_calls_go_on_over_zenoh_when_the_socket_is_gone(daemon, endpoint):
    """The file is deleted and all connections broken: no call fails, and the way is told."""
    shard = daemon(endpoint)
    with connect(endpoint) as cell:
        request = add_one(cell)
        shard._sockets.close()
        (shard._shared.path / "socket").unlink()

        for _ in range(5):
            add_one(cell)
        with Lock(request) as lock:
            assert lock[request] == 6

        assert carrier_of(cell).transport_of("s0").startswith("zenoh")


def test_open_connections_outlive_the_file(daemon, endpoint, until):
    """A deleted file ends no call; only what has to connect anew takes the other way."""
    shard = daemon(endpoint)
    with connect(endpoint) as cell, connect(endpoint) as other:
        request = add_one(cell)
        (shard._shared.path / "socket").unlink()
        before = carrier_of(cell).calls["socket"]
        with Lock(request) as lock:
            waiting = threading.Thread(target=lambda: add_one(cell))
            waiting.start()
            until(lambda: not all(one.granted for one in other.locks()))
            lock[request] = 10
        waiting.join()
        with Lock(request) as lock:
            assert lock[request] == 11

        assert carrier_of(cell).calls["socket"] > before


def test_socket_is_taken_again_after_a_restart(daemon, endpoint, until):
    """The next welcome names the new folder; nothing of the old one is left."""
    shard = daemon(endpoint)
    with connect(endpoint) as cell:
        add_one(cell)
        first = shard._shared.path
        shard.stop(drain_s=0.0)
        assert not first.exists()
        again = daemon(endpoint)

        add_one(cell)

        until(lambda: carrier_of(cell).transport_of("s0") == "socket")
        before = dict(carrier_of(cell).calls)
        add_one(cell)
        after = carrier_of(cell).calls
        assert after["zenoh"] == before["zenoh"]
        assert after["socket"] >= before["socket"] + 2
        assert again._shared.path.exists()


@over_socket
def test_late_answer_never_meets_the_next_call(daemon, carry, endpoint):
    """A connection whose answer was not waited for is thrown away."""
    daemon(endpoint)
    carrier = carry(endpoint)
    before, late = carrier.calls["zenoh"], []
    question = parked(carrier, 0.15)

    for _ in range(100):  # whose thread stands still has its answer in time
        late.append(carrier.request("s0", question, timeout_s=0.05) is None)
        assert isinstance(carrier.request("s0", ListLocks(), timeout_s=30), Locks)
        if sum(late) == 5:
            break
    assert carrier.request("s0", question, timeout_s=30) is not None  # after all late answers

    assert isinstance(carrier.request("s0", ListLocks(), timeout_s=30), Locks)
    assert (sum(late), carrier.calls["zenoh"]) == (5, before)


@over_socket
def test_calls_beyond_the_connections_of_a_client_take_zenoh(daemon, carry, endpoint):
    """More calls at once than a client may have connections: all of them are answered."""
    daemon(endpoint)
    carrier = carry(endpoint)

    question = parked(carrier, 0.3)
    before = carrier.calls["socket"]

    answers = carrier.request_all([("s0", question)] * 120, timeout_s=30)

    assert {type(answer) for answer in answers} == {Reached}
    assert carrier.calls["socket"] - before == 100
    assert isinstance(carrier.request("s0", ListLocks(), timeout_s=30), Locks)


# ---------------------------------------------------------------- many threads


@pytest.mark.timing
def test_waiting_threads_do_not_slow_a_fast_one(daemon, endpoint, until):
    """Eight threads in long polls: the ninth is as fast as alone, each has its own connection."""
    daemon(endpoint)
    with connect(endpoint) as cell, connect(endpoint) as other:
        held, free = Write(cell.world("online"), CUP, COUNT), Entity("free")
        add_one(cell, free)

        def median_s():
            times_s = []
            for _ in range(100):
                started_s = time.perf_counter()
                add_one(cell, free)
                times_s.append(time.perf_counter() - started_s)
            return statistics.median(times_s)

        release, holding = threading.Event(), threading.Event()

        def hold():
            with Lock(Write(other.world("online"), CUP, COUNT)):
                holding.set()
                release.wait()

        threads = [threading.Thread(target=hold)]
        threads[0].start()
        holding.wait()
        threads += [threading.Thread(target=lambda: add_one(cell)) for _ in range(8)]
        for thread in threads[1:]:
            thread.start()
        until(lambda: sum(not lock.granted for lock in other.locks()) == 8)
        beside_s = [median_s() for _ in range(3)]
        release.set()
        for thread in threads:
            thread.join()
        with Lock(held) as lock:
            assert lock[held] == 8
        alone_s = [median_s() for _ in range(3)]

    # A wait for one of the others would be a hundred times as long.
    assert min(beside_s) < 10 * min(alone_s), (beside_s, alone_s)


def test_watch_lists_nothing_again_while_only_other_slots_change(
    daemon, endpoint, until, monkeypatch
):
    """The numbers that it skips are told without another notice, before they count as missing."""
    daemon(endpoint)
    with connect(endpoint) as cell:
        request = add_one(cell)
        with cell.world("online").watch("somebody/else") as watch:
            listed, following, now_s = [], watch._following["s0"], 0.0
            monkeypatch.setattr(watch, "_list_again", lambda *_args, **_more: listed.append(1))
            # For the watch time stands still, so that nothing is missing for long but by the test.
            monkeypatch.setattr(watches, "time", SimpleNamespace(monotonic=lambda: now_s))
            for _ in range(4):
                with Lock(request) as lock:
                    lock[request] += 1
                cell._client.greet()
                sent = cell._client.notice_numbers["s0"]

                def follows(sent=sent):
                    assert watch.next(timeout_s=0) is None
                    return (following.epoch, following.number) >= sent

                until(follows)
                now_s += 2 * LATE_S
                assert watch.next(timeout_s=0) is None
        assert listed == []
    assert SKIP_S < LATE_S == watch._feed.late_s


def test_carrier_says_what_went_over_what(daemon, endpoint, until):
    """The sessions of a shard are those of the clients, whichever way they come."""
    daemon(endpoint)
    with connect(endpoint, actor="one") as cell:

        def sessions():
            answer = carrier_of(cell).request("s0", ListSessions(), timeout_s=30)
            assert answer is not None
            return [(info.actor, info.token_present) for info in answer.sessions]

        assert until(lambda: sessions() == [("one", True)], limit_s=30.0)
        assert isinstance(carrier_of(cell), SocketCarrier)


def test_folder_of_the_shard_is_the_one_of_its_welcome(daemon, carry, endpoint):
    """What a WELCOME says can be opened."""
    shard = daemon(endpoint)
    hello = Hello("me", 0, 2_000_000_000, "me", "h", 1, True)
    welcome = carry(endpoint).request("s0", hello, timeout_s=30)

    opened = open_shared(welcome.shared, welcome.shared_nonce)

    assert opened.path == shard._shared.path
    opened.close()


@over_socket
def test_connection_that_is_given_back_while_the_line_closes_is_closed(daemon, carry, endpoint):
    """Whoever is through with its call at that very moment leaves no descriptor open."""
    daemon(endpoint)
    carrier = carry(endpoint)
    line = carrier._lines["s0"]
    connection = line.take()

    class Closing(list):
        def append(self, given):
            line.close()
            super().append(given)

    line.idle = Closing()
    line.give_back(connection)

    assert connection.socket.fileno() == -1


@over_socket
def test_size_of_slices_is_asked_while_a_shard_is_learned(daemon, carry, endpoint):
    """A thread that fetches and one that meets a further shard do not meet."""
    daemon(endpoint)
    carrier = carry(endpoint)

    class Learning:
        @property
        def problem(self):
            carrier._lines["s9"] = carrier._lines["s0"]
            return ""

        def close(self):
            return

    carrier._lines["s8"] = Learning()
    carrier._shards.add("s8")

    assert carrier.fetch_bytes > 0


@over_socket
def test_call_on_a_connection_that_was_just_closed_takes_the_other_way(daemon, carry, endpoint):
    """Another thread may close an idle connection while one takes it: nobody is shown EBADF."""
    daemon(endpoint)
    carrier = carry(endpoint)
    carrier._lines["s0"].idle[-1].socket.close()

    answers = carrier.request_all([("s0", ListLocks())], timeout_s=30)
    answers.append(carrier.request("s0", ListLocks(), timeout_s=30))

    assert [type(answer) for answer in answers] == [Locks, Locks]


@over_socket
def test_signals_do_not_lengthen_a_call(daemon, carry, endpoint):
    """A program with an interval timer interrupts each wait; together they last no longer."""
    daemon(endpoint)
    carrier = carry(endpoint)
    came, question = [], parked(carrier, 30.0)
    before = signal.signal(signal.SIGALRM, lambda *_: came.append(time.monotonic()))
    signal.setitimer(signal.ITIMER_REAL, 0.05, 0.05)
    try:
        while len(came) < 2:  # of a thread that stood still there may be one in a call
            answer = carrier.request("s0", question, timeout_s=0.2)
            assert answer is None  # it comes after half a minute
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


def test_shard_that_offers_no_socket_is_told_of_once(tmp_path, monkeypatch, caplog):
    """Its line tries again and again while the shard is gone; its log is not filled by that."""
    monkeypatch.setenv("ENACT_SHARED_FOLDER", str(tmp_path))
    line = SocketLine("s0", "s0-1", bytes(16), b"session tester")
    with caplog.at_level(logging.DEBUG, "enact.link"):
        for _ in range(3):
            line._retry_at_s = 0.0
            assert line.connect() is None

    (said,) = caplog.messages
    assert "is not shared with this process, or its shard is gone" in said
