"""One datum into or out of a world context, for tests that are about something else."""

from enact_dist import Lock, View, ViewEach, Write


def put(world, entity, aspect, datum, stamp_ns=None):
    """Commit a datum; return its position."""
    request = Write(world, entity, aspect)
    with Lock(request) as lock:
        lock.put(request, datum, stamp_ns=stamp_ns)
    return lock.position


def delete(world, entity, aspect):
    """Commit null; return its position."""
    request = Write(world, entity, aspect)
    with Lock(request) as lock:
        del lock[request]
    return lock.position


def datum_of(world, entity, aspect):
    """Return a datum; null raises."""
    request = View(world, entity, aspect)
    return world.view(request)[request]


def get(world, entity, aspect, default=None):
    """Return a datum, or the default where it is null."""
    request = View(world, entity, aspect)
    return world.view(request).get(request, default)


def each(world, pattern, aspect):
    """Return the data of a pattern by entity."""
    request = ViewEach(world, pattern, aspect)
    return dict(world.view(request)[request])


def put_online(cell, entity, aspect, datum, stamp_ns=None):
    """Commit a datum to the world context `online` of a cell; return its position."""
    return put(cell.world("online"), entity, aspect, datum, stamp_ns)
