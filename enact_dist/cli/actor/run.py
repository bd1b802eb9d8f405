"""`enact actor run`: one actor in this process, or several."""

from __future__ import annotations

import logging
import os
import socket
import sys
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from enact_dist.actor.running.commands import CommandListener
from enact_dist.actor.running.doing import raised
from enact_dist.actor.running.group import ANEW, CUT_OFF, DRAIN_S, ActorGroup, Leaving, Life
from enact_dist.cli.arguments import pairs
from enact_dist.cli.target import cell_config, cell_target, is_endpoint, open_cell, see_modules
from enact_dist.cli.verbs import DONE, exit_status, told
from enact_dist.config.table import path_of, suggestion
from enact_dist.config.types import ActorConfig, ActorProcess, CellConfig, processes_of
from enact_dist.errors import ConfigError, EnactError, MisuseError, UnknownWorldError
from enact_dist.link.daemon.service_manager import ServiceManager
from enact_dist.link.log import READY, JsonLines, TextLines, say
from enact_dist.link.signals import StopSignals

if TYPE_CHECKING:
    import argparse
    from collections.abc import Callable, Iterable, Mapping

    from enact_dist.actor.actor import Actor
    from enact_dist.actor.report import ActorStatistics
    from enact_dist.actor.running.runner import ActorRun
    from enact_dist.world.cell import Cell

_log = logging.getLogger("enact.actor")
_OF_ONE = (("--name", "name"), ("--world", "world"), ("--option", "option"),
           ("--entity", "entity"), ("--every", "every"))  # fmt: skip
"""Options that say something of one actor only."""


@dataclass(frozen=True, slots=True)
class _Made:
    """An actor that is ready to run: what the command line or `cell.toml` says of it."""

    actor: Actor
    name: str
    worlds: dict[str, str] | None
    drain_s: float


def run_actors(options: argparse.Namespace) -> int:
    """Run actors until they are done or a signal comes."""
    process = _process(options)
    drain_s = DRAIN_S if options.drain_s is None else float(options.drain_s)
    leaving = Leaving()
    try:
        if process is not None and len(process.actors) > 1:
            return _run_group(options, process, leaving)
        return _run_one(options, process, leaving)
    except Exception as error:
        leaving.within(drain_s, exit_status(error))
        raise


def _run_one(options: argparse.Namespace, process: ActorProcess | None, leaving: Leaving) -> int:
    """Run the actor of a process of its own."""
    manager = ServiceManager()
    target = process.members[0] if process is not None else options.targets[0]
    json_lines = JsonLines(process=f"actor {options.name or target}")
    formatter = json_lines if options.log == "json" else TextLines()
    _log_to_stderr(formatter)
    made = _made(options, target)  # a signal ends an import at once
    life = Life(made.name, made.drain_s, alive=manager.alive, ready=manager.ready)
    with StopSignals() as signals:
        for act in (lambda _: manager.stopping(), life.end):
            signals.call(act)
        signals.call_again(life.stop_now)
        status = _lived(options, made, life, formatter)
    if status or signals.count:  # else it is done, and what it has started may go on
        leaving.within(made.drain_s, status or CUT_OFF)
    return status


def _run_group(options: argparse.Namespace, process: ActorProcess, leaving: Leaving) -> int:
    """Run the actors of a process, each in a thread; see `actor.running.group`."""
    manager = ServiceManager()
    json_lines = JsonLines(process=f"process {process.name}", actors=process.members)
    formatter = json_lines if options.log == "json" else TextLines(process.members)
    _begin_with(process.env)
    _log_to_stderr(formatter)
    first: dict[str, _Made | Exception] = {}
    for actor in process.actors:  # in this thread, where a signal ends an import at once
        try:
            first[actor.name] = _made(options, actor.name, begun=True)
        except Exception as error:  # noqa: BLE001 - told where that actor begins; others run
            first[actor.name] = error

    def live(name: str, life: Life) -> int:
        try:
            made = first.pop(name, None) or _made(options, name, begun=True)
            if isinstance(made, Exception):
                raise made
            return _lived(options, made, life, formatter)
        except (EnactError, OSError, ImportError, MemoryError) as error:
            for line in (*getattr(error, "__notes__", ()), told(error)):
                _log.critical("actor %s: %s", name, line)
            return exit_status(error)
        except Exception as error:  # noqa: BLE001 - of a process of its own it would be the end
            _log.exception("actor %s failed", name)
            return exit_status(error)

    drains_s = {one.name: _drain_s(options, one) for one in process.actors}
    group = ActorGroup(process.name, drains_s, live, alive=manager.alive, ready=manager.ready)
    with StopSignals() as signals:
        for act in (lambda _: manager.stopping(), group.end):
            signals.call(act)
        signals.call_again(group.stop_now)
        status = group.run()
    if status or signals.count:
        leaving.within(max(drains_s.values()), status or CUT_OFF)
    return status


