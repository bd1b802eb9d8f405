"""Two standbys see at the same moment that a shard is free: one takes it, the other waits on."""

import os
import queue
import threading

from shard_stores import address_of, state, take, versions

from enact_dist.link.postgres import standby
from enact_dist.link.postgres.address import ShardHeldError
from enact_dist.link.postgres.opening import open_database

RACES = int(os.environ.get("ENACT_RACES", "25"))
LEASE_S = 60.0
"""No holder of this test is ever late."""


class Contender(threading.Thread):
    """Stands by until it has the shard, as a daemon does; the winners are in `won`."""

    def __init__(self, address, won, stopped):
        super().__init__(daemon=True)
        self.lost, self.store, self.recovered = 0, None, None
        self._address, self._won, self._stopped = address, won, stopped
        self.start()

    def run(self):
        while free := standby.wait_free(
            self._address, stopped=self._stopped, patient=True, note=lambda _: None
        ):
            try:
                self.store, self.recovered = open_database(free, unix_s=1)
            except ShardHeldError:
                self.lost += 1
            else:
                self._won.put(self)
                return


def test_of_two_standbys_one_takes_a_shard_each_time(server, stopped, monkeypatch):
    """The holder gives it back again and again; each time there is one new epoch, and nothing is lost."""
    monkeypatch.setattr(standby, "LOOK_S", 0.001)  # or they seldom see it at the same moment
    address, won = address_of(server.url, lease_s=LEASE_S), queue.Queue()
    store, recovered, _ = take(address)
    epoch, lost = recovered.epoch, 0
    waiting = {Contender(address, won, stopped) for _ in range(2)}
    for number in range(1, RACES + 1):
        store.write([state(number)])
        store.close()
        winner = won.get(timeout=60)
        waiting.remove(winner)
        store = winner.store
        assert winner.recovered.epoch == epoch + number
        assert versions(winner.recovered) == {"a": number}
        (other,) = waiting
        assert other.is_alive()
        assert won.empty()
        lost += winner.lost
        waiting.add(Contender(address, won, stopped))
    lost += sum(one.lost for one in waiting)
    stopped.set()
    for one in waiting:
        one.join(30)
        assert one.store is None
    store.close()
    print(f"{RACES} races, {lost} of them lost in the last step")
