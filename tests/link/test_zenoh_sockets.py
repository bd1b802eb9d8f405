"""Zenoh's TCP sockets hold up nobody, and do not wait for the kernel's next try after a cut."""

import contextlib
import errno
import os
import queue
import select
import signal
import socket
import struct
import threading
from types import SimpleNamespace

import pytest
import zenoh
from polling import until

from enact_dist.link.zenoh import config as zenoh_config
from enact_dist.link.zenoh import links as zenoh_links
from enact_dist.link.zenoh.config import close_session, open_session
from enact_dist.link.zenoh.links import _lost_after, connections, give_up, settle, unanswered
from enact_dist.link.zenoh.queries import wait_connected

LINGER = struct.Struct("ii")
ZENOHS = (1, 10)


def linger_of(connection):
    return LINGER.unpack(connection.getsockopt(socket.SOL_SOCKET, socket.SO_LINGER, LINGER.size))


def user_timeout_ms_of(connection):
    return connection.getsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT)


@pytest.mark.parametrize(
    ("before", "known", "after"),
    [
        (ZENOHS, True, (0, 1_500)),
        (ZENOHS, False, (1, 0)),
        ((1, 5), True, (1, 0)),
        ((0, 0), True, (0, 0)),
    ],
)
def test_only_zenohs_sockets_of_the_session_are_settled(before, known, after):
    """What a program has set on its own sockets stays, and another session has its own lease."""
    with (
        socket.create_server(("127.0.0.1", 0)) as listener,
        socket.create_connection(listener.getsockname()) as connection,
    ):
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, LINGER.pack(*before))
        ports = connection.getsockname()[1], connection.getpeername()[1]

        found = settle({ports if known else ports[::-1]: 1.5})

        assert (linger_of(connection)[0], user_timeout_ms_of(connection)) == after
        assert found == (after[1] > 0)


@pytest.mark.parametrize("default_s", [None, 60.0])
def test_sockets_of_the_program_go_on_as_it_has_set_them(monkeypatch, default_s):
    """Whether they block is nobody else's matter, whatever the program sets while we look."""
    with (
        socket.create_server(("127.0.0.1", 0)) as listener,
        socket.create_connection(listener.getsockname()) as connection,
        socket.create_connection(listener.getsockname()) as blocking,
    ):

        class Looked(socket.socket):
            def __init__(self, **options):
                super().__init__(**options)
                connection.setblocking(default_s is not None)

        connection.setblocking(default_s is None)
        before = socket.getdefaulttimeout()
        socket.setdefaulttimeout(default_s)
        monkeypatch.setattr(socket, "socket", Looked)
        try:
            for one in connections():
                one.close()
        finally:
            socket.setdefaulttimeout(before)

        assert os.get_blocking(connection.fileno()) == (default_s is not None)
        assert os.get_blocking(blocking.fileno())


def settled(port):
    """Return for how long either end of each connection to a port waits that is settled (ms)."""
    found = []
    for connection in connections():
        with connection, contextlib.suppress(OSError):  # one that listens has no other end
            ports = connection.getsockname()[1], connection.getpeername()[1]
            if port in ports and not linger_of(connection)[0]:
                found.append(user_timeout_ms_of(connection))
    return sorted(found)


def test_connections_of_sessions_are_settled_on_either_side(endpoint):
    """Both ends are in this process; a connection that comes later is seen, too."""
    port = int(endpoint.rpartition(":")[2])
    shard = open_session(listen=[endpoint], lease_s=1.0)
    clients = [open_session(connect=[endpoint], lease_s=lease_s) for lease_s in (2.0, 60.0)]
    expected = [750, 750, 3_000, 3_000]  # a client is as patient as a busy shard may need
    try:
        # No event reports that a thread has seen a connection.
        until(lambda: settled(port) == expected, missed=lambda: (settled(port), expected))
    finally:
        for session in (*clients, shard):
            close_session(session)


READER = """
import contextlib
import sys
import zenoh
from enact_dist.link.zenoh.config import open_session
session = open_session(connect=[sys.argv[1]], lease_s=60.0)
while True:  # until the queryable is known here, and then until the answer comes
    with contextlib.suppress(zenoh.ZError):
        session.get("large", timeout=60.0, congestion_control=zenoh.CongestionControl.BLOCK).recv()
"""


def test_reader_that_stops_in_mid_transfer_is_given_up_long_before_its_lease_ends(
    program, endpoint, monkeypatch
):
    """Whoever sends to it would wait as long as a lease, and after that Zenoh's own threads."""
    monkeypatch.setattr(zenoh_config, "CLIENT_BLOCK_S", 0.5)
    shard = open_session(listen=[endpoint], lease_s=60.0)
    others = []
    try:
        queryable = shard.declare_queryable("large", zenoh.handlers.FifoChannel(64))
        reader = program(READER, endpoint)
        query = queryable.handler.recv()
        reader.send_signal(signal.SIGSTOP)
        sending = threading.Thread(target=send, args=(query, bytes(64 << 20)), daemon=True)
        sending.start()

        sending.join(30.0)

        assert not sending.is_alive()
        others.append(open_session(connect=[endpoint], lease_s=60.0))
        assert wait_connected(others[0], 15.0)
    finally:
        for session in (*others, shard):
            close_session(session)


