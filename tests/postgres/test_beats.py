"""When a standby may take a shard over, as it sees the holder's beats by its own clock."""

import threading
import time

from shard_stores import address_of, state

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
    """Its processes stood still, and the holder's renewals with them: the holder goes on."""
    address = address_of(server.url, lease_s=1.0)
    store, _, _ = stores.open(address)
    stopped = threading.Event()
    looks = []
    arguments = {"stopped": stopped, "patient": True, "note": print}
    arguments["looked"] = lambda: looks.append(time.monotonic())
    found = []
    standby = threading.Thread(target=lambda: found.append(wait_free(address, **arguments)))
    standby.start()
    _await(lambda: len(looks) > 3)
    server.pause()
    time.sleep(2.0)  # longer than the lease and what a standby waits
    server.go_on()
    back = len(looks)
    _await(lambda: len(looks) > back + 10)
    stopped.set()
    standby.join(10)
    assert found == [None]
    store.write([state(1)])


def _await(condition):
    end_s = time.monotonic() + 20
    while not condition():
        assert time.monotonic() < end_s
        time.sleep(0.02)
