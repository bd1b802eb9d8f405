"""Serves one `ShardHost` to the processes of its own host, over a Unix socket.

A client that does not read blocks only its own connection: see `SocketConnection` for requests and
answers, `SocketWatcher` for notices.

The kernel reports who connects and when that process ends: its session then ends at once.
"""

from __future__ import annotations

import itertools
import logging
import os
import select
import socket
import threading
import time
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Final

from enact_dist.core.protocol.records import SessionBarred, SessionDied
from enact_dist.core.shard.owners import is_shard, not_yours
from enact_dist.errors import LinkError
from enact_dist.link.socket.connection import SocketConnection
from enact_dist.link.socket.frames import end_socket
from enact_dist.link.socket.peers import Deaths, PeerCredentials, check_peer
from enact_dist.link.socket.watcher import OutgoingNotice
from enact_dist.link.zenoh.access import opens
from enact_dist.wire.keys import name_in

if TYPE_CHECKING:
    from collections.abc import Callable

    from enact_dist.core.protocol.messages import Notice
    from enact_dist.link.host import ShardHost
    from enact_dist.link.memory.shared_folder import SharedFolder
    from enact_dist.link.socket.watcher import SocketWatcher

SOCKET_NAME: Final = "socket"
CONNECTIONS_MAX: Final = 1024
"""Connections to one shard: each costs a thread and 0.1 MB."""
SESSION_CONNECTIONS_MAX: Final = 128
"""Connections of one session: one per thread that calls at the same time, and one per feed."""
PROCESS_CONNECTIONS_MAX: Final = 128
"""Connections that each process may always have; more only while many are free."""
KEPT_FREE: Final = 512
"""Connections reserved for processes that have fewer than that."""
BACKLOG: Final = 256
BURST: Final = 16
BURST_PAUSE_S: Final = 0.005
"""After so many connections the next has to wait so long, so that a client that opens hundreds
leaves the interpreter to the others: each starts a thread."""
DRAIN_ROUNDS: Final = 20
DRAIN_STEP_S: Final = 0.001
"""How often and how long a tick waits for arrived requests to be submitted."""
JOIN_S: Final = 0.5
"""How long closing waits for the accepting thread, and then for all connections together."""

_log = logging.getLogger("enact.link")


