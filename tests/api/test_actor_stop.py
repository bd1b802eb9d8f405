"""A stopped actor stops: also while it waits for its lock."""

import threading

import pytest

from enact_dist.access.lock import Lock
from enact_dist.actor.actor import Actor
from enact_dist.actor.running.runner import ActorRun
from enact_dist.terms import Aspect, Entity, World, Write

COUNT, BENCH = Aspect("count", int), Entity("bench")
STOP_S = 60.0
"""What a busy machine may take; the wait for the lock would be ten minutes."""


class Counter(Actor):
    """Count once."""

    online = World("online")
    count = Write(online, BENCH, COUNT)
    wait_s = 600.0

    def update(self, lock):
        lock[self.count] = 1


@pytest.mark.carrier("local")
def test_actor_ends_when_stopped_in_a_lock_wait(cell, online):
    """`stop` ends an attempt that waits for its lock; nothing waits at the shard, no refusal."""
    stop, ended = threading.Event(), []
    run = ActorRun(Counter(), cell, stop=stop)
    with Lock(Write(online, BENCH, COUNT)):
        thread = threading.Thread(target=lambda: ended.append(run.run()))
        thread.start()
        while not any(not info.granted for info in cell.locks()):
            assert thread.is_alive()
        stop.set()
        thread.join(STOP_S)
        assert not thread.is_alive()
        assert [info.granted for info in cell.locks()] == [True]
    assert ended[0].state == "stopped"
    assert ended[0].updates == ended[0].refused == 0
