"""What a cell consists of, as frozen values: the result of reading a `cell.toml`.

Their fields are the keys of its tables: `enact_dist.config.read` reads them by their annotations,
and `enact_dist.config.environment` overrides those that name a variable.
"""

from __future__ import annotations

import json
import re
import zlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final, NamedTuple

from enact_dist.config.rights import RightsConfig, SecurityConfig, compiled_rights
from enact_dist.config.shows import GUESSED, Shows
from enact_dist.config.table import TableKey
from enact_dist.core.protocol.messages import AspectEntry, Pin, PlacementMap, ShardEntry
from enact_dist.core.state.retention import stated_limits
from enact_dist.errors import ConfigError
from enact_dist.retention import AGE_S_MAX, Retention, checked_retention
from enact_dist.terms import Durability, Entities, Entity, checked_name

if TYPE_CHECKING:
    from enact_dist.core.shard.state import ShardSettings

CARRIERS: Final = ("auto", "zenoh", "socket")
"""How messages may travel between processes; `local()` needs none of them.

"auto" takes a socket between processes of one host and Zenoh for all others; "socket" makes it an
error if there is none.
"""

TTL_S_MIN: Final = 0.2
"""Shorter leases end in ordinary scheduling pauses of a loaded machine."""
TTL_S_MAX: Final = 60.0
"""A dead holder blocks its data for one TTL, a restarted shard waits one for absent sessions."""
LEASE_S_MIN, LEASE_S_MAX = 1.0, 60.0
"""A shorter lease ends while a host is busy; a standby waits for the whole of a longer one."""
DRAIN_S_MAX: Final = 3600.0
"""Default duration of `enact lock hold`."""

_PASSWORD = re.compile(r"([?&]\w*password=)[^&]*")
_STORE: Final = re.compile(r"postgres(?:ql)?://\S+\Z")
_ENDPOINT: Final = re.compile(r"(?:tcp|tls)/(\[[0-9A-Fa-f:.]+\]|[A-Za-z0-9._-]+):(\d{1,5})\Z")
_ADDRESS: Final = re.compile(r"((\[[0-9A-Fa-f:.]+\]|[A-Za-z0-9._-]+)?:)?\d{1,5}\Z")
_DOTTED_NAME: Final = re.compile(r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)*:[A-Za-z_]\w*\Z")
_WILDCARDS: Final = ("0.0.0.0", "[::]")  # noqa: S104 - recognised here in order to be refused


def checked_endpoint(endpoint: str) -> str:
    """Return `endpoint` if it has the form ``tcp/host:port`` or ``tls/host:port``.

    Raises:
        ValueError: It has another form, or a port outside 1 to 65535.
    """
    found = _ENDPOINT.match(endpoint)
    if found is None or not 1 <= int(found[2]) <= 65_535:
        raise ValueError(
            f"{endpoint!r} is no endpoint; write tcp/host:port with a port from 1 to 65535,"
            " such as tcp/127.0.0.1:7447, or tls/host:port in a cell with keys"
        )
    return endpoint


def metrics_address(text: str) -> tuple[str, int]:
    """Read ``host:port``, or a port of the loopback.

    Raises:
        ValueError: It has another form, or a port outside 1 to 65535.
    """
    host, _, port = text.rpartition(":")
    if not _ADDRESS.match(text) or not 1 <= int(port) <= 65_535:
        raise ValueError(
            f"{text!r} is no address for metrics; write host:port, or a port of the loopback, such"
            " as 127.0.0.1:9464 or 9464"
        )
    return host.strip("[]") or "127.0.0.1", int(port)


def checked_store(url: str) -> str:
    """Return `url` if it is the address of a PostgreSQL database.

    Raises:
        ValueError: It has another form.
    """
    if not _STORE.match(url):
        raise ValueError(
            f"{without_password(url)!r} is no address of a database; write"
            " postgresql://user@host/database, with several hosts as host1,host2"
        )
    return url


