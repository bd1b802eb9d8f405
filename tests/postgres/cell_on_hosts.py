"""A cell of one shard in a database, with daemons and clients on hosts of their own."""

import os
import sys

from polling import until
from postgres_nodes import USER
from replicated_cell import SHARD

from enact_dist.config.environment import without_overrides
from enact_dist.verify.chaos.network.hosts import open_hosts
from enact_dist.verify.daemons import LineProcess

CLIENTS = "clients"


class CellOnHosts:
    """Two daemons of a shard, and clients.

    Args:
        folder: For its files.
        name: Of the cell.
        daemons: Hosts of the daemons.
        others: Further hosts, beside that of the clients.

    Attributes:
        hosts: The hosts.

    Raises:
        LinkError: The system allows no namespaces.
    """

    def __init__(self, folder, name, daemons, others):
        self.folder = folder
        self._name, self._daemons = name, daemons
        self._all = []
        self.hosts = open_hosts(tuple(dict.fromkeys((*others, *daemons, CLIENTS))), required=True)
        self._file = folder / "cell.toml"

    def store_at(self, hosts, port, database):
        """Write the file of the cell, with its database on these hosts."""
        places = ",".join(f"{self.hosts.address(host)}:{port}" for host in hosts)
        both = ", ".join(f'"{self.hosts.endpoint(host)}"' for host in self._daemons)
        self._file.write_text(
            f'name = "{self._name}"\nworlds = ["online"]\ncarrier = "zenoh"\n'
            f'store = "postgresql://{USER}@{places}/{database}"\n'
            f"[shards.{SHARD}]\nadvertise = [{both}]\nlisten = {both.split(', ', maxsplit=1)[0]}\n"
        )

    def daemon(self, host, says):
        """Start a daemon; return it once it says this."""
        words = ["shard", "run", SHARD, "--cell", str(self._file), "--standby"]
        words += ["--listen", self.hosts.endpoint(host)]
        daemon = self._run("enact_dist.cli.main", host, words, host)
        daemon.expect(says)
        return daemon

    def client(self, number):
        """Return a client that counts in a slot of its own."""
        return self._run("counting_client", CLIENTS, [str(self._file), str(number)], f"c{number}")

    def _run(self, module, host, words, log):
        environment = {**without_overrides(os.environ), "PYTHONPATH": os.pathsep.join(sys.path)}
        self._all.append(
            LineProcess(
                module, words, self.folder / f"{log}.log",
                before=self.hosts.before(host), environment=environment,
            )
        )  # fmt: skip
        return self._all[-1]

    def log(self, host):
        """Return what a daemon has said."""
        return (self.folder / f"{host}.log").read_text()

    def await_log(self, host, text, within_s=60):
        """Return once a daemon has said this."""
        until(lambda: text in self.log(host), limit_s=within_s, missed=lambda: self.log(host))

    def close(self):
        """End all processes and hosts; what a database leaves is its own."""
        for process in self._all:
            process.end()
        self.end_database()
        self.hosts.close()

    def end_database(self):
        """End what else runs on the hosts."""
        raise NotImplementedError


def await_updates(clients, within_s=60.0):
    """Return once each client has counted on."""
    for client in clients:
        client.tell(f"next {within_s}")
    for client in clients:
        client.expect("next", timeout_s=within_s + 30.0)
