"""`enact shard move`: hands a shard over from the daemon that serves it to a standby."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Final

from enact_dist.cli.shard.shard import store_of
from enact_dist.cli.target import cell_config, open_cell
from enact_dist.cli.verbs import Output
from enact_dist.errors import ConfigError, StoreError

if TYPE_CHECKING:
    import argparse

    from enact_dist.world.cell import Cell

LOOK_S: Final = 0.01


def move_shard(options: argparse.Namespace) -> Output:
    """Ask for the hand-over, wait for it, and report how long the shard granted nothing.

    Raises:
        ConfigError: The cell has no store.
        StoreError: There is no such standby, or the shard went elsewhere or nowhere.
    """
    config = cell_config(options)
    config.shard(options.name)
    address = store_of(config, options.name)
    if address is None:
        raise ConfigError(
            f"{config.path} has no store, so no other daemon can serve shard {options.name}: a"
            " shard with a folder moves with `enact shard backup` and `enact shard restore`"
        )
    from enact_dist.link.postgres.address import require_driver

    require_driver(address.url)
    from enact_dist.link.postgres.moving import ask_to_move, holder_of

    with open_cell(options) as cell:
        move = ask_to_move(address, options.to)
        pause_s = _pause_s(cell, options.name, move.epoch, options.timeout_s)
    if pause_s is None:
        raise StoreError(
            f"shard {options.name} was not handed over within {options.timeout_s:g} s: process"
            f" {move.holder} was asked to give it to {move.to}; their logs and enact doctor say"
            " more"
        )
    holder = holder_of(address)
    if holder != move.to:
        raise StoreError(
            f"shard {options.name} went from {move.holder} to {holder} instead of {move.to}, which"
            " did not take it in time: look at its log"
        )
    row = {"shard": options.name, "from": move.holder, "to": holder, "pause_s": round(pause_s, 3)}
    text = f"shard {options.name}: from {move.holder} to {holder}, pause {pause_s:.2f} s"
    return Output(row, text)


def _pause_s(cell: Cell, shard: str, epoch: int, wait_s: float) -> float | None:
    """Return how long a shard granted nothing between two epochs; None: it is not over in time."""
    open_s = time.monotonic()
    end_s = open_s + wait_s
    while (now_s := time.monotonic()) < end_s:
        found = next(one for one in cell.shards() if one.name == shard)
        if found.reachable and found.open:
            if found.epoch > epoch:
                return time.monotonic() - open_s
            open_s = now_s
        time.sleep(LOOK_S)
    return None
