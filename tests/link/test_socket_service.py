"""What a shard's socket refuses, and that a client that does not read delays nobody."""

import os
import queue
import select
import socket
import threading
import time
from types import SimpleNamespace

import pytest
from socket_parts import ask, counters, over_socket, speak

from enact_dist.core.protocol.datum import Slot
from enact_dist.core.protocol.messages import (
    AwaitStamp,
    Committed,
    Granted,
    Hello,
    ListLocks,
    Locks,
    Notice,
    Reached,
    Refused,
    Survey,
)
from enact_dist.core.state import grants as tenures
from enact_dist.link.notices import Interest
from enact_dist.link.socket import connection as socket_connection
from enact_dist.link.socket import service as socket_service
from enact_dist.link.socket import watcher as socket_watcher
from enact_dist.link.socket.frames import Kind, Stream, greeting_of, read_skipped, send_frame
from enact_dist.terms import Access
from enact_dist.wire.frames import decode_frame, encode_frame

ANSWER_S = 30.0
"""How long an answer that nothing delays may take on a busy machine."""

OPENS = """
import socket, sys
from enact_dist.link.socket.frames import Kind, Stream, greeting_of, send_frame
near = socket.socket(socket.AF_UNIX)
near.connect(sys.argv[1])
send_frame(near, greeting_of(sys.argv[2], "tester"), kind=Kind.OPEN)
kind, text, _ = Stream(near).receive()
print(int(kind), text.decode(), sep="\\n", flush=True)
sys.stdin.read()
"""

# ---------------------------------------------------------------- what the shard refuses


def test_connection_without_a_greeting_is_refused_and_the_others_served(raw):
    """Garbage in place of a greeting ends that connection, by name and counted."""
    stranger = raw(greet=False)
    stranger.sendall(b"GET / HTTP/1.1\r\n\r\n")

    kind, text, _ = Stream(stranger).receive()

    assert kind == Kind.REFUSED
    assert b"starts no frame" in text
    assert counters(raw.shard)["connections_refused"] == 1
    assert isinstance(ask(raw(), ListLocks()), Locks)


def test_answer_that_another_thread_brings_at_once_is_sent_once(raw, monkeypatch):
    """The connection's thread looks for its answer while another one is sending it."""
    near = raw()
    stream = Stream(near)
    sending, submit, threads = threading.Event(), raw.shard.host.submit, []
    send_what_fits = socket_connection.SocketConnection._send_what_fits

    def slowly(connection, answer):
        sending.set()
        time.sleep(0.1)  # as if the kernel had let the other thread run
        return send_what_fits(connection, answer)

    def brought_by_another(message, reply, identity):
        answers = queue.SimpleQueue()
        submit(message, answers.put, identity)
        answer = answers.get(timeout=30)
        threads.append(threading.Thread(target=reply, args=(answer,)))
        threads[-1].start()
        assert sending.wait(30)

    monkeypatch.setattr(socket_connection.SocketConnection, "_send_what_fits", slowly)
    monkeypatch.setattr(raw.shard.host, "submit", brought_by_another)
    first = ask(near, AwaitStamp(0, 0), stream)
    sending.clear()
    threads[0].join()
    second = ask(near, ListLocks(), stream)

    assert (type(first), type(second)) == (Reached, Locks)


def test_frame_that_cannot_be_read_is_refused_and_the_connection_goes_on(raw):
    """A damaged message is answered with its refusal; the next one is served."""
    near = raw()
    stream = Stream(near)
    send_frame(near, b"\xff\x00garbage")
    _, header, _ = stream.receive()

    assert isinstance(decode_frame(header), Refused)
    assert isinstance(ask(near, ListLocks(), stream), Locks)
    assert counters(raw.shard)["frames_refused"] == 1


def test_answer_in_place_of_a_request_is_refused(raw):
    """Only requests are handled."""
    answer = ask(raw(), Locks(1, ()))

    assert isinstance(answer, Refused)
    assert "no request" in answer.text


