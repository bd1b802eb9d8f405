"""Watches the connections of Zenoh's sessions: none blocks others, a cut one is restored soon.

`settle` describes the options that each new connection gets beyond Zenoh's settings, and why.

The kernel repeats unanswered connection attempts once a second at best, so after a cut Zenoh would
reconnect up to 1.1 s late (0.6 s with this).  Therefore, from the loss of a connection to another
host on, attempts that wait longer than `LOOK_S` are checked: if a connection of our own is answered
at once, the network is back and the waiting attempt is aborted; Zenoh tries again after 50 ms.

Sockets are found among the open descriptors of the process; if the system does not list them (not
Linux), nothing is done.  One thread lists them for all sessions of the process, at most once in
`COST` times its duration, and less often the longer a connection has been lost: its cost grows
neither with the number of connections nor with the time that a shard is away.
"""

from __future__ import annotations

import contextlib
import logging
import os
import queue
import socket
import struct
import threading
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Final, TypeAlias

import zenoh

from enact_dist.link.zenoh.endpoints import STREAMS, split_endpoint
from enact_dist.link.zenoh.events import Events

_DESCRIPTORS: Final = Path("/proc/self/fd")
_TABLE: Final = Path("/proc/self/net/tcp")
_LINGER: Final = struct.Struct("ii")
_ZENOHS: Final = _LINGER.pack(1, 10)
_NONE: Final = _LINGER.pack(0, 0)
_SYN_SENT: Final = 2
_INTERNET: Final = (socket.AF_INET, socket.AF_INET6)


