"""One direction between a daemon and its database is cut: it falls silent, and its standby serves."""

import os
import sys
import time

import pytest
from postgres_nodes import USER, Node, make_folder
from replicated_cell import SHARD

from enact_dist.config.environment import without_overrides
from enact_dist.errors import LinkError
from enact_dist.link.log import READY, STANDS_BY
from enact_dist.verify.chaos.network.hosts import open_hosts
from enact_dist.verify.daemons import LineProcess

pytestmark = [pytest.mark.slow, pytest.mark.sampled(1), pytest.mark.carrier("zenoh")]
DATABASE, CLIENTS = "db", "clients"
DAEMONS = ("a", "b")
CLIENTS_OF_BOTH = 3
"""Of two daemons that take requests, Zenoh lets each client ask one."""


class HostsOfACell:
    """The database, two daemons of a shard and the clients, each on a host of its own.

    Attributes:
        hosts: The hosts.
    """

    def __init__(self, folder, name):
        self._folder = folder
        self._all = []
        self.hosts = open_hosts((DATABASE, *DAEMONS, CLIENTS), required=True)
        self._data = make_folder()
        self._node = Node(self._data, "alone", before=self.hosts.before(DATABASE))
        self._node.init()
        with (self._node.data / "postgresql.conf").open("a") as file:
            file.write("listen_addresses = '*'\n")
        with (self._node.data / "pg_hba.conf").open("a") as file:
            file.write("host all all all trust\n")
        self._node.start()
        place = self.hosts.endpoint(DATABASE).split("/")[1].split(":")[0]
        both = ", ".join(f'"{self.hosts.endpoint(host)}"' for host in DAEMONS)
        self._file = folder / "cell.toml"
        self._file.write_text(
            f'name = "{name}"\nworlds = ["online"]\ncarrier = "zenoh"\n'
            f'store = "postgresql://{USER}@{place}:{self._node.port}/postgres"\n'
            f"[shards.{SHARD}]\nadvertise = [{both}]\nlisten = {both.split(', ', maxsplit=1)[0]}\n"
        )

    def log(self, host):
        return (self._folder / f"{host}.log").read_text()

    def await_log(self, host, text, within_s=60):
        """Return once a daemon has said this."""
        end_s = time.monotonic() + within_s
        while text not in self.log(host):
            assert time.monotonic() < end_s, self.log(host)
            time.sleep(0.05)  # a file tells of no new lines

    def daemon(self, host, says):
        words = ["shard", "run", SHARD, "--cell", str(self._file), "--standby"]
        words += ["--listen", self.hosts.endpoint(host)]
        daemon = self._run("enact_dist.cli.main", host, words, host)
        daemon.expect(says)
        return daemon

    def client(self, number):
        return self._run("counting_client", CLIENTS, [str(self._file), str(number)], f"c{number}")

    def _run(self, module, host, words, log):
        environment = {**without_overrides(os.environ), "PYTHONPATH": os.pathsep.join(sys.path)}
        self._all.append(
            LineProcess(
                module, words, self._folder / f"{log}.log",
                before=self.hosts.before(host), environment=environment,
            )
        )  # fmt: skip
        return self._all[-1]

    def close(self):
        for process in self._all:
            process.end()
        self._node.close()
        self.hosts.close()


@pytest.fixture
def cell(tmp_path, shard_name):
    try:
        cell = HostsOfACell(tmp_path, f"ways{shard_name}")
    except LinkError as error:
        pytest.skip(str(error))
    yield cell
    cell.close()


def await_updates(clients):
    """Return once each client has counted on."""
    for client in clients:
        client.tell("next")
        client.expect("next")


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