def test_session_with_too_many_connections_is_refused_by_name(raw, monkeypatch):
    """One process cannot take all threads of a shard; what is refused is counted."""
    monkeypatch.setattr(socket_service, "SESSION_CONNECTIONS_MAX", 3)
    kept = [raw("greedy") for _ in range(3)]
    one_more = raw("greedy", greet=False)
    send_frame(one_more, greeting_of("greedy", "tester"), kind=Kind.OPEN)

    kind, text, _ = Stream(one_more).receive()

    assert (kind, b"3 connections" in text) == (Kind.REFUSED, True)
    assert isinstance(ask(raw("modest"), ListLocks()), Locks)
    assert isinstance(ask(kept[0], ListLocks()), Locks)


def test_process_that_opens_more_than_its_share_leaves_the_rest_to_others(
    raw, monkeypatch, program, until
):
    """While many are free it may have more; the last ones are for processes with fewer."""
    for name, most in (("CONNECTIONS_MAX", 8), ("PROCESS_CONNECTIONS_MAX", 3), ("KEPT_FREE", 4)):
        monkeypatch.setattr(socket_service, name, most)
    kept = [raw(f"greedy{number}") for number in range(4)]
    one_more = raw("greedy4", greet=False)
    send_frame(one_more, greeting_of("greedy4", "tester"), kind=Kind.OPEN)
    kind, text, _ = Stream(one_more).receive()
    folder = raw.shard._shared.path
    other = program(OPENS, folder / "socket", "modest")

    assert kind == Kind.REFUSED
    assert b"the last 4 are reserved for others" in text
    assert other.stdout.readline() == f"{int(Kind.OPENED)}\n"
    assert counters(raw.shard)["quota_refused"] == 1
    kept[0].close()
    kept[1].close()
    until(lambda: raw.shard._sockets._count == 3)
    raw("greedy4")


def test_session_of_one_process_is_not_opened_by_another_one(raw, program):
    """The kernel says who connects; a session is one process."""
    mine = raw("mine")
    other = program(OPENS, raw.shard._shared.path / "socket", "mine")

    assert other.stdout.readline() == f"{int(Kind.REFUSED)}\n"
    text = other.stdout.readline()
    assert f"belongs to process {os.getpid()} of user" in text
    assert f"process {other.pid} of user" in text
    assert isinstance(ask(mine, ListLocks()), Locks)


def test_place_of_a_connection_is_free_again_when_it_ends(raw, monkeypatch, until):
    """What has left counts no more."""
    monkeypatch.setattr(socket_service, "CONNECTIONS_MAX", 2)
    first, _ = raw("a"), raw("b")
    first.close()

    until(lambda: raw.shard._sockets._count == 1)

    assert isinstance(ask(raw("c"), ListLocks()), Locks)


def test_place_of_a_client_that_left_before_its_greeting_was_answered_is_free(
    raw, monkeypatch, until
):
    """A busy shard answers late, and a client waits for half a second only: nothing stays counted."""
    service, admit = raw.shard._sockets, socket_service.SocketService.admit
    nears = [raw("hasty", greet=False) for _ in range(3)]
    left, gone = [], threading.Event()

    def admit_late(served, connection, session):
        admit(served, connection, session)
        left.append(session)
        assert gone.wait(30)

    monkeypatch.setattr(socket_service.SocketService, "admit", admit_late)
    for near in nears:
        send_frame(near, greeting_of("hasty", "tester"), kind=Kind.OPEN)
    until(lambda: len(left) == 3)
    for near in nears:
        near.close()
    gone.set()

    until(lambda: service._count == 0)
    assert service._connections == {}
    assert not service._deaths._watched["hasty"].connections


def test_kernel_that_watches_no_more_processes_costs_nobody_a_connection(raw, monkeypatch, until):
    """Then a death is noticed by the end of the lease, as over a network."""
    service = raw.shard._sockets

    class Full:
        def register(self, *_):
            raise OSError(28, "No space left on device")

    real, service._deaths._poll = service._deaths._poll, Full()
    try:
        near = raw("unwatched")
        assert isinstance(ask(near, ListLocks()), Locks)
    finally:
        service._deaths._poll = real
    near.close()

    until(lambda: service._count == 0)
    assert service._deaths._session_of == {}