def settle(user_timeout_s: Mapping[tuple[int, int], float]) -> int:
    """Make connections end if their peer acknowledges nothing, and close at once.

    Zenoh 1.10 waits for the kernel in two places, each time with threads that serve all clients:

    - A link in mid-transfer is closed only once the kernel has accepted the message being sent.
      Meanwhile everything that has a message for the link waits (zenoh issues 1053 and 1876),
      including the one thread that accepts connections and the one that sends for all.  When a
      client was cut off during a fetch, its shard answered no client for 6 s more with a TTL of
      12 s.  A connection that the kernel has given up is closed at once.
    - Closing lingers for 10 s (zenoh issue 2350), until all is acknowledged: with a TTL of 2 s it
      took 12 s from a cut to the next grant, against 2.0 s now.  Without a linger time the kernel
      still sends the rest in the background.

    Args:
        user_timeout_s: Own and other port of each connection, and how long sent bytes, or a closed
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
            if ports not in user_timeout_s:
                continue
            timeout_ms = max(1, round(1e3 * user_timeout_s[ports]))
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, timeout_ms)
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


LOOK_S: Final = 0.1
"""Delay of the first look after a loss, and how soon a host must answer."""
LOOK_S_MAX: Final = 2.0
"""Longest pause between two looks."""
LATER: Final = 10
"""A look comes after another tenth of the time for which a connection has been lost."""
COST: Final = 50
"""A look lists all descriptors of the process; the pause after it is this many times as long."""
FAILED_S: Final = 1.0
"""The pause after a look that failed."""
JOIN_S: Final = 1.0

_FAILED: Final = "cannot watch connections at the moment: %s"
_log = logging.getLogger("enact.link")

Host: TypeAlias = "tuple[str, int]"


class LinkWatch:
    """Watches the connections of a session until that is closed.

    Attributes:
        lost: Destinations of lost connections, of a session that connects.
        left: Whether the session is closed and no longer watched.

    Args:
        session: Stays open when this ends.
        connect: The endpoints that it connects to.
        user_timeout_s: How long sent bytes may stay unacknowledged.
    """

    def __init__(
        self, session: zenoh.Session, connect: Sequence[str], user_timeout_s: float
    ) -> None:
        self.lost: list[str] = []
        self.user_timeout_s = user_timeout_s
        self.left = False
        self._connects = bool(connect)
        _keeper.enter(self)
        try:
            self._events: Events[zenoh.LinkEvent] = Events(
                "enact-link-events",
                lambda callback: session.info.declare_link_events_listener(callback, history=True),
                lambda event: _keeper.report(self, event),
            )
        except BaseException:
            _keeper.leave(self)
            raise

    def note(self, events: Iterable[zenoh.LinkEvent]) -> None:
        """Take new and lost connections."""
        if self._connects:
            self.lost = _lost_after(events, self.lost)

    def join(self) -> None:
        """Wait for the event thread, which ends after the session."""
        self._events.join(JOIN_S)
        self.left = True
        _keeper.leave(self)


Report: TypeAlias = "tuple[LinkWatch, zenoh.LinkEvent]"


class _Keeper:
    """The one thread of this process that watches connections, while there are sessions."""

    def __init__(self) -> None:
        self._mutex = threading.Lock()
        self._watches: set[LinkWatch] = set()
        self._round: _Round | None = None

    def enter(self, watch: LinkWatch) -> None:
        """Watch the connections of a session from now on."""
        with self._mutex:
            if self._round is None:
                self._round = _Round()
            self._watches.add(watch)

    def report(self, watch: LinkWatch, event: zenoh.LinkEvent) -> None:
        """Report new or lost connections to the thread, without waiting for it."""
        current = self._round
        if current is not None:
            current.events.put((watch, event))

    def leave(self, watch: LinkWatch) -> None:
        """Forget a session; with the last one the thread ends."""
        with self._mutex:
            self._watches.discard(watch)
            ended = None
            if self._round is not None:
                self._round.losing.discard(watch)
            if not self._watches:
                ended, self._round = self._round, None
        if ended is not None:
            ended.end()


_keeper = _Keeper()


class _Round:
    """One life of that thread, from the first session to the end of the last one."""

    def __init__(self) -> None:
        self.events: queue.SimpleQueue[Report | None] = queue.SimpleQueue()
        self._over = threading.Event()
        self.losing: set[LinkWatch] = set()
        self._lost_s = self._look_s = self._rest_until_s = 0.0
        self._waited: set[int] = set()
        self._thread = threading.Thread(target=self._run, name="enact-links", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while not self._over.is_set():
            here = self._here()
            if self._over.wait(max(0.0, self._rest_until_s - time.monotonic())):
                return
            here += _all_here(self.events)  # one look settles all of them
            began_s = time.thread_time()
            pause_s = 0.0
            try:
                self._note(here)
                if self.losing and time.monotonic() >= self._look_s:
                    self._waited = _given_up(_hosts_of(self.losing), self._waited)
            except Exception as error:  # noqa: BLE001 - no descriptor is free, most likely
                _log.warning(_FAILED, error)
                pause_s = FAILED_S
            self._rest(time.thread_time() - began_s, pause_s)

    def _here(self) -> list[Report]:
        """Wait for events, or until a look is due; return the events."""
        wait_s = max(0.0, self._look_s - time.monotonic()) if self.losing else None
        try:
            first = self.events.get(timeout=wait_s)
        except queue.Empty:
            return []
        return [first] if first is not None else []

    def _rest(self, cost_s: float, pause_s: float) -> None:
        """Return when the next look is due, given the cost of the last one."""
        now_s = time.monotonic()
        self._rest_until_s = now_s + min(FAILED_S, COST * cost_s)
        later_s = min(LOOK_S_MAX, (now_s - self._lost_s) / LATER)
        self._look_s = now_s + max(LOOK_S, later_s, pause_s)

    def _note(self, here: Sequence[Report]) -> None:
        """Record lost connections, and settle new ones if possible."""
        for watch in {watch: None for watch, _ in here}:
            events = [event for of, event in here if of is watch]
            before = watch.lost
            watch.note(events)
            if watch.lost and watch.lost != before:
                self._lost_s = self._look_s = time.monotonic()
            (self.losing.add if _hosts_of((watch,)) else self.losing.discard)(watch)
            if watch.left:  # perhaps closed just now
                self.losing.discard(watch)
        try:
            _settle_new(here)
        except Exception as error:  # noqa: BLE001 - what is lost is looked after all the same
            _log.warning(_FAILED, error)

    def end(self) -> None:
        """End the thread."""
        self._over.set()
        self.events.put(None)
        if self._thread is not threading.current_thread():
            self._thread.join(JOIN_S)


def _given_up(hosts: Iterable[Host], waited: set[int]) -> set[int]:
    """Abort attempts waiting since the last look for hosts that answer; return the others."""
    waiting = unanswered(hosts)
    for host, inodes in waiting.items():
        if inodes & waited and _answers(*host):
            give_up(inodes & waited)
    return set().union(*waiting.values())


def _all_here(events: queue.SimpleQueue[Report | None]) -> list[Report]:
    """Return all waiting events."""
    here = []
    with contextlib.suppress(queue.Empty):
        while (one := events.get_nowait()) is not None:
            here.append(one)
    return here


def _has_come(event: zenoh.LinkEvent) -> bool:
    """Return whether a connection is new; otherwise it was lost."""
    return event.kind == zenoh.SampleKind.PUT


def _settle_new(here: Iterable[Report]) -> None:
    """Settle the new connections.

    A thousand that come at once are settled by one look, since each look lists all descriptors.
    """
    came = {
        (_port_of(event.link.src), _port_of(event.link.dst)): watch.user_timeout_s
        for watch, event in here
        if _has_come(event)
    }
    if came:
        settle(came)


def _lost_after(events: Iterable[zenoh.LinkEvent], lost: Sequence[str] = ()) -> list[str]:
    """Return the destinations of connections lost after these events, given `lost` before.

    A new connection replaces a lost one: one to the same endpoint if there is one, else the oldest,
    since a host may have another address now.
    """
    left = list(lost)
    for event in events:
        if not _has_come(event):
            left.append(event.link.dst)
        elif left:
            left.remove(event.link.dst if event.link.dst in left else left[0])
    return left


def _hosts_of(watches: Iterable[LinkWatch]) -> set[Host]:
    """Return the IPv4 addresses and ports of other hosts to which connections are lost."""
    hosts = set()
    for endpoint in {endpoint for watch in watches for endpoint in watch.lost}:
        protocol, host, _ = split_endpoint(endpoint)
        if protocol in STREAMS and _is_elsewhere(host):
            hosts.add((host, _port_of(endpoint)))
    return hosts


def _is_elsewhere(address: str) -> bool:
    """Return whether an IPv4 address is another host's: connections to our own are never cut."""
    try:
        socket.inet_aton(address)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as mine:
            mine.bind((address, 0))
    except OSError as error:
        return error.errno is not None  # otherwise it is no IPv4 address
    return False


def _port_of(endpoint: str) -> int:
    """Return the port of an endpoint, 0 if it has none."""
    port = split_endpoint(endpoint)[2]
    return int(port) if port.isdecimal() else 0


def _answers(address: str, port: int) -> bool:
    try:
        socket.create_connection((address, port), LOOK_S).close()
    except OSError:
        return False
    return True
