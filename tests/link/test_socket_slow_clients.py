"""A client or watcher that does not read delays nobody, and gets what it is owed when it reads."""

import os
import select
import socket
import threading
from types import SimpleNamespace

import pytest
from socket_parts import ask, counters, over_socket, speak

from enact_dist.core.protocol.datum import Slot
from enact_dist.core.protocol.messages import (
    Committed,
    Granted,
    Hello,
    ListLocks,
    Locks,
    Notice,
    SlotChange,
    Survey,
)
from enact_dist.core.state import grants as tenures
from enact_dist.link.notices import Interest
from enact_dist.link.socket import connection as socket_connection
from enact_dist.link.socket import service as socket_service
from enact_dist.link.socket import watcher as socket_watcher
from enact_dist.link.socket.frames import FrameKind, Stream, read_skipped, send_frame
from enact_dist.link.socket.watcher import OutgoingNotice
from enact_dist.terms import Access
from enact_dist.wire.frames import decode_frame, encode_frame

ANSWER_S = 30.0


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
    send_frame(watcher, b"", kind=FrameKind.WATCH)
    stream = Stream(writer)
    peer = make_peer(lambda _, message: ask(writer, message, stream), session="writer")
    peer.hello()
    for number in range(1500):
        assert isinstance(_write(peer, writer, stream, b"%d" % number), Committed)

    assert counters(raw.shard)["notices_dropped"] > 0


def test_what_waits_for_a_watcher_that_does_not_read_carries_no_data(raw, make_peer, until):
    """It asked for data of 4 kB; the shard keeps the bare notices for it."""
    near, writer = raw("watcher"), raw("writer")
    interest, _ = encode_frame(Survey((), (), (), data=True))
    send_frame(near, interest, kind=FrameKind.WATCH)
    (connection,) = raw.shard._sockets._connections["watcher"]
    connection.connected.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1)
    until(lambda: raw.shard._sockets._watchers)
    (watcher,) = raw.shard._sockets._watchers
    until(lambda: not watcher._waiting)
    stream = Stream(writer)
    peer = make_peer(lambda _, message: ask(writer, message, stream), session="writer")
    peer.hello()

    for number in range(100):
        body = b"%03d" % number + bytes(3_900)
        assert isinstance(_write(peer, writer, stream, body), Committed)

    waiting = [len(frame) for frame in watcher._waiting]
    assert len(waiting) > 50
    assert max(waiting[1:]) < 200
    reading, found = Stream(near), []
    near.settimeout(ANSWER_S)
    while len(found) < 100:
        kind, *frame = reading.receive()
        found += [decode_frame(*frame)] if kind == FrameKind.MESSAGE else []
    carried = [bool(one.changes[0].datum) for one in found]
    assert carried[0]
    assert not carried[-1]


def test_watcher_that_reads_again_gets_all_that_was_kept_for_it(raw, monkeypatch, until):
    """Its thread may run at once when the bell rings: it then knows that there is more to send."""
    bell = watching_after_each_bell(monkeypatch)
    near = raw("watcher")
    (connection,) = raw.shard._sockets._connections["watcher"]
    connection.connected.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1)
    send_frame(near, b"", kind=FrameKind.WATCH)
    stream = Stream(near)
    assert stream.receive()[0] == FrameKind.OPENED
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
            watcher.put(OutgoingNotice(Notice("s0", 1, 2, ())))

    service = SimpleNamespace(host=SimpleNamespace(count=count))
    near, far = socket.socketpair()
    with near, far:
        cup = Interest(Survey(("online",), ("cup",), ("count",)))
        watcher = socket_watcher.SocketWatcher(service, near, cup)
        watcher.put(OutgoingNotice(Notice("s0", 1, 1, ())))
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
    send_frame(near, b"", kind=FrameKind.WATCH)

    first, second = stream.receive(), stream.receive()

    assert (first[0], second[0]) == (FrameKind.OPENED, FrameKind.MESSAGE)
    assert decode_frame(*second[1:]) == notice


def test_watcher_gets_what_it_watches_and_the_numbers_of_the_rest(raw):
    """Notices of other slots wake nobody; their numbers come before the next one, or late alone."""
    near = raw("watcher")
    stream = Stream(near)
    interest, _ = encode_frame(Survey(("online",), ("cup",), ("count",)))
    send_frame(near, interest, kind=FrameKind.WATCH)
    assert stream.receive()[0] == FrameKind.OPENED
    service, epoch = raw.shard._sockets, raw.shard.host.epoch

    def publish(number, entity):
        change = SlotChange(Slot("online", entity, "count"), 1, 1, False)
        service._publish(Notice("s0", epoch, number, (change,)))

    for number, entity in ((11, "tray"), (12, "tray"), (13, "cup"), (14, "tray")):
        publish(number, entity)

    kinds, headers, _ = zip(*(stream.receive() for _ in range(3)), strict=True)
    assert kinds == (FrameKind.SKIPPED, FrameKind.MESSAGE, FrameKind.SKIPPED)
    assert read_skipped(headers[0]) == (epoch, 10, 12)
    assert decode_frame(headers[1], b"").number == 13
    assert read_skipped(headers[2]) == (epoch, 13, 14)


def test_watcher_that_says_nonsense_is_refused(raw):
    """What is watched is a Survey and nothing else."""
    near = raw("watcher")
    header, _ = encode_frame(ListLocks())

    send_frame(near, header, kind=FrameKind.WATCH)

    kind, text, _ = Stream(near).receive()
    assert kind == FrameKind.REFUSED
    assert b"ListLocks came instead of what to watch" in text


def _write(peer, writer, stream, body):
    granted = peer.acquire("cup")
    from enact_dist.core.protocol.datum import Datum, Slot
    from enact_dist.core.protocol.messages import Commit, WriteItem

    datum = Datum(b"\x01", body, len(body))
    item = WriteItem(Slot("online", "cup", "count"), datum)
    header, payload = encode_frame(Commit(granted.lock, granted.token, (item,), 0))
    send_frame(writer, header, [payload])
    _, header, payload = stream.receive()
    return decode_frame(header, payload)
