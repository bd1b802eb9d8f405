"""The bench `layers` sees every layer of an update, once, and leaves no watch behind."""

import pytest

from enact_dist import local
from enact_dist.bench.layers import (
    CALLS,
    CLIENT,
    DECISIONS,
    HOST,
    LOCK,
    Watch,
    layer_times_us,
)
from enact_dist.bench.updates import slots, update
from enact_dist.core.messages import Acquire, Commit, Committed, Granted
from enact_dist.core.shard import Shard
from enact_dist.link.client import CellClient


@pytest.fixture
def world():
    """Return a world context of a shard in this process."""
    with local(worlds=["bench"]) as cell:
        yield cell.world("bench")


def test_every_layer_has_its_own_time(world):
    """Lock, client, host and decisions each take a part of every update, and no more than all."""
    (write,) = slots(world, 1)

    own_us, messages = layer_times_us(lambda: update((write,)), world, seconds_s=0.05)

    assert list(own_us) == [LOCK, CLIENT, HOST, DECISIONS]
    assert len({len(times_us) for times_us in own_us.values()}) == 1
    assert all(min(times_us) > 0.0 for times_us in own_us.values())
    assert [type(message) for message in messages] == [Acquire, Granted, Commit, Committed]


def test_watch_counts_inner_calls_once_and_is_taken_off(world):
    """A watched method does what it did, is counted while watched only, and as the outer one."""
    (write,) = slots(world, 1)
    acquire, handle = CellClient.acquire, Shard.handle
    watch = Watch()

    with watch.over(CellClient, "acquire", CLIENT), watch.over(Shard, "handle", DECISIONS):
        update((write,))
        spent_ns = dict(watch.spent_ns)
    update((write,))

    assert watch.spent_ns == spent_ns
    assert set(spent_ns) == {CLIENT, DECISIONS}
    assert CALLS not in spent_ns
    assert (CellClient.acquire, Shard.handle) == (acquire, handle)
