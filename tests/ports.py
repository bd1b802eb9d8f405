"""Ports of the loopback for daemons that a test starts, which nobody else is given meanwhile.

A port that was found free and let go of may be that of another test's daemon before the own one
listens, or while it is killed and started again.  A socket that is bound to it and never listens
keeps the system from giving it away; a daemon that says SO_REUSEADDR, as Zenoh does, listens there.
"""

import socket

_kept = []


def free_port():
    """Return a port at which nobody listens yet."""
    kept = socket.socket()
    kept.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    kept.bind(("127.0.0.1", 0))
    _kept.append(kept)
    return kept.getsockname()[1]


def free_endpoint():
    """Return an endpoint at which nobody listens yet."""
    return f"tcp/127.0.0.1:{free_port()}"


def give_back():
    """Let the system give the ports of this test to others."""
    while _kept:
        _kept.pop().close()
