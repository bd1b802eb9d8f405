"""`enact up`: the shards and actors of a cell on this machine, as supervised child processes."""

from __future__ import annotations

import json
import socket
import sys
import time
from typing import TYPE_CHECKING, Final

from enact_dist.cli.arguments import LOG
from enact_dist.cli.target import CELL_DEFAULT, CELL_VARIABLE, cell_config, see_modules
from enact_dist.cli.text.output import coloured
from enact_dist.cli.verbs import NOUNS, Verb, flag, option
from enact_dist.config.table import suggestion
from enact_dist.config.types import CellConfig, ShardConfig, processes_of
from enact_dist.errors import ConfigError, LinkError
from enact_dist.link.signals import StopSignals

if TYPE_CHECKING:
    import argparse
    from collections.abc import Sequence

    from enact_dist.operate.supervise import Say

LOOK_S: Final = 0.2
"""How often a shard that runs already is looked at."""
ANSWER_S: Final = 2.0
"""How long who listens where a shard should may take to say what it is."""


VERBS: Final = (
    Verb(
        "up", NOUNS["up"].summary, "run_up",
        "enact up cell.toml\nenact up cell.toml --no-actors\n"
        "enact up cell.toml --without camera planner",
        (
            option("cell", "CELL", f"the cell.toml (default: ${CELL_VARIABLE}, else"
                   f" ./{CELL_DEFAULT})", nargs="?"),
            option("--host", "NAME", "act as this machine (default: its host name)"),
            flag("--no-actors", "run the shards only"),
            option("--only", "NAME", "run these shards, actors and processes of this machine",
                   nargs="+", default=[]),
            option("--without", "NAME",
                   "run all but these shards, actors and processes of this machine",
                   nargs="+", default=[]),
            LOG,
        ),
    ),
)  # fmt: skip


def run_up(options: argparse.Namespace) -> int:
    """Run the cell until a signal; drain actors, then shards."""
    from enact_dist.operate.supervise import Supervisor, Task

    log: str = options.log
    config = cell_config(options)
    see_modules(config.path)
    host = options.host or socket.gethostname()
    chosen = _chosen(config, options)
    shards = [one for one in config.shards if one.host in {"", host} and one.name in chosen]
    actors = [one for one in config.actors if one.host in {"", host} and one.name in chosen]
    actors = [] if options.no_actors else actors
    if not shards and not actors:
        raise ConfigError(f"no shard and no actor of {config.path} runs on host {host!r}")
    _refuse_homeless(config, shards, host)
    if actors:
        _refuse_misfits(config)
    for shard in shards:
        _refuse_second(config, shard)
    tasks = [
        *(
            Task(one.name, "shard", _command(config, "shard", (one.name,), log), one.drain_s or 0.0)
            for one in shards
        ),
        *(
            Task(
                one.name, "actor", _command(config, "actor", one.members, log),
                one.drain_s or 0.0, one.env,
            )
            for one in processes_of(actors)
        ),
    ]  # fmt: skip
    say: Say = _Log([task.name for task in tasks])
    if log == "json":
        shared = {process.name for process in config.processes() if len(process.actors) > 1}
        kinds = {task.name: "process" if task.name in shared else task.kind for task in tasks}
        say = _JsonLog(config.name, {name: f"{kind} {name}" for name, kind in kinds.items()})
    count = len(tasks) - len(shards)
    there = f" in {count} processes" if count < len(actors) else ""
    say("", f"up: cell {config.name} on {host}, {len(shards)} shards, {len(actors)} actors{there}")
    with StopSignals() as stop:
        status = Supervisor(tasks, say).run(stop.event, count=lambda: stop.count)
    say("", "down")
    return status