def without_password(url: str) -> str:
    """Return the address of a database for people."""
    scheme, mark, rest = url.partition("://")
    who, at, place = rest.rpartition("@")
    return _PASSWORD.sub(r"\1…", f"{scheme}{mark}{who.partition(':')[0]}{at}{place}")


def is_locked(endpoint: str) -> bool:
    """Return whether only programs with a key of the cell can connect to an endpoint."""
    return endpoint.startswith("tls/")


def is_wildcard(endpoint: str) -> bool:
    """Return whether an endpoint means every address of a host; no client can connect to that."""
    found = _ENDPOINT.match(endpoint)
    return found is not None and found[1] in _WILDCARDS


def _entity(name: str) -> str:
    return Entity(name).name


def _pattern(text: str) -> str:
    return Entities(text).pattern


def _dotted_name(key: str, form: str, path: str) -> str:
    if not _DOTTED_NAME.match(path):
        raise ValueError(f"{key!r} is written package.module:{form}, not {path!r}")
    return path


TTL_S_DEFAULT: Final = 2.0
"""Session TTL in seconds: a dead holder blocks others that long; shorter needs a quiet network."""

CARRIER_DEFAULT: Final = "auto"

LEASE_S_DEFAULT: Final = 2.0

_EXAMPLE: Final = "tcp/127.0.0.1:7447"
_DRAIN: Final = TableKey(high=DRAIN_S_MAX, variable="DRAIN_S")


@dataclass(frozen=True, slots=True)
class ShardConfig:
    """One shard daemon.

    Attributes:
        listen: Endpoints it opens (``tcp/0.0.0.0:7447``).
        advertise: Endpoints at which others reach it; those of `listen` unless written.
        folder: Its data folder, absolute, or ``None`` to keep everything in memory.
        host: Host name of the machine it runs on; empty: wherever `enact up` is called.
        metrics: Host and port at which Prometheus may ask, or ``None``.
        drain_s: How long holders may still finish after a signal, seconds; ``None`` leaves it to
            the daemon.
    """

    name: Annotated[str, TableKey(title="shard")]
    listen: Annotated[
        tuple[str, ...], TableKey(make=checked_endpoint, example=_EXAMPLE, variable="LISTEN")
    ]
    advertise: Annotated[
        tuple[str, ...], TableKey(make=checked_endpoint, example=_EXAMPLE, variable="ADVERTISE")
    ] = ()
    folder: Annotated[Path | None, TableKey(variable="FOLDER")] = None
    host: str = ""
    metrics: Annotated[
        tuple[str, int] | None, TableKey(make=metrics_address, variable="METRICS")
    ] = None
    drain_s: Annotated[float | None, _DRAIN] = None


class PinTable(NamedTuple):
    """The keys of a pin."""

    entities: Annotated[str, TableKey(make=_pattern)]
    shard: str


class RetentionTable(NamedTuple):
    """The keys of a retention that is written as a table."""

    versions: Annotated[int | None, TableKey(low=1)] = None
    age_s: Annotated[float | None, TableKey(low=0.001, high=AGE_S_MAX)] = None
    size_bytes: Annotated[int | None, TableKey(low=1)] = None


def _retention(found: object) -> Retention | None:
    return Retention(*found) if isinstance(found, RetentionTable) else checked_retention(found)


@dataclass(frozen=True, slots=True)
class AspectConfig:
    """What the cell fixes about an aspect.

    Attributes:
        durability: What its commits survive, whatever the actors declare; None: as they declare.
        retention: How much of each datum's history stays; None: as the actors declare.
        compare: Comparator for `enact world diff`, ``package.module:NAME``, or nothing.
        shows: What a recording shows its data as.
    """

    name: Annotated[str, TableKey(title="aspect")]
    durability: Durability | None = None
    retention: Annotated[Retention | None, TableKey(table=RetentionTable, make=_retention)] = None
    compare: Annotated[str, TableKey(make=partial(_dotted_name, "compare", "NAME"))] = ""
    shows: Annotated[Shows, TableKey(inline=True)] = GUESSED

    def entry(self) -> AspectEntry:
        """Return it as an entry of a catalogue, without a fingerprint: any type may register."""
        durability = self.durability.value if self.durability is not None else ""
        return AspectEntry(self.name, "", durability, *stated_limits(self.retention))


