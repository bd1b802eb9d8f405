"""`enact actor run|ls|check`."""

from __future__ import annotations

import logging
import os
import socket
import sys
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING, Final

from enact_dist.actor_drain import DRAIN_S, Drain
from enact_dist.actor_life import StopWithPulse
from enact_dist.actor_words import ListeningForWords
from enact_dist.cli import actor_tell
from enact_dist.cli.output import print_json, print_table, shown_s
from enact_dist.cli.verbs import (
    DONE,
    FAILED,
    add_cell,
    add_log,
    add_noun,
    add_reader,
    add_timeout,
    add_verb,
    cell_config,
    cell_target,
    duration,
    is_endpoint,
    one_entity,
    open_cell,
    pair,
    pairs,
    seconds,
    see_modules,
    verbs_of,
)
from enact_dist.errors import (
    ConfigError,
    EnactError,
    MisuseError,
    ProtocolError,
    UnknownWorldError,
)
from enact_dist.link.log import READY, JsonLines, TextLines, say
from enact_dist.link.service_manager import ServiceManager
from enact_dist.link.signals import StopSignals
from enact_dist.user_code import raised

if TYPE_CHECKING:
    import argparse
    from collections.abc import Callable, Iterator, Mapping

    from enact_dist.actor import Actor
    from enact_dist.actor_report import ActorStatistics
    from enact_dist.actor_runner import ActorRun
    from enact_dist.cell import Cell
    from enact_dist.cell_info import ActorInfo
    from enact_dist.cli.verbs import Verb

ANEW: Final = 75
"""Exit status of an actor that ends in order to restart: its supervisor starts it again."""

_log = logging.getLogger("enact.actor")


def add_to(nouns: argparse._SubParsersAction[Verb]) -> None:
    """Add the noun and its verbs."""
    verbs = verbs_of(add_noun(nouns, "actor", "run, list and check actors"))
    _add_run(verbs)
    actor_tell.add_to(verbs)
    ls = add_verb(
        verbs,
        "ls",
        "list the sessions of the cell with what their actors report, and which are silent",
        run=list_actors,
        example="enact actor ls --json",
    )
    add_reader(ls)
    check = add_verb(
        verbs,
        "check",
        "check all declared reads and writes of the cell's actors, without running any",
        run=check_actors,
        example="enact actor check --cell cell.toml",
    )
    add_cell(check, file_only=True)
    check.add_argument("--json", action="store_true", help="print JSON instead of lines")
    check.add_argument(
        "--initial",
        action="append",
        default=[],
        metavar="ASPECT",
        help="an aspect that is written from outside; may be repeated",
    )


def _add_run(verbs: argparse._SubParsersAction[Verb]) -> None:
    run = add_verb(
        verbs,
        "run",
        "run one actor in this process until SIGTERM or until it is done",
        run=run_actor,
        example="enact actor run fusion\n"
        "enact actor run actors.palletizing.fusion:Fusion --world training=training"
        " --option voxel_m=0.002",
    )
    run.add_argument(
        "target", metavar="TARGET", help="MODULE:CLASS, or the name of an actor of cell.toml"
    )
    add_cell(run)
    add_timeout(run)
    add_log(run)
    run.add_argument("--name", default="", help="how others see it (default: class and entity)")
    run.add_argument(
        "--world",
        action="append",
        type=pair,
        metavar="ROLE=NAME",
        help="bind a role to a world context; without any, each role to that of its name",
    )
    run.add_argument(
        "--option", action="append", type=pair, metavar="KEY=VALUE", help="argument of the class"
    )
    run.add_argument(
        "--entity",
        type=one_entity,
        metavar="NAME",
        help="the one entity that it works on, of those that its patterns match",
    )
    run.add_argument("--every", type=seconds, metavar="S", help="period of a source, seconds")
    run.add_argument(
        "--drain",
        dest="drain_s",
        type=duration,
        metavar="S",
        help="seconds that an update may take after SIGTERM before it is cut off (default:"
        " `drain_s` of the actor in cell.toml, else 8)",
    )