def _chosen(config: CellConfig, options: argparse.Namespace) -> set[str]:
    """Return the names of the shards and actors that are to run, wherever they belong.

    The name of a process stands for all its actors, unless one of them has it, too.

    Raises:
        ConfigError: The cell has none of a name that was given.
    """
    known = {one.name for one in config.shards} | {one.name for one in config.actors}
    meant = {process.name: set(process.members) for process in config.processes()}
    meant |= {name: {name} for name in known}
    for name in (*options.only, *options.without):
        if name not in meant:
            raise ConfigError(
                f"{config.path} has no shard and no actor {name!r}{suggestion(name, meant)} (it has"
                f" {', '.join(sorted(meant))})"
            )
    only, without = (
        {each for name in names for each in meant[name]}
        for names in (options.only, options.without)
    )
    chosen = (only or known) - without
    if not chosen:
        said = f"--only {' '.join(options.only)} " if options.only else ""
        raise ConfigError(
            f"{said}--without {' '.join(options.without)} leaves nothing of {config.path} to run;"
            " name fewer after --without"
        )
    return chosen


def _refuse_homeless(config: CellConfig, shards: Sequence[ShardConfig], host: str) -> None:
    """Refuse to start shards that say nowhere where they run, in a cell of several machines.

    Raises:
        ConfigError: Each machine would start them; the message says what to write.
    """
    from enact_dist.link.zenoh.endpoints import is_of_this_host

    if config.store:
        return  # each machine may start it: one serves, the others stand by
    hosts = {one.host for one in config.shards} | {one.host for one in config.actors}
    named = sorted(hosts - {""})
    for shard in shards:
        if shard.host:
            continue
        where = f"[shards.{shard.name}] of {config.path}"
        if named:
            raise ConfigError(
                f"{where} names no host, but the cell has several machines ({', '.join(named)}):"
                f' `enact up` would start the shard on each; if it runs here, write host = "{host}"'
            )
        strange = [endpoint for endpoint in shard.listen if not is_of_this_host(endpoint)]
        if strange:
            raise ConfigError(
                f"shard {shard.name} listens at {strange[0]}, which is not an address of this"
                f" machine; set `host` in {where} to the machine that runs the shard"
            )


def _refuse_misfits(config: CellConfig) -> None:
    """Print what is wrong with the actors; raise if something is an error.

    Raises:
        ConfigError: The actors cannot run together.
    """
    from enact_dist.actor.check import check_cell

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

    A process that a supervisor left behind ends by itself; one of another `enact up` does not.

    Raises:
        LinkError: It does; the message says where.
    """
    from enact_dist.link.zenoh.endpoints import somebody_listens

    if config.store:
        return  # the database lets one of them serve
    elsewhere = [endpoint for endpoint in shard.advertise if endpoint not in shard.listen]
    if not any(somebody_listens(endpoint) for endpoint in (*shard.listen, *elsewhere)):
        return
    from enact_dist.link.daemon.second_daemon import refuse_second_daemon
    from enact_dist.link.daemon.settings import DRAIN_S, DaemonSettings
    from enact_dist.link.zenoh.tls import shard_keys
    from enact_dist.operate.supervise import END_S

    settings = DaemonSettings(
        config.name,
        config.shard_settings(shard.name),
        shard.listen,
        keys=shard_keys(config.security, shard.name),
    )
    drain_s = DRAIN_S if shard.drain_s is None else shard.drain_s
    wait_s = drain_s + END_S["shard"]
    end_s = time.monotonic() + wait_s
    told = False
    while True:
        try:
            refuse_second_daemon(settings, probe_s=ANSWER_S)
        except LinkError as error:
            if not shard.host and not any(somebody_listens(one) for one in shard.listen):
                raise LinkError(
                    f"{error}; if that is another machine, set it as `host` in"
                    f" [shards.{shard.name}] of {config.path}, so that `enact up` starts the shard"
                    " only there"
                ) from error
            if time.monotonic() > end_s:
                raise
            if not told:
                text = f"shard {shard.name} runs already; waiting up to {wait_s:g} s for its end"
                print(f"enact: {text}", file=sys.stderr, flush=True)
            told = True
            time.sleep(LOOK_S)
        else:
            return


def _command(config: CellConfig, kind: str, names: tuple[str, ...], log: str) -> tuple[str, ...]:
    command = (sys.executable, "-m", "enact_dist.cli.main", kind, "run", *names)
    # Another host may serve the shard, now or when this process is started again.
    more = ("--standby",) if config.store and kind == "shard" else ()
    return (*command, "--cell", str(config.path), "--log", log, *more)


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
