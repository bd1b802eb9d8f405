"""A running shard: its folder or place in a database, its Zenoh session, its keys, its end."""

from __future__ import annotations

import logging
import os
import secrets
import threading
import time
from contextlib import ExitStack
from dataclasses import replace
from typing import TYPE_CHECKING, Final

from enact_dist.core.protocol.messages import Answer, ListLocks, Locks
from enact_dist.core.protocol.records import Called, SessionBarred, SessionSeen, ShardReturned
from enact_dist.errors import ConfigError, LinkError
from enact_dist.link.client.calls import Calls
from enact_dist.link.client.duplicate_daemons import Comparing
from enact_dist.link.daemon.reload import Reload, checked_keys
from enact_dist.link.daemon.second_daemon import refuse_second_daemon
from enact_dist.link.daemon.settings import DRAIN_S, DaemonSettings
from enact_dist.link.daemon.shard_calls import ShardCalls
from enact_dist.link.daemon.successor import Successor
from enact_dist.link.lease import ShardTakenError
from enact_dist.link.log import JsonLines, TextLines, last_words
from enact_dist.link.memory.shared_folder import SharedFolder
from enact_dist.link.opening import open_host
from enact_dist.link.socket.service import SocketService
from enact_dist.link.zenoh.config import close_session, listening_settings, open_session
from enact_dist.link.zenoh.service import ZenohService
from enact_dist.wire.keys import name_in

if TYPE_CHECKING:
    from collections.abc import Callable, Container, Iterable, Mapping

    import zenoh

    from enact_dist.link.daemon.metrics import MetricsServer
    from enact_dist.link.host import ShardHost
    from enact_dist.link.postgres.address import FreeShard
    from enact_dist.link.zenoh.tls import Certificate

RECONNECT_S: Final = 2.0
"""How long clients may take to connect again when the shard has taken new keys."""
REOPEN_S, REOPEN_PAUSE_S = 5.0, 0.02
"""How long the port may take to be free for the shard's next Zenoh session."""

_log = logging.getLogger("enact.shard")


