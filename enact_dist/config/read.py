"""Reads `cell.toml`: which shards, world contexts, aspects and actors a cell has.

Example::

    name = "palletizing"
    worlds = ["training", "online"]
    session_ttl_s = 2.0
    data_folder = "data"

    [shards.left]
    listen = "tcp/127.0.0.1:7447"

    [shards.right]
    listen = "tcp/0.0.0.0:7448"
    advertise = "tcp/tray-pc:7448"
    host = "tray-pc"

    [[pins]]
    entities = "tray/**"
    shard = "right"

    [aspects.depth]
    durability = "volatile"

    [actors.fusion]
    class = "actors.palletizing.fusion:Fusion"
    worlds = { training = "training", online = "online" }
    args = { voxel_m = 0.002 }

`enact_dist/docs/cell.md` explains every key; the dataclasses of `enact_dist.config.types` are what
the file is read by, and this module adds what concerns several keys.

A cell.toml is a program: the modules that it names run as the user who starts it.  Python looks for
them beside the file first and in the working folder last.  Relative folders are relative to the
file.  An unknown key, a wrong type or an unknown name is a `ConfigError` with file, line and, if
there is a similar name, a suggestion.  Environment variables override the file: see
`enact_dist.config.environment`.
"""

from __future__ import annotations

import os
import re
import tomllib
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Final

from enact_dist.config.environment import with_environment
from enact_dist.config.lines import LineLocator
from enact_dist.config.rights_check import check_clients, check_rights, refuse_unproven_names
from enact_dist.config.table import ConfigSource, Table, path_of, suggestion
from enact_dist.config.types import (
    ActorProcess,
    CellConfig,
    ShardConfig,
    is_locked,
    is_wildcard,
)
from enact_dist.errors import ConfigError

_VARIABLE: Final = re.compile(r"[A-Za-z_][A-Za-z0-9_]*\Z")


def load_config(
    path: str | os.PathLike[str], *, environment: Mapping[str, str] | None = None
) -> CellConfig:
    """Read a `cell.toml`.

    Args:
        path: The file.
        environment: Overrides of the file; those of this process unless given.

    Raises:
        ConfigError: The file is missing, is no TOML, or says something that cannot be used.
    """
    file = path_of(os.fspath(path)).absolute()
    try:
        text = file.read_text(encoding="utf-8-sig")  # some editors write a byte-order mark
    except OSError as error:
        raise ConfigError(f"cannot read {path}: {error.strerror}", path=str(path)) from error
    except UnicodeDecodeError as error:
        raise ConfigError(
            f"{path} is not UTF-8 ({error}); save it as UTF-8", path=str(path)
        ) from error
    return parse_config(text, file, environment=environment, shown=str(path))


def parse_config(
    text: str,
    file: Path,
    *,
    environment: Mapping[str, str] | None = None,
    shown: str = "",
) -> CellConfig:
    """Read the text of a `cell.toml` as if it stood in `file`.

    Args:
        text: TOML.
        file: Where it stands; its folder is the base of relative folders.
        environment: Overrides of the file; those of this process unless given.
        shown: How messages name the file; `file` unless given.

    Raises:
        ConfigError: The text is no TOML, or says something that cannot be used.
    """
    shown = shown or str(file)
    try:
        values = tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # also a number of thousands of digits
        found = re.search(r"at line (\d+)", str(error))
        line = int(found[1]) if found else max(1, len(text.splitlines()))
        raise ConfigError(f"{shown}, line {line}: {error}", path=shown, line=line) from error
    root = Table(values, (), ConfigSource(shown, LineLocator(text), file.parent))
    config = _cell(root, file)
    config = with_environment(config, os.environ if environment is None else environment)
    _check_doors(root, config)
    _check_store(root, config)
    check_clients(root, config)
    refuse_unproven_names(root, config)
    return config


