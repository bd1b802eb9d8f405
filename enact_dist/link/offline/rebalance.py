"""Moves entities between the folders of a stopped cell according to its placement.

::

    all folders opened and marked ─> epochs raised ─> shared records copied
      ─> batch by batch: the new shard has it durably ─> the old one forgets it ─> marks removed

See `link.offline.cell`.  Rules that a change must keep:

- Before anything moves, all epochs rise above the highest one: an entity's fencing numbers then
  grow on its new shard too, and no client confuses old and new versions.
- A client that was disconnected while holding a lock may believe in it for a TTL.  So the marks
  stay until all folders have been locked for the longest TTL of the sessions that had not ended.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Mapping
from itertools import groupby
from pathlib import Path
from typing import Final, NamedTuple, Protocol

from enact_dist.core.offline.moving import Move, MovePlan, Shards
from enact_dist.core.protocol.messages import PlacementMap
from enact_dist.core.protocol.records import Recovered
from enact_dist.link.folder.moving_marks import mark, under_way, unmark
from enact_dist.link.offline.cell import SILENT, opened, refuse_obstacles, write
from enact_dist.link.store.store import Store

BATCH_BYTES: Final = 32 << 20
"""About so many bytes move at once; a larger entity moves alone."""
BATCH_STATES: Final = 2_000


class Progress(Protocol):
    """Reports the progress of a rebalance."""

    def act(self, name: str) -> None:
        """Take the next step; it is durable before the one after."""

    def moved(self, entities: int, size: int) -> None:
        """Take the number of entities and bytes that are in their final place."""

    def waits(self, wait_s: float) -> None:
        """Take the remaining wait for leases from before the stop."""


class Rebalance(NamedTuple):
    """What was done, or would be.

    Attributes:
        moves: The entities that move, in order.
        resumed: Whether an earlier run was interrupted.
        waited_s: Time spent waiting for leases from before the stop.
    """

    moves: list[Move]
    resumed: bool
    waited_s: float = 0.0


def look(folders: Mapping[str, Path], placement: PlacementMap) -> Rebalance:
    """Return what `rebalance` would do, without changing anything.

    Raises:
        StoreError: As `rebalance`.
    """
    with opened(folders) as (_, stored):
        resumed = bool(under_way(folders))
        plan = Shards(stored, placement, under_way=resumed).plan()
    refuse_obstacles("nothing was moved", plan.obstacles)
    return Rebalance(plan.moves, resumed)


def rebalance(
    folders: Mapping[str, Path],
    placement: PlacementMap,
    *,
    unix_s: int,
    progress: Progress | None = None,
) -> Rebalance:
    """Move every entity to its shard under `placement`.

    Args:
        folders: The folder of each shard: all of the placement, and those that leave the cell.
        placement: The new placement of entities.
        unix_s: The wall clock, seconds since 1970.
        progress: Receives the progress.

    Raises:
        StoreError: A folder is in use, damaged or cannot be written, folders of an earlier run are
            missing, or something would be lost; the message says what to do.
    """
    progress = progress or SILENT
    with opened(folders, progress.act, unix_s=unix_s) as (stores, stored):
        locked_s = time.monotonic()
        resumed = bool(under_way(folders))
        shards = Shards(stored, placement, under_way=resumed)
        plan = shards.plan()
        refuse_obstacles("nothing was moved", plan.obstacles)
        if plan.moves or plan.first or resumed:
            mark(folders, progress.act)
        carry_out(shards, plan, stores, stored, progress)
        wait_s = 0.0
        if plan.moves or resumed:
            wait_s = wait_for_leases(stored, locked_s, progress)
        unmark(folders, progress.act)
    return Rebalance(plan.moves, resumed, wait_s)


def carry_out(
    shards: Shards,
    plan: MovePlan,
    stores: Mapping[str, Store],
    stored: Mapping[str, Recovered],
    progress: Progress,
) -> None:
    """Raise all epochs, tell each shard what all must know, and move the entities."""
    if not plan.moves and not plan.first:
        return
    epoch = max(found.epoch for found in stored.values())
    for name, store in stores.items():
        progress.act(f"raise the epoch of {name}")
        store.raise_epoch(epoch)
    for name, records in plan.first.items():
        progress.act(f"tell {name}")
        write(stores[name], records)
    _move(shards, plan.moves, stores, progress)


def wait_for_leases(stored: Mapping[str, Recovered], locked_s: float, progress: Progress) -> float:
    """Wait until no client can believe in a lock from before `locked_s`; return how long."""
    ttl_ns = max((s.ttl_ns for found in stored.values() for s in found.sessions), default=0)
    wait_s = max(0.0, locked_s + ttl_ns / 1e9 - time.monotonic())
    progress.waits(wait_s)
    time.sleep(wait_s)
    return wait_s


def _move(
    shards: Shards, moves: Iterable[Move], stores: Mapping[str, Store], progress: Progress
) -> None:
    count = size = 0
    for batch in _batches(moves):
        first, entities = batch[0], tuple(move.entity for move in batch)
        source, target = first.source, first.target
        if not first.copied:
            progress.act(f"copy {first.entity} to {target}")
            write(stores[target], shards.brought(target, entities, source))
        progress.act(f"forget {first.entity} on {source}")
        write(stores[source], shards.left(source, entities))
        progress.act(f"unlink on {source}")
        stores[source].rest()
        stores[target].rest()
        count, size = count + len(batch), size + sum(move.size for move in batch)
        progress.moved(count, size)


def _batches(moves: Iterable[Move]) -> Iterator[list[Move]]:
    """Yield batches of moves, with entities that are already copied last."""
    ordered = sorted(moves, key=lambda move: (move.copied, move.source, move.target))
    for _, group in groupby(ordered, key=lambda move: (move.copied, move.source, move.target)):
        batch: list[Move] = []
        states = size = 0
        for move in group:
            states, size = states + move.states, size + move.size
            if batch and (size > BATCH_BYTES or states > BATCH_STATES):
                yield batch
                batch, states, size = [], move.states, move.size
            batch.append(move)
        yield batch
