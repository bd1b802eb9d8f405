"""Zenoh's names of places, as ``tcp/host:7447?option#setting``, and what is known of them soon.

Nothing of Zenoh is loaded here.
"""

from __future__ import annotations

import errno
import queue
import socket
import threading
import time
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Sequence

PROTOCOLS: Final = frozenset(("tcp", "udp", "tls", "quic", "ws", "unixsock-stream"))
"""How the names of places begin."""
LISTENS_S: Final = 0.3
"""How long a place may take to say that somebody listens."""
LOOK_UP_S: Final = 1.0
"""How long host names may take to be looked up where that only explains an error."""


def split_endpoint(endpoint: str) -> tuple[str, str, str]:
    """Return protocol, host and port of an endpoint; host and port are empty where it lacks them.

    Options and settings are left out; an IPv6 address keeps its brackets.
    """
    protocol, _, address = endpoint.partition("/")
    host, _, port = address.partition("?")[0].partition("#")[0].rpartition(":")
    return protocol, host, port


def somebody_listens(endpoint: str) -> bool:
    """Say whether it is worth asking there; a refused connection saves the time of asking."""
    protocol, host, port = split_endpoint(endpoint)
    if protocol != "tcp" or not port.isdecimal():
        return True
    try:
        socket.create_connection((host.strip("[]"), int(port)), LISTENS_S).close()
    except (OSError, ValueError):
        return False
    return True


def is_of_this_host(endpoint: str) -> bool:
    """Say whether this host may listen at an endpoint; so it is where nobody can tell."""
    protocol, host, port = split_endpoint(endpoint)
    if protocol != "tcp" or not port.isdecimal():
        return True
    try:
        found = socket.getaddrinfo(host.strip("[]"), 0, type=socket.SOCK_STREAM)
    except (OSError, ValueError):
        return True
    for family, kind, protocol_number, _, address in found:
        try:
            with socket.socket(family, kind, protocol_number) as probe:
                probe.bind(address)
        except OSError as error:
            if error.errno != errno.EADDRNOTAVAIL:
                return True
        else:
            return True
    return False


def unknown_hosts(endpoints: Sequence[str]) -> list[str]:
    """Return the hosts of endpoints whose names cannot be resolved, as far as is known soon."""
    hosts = list(dict.fromkeys(split_endpoint(endpoint)[1].strip("[]") for endpoint in endpoints))
    found: queue.SimpleQueue[str | None] = queue.SimpleQueue()

    def look_up(host: str) -> None:
        try:
            socket.getaddrinfo(host, None)
        except (OSError, ValueError):
            found.put(host)
        else:
            found.put(None)

    for host in hosts:  # in threads of their own: a silent name server is waited for much longer
        threading.Thread(target=look_up, args=(host,), name="look-up", daemon=True).start()
    unknown: set[str | None] = set()
    end_s = time.monotonic() + LOOK_UP_S
    for _ in hosts:
        try:
            unknown.add(found.get(timeout=max(0.0, end_s - time.monotonic())))
        except queue.Empty:
            break
    return [host for host in hosts if host in unknown]