class RunningShard:
    """A running shard.  Made by `start_shard`; `stop` it before the interpreter exits.

    Args:
        settings: The settings of the shard.
        certificate: Its certificate; None: it has no keys.
        free: The shard in a database that it takes over, in place of a folder.
        session: The Zenoh session that serves it, which clients know already; None: a new one.
        metrics: A server that shows this shard from now on; None: a new one, if one is wanted.
        reload: Of this process, which this shard follows until its end; None: one of its own.

    Attributes:
        moves_to: The standby that an operator asked it to give the shard to; "": none.
    """

    def __init__(
        self,
        settings: DaemonSettings,
        certificate: Certificate | None,
        free: FreeShard | None = None,
        session: zenoh.Session | None = None,
        metrics: MetricsServer | None = None,
        reload: Reload | None = None,
    ) -> None:
        self.settings = settings
        self._ended = threading.Event()
        self._stopping = threading.Lock()
        self._stopped = False
        self._failure: Exception | None = None
        self.moves_to = ""
        self._shared = _shared_folder(settings)
        shard = replace(settings.shard, start=secrets.randbits(62))
        if self._shared is not None:
            shard = replace(shard, shared=self._shared.name, shared_nonce=self._shared.nonce)
        with ExitStack() as undo:
            if self._shared is not None:
                undo.callback(self._shared.close)
            self.host: ShardHost = open_host(
                shard,
                free or settings.folder,
                on_failure=self._has_failed,
                shared=self._shared if settings.shared_bytes_max != 0 else None,
                payload_bytes_max=settings.shared_bytes_max,
            )
            undo.callback(self.host.close)
            if free is not None and free.seen.holder:
                self.host.count("takeovers")
            self._sockets: SocketService | None = None
            if self._shared is not None and settings.carrier != "zenoh":
                self._sockets = SocketService(self.host, self._shared)
                undo.callback(self._sockets.close)
            self._metrics = self._shown(metrics, undo)
            self._names = settings.common_names
            self._session = session or self._open_session()
            if session is None:
                undo.callback(close_session, self._session)
            self._calls = ShardCalls(
                settings.cell,
                shard.name,
                shard.placement.shards,
                lease_s=settings.link_lease_s,
                answered=lambda *call: self.host.event(Called(*call)),
                returned=lambda name: self.host.event(ShardReturned(name)),
                keys=settings.keys,
            )
            undo.callback(self._calls.close)
            self._comparing = Comparing(settings.cell, self.host.event, settings.keys)
            undo.callback(self._comparing.close)
            self.host.call_with(self._calls.submit, self._comparing.submit)
            self._service = self._served()
            for other in self._calls.others:  # the first tick's requests to them were not sent
                self.host.event(ShardReturned(other))
            undo.callback(self._service.close)
            self._successor: Successor | None = None
            if self.host.silence is not None:
                self._successor = Successor(
                    self.host, settings, self._has_failed, lambda: self._service
                )
                undo.callback(self._successor.close)
                self.host.silence.on_move(self._move)
            self._own_reload = Reload(settings.keys) if reload is None and settings.change else None
            self.reload = self._own_reload or reload
            undo.pop_all()
        if self.reload is not None:
            self.reload.turn_to(self._take_again, self.host.count, certificate)

    def _shown(self, metrics: MetricsServer | None, undo: ExitStack) -> MetricsServer | None:
        if self.settings.metrics is None:
            return None
        from enact_dist.link.daemon.metrics import MetricsServer, source_of

        source = source_of(self.host, self.settings.cell)
        if metrics is None:
            metrics = MetricsServer(self.settings.metrics, source)
            undo.callback(metrics.close)
        else:
            metrics.show(source)
        return metrics

    def _has_failed(self, failure: Exception) -> None:
        if isinstance(failure, ShardTakenError):
            # Another process serves the shard: whatever is still in this one must not leave it.
            last_words(formatter_of(self.settings), f"this process ends at once: {failure}")
            os._exit(1)
        self._ended.set()

    def _move(self, to: str) -> None:
        _log.info(
            "shard %s goes to %s", self.settings.shard.name, to, extra={"event": "shard.move"}
        )
        self.moves_to = to
        self._ended.set()

    def _open_session(self) -> zenoh.Session:
        return listening_session(self.settings, self._names)

    def _served(self) -> ZenohService:
        proven = self._names is not None
        return ZenohService(self.host, self._session, self.settings.cell, proven=proven)

    def _take_again(self) -> Certificate | None:
        """Serve with keys, names and rights as they are now; return the certificate, if any.

        Clients connect again; sessions and locks stay, except for those of names that are barred.

        Raises:
            EnactError: They cannot be used; nothing has changed.
        """
        settings = self.settings.read_again()
        keys, rights = settings.keys, settings.shard.rights
        with self._stopping:
            certificate = checked_keys(keys, settings.hosts) if keys is not None else None
            names = settings.common_names
            if self._stopped:
                return certificate
            barred = {
                name
                for name, proof in (self._names or {}).items()
                if names is not None and names.get(name) != proof
            }
            self.settings, self._names = settings, names
            if rights is not None:
                self.host.take_rights(rights)
                if self._sockets is not None:
                    self._sockets.take_rights()
            if keys is not None:
                self._reopen(barred)
        return certificate

    def _reopen(self, barred: Container[str]) -> None:
        """Open the Zenoh session with the settings of now, and end the sessions of barred names."""
        before = self._service
        before.close()
        close_session(self._session)
        try:
            self._session = reopened(self._open_session)
            self._service = self._served()
        except Exception as error:
            _log.critical("shard %s cannot listen again: %s", self.settings.shard.name, error)
            self._failure = error
            self._ended.set()
            raise
        for session, identity in self.host.owners().items():
            if name_in(identity) in barred:
                self.host.event(SessionBarred(session))
        grace_s = self.settings.link_lease_s + RECONNECT_S
        timer = threading.Timer(grace_s, self._report_absent, (tuple(before.present),))
        timer.daemon = True
        timer.start()

    def _report_absent(self, before: Iterable[tuple[str, str]]) -> None:
        """Report the tokens that have not come back: their clients ended during a reload."""
        for session, identity in before:
            if not self._stopped and (session, identity) not in self._service.present:
                self.host.event(SessionSeen(session, present=False, identity=identity))

    @property
    def failure(self) -> Exception | None:
        """Why the shard ended by itself, or None."""
        return self.host.failure or self._failure

    def wait(self, timeout_s: float | None = None) -> bool:
        """Wait until the shard has failed or was asked to end; False after `timeout_s`."""
        return self._ended.wait(timeout_s)

    def end(self) -> None:
        """Make `wait` return; may be called from a signal handler."""
        self._ended.set()

    def stop(self, *, drain_s: float = DRAIN_S) -> None:
        """Drain, answer parked requests, close connections and store; idempotent."""
        if self.reload is not None:
            self.reload.pause()
        if self._own_reload is not None:
            self._own_reload.close()
        with self._stopping:
            if self._stopped:
                return
            self._stopped = True
            if self._successor is not None:
                self._successor.close()
            self.host.drain()
            if not self.host.wait_idle(drain_s):
                self._name_holders(drain_s)
            self.host.drain()  # requests parked meanwhile are answered, too
            for part in (self.host, self._calls, self._comparing, self._sockets, self._service):
                if part is not None:
                    part.close()
            close_session(self._session)
            if self._metrics is not None:
                self._metrics.close()
            if self._shared is not None:
                self._shared.close()
            self._ended.set()

    def _name_holders(self, drain_s: float) -> None:
        held = []
        calls = Calls([(self.settings.shard.name, ListLocks())])
        while calls.left:
            answers: list[Answer] = []
            self.host.submit(calls.asked[0][1], answers.append)
            if not answers:  # it has stopped by itself
                break
            calls.take(0, answers[0])
        for answer in calls.answers:
            held += [
                f"{holder.actor}@{holder.host} ({', '.join(holder.slots)})"
                for holder in (answer.holders if isinstance(answer, Locks) else ())
                if holder.granted
            ]
        if held:
            _log.warning(
                "%d locks are lost because they were still held when the drain of %g s ended: %s;"
                " to give them more time, set --drain, ENACT_SHARD_<NAME>_DRAIN_S, or drain_s in"
                " [shards.%s] of cell.toml; the first of these that is set counts",
                len(held),
                drain_s,
                "; ".join(held),
                self.settings.shard.name,
                extra={"event": "shard.drain_over"},
            )


