"""How long a lease is held and waited for, and what a lost connection did."""

from __future__ import annotations

import pytest

from enact_dist.core.failover.lease import (
    DRIFT_PPM,
    OUTAGE_NS,
    BrokenBatch,
    Lease,
    ShardRow,
    Standby,
    after_break,
)

S = 1_000_000_000
LEASE_NS = 2 * S


def test_two_clocks_that_drift_apart_never_let_two_daemons_serve():
    """The slowest holder falls silent before the fastest standby takes the shard over."""
    lease, standby = Lease(LEASE_NS), Standby(LEASE_NS)
    lease.confirmed(0)
    standby.connected()
    standby.saw(ShardRow(7, 3, 1, "a"), 0)
    fast, slow = 1 + 0.99 * DRIFT_PPM / 1e6, 1 - 0.99 * DRIFT_PPM / 1e6

    silent_s = lease.until_ns / slow / 1e9
    taken_s = next(
        at_ns / 1e9
        for at_ns in range(0, 2 * LEASE_NS, 1_000_000)
        if standby.saw(ShardRow(7, 3, 1, "a"), int(at_ns * fast))
    )

    assert silent_s < taken_s


def test_a_lease_never_gets_shorter():
    lease = Lease(LEASE_NS)
    lease.confirmed(5 * S)
    until_ns = lease.until_ns

    lease.confirmed(4 * S)

    assert lease.until_ns == until_ns
    assert lease.holds(until_ns - 1)
    assert not lease.holds(until_ns)


def test_each_beat_is_waited_for_anew():
    standby = Standby(LEASE_NS)
    standby.connected()

    assert not standby.saw(ShardRow(7, 3, 1, "a"), 0)
    assert not standby.saw(ShardRow(7, 3, 2, "a"), 2 * S)
    assert not standby.saw(ShardRow(7, 3, 2, "a"), 4 * S)
    assert standby.saw(ShardRow(7, 3, 2, "a"), 5 * S)


def test_a_shard_that_was_given_back_is_taken_at_once():
    standby = Standby(LEASE_NS)
    standby.connected()

    assert standby.saw(ShardRow(7, 3, 1, ""), 0)


def test_after_an_outage_the_standby_gives_the_holder_more_time():
    standby, row = Standby(LEASE_NS), ShardRow(7, 3, 1, "a")
    standby.connected()
    standby.saw(row, 0)
    standby.connected()

    assert not standby.saw(row, 10 * S)
    assert not standby.saw(row, 10 * S + LEASE_NS + OUTAGE_NS)
    assert standby.saw(row, 10 * S + 2 * LEASE_NS + OUTAGE_NS)


def test_after_an_outage_a_beat_ends_the_extra_time():
    standby = Standby(LEASE_NS)
    standby.connected()
    standby.connected()
    standby.saw(ShardRow(7, 3, 1, "a"), 0)
    standby.saw(ShardRow(7, 3, 2, "a"), S)

    assert standby.saw(ShardRow(7, 3, 2, "a"), S + LEASE_NS + LEASE_NS // 10)


@pytest.mark.parametrize(
    ("row", "found"),
    [
        (ShardRow(7, 4, 9, "a"), BrokenBatch.STANDS),
        (ShardRow(7, 3, 9, "a"), BrokenBatch.MISSING),
        (ShardRow(8, 4, 9, "b"), BrokenBatch.TAKEN),
        (ShardRow(8, 3, 9, "b"), BrokenBatch.TAKEN),
        (ShardRow(7, 5, 9, "a"), BrokenBatch.TAKEN),
        (ShardRow(6, 4, 9, "a"), BrokenBatch.TAKEN),
    ],
)
def test_the_row_says_what_became_of_a_batch(row, found):
    assert after_break(row, epoch=7, batch=4) is found