def test_request_that_was_read_is_handled_before_the_tick(raw, monkeypatch):
    """What a thread has taken from its socket and not handed in yet has arrived, too."""
    service, host = raw.shard._sockets, raw.shard.host
    decoding, go_on, decode = threading.Event(), threading.Event(), decode_frame

    def decode_slowly(*frame):
        decoding.set()
        assert go_on.wait(30)  # as if the interpreter let others run first
        return decode(*frame)

    monkeypatch.setattr(socket_connection, "decode_request", decode_slowly)
    monkeypatch.setattr(socket_service, "DRAIN_ROUNDS", 5000)
    send_frame(raw(), encode_frame(ListLocks())[0])
    assert decoding.wait(30)
    handed_in, found = host._handles, []
    drain = threading.Thread(target=lambda: (service.drain_inbox(), found.append(host._handles)))
    drain.start()
    time.sleep(0.02)  # an empty drain would be over
    go_on.set()
    drain.join()

    assert found == [handed_in + 1]


def test_shard_serves_no_stranger(raw):
    """A peer that is neither the shard's user nor root gets no connection."""
    raw.shard._sockets._users = frozenset((123_456,))
    near = raw(greet=False)
    send_frame(near, greeting_of("stranger", "tester"), kind=Kind.OPEN)

    kind, text, _ = Stream(near).receive()

    assert (kind, b"for user 123456" in text) == (Kind.REFUSED, True)


# ---------------------------------------------------------------- slow clients


@pytest.fixture
def patient(monkeypatch):
    """Waits for a client that does not read take far longer than any answer may: nobody has one."""
    monkeypatch.setattr(socket_connection, "SEND_S", 20 * ANSWER_S)
    monkeypatch.setattr(tenures, "WAIT_SLICE_NS_MAX", 60 * 10**9)


def unread(raw, session):
    """Open a connection whose kernel takes a few kB of answers that its client does not read."""
    near = raw(session)
    (connection,) = raw.shard._sockets._connections[session]
    connection.connected.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1)
    ask(near, Hello(session, 0, 60 * 10**9, session, "h", 1, False))
    return near, connection


def ask_for_cup(near, make_peer, peer, session):
    """Send a request for the cup, for as long as it takes; its answer stays unread."""
    asking = make_peer(None, session=session, epoch=peer.epoch)
    message = asking.acquire_message("cup", wait_s=60.0, access=Access.READ)
    send_frame(near, encode_frame(message)[0])


@over_socket
def test_client_that_reads_no_answers_is_given_up(
    raw, carry, make_peer, endpoint, monkeypatch, until
):
    """It loses its connection after a while, counted."""
    monkeypatch.setattr(socket_connection, "SEND_S", 0.3)
    peer = speak(carry(endpoint, session="good"), make_peer, "good")
    peer.write("cup", os.urandom(50_000))
    near, connection = unread(raw, "stopped")

    ask_for_cup(near, make_peer, peer, "stopped")

    assert connection.ended.wait(ANSWER_S)
    assert counters(raw.shard)["answers_dropped"] == 1


@over_socket
@pytest.mark.usefixtures("patient")
def test_client_that_reads_no_answers_delays_nobody(raw, carry, make_peer, endpoint, until):
    """The others are answered all the time that the shard waits for it."""
    peer = speak(carry(endpoint, session="good"), make_peer, "good", timeout_s=ANSWER_S)
    peer.write("cup", os.urandom(50_000))
    near, connection = unread(raw, "stopped")
    ask_for_cup(near, make_peer, peer, "stopped")
    until(lambda: connection.step == 5)  # the second request, answered

    for _ in range(100):
        assert isinstance(peer.write("plate", b"1"), Committed)

    send_frame(near, encode_frame(ListLocks())[0])
    assert (connection.step, connection.ended.is_set()) == (5, False)
    answer, more = (decode_frame(*Stream(near).receive()[1:]) for _ in range(2))
    assert (type(answer), type(more)) == (Granted, Locks)


