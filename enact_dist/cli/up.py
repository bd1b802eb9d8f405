"""`enact up`: the shards and actors of a cell on this machine, as supervised child processes."""

from __future__ import annotations

import socket
import sys
from typing import TYPE_CHECKING

from enact_dist.cli.output import coloured
from enact_dist.cli.verbs import add_verb, cell_config, see_working_folder
from enact_dist.errors import ConfigError
from enact_dist.link.signals import StopSignals

if TYPE_CHECKING:
    import argparse

    from enact_dist.cli.verbs import Verb
    from enact_dist.config_types import ActorConfig, CellConfig, ShardConfig
    from enact_dist.supervise import Task


def add_to(nouns: argparse._SubParsersAction[Verb]) -> None:
    """Add the verb, which has no noun."""
    up = add_verb(
        nouns,
        "up",
        "run every shard and actor of a cell on this machine until Ctrl-C",
        run=run_up,
        example="enact up cell.toml\nenact up cell.toml --no-actors",
    )
    up.add_argument("cell", metavar="CELL", nargs="?", help="the cell.toml (default: ./cell.toml)")
    up.add_argument("--host", metavar="NAME", help="act as this machine (default: its host name)")
    up.add_argument("--no-actors", action="store_true", help="run the shards only")


def run_up(arguments: argparse.Namespace) -> int:
    """Run the cell until a signal; drain actors, then shards."""
    from enact_dist.supervise import Supervisor

    see_working_folder()
    config = cell_config(arguments)
    host = arguments.host or socket.gethostname()
    shards = [shard for shard in config.shards if shard.host in {"", host}]
    actors = [actor for actor in config.actors if actor.host in {"", host}]
    actors = [] if arguments.no_actors else actors
    if not shards and not actors:
        raise ConfigError(f"no shard and no actor of {config.path} runs on host {host!r}")
    if actors:
        _refuse_misfits(config)
    tasks = [*_shard_tasks(config, shards), *_actor_tasks(config, actors)]
    say = _Log([task.name for task in tasks])
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


def _shard_tasks(config: CellConfig, shards: list[ShardConfig]) -> list[Task]:
    return [_task(config, "shard", shard.name) for shard in shards]


def _actor_tasks(config: CellConfig, actors: list[ActorConfig]) -> list[Task]:
    return [_task(config, "actor", actor.name) for actor in actors]


def _task(config: CellConfig, kind: str, name: str) -> Task:
    from enact_dist.supervise import Task

    command = (sys.executable, "-m", "enact_dist.cli.main", kind, "run", name)
    return Task(name, kind, (*command, "--cell", str(config.path)))


class _Log:
    """Prints lines with the name of their process in front, each in its colour."""

    def __init__(self, names: list[str]) -> None:
        self._width = max(map(len, ["enact", *names]))
        self._order = {name: index for index, name in enumerate(names)}

    def __call__(self, name: str, line: str) -> None:
        prefix = f"{name or 'enact':<{self._width}} |"
        print(coloured(prefix, self._order.get(name, -1)), line, flush=True)
