"""A shard as a process: standing by, takeover, signals, log.

Exit status: 0 after SIGTERM or SIGINT; 1 if the shard cannot start or its store fails.  On a signal
the daemon drains: it grants nothing new, answers parked requests, lets commits in progress end, and
waits up to `drain_s` for holders to finish, which ends their leases.  A second signal cuts that
wait short.  Locks still held then are logged and lost: their commits will be refused.  Everything
else takes less than 1.2 s.
"""

from __future__ import annotations

import gc
import logging
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from typing import Final

import zenoh

from enact_dist.errors import EnactError, LinkError, StoreError
from enact_dist.link.daemon.daemon import (
    RunningShard,
    checked,
    formatter_of,
    listening_session,
    reopened,
    start_shard,
)
from enact_dist.link.daemon.reload import Reload, checked_keys
from enact_dist.link.daemon.service_manager import ServiceManager
from enact_dist.link.daemon.settings import DaemonSettings
from enact_dist.link.log import READY, STANDS_BY, Log, say
from enact_dist.link.postgres.address import require_driver
from enact_dist.link.signals import StopSignals
from enact_dist.link.zenoh.config import close_session
from enact_dist.link.zenoh.tls import Certificate

SWITCH_INTERVAL_S: Final = 0.0002
"""With Python's 5 ms a busy store thread would add 7 to 11 ms to a call (p90), measured."""
TAKE_AGAIN_S: Final = 1.0
"""Pause of a standby after a takeover that failed."""
GC_THRESHOLDS: Final = (5_000, 20, 1_000_000)
"""Allocations between two collections of young objects, and how rarely older ones are examined."""

_log = logging.getLogger("enact.shard")


def run_shard(settings: DaemonSettings) -> int:
    """Run a shard until SIGTERM or SIGINT; return the exit status.  Main thread only."""
    name = settings.shard.name
    manager = ServiceManager()
    formatter = formatter_of(settings)
    gc.set_threshold(*GC_THRESHOLDS)  # a large shard is read without full collections, too
    with Log(formatter), StopSignals() as signals, ExitStack() as undo:
        reload = None
        if settings.change:
            reload = Reload(settings.keys)
            undo.callback(reload.close)
            signals.call_at(signal.SIGHUP, reload)
        while True:
            _forget_garbage()
            try:
                shard = _started(settings, signals.event, manager, formatter, reload)
            except EnactError as error:
                if settings.log == "json":
                    _log.critical("shard %s: %s", name, error, extra={"event": "shard.refused"})
                else:
                    print(f"shard {name}: {error}", file=sys.stderr, flush=True)
                return 1
            if shard is None:
                return 0
            _serve(shard, signals, manager, formatter)
            if shard.failure is not None:
                return 1
            if not shard.moves_to or signals.event.is_set():
                return 0
            settings = replace(shard.settings, standby=True)


def _serve(
    shard: RunningShard, signals: StopSignals, manager: ServiceManager, formatter: logging.Formatter
) -> None:
    """Serve until a signal, a failure, or a request to give the shard to a standby."""
    try:
        signals.call(lambda word: None if shard.wait(0) else _stop(shard, word, manager))
        signals.call_again(lambda _: shard.host.stop_now())
        shard.host.each_tick(lambda: manager.alive(shard.host.state))
        _say_ready(shard, formatter)
        manager.ready(shard.host.state)
        _stay_responsive()
        shard.wait()
    finally:
        shard.stop(drain_s=shard.settings.drain_s)


def _started(
    settings: DaemonSettings,
    stopped: threading.Event,
    manager: ServiceManager,
    formatter: logging.Formatter,
    reload: Reload | None,
) -> RunningShard | None:
    if settings.store is None:
        return start_shard(settings, reload)
    if not settings.standby:
        return take_shard(settings, stopped, lambda: None, reload)
    text = f"{STANDS_BY} for shard {settings.shard.name} of cell {settings.cell}"
    told = threading.Event()

    def waiting() -> None:
        if not told.is_set():
            told.set()
            say(formatter, "shard.standby", text, endpoints=settings.listen)
            manager.ready(text)
        manager.alive(text)

    return take_shard(settings, stopped, waiting, reload)


