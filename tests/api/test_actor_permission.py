"""An actor that may not do what it asked ends: nothing changes by asking again."""

import threading

import pytest

from enact_dist import Actor, Aspect, Entity, World, Write, local
from enact_dist.actor.running.runner import run_actor
from enact_dist.errors import PermissionDeniedError

pytestmark = pytest.mark.carrier("auto")


def test_actor_in_the_session_of_another_ends_at_once():
    """Its update is not run a second time, though its period goes on."""
    tried = []

    class Foreign(Actor):
        count = Write(World("online"), Entity("system"), Aspect("count", int))
        every_s = 0.002

        def update(self, lock):
            tried.append(lock)
            raise PermissionDeniedError("session a1b2 belongs to camera@robot:7; eve@h:1 asked")

    with (
        local(worlds=["online"]) as cell,
        pytest.raises(PermissionDeniedError, match="belongs to camera@robot:7"),
    ):
        run_actor(Foreign(), cell, stop=threading.Event())

    assert len(tried) == 1
