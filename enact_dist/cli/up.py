"""`enact up`: the shards and actors of a cell on this machine, as supervised child processes."""

from __future__ import annotations

import json
import socket
import sys
import time
from typing import TYPE_CHECKING, Final

from enact_dist.cli.output import coloured
from enact_dist.cli.verbs import (
    CELL_DEFAULT,
    CELL_VARIABLE,
    add_log,
    add_verb,
    cell_config,
    see_modules,
)
from enact_dist.errors import ConfigError, LinkError
from enact_dist.link.signals import StopSignals

if TYPE_CHECKING:
    import argparse

    from enact_dist.cli.verbs import Verb
    from enact_dist.config_types import CellConfig, ShardConfig
    from enact_dist.supervise import Say, Task

LOOK_S: Final = 0.2
"""How often a shard that runs already is looked at."""
ANSWER_S: Final = 2.0
"""How long who listens where a shard should may take to say what it is."""


def add_to(nouns: argparse._SubParsersAction[Verb]) -> None:
    """Add the verb, which has no noun."""
    up = add_verb(
        nouns,
        "up",
        "run every shard and actor of a cell on this machine until Ctrl-C",
        run=run_up,
        example="enact up cell.toml\nenact up cell.toml --no-actors",
    )
    up.add_argument(
        "cell",
        metavar="CELL",
        nargs="?",
        help=f"the cell.toml (default: ${CELL_VARIABLE}, else ./{CELL_DEFAULT})",
    )
    up.add_argument("--host", metavar="NAME", help="act as this machine (default: its host name)")
    up.add_argument("--no-actors", action="store_true", help="run the shards only")
    add_log(up)


def run_up(arguments: argparse.Namespace) -> int:
    """Run the cell until a signal; drain actors, then shards."""
    from enact_dist.supervise import Supervisor

    config = cell_config(arguments)
    see_modules(config.path)
    host = arguments.host or socket.gethostname()
    shards = [shard for shard in config.shards if shard.host in {"", host}]
    actors = [actor for actor in config.actors if actor.host in {"", host}]
    actors = [] if arguments.no_actors else actors
    if not shards and not actors:
        raise ConfigError(f"no shard and no actor of {config.path} runs on host {host!r}")
    if actors:
        _refuse_misfits(config)
    for shard in shards:
        _refuse_second(config, shard)
    tasks = [
        *(_task(config, "shard", shard.name, arguments.log, shard.drain_s) for shard in shards),
        *(_task(config, "actor", actor.name, arguments.log, actor.drain_s) for actor in actors),
    ]
    say: Say = _Log([task.name for task in tasks])
    if arguments.log == "json":
        say = _JsonLog(config.name, {task.name: f"{task.kind} {task.name}" for task in tasks})
    say("", f"up: cell {config.name} on {host}, {len(shards)} shards, {len(actors)} actors")
    with StopSignals() as stop:
        status = Supervisor(tasks, say).run(stop.event, count=lambda: stop.count)
    say("", "down")
    return status


def _refuse_misfits(config: CellConfig) -> None:
    """Print what is wrong with the actors; raise if something is an error.

    Raises:
        ConfigError: The actors cannot run together.
    """
    from enact_dist.actor_check import check_cell

    findings = check_cell(config)
    for finding in findings:
        if finding.level == "warning" and finding.kind != "unwritten read":
            print(f"enact: {finding}", file=sys.stderr)
    wrong = [str(finding.text) for finding in findings if finding.level == "error"]
    if wrong:
        raise ConfigError(
            f"{config.path}: {'; '.join(wrong)} (enact actor check shows all)",
            path=str(config.path),
        )


def _refuse_second(config: CellConfig, shard: ShardConfig) -> None:
    """Raise if a shard runs already, and does not end in the time that an ending one has.

    One that a supervisor has left behind ends by itself; one of another `enact up` does not.

    Raises:
        LinkError: It does; the message says where.
    """
    from enact_dist.link.endpoints import somebody_listens

    if not any(somebody_listens(endpoint) for endpoint in shard.listen):
        return
    from enact_dist.link.shard_daemon import DRAIN_S, DaemonSettings, refuse_second_daemon
    from enact_dist.supervise import END_S

    settings = DaemonSettings(config.name, config.shard_settings(shard.name), shard.listen)
    drain_s = DRAIN_S if shard.drain_s is None else shard.drain_s
    wait_s = drain_s + END_S["shard"]
    end_s = time.monotonic() + wait_s
    told = False
    while True:
        try:
            refuse_second_daemon(settings, probe_s=ANSWER_S)
        except LinkError:
            if time.monotonic() > end_s:
                raise
            if not told:
                text = f"shard {shard.name} runs already; waiting up to {wait_s:g} s for its end"
                print(f"enact: {text}", file=sys.stderr, flush=True)
            told = True
            time.sleep(LOOK_S)
        else:
            return


def _task(config: CellConfig, kind: str, name: str, log: str, drain_s: float | None = None) -> Task:
    from enact_dist.supervise import Task

    command = (sys.executable, "-m", "enact_dist.cli.main", kind, "run", name)
    words = ("--cell", str(config.path), "--log", log)
    return Task(name, kind, (*command, *words), drain_s or 0.0)


class _Log:
    """Prints lines with the name of their process in front, each in its colour."""

    def __init__(self, names: list[str]) -> None:
        self._width = max(map(len, ["enact", *names]))
        self._order = {name: index for index, name in enumerate(names)}

    def __call__(self, name: str, line: str) -> None:
        prefix = f"{name or 'enact':<{self._width}} |"
        print(coloured(prefix, self._order.get(name, -1)), line, flush=True)


class _JsonLog:
    """Prints JSON objects as they come, and makes one of each other line; see `link.log`."""

    def __init__(self, cell: str, processes: dict[str, str]) -> None:
        self._cell, self._processes = cell, processes

    def __call__(self, name: str, line: str) -> None:
        if not _is_object(line):
            of_ours = {"time": round(time.time(), 6), "level": "INFO", "logger": "enact.up"}
            where = {"cell": self._cell, "process": self._processes.get(name, "up")}
            line = json.dumps({**of_ours, "event": "", "text": line, **where}, ensure_ascii=False)
        print(line, flush=True)


def _is_object(line: str) -> bool:
    try:
        return isinstance(json.loads(line), dict)
    except ValueError:
        return False
