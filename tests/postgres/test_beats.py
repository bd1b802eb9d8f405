"""When a standby may take a shard over, as it sees the holder's beats by its own clock."""

import threading
import time

from polling import until
from shard_stores import address_of

from enact_dist.core.failover.lease import OUTAGE_NS
from enact_dist.link.postgres.standby import wait_free


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
    assert found[1] - started_s > OUTAGE_NS / 1e9


def test_a_look_that_the_database_kept_waiting_counts_for_nothing(server, stores):
    """Its processes stood still, and the holder's renewals with them."""
    address = address_of(server.url, lease_s=1.0)
    _, _, medium = stores.open(address)
    looks, found = [], []

    def stand_by():
        arguments = {"patient": True, "note": print, "looked": lambda _: looks.append(1)}
        found.append(wait_free(address, stopped=threading.Event(), **arguments))
        found.append(time.monotonic())

    standby = threading.Thread(target=stand_by)
    standby.start()
    until(lambda: len(looks) > 3)
    medium._renewer.close()
    server.pause()
    standby.join(1.5)  # longer than the lease and what a standby waits
    assert not found
    server.go_on()
    back_s = time.monotonic()
    standby.join(20)
    assert found[0].seen.holder
    assert found[1] - back_s > OUTAGE_NS / 2e9  # the lease itself was over in a fifth of that
