"""What tests of forks and of dropped contexts share: requests to one shard, and its slots."""

from __future__ import annotations

from itertools import count

from shard_bench import lock_id, slot

from enact_dist.core.protocol.messages import (
    DropWorld,
    Fork,
    Item,
)
from enact_dist.terms import Access

W, V = Access.WRITE, Access.VIEW
LOCKS = count(1)


def write(bench, value, to=None):
    """Set a slot (None: to null) and return the stamp of the commit."""
    to = to or slot()
    lock = lock_id("ann", 1, next(LOCKS))
    grant = bench.granted(lock, Item(W, *to))
    return bench.commit(lock, grant.token, (to, value)).position.stamp_ns


def fork(bench, world="what_if", source="online", at_ns=None):
    """Fork a world context, as of now where nothing else is said."""
    at_ns = bench.shard.state.stamp() if at_ns is None else at_ns
    return bench.ask(Fork("ann", world, source, at_ns))


def drop(bench, world="what_if"):
    """Drop a world context."""
    return bench.ask(DropWorld("ann", world))


def of(world, entity="piece", aspect="count"):
    """Return a slot of a world context."""
    return slot(entity, aspect, world)


def content(bench, where):
    """Return the newest state of a slot."""
    return bench.shard.state.slots[where]
