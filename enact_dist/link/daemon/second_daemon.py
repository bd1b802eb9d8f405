"""Refuses the start of a shard that another daemon serves already."""

from __future__ import annotations

from itertools import chain
from typing import TYPE_CHECKING, Final

from enact_dist.errors import LinkError
from enact_dist.link.client.duplicate_daemons import (
    expected_places,
    moved_places,
    serving,
    two_daemons,
)
from enact_dist.link.zenoh.config import to_reach
from enact_dist.link.zenoh.discovery import FoundShard, find_shards
from enact_dist.link.zenoh.endpoints import somebody_listens

if TYPE_CHECKING:
    from enact_dist.link.daemon.settings import DaemonSettings

PROBE_S: Final = 0.3
"""How long another daemon with our name may take to answer before we start."""


def refuse_second_daemon(settings: DaemonSettings, *, probe_s: float | None = None) -> None:
    """Raise if a daemon already serves this shard at one of its endpoints for clients.

    Other running shards of the cell are asked where they expect it.  Two daemons may be there for a
    shard in a database, which lets one of them serve.

    Raises:
        LinkError: A daemon does, or another shard of the cell runs twice.
        ConfigError: An endpoint cannot be read.
    """
    probe_s = PROBE_S if probe_s is None else probe_s
    name, cell = settings.shard.name, settings.cell
    shards = settings.shard.placement.shards
    expected = {entry.name: entry.endpoints for entry in shards}
    ours = (*settings.listen, *expected.get(name, ()), *settings.written)
    listening = [place for place in dict.fromkeys(map(to_reach, ours)) if somebody_listens(place)]
    keys = settings.keys
    found = find_shards(listening, timeout_s=probe_s, keys=keys) if listening else ()
    if FoundShard(cell, name) in found and settings.store is None:
        raise LinkError(
            f"shard {name} of cell {cell} already runs at {' or '.join(listening)}; two daemons"
            " must not serve one shard: stop the other, or give this one another name"
        )
    others = [entry for entry in shards if entry.name != name]
    reported = expected_places(cell, others, timeout_s=probe_s, keys=keys) if others else ()
    for shard, places in moved_places(expected, chain.from_iterable(reported)).items():
        daemons = serving(cell, shard, places, timeout_s=probe_s, keys=keys)
        if shard == name and daemons and settings.store is None:
            raise LinkError(
                f"shard {name} of cell {cell} already runs at {daemons[0]}, where other shards of"
                f" the cell expect it; this start would listen at {', '.join(settings.listen)};"
                " two daemons must not serve one shard: stop the other first, and let the cell.toml"
                " of every shard name the same endpoint"
            )
        if len(daemons) > 1:
            raise LinkError(two_daemons(cell, shard, daemons))
