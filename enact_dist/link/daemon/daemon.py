"""A shard as a process: folder, Zenoh session, signals, log.

Exit status: 0 after SIGTERM or SIGINT; 1 if the shard cannot start or its store fails.  On a signal
the daemon drains: it grants nothing new, answers parked requests, lets commits in progress end, and
waits up to `drain_s` for holders to finish, which ends their leases.  A second signal cuts that
wait short.  Locks still held then are logged and lost: their commits will be refused.  Everything
else takes less than 1.2 s.
"""

from __future__ import annotations

import gc
import logging
import secrets
import signal
import sys
import threading
import time
from contextlib import ExitStack
from dataclasses import replace
from itertools import chain
from typing import TYPE_CHECKING, Final

from enact_dist.core.protocol.messages import ListLocks, Locks
from enact_dist.core.protocol.records import Called, SessionBarred, SessionSeen, ShardReturned
from enact_dist.errors import ConfigError, EnactError, LinkError
from enact_dist.link.client.calls import Calls
from enact_dist.link.client.duplicate_daemons import (
    Comparing,
    expected_places,
    moved_places,
    serving,
    two_daemons,
)
from enact_dist.link.daemon.reload import Reload, checked_keys
from enact_dist.link.daemon.service_manager import ServiceManager
from enact_dist.link.daemon.settings import DRAIN_S, DaemonSettings
from enact_dist.link.daemon.shard_calls import ShardCalls
from enact_dist.link.log import READY, JsonLines, Log, TextLines, say
from enact_dist.link.memory.shared_folder import SharedFolder
from enact_dist.link.opening import open_host
from enact_dist.link.signals import StopSignals
from enact_dist.link.socket.service import SocketService
from enact_dist.link.zenoh.config import close_session, listening_settings, open_session, to_reach
from enact_dist.link.zenoh.discovery import FoundShard, find_shards
from enact_dist.link.zenoh.endpoints import somebody_listens
from enact_dist.link.zenoh.service import ZenohService
from enact_dist.wire.keys import name_in

if TYPE_CHECKING:
    from collections.abc import Container, Iterable

    import zenoh

    from enact_dist.core.protocol.messages import Answer
    from enact_dist.link.daemon.metrics import MetricsServer
    from enact_dist.link.host import ShardHost
    from enact_dist.link.zenoh.tls import Certificate

PROBE_S: Final = 0.3
"""How long another daemon with our name may take to answer before we start."""
RECONNECT_S: Final = 2.0
"""How long clients may take to connect again when the shard has taken new keys."""
REOPEN_S, REOPEN_PAUSE_S = 5.0, 0.02
"""How long the port may take to be free for the shard's next Zenoh session."""
SWITCH_INTERVAL_S: Final = 0.0002
"""With Python's 5 ms a busy store thread would add 7 to 11 ms to a call (p90), measured."""
GC_THRESHOLDS: Final = (5_000, 20, 1_000_000)
"""Allocations between two collections of young objects, and how rarely older ones are examined."""

_log = logging.getLogger("enact.shard")


class RunningShard:
    """A running shard.  Made by `start_shard`; `stop` it before the interpreter exits."""

    def __init__(self, settings: DaemonSettings) -> None:
        self.settings = settings
        self._ended = threading.Event()
        self._stopping = threading.Lock()
        self._stopped = False
        self._failure: Exception | None = None
        self._shared = _shared_folder(settings)
        shard = replace(settings.shard, start=secrets.randbits(62))
        if self._shared is not None:
            shard = replace(shard, shared=self._shared.name, shared_nonce=self._shared.nonce)
        with ExitStack() as undo:
            if self._shared is not None:
                undo.callback(self._shared.close)
            self.host: ShardHost = open_host(
                shard,
                settings.folder,
                on_failure=lambda _: self._ended.set(),
                shared=self._shared if settings.shared_bytes_max != 0 else None,
                payload_bytes_max=settings.shared_bytes_max,
            )
            undo.callback(self.host.close)
            self._sockets: SocketService | None = None
            if self._shared is not None and settings.carrier != "zenoh":
                self._sockets = SocketService(self.host, self._shared)
                undo.callback(self._sockets.close)
            self._metrics: MetricsServer | None = None
            if settings.metrics is not None:
                self._metrics = _metrics_server(settings, self.host)
                undo.callback(self._metrics.close)
            self._names = settings.common_names
            self._session = self._open_session()
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
            self.reload: Reload | None = None
            if settings.keys is not None or settings.shard.rights is not None:
                self.reload = Reload(self._take_again, self.host.count, settings.keys)
            undo.pop_all()

    def _open_session(self) -> zenoh.Session:
        settings = self.settings
        return open_session(
            listen=settings.listen,
            lease_s=settings.link_lease_s,
            keys=settings.keys,
            more=listening_settings(
                settings.cell,
                settings.shard.name,
                self._names,
                [entry.name for entry in settings.shard.placement.shards],
            ),
        )

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
            self._session = self._reopened()
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

    def _reopened(self) -> zenoh.Session:
        end_s = time.monotonic() + REOPEN_S
        while True:
            try:
                return self._open_session()
            except LinkError:  # the old socket is not closed yet
                if time.monotonic() > end_s:
                    raise
                time.sleep(REOPEN_PAUSE_S)

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
            self.reload.close()
        with self._stopping:
            if self._stopped:
                return
            self._stopped = True
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

    def stop_now(self) -> None:
        """End the wait of a drain."""
        self.host.stop_now()

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