@over_socket
@pytest.mark.usefixtures("patient")
@pytest.mark.parametrize("size", [20_000, 60_000])
def test_grant_for_a_waiter_that_does_not_read_delays_nobody(
    raw, carry, make_peer, endpoint, until, size
):
    """Whoever releases a lock sends the next grant only as far as that goes without waiting."""
    peer = speak(carry(endpoint, session="good"), make_peer, "good", timeout_s=ANSWER_S)
    peer.write("cup", os.urandom(size))
    held = peer.acquire("cup")
    waiting = []
    for number in range(5):
        near, _ = unread(raw, f"waiter{number}")
        ask_for_cup(near, make_peer, peer, f"waiter{number}")
        waiting.append(near)
    until(lambda: len(peer.call("s0", ListLocks()).holders) == 6)

    assert isinstance(peer.commit(held, "cup", os.urandom(size)), Committed)

    for near in waiting:
        answer = decode_frame(*Stream(near).receive()[1:])
        assert isinstance(answer, Granted)


def test_watcher_that_does_not_read_delays_no_commit(raw, make_peer, monkeypatch):
    """Notices are kept for it up to a number, then dropped and counted; commits go on."""
    monkeypatch.setattr(socket_watcher, "NOTICES_MAX", 100)
    watcher, writer = raw("watcher"), raw("writer")
    send_frame(watcher, b"", kind=Kind.WATCH)
    stream = Stream(writer)
    peer = make_peer(lambda _, message: ask(writer, message, stream), session="writer")
    peer.hello()
    for number in range(1500):
        assert isinstance(_write(peer, writer, stream, number), Committed)

    assert counters(raw.shard)["notices_dropped"] > 0


def test_watcher_that_reads_again_gets_all_that_was_kept_for_it(raw, monkeypatch, until):
    """Its thread may run at once when the bell rings: it then knows that there is more to send."""
    bell = watching_after_each_bell(monkeypatch)
    near = raw("watcher")
    (connection,) = raw.shard._sockets._connections["watcher"]
    connection.connected.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1)
    send_frame(near, b"", kind=Kind.WATCH)
    stream = Stream(near)
    assert stream.receive()[0] == Kind.OPENED
    (watcher,) = raw.shard._sockets._watchers
    until(lambda: not watcher._waiting)
    sent = [Notice("s0", raw.shard.host.epoch, number, ()) for number in range(1, 1001)]

    for notice in sent:
        raw.shard._sockets._publish(notice)

    near.settimeout(ANSWER_S)
    assert [decode_frame(*stream.receive()[1:]) for _ in sent] == sent
    assert bell.rang


def test_watcher_whose_numbers_are_dropped_does_not_hold_up_a_commit(monkeypatch):
    """The timer counts them, for which it needs the host, while the host publishes to the watcher."""
    monkeypatch.setattr(socket_watcher, "NOTICES_MAX", 1)
    monkeypatch.setattr(socket_watcher, "SKIP_S", 0.0)
    mutex, counting = threading.RLock(), threading.Event()

    def count(_):
        counting.set()
        with mutex:
            pass

    def publish():
        with mutex:
            timer.start()
            assert counting.wait(ANSWER_S)
            watcher.put(Notice("s0", 1, 2, ()), b"")

    service = SimpleNamespace(host=SimpleNamespace(count=count))
    near, far = socket.socketpair()
    with near, far:
        cup = Interest(Survey(("online",), ("cup",), ("count",)))
        watcher = socket_watcher.SocketWatcher(service, near, cup)
        watcher.put(Notice("s0", 1, 1, ()), b"")
        timer = threading.Thread(target=watcher.tell_skipped, daemon=True)
        commit = threading.Thread(target=publish, daemon=True)
        commit.start()
        commit.join(10)

    assert counting.is_set()
    assert not commit.is_alive()


