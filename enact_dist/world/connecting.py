"""Opening a cell: `connect` over the network, `local` inside this process."""

from __future__ import annotations

import os
import secrets
import socket
import sys
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from enact_dist.access.arguments import check_seconds, checked_as
from enact_dist.core.client.client import Client
from enact_dist.core.protocol.messages import PlacementMap, ShardEntry, Welcome
from enact_dist.errors import ConfigError, LinkError, MisuseError
from enact_dist.link.zenoh.endpoints import PROTOCOLS, split_endpoint
from enact_dist.wire.limits import NAME_CHARACTERS_MAX
from enact_dist.wire.texts import is_safe, shown
from enact_dist.world.cell import Cell

if TYPE_CHECKING:
    from collections.abc import Sequence

    from enact_dist.config.rights import SecurityConfig
    from enact_dist.config.types import CellConfig
    from enact_dist.link.clock import Clock

TTL_S: Final = 2.0
"""Lease of a session if no `cell.toml` sets one."""
LOCAL_SHARD: Final = "local"


def connect(
    target: str | Path,
    *,
    actor: str = "",
    timeout_s: float = 5.0,
    request_timeout_s: float = 10.0,
    observer: bool = False,
    patience_s: float | None = None,
) -> Cell:
    """Join a running cell.

    Args:
        target: A `cell.toml`, or one endpoint such as ``tcp/host:7447``; one is enough, since each
            shard knows the others.
        actor: Name under which `enact lock ls` and `enact actor ls` show this process.
        timeout_s: How long to wait for a first shard to answer.
        request_timeout_s: How long a request waits for a shard that does not answer before the
            shard counts as unreachable.  Locks have a time limit of their own, and a commit takes
            as long as it takes to learn its outcome.
        observer: Read only: no lock can be taken, no world context or aspect is created, and
            shards keep no record of the session.
        patience_s: The former name of `request_timeout_s`, for this release.

    Raises:
        ShardUnreachableError: No shard answered in time; the message names shards and endpoints.
        ConfigError: The `cell.toml` cannot be used, `target` is neither file nor endpoint, or the
            cell has keys and this host none that can be used.
        MisuseError: A time is negative or not a number, or this process was forked from one that
            has been connected (see `Cell`).
    """
    from enact_dist.link.client.joining import join
    from enact_dist.link.zenoh.access import actor_said, new_session_id
    from enact_dist.link.zenoh.config import OPEN_S
    from enact_dist.link.zenoh.tls import client_keys

    if patience_s is not None:
        text = "connect(patience_s=…) is now connect(request_timeout_s=…)"
        warnings.warn(text, DeprecationWarning, stacklevel=2)
        request_timeout_s = patience_s
    for word, waits_s in (("timeout_s", timeout_s), ("request_timeout_s", request_timeout_s)):
        check_seconds(word, waits_s)
    known = _known_of(target)
    client = _client(actor, ttl_s=known.ttl_s, observer=observer)
    keys = client_keys(known.security, client.actor)
    if keys is not None:
        client.actor = actor_said(keys.name, client.actor)
    secret = secrets.token_hex(16)
    client.session = new_session_id(keys.name if keys is not None else client.actor, secret)
    cell_name, cell_client, welcome = join(
        known.name,
        known.endpoints,
        client,
        timeout_s=timeout_s,
        open_s=min(OPEN_S, request_timeout_s),
        carrier=known.carrier,
        expected=known.expected,
        keys=keys,
        secret=secret,
    )
    cell_client.request_timeout_s = request_timeout_s
    try:
        cell_client.start(welcome)
    except BaseException:
        cell_client.close()
        raise
    return Cell(cell_name, cell_client)


class _Known(NamedTuple):
    """What a target says of its cell before a shard has answered."""

    name: str
    ttl_s: float
    carrier: str
    endpoints: tuple[str, ...]
    expected: tuple[ShardEntry, ...]
    security: SecurityConfig


def _known_of(target: str | Path) -> _Known:
    """Read a `cell.toml`, or the environment beside an endpoint.

    Raises:
        ConfigError: It is neither, or cannot be used.
    """
    from enact_dist.config.environment import security_of, setting_of
    from enact_dist.config.read import load_config
    from enact_dist.config.types import CARRIER_DEFAULT

    if _is_endpoint(target):
        place = str(target)
        ttl_s = setting_of(os.environ, "SESSION_TTL_S", TTL_S)
        carrier = setting_of(os.environ, "CARRIER", CARRIER_DEFAULT)
        return _Known("", ttl_s, carrier, (place,), (), security_of(os.environ, place))
    _refuse_no_file(target)
    config = load_config(Path(target))
    expected = config.placement_map().shards
    endpoints = tuple(e for entry in expected for e in entry.endpoints)
    return _Known(config.name, config.ttl_s, config.carrier, endpoints, expected, config.security)