def _lived(
    options: argparse.Namespace, made: _Made, life: Life, formatter: logging.Formatter
) -> int:
    """Run an actor once, in a session of its own; return its exit status."""
    name = made.name
    with open_cell(options, observer=False, actor=name) as cell:
        if isinstance(formatter, JsonLines):
            formatter.cell = cell.name
            formatter.process = formatter.process if formatter.actors else f"actor {name}"
        run = _bound(made, cell, life)
        life.begin(run.doing)
        restarts = threading.Event()

        def restart() -> None:
            restarts.set()
            life.end("the word to begin anew")

        def ready() -> None:
            run.answer()
            say(formatter, "actor.ready", f"{READY} actor {name} in cell {cell.name}")
            life.ready()
            _warn_of_same_name(cell, name)

        with CommandListener(made.actor, run, cell, restart):
            statistics = _run(run, ready)
    life.over()
    counted = {key: getattr(statistics, key) for key in ("state", "updates", "failures", "refused")}
    say(formatter, "actor.end", _end_line(name, statistics), **counted)
    return ANEW if restarts.is_set() else DONE


def _run(run: ActorRun, ready: Callable[[], None]) -> ActorStatistics:
    """Run an actor to its end.

    Raises:
        MisuseError: Its `start` or `stop` raised something of its own.
    """
    try:
        return run.run(on_ready=ready)
    except EnactError:
        raise
    except Exception as error:
        method = "start" if run.statistics().state == "starting" else "stop"
        raise MisuseError(f"{method} of actor {run.name} failed: {raised(error)}") from error


def _bound(made: _Made, cell: Cell, life: Life) -> ActorRun:
    """Return the run of an actor whose roles are bound.

    Raises:
        ConfigError: They cannot be bound like this: the same command would fail the same way.
        UnknownWorldError: The cell has no such world context; it may be made yet.
    """
    from enact_dist.actor.running.runner import ActorRun

    try:
        return ActorRun(made.actor, cell, made.worlds, stop=life.stop, name=made.name)
    except UnknownWorldError:
        raise
    except MisuseError as error:
        raise ConfigError(str(error)) from error


def _warn_of_same_name(cell: Cell, name: str) -> None:
    """Say which other actors of this name run; several may be meant, so none is refused."""
    from enact_dist.world.cell import session_behind
    from enact_dist.world.listings import sessions_named

    try:
        others = sessions_named(session_behind(cell).client, name)
    except EnactError as error:
        _log.info("whether another actor %s runs is not known: %s", name, error)
        return
    for other in others:
        gone = other.host == socket.gethostname() and not _runs(other.pid)
        if not gone:  # else a predecessor, whose session has not ended yet
            _log.warning(
                "another actor named %s runs, process %d on %s; unless both are meant, end one",
                name, other.pid, other.host,
            )  # fmt: skip


def _runs(pid: int) -> bool:
    """Whether a process of this host, and of this container, runs beside this one."""
    return pid != os.getpid() and Path(f"/proc/{pid}").exists()


def _log_to_stderr(formatter: logging.Formatter) -> None:
    """Let the log of the actors and of what they use go to standard error."""
    handler = logging.StreamHandler()
    handler.setFormatter(formatter)
    logging.basicConfig(level=logging.INFO, handlers=[handler])


# ---------------------------------------------------------------- what the command names


def _process(options: argparse.Namespace) -> ActorProcess | None:
    """Return the actors of `cell.toml` that the command names; None for one ``MODULE:CLASS``.

    Raises:
        ConfigError: It names none, one twice, or several with what belongs to one.
    """
    targets: list[str] = options.targets
    if options.process and targets:
        raise ConfigError("name actors, or a process with --process, not both")
    if not targets and not options.process:
        raise ConfigError("name an actor of cell.toml, MODULE:CLASS, or --process NAME")
    if len(targets) == 1 and ":" in targets[0]:
        return None
    if classes := [target for target in targets if ":" in target]:
        raise ConfigError(
            f"{classes[0]} runs in a process of its own; actors that share one have their tables"
            " in cell.toml, and are called by their names"
        )
    config = cell_config(options)
    if options.process:
        actors = [one for one in config.actors if one.process == options.process]
        known = {one.process for one in config.actors if one.process}
        if not actors:
            raise ConfigError(
                f"{config.path} has no process {options.process!r}"
                f"{suggestion(options.process, known)} (known: {_listed(known)})"
            )
    else:
        actors = [actor_entry(config, target) for target in targets]
    _refuse_of_one(options, actors)
    (process, *others) = processes_of(actors)
    if len(actors) > 1 and others:
        process = ActorProcess("+".join(targets), tuple(actors))
        _refuse_other_variables(process)
    return process


