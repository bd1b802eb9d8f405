"""Looks after the connections of a Zenoh session: none lingers, and a cut one is back soon.

A connection that nobody answers is repeated by the kernel once a second at best, so after a cut
Zenoh is connected again up to 1.1 s late (0.6 s with this).  From the loss of a connection on,
whoever waits for an answer longer than `LOOK_S` is therefore checked: if a connection of our own is
answered at once, the network is there again and the waiting one is given up; Zenoh tries anew after
50 ms.
"""

from __future__ import annotations

import socket
import threading
import time
from typing import TYPE_CHECKING, Final

import zenoh

from enact_dist.link.zenoh_sockets import end_lingering, give_up, unanswered

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

EVENTS_MAX: Final = 65_536
"""Comings and goings of connections that wait to be looked at."""
LOOK_S: Final = 0.1
"""How often is looked while a connection is lost, and how soon a host has to answer."""
COST: Final = 50
"""A look lists all descriptors of the process; the pause after it is this many times as long."""
JOIN_S: Final = 1.0


class LinkWatch:
    """Looks after the connections of a session, from a thread of its own, until that is closed.

    Args:
        session: Not closed with this.
        connect: The endpoints that it connects to.
    """

    def __init__(self, session: zenoh.Session, connect: Sequence[str]) -> None:
        self._connect = tuple(connect)
        self._closing = threading.Event()
        self._listener = session.info.declare_link_events_listener(
            zenoh.handlers.FifoChannel(EVENTS_MAX), history=True
        )
        self._thread = threading.Thread(
            target=self._run, args=(self._listener.handler,), name="enact-links", daemon=True
        )
        self._thread.start()

    def _run(self, events: zenoh.Handler[zenoh.LinkEvent]) -> None:
        try:
            while True:
                lost = _counted(events, events.recv())
                end_lingering()
                if lost and self._connect:
                    self._knock(events, lost)
        except zenoh.ZError:  # the session is closed
            return

    def _knock(self, events: zenoh.Handler[zenoh.LinkEvent], lost: int) -> None:
        """Look at what waits for an answer until every lost connection is back."""
        hosts, pause_s = list(_hosts_of(self._connect)), LOOK_S
        waited: set[int] = set()
        while not self._closing.wait(pause_s):
            event = events.try_recv()
            if event is not None:
                lost = _counted(events, event, lost)
                end_lingering()
            if not lost:
                return
            began_s = time.thread_time()
            waiting = {host: unanswered(*host) for host in hosts}
            pause_s = max(LOOK_S, COST * (time.thread_time() - began_s))
            for host, inodes in waiting.items():
                if inodes & waited and _answers(*host):
                    give_up(inodes & waited)
            waited = set().union(*waiting.values())

    def join(self) -> None:
        """Wait for the end of the thread, which follows that of the session."""
        self._closing.set()
        self._thread.join(JOIN_S)


def _counted(
    events: zenoh.Handler[zenoh.LinkEvent], event: zenoh.LinkEvent | None, lost: int = 0
) -> int:
    """Take all events that are here; return how many connections are lost now.

    A thousand clients that connect at once are looked at together: each look lists all descriptors.
    """
    while event is not None:
        lost = max(0, lost - 1) if event.kind == zenoh.SampleKind.PUT else lost + 1
        event = events.try_recv()
    return lost


def _hosts_of(endpoints: Iterable[str]) -> Iterable[tuple[str, int]]:
    """Yield the IPv4 addresses and ports of endpoints."""
    for endpoint in endpoints:
        protocol, _, rest = endpoint.partition("/")
        host, _, port = rest.partition("?")[0].partition("#")[0].rpartition(":")
        if protocol != "tcp":
            continue
        try:
            yield socket.gethostbyname(host), int(port)
        except (OSError, ValueError):
            continue  # IPv6, or a name that is not known yet: the kernel's pace will do


def _answers(address: str, port: int) -> bool:
    try:
        socket.create_connection((address, port), LOOK_S).close()
    except OSError:
        return False
    return True