def run_actor(arguments: argparse.Namespace) -> int:
    """Run one actor until it is done or a signal comes."""
    manager = ServiceManager()
    json_lines = JsonLines(process=f"actor {arguments.name or arguments.target}")
    formatter = json_lines if arguments.log == "json" else TextLines()
    _log_to_stderr(formatter)
    actor, name, worlds, drain_s = _made(arguments)  # a signal ends an import at once
    with StopSignals() as signals:
        stop = StopWithPulse(manager.alive)
        with open_cell(arguments, observer=False, actor=name) as cell:
            json_lines.cell, json_lines.process = cell.name, f"actor {name}"
            run = _bound(actor, cell, worlds, stop, name)
            drain = Drain(name, run.doing, drain_s)
            for act in (lambda _: manager.stopping(), lambda _: stop.set(), drain.begin):
                signals.call(act)
            signals.call_again(drain.hurry)

            restarts = threading.Event()

            def restart() -> None:
                restarts.set()
                stop.set()
                drain.begin("the word to begin anew")

            def ready() -> None:
                run.answer()
                say(formatter, "actor.ready", f"{READY} actor {name} in cell {cell.name}")
                manager.ready()
                _warn_of_namesakes(cell, name)

            with ListeningForWords(actor, run, cell, restart):
                statistics = _run(run, ready)
        drain.over()
    counted = {key: getattr(statistics, key) for key in ("state", "updates", "failures", "refused")}
    say(formatter, "actor.end", _farewell(name, statistics), **counted)
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


def _bound(
    actor: Actor, cell: Cell, worlds: dict[str, str] | None, stop: StopWithPulse, name: str
) -> ActorRun:
    """Return the run of an actor whose roles are bound.

    Raises:
        ConfigError: They cannot be bound like this: the same command would fail the same way.
        UnknownWorldError: The cell has no such world context; it may be made yet.
    """
    from enact_dist.actor_runner import ActorRun

    try:
        return ActorRun(actor, cell, worlds, stop=stop, name=name)
    except UnknownWorldError:
        raise
    except MisuseError as error:
        raise ConfigError(str(error)) from error


def _warn_of_namesakes(cell: Cell, name: str) -> None:
    """Say which other actors of this name run; several may be meant, so none is refused."""
    try:
        others = cell.namesakes(name)
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
    """Let the log of the actor and of what it uses go to standard error."""
    handler = logging.StreamHandler()
    handler.setFormatter(formatter)
    logging.basicConfig(level=logging.INFO, handlers=[handler])


def _made(arguments: argparse.Namespace) -> tuple[Actor, str, dict[str, str] | None, float]:
    """Return the actor that the command names, its name, its roles' world contexts, its drain."""
    from enact_dist.actor import name_of
    from enact_dist.actor_load import check_every_s, configured_actor, load_actor

    worlds = pairs(arguments.world, "--world") or None
    options = pairs(arguments.option, "--option")
    drain_s = arguments.drain_s
    if ":" in arguments.target:
        see_modules(_cell_file(arguments))
        actor = load_actor(arguments.target, options)
        name = ""
    else:
        config = cell_config(arguments)
        see_modules(config.path)
        for entry in config.actors:
            if entry.name == arguments.target:
                break
        else:
            known = ", ".join(entry.name for entry in config.actors) or "none"
            raise ConfigError(
                f"{config.path} has no actor {arguments.target!r} (known: {known}); or write"
                " MODULE:CLASS"
            )
        if options:
            raise ConfigError(f"the options of {entry.name} stand in {config.path}; leave --option")
        _begin_with(entry.env)
        actor = configured_actor(entry)
        name = entry.name
        drain_s = entry.drain_s if drain_s is None else drain_s
        worlds = worlds or dict(entry.worlds) or None
    if arguments.every is not None:
        check_every_s(type(actor), arguments.every)
        actor.every_s = arguments.every
    if arguments.entity is not None:
        actor.only_entity = arguments.entity
    try:
        actor.declaration.check_entity(actor.only_entity)
    except MisuseError as error:
        raise ConfigError(str(error)) from None
    name = arguments.name or name or name_of(actor)
    return actor, name, worlds, DRAIN_S if drain_s is None else drain_s


def _begin_with(env: Mapping[str, str]) -> None:
    """Begin this process anew with these variables, unless it has them.

    Libraries read some when they are loaded, which they are by now.
    """
    if any(os.environ.get(name) != value for name, value in env.items()):
        command = [sys.executable, *sys.orig_argv[1:]]
        os.execve(command[0], command, {**os.environ, **env})  # noqa: S606 - itself


def _cell_file(arguments: argparse.Namespace) -> Path | None:
    """Return the cell.toml that the command names; None where it names an endpoint, or nothing."""
    try:
        target = cell_target(arguments)
    except ConfigError:
        return None  # said when the cell is opened
    return None if is_endpoint(target) else Path(target).expanduser()


