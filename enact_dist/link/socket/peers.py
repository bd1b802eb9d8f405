"""Identifies the process at the other end of a Unix socket, and its death, via the kernel.

The end of a connection proves nothing about a process: it may have closed its descriptors, or a
forked child may keep them open.  Only a descriptor of the *process* (pidfd) proves its death.  If
the kernel provides none, no process is reported dead.
"""

from __future__ import annotations

import contextlib
import logging
import os
import select
import socket
import struct
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final, NamedTuple

from enact_dist.errors import LinkError

_CREDENTIALS: Final = struct.Struct("iII")
_SO_PEERGROUPS: Final = 59
_SO_PEERPIDFD: Final = 77  # Linux 6.5; also works across containers
GROUPS_MAX: Final = 256
"""Python takes at most 1,024 bytes of an option; a process with more groups has only its first."""
LINGER_S: Final = 5.0
"""A process closes its connections a moment before the kernel reports its end."""
JOIN_S: Final = 0.5

_log = logging.getLogger("enact.link")


class PeerCredentials(NamedTuple):
    """The process that connected, as the kernel recorded it then (-1 or 0: not visible here)."""

    pid: int
    user: int
    group: int


def peer_of(connected: socket.socket) -> PeerCredentials:
    """Return the process at the other end."""
    size = _CREDENTIALS.size
    raw = connected.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, size)
    return PeerCredentials(*_CREDENTIALS.unpack(raw))


def check_peer(
    connected: socket.socket, *, users: frozenset[int], group: int | None
) -> PeerCredentials:
    """Return the process at the other end if its user is in `users` or its group is `group`.

    Raises:
        LinkError: It belongs to another user; the message names it.
    """
    peer = peer_of(connected)
    if peer.user in users or (group is not None and group in _groups_of(connected, peer)):
        return peer
    allowed = f"user {' or '.join(map(str, sorted(users)))}"
    if group is not None:
        allowed += f" or group {group}"
    raise LinkError(
        f"process {peer.pid} of user {peer.user} and group {peer.group} connected to a socket for"
        f" {allowed}; run both processes as the same user, or share a folder of one group"
    )


def _groups_of(connected: socket.socket, peer: PeerCredentials) -> frozenset[int]:
    try:
        raw = connected.getsockopt(socket.SOL_SOCKET, _SO_PEERGROUPS, 4 * GROUPS_MAX)
    except OSError:
        raw = b""
    return frozenset((peer.group, *struct.unpack(f"{len(raw) // 4}I", raw)))


def process_of(connected: socket.socket) -> int | None:
    """Return a descriptor of the process at the other end, or None if the kernel has none."""
    try:
        raw = connected.getsockopt(socket.SOL_SOCKET, _SO_PEERPIDFD, 4)
        return int(struct.unpack("i", raw)[0])
    except OSError:
        pass
    pid = peer_of(connected).pid
    if pid <= 0 or not hasattr(os, "pidfd_open"):
        return None
    try:
        return os.pidfd_open(pid)
    except OSError:  # in another container, or gone already: then the lease ends its session
        return None


@dataclass(slots=True)
class _Watched:
    """One session: its process, its connections, and how long to watch it without any.

    The kernel may have had no descriptor of the process (-1) when it connected; the next
    connection asks again.
    """

    process: int = -1
    connections: set[socket.socket] = field(default_factory=set)
    until_s: float = 0.0


class Deaths:
    """Watches the processes of sessions and reports each that ends.  Thread-safe.

    Args:
        died: Called with the session, from this watcher's own thread.
    """

    def __init__(self, died: Callable[[str], None]) -> None:
        self._died = died
        self._watched: dict[str, _Watched] = {}
        self._session_of: dict[int, str] = {}
        self._mutex = threading.Lock()
        self._poll = select.epoll()
        self._bell = os.eventfd(0, os.EFD_CLOEXEC | os.EFD_NONBLOCK)
        self._poll.register(self._bell, select.EPOLLIN)
        self._closed = False
        self._thread = threading.Thread(target=self._run, name="enact-deaths", daemon=True)
        self._thread.start()

    def connected(self, session: str, connection: socket.socket) -> None:
        """Note one more connection of a session's process."""
        with self._mutex:
            if self._closed:
                return
            watched = self._watched.setdefault(session, _Watched())
            watched.connections.add(connection)
            process = process_of(connection) if watched.process < 0 else None
            if process is None:
                return
            try:
                self._poll.register(process, select.EPOLLIN)
            except OSError as error:  # the kernel cannot watch more: the lease ends the session
                os.close(process)
                _log.warning("the process of session %s is not watched: %s", session[:8], error)
                return
            watched.process = process
            self._session_of[process] = session

    def disconnected(self, session: str, connection: socket.socket) -> None:
        """Note that a connection has ended; the process stays watched a little longer."""
        with self._mutex:
            watched = self._watched.get(session)
            if watched is None:
                return
            watched.connections.discard(connection)
            if not watched.connections and not self._closed:
                watched.until_s = time.monotonic() + LINGER_S
                os.eventfd_write(self._bell, 1)

    def _run(self) -> None:
        while not self._closed:
            found = self._poll.poll(self._sweep())
            for descriptor, _ in found:
                if descriptor == self._bell:
                    self._silence()
                    continue
                with self._mutex:
                    session = self._session_of.get(descriptor)
                    if session is not None:
                        self._forget(session)
                if session is not None:
                    self._died(session)
        with self._mutex:
            for session in list(self._watched):
                self._forget(session)
            self._poll.close()
            os.close(self._bell)

    def _silence(self) -> None:
        with contextlib.suppress(BlockingIOError):
            os.eventfd_read(self._bell)

    def _sweep(self) -> float:
        """Drop processes without connections; return how long to wait, in s (-1: forever)."""
        with self._mutex:
            now_s = time.monotonic()
            ends = {s: w.until_s for s, w in self._watched.items() if not w.connections}
            for session, until_s in ends.items():
                if until_s <= now_s:
                    self._forget(session)
            return min((end_s - now_s for end_s in ends.values() if end_s > now_s), default=-1.0)

    def _forget(self, session: str) -> None:
        watched = self._watched.pop(session)
        if watched.process >= 0:
            del self._session_of[watched.process]
            self._poll.unregister(watched.process)
            os.close(watched.process)

    def close(self) -> None:
        """Stop watching; idempotent."""
        with self._mutex:
            if self._closed:
                return
            self._closed = True
            os.eventfd_write(self._bell, 1)
        if threading.current_thread() is not self._thread:
            self._thread.join(JOIN_S)
