"""What a shard's socket refuses, and that a client that does not read delays nobody."""

import os
import queue
import threading
import time

from socket_parts import ask, counters

from enact_dist.core.protocol.messages import (
    AwaitStamp,
    ListLocks,
    Locks,
    Reached,
    Refused,
)
from enact_dist.link.socket import connection as socket_connection
from enact_dist.link.socket import service as socket_service
from enact_dist.link.socket.frames import FrameKind, Stream, greeting_of, send_frame
from enact_dist.wire.frames import decode_frame, encode_frame

"""How long an answer that nothing delays may take on a busy machine."""

OPENS = """
import socket, sys
from enact_dist.link.socket.frames import FrameKind, Stream, greeting_of, send_frame
near = socket.socket(socket.AF_UNIX)
near.connect(sys.argv[1])
send_frame(near, greeting_of(sys.argv[2], "tester"), kind=FrameKind.OPEN)
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

    assert kind == FrameKind.REFUSED
    assert b"starts no frame" in text
    assert counters(raw.shard)["connections_refused"] == 1
    assert isinstance(ask(raw(), ListLocks()), Locks)


def test_answer_that_another_thread_brings_at_once_is_sent_once(raw, monkeypatch):
    """The connection's thread looks for its answer while another one is sending it."""
    near = raw()
    stream = Stream(near)
    sending, looked = threading.Event(), threading.Event()
    submit, threads, connection_of = raw.shard.host.submit, [], socket_connection.SocketConnection
    send_what_fits = connection_of._send_what_fits

    def slowly(connection, answer):
        sending.set()
        assert looked.wait(30)  # as if the kernel had let the other thread run
        return send_what_fits(connection, answer)

    def noted(act):
        return lambda *arguments: (looked.set(), act(*arguments))

    def brought_by_another(message, reply, identity, subject=None, lends=False):
        answers = queue.SimpleQueue()
        submit(message, answers.put, identity)
        answer = answers.get(timeout=30)
        threads.append(threading.Thread(target=reply, args=(answer,)))
        threads[-1].start()
        assert sending.wait(30)

    monkeypatch.setattr(connection_of, "_send_what_fits", slowly)
    for name in ("_send", "_send_late"):  # whichever it comes to
        monkeypatch.setattr(connection_of, name, noted(getattr(connection_of, name)))
    monkeypatch.setattr(raw.shard.host, "submit", brought_by_another)
    first = ask(near, AwaitStamp(0, 0), stream)
    threads[0].join()
    sending.clear()
    looked.clear()
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
    send_frame(one_more, greeting_of("greedy", "tester"), kind=FrameKind.OPEN)

    kind, text, _ = Stream(one_more).receive()

    assert (kind, b"3 connections" in text) == (FrameKind.REFUSED, True)
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
    send_frame(one_more, greeting_of("greedy4", "tester"), kind=FrameKind.OPEN)
    kind, text, _ = Stream(one_more).receive()
    folder = raw.shard._shared.path
    other = program(OPENS, folder / "socket", "modest")

    assert kind == FrameKind.REFUSED
    assert b"the last 4 are reserved for others" in text
    assert other.stdout.readline() == f"{int(FrameKind.OPENED)}\n"
    assert counters(raw.shard)["quota_refused"] == 1
    kept[0].close()
    kept[1].close()
    until(lambda: raw.shard._sockets._count == 3)
    raw("greedy4")


def test_session_of_one_process_is_not_opened_by_another_one(raw, program):
    """The kernel says who connects; a session is one process."""
    mine = raw("mine")
    other = program(OPENS, raw.shard._shared.path / "socket", "mine")

    assert other.stdout.readline() == f"{int(FrameKind.REFUSED)}\n"
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

    def admit_late(served, connection, session, secret):
        admit(served, connection, session, secret)
        left.append(session)
        assert gone.wait(30)

    monkeypatch.setattr(socket_service.SocketService, "admit", admit_late)
    for near in nears:
        send_frame(near, greeting_of("hasty", "tester"), kind=FrameKind.OPEN)
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


def test_request_that_was_read_is_handled_before_the_tick(raw, monkeypatch, until):
    """What a thread has taken from its socket and not handed in yet has arrived, too."""
    service, host = raw.shard._sockets, raw.shard.host
    decoding, go_on, decode = threading.Event(), threading.Event(), decode_frame

    def decode_slowly(*frame):
        decoding.set()
        assert go_on.wait(30)  # as if the interpreter let others run first
        return decode(*frame)

    monkeypatch.setattr(socket_connection, "decode_request", decode_slowly)
    monkeypatch.setattr(socket_service, "DRAIN_ROUNDS", 100_000)
    rounds, wait = [], service._closing.wait

    def noted(limit_s):
        rounds.append(threading.current_thread())
        return wait(limit_s)

    monkeypatch.setattr(service._closing, "wait", noted)
    send_frame(raw(), encode_frame(ListLocks())[0])
    assert decoding.wait(30)
    handed_in, found = host._handles, []
    drain = threading.Thread(target=lambda: (service.drain_inbox(), found.append(host._handles)))
    drain.start()
    until(lambda: drain in rounds or not drain.is_alive())  # an empty drain would be over
    go_on.set()
    drain.join()

    assert found == [handed_in + 1]


def test_shard_serves_no_stranger(raw):
    """A peer that is neither the shard's user nor root gets no connection."""
    raw.shard._sockets._users = frozenset((123_456,))
    near = raw(greet=False)
    send_frame(near, greeting_of("stranger", "tester"), kind=FrameKind.OPEN)

    kind, text, _ = Stream(near).receive()

    assert (kind, b"for user 123456" in text) == (FrameKind.REFUSED, True)


def test_service_ends_in_time_though_its_threads_do_not(raw, monkeypatch):
    """Connections that cannot be ended share half a second to end: 60 take no half minute."""
    monkeypatch.setattr(socket_connection.SocketConnection, "end", lambda _: None)
    kept = [raw(f"stubborn{number}") for number in range(60)]
    started_s = time.monotonic()

    raw.shard._sockets.close()

    assert time.monotonic() - started_s < 15.0
    assert len(kept) == 60
