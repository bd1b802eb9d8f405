"""Counts in and out of world contexts, now and in the past."""

import slots

from enact_dist import Aspect

COUNT = Aspect("count", int)


def put(world, entity, value, aspect=COUNT, *, stamp_ns=None):
    """Commit a count; return its position."""
    return slots.put(world, entity, aspect, value, stamp_ns)


def delete(world, entity, aspect=COUNT):
    """Commit null; return its position."""
    return slots.delete(world, entity, aspect)


def value_of(world, entity, aspect=COUNT):
    """Return a count; null raises."""
    return slots.datum_of(world, entity, aspect)
