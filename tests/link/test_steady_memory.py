"""A shard and its clients that have warmed up take no memory for what they do over and over.

The interpreter keeps up to 2,000 tuples of each length that it would else free.  One that is made
of an iterator (`tuple(map(…))`, `f(*generator)`, `_replace` of a named tuple) never comes from
there and goes there in the end, so that each message adds to them until they are full, for minutes
at 10 Hz.  One that is made of a list, a tuple or a display comes from there and goes back.
"""

from __future__ import annotations

import gc
import sys

import numpy as np
import pytest

from enact_dist import Aspect, Durability, Entity, Lock, View, Write, connect
from enact_dist.core.client.lease_clock import SENDINGS_KEPT
from enact_dist.core.state import grants as tenures
from enact_dist.core.state import history
from enact_dist.link.daemon.daemon import start_shard
from enact_dist.link.daemon.settings import DaemonSettings
from enact_dist.link.memory.maps import leftovers

CLOUD = Aspect("cloud", np.ndarray, Durability.VOLATILE, retention=1)
NUMBER = Aspect("number", int, Durability.VOLATILE, retention=1)
ROUNDS = 600
BLOCKS_MAX = ROUNDS // 3
"""One block that stays in each round would be three times that; threads beside it take a few."""


@pytest.fixture
def online(make_settings, endpoint, monkeypatch):
    """A world context of one shard, both in this process."""
    monkeypatch.setattr(tenures, "STALE_ENDS_MAX", 16)
    monkeypatch.setattr(history, "LOOSE_NS", 0)
    shard = start_shard(
        DaemonSettings("cell", make_settings("s0", endpoints=(endpoint,)), (endpoint,))
    )
    cell = connect(endpoint)
    yield cell.create_world("online")
    cell.close()
    shard.stop(drain_s=0.0)


def publishing(online):
    """Return a step that writes an array too large for a message."""
    write, array = Write(online, Entity("tray"), CLOUD), np.zeros(100_000, np.uint8)

    def step(number):
        with Lock(write) as lock:
            lock.put(write, array, stamp_ns=number + 1)

    return step


def counting(online):
    """Return a step that counts on, read from a view before, while somebody watches others."""
    write, view = (kind(online, Entity("door"), NUMBER) for kind in (Write, View))

    def step(_):
        online.view(view)
        with Lock(write) as lock:
            lock[write] = lock.get(write, 0) + 1

    return step


def blocks():
    """Return how many blocks the interpreter has, once all maps that are over are gone."""
    assert leftovers().wait(30.0)
    return sys.getallocatedblocks()


@pytest.mark.parametrize("kind", [publishing, counting])
def test_rounds_take_no_memory_when_all_has_warmed_up(online, kind):
    """Nothing that both ends do in a lock, a view or a commit leaves a block behind."""
    step = kind(online)
    with online.watch(Entity("elsewhere"), NUMBER):
        for number in range(SENDINGS_KEPT):
            step(number)
        gc.collect()  # empties the free lists
        for number in range(ROUNDS):
            step(number)  # what is alive at a time goes through them

        def grown():
            before = blocks()
            for number in range(ROUNDS):
                step(number)
            return blocks() - before

        # What a machine that stood still wrote to the log stays for pytest; no round adds to it.
        assert any(grown() < BLOCKS_MAX for _ in range(3))
