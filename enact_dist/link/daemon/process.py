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
import signal
import sys
import threading
from typing import TYPE_CHECKING, Final

from enact_dist.errors import EnactError
from enact_dist.link.daemon.daemon import formatter_of, start_shard, take_shard
from enact_dist.link.daemon.service_manager import ServiceManager
from enact_dist.link.log import READY, STANDS_BY, Log, say
from enact_dist.link.signals import StopSignals

if TYPE_CHECKING:
    from enact_dist.link.daemon.daemon import RunningShard
    from enact_dist.link.daemon.settings import DaemonSettings

SWITCH_INTERVAL_S: Final = 0.0002
"""With Python's 5 ms a busy store thread would add 7 to 11 ms to a call (p90), measured."""
GC_THRESHOLDS: Final = (5_000, 20, 1_000_000)
"""Allocations between two collections of young objects, and how rarely older ones are examined."""

_log = logging.getLogger("enact.shard")


def run_shard(settings: DaemonSettings) -> int:
    """Run a shard until SIGTERM or SIGINT; return the exit status.  Main thread only."""
    name = settings.shard.name
    manager = ServiceManager()
    formatter = formatter_of(settings)
    gc.set_threshold(*GC_THRESHOLDS)  # a large shard is read without full collections, too
    with Log(formatter), StopSignals() as signals:
        try:
            shard = _started(settings, signals.event, manager, formatter)
        except EnactError as error:
            if settings.log == "json":
                _log.critical("shard %s: %s", name, error, extra={"event": "shard.refused"})
            else:
                print(f"shard {name}: {error}", file=sys.stderr, flush=True)
            return 1
        if shard is None:
            return 0
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


def _started(
    settings: DaemonSettings,
    stopped: threading.Event,
    manager: ServiceManager,
    formatter: logging.Formatter,
) -> RunningShard | None:
    if settings.store is None:
        return start_shard(settings)
    if not settings.standby:
        return take_shard(settings, stopped, lambda: None)
    text = f"{STANDS_BY} for shard {settings.shard.name} of cell {settings.cell}"
    told = threading.Event()

    def waiting() -> None:
        if not told.is_set():
            told.set()
            say(formatter, "shard.standby", text, endpoints=settings.listen)
            manager.ready(text)
        manager.alive(text)

    return take_shard(settings, stopped, waiting)


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
    gc.collect()
    gc.freeze()
