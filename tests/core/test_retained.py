"""Retention: the last versions of a slot, found by when they were captured, bounded, pinned."""

from __future__ import annotations

import pytest
from shard_bench import TTL_NS, ShardBench, item, lock_id, slot

from enact_dist.core.client.client import Client
from enact_dist.core.protocol.datum import Datum
from enact_dist.core.protocol.messages import (
    AspectEntry,
    Commit,
    Fetch,
    Gone,
    Granted,
    Item,
    ListSessions,
    Refused,
    Registered,
    Release,
    Sessions,
    ShardEntry,
    Slice,
    SlotState,
    Survey,
    Surveyed,
    TakeView,
    Viewed,
    WriteItem,
)
from enact_dist.core.protocol.parts import NO_LIMIT
from enact_dist.core.state.slots import INLINE_BYTES_MAX
from enact_dist.terms import Access, NullReason

W, V = Access.WRITE, Access.VIEW
KEPT = 3
LARGE = INLINE_BYTES_MAX + 1


@pytest.fixture
def cameras() -> ShardBench:
    """A shard whose frames retain three versions, with two sessions."""
    bench = ShardBench()
    bench.register(AspectEntry("mask", "int", "volatile", KEPT))
    bench.hello("ann", "bob")
    return bench


def capture(bench: ShardBench, seq: int, stamp_ns: int, *, size: int = 1) -> None:
    """Write one mask that was captured at a stamp; `seq` is the number of the write, from 1."""
    lock, body = lock_id("ann", 1, seq), bytes([seq]) * size
    grant = bench.granted(lock, item(W, "cam", "mask"))
    write = WriteItem(slot("cam", "mask"), Datum(b"t", body, size, stamp_ns))
    bench.ask(Commit(lock, grant.token, (write,), 0))


def retained(bench: ShardBench, aspect: str = "mask") -> int:
    """Return how many versions an aspect retains."""
    return bench.shard.state.catalogue.policies[aspect].limits.versions


def viewed(bench: ShardBench, stamp_ns: int, *, seq: int = 1, at_ns: int = 0) -> SlotState:
    """Return what a view of the mask at a capture stamp shows."""
    asked = item(V, "cam", "mask")._replace(captured_ns=stamp_ns)
    count = bench.next_count("bob")
    answer = bench.ask(TakeView(lock_id("bob", 0, seq), 1, 1, count, (asked,), 0, at_ns))
    assert isinstance(answer, Viewed), answer
    (state,) = answer.states
    return state


def test_last_versions_are_found_by_their_capture_stamp(cameras):
    """As many as the aspect retains, the newest included; each with its version."""
    for seq, stamp_ns in enumerate((100, 200, 300, 400), 1):
        capture(cameras, seq, stamp_ns)

    found = [viewed(cameras, stamp_ns) for stamp_ns in (200, 300, 400)]

    assert [(s.version, s.captured_ns) for s in found] == [(2, 200), (3, 300), (4, 400)]
    assert [bytes(s.datum.body) for s in found if s.datum] == [b"\x02", b"\x03", b"\x04"]
    assert viewed(cameras, 100).null_reason == NullReason.OUTSIDE_RETENTION.name
    assert viewed(cameras, 250).null_reason == NullReason.OUTSIDE_RETENTION.name


def test_aspect_that_retains_nothing_shows_only_its_newest_version(cameras):
    """Whoever says so gets no history."""
    cameras.register(AspectEntry("frame", "int", "volatile", 1))
    for seq in (1, 2):
        grant = cameras.granted(lock_id("ann", 1, seq), item(W, "cam", "frame"))
        write = WriteItem(slot("cam", "frame"), Datum(b"t", b"x", 1, 100 * seq))
        cameras.ask(Commit(lock_id("ann", 1, seq), grant.token, (write,), 0))
    asked = [item(V, "cam", "frame")._replace(captured_ns=ns) for ns in (100, 200)]
    answers = [
        cameras.ask(TakeView(lock_id("bob"), 1, 1, cameras.next_count("bob"), (one,), 0))
        for one in asked
    ]

    assert [a.states[0].version for a in answers] == [0, 2]
    assert cameras.shard.state.slots.history.bytes == 0