@dataclass(frozen=True, slots=True)
class ActorConfig:
    """One actor process.

    Attributes:
        class_path: ``package.module:Class``.
        worlds: Role of the actor class to world context of the cell.
        options: Parameters of the class (`args`), as TOML gives them.
        env: Environment variables of its process.
        process: Name of the operating system process that it shares with others; empty: it has
            one of its own.
        every_s: Period in seconds that replaces the one of a source, or ``None``.
        entity: The one entity that it works on, of those that its patterns match; empty: all.
        host: Host name of the machine it runs on; empty: wherever `enact up` is called.
        drain_s: How long its update may still take after a signal, seconds; ``None`` leaves it to
            the actor's process.
    """

    name: Annotated[str, TableKey(title="actor")]
    class_path: Annotated[str, TableKey("class", make=partial(_dotted_name, "class", "Class"))]
    worlds: Mapping[str, str] = field(default_factory=dict)
    options: Annotated[Mapping[str, object], TableKey("args", older="options")] = field(
        default_factory=dict
    )
    every_s: Annotated[float | None, TableKey(low=0.001, high=86_400.0)] = None
    entity: Annotated[str, TableKey(make=_entity)] = ""
    host: str = ""
    drain_s: Annotated[float | None, _DRAIN] = None
    env: Annotated[Mapping[str, str], TableKey(blank=True)] = field(default_factory=dict)
    process: Annotated[str, TableKey(make=partial(checked_name, "process", slashes=False))] = ""


@dataclass(frozen=True, slots=True)
class ActorProcess:
    """One operating system process with its actors.

    Attributes:
        name: `process` of its actors; of an actor that has a process of its own, that actor's name.
        actors: Its actors, at least one, in the order of the file.
    """

    name: str
    actors: tuple[ActorConfig, ...]

    @property
    def env(self) -> Mapping[str, str]:
        """Environment variables of the process: those of all its actors."""
        return {name: text for actor in self.actors for name, text in actor.env.items()}

    @property
    def drain_s(self) -> float | None:
        """The longest `drain_s` of its actors; ``None`` where no actor has one."""
        return max((one.drain_s for one in self.actors if one.drain_s is not None), default=None)

    @property
    def members(self) -> tuple[str, ...]:
        """Names of its actors."""
        return tuple(actor.name for actor in self.actors)


