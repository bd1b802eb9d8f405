"""One direction between a daemon and its database is cut: it falls silent, and its standby serves."""

import os
import sys

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

    The old daemon ends once it hears of the new one, from that or from the database; a client that
    asks it meanwhile gets no answer.
    """
    cuts = [lost, *([DAEMONS, DAEMONS[::-1]] if apart else [])]
    active = cell.daemon("a", READY)
    standby = cell.daemon("b", STANDS_BY)
    clients = [cell.client(number) for number in range(2)]
    await_updates(clients)
    for one in cuts:
        cell.hosts.cut(*one)
    standby.expect(READY)
    if not apart:
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