def test_never_set_and_deleted_slots_keep_their_reason(cameras):
    """Null at a stamp says why; what was captured before the deletion is still there."""
    assert viewed(cameras, 100).null_reason == NullReason.NEVER_SET.name
    capture(cameras, 1, 100)
    grant = cameras.granted(lock_id("ann", 1, 2), item(W, "cam", "mask"))
    cameras.commit(lock_id("ann", 1, 2), grant.token, (slot("cam", "mask"), None))

    assert viewed(cameras, 100).version == 1
    assert viewed(cameras, 101).null_reason == NullReason.DELETED.name


def test_view_as_of_a_commit_stamp_does_not_see_what_was_captured_later(cameras):
    """A stamp written twice: the cut decides which of the two it is."""
    capture(cameras, 1, 100)
    first_ns = cameras.shard.state.slots[slot("cam", "mask")].stamp_ns
    cameras.wall_ns += 1_000
    capture(cameras, 2, 100)

    assert viewed(cameras, 100, at_ns=first_ns).version == 1
    assert viewed(cameras, 100, seq=2).version == 2

    capture(cameras, 3, 300)
    capture(cameras, 4, 400)
    assert viewed(cameras, 300, seq=3).version == 3
    assert viewed(cameras, 300, seq=4, at_ns=first_ns).null_reason == "OUTSIDE_RETENTION"


def test_view_is_current_from_the_newest_commit_on(cameras):
    """An older version belongs to a cut only together with what has replaced it."""
    for seq, stamp_ns in enumerate((100, 200), 1):
        capture(cameras, seq, stamp_ns)
        cameras.wall_ns += 1_000
    newest_ns = cameras.shard.state.slots[slot("cam", "mask")].stamp_ns
    asked = item(V, "cam", "mask")._replace(captured_ns=100)

    answer = cameras.ask(TakeView(lock_id("bob"), 1, 1, 1, (asked,), 0))

    assert isinstance(answer, Viewed)
    assert answer.states[0].stamp_ns < answer.from_ns == newest_ns <= answer.until_ns


def test_pinned_version_is_fetched_after_it_left_retention(cameras):
    """Who was shown a large datum can fetch it until the view is released."""
    capture(cameras, 1, 100, size=LARGE)
    capture(cameras, 2, 200, size=LARGE)
    assert viewed(cameras, 100).large
    for seq, stamp_ns in enumerate((300, 400, 500), 3):
        capture(cameras, seq, stamp_ns, size=LARGE)
    assert viewed(cameras, 100, seq=2).null_reason
    fetch = Fetch(lock_id("bob", 0, 1), 1, slot("cam", "mask"), 1, 0, LARGE)

    part = cameras.ask(fetch)
    assert isinstance(part, Slice)
    assert (bytes(part.body.body), part.stamp_ns) == (b"\x01" * LARGE, 100)

    cameras.ask(Release(lock_id("bob", 0, 1)))
    assert isinstance(cameras.ask(fetch), Gone)


def test_lock_shows_views_by_stamp_beside_its_own_data(cameras):
    """The views of an actor's lock ride with it."""
    for seq, stamp_ns in enumerate((100, 200), 1):
        capture(cameras, seq, stamp_ns)
    asked = item(V, "cam", "mask")._replace(captured_ns=100)

    granted = cameras.acquire(lock_id("bob", 0, 1), item(W), asked)

    assert isinstance(granted, Granted)
    assert [state.version for state in granted.states] == [0, 1]


def test_view_that_gets_no_cut_is_asked_by_stamp_under_a_read_lock(cameras):
    """Where undecided commits stand in the way of every cut, the client locks what it views."""
    for seq, stamp_ns in enumerate((100, 200), 1):
        capture(cameras, seq, stamp_ns)
    client = Client("bob", ttl_ns=TTL_NS)
    client.learn_placement(cameras.settings.placement._replace(shards=(ShardEntry("s0", ()),)))
    asked = item(V, "cam", "mask")._replace(captured_ns=100)
    ((_, items),) = client.plan((asked,), lock_views=True).locks
    assert [one.access for one in items] == [Access.READ]

    granted = cameras.granted(lock_id("bob", 0, 1), *items)

    assert [(state.version, state.captured_ns) for state in granted.states] == [(1, 100)]
    assert cameras.acquire(lock_id("ann", 1, 3), item(W, "cam", "mask")) is None


