"""Views without a lock keep their large data: as much as the lanes of a session, not more."""

import pytest
from shard_bench import ShardBench, item, lock_id, slot

from enact_dist.core.protocol.datum import Datum
from enact_dist.core.protocol.messages import (
    Commit,
    Fetch,
    Gone,
    Release,
    Slice,
    TakeView,
    WriteItem,
)
from enact_dist.core.state.sessions import LANES_MAX
from enact_dist.terms import Access

SIZE = 300_000


@pytest.fixture
def bench():
    """A shard with one datum that answers only name."""
    bench = ShardBench()
    bench.hello("ann", "bob")
    write(bench, 1, b"1")
    return bench


def write(bench, seq, byte):
    grant = bench.granted(lock_id("bob", 7, seq), item(Access.WRITE))
    data = Datum(b"t", byte * SIZE, SIZE)
    bench.ask(Commit(grant.lock, grant.token, (WriteItem(slot(), data),), 0))


def view(bench, session, lane, seq=2):
    bench.ask(TakeView(lock_id(session, lane, seq), 1, 1, 0, (item(Access.VIEW),), 0))


def pinned(bench, session):
    return [lock for lock in bench.shard.state.pins if lock.session == session]


def test_views_in_ever_new_lanes_displace_the_oldest_of_their_own_session(bench):
    """Another client's stay; a shard was filled and slowed down for all before."""
    view(bench, "bob", 0)
    for lane in range(LANES_MAX + 20):
        view(bench, "ann", lane)

    assert len(pinned(bench, "ann")) == LANES_MAX
    assert lock_id("ann", 0, 2) not in pinned(bench, "ann")
    assert pinned(bench, "bob") == [lock_id("bob", 0, 2)]
    assert bench.counter("views_displaced") == 20


def test_views_of_one_lane_take_no_more_than_the_lanes_do(bench):
    """Older ones of the lane go first, and that is no loss: their client has gone on."""
    view(bench, "ann", 1)
    for seq in range(2, LANES_MAX + 50):
        view(bench, "ann", 0, seq)

    assert len(pinned(bench, "ann")) <= LANES_MAX
    assert lock_id("ann", 1, 2) in pinned(bench, "ann")
    assert bench.counter("views_displaced") == 0


def test_view_shows_what_it_has_named_until_it_is_released(bench):
    """Whatever is written meanwhile."""
    view(bench, "ann", 0)
    write(bench, 2, b"2")
    fetch = Fetch(lock_id("ann", 0, 2), 1, slot(), 1, 0, SIZE)

    found = bench.ask(fetch)
    bench.ask(Release(lock_id("ann", 0, 2)))

    assert isinstance(found, Slice)
    assert not pinned(bench, "ann")
    assert isinstance(bench.ask(fetch), Gone)