def watching_after_each_bell(monkeypatch):
    """Let a watcher's thread look what there is to send before its bell's ringing returns."""
    looked, bell = threading.Event(), SimpleNamespace(rang=0)

    class Poll:
        def __init__(self):
            self._poll = select.poll()
            self.register, self.poll = self._poll.register, self._poll.poll

        def modify(self, descriptor, events):
            self._poll.modify(descriptor, events)
            looked.set()

    def ring(descriptor, number):
        looked.clear()
        os.eventfd_write(descriptor, number)
        assert looked.wait(ANSWER_S)
        bell.rang += 1

    seen = SimpleNamespace(**{**vars(select), "poll": Poll})
    monkeypatch.setattr(socket_watcher, "select", seen)
    monkeypatch.setattr(
        socket_watcher, "os", SimpleNamespace(**{**vars(os), "eventfd_write": ring})
    )
    return bell


def test_watcher_is_welcomed_before_its_first_notice(raw, monkeypatch):
    """A commit at that very moment does not come in place of the answer to its request."""
    watch = socket_service.SocketService.watch
    notice = Notice("s0", raw.shard.host.epoch, 1, ())

    def watch_and_publish(service, watcher):
        watch(service, watcher)
        service._publish(notice)

    monkeypatch.setattr(socket_service.SocketService, "watch", watch_and_publish)
    near = raw("watcher")
    stream = Stream(near)
    send_frame(near, b"", kind=Kind.WATCH)

    first, second = stream.receive(), stream.receive()

    assert (first[0], second[0]) == (Kind.OPENED, Kind.MESSAGE)
    assert decode_frame(*second[1:]) == notice


def test_watcher_gets_what_it_watches_and_the_numbers_of_the_rest(raw):
    """Notices of other slots wake nobody; their numbers come before the next one, or late alone."""
    near = raw("watcher")
    stream = Stream(near)
    interest, _ = encode_frame(Survey(("online",), ("cup",), ("count",)))
    send_frame(near, interest, kind=Kind.WATCH)
    assert stream.receive()[0] == Kind.OPENED
    service, epoch = raw.shard._sockets, raw.shard.host.epoch

    def publish(number, entity):
        change = (Slot("online", entity, "count"), 1, 1, False, 0)
        service._publish(Notice("s0", epoch, number, (change,)))

    for number, entity in ((11, "tray"), (12, "tray"), (13, "cup"), (14, "tray")):
        publish(number, entity)

    kinds, headers, _ = zip(*(stream.receive() for _ in range(3)), strict=True)
    assert kinds == (Kind.SKIPPED, Kind.MESSAGE, Kind.SKIPPED)
    assert read_skipped(headers[0]) == (epoch, 10, 12)
    assert decode_frame(headers[1], b"").number == 13
    assert read_skipped(headers[2]) == (epoch, 13, 14)


def test_watcher_that_says_nonsense_is_refused(raw):
    """What is watched is a Survey and nothing else."""
    near = raw("watcher")
    header, _ = encode_frame(ListLocks())

    send_frame(near, header, kind=Kind.WATCH)

    kind, text, _ = Stream(near).receive()
    assert kind == Kind.REFUSED
    assert b"ListLocks came instead of what to watch" in text


def _write(peer, writer, stream, number):
    granted = peer.acquire("cup")
    from enact_dist.core.protocol.datum import Datum, Slot
    from enact_dist.core.protocol.messages import Commit, WriteItem

    datum = Datum(b"\x01", b"%d" % number, len(b"%d" % number))
    item = WriteItem(Slot("online", "cup", "count"), datum)
    header, payload = encode_frame(Commit(granted.lock, granted.token, (item,), 0))
    send_frame(writer, header, [payload])
    _, header, payload = stream.receive()
    return decode_frame(header, payload)


def test_service_ends_in_time_though_its_threads_do_not(raw, monkeypatch):
    """Connections that cannot be ended share half a second to end: 60 take no half minute."""
    monkeypatch.setattr(socket_connection.SocketConnection, "end", lambda _: None)
    kept = [raw(f"stubborn{number}") for number in range(60)]
    started_s = time.monotonic()

    raw.shard._sockets.close()

    assert time.monotonic() - started_s < 15.0
    assert len(kept) == 60