def _cell(root: Table, file: Path) -> CellConfig:
    config = root.record(CellConfig, path=file)
    shards = _shards(root, config)
    known = [shard.name for shard in shards]
    for table, pin in zip(root.tables("pins"), config.pins, strict=True):
        if pin.shard not in known:
            table.refuse(
                "shard",
                f"pin of {pin.pattern!r} to unknown shard {pin.shard!r}"
                f"{suggestion(pin.shard, known)} (known: {', '.join(known)})",
            )
    for index, world in enumerate(config.worlds):
        if world in config.worlds[:index]:
            problem = f"the world context {world!r} is listed twice"
            root.source.refuse(("worlds", index), problem)
    _check_actors(root, config)
    check_rights(root, config)
    return replace(config, shards=shards)


def _shards(root: Table, config: CellConfig) -> tuple[ShardConfig, ...]:
    """Return the shards with the values that follow from others, checked against each other."""
    shards: list[ShardConfig] = []
    for shard in config.shards:
        table = root.table("shards").table(shard.name)
        advertise = shard.advertise or shard.listen
        folder = shard.folder or (config.data_folder and config.data_folder / shard.name)
        key = "advertise" if shard.advertise else "listen"
        for endpoint in filter(is_wildcard, advertise):
            table.refuse(
                key,
                f"no client can connect to {endpoint}; write in {table.title} an advertise endpoint"
                " that names the host",
            )
        for other in shards:
            both = f"shards {other.name} and {shard.name} share"
            if folder is not None and folder == other.folder:
                table.refuse("folder", f"{both} folder {folder}")
            if shared := {*advertise} & {*other.advertise}:
                table.refuse(key, f"{both} endpoint {min(shared)}")
        shards.append(replace(shard, advertise=advertise, folder=folder))
    if not shards:
        root.refuse("shards", "the cell has no shard; write a table [shards.NAME] with listen")
    return tuple(shards)


def _check_doors(root: Table, config: CellConfig) -> None:
    """Refuse an open endpoint in a cell with keys, and a locked one in a cell without.

    Raises:
        ConfigError: A shard has such an endpoint, from the file or from a variable.
    """
    has_keys = config.security.keys is not None
    for shard in config.shards:
        table = root.table("shards").table(shard.name)
        for key, endpoints in (("listen", shard.listen), ("advertise", shard.advertise)):
            for endpoint in endpoints:
                if is_locked(endpoint) == has_keys:
                    continue
                locked = "tls/" + endpoint.partition("/")[2]
                problem = (
                    f"{endpoint} of shard {shard.name} is a door without a lock: the cell has keys,"
                    f" and any program can connect there without one; write {locked}"
                    if has_keys
                    else f"{endpoint} of shard {shard.name} needs keys: write [security] with"
                    ' keys = "keys", or set ENACT_KEYS (docs/security.md explains how to make them)'
                )
                table.refuse(key if key in table.values else "listen", problem)


def _check_store(root: Table, config: CellConfig) -> None:
    """Refuse folders beside a database: a shard has its data in one of them.

    Raises:
        ConfigError: Both are given, in the file or by variables.
    """
    if not config.store:
        return
    tables = [("data_folder", root, config.data_folder)]
    tables += [
        ("folder", root.table("shards").table(one.name), one.folder) for one in config.shards
    ]
    for key, table, folder in tables:
        if folder is not None:
            table.refuse(
                key,
                f"{key} = {str(folder)!r} and a store in a database exclude each other (`store`,"
                " ENACT_STORE or --store): remove one of them",
            )


def _check_actors(root: Table, config: CellConfig) -> None:
    """Check the actors against the world contexts of the cell and against each other."""
    tables = {actor.name: root.table("actors").table(actor.name) for actor in config.actors}
    for actor in config.actors:
        for role, world in actor.worlds.items():
            if world not in config.worlds:
                tables[actor.name].table("worlds").refuse(
                    role,
                    f"role {role!r} is bound to unknown world context {world!r}"
                    f"{suggestion(world, config.worlds)}"
                    f" (known: {', '.join(config.worlds) or 'none'})",
                )
        for name in actor.env:
            if not _VARIABLE.match(name):
                problem = f"{name!r} is no name of a variable of the environment"
                tables[actor.name].table("env").refuse(name, problem)
    for process in config.processes():
        _refuse_misfits(process, tables)


def _refuse_misfits(process: ActorProcess, tables: Mapping[str, Table]) -> None:
    """Raise `ConfigError` unless the actors of a process can share it.

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