def _farewell(name: str, statistics: ActorStatistics) -> str:
    error = f"; last error: {statistics.last_error}" if statistics.last_error else ""
    return (
        f"{statistics.state}: actor {name} after {statistics.updates} updates,"
        f" {statistics.failures} failures, {statistics.refused} refusals{error}"
    )


# ---------------------------------------------------------------- ls, check


def list_actors(arguments: argparse.Namespace) -> int:
    """Print every session but this one; one line per reporting actor."""
    with open_cell(arguments) as cell:
        infos = [info for info in cell.actors() if info.session != cell.session]
    if arguments.json:
        print_json(infos)
        return DONE
    print_table(
        ("actor", "host", "pid", "state", "updates", "rate", "failures", "refused", "incomplete",
         "wait p99", "last update", "lease left", "locks", "last error"),
        [row for info in infos for row in _rows(info)],
        empty="no actor is connected",
    )  # fmt: skip
    for report in (report for info in infos for report in _reports(info)):
        if report.args:
            print(f"{report.name}: {', '.join(report.args)}")
        for line in _losses(report):
            print(f"{report.name}: {line}")
    return DONE


def _losses(report: ActorStatistics) -> Iterator[str]:
    """Yield the losses of an actor that the table does not show."""
    last = f", the newest a {report.last_incomplete}" if report.last_incomplete else ""
    never = f", the newest {report.last_interrupted}: how far they came is unknown"
    remedy = ": this actor waits for data with equal stamps; set them with lock.put(…, stamp_ns=…)"
    lost = (
        (report.incomplete, f"incomplete sets{last}"),
        (report.late, "data too late for their set"),
        (report.partial, f"sets ran without some data, the newest a {report.last_partial}"),
        (report.unstamped, f"data without a capture stamp, from {report.unstamped_from}{remedy}"),
        (report.missed, "ticks missed"),
        (
            report.interrupted,
            f"versions taken, never ended{never}; write them again to run them",
        ),
        (report.unknown, "commits without an answer, which may stand (see its log)"),
    )
    yield from (f"{count} {what}" for count, what in lost if count)


def _reports(info: ActorInfo) -> tuple[ActorStatistics, ...]:
    from enact_dist.actor_report import read_reports

    try:
        return read_reports(info.report)
    except ProtocolError:
        return ()  # a session that reports something of its own


def _rows(info: ActorInfo) -> Iterator[tuple[object, ...]]:
    here = (info.host, info.pid)
    left_s = info.lease_left_s
    left = (f"over for {shown_s(-left_s)}" if info.silent else shown_s(left_s), info.locks)
    reports = _reports(info)
    for report in reports:
        ago_s = time.time() - report.last_update_unix_s
        last = f"{shown_s(max(0.0, ago_s))} ago" if report.last_update_unix_s else "never"
        yield (
            report.name, *here, _state(info, _doing(report)), report.updates,
            "-" if info.silent else f"{report.rate_hz:.1f}/s",
            report.failures, report.refused, report.incomplete,
            f"{report.lock_wait_p99_ms:.1f} ms", last, *left, report.last_error or "-",
        )  # fmt: skip
    if not reports:
        yield (info.actor, *here, _state(info, "connected"), *["-"] * 7, *left, "-")


def _doing(report: ActorStatistics) -> str:
    """Return an actor's state; if its update does not return, with the time it has taken."""
    if report.state != "stuck":
        return report.state
    return f"stuck for {shown_s(report.updating_s)} in update (lock lost)"


def _state(info: ActorInfo, reported: str) -> str:
    """Return how an actor is: of one that is silent nobody knows whether it still runs."""
    state = "silent" if info.silent else reported
    return f"{state}, one of {len(info.namesakes) + 1}" if info.namesakes else state


def check_actors(arguments: argparse.Namespace) -> int:
    """Print what is wrong with the actors of a `cell.toml`; status 1 if there is an error."""
    from enact_dist.actor_check import check_cell

    config = cell_config(arguments)
    see_modules(config.path)
    findings = check_cell(config, initial=arguments.initial)
    wrong = any(finding.level == "error" for finding in findings)
    if arguments.json:
        print_json(findings)
    else:
        for finding in findings:
            print(finding)
        if all(finding.level == "advice" for finding in findings):
            print(f"ok: {len(config.actors)} actors of cell {config.name} fit together")
    return FAILED if wrong else DONE
