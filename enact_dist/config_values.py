"""Checks of single values that both `cell.toml` and the environment can give."""

from __future__ import annotations

import re
from typing import Final

CARRIERS: Final = ("auto", "zenoh", "socket")
"""How messages may travel between processes; `local()` needs none of them.

"auto" takes a socket between processes of one host and Zenoh for all others; "socket" makes it an
error if there is none.
"""

TTL_S_MIN: Final = 0.2
"""Shorter leases end in ordinary scheduling pauses of a loaded machine."""
TTL_S_MAX: Final = 60.0
"""A dead holder blocks its data for one TTL, a restarted shard waits one for absent sessions."""
DRAIN_S_MAX: Final = 3600.0
"""Default duration of `enact lock hold`."""

_ENDPOINT: Final = re.compile(r"tcp/(\[[0-9A-Fa-f:.]+\]|[A-Za-z0-9._-]+):(\d{1,5})\Z")
_ADDRESS: Final = re.compile(r"((\[[0-9A-Fa-f:.]+\]|[A-Za-z0-9._-]+)?:)?\d{1,5}\Z")
_WILDCARDS: Final = ("0.0.0.0", "[::]")  # noqa: S104 - recognised here in order to be refused


def checked_endpoint(endpoint: str) -> str:
    """Return `endpoint` if it has the form ``tcp/host:port``.

    Raises:
        ValueError: It has another form, or a port outside 1 to 65535.
    """
    found = _ENDPOINT.match(endpoint)
    if found is None or not 1 <= int(found[2]) <= 65_535:
        raise ValueError(
            f"{endpoint!r} is no endpoint; write tcp/host:port with a port from 1 to 65535,"
            " such as tcp/127.0.0.1:7447"
        )
    return endpoint


def metrics_address(text: str) -> tuple[str, int]:
    """Read ``host:port``, or a port of the loopback.

    Raises:
        ValueError: It has another form, or a port outside 1 to 65535.
    """
    host, _, port = text.rpartition(":")
    if not _ADDRESS.match(text) or not 1 <= int(port) <= 65_535:
        raise ValueError(
            f"{text!r} is no address for metrics; write host:port, or a port of the loopback, such"
            " as 127.0.0.1:9464 or 9464"
        )
    return host.strip("[]") or "127.0.0.1", int(port)


def is_wildcard(endpoint: str) -> bool:
    """Return whether an endpoint means every address of a host; no client can connect to that."""
    found = _ENDPOINT.match(endpoint)
    return found is not None and found[1] in _WILDCARDS