def send(query, data):
    with contextlib.suppress(zenoh.ZError), query:  # the connection goes meanwhile
        query.reply("large", data)


LEFT_OPEN = """
import sys
from enact_dist.link.zenoh import links as zenoh_links
from enact_dist.link.zenoh.config import open_session
zenoh_links.JOIN_S = 3600.0
kept = [open_session(listen=[endpoint], lease_s=1.0) for endpoint in sys.argv[1:]]
"""


def test_sessions_that_were_left_open_are_closed_before_their_threads_are_waited_for(
    program, endpoint, free
):
    """The threads end with the sessions; the other way round each would cost a second."""
    process = program(LEFT_OPEN, endpoint, free(), free())

    assert process.wait(timeout=60.0) == 0


FAR = "192.0.2.1"
"""An address of no host, and so none of this one."""


def link_events(kinds, host="127.0.0.1"):
    """Return events of connections that came (+) and went (-), each with ports of its own."""
    kind_of = {"+": zenoh.SampleKind.PUT, "-": zenoh.SampleKind.DELETE}
    return [
        SimpleNamespace(
            kind=kind_of[kind],
            link=SimpleNamespace(src=f"tcp/127.0.0.1:{port}", dst=f"tcp/{host}:1"),
        )
        for port, kind in enumerate(kinds, 2)
    ]


@pytest.mark.parametrize(
    ("kinds", "before", "lost"),
    [("+-", 0, 1), ("-+", 0, 0), ("++-", 0, 1), ("--", 0, 2), ("++-", 2, 1), ("+", 1, 0)],
)
def test_connection_that_comes_stands_for_a_lost_one(kinds, before, lost):
    """One that comes while none is lost is a new one, and makes up for none that goes later."""
    assert len(_lost_after(link_events(kinds), ["tcp/127.0.0.1:1"] * before)) == lost


def test_connection_to_another_address_stands_for_the_oldest_lost_one():
    """A host that was lost may come back with another address, and is looked for no more."""
    lost = _lost_after(link_events("-", "192.0.2.2") + link_events("-", "192.0.2.3"))
    assert lost == ["tcp/192.0.2.2:1", "tcp/192.0.2.3:1"]
    assert _lost_after(link_events("+", "192.0.2.3"), lost) == ["tcp/192.0.2.2:1"]
    assert _lost_after(link_events("+", "192.0.2.4"), lost) == ["tcp/192.0.2.3:1"]


def test_connections_of_all_sessions_are_settled_together(watching, monkeypatch):
    """Of a hundred none is looked for alone, and those that have gone are not looked for."""
    settled, begun, go_on = queue.SimpleQueue(), threading.Event(), threading.Event()

    def settle_later(user_timeout_s):
        settled.put(user_timeout_s)
        begun.set()
        go_on.wait(30.0)

    monkeypatch.setattr(zenoh_links, "settle", settle_later)
    first, second = watching(user_timeout_s=1.0), watching(user_timeout_s=2.0)
    first(link_events("+")[0])
    assert begun.wait(30.0)
    for event in link_events("+-+"):
        first(event)
        second(event)
    go_on.set()

    assert settled.get(timeout=30) == {(2, 1): 1.0}
    assert settled.get(timeout=30) == {(2, 1): 2.0, (4, 1): 2.0}
    assert settled.empty()


def test_connection_that_nobody_answers_is_given_up_and_no_other():
    """A listener whose queue is full answers nobody: the kernel would try again every second."""
    with socket.create_server(("127.0.0.1", 0), backlog=0) as full:
        address, port = full.getsockname()
        asking = [socket.socket() for _ in range(4)]
        for one in asking:
            one.setblocking(False)
            one.connect_ex((address, port))
        found = unanswered([(address, port)])[address, port]
        stuck = [one for one in asking if os.fstat(one.fileno()).st_ino in found]
        try:
            assert 0 < len(stuck) == len(found) < len(asking)
            assert unanswered([(address, port + 1)]) == {(address, port + 1): set()}

            give_up({os.fstat(stuck[0].fileno()).st_ino})

            left = unanswered([(address, port)])[address, port]
            assert left == found - {os.fstat(stuck[0].fileno()).st_ino}
            assert select.select([], [stuck[0]], [], 30.0)[1]
        finally:
            for one in asking:
                one.close()


@pytest.fixture
def watching():
    """Watch made-up events: `watching(connect)` gives what tells one."""
    made = []

    def make(connect=(), user_timeout_s=1.0):
        callbacks = []
        info = SimpleNamespace(
            declare_link_events_listener=lambda callback, **_: callbacks.append(callback)
        )
        made.append(
            (
                zenoh_links.LinkWatch(SimpleNamespace(info=info), connect, user_timeout_s),
                callbacks[0],
            )
        )
        return callbacks[0]

    yield make
    for _, callback in made:
        callback.drop()
    for watch, _ in made:
        watch.join()
    assert "enact-links" not in {thread.name for thread in threading.enumerate()}


