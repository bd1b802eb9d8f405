"""The settings of a shard daemon, and which of them a reload takes anew."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import chain
from typing import TYPE_CHECKING, Final

from enact_dist.errors import ConfigError
from enact_dist.link.zenoh.access import common_name, read_revoked
from enact_dist.link.zenoh.config import to_reach
from enact_dist.link.zenoh.endpoints import split_endpoint

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from enact_dist.core.shard.state import ShardSettings
    from enact_dist.link.postgres.address import StoreAddress
    from enact_dist.link.zenoh.tls import KeyFiles

DRAIN_S: Final = 0.8
"""Default time for holders to finish; together with the rest it stays below 2 s."""


@dataclass(frozen=True, slots=True)
class DaemonSettings:
    """The settings of a shard daemon.

    Attributes:
        shard: The settings of the shard, with its name and the endpoints for clients.
        listen: Endpoints to listen at ("tcp/0.0.0.0:7447").
        folder: Its data folder; None keeps data in memory only.
        log: "text" or "json" (one object per line, see `link.log`).
        link_lease_s: A connection counts as lost after this time without a sign of life.
        carrier: How clients of this host may reach it.  "auto": also over a socket, if one can be
            made; "socket": it is an error if none can be made; "zenoh": no socket.
        shared_bytes_max: Byte limit of large data in memory shared on this host.  Beyond it,
            history is removed, then writes are refused.  None: half of the file system there, and
            plain memory beyond; 0: nothing is shared.
        drain_s: How long holders may still take to finish after a signal.
        metrics: Host and port for Prometheus, see `link.daemon.metrics`; None: no server.
        written: The shard's endpoints in `cell.toml`, even if this start overrides them.
        keys: The files by which the shard proves its name, in a cell with keys.
        names: Names of clients that have a key.
        again: Reads the settings anew; a reload takes keys, names and rights from them.
        store: Its place in a database, in place of a folder.
        standby: Whether it waits for the end of another daemon that serves the shard.
    """

    cell: str
    shard: ShardSettings
    listen: tuple[str, ...]
    folder: Path | None = None
    log: str = "text"
    link_lease_s: float = 1.0
    carrier: str = "auto"
    shared_bytes_max: int | None = None
    drain_s: float = DRAIN_S
    metrics: tuple[str, int] | None = None
    written: tuple[str, ...] = ()
    keys: KeyFiles | None = None
    names: tuple[str, ...] = ()
    again: Callable[[], DaemonSettings] | None = None
    store: StoreAddress | None = None
    standby: bool = False

    @property
    def change(self) -> bool:
        """Whether a reload has anything to take."""
        return self.keys is not None or self.shard.rights is not None

    @property
    def common_names(self) -> dict[str, str] | None:
        """The common names of the clients' certificates by their names; None without keys.

        Raises:
            ConfigError: The list of revoked keys cannot be used.
        """
        if self.keys is None:
            return None
        revoked = read_revoked(self.keys.folder)
        return {name: common_name(name, revoked.get(name, 0)) for name in self.names}

    @property
    def hosts(self) -> tuple[str, ...]:
        """Where it serves; every address of its host counts as the loopback."""
        own = [
            entry.endpoints
            for entry in self.shard.placement.shards
            if entry.name == self.shard.name
        ]
        places = map(to_reach, chain(self.listen, *own))
        return tuple(dict.fromkeys(split_endpoint(place)[1].strip("[]") for place in places))

    def read_again(self) -> DaemonSettings:
        """Return the settings with keys, names and rights as their files have them now.

        Raises:
            ConfigError: They cannot be read, or the shard would have to be started again.
        """
        new = self.again() if self.again is not None else self
        for what, had, has in (
            ("[security] keys", self.keys, new.keys),
            ("[rights]", self.shard.rights, new.shard.rights),
        ):
            if (had is None) != (has is None):
                change = "removed" if has is None else "added"
                raise ConfigError(f"{what} was {change}: that takes a restart of the shard")
        shard = replace(self.shard, rights=new.shard.rights)
        return replace(self, shard=shard, names=new.names, keys=new.keys)
