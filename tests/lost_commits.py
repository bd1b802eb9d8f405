"""A step of an actor whose commit fails, for tests of what the actor takes for done then."""

from contextlib import suppress

from enact_dist.actor.binding import BoundActor
from enact_dist.errors import LeaseLostError


def lose_commit(actor, cell, entity=None, *, members=(), tick_ns=0):
    """Let an actor do what is pending, and nothing of it be written."""
    lock = BoundActor(actor, cell).lock(entity, members=members, tick_ns=tick_ns)
    with suppress(LeaseLostError), lock:
        actor.update(lock)
        raise LeaseLostError("the lease has ended", cause="lease")
