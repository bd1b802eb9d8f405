"""The bench `layers` sees every layer of an update, once, and leaves no watch behind."""

from functools import partial
from types import SimpleNamespace

import pytest

from enact_dist import local
from enact_dist.bench.cases import layers
from enact_dist.bench.cases.layers import (
    CALLS,
    CLIENT,
    DECISIONS,
    DECODED,
    FETCHED,
    HOST,
    LOCK,
    TOUCHED,
    LayerWatch,
    Profile,
    layer_times_us,
)
from enact_dist.bench.cases.payloads import entity, fetch, floats, store
from enact_dist.bench.cases.updates import slots, update
from enact_dist.bench.floors import QUERY
from enact_dist.core.protocol.messages import Acquire, Commit, Committed, Granted
from enact_dist.core.shard.shard import Shard
from enact_dist.link.client.locks import CellClient


@pytest.fixture
def world():
    """Return a world context of a shard in this process."""
    with local(worlds=["bench"]) as cell:
        yield cell.world("bench")


def test_every_layer_has_its_own_time(world):
    """Lock, client, host and decisions each take a part of every update, and no more than all."""
    (write,) = slots(world, 1)

    profile = Profile("update", world, lambda: update((write,)), QUERY)
    own_us, messages = layer_times_us(profile, seconds_s=0.05)

    assert set(own_us) == {LOCK, CLIENT, HOST, DECISIONS}
    assert len({len(times_us) for times_us in own_us.values()}) == 1
    assert all(min(times_us) > 0.0 for times_us in own_us.values())
    assert [type(message) for message in messages] == [Acquire, Granted, Commit, Committed]


def test_fetch_shows_its_datum_beside_the_layers(world):
    """How the datum came, its decoding and its first touch are parts of their own."""
    of = entity("1 kB")
    store(world, of, floats(1_024))
    begun = []

    profile = Profile(
        "fetch", world, partial(fetch, world, of), QUERY, lambda: begun.append(1), of_datum=True
    )
    own_us, _ = layer_times_us(profile, seconds_s=0.01)

    assert set(own_us) == {LOCK, CLIENT, HOST, DECISIONS, FETCHED, DECODED, TOUCHED}
    assert len(begun) == len(own_us[DECODED]) + 1  # an act that is not counted comes first


def test_own_time_is_without_that_of_inner_layers(monkeypatch):
    """An outer call of 3 ms with an inner one of 20 ms has 3 ms of its own, not 23."""
    watch, clock_ns = LayerWatch(), [0]
    monkeypatch.setattr(layers, "time", SimpleNamespace(perf_counter_ns=lambda: clock_ns[0]))

    class Layered:
        @staticmethod
        def inner():
            clock_ns[0] += 20_000_000

    def outer():
        clock_ns[0] += 3_000_000
        Layered.inner()

    with watch.over(Layered, "inner", DECISIONS):
        watch.counted(CLIENT, outer)

    assert watch.spent_ns == {DECISIONS: 20_000_000, CLIENT: 3_000_000}


def test_watch_counts_inner_calls_once_and_is_taken_off(world):
    """A watched method does what it did, is counted while watched only, and as the outer one."""
    (write,) = slots(world, 1)
    acquire, handle = CellClient.acquire, Shard.handle
    watch = LayerWatch()

    with watch.over(CellClient, "acquire", CLIENT), watch.over(Shard, "handle", DECISIONS):
        update((write,))
        spent_ns = dict(watch.spent_ns)
    update((write,))

    assert watch.spent_ns == spent_ns
    assert set(spent_ns) == {CLIENT, DECISIONS}
    assert CALLS not in spent_ns
    assert (CellClient.acquire, Shard.handle) == (acquire, handle)