class WaitingShard:
    """The endpoints of a daemon that waits for its shard: clients connect before it serves.

    Attributes:
        settings: With keys, names and rights as they were taken last.
        certificate: The one that it shows, in a cell with keys.
        session: The Zenoh session that listens; None: it could not listen again.
    """

    def __init__(self, settings: DaemonSettings) -> None:
        self.settings = settings
        self.certificate = checked(settings)
        names = settings.common_names
        self.session: zenoh.Session | None = reopened(lambda: listening_session(settings, names))

    def take_again(self) -> Certificate | None:
        """Listen with keys and names as they are now, and keep the rights; return the certificate.

        Raises:
            EnactError: They cannot be used; nothing has changed.
        """
        settings = self.settings.read_again()
        keys, names = settings.keys, settings.common_names
        if keys is not None:
            self.certificate = checked_keys(keys, settings.hosts)
        self.settings = settings
        if keys is not None:
            self.close()
            try:
                self.session = reopened(lambda: listening_session(settings, names))
            except LinkError as error:
                _log.critical(
                    "shard %s: clients cannot connect before it serves: %s",
                    settings.shard.name,
                    error,
                )
        return self.certificate

    def close(self) -> None:
        """Close the session; idempotent."""
        session, self.session = self.session, None
        if session is not None:
            close_session(session)


def take_shard(
    settings: DaemonSettings,
    stopped: threading.Event,
    waiting: Callable[[], None],
    reload: Reload | None,
) -> RunningShard | None:
    """Start a shard in a database once no other daemon serves it; None once `stopped` is set.

    Args:
        settings: The settings of the shard, with its place.
        stopped: Ends the wait.
        waiting: Called ten times a second.
        reload: Of this process, for the wait and for the shard.

    Raises:
        As `start_shard`; a standby waits for its database, too.
    """
    assert settings.store is not None
    require_driver(settings.store.url)
    from enact_dist.link.daemon.metrics import MetricsServer, StandbyProbes
    from enact_dist.link.postgres.standby import StandbyWatch, wait_free

    own, watch, name = WaitingShard(settings), StandbyWatch(), settings.shard.name
    probes = StandbyProbes(settings, watch.shown)

    def looked(answered: bool) -> None:
        probes.looked(answered)
        waiting()

    with ExitStack() as undo:
        undo.callback(own.close)
        metrics = None
        if settings.metrics is not None:
            metrics = MetricsServer(settings.metrics, probes.source())
            undo.callback(metrics.close)
        if reload is not None:
            undo.callback(reload.pause)
        while True:
            if reload is not None:
                reload.turn_to(own.take_again, watch.count, own.certificate)
            free = wait_free(
                settings.store,
                stopped=stopped,
                patient=settings.standby,
                note=lambda text: _log.info("shard %s stands by: %s", name, text),
                looked=looked,
                watch=watch,
            )
            if free is None:
                return None
            probes.takes()
            if reload is not None:
                reload.pause()
            try:
                with _each_second(waiting, name):
                    shard = RunningShard(
                        own.settings, own.certificate, free, own.session, metrics, reload
                    )
            except StoreError as error:
                if stopped.is_set():
                    return None
                if not settings.standby:
                    raise
                _log.warning("shard %s stands by again: %s", name, error)
                stopped.wait(TAKE_AGAIN_S)
            else:
                undo.pop_all()
                return shard


@contextmanager
def _each_second(act: Callable[[], None], name: str) -> Iterator[None]:
    """Call a function each second: a takeover that reads for long must pass for alive."""
    over = threading.Event()

    def go_on() -> None:
        if not over.wait(1.0):
            text = (
                "shard %s is being taken over: it is read, or the database has not confirmed that"
            )
            _log.info(text, name)
        while not over.wait(1.0):
            act()

    thread = threading.Thread(target=go_on, name="enact-takeover", daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


def _stop(shard: RunningShard, name: str, manager: ServiceManager) -> None:
    _log.info("%s received", name, extra={"event": "shard.stop"})
    manager.stopping()
    shard.end()


def _say_ready(shard: RunningShard, formatter: logging.Formatter) -> None:
    settings, epoch = shard.settings, shard.host.epoch
    place = settings.store or settings.folder
    folder = str(place) if place else None
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
    gc.freeze()  # without a collection, which would block answers for 0.3 s with 80,000 states


def _forget_garbage() -> None:
    """Collect everything: what the start has left, or the shard that this process had before."""
    gc.unfreeze()
    gc.collect()
