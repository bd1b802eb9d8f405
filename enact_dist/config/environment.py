"""Environment variables that override a `cell.toml`: for containers and for a second try.

============================  =====================================================
variable                      replaces
============================  =====================================================
ENACT_SESSION_TTL_S           session_ttl_s
ENACT_DATA_FOLDER             data_folder, of shards without a `folder` of their own
ENACT_CARRIER                 carrier
ENACT_SHARED_BYTES_MAX        shared_bytes_max
ENACT_SHARD_<NAME>_LISTEN     shards.NAME.listen, comma separated
ENACT_SHARD_<NAME>_ADVERTISE  shards.NAME.advertise, comma separated
ENACT_SHARD_<NAME>_FOLDER     shards.NAME.folder
ENACT_SHARD_<NAME>_METRICS    shards.NAME.metrics
ENACT_SHARD_<NAME>_DRAIN_S    shards.NAME.drain_s
============================  =====================================================

`<NAME>` is the shard's name in capitals, with ``_`` for ``.`` and ``-``.  Relative folders are
relative to the working folder.  An empty variable counts as none.  One that starts with
``ENACT_SHARD_`` and names no shard or no such key, or that is close to one of the others, is a
`ConfigError`: a misspelt override must not end as a silent default.  `ENACT_CELL` (which cell the
command line talks to) and `ENACT_SHARED_FOLDER` (where processes of one host meet, see
`link.memory.shared_folder`) are no keys of the file.
"""

from __future__ import annotations

import dataclasses
import difflib
import re
from pathlib import Path
from typing import TYPE_CHECKING, Final

from enact_dist.config.table import suggestion
from enact_dist.config.types import (
    CARRIER_DEFAULT,
    CARRIERS,
    DRAIN_S_MAX,
    TTL_S_MAX,
    TTL_S_MIN,
    checked_endpoint,
    is_wildcard,
    metrics_address,
)
from enact_dist.errors import ConfigError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from enact_dist.config.types import CellConfig, ShardConfig

_CELL_NAMES: Final = (
    "ENACT_SESSION_TTL_S",
    "ENACT_DATA_FOLDER",
    "ENACT_CARRIER",
    "ENACT_SHARED_BYTES_MAX",
    "ENACT_SHARED_FOLDER",
)
_SHARD_PREFIX: Final = "ENACT_SHARD_"
_SHARD_KEYS: Final = ("LISTEN", "ADVERTISE", "FOLDER", "METRICS", "DRAIN_S")
_CLOSE: Final = 0.85
"""Similarity from which a name counts as misspelt; ENACT_SESSION_TTL has 0.94."""


def with_environment(config: CellConfig, environment: Mapping[str, str]) -> CellConfig:
    """Return `config` with the overrides of `environment`.

    Raises:
        ConfigError: An override has a wrong value, or names nothing of this cell.
    """
    _refuse_unknown(config, [name for name in environment if name.startswith("ENACT_")])
    ours = {name: text for name, text in environment.items() if text}
    if "ENACT_SESSION_TTL_S" in ours:
        config = dataclasses.replace(
            config, ttl_s=_seconds("ENACT_SESSION_TTL_S", ours, TTL_S_MIN, TTL_S_MAX)
        )
    if "ENACT_CARRIER" in ours:
        config = dataclasses.replace(config, carrier=_carrier(ours["ENACT_CARRIER"]))
    if "ENACT_SHARED_BYTES_MAX" in ours:
        bytes_max = _bytes_max(ours["ENACT_SHARED_BYTES_MAX"])
        config = dataclasses.replace(config, shared_bytes_max=bytes_max)
    if "ENACT_DATA_FOLDER" in ours:
        config = _moved(config, Path(ours["ENACT_DATA_FOLDER"]).expanduser().absolute())
    shards = tuple(_with_overrides(shard, ours) for shard in config.shards)
    return dataclasses.replace(config, shards=shards)


def without_overrides(environment: Mapping[str, str]) -> dict[str, str]:
    """Return `environment` for processes that are to do what their `cell.toml` says, no less."""
    overrides = set(_CELL_NAMES) - {"ENACT_SHARED_FOLDER"}
    return {
        name: text
        for name, text in environment.items()
        if name not in overrides and not name.startswith(_SHARD_PREFIX)
    }


