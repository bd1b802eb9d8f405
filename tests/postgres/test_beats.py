"""When a standby may take a shard over, as it sees the holder's beats by its own clock."""

import pytest

from enact_dist.link.postgres.address import SeenRow
from enact_dist.link.postgres.standby import RETURN_S, BeatWatch

HELD = SeenRow(7, 1, "host 1")


@pytest.fixture
def watch():
    return BeatWatch(2.0)


def test_a_shard_without_a_holder_is_free_at_once(watch):
    """Its daemon has ended cleanly, or there was none."""
    assert watch.is_free(SeenRow(7, 5, ""), 0.0)


def test_a_shard_is_free_after_its_lease_without_a_beat(watch):
    """And the drift of two clocks, counted from when the beat was seen."""
    assert not watch.is_free(HELD, 10.0)
    assert not watch.is_free(HELD, 12.03)
    assert watch.is_free(HELD, 12.05)


def test_each_beat_begins_the_wait_anew(watch):
    """So does an epoch: another standby was first."""
    assert not watch.is_free(HELD, 10.0)
    assert not watch.alive
    assert not watch.is_free(HELD._replace(beat=2), 12.0)
    assert watch.alive
    assert not watch.is_free(HELD._replace(epoch=8), 14.0)
    assert not watch.is_free(HELD._replace(epoch=8), 16.0)
    assert watch.is_free(HELD._replace(epoch=8), 16.1)


def test_an_outage_of_the_database_counts_for_nothing(watch):
    """No beat could change; the holder gets time to connect again, too."""
    assert not watch.is_free(HELD, 10.0)
    watch.reconnected()
    assert not watch.is_free(HELD, 30.0)
    assert not watch.is_free(HELD, 30.0 + 2.0 + RETURN_S)
    assert watch.is_free(HELD, 30.0 + (2.0 + RETURN_S) * 1.03)