def _metrics_server(settings: DaemonSettings, host: ShardHost) -> MetricsServer:
    from enact_dist.link.daemon.metrics import MetricsServer, shown_of

    assert settings.metrics is not None
    return MetricsServer(settings.metrics, shown_of(host, settings.cell))


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


def start_shard(settings: DaemonSettings) -> RunningShard:
    """Start a shard in this process; return when it is ready.

    Raises:
        StoreError: The folder is in use, unreadable or corrupt.
        LinkError: An endpoint is in use, or another daemon already serves this shard.
        ConfigError: An endpoint cannot be read, or is missing, or the keys cannot be used.
    """
    if not settings.listen:
        raise ConfigError(f"shard {settings.shard.name} has no endpoint to listen at")
    if settings.keys is not None:
        checked_keys(settings.keys, settings.hosts)
    refuse_second_daemon(settings)
    return RunningShard(settings)


def refuse_second_daemon(settings: DaemonSettings, *, probe_s: float | None = None) -> None:
    """Raise if a daemon already serves this shard at one of its endpoints for clients.

    Other running shards of the cell are asked where they expect it.

    Args:
        settings: Settings of the shard.
        probe_s: How long a listener there may take to identify itself; None: `PROBE_S`.

    Raises:
        LinkError: A daemon does, or another shard of the cell runs twice.
        ConfigError: An endpoint cannot be read.
    """
    probe_s = PROBE_S if probe_s is None else probe_s
    name, cell = settings.shard.name, settings.cell
    shards = settings.shard.placement.shards
    expected = {entry.name: entry.endpoints for entry in shards}
    ours = (*settings.listen, *expected.get(name, ()), *settings.written)
    listening = [place for place in dict.fromkeys(map(to_reach, ours)) if somebody_listens(place)]
    keys = settings.keys
    found = find_shards(listening, timeout_s=probe_s, keys=keys) if listening else ()
    if FoundShard(cell, name) in found:
        raise LinkError(
            f"shard {name} of cell {cell} already runs at {' or '.join(listening)}; two daemons"
            " must not serve one shard: stop the other, or give this one another name"
        )
    others = [entry for entry in shards if entry.name != name]
    reported = expected_places(cell, others, timeout_s=probe_s, keys=keys) if others else ()
    for shard, places in moved_places(expected, chain.from_iterable(reported)).items():
        daemons = serving(cell, shard, places, timeout_s=probe_s, keys=keys)
        if shard == name and daemons:
            raise LinkError(
                f"shard {name} of cell {cell} already runs at {daemons[0]}, where other shards of"
                f" the cell expect it; this start would listen at {', '.join(settings.listen)};"
                " two daemons must not serve one shard: stop the other first, and let the cell.toml"
                " of every shard name the same endpoint"
            )
        if len(daemons) > 1:
            raise LinkError(two_daemons(cell, shard, daemons))


def run_shard(settings: DaemonSettings) -> int:
    """Run a shard until SIGTERM or SIGINT; return the exit status.  Main thread only."""
    name = settings.shard.name
    manager = ServiceManager()
    formatter = _formatter(settings)
    with Log(formatter), StopSignals() as signals:
        try:
            shard = start_shard(settings)
        except EnactError as error:
            if settings.log == "json":
                _log.critical("shard %s: %s", name, error, extra={"event": "shard.refused"})
            else:
                print(f"shard {name}: {error}", file=sys.stderr, flush=True)
            return 1
        try:
            signals.call(lambda word: _stop(shard, word, manager))
            signals.call_again(lambda _: shard.stop_now())
            if shard.reload is not None:
                signals.call_at(signal.SIGHUP, shard.reload)
            shard.host.each_tick(lambda: manager.alive(shard.host.state))
            _say_ready(shard, formatter)
            manager.ready(shard.host.state)
            _stay_responsive()
            shard.wait()
        finally:
            shard.stop(drain_s=settings.drain_s)
        return 1 if shard.failure is not None else 0


def _formatter(settings: DaemonSettings) -> logging.Formatter:
    if settings.log == "json":
        return JsonLines(cell=settings.cell, process=f"shard {settings.shard.name}")
    return TextLines()


def _stop(shard: RunningShard, name: str, manager: ServiceManager) -> None:
    _log.info("%s received", name, extra={"event": "shard.stop"})
    manager.stopping()
    shard.end()


def _say_ready(shard: RunningShard, formatter: logging.Formatter) -> None:
    settings, epoch = shard.settings, shard.host.epoch
    folder = str(settings.folder) if settings.folder else None
    data = f"data in {folder}" if folder else "data in memory only"
    text = (
        f"{READY} shard {settings.shard.name} of cell {settings.cell} at"
        f" {', '.join(settings.listen)}, epoch {epoch}, {data}"
    )
    say(formatter, "shard.ready", text, endpoints=settings.listen, epoch=epoch, folder=folder)


def _stay_responsive() -> None:
    """Configure the interpreter for short calls beside computing threads and many slots.

    A full collection over a million objects blocks all answers for 0.1 s or more.  The shard makes
    no cycles (measured: none in 5,000 updates), so only young objects are collected.
    """
    sys.setswitchinterval(SWITCH_INTERVAL_S)
    gc.collect()
    gc.freeze()
    gc.set_threshold(*GC_THRESHOLDS)