def local(
    path: str | Path | None = None,
    *,
    worlds: Sequence[str] = (),
    config: CellConfig | None = None,
    actor: str = "",
    clock: Clock | None = None,
) -> Cell:
    """Run one shard inside this process: the paper's mode, with actors as threads.

    Args:
        path: Folder that stores the commits; with None they stay in memory, and every aspect is
            volatile, whatever its durability.
        worlds: World contexts to create.
        config: Aspects, further world contexts and the session's TTL of a `cell.toml`.
        actor: Name under which this process is shown.
        clock: Clock of the shard, for tests; the default is this host's.

    Raises:
        StoreError: The folder is in use, unreadable or corrupt.
        MisuseError: `worlds` contains something that is no name of a world context.
    """
    from enact_dist.core.shard.state import ShardSettings
    from enact_dist.link.client.locks import CellClient
    from enact_dist.link.daemon.embedded import EmbeddedCarrier
    from enact_dist.link.opening import open_host

    names = dict.fromkeys((*_world_names(worlds), *(config.worlds if config else ())))
    settings = ShardSettings(
        LOCAL_SHARD,
        PlacementMap(1, (ShardEntry(LOCAL_SHARD, ()),), ()),
        tuple(names),
        config.aspect_entries() if config else (),
        fetch_bytes_max=1 << 40,
    )
    host = open_host(settings, Path(path) if path is not None else None, clock=clock)
    try:
        client = _client(actor, ttl_s=config.ttl_s if config else TTL_S, observer=False)
        carrier = EmbeddedCarrier(host, client.session)
        options: dict[str, Any] = {} if clock is None else {"now_ns": clock.monotonic_ns}
        cell_client = CellClient(carrier, client, keep_alive=False, **options)
        welcome = cell_client.call(LOCAL_SHARD, client.hello(LOCAL_SHARD))
        if not isinstance(welcome, Welcome):
            raise LinkError(f"{type(welcome).__name__} came as the answer to Hello")
        cell_client.start(welcome)
    except BaseException:
        host.close()
        raise
    return Cell(config.name if config else LOCAL_SHARD, cell_client, host=host)


def _world_names(worlds: Sequence[str]) -> tuple[str, ...]:
    if isinstance(worlds, str):
        raise MisuseError(f"worlds={worlds!r} is one string; write worlds=[{worlds!r}]")
    return tuple(checked_as("world context", name) for name in worlds)


def _is_endpoint(target: str | Path) -> bool:
    """Say whether `target` is written as an endpoint; check its host and port.

    Raises:
        ConfigError: It is an endpoint with an invalid host or port.
    """
    if isinstance(target, Path):
        return False
    protocol, host, port = split_endpoint(target)
    if "/" not in target or protocol not in PROTOCOLS:
        return False
    if protocol == "unixsock-stream":
        return True
    if not host or not port.isdecimal() or not 0 < int(port) < 1 << 16:
        raise ConfigError(f"{target!r} has no host, or no port from 1 to 65535; {_ENDPOINT}")
    return True


def _refuse_no_file(target: str | Path) -> None:
    if not str(target) or not Path(target).exists():
        raise ConfigError(
            f"{str(target)!r} is neither a file nor an endpoint; {_ENDPOINT}, a cell is described"
            " in a cell.toml",
            path=str(target),
        )


_ENDPOINT: Final = "an endpoint looks like 'tcp/host:7447'"


def _checked_actor(actor: str) -> str:
    """Return a name that is safe in logs and tables.

    Raises:
        ConfigError: It has a control character, or is too long.
    """
    if is_safe(actor) and len(actor) <= NAME_CHARACTERS_MAX:
        return actor
    raise ConfigError(
        f"an actor cannot be called {shown(actor[:60])!r}: a name has at most"
        f" {NAME_CHARACTERS_MAX} characters, and no line breaks or other control characters"
    )


def _client(actor: str, *, ttl_s: float, observer: bool) -> Client:
    return Client(
        secrets.token_hex(16),
        ttl_ns=int(ttl_s * 1e9),
        actor=_checked_actor(actor) or shown(Path(sys.argv[0] or "python").stem) or "python",
        host=socket.gethostname(),
        pid=os.getpid(),
        observer=observer,
    )
