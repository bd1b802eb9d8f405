"""Zenoh's TCP sockets close at once: a host that is cut off must not hold the receiving threads."""

import socket
import struct
import time

import pytest

from enact_dist.link.zenoh_config import close_session, open_session
from enact_dist.link.zenoh_lingering import _connections, end_lingering

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


def lingering():
    """Return how many TCP sockets of this process wait before they close."""
    count = 0
    for connection in _connections():
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