def listening_session(settings: DaemonSettings, names: Mapping[str, str] | None) -> zenoh.Session:
    """Open the Zenoh session at which a shard listens; `names` are those of clients with keys."""
    return open_session(
        listen=settings.listen,
        lease_s=settings.link_lease_s,
        keys=settings.keys,
        more=listening_settings(
            settings.cell,
            settings.shard.name,
            names,
            [entry.name for entry in settings.shard.placement.shards],
        ),
    )


def reopened(opened: Callable[[], zenoh.Session]) -> zenoh.Session:
    """Open a session at a port that this process has just given up."""
    end_s = time.monotonic() + REOPEN_S
    while True:
        try:
            return opened()
        except LinkError:  # the old socket is not closed yet
            if time.monotonic() > end_s:
                raise
            time.sleep(REOPEN_PAUSE_S)


def _shared_folder(settings: DaemonSettings) -> SharedFolder | None:
    """Make the folder that the shard shares with processes of this host.

    Raises:
        LinkError: It is required and cannot be made.
    """
    if settings.carrier == "zenoh" and settings.shared_bytes_max == 0:
        return None
    try:
        return SharedFolder(settings.cell, settings.shard.name)
    except LinkError as error:
        if settings.carrier == "socket":
            raise
        _log.warning("no memory is shared on this host: %s", error)
        return None


def start_shard(settings: DaemonSettings, reload: Reload | None = None) -> RunningShard:
    """Start a shard in this process; return when it is ready.

    Args:
        settings: The settings of the shard.
        reload: Of this process; None: one of its own, if there is anything to take anew.

    Raises:
        StoreError: The folder is in use, unreadable or corrupt.
        LinkError: An endpoint is in use, or another daemon already serves this shard.
        ConfigError: An endpoint cannot be read, or is missing, or the keys cannot be used.
    """
    return RunningShard(settings, checked(settings), reload=reload)


def checked(settings: DaemonSettings) -> Certificate | None:
    """Return the certificate of a shard that may start, None in a cell without keys.

    Raises:
        As `start_shard`.
    """
    if not settings.listen:
        raise ConfigError(f"shard {settings.shard.name} has no endpoint to listen at")
    keys = settings.keys
    certificate = checked_keys(keys, settings.hosts) if keys is not None else None
    refuse_second_daemon(settings)
    return certificate


def formatter_of(settings: DaemonSettings) -> logging.Formatter:
    """Return how the log of a shard's process is written."""
    if settings.log == "json":
        return JsonLines(cell=settings.cell, process=f"shard {settings.shard.name}")
    return TextLines()
