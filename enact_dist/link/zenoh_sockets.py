"""What Zenoh's TCP sockets need and its settings do not offer: see `settle` and `give_up`.

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
    from collections.abc import Iterable, Iterator, Mapping

_DESCRIPTORS: Final = Path("/proc/self/fd")
_TABLE: Final = Path("/proc/self/net/tcp")
_LINGER: Final = struct.Struct("ii")
_ZENOHS: Final = _LINGER.pack(1, 10)
_NONE: Final = _LINGER.pack(0, 0)
_SYN_SENT: Final = 2
_INTERNET: Final = (socket.AF_INET, socket.AF_INET6)

_log = logging.getLogger("enact.link")


def settle(patience_s: Mapping[tuple[int, int], float]) -> int:
    """Let connections end if their peer acknowledges nothing, and close at once.

    Zenoh 1.10 waits for the kernel in two places, each time with threads that serve all clients:

    - A link in mid-transfer is closed only once the kernel has taken what its sender has in hand,
      and whoever else has a message for it waits meanwhile (zenoh issues 1053 and 1876): among
      them the one thread that accepts connections, and the one that sends for all.  When a client
      was cut off while it fetched, its shard answered nobody for 6 s more with a TTL of 12 s.
      What the kernel has given up by itself is closed at once, and nobody waits for it.
    - Closing lingers for 10 s (zenoh issue 2350), until all is acknowledged: 12 s from a cut to
      the next grant with a TTL of 2 s, against 2.0 s now.  Without a linger time the kernel goes
      on sending what is left, behind the process's back.

    Args:
        patience_s: Own and other port of each connection, and how long sent bytes, or a closed
            window, may stay as they are; only connections with exactly Zenoh's linger time count.

    Returns:
        How many were settled; each is once.
    """
    found = 0
    for connection in connections():
        with connection, contextlib.suppress(OSError):
            if connection.getsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _LINGER.size) != _ZENOHS:
                continue
            ports = connection.getsockname()[1], connection.getpeername()[1]
            if ports not in patience_s:
                continue
            patience_ms = max(1, round(1e3 * patience_s[ports]))
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, patience_ms)
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _NONE)
            found += 1
    return found


def unanswered(hosts: Iterable[tuple[str, int]]) -> dict[tuple[str, int], set[int]]:
    """Return the inodes of this process's sockets that wait for IPv4 addresses to answer."""
    hosts = tuple(hosts)
    waiting = set()
    for connection in connections():
        with connection, contextlib.suppress(OSError):
            if _state(connection) == _SYN_SENT:
                waiting.add(os.fstat(connection.fileno()).st_ino)
    if not waiting:
        return {host: set() for host in hosts}
    # The kernel does not tell whom a socket waits for, except in its table.
    rows = [line.split() for line in _TABLE.read_text().splitlines()[1:]]
    inodes = {(row[2], int(row[9])) for row in rows}
    return {
        host: {inode for inode in waiting if (_written(*host), inode) in inodes} for host in hosts
    }


def _written(address: str, port: int) -> str:
    """Return an address as the kernel's table has it."""
    return f"{int.from_bytes(socket.inet_aton(address), 'little'):08X}:{port:04X}"


def give_up(inodes: set[int]) -> None:
    """End connections that got no answer, so that Zenoh tries again."""
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