def variable_of(shard: str, key: str) -> str:
    """Return the name of the variable that overrides `key` of the shard called `shard`."""
    return f"{_SHARD_PREFIX}{re.sub('[.-]', '_', shard).upper()}_{key}"


def _refuse_unknown(config: CellConfig, ours: Sequence[str]) -> None:
    of_shards = [variable_of(shard.name, key) for shard in config.shards for key in _SHARD_KEYS]
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


def _seconds(name: str, ours: Mapping[str, str], low: float, high: float) -> float:
    try:
        seconds = float(ours[name])
    except ValueError:
        seconds = -1.0
    if not low <= seconds <= high:
        raise ConfigError(f"{name}={ours[name]!r} is no number of seconds from {low:g} to {high:g}")
    return seconds


def _bytes_max(text: str) -> int:
    if not text.isdecimal():
        raise ConfigError(f"ENACT_SHARED_BYTES_MAX={text!r} is no number of bytes, 0 or more")
    return int(text)


def _carrier(text: str) -> str:
    if text not in CARRIERS:
        raise ConfigError(f"ENACT_CARRIER={text!r} is unknown (known: {', '.join(CARRIERS)})")
    return text


def carrier_of(environment: Mapping[str, str]) -> str:
    """Return the carrier that the environment asks for where no `cell.toml` does.

    Raises:
        ConfigError: No shard has that name.
    """
    return _carrier(environment.get("ENACT_CARRIER") or CARRIER_DEFAULT)


def _moved(config: CellConfig, data_folder: Path) -> CellConfig:
    """Return `config` with another data folder; shards with a folder elsewhere keep theirs."""

    def moved(shard: ShardConfig) -> ShardConfig:
        default = config.data_folder and config.data_folder / shard.name
        if shard.folder != default:
            return shard
        return dataclasses.replace(shard, folder=data_folder / shard.name)

    shards = tuple(moved(shard) for shard in config.shards)
    return dataclasses.replace(config, data_folder=data_folder, shards=shards)


def _with_overrides(shard: ShardConfig, ours: Mapping[str, str]) -> ShardConfig:
    listen = _endpoints(variable_of(shard.name, "LISTEN"), ours)
    advertise = _endpoints(variable_of(shard.name, "ADVERTISE"), ours)
    if listen:
        # An advertised endpoint that was only the default follows the new one.
        followed = listen if shard.advertise == shard.listen else shard.advertise
        shard = dataclasses.replace(shard, listen=listen, advertise=followed)
    if advertise:
        shard = dataclasses.replace(shard, advertise=advertise)
    if any(is_wildcard(endpoint) for endpoint in shard.advertise):
        raise ConfigError(
            f"shard {shard.name} would advertise {', '.join(shard.advertise)}, to which no"
            f" client can connect; set {variable_of(shard.name, 'ADVERTISE')} too (or give"
            " `enact shard run` the option --advertise)"
        )
    folder = ours.get(variable_of(shard.name, "FOLDER"))
    if folder:
        shard = dataclasses.replace(shard, folder=Path(folder).expanduser().absolute())
    metrics = ours.get(variable_of(shard.name, "METRICS"))
    if metrics:
        try:
            shard = dataclasses.replace(shard, metrics=metrics_address(metrics))
        except ValueError as error:
            raise ConfigError(f"{variable_of(shard.name, 'METRICS')}: {error}") from error
    drain = variable_of(shard.name, "DRAIN_S")
    if ours.get(drain):
        drain_s = _seconds(drain, ours, 0.0, DRAIN_S_MAX)
        shard = dataclasses.replace(shard, drain_s=drain_s)
    return shard


def _endpoints(name: str, ours: Mapping[str, str]) -> tuple[str, ...]:
    endpoints = tuple(part.strip() for part in ours.get(name, "").split(",") if part.strip())
    for endpoint in endpoints:
        try:
            checked_endpoint(endpoint)
        except ValueError as error:
            raise ConfigError(f"{name}: {error}") from error
    return endpoints