@dataclass(frozen=True, slots=True)
class CellConfig:
    """A whole cell.

    Attributes:
        path: The file it was read from, absolute.
        name: Name of the cell; part of every key on the network.
        ttl_s: Session TTL in seconds.
        carrier: How messages travel between processes.
        shared_bytes_max: Cap of each shard's large data in shared memory, bytes.
        data_folder: Where shards without a `folder` of their own keep theirs, or ``None``.
        store: Address of the database that keeps the data of all shards; empty: folders do.
        lease_s: How long a shard may answer after the database's last confirmation, seconds; then
            a standby takes over.
        security: The keys of the cell, and who has every right.
        worlds: World contexts that exist from the start.
        shards: At least one, in the order of the file.
        pins: Entities kept on one shard; the first pin that matches wins.
        aspects: Aspects whose durability is fixed here.
        actors: Actors of the cell, in the order of the file.
        rights: Who may do what; None: every client may do everything.
    """

    path: Annotated[Path, TableKey(given=True)]
    name: Annotated[str, TableKey(make=partial(checked_name, "cell", slashes=False))]
    ttl_s: Annotated[
        float, TableKey("session_ttl_s", low=TTL_S_MIN, high=TTL_S_MAX, variable="SESSION_TTL_S")
    ] = TTL_S_DEFAULT
    carrier: Annotated[str, TableKey(choices=CARRIERS, variable="CARRIER")] = CARRIER_DEFAULT
    shared_bytes_max: Annotated[int | None, TableKey(variable="SHARED_BYTES_MAX")] = None
    data_folder: Annotated[Path | None, TableKey(variable="DATA_FOLDER")] = None
    store: Annotated[str, TableKey(make=checked_store, variable="STORE")] = ""
    lease_s: Annotated[float, TableKey(low=LEASE_S_MIN, high=LEASE_S_MAX)] = LEASE_S_DEFAULT
    security: Annotated[
        SecurityConfig,
        TableKey(table=SecurityConfig, example='[security] and below it keys = "keys"'),
    ] = field(default_factory=SecurityConfig)
    worlds: Annotated[
        tuple[str, ...], TableKey(make=partial(checked_name, "world context", slashes=False))
    ] = ()
    shards: tuple[ShardConfig, ...] = ()
    pins: Annotated[tuple[Pin, ...], TableKey(table=PinTable, make=Pin._make)] = ()
    aspects: tuple[AspectConfig, ...] = ()
    actors: tuple[ActorConfig, ...] = ()
    rights: Annotated[RightsConfig | None, TableKey(table=RightsConfig, example="[rights]")] = None

    @property
    def actor_names(self) -> tuple[str, ...]:
        """Names of its actors."""
        return tuple(actor.name for actor in self.actors)

    @property
    def key_holders(self) -> tuple[str, ...]:
        """Who has a key in a cell with keys, beside the shards: actors, operators, programs."""
        programs = self.rights.programs if self.rights is not None else ()
        return tuple(dict.fromkeys((*self.actor_names, *self.security.key_holders, *programs)))

    @property
    def ttl_ns(self) -> int:
        """Session TTL in nanoseconds."""
        return round(self.ttl_s * 1e9)

    def shard(self, name: str) -> ShardConfig:
        """Return the shard called `name`.

        Raises:
            ConfigError: The cell has none of that name.
        """
        for shard in self.shards:
            if shard.name == name:
                return shard
        known = ", ".join(shard.name for shard in self.shards)
        raise ConfigError(
            f"{self.path}: the cell {self.name} has no shard {name!r}; it has {known}",
            path=str(self.path),
        )

    def processes(self) -> tuple[ActorProcess, ...]:
        """Return the processes of the cell's actors, in the order of their first actors."""
        return processes_of(self.actors)

    def placement_map(self) -> PlacementMap:
        """Return the shards with their advertised endpoints, and the pins.

        The version is a checksum of what decides where an entity lives, the shard names and the
        pins in order: the same file has the same version on every host and after every restart,
        and an endpoint that differs between hosts does not make their maps disagree.
        """
        text = json.dumps([sorted(shard.name for shard in self.shards), self.pins])
        version = zlib.crc32(text.encode()) & 0x7FFF_FFFF
        shards = tuple(ShardEntry(shard.name, shard.advertise) for shard in self.shards)
        return PlacementMap(version, shards, self.pins)

    def aspect_entries(self) -> tuple[AspectEntry, ...]:
        """Return the aspects as entries of a catalogue."""
        return tuple(aspect.entry() for aspect in self.aspects)

    def shard_settings(self, name: str) -> ShardSettings:
        """Return what the core of shard `name` has to know.

        Raises:
            ConfigError: The cell has none of that name, or its `rights.toml` is missing.
        """
        from enact_dist.core.shard.state import ShardSettings

        rights = self.rights
        return ShardSettings(
            name=self.shard(name).name,
            placement=self.placement_map(),
            worlds=self.worlds,
            aspects=self.aspect_entries(),
            ttl_ns_max=self.ttl_ns,
            rights=None
            if rights is None
            else compiled_rights(
                rights, self.path, actors=self.actor_names, operators=self.security.operators
            ),
        )


def processes_of(actors: Iterable[ActorConfig]) -> tuple[ActorProcess, ...]:
    """Return the processes in which these actors run, in the order of their first actors."""
    found: dict[tuple[bool, str], list[ActorConfig]] = {}
    for actor in actors:
        found.setdefault((not actor.process, actor.process or actor.name), []).append(actor)
    return tuple(ActorProcess(name, tuple(those)) for (_, name), those in found.items())
