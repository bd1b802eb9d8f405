"""When a standby may take a shard over, as it sees the holder's beats by its own clock."""

import threading
import time

import pytest
from shard_stores import address_of

from enact_dist.link.postgres.address import SeenRow
from enact_dist.link.postgres.standby import RETURN_S, BeatWatch, wait_free

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
    watch.was_away()
    assert not watch.is_free(HELD, 30.0)
    assert not watch.is_free(HELD, 30.0 + 2.0 + RETURN_S)
    assert watch.is_free(HELD, 30.0 + (2.0 + RETURN_S) * 1.03)


def test_a_holder_that_came_back_has_its_usual_lease(watch):
    """The time to connect again is over once a beat was seen."""
    watch.was_away()
    assert not watch.is_free(HELD, 10.0)
    assert not watch.is_free(HELD._replace(beat=2), 11.0)
    assert not watch.is_free(HELD._replace(beat=2), 13.0)
    assert watch.is_free(HELD._replace(beat=2), 13.1)


def test_a_standby_gives_the_holder_time_after_an_outage(server, stores):
    """The server was restarted: no beat could change, so none counts as missing."""
    address = address_of(server.url, lease_s=0.5)
    _, _, medium = stores.open(address)
    medium._renewer.close()
    away = threading.Event()
    found = []

    def stand_by():
        found.append(wait_free(address, stopped=threading.Event(), patient=True, note=note))
        found.append(time.monotonic())

    def note(text):
        if "cannot be reached" in text:
            away.set()

    standby = threading.Thread(target=stand_by)
    standby.start()
    server.stop("fast")
    assert away.wait(10)
    server.start()
    started_s = time.monotonic()
    standby.join(20)
    assert found[0].seen.holder
    assert found[1] - started_s > RETURN_S


def test_a_look_that_the_database_kept_waiting_counts_for_nothing(server, stores):
    """Its processes stood still, and the holder's renewals with them."""
    address = address_of(server.url, lease_s=1.0)
    _, _, medium = stores.open(address)
    looks, found = [], []

    def stand_by():
        arguments = {"patient": True, "note": print, "looked": lambda: looks.append(1)}
        found.append(wait_free(address, stopped=threading.Event(), **arguments))
        found.append(time.monotonic())

    standby = threading.Thread(target=stand_by)
    standby.start()
    _await(lambda: len(looks) > 3)
    medium._renewer.close()
    server.pause()
    time.sleep(1.5)  # longer than the lease and what a standby waits
    server.go_on()
    back_s = time.monotonic()
    standby.join(20)
    assert found[0].seen.holder
    assert found[1] - back_s > RETURN_S


def _await(condition):
    end_s = time.monotonic() + 20
    while not condition():
        assert time.monotonic() < end_s
        time.sleep(0.02)
