"""Which shard owns an entity: a pure function of its name and the cell's placement map.

Pins come first, in order; every other entity goes to the shard with the highest score by
rendezvous hashing (Thaler and Ravishankar 1998): when a shard is added, only the entities that it
wins move.
"""

from __future__ import annotations

from hashlib import blake2b
from typing import TYPE_CHECKING

from enact_dist.patterns import pattern_matches

if TYPE_CHECKING:
    from enact_dist.core.protocol.messages import PlacementMap


def shard_of(entity: str, placement: PlacementMap) -> str:
    """Return the name of the shard that owns `entity`.

    Raises:
        ValueError: The placement names no shard.
    """
    for pin in placement.pins:
        if pattern_matches(pin.pattern, entity):
            return pin.shard
    if len(placement.shards) == 1:
        return placement.shards[0].name
    if not placement.shards:
        raise ValueError("the placement map names no shard")
    names = [shard.name for shard in placement.shards]
    scores = (blake2b(f"{name}\0{entity}".encode(), digest_size=8).digest() for name in names)
    return max(zip(scores, names, strict=True))[1]
