"""Opens a shard's folder, or its place in a database, and runs the shard in it."""

from __future__ import annotations

import logging
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

from enact_dist.core.protocol.records import Recovered
from enact_dist.core.shard.shard import Shard
from enact_dist.core.state.catalogue import REMEDY
from enact_dist.core.state.clock import unkept_epoch
from enact_dist.link.clock import Clock, SystemClock
from enact_dist.link.host import ShardHost

if TYPE_CHECKING:
    from collections.abc import Callable

    from enact_dist.core.shard.state import ShardSettings
    from enact_dist.link.memory.shared_folder import SharedFolder
    from enact_dist.link.postgres.address import FreeShard
    from enact_dist.link.store.store import Store

_log = logging.getLogger("enact.shard")


def open_host(
    settings: ShardSettings,
    place: Path | FreeShard | None,
    *,
    clock: Clock | None = None,
    on_failure: Callable[[Exception], None] | None = None,
    shared: SharedFolder | None = None,
    payload_bytes_max: int | None = None,
) -> ShardHost:
    """Open a shard's place and run the shard; without a place no data outlive the process.

    The place is a folder, or the shard in a database that was found free; see `ShardHost` for the
    other arguments.

    Raises:
        StoreError: The place is in use, unreadable or corrupt, or holds entities of other shards.
    """
    clock = clock or SystemClock()
    wall_ns = clock.wall_ns()
    if place is None:
        store, recovered = None, Recovered(epoch=unkept_epoch(wall_ns))
    else:
        from enact_dist.link.folder.folder import (
            holds_store,
            refuse_far_stamps,
            refuse_strangers,
            warn_of_others,
        )

        if isinstance(place, Path) and not holds_store(place):
            warn_of_others(place, settings.name, settings.placement)
        store, recovered, where = _opened(place, wall_ns // 1_000_000_000)
        with ExitStack() as undo:
            undo.callback(store.close)
            refuse_strangers(where, recovered, settings.name, settings.placement)
            refuse_far_stamps(where, recovered, wall_ns=wall_ns)
            undo.pop_all()
    shard = Shard(settings, recovered, now_ns=clock.monotonic_ns(), wall_ns=wall_ns)
    if left_out := shard.state.catalogue.shown().left_out:
        what = "world contexts and aspects do not fit into the catalogue sent to clients"
        _log.warning("shard %s: %d %s; %s", settings.name, left_out, what, REMEDY)
    return ShardHost(
        shard,
        store=store,
        clock=clock,
        on_failure=on_failure,
        shared=shared,
        payload_bytes_max=payload_bytes_max,
    )


def _opened(place: Path | FreeShard, unix_s: int) -> tuple[Store, Recovered, Path | str]:
    """Return the store at a place, what it holds, and the place as messages name it."""
    if isinstance(place, Path):
        from enact_dist.link.store.store import open_store

        return *open_store(place, unix_s=unix_s), place
    from enact_dist.link.postgres.opening import open_database

    return *open_database(place, unix_s=unix_s), str(place.address)
