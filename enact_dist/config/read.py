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
    options = { voxel_m = 0.002 }

`enact_dist/docs/cell.md` explains every key.

A cell.toml is a program: the modules that it names run as the user who starts it.  They are looked
up beside the file first, the working folder comes last.  Relative folders are relative to the file.
An unknown key, a wrong type or a name that does not exist is a `ConfigError` with file, line and,
where one is close, a suggestion.  The environment
overrides the file: see `enact_dist.config.environment`.
"""

from __future__ import annotations

import os
import re
import tomllib
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Final

from enact_dist.config.environment import with_environment
from enact_dist.config.processes import refuse_misfits, take_process
from enact_dist.config.shows import SHOWS_KEYS, take_shows
from enact_dist.config.table import LineLocator, Source, Table, suggestion
from enact_dist.config.types import (
    CARRIER_DEFAULT,
    CARRIERS,
    DRAIN_S_MAX,
    TTL_S_DEFAULT,
    TTL_S_MAX,
    TTL_S_MIN,
    ActorConfig,
    AspectConfig,
    CellConfig,
    ShardConfig,
    checked_endpoint,
    is_wildcard,
    metrics_address,
    processes_of,
)
from enact_dist.core.protocol.messages import Pin
from enact_dist.errors import ConfigError
from enact_dist.retention import AGE_S_MAX, Retention, checked_retention
from enact_dist.terms import Durability, Entities, Entity, checked_name

if TYPE_CHECKING:
    from collections.abc import Mapping

__all__ = [
    "ActorConfig",
    "AspectConfig",
    "CellConfig",
    "ShardConfig",
    "load_config",
    "parse_config",
]

_VARIABLE: Final = re.compile(r"[A-Za-z_][A-Za-z0-9_]*\Z")
_EXAMPLE: Final = "tcp/127.0.0.1:7447"
_DOTTED_NAME: Final = re.compile(r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)*:[A-Za-z_]\w*\Z")


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
    file = Path(path).expanduser().absolute()
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
    except tomllib.TOMLDecodeError as error:
        found = re.search(r"at line (\d+)", str(error))
        line = int(found[1]) if found else max(1, len(text.splitlines()))
        raise ConfigError(f"{shown}, line {line}: {error}", path=shown, line=line) from error
    root = Table(values, (), Source(shown, LineLocator(text)))
    config = _cell(root, file)
    return with_environment(config, os.environ if environment is None else environment)


def _cell(root: Table, file: Path) -> CellConfig:
    root.refuse_unknown(
        "name", "worlds", "session_ttl_s", "data_folder", "carrier", "shared_bytes_max",
        "shards", "pins", "aspects", "actors",
    )  # fmt: skip
    name = root.take_str("name")
    root.checked("name", lambda: checked_name("cell", name, slashes=False))
    data_folder = _folder(root, "data_folder", file)
    shards = _shards(root, file, data_folder)
    worlds = _worlds(root)
    return CellConfig(
        path=file,
        name=name,
        ttl_s=root.take_float("session_ttl_s", TTL_S_DEFAULT, low=TTL_S_MIN, high=TTL_S_MAX),
        carrier=_carrier(root),
        shared_bytes_max=_shared_bytes_max(root),
        data_folder=data_folder,
        worlds=worlds,
        shards=shards,
        pins=tuple(_pin(table, shards) for table in root.take_tables("pins")),
        aspects=tuple(
            _aspect(name, table) for name, table in root.take_table("aspects").named_tables()
        ),
        actors=_actors(root, worlds),
    )


def _carrier(root: Table) -> str:
    carrier = root.take_str("carrier", CARRIER_DEFAULT)
    if carrier not in CARRIERS:
        root.refuse("carrier", f"unknown carrier {carrier!r} (known: {', '.join(CARRIERS)})")
    return carrier


def _shared_bytes_max(root: Table) -> int | None:
    found = root.values.get("shared_bytes_max")
    if found is not None and (type(found) is not int or found < 0):
        root.refuse("shared_bytes_max", f"'shared_bytes_max' is a number of bytes, not {found!r}")
    return found


def _worlds(root: Table) -> tuple[str, ...]:
    worlds = root.take_strings("worlds")
    for index, world in enumerate(worlds):
        where = ("worlds", index)
        try:
            checked_name("world context", world, slashes=False)
        except ValueError as error:
            root.source.refuse(where, str(error))
        if world in worlds[:index]:
            root.source.refuse(where, f"the world context {world!r} is listed twice")
    return worlds


def _folder(table: Table, key: str, file: Path) -> Path | None:
    if key not in table.values:
        return None
    return file.parent / Path(table.take_str(key)).expanduser()


def _shards(root: Table, file: Path, data_folder: Path | None) -> tuple[ShardConfig, ...]:
    tables = root.take_table("shards")
    shards: list[ShardConfig] = []
    for name, table in tables.named_tables():
        shard = _shard(name, table, file, data_folder)
        for other in shards:
            _refuse_shared(table, shard, other)
        shards.append(shard)
    if not shards:
        root.refuse("shards", "the cell has no shard; write a table [shards.NAME] with listen")
    return tuple(shards)


def _shard(name: str, table: Table, file: Path, data_folder: Path | None) -> ShardConfig:
    table.refuse_unknown("listen", "advertise", "folder", "host", "metrics", "drain_s")
    _check_title(name, "shard", table)
    listen = _endpoints(table, "listen")
    if not listen:
        table.refuse("listen", f"{table.title} needs the key 'listen', such as {_EXAMPLE}")
    advertise = _endpoints(table, "advertise") or listen
    for endpoint in advertise:
        if is_wildcard(endpoint):
            key = "advertise" if "advertise" in table.values else "listen"
            table.refuse(
                key,
                f"no client can connect to {endpoint}; write in {table.title} an advertise endpoint"
                " that names the host",
            )
    folder = _folder(table, "folder", file) or (data_folder and data_folder / name)
    drain_s = _drain_s(table)
    return ShardConfig(name, listen, advertise, folder, _host(table), _metrics(table), drain_s)


def _drain_s(table: Table) -> float | None:
    drain_s = table.take_float("drain_s", 0.0, low=0.0, high=DRAIN_S_MAX)
    return drain_s if "drain_s" in table.values else None


def _metrics(table: Table) -> tuple[str, int] | None:
    if "metrics" not in table.values:
        return None
    text = table.take_str("metrics")
    return table.checked("metrics", lambda: metrics_address(text))


def _host(table: Table) -> str:
    return table.take_str("host", "")


def _refuse_shared(table: Table, shard: ShardConfig, other: ShardConfig) -> None:
    if shard.folder is not None and shard.folder == other.folder:
        table.refuse("folder", f"shards {other.name} and {shard.name} share folder {shard.folder}")
    shared = set(shard.advertise) & set(other.advertise)
    if shared:
        table.refuse(
            "advertise" if "advertise" in table.values else "listen",
            f"shards {other.name} and {shard.name} share endpoint {min(shared)}",
        )


def _endpoints(table: Table, key: str) -> tuple[str, ...]:
    found = table.values.get(key)
    if "" in (found if isinstance(found, list) else (found,)):
        table.refuse(
            key, f"{key!r} in {table.title} is empty; write an endpoint, such as {_EXAMPLE}"
        )
    endpoints = table.take_strings(key)
    for endpoint in endpoints:
        table.checked(key, lambda endpoint=endpoint: checked_endpoint(endpoint))  # type: ignore[misc]
    return endpoints


def _pin(table: Table, shards: tuple[ShardConfig, ...]) -> Pin:
    table.refuse_unknown("entities", "shard")
    entities, shard = table.take_str("entities"), table.take_str("shard")
    table.checked("entities", lambda: Entities(entities))
    names = [known.name for known in shards]
    if shard not in names:
        table.refuse(
            "shard",
            f"pin of {entities!r} to unknown shard {shard!r}{suggestion(shard, names)}"
            f" (known: {', '.join(names)})",
        )
    return Pin(entities, shard)


def _aspect(name: str, table: Table) -> AspectConfig:
    table.refuse_unknown("durability", "retention", "compare", *SHOWS_KEYS)
    _check_title(name, "aspect", table)
    compare = table.take_str("compare", "")
    if "compare" in table.values and not _DOTTED_NAME.match(compare):
        table.refuse("compare", f"'compare' is written package.module:NAME, not {compare!r}")
    durability, retention = _durability(name, table), _retention(table)
    return AspectConfig(name, durability, retention, compare, take_shows(table))


def _durability(name: str, table: Table) -> Durability | None:
    if "durability" not in table.values:
        return None
    found = table.take_str("durability")
    known = [durability.value for durability in Durability]
    if found not in known:
        table.refuse(
            "durability",
            f"unknown durability {found!r} of aspect {name!r}{suggestion(found, known)}"
            f" (known: {', '.join(known)})",
        )
    return Durability(found)


def _retention(table: Table) -> Retention | None:
    found = table.values.get("retention")
    if not isinstance(found, dict):
        return table.checked("retention", lambda: checked_retention(found))
    parts = table.take_table("retention")
    parts.refuse_unknown("versions", "age_s", "size_bytes")
    age_s = None
    if "age_s" in parts.values:
        age_s = parts.take_float("age_s", 0.0, low=0.001, high=AGE_S_MAX)
    versions, size_bytes = parts.take_count("versions"), parts.take_count("size_bytes")
    return table.checked("retention", lambda: Retention(versions, age_s, size_bytes))


def _actors(root: Table, worlds: tuple[str, ...]) -> tuple[ActorConfig, ...]:
    tables = dict(root.take_table("actors").named_tables())
    actors = tuple(_actor(name, table, worlds) for name, table in tables.items())
    for process in processes_of(actors):
        refuse_misfits(process, tables)
    return actors


def _actor(name: str, table: Table, worlds: tuple[str, ...]) -> ActorConfig:
    table.refuse_unknown(
        "class", "worlds", "args", "options", "env", "process", "every_s", "entity", "host",
        "drain_s",
    )  # fmt: skip
    _check_title(name, "actor", table)
    class_path = table.take_str("class")
    if not _DOTTED_NAME.match(class_path):
        table.refuse("class", f"'class' is written package.module:Class, not {class_path!r}")
    every_s = None
    if "every_s" in table.values:
        every_s = table.take_float("every_s", 1.0, low=0.001, high=86_400.0)
    return ActorConfig(
        name=name,
        class_path=class_path,
        worlds=_roles(table.take_table("worlds"), worlds),
        options=_args(table),
        env=_env(table.take_table("env")),
        every_s=every_s,
        entity=_entity(table),
        host=_host(table),
        drain_s=_drain_s(table),
        process=take_process(table),
    )


def _args(table: Table) -> Mapping[str, object]:
    args, options = table.take_table("args"), table.take_table("options")
    for name in args.values:
        if name in options.values:
            args.refuse(name, f"{name!r} stands in args and in options of {table.title}")
    return MappingProxyType({**options.values, **args.values})


def _env(table: Table) -> Mapping[str, str]:
    for name in table.values:
        if not _VARIABLE.match(name):
            table.refuse(name, f"{name!r} is no name of a variable of the environment")
    return MappingProxyType({name: table.take_str(name, "") for name in table.values})


def _entity(table: Table) -> str:
    """Return the name of the one entity of an actor, or nothing."""
    if "entity" not in table.values:
        return ""
    name = table.take_str("entity")
    return table.checked("entity", lambda: Entity(name).name)


def _roles(table: Table, worlds: tuple[str, ...]) -> Mapping[str, str]:
    bound = {role: table.take_str(role) for role in table.values}
    for role, world in bound.items():
        if world not in worlds:
            table.refuse(
                role,
                f"role {role!r} is bound to unknown world context {world!r}"
                f"{suggestion(world, worlds)} (known: {', '.join(worlds) or 'none'})",
            )
    return MappingProxyType(bound)


def _check_title(name: str, kind: str, table: Table) -> None:
    try:
        checked_name(kind, name, slashes=False)
    except ValueError as error:
        table.source.refuse(table.where, str(error))
