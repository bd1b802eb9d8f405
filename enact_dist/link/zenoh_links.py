"""Looks after the connections of a Zenoh session: none holds up others, a cut one is back soon.

`settle` says what a connection is given as soon as it is there, and why.

A connection that nobody answers is repeated by the kernel once a second at best, so after a cut
Zenoh is connected again up to 1.1 s late (0.6 s with this).  From the loss of a connection on,
whoever waits for an answer longer than `LOOK_S` is therefore checked: if a connection of our own is
answered at once, the network is there again and the waiting one is given up; Zenoh tries anew after
50 ms.
"""

from __future__ import annotations

import contextlib
import logging
import socket
import threading
import time
from typing import TYPE_CHECKING, Final

import zenoh

from enact_dist.link.endpoints import split_endpoint
from enact_dist.link.zenoh_sockets import give_up, settle, unanswered

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

EVENTS_MAX: Final = 65_536
"""Comings and goings of connections that wait to be looked at."""
LOOK_S: Final = 0.1
"""How often is looked while a connection is lost, and how soon a host has to answer."""
COST: Final = 50
"""A look lists all descriptors of the process; the pause after it is this many times as long."""
FAILED_S: Final = 1.0
"""The pause after a look that failed."""
JOIN_S: Final = 1.0

_FAILED: Final = "connections are not looked after at the moment: %s"
_log = logging.getLogger("enact.link")


class LinkWatch:
    """Looks after the connections of a session, from a thread of its own, until that is closed.

    Args:
        session: Not closed with this.
        connect: The endpoints that it connects to.
        patience_s: How long bytes that it sent may stay unacknowledged.
    """

    def __init__(self, session: zenoh.Session, connect: Sequence[str], patience_s: float) -> None:
        self._connect = tuple(connect)
        self._patience_s = patience_s
        self._lost = 0
        self._closing = threading.Event()
        self._listener = session.info.declare_link_events_listener(
            zenoh.handlers.FifoChannel(EVENTS_MAX), history=True
        )
        self._thread = threading.Thread(
            target=self._run, args=(self._listener.handler,), name="enact-links", daemon=True
        )
        self._thread.start()

    def _run(self, events: zenoh.Handler[zenoh.LinkEvent]) -> None:
        while True:
            try:
                self._note(_all_here(events, events.recv()))
                if self._lost and self._connect:
                    self._knock(events)
            except zenoh.ZError:  # the session is closed
                return
            except Exception as error:  # noqa: BLE001 - no descriptor is free, most likely
                _log.warning(_FAILED, error)

    def _note(self, here: Sequence[zenoh.LinkEvent]) -> None:
        """Count what is lost, and settle what has come if that can be done."""
        self._lost = _lost_after(here, self._lost)
        try:
            _settle_new(here, self._patience_s)
        except Exception as error:  # noqa: BLE001 - what is lost is looked after all the same
            _log.warning(_FAILED, error)

    def _knock(self, events: zenoh.Handler[zenoh.LinkEvent]) -> None:
        """Look at what waits for an answer until every lost connection is back."""
        hosts, pause_s = list(_hosts_of(self._connect)), LOOK_S
        waited: set[int] = set()
        while not self._closing.wait(pause_s):
            event = events.try_recv()
            if event is not None:
                self._note(_all_here(events, event))
            if not self._lost:
                return
            began_s = time.thread_time()
            try:
                waited = _given_up(hosts, waited)
            except Exception as error:  # noqa: BLE001 - as above; nothing else would wake us
                _log.warning(_FAILED, error)
                pause_s = FAILED_S
            else:
                pause_s = max(LOOK_S, COST * (time.thread_time() - began_s))

    def join(self) -> None:
        """Wait for the end of the thread, which follows that of the session."""
        self._closing.set()
        self._thread.join(JOIN_S)


def _given_up(hosts: Iterable[tuple[str, int]], waited: set[int]) -> set[int]:
    """Give up what has `waited` since the last look for a host that answers; return what waits."""
    waiting = {host: unanswered(*host) for host in hosts}
    for host, inodes in waiting.items():
        if inodes & waited and _answers(*host):
            give_up(inodes & waited)
    return set().union(*waiting.values())


def _all_here(
    events: zenoh.Handler[zenoh.LinkEvent], first: zenoh.LinkEvent
) -> list[zenoh.LinkEvent]:
    """Return the first event and all that wait behind it."""
    here = [first]
    while (event := events.try_recv()) is not None:
        here.append(event)
    return here


def _has_come(event: zenoh.LinkEvent) -> bool:
    """Say whether a connection has come; else one has gone."""
    return event.kind == zenoh.SampleKind.PUT


def _settle_new(events: Iterable[zenoh.LinkEvent], patience_s: float) -> None:
    """Settle the connections that have come.

    A thousand that come at once are settled together: each look lists all descriptors.
    """
    came = {
        (_port_of(event.link.src), _port_of(event.link.dst)) for event in events if _has_come(event)
    }
    if came:
        settle(came, patience_s)


def _lost_after(events: Iterable[zenoh.LinkEvent], lost: int = 0) -> int:
    """Return how many connections are lost after these events, of `lost` before.

    One that comes stands for one that was lost, where there is such a one.
    """
    for event in events:
        lost = max(0, lost - 1) if _has_come(event) else lost + 1
    return lost


def _hosts_of(endpoints: Iterable[str]) -> Iterable[tuple[str, int]]:
    """Yield the IPv4 addresses and ports of endpoints."""
    for endpoint in endpoints:
        protocol, host, _ = split_endpoint(endpoint)
        if protocol == "tcp":
            with contextlib.suppress(OSError, UnicodeError):  # IPv6, or not known yet
                yield socket.gethostbyname(host), _port_of(endpoint)


def _port_of(endpoint: str) -> int:
    """Return the port of an endpoint, 0 where it has none."""
    port = split_endpoint(endpoint)[2]
    return int(port) if port.isdecimal() else 0


def _answers(address: str, port: int) -> bool:
    try:
        socket.create_connection((address, port), LOOK_S).close()
    except OSError:
        return False
    return True
