"""How long a lease is held and waited for, and what a lost connection did."""

from __future__ import annotations

import pytest

from enact_dist.core.failover.lease import (
    DRIFT_PPM,
    OUTAGE_NS,
    BrokenBatch,
    HolderRow,
    Lease,
    Standby,
    after_break,
)

S = 1_000_000_000
LEASE_NS = 2 * S


def test_two_clocks_that_drift_apart_never_let_two_daemons_serve():
    """The slowest holder falls silent before the fastest standby takes the shard over."""
    lease, standby = Lease(LEASE_NS), Standby(LEASE_NS)
    lease.confirmed(0)
    standby.is_free(HolderRow(7, 3, 1, "a"), 0)
    fast, slow = 1 + 0.99 * DRIFT_PPM / 1e6, 1 - 0.99 * DRIFT_PPM / 1e6

    silent_s = lease.until_ns / slow / 1e9
    taken_s = next(
        at_ns / 1e9
        for at_ns in range(0, 2 * LEASE_NS, 1_000_000)
        if standby.is_free(HolderRow(7, 3, 1, "a"), int(at_ns * fast))
    )

    assert silent_s < taken_s


def test_a_lease_never_gets_shorter():
    """A confirmation that comes late, of an earlier moment, changes nothing."""
    lease = Lease(LEASE_NS)
    lease.confirmed(5 * S)
    until_ns = lease.until_ns

    lease.confirmed(4 * S)

    assert lease.until_ns == until_ns
    assert lease.holds(until_ns - 1)
    assert not lease.holds(until_ns)


HELD = HolderRow(7, 3, 1, "host 1")


@pytest.fixture
def standby():
    return Standby(LEASE_NS)


def test_a_shard_without_a_holder_is_free_at_once(standby):
    """Its daemon has ended cleanly, or there was none."""
    assert standby.is_free(HELD._replace(holder=""), 0)


def test_a_shard_is_free_after_its_lease_without_a_beat(standby):
    """And the drift of two clocks, counted from when the beat was seen."""
    assert not standby.is_free(HELD, 10 * S)
    assert not standby.is_free(HELD, 12_030_000_000)
    assert standby.is_free(HELD, 12_050_000_000)


def test_each_beat_begins_the_wait_anew(standby):
    """So does an epoch: another standby was first."""
    assert not standby.is_free(HELD, 10 * S)
    assert not standby.alive
    assert not standby.is_free(HELD._replace(beat=2), 12 * S)
    assert standby.alive
    assert not standby.is_free(HELD._replace(epoch=8), 14 * S)
    assert not standby.is_free(HELD._replace(epoch=8), 16 * S)
    assert standby.is_free(HELD._replace(epoch=8), 16_100_000_000)


def test_an_outage_of_the_database_counts_for_nothing(standby):
    """No beat could change; the holder gets time to connect again, too."""
    assert not standby.is_free(HELD, 10 * S)
    standby.was_away()
    assert not standby.is_free(HELD, 30 * S)
    assert not standby.is_free(HELD, 32 * S + OUTAGE_NS)
    assert standby.is_free(HELD, 30 * S + (LEASE_NS + OUTAGE_NS) * 103 // 100)


def test_the_time_of_slow_looks_does_not_count(standby):
    """The holder's beats waited as long; what lies between such looks counts all the same."""
    assert not standby.is_free(HELD, 10 * S)
    for ended_s in (12, 14, 16):
        standby.stood_still(3 * S // 2)
        assert not standby.is_free(HELD, ended_s * S)
    assert not standby.is_free(HELD, 19 * S + S // 2)  # the holder has longer, as after an outage
    assert standby.is_free(HELD, 19 * S + 7 * S // 10)


def test_a_holder_that_came_back_has_its_usual_lease(standby):
    """The time to connect again is over once a beat was seen."""
    standby.was_away()
    assert not standby.is_free(HELD, 10 * S)
    assert not standby.is_free(HELD._replace(beat=2), 11 * S)
    assert not standby.is_free(HELD._replace(beat=2), 13 * S)
    assert standby.is_free(HELD._replace(beat=2), 13_100_000_000)


@pytest.mark.parametrize(
    ("row", "found"),
    [
        (HolderRow(7, 4, 9, "a"), BrokenBatch.STANDS),
        (HolderRow(7, 3, 9, "a"), BrokenBatch.MISSING),
        (HolderRow(8, 4, 9, "b"), BrokenBatch.TAKEN),
        (HolderRow(8, 3, 9, "b"), BrokenBatch.TAKEN),
        (HolderRow(7, 5, 9, "a"), BrokenBatch.TAKEN),
        (HolderRow(6, 4, 9, "a"), BrokenBatch.TAKEN),
    ],
)
def test_the_row_says_what_became_of_a_batch(row, found):
    """Our epoch and our number, our epoch and the number before, or another one's."""
    assert after_break(row[:2], epoch=7, batch=4) is found
