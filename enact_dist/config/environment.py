"""Environment variables that override a `cell.toml`: for containers and for a second try.

A key that has a variable names it in `enact_dist.config.types`: ``ENACT_CARRIER`` replaces
`carrier`, ``ENACT_SHARD_<NAME>_LISTEN`` the `listen` of one shard.  `<NAME>` is the shard's name in
capitals, with ``_`` for ``.`` and ``-``.  ``ENACT_DATA_FOLDER`` concerns shards without a `folder`
of their own; lists are comma separated.  Relative folders are relative to the working folder.  An
empty variable counts as none.  One that starts with ``ENACT_SHARD_`` and names no shard or no such
key, or that is close to one of the others, is a `ConfigError`: a misspelt override must not end as
a silent default.

`ENACT_CELL` (which cell the command line talks to), `ENACT_SHARED_FOLDER` (where processes of one
host meet, see `link.memory.shared_folder`), `ENACT_STANDING` (whether an actor's lock waits for
news at its shard, see `actor.running.runner`) and `ENACT_RETAIN` (whether grants are kept, see
`link.memory.use_marks`) are no keys of the file.  Nor is `ENACT_IDENTITY`: which key a program
uses whose name has none, see `link.zenoh.tls`.
"""

from __future__ import annotations

import dataclasses
import difflib
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, TypeVar

from enact_dist.config.rights import SecurityConfig
from enact_dist.config.table import Field, fields_of, path_of, suggestion
from enact_dist.config.types import (
    CellConfig,
    ShardConfig,
    is_locked,
    is_wildcard,
)
from enact_dist.errors import ConfigError

T = TypeVar("T", CellConfig, SecurityConfig, ShardConfig)
V = TypeVar("V", float, str)


def variables_of(kind: type) -> dict[str, Field]:
    """Return the variables that override the fields of a class, without their prefix."""
    return {one.key.variable: one for one in fields_of(kind) if one.key.variable}


_CELL_NAMES: Final = (
    *(f"ENACT_{name}" for kind in (CellConfig, SecurityConfig) for name in variables_of(kind)),
    "ENACT_IDENTITY",
    "ENACT_SHARED_FOLDER",
    "ENACT_RETAIN",
    "ENACT_STANDING",
)
_SHARD_PREFIX: Final = "ENACT_SHARD_"
_CLOSE: Final = 0.85
"""Similarity from which a name counts as misspelt; ENACT_SESSION_TTL has 0.94."""


def with_environment(config: CellConfig, environment: Mapping[str, str]) -> CellConfig:
    """Return `config` with the overrides of `environment`.

    Raises:
        ConfigError: An override has a wrong value, or names nothing of this cell.
    """
    _refuse_unknown(config, [name for name in environment if name.startswith("ENACT_")])
    ours = {name: text for name, text in environment.items() if text}
    security = _overridden(config.security, "ENACT_{}".format, ours)
    moved = dataclasses.replace(_overridden(config, "ENACT_{}".format, ours), security=security)
    shards = tuple(
        _shard(shard, config.data_folder, moved.data_folder, ours) for shard in config.shards
    )
    return dataclasses.replace(moved, shards=shards)


def without_overrides(environment: Mapping[str, str]) -> dict[str, str]:
    """Return `environment` without overrides, for processes that follow their `cell.toml`."""
    overrides = set(_CELL_NAMES) - {"ENACT_SHARED_FOLDER", "ENACT_RETAIN", "ENACT_STANDING"}
    return {
        name: text
        for name, text in environment.items()
        if name not in overrides and not name.startswith(_SHARD_PREFIX)
    }


def setting_of(environment: Mapping[str, str], key: str, default: V) -> V:
    """Return what a variable says of a whole cell, for an endpoint without a `cell.toml`.

    Raises:
        ConfigError: It says what no cell.toml may say.
    """
    text = environment.get(f"ENACT_{key}")
    if not text:
        return default
    value: V = _read(f"ENACT_{key}", text, variables_of(CellConfig)[key])
    return value


