"""Opens a shard's folder and runs the shard in it."""

from __future__ import annotations

import logging
from contextlib import ExitStack
from typing import TYPE_CHECKING

from enact_dist.core.protocol.records import Recovered
from enact_dist.core.shard.shard import Shard
from enact_dist.core.state.catalogue import REMEDY
from enact_dist.core.state.clock import unkept_epoch
from enact_dist.link.clock import Clock, SystemClock
from enact_dist.link.host import ShardHost

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from enact_dist.core.shard.state import ShardSettings
    from enact_dist.link.memory.shared_folder import SharedFolder

_log = logging.getLogger("enact.shard")


def open_host(
    settings: ShardSettings,
    folder: Path | None,
    *,
    clock: Clock | None = None,
    on_failure: Callable[[Exception], None] | None = None,
    shared: SharedFolder | None = None,
    payload_bytes_max: int | None = None,
) -> ShardHost:
    """Open a shard's folder and run the shard; without a folder no data outlive the process.

    Raises:
        StoreError: The folder is in use, unreadable or corrupt, or holds entities of other shards.
    """
    clock = clock or SystemClock()
    wall_ns = clock.wall_ns()
    if folder is None:
        store, recovered = None, Recovered(epoch=unkept_epoch(wall_ns))
    else:
        from enact_dist.link.folder.folder import refuse_far_stamps, refuse_strangers
        from enact_dist.link.store.store import open_store

        store, recovered = open_store(folder, unix_s=wall_ns // 1_000_000_000)
        with ExitStack() as undo:
            undo.callback(store.close)
            refuse_strangers(folder, recovered, settings.name, settings.placement)
            refuse_far_stamps(folder, recovered, wall_ns=wall_ns)
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
