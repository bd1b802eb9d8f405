"""Steps of an actor whose commits fail, for tests of what the actor takes for done then."""

from contextlib import suppress
from copy import deepcopy

from enact_dist import testing
from enact_dist.errors import LeaseLostError

PENDING = "_pending_in_test"
"""Attribute by which `testing.run_once` knows what an actor has seen."""


def lose_commit(actor, cell, worlds=None):
    """Let an actor do its next step, and nothing of it be written; the step stays pending."""
    update, pending = actor.update, deepcopy(vars(actor).get(PENDING))

    def loses(lock):
        update(lock)
        raise LeaseLostError("the lease has ended", cause="lease expired")

    actor.update = loses
    with suppress(LeaseLostError):
        testing.run_once(actor, cell, worlds)
    del actor.update
    vars(actor).pop(PENDING, None)
    if pending is not None:
        vars(actor)[PENDING] = pending