@pytest.mark.parametrize("access", [Access.WRITE, Access.READ_EACH, Access.VIEW_EACH])
def test_only_a_view_can_be_asked_by_stamp(cameras, access):
    """A lock is about the present, and a pattern has no one stamp."""
    asked = Item(access, "online", "cam", "mask", 0, 100)

    answer = cameras.acquire(lock_id("bob", 0, 1), asked)

    assert isinstance(answer, Refused)
    assert "only a View" in answer.text


def test_survey_lists_what_is_retained_oldest_first(cameras):
    """Without data; unasked, only the newest version stands there."""
    for seq, stamp_ns in enumerate((100, 200, 300, 400), 1):
        capture(cameras, seq, stamp_ns)

    listed, newest = (
        cameras.ask(Survey((), (), ("mask",), retained)) for retained in (True, False)
    )

    assert isinstance(listed, Surveyed)
    assert isinstance(newest, Surveyed)
    assert [(s.version, s.captured_ns, s.datum) for s in listed.states] == [
        (2, 200, None),
        (3, 300, None),
        (4, 400, None),
    ]
    assert newest.states == listed.states[-1:]
    assert cameras.notices[-1].changes[0].captured_ns == 400


def test_largest_retention_that_anybody_asks_for_counts(cameras):
    """Whoever needs fewer versions does not take away those of another."""
    for asked, counts in ((2, KEPT), (5, 5), (0, 5)):
        answer = cameras.register(AspectEntry("mask", "int", "volatile", asked))
        assert isinstance(answer, Registered)
        assert retained(cameras) == counts


def test_larger_retention_outlives_a_restart(cameras):
    """Whoever asked for more versions does not ask again: the shard has kept it."""
    cameras.register(AspectEntry("mask", "int", "volatile", 5))
    cameras.register(AspectEntry("mask", "int", "volatile", 4))

    cameras.restart()

    assert retained(cameras) == 5


@pytest.mark.parametrize("figures", [(-1, 0, 0), (0, -1, 0), (0, 0, -1), (NO_LIMIT + 1, 0, 0)])
def test_retention_that_is_none_is_refused(cameras, figures):
    """No figure means *no limit*, and the limits of the shard come before all of them."""
    entry = AspectEntry("other", "int", "volatile", *figures)

    answer = cameras.register(entry)

    assert isinstance(answer, Refused)
    assert str(NO_LIMIT) in answer.text


def test_retention_shows_in_the_counters(cameras):
    """`enact shard ls` tells what it costs."""
    for seq, stamp_ns in enumerate((100, 200, 300), 1):
        capture(cameras, seq, stamp_ns, size=10)

    answer = cameras.ask(ListSessions())

    assert isinstance(answer, Sessions)
    assert {c.name: c.value for c in answer.counters}["retained_bytes"] == 20


def test_aspect_of_which_nothing_was_said_retains_less_once_somebody_says_so():
    """What was retained by default goes with the next commit, in memory and on the disk."""
    bench = ShardBench()
    bench.register(AspectEntry("mask", "int", "durable"))
    bench.hello("ann")
    for seq in range(1, 5):
        capture(bench, seq, stamp_ns=100 - seq)
    bench.register(AspectEntry("mask", "int", "durable", 1))

    capture(bench, 5, stamp_ns=95)
    bench.wait(TTL_NS // 2, keep=("ann",))

    bench.shard.assert_invariants()
    history = bench.shard.state.slots.history
    assert (history.count, history.bytes, bench.recovered(2).history) == (0, 0, [])


def test_restart_forgets_what_an_aspect_retains_no_more():
    """Nothing wrote to the slot between: its rows would stay on the disk for ever."""
    bench = ShardBench()
    bench.register(AspectEntry("mask", "int", "durable"))
    bench.hello("ann")
    for seq in range(1, 5):
        capture(bench, seq, stamp_ns=100 - seq)
    bench.register(AspectEntry("mask", "int", "durable", 1))
    assert len(bench.recovered(2).history) == 3

    bench.restart()
    bench.wait(TTL_NS)

    assert bench.recovered(3).history == []
