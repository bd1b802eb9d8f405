"""One direction between a daemon and its database is cut: it falls silent, and its standby serves."""

import pytest
from cell_on_hosts import CellOnHosts, await_updates
from postgres_nodes import Node, make_folder

from enact_dist.errors import LinkError
from enact_dist.link.log import READY, STANDS_BY

pytestmark = [pytest.mark.slow, pytest.mark.sampled(1), pytest.mark.carrier("zenoh")]
DATABASE = "db"
DAEMONS = ("a", "b")
CLIENTS_OF_BOTH = 3
"""Of two daemons that take requests, Zenoh lets each client ask one."""


class HostsOfACell(CellOnHosts):
    """The database, two daemons of a shard and the clients, each on a host of its own."""

    def __init__(self, folder, name):
        super().__init__(folder, name, DAEMONS, (DATABASE,))
        self._node = Node(make_folder(), "alone", before=self.hosts.before(DATABASE))
        self._node.init()
        with (self._node.data / "postgresql.conf").open("a") as file:
            file.write("listen_addresses = '*'\n")
        with (self._node.data / "pg_hba.conf").open("a") as file:
            file.write("host all all all trust\n")
        self._node.start()
        self.store_at([DATABASE], self._node.port, "postgres")

    def end_database(self):
        self._node.close()


@pytest.fixture
def cell(tmp_path, shard_name):
    try:
        cell = HostsOfACell(tmp_path, f"ways{shard_name}")
    except LinkError as error:
        pytest.skip(str(error))
    yield cell
    cell.close()


@pytest.mark.parametrize("apart", [False, True], ids=["alone", "and from its successor"])
@pytest.mark.parametrize("lost", [(DATABASE, "a"), ("a", DATABASE)], ids=["answers", "requests"])
def test_a_daemon_that_hears_or_reaches_no_database_is_replaced(cell, lost, apart):
    """Whichever way is cut: no update is lost or counted twice.

    The old daemon ends once it hears of the new one, from that or from the database; as long as it
    hears of neither, clients that reach both ask the new one.
    """
    cuts = [lost, *([DAEMONS, DAEMONS[::-1]] if apart else [])]
    active = cell.daemon("a", READY)
    standby = cell.daemon("b", STANDS_BY)
    clients = [cell.client(number) for number in range(CLIENTS_OF_BOTH)]
    await_updates(clients)
    for one in cuts:
        cell.hosts.cut(*one)
    standby.expect(READY)
    if apart:
        cell.await_log("a", "it takes no requests")
    else:
        assert active.wait_status(60) == 1
    await_updates(clients)
    assert "answers wait" in cell.log("a")
    assert active.status == (None if apart else 1), cell.log("a")
    for one in cuts:
        cell.hosts.heal(*one)
    assert active.wait_status(60) == 1
    assert "has another holder" in cell.log("a")
    await_updates(clients)
    for client in clients:
        client.tell("end")
        client.expect("right")


def test_a_daemon_that_let_its_clients_go_takes_them_back(cell):
    """It reaches neither its database nor a standby, and no other daemon takes the shard."""
    active = cell.daemon("a", READY)
    clients = [cell.client(number) for number in range(2)]
    await_updates(clients)
    cuts = [(DATABASE, "a"), ("a", DATABASE)]
    for one in cuts:
        cell.hosts.cut(*one)
    cell.await_log("a", "it takes no requests")
    for one in cuts:
        cell.hosts.heal(*one)
    await_updates(clients)
    assert "the lease is renewed" in cell.log("a")
    assert active.status is None
    for client in clients:
        client.tell("end")
        client.expect("right")