def security_of(environment: Mapping[str, str], endpoint: str) -> SecurityConfig:
    """Return the keys that the environment names, for an endpoint without a `cell.toml`."""
    none = SecurityConfig()
    return _overridden(none, "ENACT_{}".format, environment) if is_locked(endpoint) else none


def variable_of(shard: str, key: str) -> str:
    """Return the name of the variable that overrides `key` of the shard called `shard`."""
    return f"{_SHARD_PREFIX}{re.sub('[.-]', '_', shard).upper()}_{key}"


def _refuse_unknown(config: CellConfig, ours: Sequence[str]) -> None:
    keys = variables_of(ShardConfig)
    of_shards = [variable_of(shard.name, key) for shard in config.shards for key in keys]
    for name in ours:
        if name.startswith(_SHARD_PREFIX) and name not in of_shards:
            raise ConfigError(
                f"the environment sets {name}, which is no key of a shard of {config.path}"
                f"{suggestion(name, of_shards)} (known: {', '.join(of_shards)})"
            )
        if name.startswith(_SHARD_PREFIX):
            continue  # one of them, so it is spelt right
        close = difflib.get_close_matches(name, _CELL_NAMES, n=1, cutoff=_CLOSE)
        if close and name not in _CELL_NAMES:
            raise ConfigError(f"the environment sets {name}; did you mean {close[0]}?")


def _overridden(config: T, name_of: Callable[[str], str], ours: Mapping[str, str]) -> T:
    """Return a configuration with the fields replaced for which `ours` has a variable."""
    found = {
        field.name: _read(name, ours[name], field)
        for key, field in variables_of(type(config)).items()
        if (name := name_of(key)) in ours
    }
    return dataclasses.replace(config, **{key: one for key, one in found.items() if one != ()})


def _read(name: str, text: str, field: Field) -> Any:
    """Return the value of a variable as its field wants it."""
    kind, key = field.kind, field.key
    if key.choices and text not in key.choices:
        raise ConfigError(f"{name}={text!r} is unknown (known: {', '.join(key.choices)})")
    if kind is int:
        if not text.isdecimal():
            raise ConfigError(f"{name}={text!r} is no number of bytes, 0 or more")
        return int(text)
    if kind is float:
        try:
            seconds = float(text)
        except ValueError:
            seconds = -1.0
        if not key.low <= seconds <= key.high:
            allowed = f"from {key.low:g} to {key.high:g}"
            raise ConfigError(f"{name}={text!r} is no number of seconds {allowed}")
        return seconds
    if kind is Path:
        try:
            return path_of(text).absolute()
        except ConfigError as error:
            raise ConfigError(f"{name}: {error}") from None
    if key.make is None:
        return text
    try:
        if kind == tuple[str, ...]:
            return tuple(key.make(part.strip()) for part in text.split(",") if part.strip())
        return key.make(text)
    except ValueError as error:
        raise ConfigError(f"{name}: {error}") from error


def _shard(
    shard: ShardConfig, before: Path | None, now: Path | None, ours: Mapping[str, str]
) -> ShardConfig:
    """Return a shard with its overrides; the cell's data folder was `before` and is `now`."""
    if shard.folder == (before and before / shard.name):
        shard = dataclasses.replace(shard, folder=now and now / shard.name)
    if shard.advertise == shard.listen:
        # An advertised endpoint that was only the default follows the new one.
        shard = dataclasses.replace(shard, advertise=())
    new = _overridden(shard, lambda key: variable_of(shard.name, key), ours)
    if not new.advertise:
        new = dataclasses.replace(new, advertise=new.listen)
    if any(is_wildcard(endpoint) for endpoint in new.advertise):
        raise ConfigError(
            f"shard {shard.name} would advertise {', '.join(new.advertise)}, to which no"
            f" client can connect; set {variable_of(shard.name, 'ADVERTISE')} too (or give"
            " `enact shard run` the option --advertise)"
        )
    return new