def _refuse_of_one(options: argparse.Namespace, actors: list[ActorConfig]) -> None:
    """Raise `ConfigError` where several actors are given what belongs to one, or one twice."""
    names = [one.name for one in actors]
    twice = next((name for name in names if names.count(name) > 1), "")
    if twice:
        raise ConfigError(f"actor {twice} is named twice")
    for option, key in _OF_ONE if len(actors) > 1 else ():
        if getattr(options, key) not in (None, "", []):
            raise ConfigError(
                f"{option} belongs to one actor, but the command runs {', '.join(names)}; write it"
                " into their tables of cell.toml"
            )


def _refuse_other_variables(process: ActorProcess) -> None:
    """Raise `ConfigError` where actors that the command puts together differ in their `env`."""
    for actor in process.actors:
        for name, text in actor.env.items():
            if process.env[name] != text:
                raise ConfigError(
                    f"the actors {', '.join(process.members)} cannot share a process: env sets"
                    f" {name} to {text!r} for {actor.name} and to {process.env[name]!r} for another"
                )


def actor_entry(config: CellConfig, name: str) -> ActorConfig:
    """Return the table of an actor in `cell.toml`.

    Raises:
        ConfigError: There is none of that name.
    """
    for entry in config.actors:
        if entry.name == name:
            return entry
    raise ConfigError(
        f"{config.path} has no actor {name!r} (known:"
        f" {_listed(entry.name for entry in config.actors)}); or write MODULE:CLASS"
    )


def _made(options: argparse.Namespace, target: str, *, begun: bool = False) -> _Made:
    """Make an actor that the command names.

    Args:
        options: Those of the command.
        target: The actor.
        begun: Whether the process has begun with all variables already; what an actor's module
            makes of one when it is loaded is its own business.

    Raises:
        ConfigError: It does not exist and cannot be made.
    """
    from enact_dist.actor.actor import name_of
    from enact_dist.actor.running.load import check_every_s, configured_actor, load_actor

    worlds = pairs(options.world, "--world") or None
    given = pairs(options.option, "--option")
    drain_s = DRAIN_S if options.drain_s is None else options.drain_s
    if ":" in target:
        see_modules(cell_file(options))
        actor = load_actor(target, given)
        name = ""
    else:
        config = cell_config(options)
        see_modules(config.path)
        entry = actor_entry(config, target)
        if given:
            raise ConfigError(f"the options of {entry.name} stand in {config.path}; leave --option")
        if not begun:
            _begin_with(entry.env)
        actor = configured_actor(entry)
        name = entry.name
        drain_s = _drain_s(options, entry)
        worlds = worlds or dict(entry.worlds) or None
    if options.every is not None:
        check_every_s(type(actor), options.every)
        actor.every_s = options.every
    if options.entity is not None:
        actor.only_entity = options.entity
    try:
        actor.declaration.check_entity(actor.only_entity)
    except MisuseError as error:
        raise ConfigError(str(error)) from None
    return _Made(actor, options.name or name or name_of(actor), worlds, drain_s)


def _drain_s(options: argparse.Namespace, entry: ActorConfig) -> float:
    for drain_s in (options.drain_s, entry.drain_s):
        if drain_s is not None:
            return float(drain_s)
    return DRAIN_S


def _begin_with(env: Mapping[str, str]) -> None:
    """Restart this process with these variables, unless it has them.

    Libraries read some when they are loaded, which they are by now.
    """
    if any(os.environ.get(name) != value for name, value in env.items()):
        command = [sys.executable, *sys.orig_argv[1:]]
        os.execve(command[0], command, {**os.environ, **env})  # noqa: S606 - itself


def cell_file(options: argparse.Namespace) -> Path | None:
    """Return the cell.toml that the command names; None where it names an endpoint, or nothing."""
    try:
        target = cell_target(options)
    except ConfigError:
        return None  # reported when the cell is opened
    return None if is_endpoint(target) else path_of(target)


def _listed(names: Iterable[str]) -> str:
    return ", ".join(names) or "none"


def _end_line(name: str, statistics: ActorStatistics) -> str:
    error = f"; last error: {statistics.last_error}" if statistics.last_error else ""
    return (
        f"{statistics.state}: actor {name} after {statistics.updates} updates,"
        f" {statistics.failures} failures, {statistics.refused} refusals{error}"
    )