class SocketService:
    """Serves one shard on a Unix socket in its shared folder.

    Args:
        host: The shard.
        folder: Contains the socket; its owner closes it.

    Raises:
        LinkError: The socket cannot be made.
    """

    def __init__(self, host: ShardHost, folder: SharedFolder) -> None:
        self.host = host
        self._access = folder.access
        self._users = frozenset((os.geteuid(), 0))
        self._closing = threading.Event()
        self._mutex = threading.Lock()
        self._connections: dict[str, set[SocketConnection]] = {}
        self._processes: Counter[PeerCredentials] = Counter()
        self._count = 0
        self._watchers: tuple[SocketWatcher, ...] = ()
        self._listener = _listen(folder)
        self._deaths = Deaths(self._died)
        self._unwatch: Callable[[], None] | None = None
        host.add_inbox(self.drain_inbox)
        host.add_inbox(self._tell_skipped)
        self._thread = threading.Thread(target=self._accept, name="enact-accept", daemon=True)
        self._thread.start()

    # ---------------------------------------------------------------- connections

    def _accept(self) -> None:
        for number in itertools.count(1):
            if number % BURST == 0:
                self._closing.wait(BURST_PAUSE_S)
            try:
                connected, _ = self._listener.accept()
            except OSError as error:
                if self._closing.is_set():
                    return
                self.host.count("connections_refused")
                _log.warning("could not accept a connection: %s", error)
                self._closing.wait(0.05)
                continue
            connection = SocketConnection(self, connected)
            try:
                threading.Thread(target=connection.run, name="enact-socket", daemon=True).start()
            except RuntimeError:  # no thread available
                self.host.count("connections_refused")
                connected.close()

    def admit(self, connection: SocketConnection, session: str, secret: str) -> None:
        """Admit a connection for a session, which its secret opens.

        Raises:
            LinkError: It is from another user, the session belongs to another process, or there are
                too many.
        """
        peer = check_peer(connection.connected, users=self._users, group=self._access.group)
        connection.peer = peer
        owner, asker = self.host.owner_of(session), connection.identity
        if is_shard(asker):  # any process of the group could decide commits in its name
            raise LinkError(
                f"process {peer.pid} of user {peer.user} called itself {asker}; shards call each"
                " other over Zenoh"
            )
        if not opens(secret, session):
            raise LinkError(
                f"process {peer.pid} of user {peer.user} does not know the secret of session"
                f" {session[:8]}; only the process that opened it does"
            )
        if owner and owner != asker:  # else the end of this process would end that session
            raise LinkError(not_yours(session, owner, asker).text)
        with self._mutex:
            connection.subject = self._subject_of(asker, peer)  # in one step with `take_rights`
            mine = self._connections.get(session, set())
            problem = self._problem_with(session, mine, peer)
            crowded = not problem and self._has_its_share(peer)
            if not problem and not crowded:
                self._connections[session] = mine
                mine.add(connection)
                self._processes[peer] += 1
                self._count += 1
        if crowded:
            self.host.count("quota_refused")
            problem = (
                f"process {peer.pid} has {PROCESS_CONNECTIONS_MAX} connections or more to shard"
                f" {self.host.name} open, and the last {KEPT_FREE} are reserved for others"
            )
        if problem:
            raise LinkError(problem)
        self._deaths.connected(session, connection.connected)

    def take_rights(self) -> None:
        """Let each connection use the rights that the shard has now, or end it and its session."""
        with self._mutex:
            present = [one for mine in self._connections.values() for one in mine]
        for connection in present:
            try:
                connection.subject = self._subject_of(connection.identity, connection.peer)
            except LinkError as error:
                _log.warning("connection of %s ended: %s", connection.identity, error)
                self.host.event(SessionBarred(connection.session))
                connection.end()

    def _subject_of(self, identity: str, peer: PeerCredentials) -> str | None:
        """Return whose rights a process uses, by its user; None: the shard has no rights.

        Raises:
            LinkError: Its user has none.
        """
        rights = self.host.rights
        if rights is None:
            return None
        name = name_in(identity)
        subject = rights.subject_of(peer.user, name, trusted=peer.user in self._users)
        if not subject:
            raise LinkError(
                f"user {peer.user} of process {peer.pid} has no rights at shard {self.host.name};"
                f" add it to `uids`: {rights.hint}"
            )
        name = name.partition(":")[0]  # behind it is the word of a program of that name
        trusted = peer.user in self._users or subject in rights.operators
        if not trusted and name in rights.known and not rights.means(subject, name):
            raise LinkError(
                f"process {peer.pid} of user {peer.user} called itself {name}, which is another"
                f" name of the cell; that user is {subject}: {rights.hint}"
            )
        return subject

    def _problem_with(
        self, session: str, mine: set[SocketConnection], peer: PeerCredentials
    ) -> str:
        """Return why a process may not open another connection for a session; "" if it may."""
        other = next((one.peer for one in mine if one.peer != peer), None)
        if other is not None:
            # One session is one process; it would not know what another one does in its name.
            return (
                f"session {session[:8]} belongs to process {other.pid} of user {other.user};"
                f" process {peer.pid} of user {peer.user} may not use it"
            )
        if len(mine) >= SESSION_CONNECTIONS_MAX:
            return f"session {session[:8]} has {SESSION_CONNECTIONS_MAX} connections open"
        if self._closing.is_set() or self._count >= CONNECTIONS_MAX:
            return f"{CONNECTIONS_MAX} connections to shard {self.host.name} are open"
        return ""

    def may_release(self, session: str, peer: PeerCredentials) -> bool:
        """Whether a session has connections from this process, or has ended."""
        with self._mutex:
            if any(one.peer == peer for one in self._connections.get(session, ())):
                return True
        return session not in self.host.owners()

    def _has_its_share(self, peer: PeerCredentials) -> bool:
        """Whether a process must leave the free connections to others."""
        free = CONNECTIONS_MAX - self._count
        return self._processes[peer] >= PROCESS_CONNECTIONS_MAX and free <= KEPT_FREE

    def left(self, connection: SocketConnection, session: str) -> None:
        """Record the end of an admitted connection."""
        with self._mutex:
            mine = self._connections.get(session, set())
            mine.discard(connection)
            self._count -= 1
            self._processes[connection.peer] -= 1
            if not self._processes[connection.peer]:
                del self._processes[connection.peer]
            if not mine:
                self._connections.pop(session, None)
        self._deaths.disconnected(session, connection.connected)

    def _died(self, session: str) -> None:
        self.host.event(SessionDied(session))
        with self._mutex:
            left = list(self._connections.get(session, ()))
        for connection in left:  # forked children may hold them open
            connection.end()

    def drain_inbox(self) -> None:
        """Before a tick, wait briefly until arrived requests have been submitted to the host."""
        with self._mutex:
            steps = {c: c.step for mine in self._connections.values() for c in mine}
        waiting = {c.connected.fileno(): c for c, step in steps.items() if step % 3 == 0}
        waiting.pop(-1, None)
        poll = select.poll()
        for descriptor in waiting:
            poll.register(descriptor, select.POLLIN)
        arrived = [c for c, step in steps.items() if step % 3 == 1]
        if waiting:
            arrived += [waiting[d] for d, event in poll.poll(0) if event & select.POLLIN]
        for _ in range(DRAIN_ROUNDS):
            arrived = [
                c for c in arrived
                if c.step < steps[c] // 3 * 3 + 2 and not c.ended.is_set()
            ]  # fmt: skip
            if not arrived or self._closing.wait(DRAIN_STEP_S):
                return

    # ---------------------------------------------------------------- notices

    def watch(self, watcher: SocketWatcher) -> None:
        """Send all further notices to `watcher`."""
        with self._mutex:
            self._watchers = (*self._watchers, watcher)
            if self._unwatch is None:  # until a process watches, a commit costs nothing here
                self._unwatch = self.host.watch(self._publish)

    def unwatch(self, watcher: SocketWatcher) -> None:
        """Stop sending notices to `watcher`."""
        with self._mutex:
            self._watchers = tuple(other for other in self._watchers if other is not watcher)

    def _publish(self, notice: Notice) -> None:
        """Send a notice to all watchers without blocking.  The host's mutex is held."""
        bare, whole = OutgoingNotice(notice), None
        for watcher in self._watchers:
            if watcher.takes_data(notice):
                whole = whole or OutgoingNotice(self.host.with_data(notice))
                watcher.put(whole)
            else:
                watcher.put(bare)

    def _tell_skipped(self) -> None:
        for watcher in self._watchers:
            watcher.tell_skipped()

    # ---------------------------------------------------------------- end

    def close(self) -> None:
        """Stop serving; idempotent."""
        if self._closing.is_set():
            return
        self._closing.set()
        if self._unwatch is not None:
            self._unwatch()
        end_socket(self._listener)
        self._thread.join(JOIN_S)
        self._listener.close()
        with self._mutex:
            left = [connection for mine in self._connections.values() for connection in mine]
        for connection in left:
            connection.end()
        deadline_s = time.monotonic() + JOIN_S
        for connection in left:
            connection.ended.wait(max(0.0, deadline_s - time.monotonic()))
        self._deaths.close()


def _listen(folder: SharedFolder) -> socket.socket:
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        listener.bind(folder.address(SOCKET_NAME))
        # No client reaches it before its mode is set: the folder keeps other users out, too.
        Path(folder.address(SOCKET_NAME)).chmod(folder.access.socket_mode)
        listener.listen(BACKLOG)
    except OSError as error:
        listener.close()
        raise LinkError(
            f"cannot make a socket in {folder.path}: {error.strerror or error}"
        ) from None
    return listener
