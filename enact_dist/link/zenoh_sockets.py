"""Options for Zenoh's TCP sockets that its settings do not offer: see `settle` and `give_up`.

Sockets are found among the open descriptors of this process; if the system does not list them (not
Linux), nothing is done.
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
    """Make connections end if their peer acknowledges nothing, and close at once.

    Zenoh 1.10 waits for the kernel in two places, each time with threads that serve all clients:

    - A link in mid-transfer is closed only once the kernel has accepted the message being sent.
      Meanwhile everything that has a message for the link waits (zenoh issues 1053 and 1876),
      including the one thread that accepts connections and the one that sends for all.  When a
      client was cut off during a fetch, its shard answered nobody for 6 s more with a TTL of 12 s.
      A connection that the kernel has given up is closed at once.
    - Closing lingers for 10 s (zenoh issue 2350), until all is acknowledged: with a TTL of 2 s it
      took 12 s from a cut to the next grant, against 2.0 s now.  Without a linger time the kernel
      still sends the rest in the background.

    Args:
        patience_s: Own and other port of each connection, and how long sent bytes, or a closed
            window, may stay as they are; only connections with exactly Zenoh's linger time count.

    Returns:
        How many were settled; each connection is settled once.
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
    """Return the inodes of this process's sockets that are connecting to IPv4 addresses."""
    hosts = tuple(hosts)
    waiting = set()
    for connection in connections():
        with connection, contextlib.suppress(OSError):
            if _state(connection) == _SYN_SENT:
                waiting.add(os.fstat(connection.fileno()).st_ino)
    if not waiting:
        return {host: set() for host in hosts}
    # Only the kernel's table shows the destination of a connecting socket.
    rows = [line.split() for line in _TABLE.read_text().splitlines()[1:]]
    inodes = {(row[2], int(row[9])) for row in rows}
    return {
        host: {inode for inode in waiting if (_written(*host), inode) in inodes} for host in hosts
    }


def _written(address: str, port: int) -> str:
    """Return an address in the form of the kernel's table."""
    return f"{int.from_bytes(socket.inet_aton(address), 'little'):08X}:{port:04X}"


def give_up(inodes: set[int]) -> None:
    """Abort unanswered connection attempts, so that Zenoh tries again."""
    for connection in connections():
        with connection, contextlib.suppress(OSError):
            if os.fstat(connection.fileno()).st_ino in inodes and _state(connection) == _SYN_SENT:
                connection.shutdown(socket.SHUT_RDWR)


def _state(connection: socket.socket) -> int:
    return connection.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, 1)[0]


def connections() -> Iterator[socket.socket]:
    """Yield this process's sockets, each as a duplicate descriptor: others may close theirs.

    Descriptors are never queried for their targets: a file on a disconnected host never answers.
    """
    try:
        entries = list(_DESCRIPTORS.iterdir())
    except OSError as error:  # not Linux
        _log.debug("cannot find Zenoh's sockets: %s", error)
        return
    for entry in entries:
        with contextlib.suppress(OSError):  # closed meanwhile, or too many descriptors are open
            if not entry.readlink().name.startswith("socket:"):
                continue
            mine = os.dup(int(entry.name))
            # If the program set a default timeout, the next line would change shared options.
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
