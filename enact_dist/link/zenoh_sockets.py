"""What Zenoh's TCP sockets need and its settings do not offer: see `end_lingering` and `give_up`.

Sockets are looked up among the open descriptors of this process; where the system does not list
them (no Linux) nothing is done.
"""

from __future__ import annotations

import contextlib
import logging
import os
import socket
import struct
from pathlib import Path
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Iterator

_DESCRIPTORS: Final = Path("/proc/self/fd")
_TABLE: Final = Path("/proc/self/net/tcp")
_LINGER: Final = struct.Struct("ii")
_ZENOHS: Final = _LINGER.pack(1, 10)
_NONE: Final = _LINGER.pack(0, 0)
_SYN_SENT: Final = 2
_INTERNET: Final = (socket.AF_INET, socket.AF_INET6)

_log = logging.getLogger("enact.link")


def end_lingering() -> int:
    """Let lost connections close at once; return how many would have waited.

    Zenoh 1.10 gives each of its TCP sockets a linger time of 10 s (zenoh issue 2350).  The kernel
    then holds the thread that closes a socket until the other side has acknowledged everything, and
    these are the few threads that receive for all connections.  So when one host was cut off, its
    links were given up after their lease, and the shard heard nobody for another 10 s: 12 s from a
    cut to the next grant with a TTL of 2 s, against 2.0 s now.  Without a linger time the kernel
    goes on sending what is left, behind the process's back.

    Only sockets with exactly Zenoh's linger time are touched.
    """
    found = 0
    for connection in connections():
        with connection, contextlib.suppress(OSError):
            if connection.getsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _LINGER.size) == _ZENOHS:
                connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _NONE)
                found += 1
    return found


def unanswered(address: str, port: int) -> set[int]:
    """Return the inodes of this process's sockets that wait for this IPv4 address to answer."""
    waiting = set()
    for connection in connections():
        with connection, contextlib.suppress(OSError):
            if _state(connection) == _SYN_SENT:
                waiting.add(os.fstat(connection.fileno()).st_ino)
    if not waiting:
        return waiting
    # The kernel does not tell whom a socket waits for, except in its table.
    whom = f"{int.from_bytes(socket.inet_aton(address), 'little'):08X}:{port:04X}"
    rows = [line.split() for line in _TABLE.read_text().splitlines()[1:]]
    return waiting & {int(row[9]) for row in rows if row[2] == whom}


def give_up(inodes: set[int]) -> None:
    """End connections that nobody has answered, so that Zenoh tries anew."""
    for connection in connections():
        with connection, contextlib.suppress(OSError):
            if os.fstat(connection.fileno()).st_ino in inodes and _state(connection) == _SYN_SENT:
                connection.shutdown(socket.SHUT_RDWR)


def _state(connection: socket.socket) -> int:
    return connection.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, 1)[0]


def connections() -> Iterator[socket.socket]:
    """Yield this process's sockets, each by a descriptor of our own: others may close theirs.

    Nothing that a descriptor stands for is asked: a file of a host that was cut off never answers.
    """
    try:
        entries = list(_DESCRIPTORS.iterdir())
    except OSError as error:  # no Linux
        _log.debug("Zenoh's sockets are not to be found: %s", error)
        return
    for entry in entries:
        with contextlib.suppress(OSError):  # closed meanwhile, or too many are open
            if not entry.readlink().name.startswith("socket:"):
                continue
            mine = os.dup(int(entry.name))
            # A default timeout of the program lets the next line change what all share.
            blocking = socket.getdefaulttimeout() is not None and os.get_blocking(mine)
            try:
                connection = socket.socket(fileno=mine)
            except OSError:
                os.close(mine)
                continue
            if blocking:
                os.set_blocking(mine, True)
            if connection.family in _INTERNET and connection.type == socket.SOCK_STREAM:
                yield connection
            else:
                connection.close()
