"""Zenoh endpoints such as ``tcp/host:7447?option#setting``, and quick checks of them.

This module does not load Zenoh.
"""

from __future__ import annotations

import errno
import queue
import socket
import threading
import time
from collections.abc import Sequence
from typing import Final

PROTOCOLS: Final = frozenset(("tcp", "udp", "tls", "quic", "ws", "unixsock-stream"))
"""Prefixes of endpoints."""
STREAMS: Final = frozenset(("tcp", "tls"))
"""Those whose connections are ordinary TCP sockets."""
LISTENS_S: Final = 0.3
"""How long a host may take to accept or refuse a probing connection."""
LOOK_UP_S: Final = 1.0
"""How long host names may take to be looked up where the result only explains an error."""


def split_endpoint(endpoint: str) -> tuple[str, str, str]:
    """Return protocol, host and port of an endpoint; host and port are empty if missing.

    Drops options and settings; an IPv6 address keeps its brackets.
    """
    protocol, _, address = endpoint.partition("/")
    host, _, port = address.partition("?")[0].partition("#")[0].rpartition(":")
    return protocol, host, port


def somebody_listens(endpoint: str) -> bool:
    """Return whether asking there is worthwhile; a refused connection saves the wait."""
    protocol, host, port = split_endpoint(endpoint)
    if protocol not in STREAMS or not port.isdecimal():
        return True
    try:
        socket.create_connection((host.strip("[]"), int(port)), LISTENS_S).close()
    except (OSError, ValueError):
        return False
    return True


def is_of_this_host(endpoint: str) -> bool:
    """Return whether this host may listen at an endpoint; True if that cannot be determined."""
    protocol, host, port = split_endpoint(endpoint)
    if protocol not in STREAMS or not port.isdecimal():
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
    """Return the hosts of endpoints whose names do not resolve, as far as a short look tells."""
    hosts = list(dict.fromkeys(split_endpoint(endpoint)[1].strip("[]") for endpoint in endpoints))
    found: queue.SimpleQueue[str | None] = queue.SimpleQueue()

    def look_up(host: str) -> None:
        try:
            socket.getaddrinfo(host, None)
        except (OSError, ValueError):
            found.put(host)
        else:
            found.put(None)

    for host in hosts:  # in separate threads: a silent name server blocks for much longer
        threading.Thread(target=look_up, args=(host,), name="look-up", daemon=True).start()
    unknown: set[str | None] = set()
    end_s = time.monotonic() + LOOK_UP_S
    for _ in hosts:
        try:
            unknown.add(found.get(timeout=max(0.0, end_s - time.monotonic())))
        except queue.Empty:
            break
    return [host for host in hosts if host in unknown]
