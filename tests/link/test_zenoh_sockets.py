"""Zenoh's TCP sockets close at once, and do not wait for the kernel's next try after a cut."""

import os
import select
import socket
import struct
import time
from types import SimpleNamespace

import pytest
import zenoh

from enact_dist.link.zenoh_config import close_session, open_session
from enact_dist.link.zenoh_links import _counted
from enact_dist.link.zenoh_sockets import connections, end_lingering, give_up, unanswered

LINGER = struct.Struct("ii")
ZENOHS = (1, 10)


def linger_of(connection):
    return LINGER.unpack(connection.getsockopt(socket.SOL_SOCKET, socket.SO_LINGER, LINGER.size))


@pytest.mark.parametrize(("before", "lingers"), [(ZENOHS, 0), ((1, 5), 1), ((0, 0), 0)])
def test_only_sockets_with_zenohs_linger_time_are_changed(before, lingers):
    """What a program has set on its own sockets stays."""
    with (
        socket.create_server(("127.0.0.1", 0)) as listener,
        socket.create_connection(listener.getsockname()) as connection,
    ):
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, LINGER.pack(*before))

        found = end_lingering()

        assert linger_of(connection)[0] == lingers
        assert found == (before == ZENOHS)


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


def lingering():
    """Return how many TCP sockets of this process wait before they close."""
    count = 0
    for connection in connections():
        with connection:
            count += bool(linger_of(connection)[0])
    return count


def test_connections_of_sessions_do_not_linger_on_either_side(endpoint):
    """Both ends are in this process; a connection that comes later is seen, too."""
    shard = open_session(listen=[endpoint], lease_s=1.0)
    clients = [open_session(connect=[endpoint], lease_s=1.0) for _ in range(2)]
    try:
        deadline_s = time.monotonic() + 30.0
        while len(list(shard.info.links())) < 2 or lingering():
            assert time.monotonic() < deadline_s, f"{lingering()} sockets linger"
            time.sleep(0.005)  # nothing tells when a thread has seen a connection
    finally:
        for session in (*clients, shard):
            close_session(session)


LEFT_OPEN = """
import sys
from enact_dist.link import zenoh_links
from enact_dist.link.zenoh_config import open_session
zenoh_links.JOIN_S = 3600.0
kept = [open_session(listen=[endpoint], lease_s=1.0) for endpoint in sys.argv[1:]]
"""


def test_sessions_that_were_left_open_are_closed_before_their_threads_are_waited_for(
    program, endpoint, free
):
    """The threads end with the sessions; the other way round each would cost a second."""
    process = program(LEFT_OPEN, endpoint, free(), free())

    assert process.wait(timeout=60.0) == 0


@pytest.mark.parametrize(("kinds", "lost"), [("+-", 1), ("-+", 0), ("++-", 1), ("--", 2)])
def test_events_that_are_here_are_counted_at_once(kinds, lost):
    """Of a hundred connections that come together none is looked at alone."""
    kind_of = {"+": zenoh.SampleKind.PUT, "-": zenoh.SampleKind.DELETE}
    events = iter([SimpleNamespace(kind=kind_of[kind]) for kind in kinds])
    waiting = SimpleNamespace(try_recv=lambda: next(events, None))

    assert _counted(waiting, waiting.try_recv()) == lost


def test_connection_that_nobody_answers_is_given_up_and_no_other():
    """A listener whose queue is full answers nobody: the kernel would try again every second."""
    with socket.create_server(("127.0.0.1", 0), backlog=0) as full:
        address, port = full.getsockname()
        asking = [socket.socket() for _ in range(4)]
        for one in asking:
            one.setblocking(False)
            one.connect_ex((address, port))
        found = unanswered(address, port)
        stuck = [one for one in asking if os.fstat(one.fileno()).st_ino in found]
        try:
            assert 0 < len(stuck) == len(found) < len(asking)
            assert unanswered(address, port + 1) == set()

            give_up({os.fstat(stuck[0].fileno()).st_ino})

            assert unanswered(address, port) == found - {os.fstat(stuck[0].fileno()).st_ino}
            assert select.select([], [stuck[0]], [], 30.0)[1]
        finally:
            for one in asking:
                one.close()
