"""What one answer carries and one request parks is bounded; a late commit hides no newer one."""

from __future__ import annotations

from shard_bench import MS, S, ShardBench, item, lock_id, slot

from enact_dist.core.protocol.datum import Datum
from enact_dist.core.protocol.messages import (
    OUTCOME_COMMITTED,
    REPORT_BYTES_MAX,
    AwaitStamp,
    Commit,
    Fetch,
    KeepAlive,
    Outcome,
    Reached,
    Slice,
    WriteItem,
)
from enact_dist.terms import Access

W, WE, VE = Access.WRITE, Access.WRITE_EACH, Access.VIEW_EACH
ANN = lock_id("ann")


def test_grant_carries_a_bounded_number_of_bytes_when_a_pattern_matches_much():
    """Small data beyond twice the size of a fetched part are named and fetched, not sent."""
    bench = ShardBench()
    bench.hello("ann")
    limit = 2 * bench.settings.fetch_bytes_max
    entities = [f"tray/{number:04}" for number in range(limit // 60_000 + 50)]
    grant = bench.granted(ANN, item(WE, "tray/*", "frame"))
    writes = tuple(
        WriteItem(slot(entity, "frame"), Datum(b"t", bytes(60_000), 60_000)) for entity in entities
    )
    bench.ask(Commit(ANN, grant.token, writes, 0))

    second = lock_id("ann", 0, 2)
    states = bench.granted(second, item(VE, "tray/*", "frame")).states

    assert len(states) == len(entities)
    assert sum(state.datum.size for state in states if state.datum) <= limit
    named = next(state for state in states if state.large)
    fetch = Fetch(second, 1, named.slot, named.version, 0, 1 << 20)
    part = bench.ask(fetch)
    assert isinstance(part, Slice)
    assert part.body.size == 60_000


def test_late_commit_does_not_hide_the_outcome_of_a_newer_one_of_its_lane():
    """A client gave up a commit that the disk kept; its lane's next commit stays answerable."""
    bench = ShardBench()
    bench.hello("ann")
    older, newer = lock_id("ann", 0, 1), lock_id("ann", 0, 2)
    grant = bench.granted(older, item(W, "piece", "count"))
    bench.disk_is_done = False
    bench.commit(older, grant.token, (slot(), "1"))
    grant = bench.granted(newer, item(W, "piece", "frame"))
    bench.commit(newer, grant.token, (slot("piece", "frame"), "2"))
    bench.finish_disk()

    assert bench.value() == "1"
    assert bench.ask(Outcome(newer)).kind == OUTCOME_COMMITTED


def test_wait_for_a_stamp_is_answered_after_a_slice_however_long_it_asks():
    """Nobody parks a request at a shard for longer than one slice of waiting."""
    bench = ShardBench()
    bench.hello("ann")
    handle = bench.send(AwaitStamp(bench.wall_ns + 100 * S, 1 << 60, "ann", 1))
    bench.wait(900 * MS)
    assert handle not in bench.answers
    bench.wait(200 * MS)
    answer = bench.answers[handle]
    assert isinstance(answer, Reached)
    assert not answer.reached


def test_report_that_no_listing_shows_is_not_kept_either():
    """Thousands of sessions with the longest report of the wire would take most of a gigabyte.

    The shard renews such a session all the same, and counts what it left out.
    """
    bench = ShardBench()
    bench.hello("ann")
    kept = []
    for size in (REPORT_BYTES_MAX, 0, REPORT_BYTES_MAX + 1):
        bench.ask(KeepAlive("ann", bench.shard.epoch, 1, (), bytes(size)))
        kept.append(len(bench.shard.state.sessions.by_id["ann"].report))

    assert kept == [REPORT_BYTES_MAX, REPORT_BYTES_MAX, 0]
    assert bench.counter("reports_too_long") == 1
