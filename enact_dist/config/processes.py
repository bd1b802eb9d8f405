"""`process` of the actors of a `cell.toml`: which of them share an operating system process.

Actors of one process have one machine and one environment, so what their tables say of these must
agree.  A variable of one actor's `env` is one of the whole process.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from enact_dist.terms import checked_name

if TYPE_CHECKING:
    from collections.abc import Mapping

    from enact_dist.config.table import Table
    from enact_dist.config.types import ActorProcess


def take_process(table: Table) -> str:
    """Return the process that an actor names; empty where it names none.

    Raises:
        ConfigError: It is no name.
    """
    if "process" not in table.values:
        return ""
    name = table.take_str("process")
    return table.checked("process", lambda: checked_name("process", name, slashes=False))


def refuse_misfits(process: ActorProcess, tables: Mapping[str, Table]) -> None:
    """Raise `ConfigError` unless the actors of a process can share it.

    Args:
        process: One process of the cell.
        tables: The table of each actor of the cell, by the actor's name.

    Raises:
        ConfigError: Two of them differ in their machine or in a variable, or the process is named
            like an actor that runs elsewhere.
    """
    first, *others = process.actors
    if first.process and process.name in tables and process.name not in process.members:
        tables[first.name].refuse(
            "process",
            f"process {process.name!r} of actor {first.name} has the name of an actor that runs in"
            f" another process; choose another name, or write process = {process.name!r} in"
            f" {tables[process.name].title}, too",
        )
    set_by = dict.fromkeys(first.env, first)
    for actor in others:
        table = tables[actor.name]
        if actor.host != first.host:
            table.refuse(
                "host",
                f"actors {first.name} and {actor.name} share the process {process.name!r}, so their"
                f" `host` must be the same: {first.host or 'none'!r}, {actor.host or 'none'!r}",
            )
        for name, text in actor.env.items():
            other = set_by.setdefault(name, actor)
            if other.env[name] != text:
                table.refuse(
                    "env",
                    f"actors {other.name} and {actor.name} share the process {process.name!r}, but"
                    f" env sets {name} to {other.env[name]!r} for one and {text!r} for the other;"
                    " set the same, or give them processes of their own",
                )