def test_connections_are_looked_after_again_after_an_error(watching, monkeypatch):
    """A process that is short of descriptors for a moment cannot list its connections."""
    settled = queue.SimpleQueue()

    def settle_or_fail(user_timeout_s):
        settled.put(set(user_timeout_s))
        raise OSError(errno.EMFILE, "too many open files")

    monkeypatch.setattr(zenoh_links, "settle", settle_or_fail)
    tell, found = watching(), []
    for event in link_events("++"):
        tell(event)
        found.append(settled.get(timeout=30))

    assert found == [{(2, 1)}, {(3, 1)}]


def test_lost_connection_is_looked_after_though_others_cannot_be_settled(watching, monkeypatch):
    """It is lost with the descriptors of this process used up, at which a look fails, too."""
    looks = queue.SimpleQueue()

    def fail(*_):
        raise OSError(errno.EMFILE, "too many open files")

    def fail_once(hosts):
        looks.put(hosts)
        if looks.qsize() == 1:
            fail()
        return {}

    monkeypatch.setattr(zenoh_links, "FAILED_S", 0.0)
    monkeypatch.setattr(zenoh_links, "settle", fail)
    monkeypatch.setattr(zenoh_links, "unanswered", fail_once)

    tell = watching(["tcp/192.0.2.1:1"])
    for event in link_events("+-", FAR):
        tell(event)

    until(lambda: looks.qsize() > 1)
    assert looks.get() == {(FAR, 1)}


def test_lost_connection_to_this_host_is_not_looked_for(watching, monkeypatch):
    """The way to the own host is never cut: its shard stands still, and says when it goes on."""
    looks, settled = queue.SimpleQueue(), queue.SimpleQueue()
    monkeypatch.setattr(zenoh_links, "unanswered", looks.put)
    monkeypatch.setattr(zenoh_links, "settle", settled.put)

    tell = watching(["tcp/127.0.0.1:1"])
    for event in link_events("+-+"):
        tell(event)
        if event.kind == zenoh.SampleKind.PUT:
            settled.get(timeout=30)
    for event in link_events("-+", FAR):  # while one is looked for, so is none of this host
        tell(event)
    settled.get(timeout=30)

    assert all(looks.get() == {(FAR, 1)} for _ in range(looks.qsize()))


def test_loss_that_is_noted_after_the_session_was_closed_is_not_looked_after(watching, monkeypatch):
    """The thread that looks after all sessions was busy; another session keeps it going."""
    settled, go_on = queue.SimpleQueue(), threading.Event()

    def settle_late(user_timeout_s):
        settled.put(user_timeout_s)
        assert go_on.wait(30)

    monkeypatch.setattr(zenoh_links, "settle", settle_late)
    monkeypatch.setattr(zenoh_links, "unanswered", lambda _: {})
    callbacks = []
    info = SimpleNamespace(
        declare_link_events_listener=lambda callback, **_: callbacks.append(callback)
    )
    stays = watching(["tcp/192.0.2.1:1"])
    leaves = zenoh_links.LinkWatch(SimpleNamespace(info=info), ["tcp/192.0.2.1:1"], 1.0)
    came, went, again = link_events("+-+", FAR)
    callbacks[0](came)
    settled.get(timeout=30)
    callbacks[0](went)
    callbacks[0].drop()
    leaves.join()
    go_on.set()
    stays(again)
    settled.get(timeout=30)

    assert not zenoh_links._keeper._round.losing


def test_looks_for_a_lost_connection_come_more_and_more_rarely(watching, monkeypatch):
    """After a hundred seconds one is made every two seconds, however many sessions have lost one."""
    clock, looks = [1_000.0], []

    def look(hosts):
        looks.append((clock[0], hosts))
        return {host: set() for host in hosts}

    class Told(queue.SimpleQueue):
        def get(self, timeout=None, **_):
            if self.empty() and timeout is not None:
                clock[0] += timeout
            with contextlib.suppress(queue.Empty):
                return super().get(timeout=0.0 if timeout is not None else 30.0)
            if clock[0] > 1_100.0:
                return super().get(timeout=30.0)
            raise queue.Empty

    made = SimpleNamespace(monotonic=lambda: clock[0], thread_time=lambda: 0.0)
    monkeypatch.setattr(zenoh_links, "time", made)
    monkeypatch.setattr(zenoh_links, "unanswered", look)
    monkeypatch.setattr(zenoh_links, "settle", lambda _: None)
    monkeypatch.setattr(queue, "SimpleQueue", Told)

    for tell in [watching([f"tcp/{FAR}:1"]) for _ in range(20)]:
        for event in link_events("+-", FAR):
            tell(event)
    until(lambda: clock[0] > 1_100.0, missed=lambda: looks)

    assert 40 < len(looks) < 200, len(looks)
    assert looks[-1][0] - looks[-2][0] == pytest.approx(2.0)
    assert {hosts == {(FAR, 1)} for _, hosts in looks} == {True}
